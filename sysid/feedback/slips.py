"""Slips, where within a trial the poll's phase jumps, and the share of polls that failed.

A bus that restarts, or skips part of a round, goes on polling at another phase. One lattice would
then date all readings behind the jump wrongly, by up to half a period. `find_segments` asks whether
0, 1 or 2 change points explain a stretch better: when its readings changed and, if a model's motion
is at hand, which position each reading shows at the instant it is dated to. The search is
exhaustive, over every second changed row and over a grid of periods and phases, with sums over
rows. Each change point must gain `NATS` of log-likelihood.

Failed polls are counted where a good poll must bring a new value: a joint that stands still shows
the same value after a good poll as after a failed one. With a model's motion at hand (`moves`)
polls count whose position must differ from that of the poll before; without one (`fast`), those at
which a joint that follows its command is fast. Friction that holds the joint meanwhile is then
taken for failed polls, here and there.

Lost commands are a few that never reached the servo. A line that loses a frame, or a host that
stalls, leaves the servo with the command before. Readings behind it then disagree with any model of
the servo for as long as it takes to catch up. `find_lost_commands` looks for readings far outside
of their tone's noise, one after the other, and asks whether 1 to 3 lost commands shortly before
explain them. A fit leaves out the readings that a lost command touches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result, internal
from pupper_sysid.common.signals import robust_sd
from pupper_sysid.sysid.feedback.poll_search import (
    DRIFT,
    LOCK,
    OUTLIERS,
    Phase,
    Stretch,
    best_segments,
    summed_scores,
)
from pupper_sysid.sysid.feedback.staleness import fresh_rows, quantum, read_before
from pupper_sysid.sysid.recordings.recording import Trial

Motion = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Expected position [rad] of a joint at times [s] on the recording's clock."""

NATS = 10.0
"""Gain in log-likelihood that a change point needs: no slip is then named in 196 trials of random
servos without one, and 85 % of jumps of 0.4 to 0.5 periods are followed."""

SMALLEST_JUMP = 0.2
"""In periods; smaller jumps are within a wandering period's reach and not called slips."""

_EVERY = 2  # changed rows between possible change points
_LEAST_ROWS = 6  # changed rows of a segment
_MOST_STOPS = 120
_REACH = 2.5  # standard deviations of the period's drift
_PHASE_STEP_S = 0.00075
_FEWEST_PHASES = 24
_TRACK_STEP_S = 0.0005
_SMALLEST_SCALE_RAD = 0.002
# of the residuals' median: the likeliest scale of soft-L1 is 0.72 of it for Gaussian ones, and less
# where a slip's residuals have widened it
_SCALES = (0.9, 0.7, 0.54)


@dataclass(frozen=True, kw_only=True)
class Slip(Result):
    """Jump of the poll's phase within a trial."""

    trial: int
    """Number of the trial."""
    time_s: float
    """When, from the trial's first read."""
    jump_s: float
    """By how much polls come later than before, within half a period."""
    nats: float
    """Log-likelihood that the jump gains."""


@dataclass(frozen=True)
class Segment:
    """Part of a stretch with a lattice of its own, near `phase_s + n * period_s`."""

    start_s: float
    stop_s: float
    period_s: float
    phase_s: float
    nats: float
    """Gained by the change point at its start; of the first segment 0."""


