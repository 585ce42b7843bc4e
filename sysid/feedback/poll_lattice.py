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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from pupper_sysid.common.interval import HALF_WIDTH_SD, LEVEL, Interval
from pupper_sysid.common.results import Result, derived, internal
from pupper_sysid.sysid.feedback import poll_search
from pupper_sysid.sysid.feedback.poll_search import Phase, Stretch
from pupper_sysid.sysid.feedback.slips import (
    SMALLEST_JUMP,
    Motion,
    Slip,
    Sure,
    count_loss,
    evidence,
    fast,
    find_segments,
    more_changes_than_polls,
    moves,
    robust_scale,
)
from pupper_sysid.sysid.feedback.staleness import (
    STRETCH_S,
    fresh_rows,
    loop_period,
    quantum,
    read_before,
    staleness,
    stretches_of,
)
from pupper_sysid.sysid.recordings.recording import Trial

LONGEST_S = 0.12  # longest poll period that is searched for [s]
_CLOSE = 5.0  # nats: a period that explains the readings by less worse is not ruled out
_ALTERNATIVES = 4  # periods of the search that are compared in full
# of the period from stretch to stretch: usual size, and the stretches that this is worth
_USUAL_DRIFT, _USUAL_STRETCHES = 0.002, 3.0
_MEMORY = 3.0  # a wandering period is alike in neighbouring stretches: a third of them count


def likeliest_periods(
    trials: Sequence[Trial],
    stretches: Sequence[Stretch],
    periods: Sequence[float],
    loop: float,
    sure: Sequence[Sure],
) -> tuple[float, ...]:
    """The period that explains best which rows changed and which did not [s], then close ones.

    Of the best ones of the search and of their aliases, at which the reads meet instants of
    another lattice in the same rows. A lattice with fewer polls than changes is none.
    """
    best = periods[0]
    if not np.isfinite(best):
        return (best,)
    tried = [*periods[:_ALTERNATIVES], 2 * best, best / 2]
    tried += [1 / abs(1 / loop - 1 / p) for p in tried if abs(p / loop - 1) > 0.01]
    scores = {}
    for period in tried:
        if not 1.02 * loop < period < LONGEST_S:
            continue
        phases = tuple(poll_search.refine(s, period, poll_search.BLUR_S, None) for s in stretches)
        if more_changes_than_polls(trials, phases, sure):
            continue
        loss = _possible(count_loss(trials, phases, sure)[0]) or _UNKNOWN_LOSS
        # a period may not win by the width of its instants
        scores[period] = max(
            sum(evidence(s, period, blur, loss) for s in stretches) for blur in poll_search.BLURS_S
        )
    if not scores:
        return (best,)
    order = sorted(scores, key=lambda p: -scores[p])
    close = [p for p in order if scores[order[0]] - scores[p] < _CLOSE]
    return (order[0], *(p for p in close[1:] if abs(p / order[0] - 1) > 2 * poll_search.DRIFT))


def common_period(
    parts: Sequence[Stretch], phases: Sequence[Phase], stretch: Sequence[int]
) -> tuple[float, float]:
    """Mean period over the stretches of a lattice, and its standard error [s].

    `parts` are segments between slips, `stretch` says which stretch each is of. Segments of one
    stretch see the same wandering period: they count as one measurement of it.
    """
    size, of = np.array([len(s.begin) for s in parts], float), np.array(stretch)
    weights = np.bincount(of, size)
    periods = np.bincount(of, size * [p.period_s for p in phases]) / np.maximum(weights, 1)
    period = float(np.average(periods, weights=weights))
    effective = max(weights.sum() ** 2 / np.sum(weights**2), 1.0)
    # periods of few stretches: their scatter is shrunk towards that of other recordings
    scatter = np.average((periods - period) ** 2, weights=weights) * effective
    usual = _USUAL_STRETCHES * (_USUAL_DRIFT * period) ** 2
    variance = (scatter + usual) / (effective - 1 + _USUAL_STRETCHES)
    return period, float(np.sqrt(_MEMORY * variance / effective))


