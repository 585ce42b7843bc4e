"""Loss: the share of polls that failed, counted where the joint surely moves."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from pupper_sysid.sysid.feedback.poll_search import Phase
from pupper_sysid.sysid.feedback.quantisation import quantum
from pupper_sysid.sysid.feedback.rows import fresh_rows, read_before
from pupper_sysid.sysid.recordings.recording import Trial

_MOVING_STEPS = 3.0  # quantisation steps per poll: so much motion must change the reading
_OF_TOP_SPEED = 0.5  # below it a joint with friction may stand
_GRID_S, _SMOOTHING_S, _LONGEST_LAG_S = 0.002, 0.015, 0.3


def count_loss(trials: Sequence[Trial], phases: Sequence[Phase]) -> tuple[float, int]:
    """Share of failed polls, and the number of polls it was counted from.

    Counted where the joint moves fast enough that a new reading must differ from the last.
    """
    step = quantum(trials)
    polls = successes = 0
    for trial in trials:
        rows, read, before = fresh_rows(trial), trial.read_time_s, read_before(trial)
        middle = 0.5 * (before[rows] + read[rows])
        speed = _expected_speed(trial, middle, trial.position_rad[rows])
        for phase in (p for p in phases if p.trial == trial.number):
            least = max(_MOVING_STEPS * step / phase.period_s, _OF_TOP_SPEED * speed.max())
            first = np.ceil((phase.start_s - phase.phase_s) / phase.period_s)
            last = np.floor((phase.stop_s - phase.phase_s) / phase.period_s)
            instants = phase.phase_s + phase.period_s * np.arange(first, last + 1)
            own = (read[rows] > phase.start_s) & (read[rows] <= phase.stop_s)
            dated = middle[own] - phase.phase_s
            dated = phase.phase_s + phase.period_s * np.round(dated / phase.period_s)
            for times, success in ((instants, False), (dated, True)):
                row = np.clip(np.searchsorted(read, times), 0, len(read) - 1)
                count = int(np.sum(speed[row] > least))
                successes, polls = (
                    (successes + count, polls) if success else (successes, polls + count)
                )
    return (max(1.0 - successes / polls, 0.0), polls) if polls else (math.nan, 0)


def _expected_speed(
    trial: Trial, time: NDArray[np.float64], position: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Speed of the joint at each read [rad/s], as if it followed its command after one lag.

    Zero where position and command have little in common.
    """
    sent = trial.send_time_s
    grid = np.arange(sent[0], max(sent[-1], trial.read_time_s[-1]) + _GRID_S, _GRID_S)
    row = np.maximum(np.searchsorted(sent, grid, side="right") - 1, 0)
    smooth = gaussian_filter1d(trial.command_rad[row], _SMOOTHING_S / _GRID_S, mode="nearest")
    none = np.zeros(len(trial.read_time_s))
    if len(time) < 8 or np.ptp(smooth) == 0:
        return none
    lags = np.arange(0.0, _LONGEST_LAG_S, 2 * _GRID_S)
    late = np.interp(time[None] - lags[:, None], grid, smooth)
    late -= late.mean(axis=1, keepdims=True)
    centred = position - position.mean()
    both, own = late @ centred, np.maximum(np.sum(late**2, axis=1), 1e-12)
    match = np.sign(both) * both**2 / own
    best = int(np.argmax(match))
    if match[best] < 0.5 * np.sum(centred**2):
        return none
    speed = np.abs(np.gradient(smooth, _GRID_S)) * both[best] / own[best]
    return np.interp(trial.read_time_s - lags[best], grid, speed)
