"""Slips: where within a trial the poll's phase jumps.

A bus that restarts, or skips part of a round, goes on polling at another phase. One lattice would
then date all readings behind the jump wrongly, by up to half a period. `find_segments` asks whether
0, 1 or 2 change points explain a stretch better: when its readings changed and, if a model's motion
is at hand, which position each reading shows at the instant it is dated to. The search is
exhaustive, over every second changed row and over a grid of periods and phases, with sums over
rows. Each change point must gain `NATS` of log-likelihood.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result
from pupper_sysid.sysid.feedback.poll_search import (
    DRIFT,
    LOCK,
    OUTLIERS,
    Stretch,
    best_segments,
    summed_scores,
)

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
    """Split a stretch where the poll's phase jumps.

    Parameters
    ----------
    stretch : Stretch
    value : ndarray, shape (changed,)
        Reading of each changed row [rad].
    period_s : float
        Common period of the lattice.
    blur_s : float
        Full width of the uncertainty of one poll instant.
    loss : float
        Probability that a poll fails; NaN if unknown.
    motion : callable, optional
        Expected motion; without it only the times of changes count.
    scale_rad : float
        Size of the residuals of `motion` on this tone, any slip included. Each number of change
        points is judged at its likeliest scale of the residuals, up to half of this.
    near_s : float, optional
        An instant of the present lattice: another phase must gain `NATS`, too.

    Returns
    -------
    list of Segment
        One, two or three, in time order.
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

    read = grid.read
    borders = [
        stretch.start_s,
        *(0.5 * (read[stops[c] - 1] + read[stops[c]]) for c in cuts),
        stretch.stop_s,
    ]
    chosen = [0, *cuts, len(stops) - 1]
    found = []
    for n in range(len(chosen) - 1):
        g = int(lattice[chosen[n], chosen[n + 1]])
        period = float(periods[g // len(phases)])
        phase = reference + float(phases[g % len(phases)]) * period
        middle = 0.5 * (borders[n] + borders[n + 1])
        phase += period * np.round((middle - phase) / period)
        found.append(Segment(borders[n], borders[n + 1], period, phase, ([0.0, *gains])[n]))
    return found


def evidence(stretch: Stretch, period_s: float, blur_s: float, loss: float) -> float:
    """Log-likelihood of when rows changed, for the best segments of a period.

    Unlike the score of one period's phases it compares periods: a shorter one explains more
    changes by more polls, of which more must have failed.

    Parameters
    ----------
    stretch : Stretch
    period_s, blur_s, loss : float
        See `find_segments`.
    """
    score = _scored(stretch, np.zeros(len(stretch.end)), period_s, blur_s, loss, None, 1.0).score
    one = float(np.max(score[0] + score[:, -1]))
    best = max(float(score[0, -1]), one - NATS)
    return best + len(stretch.end) * float(np.log(1.0 - loss))


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
    shown = np.zeros(len(end))
    shown[: len(value)] = value

    own = np.flatnonzero(changed[order])
    every = max(_EVERY, -(-len(own) // _MOST_STOPS))
    stops = np.concatenate([[0], own[every:-1:every], [len(end)]])
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
        begin[order] - reference, end[order] - reference, changed[order], shown[order], stops,
        periods, phases, blur_s, OUTLIERS, 1.0 - loss if same else 0.0, track, first - reference,
        _TRACK_STEP_S, scale_rad,
    )  # fmt: skip
    prior = np.repeat(-0.5 * (np.log(periods / period_s) / DRIFT) ** 2, len(phases))
    score, lattice = best_segments(summed, prior, max(1, -(-_LEAST_ROWS // every)))
    normal = -len(value) * float(np.log(scale_rad))
    return _Grid(periods, phases, stops, end[order], score, lattice, summed[-1] + prior, normal)


def robust_scale(residual: NDArray[np.float64], quantum_rad: float) -> float:
    """Scale of a tone's residuals [rad]: of the bulk, at least a quantisation step."""
    bulk = 1.4826 * float(np.median(np.abs(residual))) if len(residual) else 0.0
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