NO_LOSS = (
    "between two polls the joint moves by less than a few steps of its reading, so failed polls "
    "do not show"
)
"""Why the loss of a lattice is NaN."""

_UNKNOWN_LOSS = 0.5
_SIGNIFICANT = 4.0  # standard deviations above shuffled rows
_SIGNIFICANT_ALONE = 8.0  # the same where the motion does not show that there is a slow poll
_NEAR_LOOP = 1.3  # loops: regular reversals look like a poll that is hardly slower than the loop
_SHUFFLES = 12
# each costs as much as the search: where the first few leave no doubt there are no more
_FEWEST_SHUFFLES, _CLEAR = 4, 20.0


@dataclass(frozen=True, kw_only=True)
class PollLattice(Result):
    """The poll of one joint's feedback, as far as its readings show it; NaN where unknown."""

    kind: str
    """A lattice was found; none is significant; or readings are live, so each is dated to its read,
    even where it repeats the one before because the joint stands still."""
    readings: str = "cannot tell"
    """Whether the bus returns present positions or those of its last poll: by the recording's
    header, else by the motion, else by a significant lattice."""
    time_doubt_s: float = 0.0
    """By how much all readings may have been measured earlier or later than they are dated: half a
    loop if the lattice is unresolved, else 0. Lag and dead time are in doubt by as much, and
    neither is identified then."""
    poll_period_s: float = math.nan
    poll_period_sd_s: float = math.nan
    """`poll_period_s` and `poll_period_sd_s`: time between polls and its standard error."""
    loss: float = math.nan
    loss_sd: float = math.nan
    """`loss` and `loss_sd`: probability that a poll fails, and its standard error."""
    z_score: float = math.nan
    """Score against shuffled rows, in their standard deviations."""
    hit_rate: float = math.nan
    """Share of changed rows with a lattice instant between the previous read and this one."""
    fresh_fraction: float
    """Share of rows with a new value, among all rows."""
    slips: tuple[Slip, ...] = ()
    """Jumps of the poll's phase within a trial."""
    polls: float = internal(default=0.0)
    """Independent polls from which the loss was counted."""
    close_s: tuple[float, ...] = internal(default=())
    """Periods that explain the readings about as well [s]: reads meet their instants in the same
    rows."""
    blur_s: float = internal(default=poll_search.BLUR_S)
    """Full width of the uncertainty of one poll instant."""
    phases: tuple[Phase, ...] = internal(default=())
    """Lattice of each stretch, in time order within a trial."""

    @derived
    def mean_age_s(self) -> float:
        """Mean age of a reading implied by period and loss [s]; NaN where the loss is unknown.

        Infinite where every poll failed.
        """
        return self._age(self.loss)

    @property
    def assumed_loss(self) -> float:
        """The loss, or where none could be counted the mean of its prior (Jeffreys)."""
        return self.loss if math.isfinite(self.loss) else _UNKNOWN_LOSS

    @property
    def poll_period_interval(self) -> Interval:
        """Poll period with its 90 % interval [s]."""
        reach = HALF_WIDTH_SD * self.poll_period_sd_s
        near = [self.poll_period_s, *self.close_s]
        return Interval(self.poll_period_s, min(near) - reach, max(near) + reach)

    @property
    def loss_interval(self) -> Interval:
        """Loss with its 90 % interval, over all periods that explain the readings.

        Where none could be counted, that of the prior: nearly 0 to nearly 1.
        """
        ends = [self._loss_at(period) for period in (self.poll_period_s, *self.close_s)]
        return Interval(
            self.assumed_loss, min(low for low, _ in ends), max(high for _, high in ends)
        )

    @property
    def mean_age_interval(self) -> Interval:
        """Mean age with its 90 % interval [s], likewise; the period's own error is small."""
        ends = [
            period * (0.5 + p / (1 - p))
            for period in (self.poll_period_s, *self.close_s)
            for p in (min(end, 0.999) for end in self._loss_at(period))
        ]
        return Interval(self._age(self.assumed_loss), min(ends), max(ends))

    def _age(self, loss: float) -> float:
        return math.inf if loss >= 1 else self.poll_period_s * (0.5 + loss / (1 - loss))

    def _loss_at(self, period_s: float) -> tuple[float, float]:
        """Jeffreys' interval of the loss if polls come each `period_s`: as many succeed."""
        loss = max(1 - (1 - self.assumed_loss) * period_s / self.poll_period_s, 0.0)
        polls = self.polls * self.poll_period_s / period_s
        failed, tail = loss * polls, (1 - LEVEL) / 2
        low, high = (
            float(betaincinv(failed + 0.5, polls - failed + 0.5, q)) for q in (tail, 1 - tail)
        )
        return min(low, loss), max(high, loss)


