"""Goodness of fit: residuals of a servo against the noise of its readings, found without the servo.

The residuals of a fit cannot say how noisy the readings are, because they hold the model's error,
too. `reading_noise` finds the noise without a model: whatever moves a joint is smooth and follows
its commands, so a weighted sum of a few consecutive readings and of earlier commands can be nearly
zero, and what is left is noise. The weights of the readings with the smallest sum of squares are
found on half of the readings and applied to the other half (Koopmans-Levin). Applied to the
residuals of a model, the same finds what of them no smooth function explains, which is closer to
the noise where readings are few. A tone's motion is periodic as well: what a Fourier series leaves
of its readings is noise, however irregular their dates are.

References
----------
Levin, M. J. (1964). Estimation of a system pulse transfer function in the presence of noise. IEEE
Transactions on Automatic Control 9: 229–235.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import least_squares
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run, fresh_residuals
from pupper_sysid.sysid.fit.structure import Structure

DESCRIBED = 1.6
"""Residual over noise up to which a servo describes a recording: in twins from an independent
simulator (facts of `benchmarks/wide_twins.py`) servos of the fitted structure stay below."""

DESCRIBED_ONE = 2.25
"""The same of one motion among several: a servo may be described but for its fastest tone. Of 36
recordings of the fitted structure (`benchmarks/wide_twins.py`, seed 211) none has more than 2.0,
but for one whose dates are unknown to 11 ms."""

LEAST_NOISE_RAD = 1e-4
"""What counts as noise where readings are exact, as in logs of a simulation: a fifteenth of a count
of 12 bits, and about what a physics step of half a millisecond leaves of the fastest motions."""

_STRIDE_S = 0.005  # between the readings of a sum, at least
_REACH_S = 0.12  # of earlier commands: dead time and settling of a servo
_ORDER = 4  # earlier readings of a sum
_IRREGULAR = 0.35  # of the usual interval: a longer or shorter one spoils a sum
_LEAST_ROWS = 4  # per weight
_SETTLED_S = 0.5  # after which a tone's motion repeats, and not before its second period
_MOST_HARMONICS = 7  # dry friction and a limited speed leave little beyond the seventh
_LEAST_FREEDOM = 15  # readings more than coefficients: noise known to 18 %
_OUTLIER_MAD = 4.0 * 1.4826
_AT_REST = 0.1  # of the root mean square speed


def reading_noise(
    runs: Sequence[Run],
    residuals: Sequence[NDArray[np.float64]],
    rows: Sequence[NDArray[np.bool_]] | None = None,
) -> float:
    """Standard deviation of the noise of readings that count, an upper bound [rad].

    `runs`: of one kind of motion. `residuals` of shape (samples,) each: of the best model known
    [rad]. `rows` of shape (samples,) each: of which readings; by default all. Returns NaN where
    there are too few readings.
    """
    of_readings = [run.sample_rad for run in runs]
    rows = rows or [np.ones(len(r), bool) for r in of_readings]
    bounds = [
        _noise([_sums(*each) for each in zip(runs, of_runs, rows, strict=True)])
        for of_runs in (of_readings, residuals)
    ]
    bounds += [_off_harmonics(runs, of_runs) for of_runs in (of_readings, residuals)]
    return float(np.fmin.reduce(bounds))


def _off_harmonics(runs: Sequence[Run], of_runs: Sequence[NDArray[np.float64]]) -> float:
    """Root mean square of what a Fourier series leaves of a tone's settled readings [rad].

    NaN where a run is no tone, or there are too few readings.
    """
    squares, freedom = 0.0, 0
    for run, values in zip(runs, of_runs, strict=True):
        if not run.tone > 0:
            return float("nan")
        time = run.sample_step * run.step_s
        settled = time > max(_SETTLED_S, 1.0 / run.frequency_hz)
        count = min(_MOST_HARMONICS, int(settled.sum()) // (2 * _LEAST_ROWS))
        if count < 1:
            continue
        turn = 2 * np.pi * run.frequency_hz * time[settled]
        orders = [n * turn for n in range(1, count + 1)]
        design = np.column_stack([np.ones(len(turn)), *map(np.sin, orders), *map(np.cos, orders)])
        rest = values[settled] - design @ least_squares(design, values[settled])
        squares += len(turn) * _clipped_square(rest)
        freedom += len(turn) - design.shape[1]
    return float(np.sqrt(squares / freedom)) if freedom >= _LEAST_FREEDOM else float("nan")


def _sums(
    run: Run, values: NDArray[np.float64], use: NDArray[np.bool_]
) -> tuple[NDArray, NDArray] | None:
    """Consecutive values (rows, order + 1), and what is known of each row: commands before it.

    `use` of shape (samples,): of which readings there are rows.
    """
    time, count = run.sample_step * run.step_s, len(values)
    if count < 10 * _ORDER:
        return None
    apart = float(np.median(np.diff(time)))
    if not apart > 0:
        return None
    stride = max(1, round(_STRIDE_S / apart))
    interval = stride * apart
    reach = int(np.clip(np.ceil(_REACH_S / interval), 3, max(count // 12, 3)))
    row = np.arange(_ORDER * stride, count)
    back = row[:, None] - stride * np.arange(_ORDER + 1)
    if not len(row):
        return None
    regular = (np.abs(-np.diff(time[back], axis=1) - interval) < _IRREGULAR * interval).all(axis=1)
    regular &= use[row]
    # means of the held command over intervals before each reading
    clock = run.step_s * np.arange(run.steps + 1)
    area = np.concatenate([[0.0], np.cumsum(run.command * run.step_s)])
    edges = time[row][:, None] - interval * np.arange(reach + 1)
    sums = np.interp(edges, clock, area) + np.minimum(edges, 0.0) * run.rest_rad
    means = -np.diff(sums, axis=1) / interval
    known = np.concatenate([means, np.ones((len(row), 1))], axis=1)
    return values[back][regular], known[regular]


def _noise(parts: Sequence[tuple[NDArray, NDArray] | None]) -> float:
    rows = [part for part in parts if part is not None and len(part[0])]
    if not rows:
        return float("nan")
    width = min(known.shape[1] for _, known in rows)
    values = np.concatenate([v for v, _ in rows])
    known = np.concatenate(
        [np.concatenate([k[:, : width - 1], k[:, -1:]], axis=1) for _, k in rows]
    )
    if len(values) < 2 * _LEAST_ROWS * (width + _ORDER + 1):
        return float("nan")
    half = (np.arange(len(values)) // max(20, len(values) // 16)) % 2 == 0
    squares = []
    for fitted, tested in ((half, ~half), (~half, half)):
        u, s, v = np.linalg.svd(known[fitted], full_matrices=False)
        kept = s > 1e-4 * s[0]
        effect = (v[kept].T / s[kept]) @ (u[:, kept].T @ values[fitted])
        rest = values[fitted] - known[fitted] @ effect
        weights = np.linalg.svd(rest, full_matrices=False)[2][-1]
        sums = (values[tested] - known[tested] @ effect) @ weights
        squares.append(_clipped_square(sums))
    return float(np.sqrt(np.mean(squares)))


def _clipped_square(values: NDArray[np.float64]) -> float:
    most = _OUTLIER_MAD * float(np.median(np.abs(values)))
    return float(np.mean(np.minimum(np.abs(values), most) ** 2))


def goodness_of_fit(
    structure: Structure,
    values: NDArray[np.float64],
    runs: Sequence[Run],
    quantum_rad: float,
) -> dict[str, float]:
    """Residual over noise of each kind of motion: 1 where the servo explains all but noise.

    `values` of shape (parameters,). `quantum_rad`: quantisation step of readings: their noise is
    not below that of rounding, nor below `LEAST_NOISE_RAD`. Returns by tone, or label of the run;
    NaN where the noise is not known. Of motions with rests it is the larger one of all readings and
    of those in motion: a joint at rest is where its model is, whatever that is.
    """
    residuals = fresh_residuals(structure, values, runs)
    least = max(quantum_rad / np.sqrt(12.0), LEAST_NOISE_RAD)
    kinds = [f"{r.tone:g} Hz" if r.tone > 0 else r.label for r in runs]
    ratios = {}
    for kind in dict.fromkeys(kinds):
        members = [n for n, k in enumerate(kinds) if k == kind]
        parts, of_kind = [residuals[n] for n in members], [runs[n] for n in members]
        used_rows = [[np.ones(len(part), bool) for part in parts]]
        if not of_kind[0].tone > 0:
            used_rows.append(list(map(_moving, of_kind, free_run(structure, values, of_kind))))
        ratios[kind] = float("nan")
        for rows in used_rows:
            noise = reading_noise(of_kind, parts, rows)
            if np.isfinite(noise):
                used = np.concatenate([r[use] for r, use in zip(parts, rows, strict=True)])
                ratio = float(np.sqrt(_clipped_square(used)) / max(noise, least))
                ratios[kind] = float(np.fmax(ratios[kind], ratio))
    return ratios


def _moving(run: Run, track: NDArray[np.float64]) -> NDArray[np.bool_]:
    """At which readings a motion is faster than a tenth of its root mean square, shape (samples,).

    `track` of shape (steps + 1,): the motion [rad].
    """
    speed = np.abs(at_steps(np.gradient(track), run.sample_step))
    return speed > _AT_REST * np.sqrt(np.mean(speed**2))


def overall(ratios: Mapping[str, float]) -> float:
    """Root mean square over the motions; NaN where none is known."""
    known = np.array([r for r in ratios.values() if np.isfinite(r)])
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
