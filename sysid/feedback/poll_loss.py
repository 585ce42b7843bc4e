"""Loss: the share of polls that failed, counted where a good poll must bring a new value.

A joint that stands still shows the same value after a good poll as after a failed one. With a
model's motion at hand (`moves`) polls count whose position must differ from that of the poll
before; without one (`fast`), those at which a joint that follows its command is fast. Friction
that holds the joint meanwhile is then taken for failed polls, here and there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from pupper_sysid.sysid.feedback.poll_search import OUTLIERS, Phase
from pupper_sysid.sysid.feedback.slips import Motion
from pupper_sysid.sysid.feedback.staleness import fresh_rows, quantum, read_before
from pupper_sysid.sysid.recordings.recording import Trial

Sure = Callable[[NDArray[np.float64], float], NDArray[np.bool_]]
"""Whether a good poll at these times [s], a period [s] after the last, must bring a new value."""

_MOVING_STEPS = 3.0  # quantisation steps per poll: so much motion must change the reading
_OF_NOISE = 2.0  # sizes of the model's own error
_OF_TOP_SPEED = 0.5  # below it a joint with friction may stand
_EARLY_OR_LATE_S = (-0.01, 0.0, 0.01)  # by which the model's motion may err
_GRID_S, _SMOOTHING_S, _LONGEST_LAG_S = 0.002, 0.015, 0.3
# of the count without a model: where motion starts and ends is not known to a poll; measured on
# 200 random servos
_OVERDISPERSION = 1.6
_IMPOSSIBLE_SD = 3.0


def count_loss(
    trials: Sequence[Trial], phases: Sequence[Phase], sure: Sequence[Sure], known: bool = False
) -> tuple[float, float]:
    """Share of failed polls, and the number of independent polls that this was counted from.

    Parameters
    ----------
    trials : sequence of Trial
    phases : sequence of Phase
    sure : sequence of callable, one per trial
        From `moves` or `fast`.
    known : bool
        Whether it is from `moves`.
    """
    successes, polls = _count(trials, phases, sure)
    if not polls:
        return math.nan, 0.0
    return max(1.0 - successes / polls, 0.0), polls if known else polls / _OVERDISPERSION


def more_changes_than_polls(
    trials: Sequence[Trial], phases: Sequence[Phase], sure: Sequence[Sure]
) -> bool:
    """Whether the readings change more often than a lattice has instants, beyond outliers."""
    successes, polls = _count(trials, phases, sure)
    return successes > polls * (1 + OUTLIERS) + _IMPOSSIBLE_SD * math.sqrt(OUTLIERS * polls)


def moves(
    trials: Sequence[Trial], motions: Mapping[int, Motion], noise_rad: Mapping[int, float]
) -> list[Sure]:
    """By a model's motion of each trial, which errs by about `noise_rad`; both by trial number."""
    step = quantum(trials)

    def by(motion: Motion, least: float) -> Sure:
        def sure(time: NDArray[np.float64], period_s: float) -> NDArray[np.bool_]:
            moved = [
                np.abs(motion(time + away) - motion(time + away - period_s))
                for away in _EARLY_OR_LATE_S
            ]
            return np.min(moved, axis=0) > least

        return sure

    return [
        by(motions[t.number], max(_MOVING_STEPS * step, _OF_NOISE * noise_rad[t.number]))
        for t in trials
    ]


def fast(trials: Sequence[Trial]) -> list[Sure]:
    """By the command alone."""
    step = quantum(trials)

    def of(trial: Trial) -> Sure:
        rows, read, before = fresh_rows(trial), trial.read_time_s, read_before(trial)
        middle = 0.5 * (before[rows] + read[rows])
        speed = _expected_speed(trial, middle, trial.position_rad[rows])
        top = float(speed.max(initial=0.0))

        def sure(time: NDArray[np.float64], period_s: float) -> NDArray[np.bool_]:
            row = np.clip(np.searchsorted(read, time), 0, len(read) - 1)
            return speed[row] > max(_MOVING_STEPS * step / period_s, _OF_TOP_SPEED * top)

        return sure

    return [of(t) for t in trials]


def _count(
    trials: Sequence[Trial], phases: Sequence[Phase], sure: Sequence[Sure]
) -> tuple[int, int]:
    """Changes dated to polls that count, and all polls that do."""
    polls = successes = 0
    for trial, counts in zip(trials, sure, strict=True):
        rows, read, before = fresh_rows(trial), trial.read_time_s, read_before(trial)
        middle = 0.5 * (before[rows] + read[rows])
        for p in (p for p in phases if p.trial == trial.number):
            first, last = (
                whole((edge - p.phase_s) / p.period_s)
                for whole, edge in ((np.ceil, p.start_s), (np.floor, p.stop_s))
            )
            instants = p.phase_s + p.period_s * np.arange(first, last + 1)
            own = (read[rows] > p.start_s) & (read[rows] <= p.stop_s)
            dated = p.phase_s + p.period_s * np.round((middle[own] - p.phase_s) / p.period_s)
            polls += int(np.sum(counts(instants, p.period_s)))
            successes += int(np.sum(counts(dated, p.period_s)))
    return successes, polls


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