@dataclass(frozen=True)
class Readings:
    """The fresh rows of a trial, each with the time at which it was measured."""

    rows: NDArray[np.int64]
    """Indices into the trial's rows, shape (fresh,)."""
    time_s: NDArray[np.float64]
    """When the position was measured, shape (fresh,)."""
    position_rad: NDArray[np.float64]
    """Shape (fresh,)."""
    held_time_s: NDArray[np.float64]
    """Shape (rows,). For every row of the trial, when the value it shows was measured; NaN before
    the first fresh row."""
    time_sd_s: float
    """Standard error of a shift common to all these times."""

    def only(self, used: NDArray[np.bool_]) -> Readings:
        """Some of the fresh rows, by a mask of shape (fresh,)."""
        rows, time_s, position_rad = (x[used] for x in (self.rows, self.time_s, self.position_rad))
        return replace(self, rows=rows, time_s=time_s, position_rad=position_rad)


def find_poll_lattice(trials: Sequence[Trial], rng: np.random.Generator) -> PollLattice:
    """Period, loss and phases of the poll behind one joint's readings, from all of its trials.

    `rng` shuffles the gaps between changes: a lattice must explain them better than that.
    """
    rows = sum(len(t.read_time_s) for t in trials)
    fresh = sum(len(fresh_rows(t)) for t in trials)
    fraction = fresh / max(rows, 1)
    # the readings of a joint that stands still repeat as well, and show nothing of the bus
    trials = [t for t in trials if t.readings != "live"]
    liveness = staleness(trials).kind if trials else "live"
    declared = any(t.readings == "polled" for t in trials)
    if liveness == "live" and not declared:
        return PollLattice(kind="every read", readings="live", fresh_fraction=fraction)
    loop = loop_period(trials)
    nothing = PollLattice(
        kind="unresolved", readings="polled" if declared or liveness == "stale" else "cannot tell",
        fresh_fraction=fraction, time_doubt_s=loop / 2 if np.isfinite(loop) else 0.0,
    )  # fmt: skip
    if liveness == "live":  # a new value at each read: the poll is faster than the loop
        return nothing
    stretches = stretches_of(trials)
    if not stretches or not np.isfinite(loop):
        return nothing

    # ln T, spaced so that the last poll of a stretch moves by half of the blur
    grid = np.exp(
        np.arange(np.log(loop * 1.02), np.log(LONGEST_S), 0.4 * poll_search.BLUR_S / STRETCH_S)
    )
    informative = sorted(stretches, key=lambda s: -len(s.begin))[:8]
    periods = poll_search.best_periods(informative, grid)
    score = periods[0][1]
    null: list[float] = []
    z_score = 0.0
    for _ in range(_SHUFFLES):
        by_chance = [poll_search.shuffled(s, rng) for s in informative]
        null.append(poll_search.best_periods(by_chance, grid)[0][1])
        if len(null) >= _FEWEST_SHUFFLES:
            z_score = float((score - np.mean(null)) / max(np.std(null, ddof=1), 1e-9))
            if not 0 <= z_score <= _CLEAR:
                break

    sure = fast(trials)
    likely = likeliest_periods(trials, informative, [p for p, _ in periods], loop, sure)
    period = likely[0]
    phases = tuple(poll_search.refine(s, period, poll_search.BLUR_S, None) for s in stretches)
    loss = count_loss(trials, phases, sure)[0]
    blur, possible = poll_search.BLUR_S, _possible(loss)
    if possible is not None:
        # second pass: rows that did not change count, too, and the blur is what fits best
        blur = poll_search.best_blur(informative, period, possible)
        phases = tuple(poll_search.refine(s, period, blur, possible) for s in stretches)
    lattice = replace(
        nothing, kind="lattice", readings="polled", time_doubt_s=0.0, poll_period_s=period,
        close_s=likely[1:], loss=loss, blur_s=blur, phases=phases,
    )  # fmt: skip
    lattice = _with_segments(trials, stretches, replace(lattice, z_score=z_score), None, sure)
    known = liveness == "stale" and period > _NEAR_LOOP * loop
    if lattice.hit_rate < 0.9 or z_score < (_SIGNIFICANT if known else _SIGNIFICANT_ALONE):
        return replace(nothing, z_score=z_score, hit_rate=lattice.hit_rate)
    return lattice


