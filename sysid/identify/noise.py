"""Noise of a joint's readings, tone by tone, and the jitter of commands that explains its growth.

Fast tones leave larger residuals than slow ones: a command that comes a few milliseconds late moves
a fast joint further off. With one noise for all tones the fastest would decide every fit, so each
tone has its own (`noise_by_trial`). `command_jitter` asks which random latency of commands the
growth amounts to.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.identify.candidates.models import CandidateModel
from pupper_sysid.sysid.identify.candidates.simulation import (
    TrialData,
    free_run,
    look_up,
    with_late_commands,
)
from pupper_sysid.sysid.recordings.recording import Trial

_OUTLIER_MAD = 4.0
_PROBE_S = 0.002  # jitter at which its effect is simulated: small beside the servo's own times
_PROBES, _DRAWS = 6, 200
_DATES = (0.5, 1.5)  # of the standard deviation of dates
_SAMPLES_PER_INDEPENDENT = 4.0  # a servo carries a late command on for about so many readings


def noise_by_trial(
    residuals: Sequence[NDArray[np.float64]], trials: Sequence[TrialData], least_rad: float
) -> tuple[float, ...]:
    """Root mean square of the residuals of each tone, outliers clipped.

    Parameters
    ----------
    residuals : sequence of ndarray, shape (samples,) each
        Model minus fresh reading, per trial [rad].
    trials : sequence of TrialData
        Trials of one tone share their noise; trials without tones share one, too.
    least_rad : float
        Noise of a tone that is fitted better than readings can be.

    Returns
    -------
    tuple of float
        One per trial [rad].
    """
    tones = [label(t) for t in trials]
    found = {}
    for tone in set(tones):
        r = np.concatenate([x for x, t in zip(residuals, tones, strict=True) if t == tone])
        most = _OUTLIER_MAD * 1.4826 * float(np.median(np.abs(r))) if len(r) else 0.0
        size = np.sqrt(np.mean(np.minimum(np.abs(r), most) ** 2)) if len(r) else 0.0
        found[tone] = max(float(size), least_rad)
    return tuple(found[t] for t in tones)


def label(trial: TrialData) -> float:
    """The tone of a trial [Hz]; -1 where there is none."""
    return round(trial.frequency_hz, 2) if trial.frequency_hz > 0 else -1.0


def command_jitter(
    model: CandidateModel,
    values: NDArray[np.float64],
    recorded: Sequence[Trial],
    trials: Sequence[TrialData],
    noise_rad: Sequence[float],
    date_sd_s: float,
    rng: np.random.Generator,
) -> Interval:
    """Standard deviation of the latency of commands that explains the noise of fast tones [s].

    Commands late at random (exponentially, about the dead time as mean) are simulated. The squared
    noise of a tone is a floor, common to all tones, and a share that grows as the squared jitter.

    Parameters
    ----------
    model : CandidateModel
    values : ndarray, shape (parameters,)
    recorded : sequence of Trial
        The trials as recorded, with the times at which commands were sent.
    trials : sequence of TrialData
    noise_rad : sequence of float
        From `noise_by_trial`.
    date_sd_s : float
        Standard deviation of the dates of readings [s]: it grows with the speed, too, and is taken
        off, half to one and a half of it.
    rng : numpy.random.Generator

    Returns
    -------
    Interval
        An upper bound where the model errs more at fast tones for other reasons; (0, 0, high) where
        nothing is seen; NaN with fewer than two tones.
    """
    tones = sorted({label(t) for t in trials})
    if len(tones) < 2:
        return Interval(np.nan, np.nan, np.nan)
    plain = free_run(model, values, trials)
    moved: dict[float, list[NDArray]] = {tone: [] for tone in tones}
    for _ in range(_PROBES):
        late = [
            with_late_commands(t, r, _PROBE_S, rng) for t, r in zip(trials, recorded, strict=True)
        ]
        for t, one, other in zip(trials, plain, free_run(model, values, late), strict=True):
            moved[label(t)].append(look_up(other, t.sample_step) - look_up(one, t.sample_step))
    gain = np.array([np.mean(np.concatenate(moved[t]) ** 2) for t in tones]) / _PROBE_S**2
    speeds: dict[float, list[NDArray]] = {tone: [] for tone in tones}
    for t, track in zip(trials, plain, strict=True):
        speeds[label(t)].append(look_up(np.gradient(track) / t.step_s, t.sample_step))
    dating = np.array([np.mean(np.concatenate(speeds[t]) ** 2) for t in tones]) * date_sd_s**2
    own = {label(t): n for t, n in zip(trials, noise_rad, strict=True)}
    square = np.array([own[t] ** 2 for t in tones])
    count = [sum(len(t.sample_step) for t in trials if label(t) == tone) for tone in tones]
    freedom = np.maximum(np.array(count) / _SAMPLES_PER_INDEPENDENT, 2.0)

    def jitter(squares: NDArray, dates: float) -> float:
        design = np.column_stack([np.ones(len(tones)), gain]) / squares[:, None]
        scale = np.linalg.norm(design, axis=0)
        rest = np.maximum(1.0 - dates**2 * dating / squares, 0.0)
        return float(np.sqrt(nnls(design / scale, rest)[0][1] / scale[1]))

    draws = square * rng.chisquare(freedom, (_DRAWS, len(tones))) / freedom
    dates = rng.uniform(*_DATES, _DRAWS)
    found = [jitter(s, d) for s, d in zip(draws, dates, strict=True)]
    return Interval.of_draws(jitter(square, 1.0), np.array(found))
