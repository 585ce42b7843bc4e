"""Noise of a joint's readings, and goodness of fit: residuals of a servo against that noise.

The residuals of a fit cannot say how noisy the readings are, because they hold the model's error,
too. `reading_noise` finds the noise without a model: whatever moves a joint is smooth and follows
its commands, so a weighted sum of a few consecutive readings and of earlier commands can be nearly
zero, and what is left is noise. The weights of the readings with the smallest sum of squares are
found on half of the readings and applied to the other half (Koopmans-Levin). Applied to the
residuals of a model, the same finds what of them no smooth function explains, which is closer to
the noise where readings are few. A tone's motion is periodic as well: what a Fourier series leaves
of its readings is noise, however irregular their dates are.

What a fit itself leaves, motion by motion, weighs its readings (`noise_by_run`), says by how much
commands jitter, and how many readings count as one (`temperature_of`).

References
----------
Levin, M. J. (1964). Estimation of a system pulse transfer function in the presence of noise. IEEE
Transactions on Automatic Control 9: 229–235.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.signals import rms, robust_sd
from pupper_sysid.common.tones import least_squares
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run, fresh_residuals, with_late_commands
from pupper_sysid.sysid.fit.structure import Structure
from pupper_sysid.sysid.recordings.recording import Trial

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
_OUTLIER = 4.0  # standard deviations of the bulk, at which residuals are clipped
_AT_REST = 0.1  # of the root mean square speed
_NOISE_RATIO = 1.5  # of the noise of a run without a tone to that of the others
_PROBE_S = 0.002  # jitter at which its effect is simulated: small beside the servo's own times
_PROBES, _DRAWS = 6, 200
_DATES = (0.5, 1.5)  # of the standard deviation of dates
_HARMONICS = (1, 2, 3)
_REMEMBERED_S = 0.5
_SAMPLES_PER_INDEPENDENT = 4.0  # a servo carries a late command on for about so many readings


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
    most = _OUTLIER * robust_sd(values)
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
    return speed > _AT_REST * rms(speed)


def overall(ratios: Mapping[str, float]) -> float:
    """Root mean square over the motions; NaN where none is known."""
    return rms([ratio for ratio in ratios.values() if np.isfinite(ratio)])


# ------------------------------------------------- noise of fits: its size, cause and memory


def noise_by_run(
    residuals: Sequence[NDArray[np.float64]], runs: Sequence[Run], least_rad: float
) -> tuple[float, ...]:
    """Root mean square of the residuals of each tone, or run without a tone, outliers clipped.

    `residuals` of shape (samples,) each: model minus fresh reading, per run [rad]. `runs`: runs of
    one tone, gain and load share their noise. That of runs without a tone is not far from the
    others': it is the model's error, and a run that it suits would decide the fit. `least_rad`:
    noise of a tone that is fitted better than readings can be. Returns one per run [rad].
    """
    kinds = [(r.tone, r.p_gain, *r.load, n if r.tone < 0 else 0) for n, r in enumerate(runs)]
    sizes = {}
    for kind in set(kinds):
        r = np.concatenate([x for x, k in zip(residuals, kinds, strict=True) if k == kind])
        most = _OUTLIER * robust_sd(r)
        size = np.sqrt(np.mean(np.minimum(np.abs(r), most) ** 2)) if len(r) else 0.0
        sizes[kind] = max(float(size), least_rad)
    others = [size for kind, size in sizes.items() if kind[0] < 0]
    if others:
        middle = float(np.median(others))
        ends = max(middle / _NOISE_RATIO, least_rad), middle * _NOISE_RATIO
        for kind in sizes:
            if kind[0] < 0:
                sizes[kind] = float(np.clip(sizes[kind], *ends))
    return tuple(sizes[kind] for kind in kinds)


def command_jitter(
    structure: Structure,
    values: NDArray[np.float64],
    recorded: Sequence[Trial],
    runs: Sequence[Run],
    noise_rad: Sequence[float],
    date_sd_s: float,
    rng: np.random.Generator,
) -> Interval:
    """Standard deviation of the latency of commands that explains the noise of fast tones [s].

    Commands late at random (exponentially, about the dead time as mean) are simulated. The squared
    noise of a tone is a floor, common to all tones, and a share that grows as the squared jitter.

    `values` of shape (parameters,). `recorded`: the trials of the runs as recorded, with the times
    at which commands were sent. `noise_rad`: from `noise_by_run`. `date_sd_s`: standard deviation
    of the dates of readings [s]: it grows with the speed, too, and is taken off, half to one and a
    half of it. Returns an upper bound where the model errs more at fast tones for other reasons;
    (0, 0, high) where nothing is seen; NaN with fewer than two tones.
    """
    tones = sorted({r.tone for r in runs})
    if len(tones) < 2:
        return Interval(np.nan, np.nan, np.nan)
    plain = free_run(structure, values, runs)
    moved: dict[float, list[NDArray]] = {tone: [] for tone in tones}
    for _ in range(_PROBES):
        late = [
            with_late_commands(t, r, _PROBE_S, rng) for t, r in zip(runs, recorded, strict=True)
        ]
        for t, one, other in zip(runs, plain, free_run(structure, values, late), strict=True):
            moved[t.tone].append(at_steps(other, t.sample_step) - at_steps(one, t.sample_step))
    gain = np.array([np.mean(np.concatenate(moved[t]) ** 2) for t in tones]) / _PROBE_S**2
    speeds: dict[float, list[NDArray]] = {tone: [] for tone in tones}
    for t, track in zip(runs, plain, strict=True):
        speeds[t.tone].append(at_steps(np.gradient(track) / t.step_s, t.sample_step))
    dating = np.array([np.mean(np.concatenate(speeds[t]) ** 2) for t in tones]) * date_sd_s**2
    noise_of = {t.tone: n for t, n in zip(runs, noise_rad, strict=True)}
    square = np.array([noise_of[t] ** 2 for t in tones])
    count = [sum(len(t.sample_step) for t in runs if t.tone == tone) for tone in tones]
    freedom = np.maximum(np.array(count) / _SAMPLES_PER_INDEPENDENT, 2.0)

    def jitter(squares: NDArray, dates: float) -> float:
        design = np.column_stack([np.ones(len(tones)), gain]) / squares[:, None]
        scale = np.linalg.norm(design, axis=0)
        rest = np.maximum(1.0 - dates**2 * dating / squares, 0.0)
        return float(np.sqrt(nnls(design / scale, rest)[0][1] / scale[1]))

    draws = square * rng.chisquare(freedom, (_DRAWS, len(tones))) / freedom
    dates = rng.uniform(*_DATES, _DRAWS)
    jitters = [jitter(s, d) for s, d in zip(draws, dates, strict=True)]
    return Interval.of_draws(jitter(square, 1.0), np.array(jitters))


def temperature_of(
    residuals: Sequence[NDArray[np.float64]], runs: Sequence[Run], parameters: int
) -> float:
    """By which the cost of readings is divided: readings per independent one, over their weight.

    A soft-L1 cost weighs each reading less than its noise deserves. The ratio of the variance of
    its slope to its mean curvature (Godambe) makes up for that: 0.57 for normal noise.

    What counts against a parameter is the power of residuals where its effect is. Of a tone that is
    at the tone and its harmonics: their power there over their power elsewhere. Of other motions it
    is at low frequencies: 1 + 2 Σ ρ(k), up to where the autocorrelation ρ vanishes, and no further
    than half a second, because what friction leaves for longer hardly moves with a parameter.

    `residuals` of shape (samples,) each: in units of their noise. `parameters`: fitted to them: so
    many numbers less are left of the power at the harmonics.
    """
    every = np.concatenate([np.empty(0), *residuals])
    if not len(every):
        return 1.0
    bent = np.mean((1.0 + every**2) ** -1.5)
    weight = float(np.mean(every**2 / (1.0 + every**2)) / max(bent, 1e-12))
    pairs = list(zip(residuals, runs, strict=True))
    tones = [(r, run) for r, run in pairs if run.tone > 0 and len(r) >= 4 * len(_HARMONICS)]
    if sum(len(r) for r, _ in tones) > sum(len(r) for r, _ in pairs) / 2:
        return weight * _at_harmonics(tones, parameters)
    return weight * _autocorrelation([(r, run) for r, run in pairs if len(r) > 1])


def _at_harmonics(tones: Sequence[tuple[NDArray, Run]], parameters: int) -> float:
    within, elsewhere, count, others = 0.0, 0.0, 0, 0
    for r, run in tones:
        turn = 2 * np.pi * run.frequency_hz * run.step_s * run.sample_step
        design = np.column_stack([f(n * turn) for n in _HARMONICS for f in (np.sin, np.cos)])
        repeating = design @ least_squares(design, r)
        within += float(repeating @ repeating)
        elsewhere += float(np.sum((r - repeating) ** 2))
        count += design.shape[1]
        others += len(r) - design.shape[1]
    if count <= parameters or not elsewhere > 0:
        return 1.0
    return max(1.0, (within / (count - parameters)) / (elsewhere / others))


def _autocorrelation(pairs: Sequence[tuple[NDArray, Run]]) -> float:
    if not pairs:
        return 1.0
    apart = np.concatenate([np.diff(run.sample_step) * run.step_s for _, run in pairs])
    longest = _REMEMBERED_S / max(float(np.median(apart)), 1e-4)
    longest = int(min(longest, min(len(r) for r, _ in pairs) - 1))
    total, lagged = 0.0, np.zeros(longest)
    for r, _ in pairs:
        x = np.clip(r, -4, 4)
        total += float(x @ x)
        for lag in range(1, longest + 1):
            lagged[lag - 1] += float(x[lag:] @ x[:-lag])
    rho = lagged / max(total, 1e-18)
    return float(max(1.0, 1.0 + 2.0 * np.sum(rho * np.cumprod(rho > 0.05))))
