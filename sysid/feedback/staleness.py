"""Live or stale: whether a joint's readings are new at each read, from its trials alone.

A reading repeats for two reasons: the bus has no newer value, or the joint does not move. Only the
first makes readings stale. A repeat in the midst of motion, where the values before and after it
go on in one direction and the command leads, cannot be friction: `staleness` counts those.

`quantum` is the quantisation step of a joint's readings, from the histogram of their differences;
`fresh_rows` and `moving_rows` tell new readings from repeated ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, bdtrc

from pupper_sysid.common.results import Result
from pupper_sysid.sysid.feedback.poll_search import Stretch
from pupper_sysid.sysid.recordings.recording import Trial

STRETCH_S = 4.0  # longest stretch [s]; longer ones would need the poll to keep its phase to 1e-4
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


def stretches_of(trials: Sequence[Trial]) -> list[Stretch]:
    """Cut trials into stretches short enough for one strict lattice each."""
    step = max(quantum(trials), 1e-6)
    stretches = []
    for trial in (t for t in trials if len(t.read_time_s) > 3):
        read, rows, before = trial.read_time_s, fresh_rows(trial), read_before(trial)
        moving = moving_rows(trial, step)
        known = np.isfinite(trial.position_rad) & np.isfinite(before)
        same = np.setdiff1d(np.flatnonzero(moving & known), rows)
        parts = max(1, int(np.ceil((read[-1] - read[0]) / STRETCH_S)))
        for start, stop in pairwise(np.linspace(read[0], read[-1], parts + 1)):
            new, held = (r[(read[r] > start) & (read[r] <= stop)] for r in (rows, same))
            if len(new) >= 8:
                times = before[new], read[new], before[held], read[held]
                stretches.append(Stretch(trial.number, start, stop, *times, moving[new]))
    return stretches


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


_SMALLEST_RAD = 1e-4  # below it there is no telling a count from decimals
_SAME_RAD = 2e-5  # differences of one number of counts, in a file with five decimals
_NEAR = 0.2  # of a step: farther from a multiple a difference does not count
_SURE = 0.98
_FIRST_MULTIPLES = 4  # the smallest frequent difference may be several steps


def quantum(trials: Sequence[Trial]) -> float:
    """Quantisation step of readings [rad]; 0 if their differences are no multiples of one.

    Differences of quantised readings gather at multiples of the step. The smallest frequent one
    gives a first guess, and least squares over all of them the step; a file's decimals only blur
    it.
    """
    positions = [t.position_rad for t in trials]
    steps = np.concatenate([np.zeros(0), *(np.abs(np.diff(p)) for p in positions)])
    steps = np.sort(steps[np.isfinite(steps) & (steps > 1e-7)])
    different = np.unique(np.round(steps, 9))
    if len(steps) < 3:
        return 0.0
    clusters = np.split(steps, np.flatnonzero(np.diff(steps) > _SAME_RAD) + 1)
    if len(clusters) > 0.3 * len(steps) + 3:
        return 0.0  # as good as continuous
    least = max(2, round(0.002 * len(steps)))
    frequent = [c for c in clusters if len(c) >= least]
    first = float(np.median((frequent or clusters)[0]))
    for divisor in range(1, _FIRST_MULTIPLES + 1):
        step = _multiples_of(different, first / divisor)
        if step:
            return step
    return 0.0


def _multiples_of(steps: NDArray[np.float64], guess: float) -> float:
    """The step near `guess` [rad] of which all but a few of `steps` are multiples; 0 if none is."""
    reach = 4.0
    while guess >= 0.9 * _SMALLEST_RAD:
        # small multiples first: the error of the guess grows with the multiple
        counts = np.round(steps / guess)
        near = (counts > 0) & (np.abs(steps - counts * guess) < _NEAR * guess)
        used = near & (counts <= reach)
        if used.any():
            guess = float(np.sum(steps[used] * counts[used]) / np.sum(counts[used] ** 2))
        if reach > steps[-1] / guess:
            return guess if near.mean() >= _SURE else 0.0
        reach *= 2
    return 0.0


# with these, 1 of 600 synthetic recordings (30–1,000 Hz) is decided wrong, and 29 % are left open
_NEEDED = 30  # episodes
_FEWEST_STEPS = 8
_LIVE_REPEATS = 0.005  # share of reads that a direct bus may lose
_IMPOSSIBLE = 1e-3
_FEWEST_REPEATS = 3
_COUNTS = 2.99  # three, less a file's decimals: motion, not the edge of a count
_OF_FAST_STEPS = 0.02
_NOISES = 6.0
_TO_AND_FRO = 0.03  # share of such steps, below which they are chance
_SMALLEST_OF_NOISE = 0.505  # median smallest of three steps of white noise to and fro
_IN_A_ROW, _OFTEN = 5, 0.1
_LEAD = 2.0
_LONGEST_S = 0.06  # rows farther apart no longer follow the motion
_HARMLESS_S = 0.004
_WINDOW, _COUNTS_A_ROW = 7, 2.0
_NONE_OF_FEW = 0.4  # twice the share of one of the five steps from -2 to 2
_POLL_REPEATS = 0.2  # share of reads that a poll of 1.25 loops repeats


@dataclass(frozen=True, kw_only=True)
class Staleness(Result):
    """Whether readings are new at each read."""

    kind: str
    episodes: int = 0
    """Stretches from one new value to the next in the midst of motion."""
    episodes_with_repeat: int = 0
    """Those in which the older value was read more than once."""
    repeat_share: float = math.nan
    """Repeated readings among all readings of these episodes; NaN without one."""


_Rows = tuple[NDArray[np.float64], NDArray[np.float64]]


def staleness(trials: Sequence[Trial]) -> Staleness:
    """Decide whether readings are live, from motion and command alone.

    A joint that moves less than a count per row shows no episode at the rows' own rate, so the rule
    is tried on every second, third, fifth … row as well. There, a poll may hide between two rows:
    only changes in quick succession then prove readings live.

    Examples
    --------
    >>> time_s = 0.02 * np.arange(200)
    >>> wave = np.sin(2 * np.pi * time_s)
    >>> late = np.sin(2 * np.pi * (time_s - 0.05))
    >>> def trial(position):
    ...     return Trial("LF_hip", 0, 1.0, time_s, time_s, wave, position, None, 0.0)
    >>> staleness([trial(late)]).kind, staleness([trial(np.repeat(late[::2], 2))]).kind
    ('live', 'stale')
    """
    rows = [(t.command_rad, t.position_rad) for t in trials if np.isfinite(t.position_rad).any()]
    if not rows:
        return Staleness(kind="cannot tell")
    values = [p[np.isfinite(p)] for _, p in rows]
    repeated = np.concatenate([np.diff(v) == 0 for v in values])
    if np.sum(~repeated) < _FEWEST_STEPS:
        return Staleness(kind="cannot tell")
    # between the quartiles: a joint with play or friction is on either side, seldom between
    offset = float(np.mean(np.nanquantile(np.concatenate([p - c for c, p in rows]), (0.25, 0.75))))
    loop = float(np.median(np.concatenate([np.diff(t.read_time_s) for t in trials])))
    step = quantum(trials)
    scatter = _scatter(values)
    least = max(_COUNTS * step, _NOISES * scatter if scatter > step else 0.0)

    repeats = _count(rows, offset, least)
    if scatter > step > 0 and _repeats_in_noise(values, step):
        return _verdict("stale", repeats)
    if len(repeated) >= _NEEDED and not _impossible(int(repeated.sum()), len(repeated)):
        return _verdict("live", repeats)  # every row is new, in motion or not
    every = 1
    while len(repeats) < _NEEDED:
        every = math.ceil(1.5 * every)
        if not every * loop <= _LONGEST_S:
            return _verdict("live" if _new_in_motion(trials, step) else "cannot tell", repeats)
        repeats = _count(list(_thinned(rows, every)), offset, least)
    if _impossible(int(np.sum(repeats > 0)), len(repeats)):
        return _verdict("stale", repeats)
    certain = every == 1 or _follows_rows(values) or _shortest(values) * loop <= _HARMLESS_S
    return _verdict("live" if certain or _new_in_motion(trials, step) else "cannot tell", repeats)


def _repeats_in_noise(values: Sequence[NDArray[np.float64]], step: float) -> bool:
    """Whether values repeat between large steps far more often than they move by a count or two.

    The steps of live readings that scatter by more than a count are as likely to be none as one.
    """
    none = few = 0
    for value in values:
        counts = np.abs(np.diff(value)) / step
        between = np.minimum(counts[:-2], counts[2:]) >= _COUNTS
        middle = counts[1:-1][between]
        none += int(np.sum(middle < _NEAR))
        few += int(np.sum((middle >= _NEAR) & (middle < _COUNTS)))
    return none >= _NEEDED and float(bdtrc(none - 1, none + few, _NONE_OF_FEW)) < _IMPOSSIBLE


def _new_in_motion(trials: Sequence[Trial], step: float) -> bool:
    """Whether rows around which the joint must have moved are new, too often for a poll.

    A joint that moves by two counts a row over seven rows changes its reading in each of them; a
    poll of 1.25 loops or longer repeats one in five.
    """
    repeated = [np.zeros(0, bool)]
    for trial in trials:
        read = trial.position_rad[np.isfinite(trial.position_rad)]
        far = read[_WINDOW:] - read[:-_WINDOW]
        same = np.diff(read)[_WINDOW // 2 :][: len(far)] == 0
        repeated.append(same[np.abs(far) > _WINDOW * max(_COUNTS_A_ROW * step, 1e-6)])
    rows = np.concatenate(repeated)
    repeats = int(rows.sum())
    if len(rows) < _NEEDED or _impossible(repeats, len(rows)):
        return False
    return float(bdtr(repeats, len(rows), _POLL_REPEATS)) < _IMPOSSIBLE


def _verdict(kind: str, repeats: NDArray[np.int64]) -> Staleness:
    total, with_repeat = int(repeats.sum()), int(np.sum(repeats > 0))
    share = total / (total + len(repeats)) if len(repeats) else math.nan
    return Staleness(
        kind=kind, episodes=len(repeats), episodes_with_repeat=with_repeat, repeat_share=share
    )


def _impossible(repeats: int, among: int) -> bool:
    """Whether a bus that answers each read could not repeat that often."""
    if repeats < _FEWEST_REPEATS:
        return False
    return float(bdtrc(repeats - 1, among, _LIVE_REPEATS)) < _IMPOSSIBLE  # that many or more


def _count(rows: Sequence[_Rows], offset: float, least: float) -> NDArray[np.int64]:
    """Repeats of each episode in the midst of motion, over all stretches of rows."""
    steps = [np.abs(np.diff(p[np.isfinite(p)])) for _, p in rows]
    moved = np.concatenate([s[s > 0] for s in steps])
    if len(moved) < _FEWEST_STEPS:
        return np.zeros(0, np.int64)
    least = max(least, _OF_FAST_STEPS * float(np.quantile(moved, 0.95)))
    return np.concatenate([episodes(c + offset, p, least) for c, p in rows])


def episodes(
    command_rad: NDArray[np.float64], position_rad: NDArray[np.float64], least_rad: float
) -> NDArray[np.int64]:
    """Count how often the older value was read again in each episode in the midst of motion.

    An episode lasts from the row of one new value to the row of the next. The command has the
    offset of the readings added; a missing reading is NaN. `least_rad` is the smallest step, and
    the smallest rate per row beside it, that are motion.
    """
    here = np.flatnonzero(np.isfinite(position_rad))
    position, command = position_rad[here], command_rad[here]
    new = np.concatenate([[0], np.flatnonzero(np.diff(position)) + 1])
    if len(new) < 4:
        return np.zeros(0, np.int64)
    # value i lasts `length[i]` rows and is followed by the step `move[i]`
    move, length = np.diff(position[new]), np.diff(new)
    rate = np.abs(move) / length
    near = np.minimum(rate[:-2], rate[2:])
    sign = np.sign(move)
    chosen = (sign[:-2] == sign[1:-1]) & (sign[1:-1] == sign[2:])
    chosen &= (near >= least_rad) & (np.abs(move[1:-1]) >= least_rad)
    # a stationary joint under a command that does not lead may repeat without the bus's doing
    error = command - position
    ahead = np.minimum.reduceat(error, new)[1:-2]
    behind = np.maximum.reduceat(error, new)[1:-2]
    chosen &= np.where(sign[1:-1] > 0, ahead, -behind) >= _LEAD * near
    missing = np.concatenate([[0], np.cumsum(np.diff(here) > 1)])
    chosen &= missing[new[2:-1]] == missing[np.maximum(new[1:-2] - 1, 0)]
    return (length[1:-1][chosen] - 1).astype(np.int64)


def _thinned(rows: Sequence[_Rows], every: int) -> Iterator[_Rows]:
    """Every so-many-th row, from the first one on and from one half of that later."""
    for command, position in rows:
        for first in range(0, every, max(1, every // 2)):
            if np.isfinite(position[first::every]).any():
                yield command[first::every], position[first::every]


def _scatter(values: Sequence[NDArray[np.float64]]) -> float:
    """Standard deviation of live readings' noise [rad], from steps to and fro; 0 if few are.

    Motion turns once and goes on; noise turns at the next row again. Polls too slow for the
    motion show it to and fro as well, but not in one row after the other.
    """
    total, smallest = 0, [np.zeros(0)]
    for value in (v for v in values if len(v) > 3):
        step = np.diff(value)
        total += int(np.sum(step != 0))
        turn = step[:-1] * step[1:] < 0
        size = np.lib.stride_tricks.sliding_window_view(np.abs(step), 3).min(axis=1)
        smallest.append(size[turn[:-1] & turn[1:]])
    sizes = np.concatenate(smallest)
    if len(sizes) < max(_FEWEST_STEPS, _TO_AND_FRO * total):
        return 0.0
    return float(np.median(sizes) / _SMALLEST_OF_NOISE)


def _follows_rows(values: Sequence[NDArray[np.float64]]) -> bool:
    """Whether many new values come in row after row: polls 1.25 loops apart cannot do that."""
    changed = [np.diff(v) != 0 for v in values]
    windows = [np.lib.stride_tricks.sliding_window_view(c, _IN_A_ROW) for c in changed
               if len(c) >= _IN_A_ROW]  # fmt: skip
    runs = sum(int(np.sum(w.all(axis=1))) for w in windows)
    return runs >= max(_NEEDED, _OFTEN * sum(int(np.sum(c)) for c in changed))


def _shortest(values: Sequence[NDArray[np.float64]]) -> float:
    """Rows between changes in one direction that follow fast upon another: the lowest tenth."""
    gaps = [np.zeros(0)]
    for value in values:
        new = np.concatenate([[0], np.flatnonzero(np.diff(value)) + 1])
        sign, length = np.sign(np.diff(value[new])), np.diff(new)
        if len(sign) > 2:
            one = (sign[:-2] == sign[1:-1]) & (sign[1:-1] == sign[2:])
            gaps.append(length[1:-1][one])
    lengths = np.concatenate(gaps)
    return float(np.quantile(lengths, 0.1)) if len(lengths) else math.inf