def redate(trials: Sequence[Trial], lattice: PollLattice, motions: Sequence[Motion]) -> PollLattice:
    """Find slips of a lattice again, now that the motion of the joint is known.

    The motion settles where a slip is, and which of two phases is right; within an eighth of a
    period the times of changes alone settle the phase, so that an error of the model's dead time
    does not enter the dates. `motions`, one per trial, give the position that a reading is expected
    to show [rad, offset included]. A lattice of another kind than "lattice" comes back as it is.
    """
    if lattice.kind != "lattice":
        return lattice
    polled = [(t, m) for t, m in zip(trials, motions, strict=True) if t.readings != "live"]
    polled_trials = [t for t, _ in polled]
    motions_by_number = {t.number: m for t, m in polled}
    return _with_segments(
        polled_trials, stretches_of(polled_trials), lattice, motions_by_number, None
    )


def _with_segments(
    trials: Sequence[Trial],
    stretches: Sequence[Stretch],
    lattice: PollLattice,
    motions: Mapping[int, Motion] | None,
    sure: Sequence[Sure] | None,
) -> PollLattice:
    """The lattice with a phase of its own for each segment between slips, and all its numbers.

    Either the motions are known, or which polls count without them (`sure`).
    """
    by_number = {t.number: t for t in trials}
    step = quantum(trials)
    loss = _possible(lattice.loss)
    parts: list[Stretch] = []
    phases: list[Phase] = []
    slips: list[Slip] = []
    of: list[int] = []
    noise = dict.fromkeys(by_number, 0.0)
    for number, stretch in enumerate(stretches):
        trial = by_number[stretch.trial]
        value = trial.position_rad[np.searchsorted(trial.read_time_s, stretch.end)]
        old = [
            p for p in lattice.phases
            if p.trial == trial.number and p.start_s < stretch.stop_s and p.stop_s > stretch.start_s
        ]  # fmt: skip
        motion, scale = None, 1.0
        if motions is not None:
            motion = motions[trial.number]
            scale = robust_scale(value - motion(_instants(stretch, old)), step)
            noise[trial.number] = max(noise[trial.number], scale)
        segments = find_segments(
            stretch, value, lattice.poll_period_s, lattice.blur_s, lattice.loss, motion, scale,
            old[0].phase_s if len(old) == 1 else None,
        )  # fmt: skip
        for n, segment in enumerate(segments):
            part = stretch.between(segment.start_s, segment.stop_s)
            near = segment.phase_s if motion is not None or len(segments) > 1 else None
            phase = poll_search.refine(part, lattice.poll_period_s, lattice.blur_s, loss, near)
            if n:
                # from one phase to the next, at the border between the two
                at, period = np.array(segment.start_s), phase.period_s
                here, there = phases[-1].nearest(at), phase.nearest(at)
                jump_s = float((there - here + period / 2) % period - period / 2)
                # less is drift: the segments follow it, but nothing slipped
                if abs(jump_s) > max(SMALLEST_JUMP * period, lattice.blur_s):
                    time_s = float(at - trial.read_time_s[0])
                    slips.append(
                        Slip(trial=trial.number, time_s=time_s, jump_s=jump_s, nats=segment.nats)
                    )
            parts.append(part)
            phases.append(phase)
            of.append(number)
    hits = np.concatenate([poll_search.contains(s, p) for s, p in zip(parts, phases, strict=True)])
    period, error = common_period(parts, phases, of)
    if sure is None and motions is not None:
        sure = moves(trials, motions, noise)
    loss, polls = count_loss(trials, phases, sure or (), known=motions is not None)
    if loss >= 1:
        # no poll that counts brought a new value: a joint that moves by less than a few steps of
        # its reading per poll shows no failures, and the readings that change are of other polls
        loss, polls = math.nan, 0.0
    return replace(
        lattice, poll_period_s=period, poll_period_sd_s=error, loss=loss,
        loss_sd=math.sqrt(max(loss * (1 - loss), 1.0 / polls) / polls) if polls else math.nan,
        polls=polls, hit_rate=float(np.mean(hits)), slips=tuple(slips), phases=tuple(phases),
    )  # fmt: skip


