"""Single bad readings: away from those before and after them, and back within one sample.

A failed read is logged as 0 or -π, a bus that mixes up its answers returns another servo's
position, a bit flips. Whatever its size, what goes away and comes back within one sample is no
motion: on its way there and back a joint passes through places between. Such readings are left out
of everything that is computed (`without_bad_readings`), and `doctor` counts and names them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.recordings.remembered import remembered

_USUAL, _TIMES = 0.95, 8.0  # quantile of how far readings stand out, and times that
_OF_RANGE = 0.03  # of the trial's motion; less does no harm
_HELD, _OF_RANGE_HELD = 0.3, 0.2  # share of repeats: polls at odd times of the motion
_STEPS = 3.0  # of the smallest step between readings
_RETURNS = 0.7  # of the way away; the neighbours are that near to one another
_LARGE = 0.6  # of the range of motion: no part of what is usual
_BEYOND, _RESTED_S = 0.15, 0.5
_COARSE = 0.3  # of the range of motion, between two samples
_BESIDE = 3.0  # times the motion beside it
_PASSES = 4
_LONGEST_S, _LIVE_ROWS = 0.12, 2  # a held bad reading


@remembered(512)
def bad_rows(trial: Trial) -> NDArray[np.int64]:
    """Rows of `trial` that hold a single bad reading.

    Examples
    --------
    >>> time_s = 0.02 * np.arange(50)
    >>> position = np.round(np.sin(time_s), 3)
    >>> position[20] = -3.0
    >>> trial = Trial("hip", 0, float("nan"), time_s, time_s, position, position, None, 0.0)
    >>> bad_rows(trial).tolist()
    [20]
    """
    position = trial.position_rad.copy()
    found = np.zeros(0, np.int64)
    for _ in range(_PASSES):  # one hides another beside it
        rows = _standing_out(trial, position, False)
        rows = rows if len(rows) else _standing_out(trial, position, True)
        if not len(rows):
            break
        position[rows] = np.nan
        found = np.union1d(found, rows)
    return found


def _standing_out(trial: Trial, position: NDArray[np.float64], held: bool) -> NDArray[np.int64]:
    """Rows of readings away from their neighbours; of held ones, each value counts once."""
    none = np.zeros(0, np.int64)
    seen = np.flatnonzero(np.isfinite(position))
    value, time = position[seen], trial.read_time_s[seen]
    if len(value) < 8 or not np.abs(value).max() < 1e6:
        return none
    changed = np.flatnonzero(np.diff(value)) + 1 if held else np.arange(1, len(value))
    first = np.concatenate([[0], changed])
    v = value[first]
    if len(v) < 6:
        return none
    padded = np.concatenate([v[2:0:-1], v, v[-2:-4:-1]])
    before2, before, after, after2 = (padded[k : k + len(v)] for k in (0, 1, 3, 4))
    around = np.stack([before2, before, after, after2])
    out = np.maximum(v - around.max(axis=0), around.min(axis=0) - v)
    out = np.maximum(out, 0.0)
    moves = np.abs(np.diff(v))
    span = float(np.ptp(np.quantile(v, (0.05, 0.95))))
    usual = out[out < _LARGE * span]
    least = _STEPS * float(np.min(moves[moves > 1e-9], initial=np.inf))
    limit = max(
        _TIMES * float(np.quantile(usual, _USUAL)) if len(usual) else 0.0, min(least, 0.01),
        (_OF_RANGE_HELD if np.mean(np.diff(value) == 0) > _HELD else _OF_RANGE) * span,
    )  # fmt: skip
    beside = np.maximum(np.abs(before - before2), np.abs(after2 - after))
    wrong = (out > limit) & (np.abs(after - before) < _RETURNS * out) & (out > _BESIDE * beside)
    held_log = np.mean(np.diff(value) == 0) > _HELD
    if held_log or np.quantile(moves, 0.8) > _COARSE * span:
        # few samples a period, or polls at odd times of it, go to and fro by themselves: within
        # the reach of the motion they count only while the command rests
        low, high = np.quantile(v, (0.05, 0.95))
        beyond = _BEYOND * span if held_log else _LARGE * span
        inside = (v > low - beyond) & (v < high + beyond)
        wrong &= ~inside | _rests(trial, time[first])
    wrong[[0, -1]] = False  # a log may begin or end anywhere
    stop = np.append(first[1:], len(value))
    lasts = time[np.minimum(stop, len(time) - 1)] - time[first]
    wrong &= (lasts <= _LONGEST_S) | (stop - first <= _LIVE_ROWS)
    rows = [seen[a:b] for a, b in zip(first[wrong], stop[wrong], strict=True)]
    return np.concatenate(rows) if rows else none


def _rests(trial: Trial, time_s: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the command hardly moves for a while before each time."""
    moved = np.abs(np.diff(trial.command_rad, prepend=trial.command_rad[0]))
    travelled = np.cumsum(moved)
    now, then = (
        np.clip(np.searchsorted(trial.send_time_s, time_s - ago, "right") - 1, 0, None)
        for ago in (0.0, _RESTED_S)
    )
    return travelled[now] - travelled[then] < 0.02 * float(np.ptp(trial.command_rad))


def without_bad_readings(trial: Trial) -> Trial:
    """The trial, its single bad readings missing."""
    rows = bad_rows(trial)
    if not len(rows):
        return trial
    position = trial.position_rad.copy()
    position[rows] = np.nan
    count = trial.position_count
    if count is not None:
        count = count.copy()
        count[rows] = -1
    return replace(trial, position_rad=position, position_count=count)
