"""Measurement time of each reading: the bus's poll instants, found from the readings alone.

A polled bus refreshes each servo's position at instants on a lattice `phase + n * period`; a read
in between returns the old value, and a failed poll leaves it for another period. A row whose value
changed therefore brackets a successful poll between the previous read and this one. Enough such
intervals determine the lattice to a fraction of a millisecond, and every changed ("fresh") row can
be dated to the poll that measured it, which separates the servo's lag from the feedback age.

`find_poll_lattice` first asks whether readings are live: the recording's header says so, or their
motion shows it (`sysid.feedback.staleness`). If they are not, it cuts trials into stretches,
searches them for a common period and each stretch's phase (`sysid.feedback.poll_search`), and
counts the failed polls; `readings` dates fresh rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result, derived, internal
from pupper_sysid.sysid.feedback.poll_search import (
    BLUR_S,
    BLURS_S,
    Phase,
    Stretch,
    best_blur,
    best_period,
    contains,
    refine,
    shuffled,
)
from pupper_sysid.sysid.feedback.quantisation import quantum
from pupper_sysid.sysid.feedback.staleness import staleness
from pupper_sysid.sysid.recordings.recording import Trial

_STRETCH_S = 4.0  # longer stretches would need the poll to keep its phase to 1e-4
_LONGEST_S = 0.12
_MOVING_QUANTA = 1.0  # a servo that moves by one count must change the reading
_SIGNIFICANT = 4.0  # standard deviations above shuffled rows
_SIGNIFICANT_ALONE = 8.0  # the same where the motion does not show that there is a slow poll
_NEAR_LOOP = 1.3  # loops: regular reversals look like a poll that is hardly slower than the loop
_SHUFFLES = 12
# each costs as much as the search: where the first few leave no doubt there are no more
_FEWEST_SHUFFLES, _CLEAR = 4, 20.0


@dataclass(frozen=True, kw_only=True)
class PollLattice(Result):
    """The poll of one joint's feedback, as far as its readings show it; NaN where unknown.

    Attributes
    ----------
    kind : {"lattice", "unresolved", "every read"}
        A lattice was found; none is significant; or readings are live, so each is dated to its
        read, even where it repeats the one before because the joint stands still.
    readings : {"live", "polled", "cannot tell"}
        Whether the bus returns present positions or those of its last poll: by the recording's
        header, else by the motion, else by a significant lattice.
    time_doubt_s : float
        By how much all readings may have been measured earlier or later than they are dated: half
        a loop if the lattice is unresolved, else 0. Lag and dead time are in doubt by as much, and
        neither is identified then.
    poll_period_s, poll_period_sd_s : float
        Time between polls and its standard error.
    loss, loss_sd : float
        Probability that a poll fails, and its standard error.
    z_score : float
        Score against shuffled rows, in their standard deviations.
    hit_rate : float
        Share of changed rows with a lattice instant between the previous read and this one.
    fresh_fraction : float
        Share of rows with a new value, among all rows.
    phases : tuple of Phase
        Lattice of each stretch.
    """

    kind: str
    readings: str = "cannot tell"
    time_doubt_s: float = 0.0
    poll_period_s: float = math.nan
    poll_period_sd_s: float = math.nan
    loss: float = math.nan
    loss_sd: float = math.nan
    z_score: float = math.nan
    hit_rate: float = math.nan
    fresh_fraction: float
    phases: tuple[Phase, ...] = internal(default=())

    @derived
    def mean_age_s(self) -> float:
        """Mean age of a reading implied by period and loss [s]."""
        return self.poll_period_s * (0.5 + self.loss / (1 - self.loss))


@dataclass(frozen=True)
class Readings:
    """The fresh rows of a trial, each with the time at which it was measured.

    Attributes
    ----------
    rows : ndarray of int, shape (fresh,)
        Indices into the trial's rows.
    time_s : ndarray, shape (fresh,)
        When the position was measured.
    position_rad : ndarray, shape (fresh,)
    held_time_s : ndarray, shape (rows,)
        For every row of the trial, when the value it shows was measured; NaN before the first
        fresh row.
    time_sd_s : float
        Standard error of a shift common to all these times.
    """

    rows: NDArray[np.int64]
    time_s: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    held_time_s: NDArray[np.float64]
    time_sd_s: float


def fresh_rows(trial: Trial) -> NDArray[np.int64]:
    """Indices of the rows whose value differs from the last value before them.

    Where readings are known to be live, every row is fresh.
    """
    valid = np.flatnonzero(np.isfinite(trial.position_rad))
    if trial.readings == "live":
        return valid
    changed = np.flatnonzero(np.diff(trial.position_rad[valid]) != 0) + 1
    return valid[changed]


def _read_before(trial: Trial) -> NDArray[np.float64]:
    """For each row, when the last reading before it was read; NaN for the first one."""
    here = np.isfinite(trial.position_rad)
    at = np.where(here, np.arange(len(here)), -1)
    last = np.concatenate([[-1], np.maximum.accumulate(at)[:-1]])
    return np.where(last >= 0, trial.read_time_s[last], np.nan)


def find_poll_lattice(trials: Sequence[Trial], rng: np.random.Generator) -> PollLattice:
    """Period, loss and phases of the poll behind one joint's readings.

    Parameters
    ----------
    trials : sequence of Trial
        All of one joint.
    rng : numpy.random.Generator
        Shuffles the gaps between changes: a lattice must explain them better than that.

    Returns
    -------
    PollLattice
    """
    rows = sum(len(t.read_time_s) for t in trials)
    fresh = sum(len(fresh_rows(t)) for t in trials)
    fraction = fresh / max(rows, 1)
    # the readings of a joint that stands still repeat as well, and show nothing of the bus
    trials = [t for t in trials if t.readings != "live"]
    told = staleness(trials).kind if trials else "live"
    declared = any(t.readings == "polled" for t in trials)
    if told == "live" and not declared:
        return PollLattice(kind="every read", readings="live", fresh_fraction=fraction)
    loop = _loop_period(trials)
    nothing = PollLattice(
        kind="unresolved", readings="polled" if declared or told == "stale" else "cannot tell",
        fresh_fraction=fraction, time_doubt_s=loop / 2 if np.isfinite(loop) else 0.0,
    )  # fmt: skip
    if told == "live":  # a new value at each read: the poll is faster than the loop
        return nothing
    step = max(quantum(trials), 1e-6)
    stretches = [s for t in trials if len(t.read_time_s) > 3 for s in _stretches(t, step)]
    if not stretches or not np.isfinite(loop):
        return nothing

    # ln T, spaced so that the last poll of a stretch moves by half of the blur
    grid = np.exp(np.arange(np.log(loop * 1.02), np.log(_LONGEST_S), 0.4 * BLUR_S / _STRETCH_S))
    informative = sorted(stretches, key=lambda s: -len(s.begin))[:8]
    period, score = best_period(informative, grid)
    null: list[float] = []
    z_score = 0.0
    for _ in range(_SHUFFLES):
        null.append(best_period([shuffled(s, rng) for s in informative], grid)[1])
        if len(null) >= _FEWEST_SHUFFLES:
            z_score = float((score - np.mean(null)) / max(np.std(null, ddof=1), 1e-9))
            if not 0 <= z_score <= _CLEAR:
                break

    phases = tuple(refine(s, period, BLUR_S, None) for s in stretches)
    loss, _ = _loss(trials, phases)
    if np.isfinite(loss):
        # second pass: rows that did not change count, too, and the blur is what fits best
        loss = float(np.clip(loss, 0.02, 0.98))
        blur = best_blur(informative, period, loss)
        phases = tuple(refine(s, period, blur, loss) for s in stretches)
    weights = np.array([len(s.begin) for s in stretches], float)
    periods = np.array([p.period_s for p in phases])
    period = float(np.average(periods, weights=weights))
    spread = float(np.sqrt(np.average((periods - period) ** 2, weights=weights)))
    effective = weights.sum() ** 2 / np.sum(weights**2)
    hits = [contains(s, p) for s, p in zip(stretches, phases, strict=True)]
    hit_rate = float(np.mean(np.concatenate(hits)))
    loss, loss_sd = _loss(trials, phases)
    nothing = replace(nothing, z_score=z_score, hit_rate=hit_rate)
    sure = told == "stale" and period > _NEAR_LOOP * loop
    if hit_rate < 0.9 or z_score < (_SIGNIFICANT if sure else _SIGNIFICANT_ALONE):
        return nothing
    return replace(
        nothing,
        kind="lattice",
        readings="polled",
        time_doubt_s=0.0,
        poll_period_s=period,
        poll_period_sd_s=spread / np.sqrt(max(effective - 1, 1)),
        loss=loss,
        loss_sd=loss_sd,
        phases=phases,
    )


def readings(trial: Trial, lattice: PollLattice) -> Readings:
    """Fresh rows of `trial` with the times at which they were measured.

    With a lattice: its last instant before the read. Without one: the middle between the previous
    read and this one. Live: every row, at the time of its read.
    """
    rows = fresh_rows(trial)
    read = trial.read_time_s
    before = _read_before(trial)[rows]
    if "live" in (lattice.readings, trial.readings):
        rows = np.flatnonzero(np.isfinite(trial.position_rad))
        return Readings(rows, read[rows], trial.position_rad[rows], read.copy(), 0.0)
    time = 0.5 * (before + read[rows])
    sd = float(np.median(read[rows] - before) / np.sqrt(12 * max(len(rows), 1))) if len(rows) else 0
    own = [p for p in lattice.phases if p.trial == trial.number]
    for phase in own:
        inside = (read[rows] >= phase.start_s) & (read[rows] <= phase.stop_s)
        count = np.round((time - phase.phase_s) / phase.period_s)
        instant = phase.phase_s + count * phase.period_s
        slack = 0.5 * BLURS_S[-1]
        hit = inside & (instant >= before - slack) & (instant <= read[rows] + slack)
        time = np.where(hit, np.minimum(instant, read[rows]), time)
    if own:
        sd = float(np.sqrt(np.mean([p.phase_sd_s**2 for p in own]) / len(own)))
    held = np.full(len(read), np.nan)
    held[rows] = time
    last = np.maximum.accumulate(np.where(np.isfinite(held), np.arange(len(read)), -1))
    held = np.where(last >= 0, held[np.maximum(last, 0)], np.nan)
    return Readings(rows, time, trial.position_rad[rows], held, sd)


# ---------------------------------------------------------------- stretches of a trial


def _stretches(trial: Trial, step: float) -> list[Stretch]:
    """Cut a trial into stretches short enough for one strict lattice each."""
    read, rows, before = trial.read_time_s, fresh_rows(trial), _read_before(trial)
    moving = np.flatnonzero(moving_rows(trial, step))
    known = np.isfinite(trial.position_rad) & np.isfinite(before)
    same = np.setdiff1d(moving[known[moving]], rows)
    parts = max(1, int(np.ceil((read[-1] - read[0]) / _STRETCH_S)))
    edges = np.linspace(read[0], read[-1], parts + 1)
    found = []
    for start, stop in pairwise(edges):
        own, held = (r[(read[r] > start) & (read[r] <= stop)] for r in (rows, same))
        if len(own) >= 8:
            found.append(
                Stretch(trial.number, start, stop, before[own], read[own], before[held], read[held])
            )
    return found


def _loop_period(trials: Sequence[Trial]) -> float:
    gaps = [np.diff(t.read_time_s) for t in trials if len(t.read_time_s) > 1]
    return float(np.median(np.concatenate(gaps))) if gaps else float("nan")


# ------------------------------------------------------------------ where the servo must move


def moving_rows(trial: Trial, step: float) -> NDArray[np.bool_]:
    """Rows by which the servo must have moved by a count of `step` [rad] since the row before."""
    gap = float(np.median(np.diff(trial.read_time_s)))
    return _speed(trial) * gap > _MOVING_QUANTA * step


def _speed(trial: Trial) -> NDArray[np.float64]:
    """|command rate| around each row [rad/s], the largest over the past 0.1 s to allow for lag."""
    rate = np.abs(np.gradient(trial.command_rad, trial.send_time_s))
    loop = max(float(np.median(np.diff(trial.send_time_s))), 1e-4)
    reach = max(1, round(0.1 / loop))
    padded = np.concatenate([np.full(reach, rate[0]), rate])
    windows = np.lib.stride_tricks.sliding_window_view(padded, reach + 1)
    # the slowest command in reach: the servo moves even if the lag is unknown
    return windows.min(axis=1)


def _loss(trials: Sequence[Trial], phases: Sequence[Phase]) -> tuple[float, float]:
    """Share of polls that left the value as it was while the servo must have been moving."""
    step = max(quantum(trials), 1e-6)
    polls = successes = 0
    for trial in trials:
        rows, read, speed = fresh_rows(trial), trial.read_time_s, _speed(trial)
        middle = 0.5 * (_read_before(trial)[rows] + read[rows])
        for phase in (p for p in phases if p.trial == trial.number):
            first = int(np.ceil((phase.start_s - phase.phase_s) / phase.period_s))
            last = int(np.floor((phase.stop_s - phase.phase_s) / phase.period_s))
            counts = np.arange(first, last + 1)
            row = np.searchsorted(read, phase.phase_s + phase.period_s * counts)
            sure = speed[np.minimum(row, len(read) - 1)] * phase.period_s > _MOVING_QUANTA * step
            # each fresh row is the success of the one poll nearest to it
            seen = np.round((middle - phase.phase_s) / phase.period_s).astype(int)
            polls += int(sure.sum())
            successes += len(np.intersect1d(counts[sure], seen))
    if not polls:
        return float("nan"), float("nan")
    loss = 1.0 - successes / polls
    return loss, float(np.sqrt(max(loss * (1 - loss), 1.0 / polls) / polls))
