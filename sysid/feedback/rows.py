"""Which rows of a trial are fresh, which must have moved, and stretches of both for the search."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.feedback.poll_search import Stretch
from pupper_sysid.sysid.recordings.recording import Trial

STRETCH_S = 4.0
"""Longest stretch [s]; longer ones would need the poll to keep its phase to 1e-4."""

_MOVING_QUANTA = 1.0  # a servo that moves by one count must change the reading


def fresh_rows(trial: Trial) -> NDArray[np.int64]:
    """Indices of the rows whose value differs from the last value before them.

    Where readings are known to be live, every row is fresh.
    """
    valid = np.flatnonzero(np.isfinite(trial.position_rad))
    if trial.readings == "live":
        return valid
    changed = np.flatnonzero(np.diff(trial.position_rad[valid]) != 0) + 1
    return valid[changed]


def read_before(trial: Trial) -> NDArray[np.float64]:
    """For each row, when the last reading before it was read; NaN for the first one."""
    here = np.isfinite(trial.position_rad)
    at = np.where(here, np.arange(len(here)), -1)
    last = np.concatenate([[-1], np.maximum.accumulate(at)[:-1]])
    return np.where(last >= 0, trial.read_time_s[last], np.nan)


def stretches_of(trial: Trial, step: float) -> list[Stretch]:
    """Cut a trial into stretches short enough for one strict lattice each."""
    read, rows, before = trial.read_time_s, fresh_rows(trial), read_before(trial)
    moving = np.flatnonzero(moving_rows(trial, step))
    known = np.isfinite(trial.position_rad) & np.isfinite(before)
    same = np.setdiff1d(moving[known[moving]], rows)
    parts = max(1, int(np.ceil((read[-1] - read[0]) / STRETCH_S)))
    edges = np.linspace(read[0], read[-1], parts + 1)
    found = []
    for start, stop in pairwise(edges):
        own, held = (r[(read[r] > start) & (read[r] <= stop)] for r in (rows, same))
        if len(own) >= 8:
            found.append(
                Stretch(trial.number, start, stop, before[own], read[own], before[held], read[held])
            )
    return found


def loop_period(trials: Sequence[Trial]) -> float:
    """Median time between reads [s]; NaN without any."""
    gaps = [np.diff(t.read_time_s) for t in trials if len(t.read_time_s) > 1]
    return float(np.median(np.concatenate(gaps))) if gaps else float("nan")


def moving_rows(trial: Trial, step: float) -> NDArray[np.bool_]:
    """Rows by which the servo must have moved by a count of `step` [rad] since the row before."""
    gap = float(np.median(np.diff(trial.read_time_s)))
    return _speed(trial) * gap > _MOVING_QUANTA * step


def _speed(trial: Trial) -> NDArray[np.float64]:
    """|command rate| around each row [rad/s], the least over the past 0.1 s to allow for lag."""
    rate = np.abs(np.gradient(trial.command_rad, trial.send_time_s))
    loop = max(float(np.median(np.diff(trial.send_time_s))), 1e-4)
    reach = max(1, round(0.1 / loop))
    padded = np.concatenate([np.full(reach, rate[0]), rate])
    windows = np.lib.stride_tricks.sliding_window_view(padded, reach + 1)
    # the slowest command in reach: the servo moves even if the lag is unknown
    return windows.min(axis=1)