def find_segments(
    stretch: Stretch,
    value: NDArray[np.float64],
    period_s: float,
    blur_s: float,
    loss: float,
    motion: Motion | None = None,
    scale_rad: float = 1.0,
    near_s: float | None = None,
) -> list[Segment]:
    """Split a stretch where the poll's phase jumps: one, two or three segments, in time order.

    `value` is the reading of each changed row [rad]; `loss` is NaN if unknown. Without the expected
    `motion` only the times of changes count. `scale_rad` is the size of its residuals on this tone,
    any slip included; each number of change points is judged at its likeliest scale, up to half of
    this. `near_s` is an instant of the present lattice: another phase must gain `NATS`, too.
    """
    reference = 0.5 * (stretch.start_s + stretch.stop_s)
    grids = [
        _scored(stretch, value, period_s, blur_s, loss, motion, share * scale_rad)
        for share in (_SCALES if motion is not None else (1.0,))
    ]
    cuts, gains, grid = _change_points(grids)
    periods, phases, stops, lattice = grid.periods, grid.phases, grid.stops, grid.lattice
    if near_s is not None and not cuts:
        away = phases - (near_s - reference) / period_s
        near = np.tile(np.abs(away - np.round(away)) <= LOCK, len(periods))
        present = np.where(near, grid.whole, -np.inf)
        if grid.score[0, -1] - present.max() < NATS:
            lattice[0, -1] = int(np.argmax(present))

    inner = (0.5 * (grid.read[stops[c] - 1] + grid.read[stops[c]]) for c in cuts)
    borders = [stretch.start_s, *inner, stretch.stop_s]
    chosen = [0, *cuts, len(stops) - 1]
    segments = []
    for n in range(len(chosen) - 1):
        g = int(lattice[chosen[n], chosen[n + 1]])
        period = float(periods[g // len(phases)])
        phase = reference + float(phases[g % len(phases)]) * period
        middle = 0.5 * (borders[n] + borders[n + 1])
        phase += period * np.round((middle - phase) / period)
        segments.append(Segment(borders[n], borders[n + 1], period, phase, ([0.0, *gains])[n]))
    return segments


def evidence(stretch: Stretch, period_s: float, blur_s: float, loss: float) -> float:
    """Log-likelihood of when rows changed, for the best segments of a period.

    Unlike the score of one period's phases it compares periods: a shorter one explains more changes
    by more polls, of which more must have failed. Where the servo need not have moved, rows that
    stayed the same say nothing, and a shorter one only meets more rows by chance.
    """
    score = _scored(stretch, np.zeros(len(stretch.end)), period_s, blur_s, loss, None, 1.0).score
    one = float(np.max(score[0] + score[:, -1]))
    best = max(float(score[0, -1]), one - NATS)
    by_chance = np.minimum((stretch.end - stretch.begin) / period_s, 1.0)
    return best + float(np.sum(np.where(stretch.moving, np.log(1.0 - loss), -np.log(by_chance))))


@dataclass(frozen=True)
class _Grid:
    """Best lattice of every segment between two stops, on a grid of periods and phases."""

    periods: NDArray[np.float64]
    phases: NDArray[np.float64]
    stops: NDArray[np.int64]
    read: NDArray[np.float64]
    score: NDArray[np.float64]
    lattice: NDArray[np.int64]
    whole: NDArray[np.float64]
    """Score of every lattice for the whole stretch."""
    normal: float
    """Log-density that all segments share: of the residuals' scale."""


def _scored(
    stretch: Stretch,
    value: NDArray[np.float64],
    period_s: float,
    blur_s: float,
    loss: float,
    motion: Motion | None,
    scale_rad: float,
) -> _Grid:
    """Score every segment of a stretch on every lattice near a period."""
    reference = 0.5 * (stretch.start_s + stretch.stop_s)
    same = len(stretch.same_end) if np.isfinite(loss) else 0
    end = np.concatenate([stretch.end, stretch.same_end[:same]])
    begin = np.concatenate([stretch.begin, stretch.same_begin[:same]])
    changed = np.arange(len(end)) < len(stretch.end)
    order = np.argsort(end, kind="stable")
    values = np.zeros(len(end))
    values[: len(value)] = value

    changed_rows = np.flatnonzero(changed[order])
    every = max(_EVERY, -(-len(changed_rows) // _MOST_STOPS))
    stops = np.concatenate([[0], changed_rows[every:-1:every], [len(end)]])
    longest = max(stretch.stop_s - stretch.start_s, 1e-3)
    spread = _REACH * DRIFT
    # neighbouring periods differ by two phase steps at the ends of the stretch
    count = 2 * int(np.ceil(spread * 0.5 * longest / (2 * _PHASE_STEP_S))) + 1
    periods = period_s * np.exp(np.linspace(-spread, spread, count))
    phases = np.linspace(-0.5, 0.5, max(_FEWEST_PHASES, round(period_s / _PHASE_STEP_S)), False)
    track, first = np.zeros(0), 0.0
    if motion is not None:
        first = float(begin.min())
        times = np.arange(first, float(end.max()) + 2 * _TRACK_STEP_S, _TRACK_STEP_S)
        track = motion(times)
    summed = summed_scores(
        begin[order] - reference, end[order] - reference, changed[order], values[order], stops,
        periods, phases, blur_s, OUTLIERS, 1.0 - loss if same else 0.0, track, first - reference,
        _TRACK_STEP_S, scale_rad,
    )  # fmt: skip
    prior = np.repeat(-0.5 * (np.log(periods / period_s) / DRIFT) ** 2, len(phases))
    score, lattice = best_segments(summed, prior, max(1, -(-_LEAST_ROWS // every)))
    normal = -len(value) * float(np.log(scale_rad))
    return _Grid(periods, phases, stops, end[order], score, lattice, summed[-1] + prior, normal)


def robust_scale(residual: NDArray[np.float64], quantum_rad: float) -> float:
    """Scale of a tone's residuals [rad]: of the bulk, at least a quantisation step."""
    bulk = robust_sd(residual)
    return max(bulk, quantum_rad, _SMALLEST_SCALE_RAD)


def _change_points(grids: Sequence[_Grid]) -> tuple[list[int], list[float], _Grid]:
    """Stops at which to cut, at most two, what each gains, and the grid of the likeliest scale.

    None if they gain too little.
    """
    one = [grid.score[0] + grid.score[:, -1] for grid in grids]
    two = [grid.score[0][:, None] + grid.score + grid.score[:, -1][None] for grid in grids]
    best = [
        np.array([np.max(part) + grid.normal for part, grid in zip(parts, grids, strict=True)])
        for parts in ([grid.score[0, -1] for grid in grids], one, two)
    ]
    none, single, double = (float(b.max()) for b in best)
    if double - max(none + NATS, single) > NATS:
        n = int(np.argmax(best[2]))
        first, second = (int(k) for k in np.unravel_index(int(np.argmax(two[n])), two[n].shape))
        gains = [float(two[n][first, second] - one[n][k]) for k in (second, first)]
        return [first, second], gains, grids[n]
    if single - none > NATS:
        n = int(np.argmax(best[1]))
        return [int(np.argmax(one[n]))], [single - none], grids[n]
    return [], [], grids[int(np.argmax(best[0]))]


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

    `sure`, one per trial, is from `moves` (then the motion is `known`) or from `fast`.
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
            inside = (read[rows] > p.start_s) & (read[rows] <= p.stop_s)
            polls += int(np.sum(counts(instants, p.period_s)))
            successes += int(np.sum(counts(p.nearest(middle[inside]), p.period_s)))
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
    reach = round(4 * _SMOOTHING_S / _GRID_S)
    bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) * (_GRID_S / _SMOOTHING_S)) ** 2)
    smooth = np.convolve(
        np.pad(trial.command_rad[row], reach, mode="edge"), bell / bell.sum(), mode="valid"
    )
    none = np.zeros(len(trial.read_time_s))
    if len(time) < 8 or np.ptp(smooth) == 0:
        return none
    lags = np.arange(0.0, _LONGEST_LAG_S, 2 * _GRID_S)
    late = np.interp(time[None] - lags[:, None], grid, smooth)
    late -= late.mean(axis=1, keepdims=True)
    centred = position - position.mean()
    both, power = late @ centred, np.maximum(np.sum(late**2, axis=1), 1e-12)
    match = np.sign(both) * both**2 / power
    best = int(np.argmax(match))
    if match[best] < 0.5 * np.sum(centred**2):
        return none
    speed = np.abs(np.gradient(smooth, _GRID_S)) * both[best] / power[best]
    return np.interp(trial.read_time_s - lags[best], grid, speed)


Simulate = Callable[[NDArray[np.float64], int], NDArray[np.float64]]
"""Model minus the first so many fresh readings [rad] of a trial, had its rows carried these
commands [rad]."""


_FAR = 5.0  # standard deviations
_IN_A_ROW = 2
_EXPLAINED = 0.5  # share of the cost of the readings far off that lost commands must explain
_LONGEST_S = 0.3  # from a lost command to the first reading far off
_SETTLED_S = 1.0  # from there on until the joint moves as if none had been lost
_LEAST_BULK = 0.3  # of the tone's noise
_TOUCHED = 0.5  # standard deviations by which lost commands move a reading
_MOST_LOST = 3  # of a trial: more are no lost commands but a wrong model


@dataclass(frozen=True, kw_only=True)
class LostCommands(Result):
    """Commands that never reached the servo."""

    trial: int
    """Number of the trial."""
    time_s: float
    """When the first of them was sent, from the trial's first command."""
    commands: int
    """How many were lost."""
    nats: float
    """Log-likelihood that this gains."""
    readings: tuple[int, ...] = internal(default=())
    """Fresh readings of the trial that it touches, counted from 0: to be left out of a fit."""


def without_commands(trial: Trial, first: int, rows: int) -> NDArray[np.float64]:
    """Commands in force [rad] had `rows` of them from row `first` on never arrived."""
    command = trial.command_rad.copy()
    command[first : first + rows] = command[first - 1] if first else trial.initial_command_rad
    return command


def find_lost_commands(
    trial: Trial, time_s: NDArray[np.float64], scale_rad: float, simulate: Simulate
) -> list[LostCommands]:
    """Find commands of a trial that never reached the servo, in time order; most trials have none.

    `time_s` is when each fresh reading was measured, on the recording's clock, and `simulate` gives
    residuals at these times. `scale_rad` is the noise of the trial's tone; where the bulk of the
    residuals is smaller, that counts.
    """
    lost_commands: list[LostCommands] = []
    rest = simulate(trial.command_rad, len(time_s))
    # a lost command is part of the tone's noise, unless that is taken from the bulk
    bulk = robust_sd(rest)
    scale_rad = float(np.clip(bulk, _LEAST_BULK * scale_rad, scale_rad))
    rest = rest / scale_rad
    unexplained = np.ones(len(rest), bool)
    for _ in range(_MOST_LOST):
        far = (np.abs(rest) > _FAR) & unexplained
        runs = np.lib.stride_tricks.sliding_window_view(far, _IN_A_ROW).all(axis=1)
        if not runs.any():
            break
        first = int(np.argmax(runs))
        best: tuple[float, int, int, NDArray[np.float64]] = (-np.inf, 0, 0, rest)
        sent = trial.send_time_s
        until = int(np.searchsorted(time_s, time_s[first] + _SETTLED_S))
        for row in np.flatnonzero((sent < time_s[first]) & (sent > time_s[first] - _LONGEST_S)):
            for rows in range(1, _MOST_LOST + 1):
                commands = without_commands(trial, int(row), rows)
                if np.array_equal(commands, trial.command_rad):
                    continue
                without = np.concatenate([simulate(commands, until) / scale_rad, rest[until:]])
                gain = float(np.sum((_cost(rest) - _cost(without))[unexplained]))
                if gain > best[0]:
                    best = gain, int(row), rows, without
        run = [first]
        while run[-1] + 1 < len(rest) and abs(rest[run[-1] + 1]) > _FAR:
            run.append(run[-1] + 1)
        gain, row, rows, without = best
        if gain < max(NATS, _EXPLAINED * float(np.sum(_cost(rest[run])))):
            unexplained[run] = False  # something else: look on behind it
            continue
        touched = unexplained & (np.abs(without - rest) > _TOUCHED)
        unexplained &= ~touched
        lost_commands.append(
            LostCommands(
                trial=trial.number, time_s=float(sent[row] - sent[0]), commands=rows, nats=gain,
                readings=tuple(int(k) for k in np.flatnonzero(touched)),
            )
        )  # fmt: skip
    return sorted(lost_commands, key=lambda u: u.time_s)


def _cost(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Soft-L1 cost of residuals in standard deviations."""
    return np.sqrt(1.0 + residual**2) - 1.0