def _possible(loss: float) -> float | None:
    """A loss that makes no row impossible; None if unknown."""
    return float(np.clip(loss, 0.02, 0.98)) if np.isfinite(loss) else None


def _instants(stretch: Stretch, phases: Sequence[Phase]) -> NDArray[np.float64]:
    """When each changed row of a stretch was measured [s]."""
    middle = 0.5 * (stretch.begin + stretch.end)
    time = middle
    for p in phases:
        inside = (stretch.end >= p.start_s) & (stretch.end <= p.stop_s)
        time = np.where(inside, np.clip(p.nearest(middle), stretch.begin, stretch.end), time)
    return time


def readings(trial: Trial, lattice: PollLattice) -> Readings:
    """Fresh rows of `trial` with the times at which they were measured.

    With a lattice: its last instant before the read. Without one: the middle between the previous
    read and this one. Live: every row, at the time of its read.
    """
    rows = fresh_rows(trial)
    read = trial.read_time_s
    before = read_before(trial)[rows]
    if "live" in (lattice.readings, trial.readings):
        rows = np.flatnonzero(np.isfinite(trial.position_rad))
        return Readings(rows, read[rows], trial.position_rad[rows], read.copy(), 0.0)
    time = 0.5 * (before + read[rows])
    sd = float(np.median(read[rows] - before) / np.sqrt(12 * max(len(rows), 1))) if len(rows) else 0
    phases = [p for p in lattice.phases if p.trial == trial.number]
    for phase in phases:
        inside = (read[rows] >= phase.start_s) & (read[rows] <= phase.stop_s)
        instant = phase.nearest(time)
        slack = 0.5 * poll_search.BLURS_S[-1]
        hit = inside & (instant >= before - slack) & (instant <= read[rows] + slack)
        time = np.where(hit, np.minimum(instant, read[rows]), time)
    if phases:
        sd = float(np.sqrt(np.mean([p.phase_sd_s**2 for p in phases]) / len(phases)))
    held = np.full(len(read), np.nan)
    held[rows] = time
    last = np.maximum.accumulate(np.where(np.isfinite(held), np.arange(len(read)), -1))
    held = np.where(last >= 0, held[np.maximum(last, 0)], np.nan)
    return Readings(rows, time, trial.position_rad[rows], held, sd)
