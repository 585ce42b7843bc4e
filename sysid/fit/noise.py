"""Noise of a joint's readings, motion by motion; what it says of commands and of readings.

Fast tones leave larger residuals than slow ones: a command that comes a few milliseconds late moves
a fast joint further off. With one noise for all tones the fastest would decide every fit, so each
tone has its own (`noise_by_run`). `command_jitter` asks which random latency of commands the growth
amounts to. Residuals are correlated besides: `temperature_of` says how many readings count as one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.tones import least_squares
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run, with_late_commands
from pupper_sysid.sysid.fit.structure import Structure
from pupper_sysid.sysid.recordings.recording import Trial

_OUTLIER_MAD = 4.0
_NOISE_RATIO = 1.5  # of the noise of a run without a tone to that of the others
_PROBE_S = 0.002  # jitter at which its effect is simulated: small beside the servo's own times
_PROBES, _DRAWS = 6, 200
_DATES = (0.5, 1.5)  # of the standard deviation of dates
_HARMONICS = (1, 2, 3)
_REMEMBERED_S = 0.5
_SAMPLES_PER_INDEPENDENT = 4.0  # a servo carries a late command on for about so many readings


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
        most = _OUTLIER_MAD * 1.4826 * float(np.median(np.abs(r))) if len(r) else 0.0
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
