"""Search for the lattice of poll instants that explains when readings changed.

In a stretch of a few seconds, each changed row brackets a successful poll between two reads; each
row that stayed the same although the servo must have moved brackets none. A lattice
`phase + n * period` is good if its instants lie in many of the former intervals and few of the
latter. For a trial period T, count for every phase how many changed rows' intervals contain an
instant; the log-likelihood of the count, against intervals placed at random, is the score. Real
polls drift by some 0.4 % from stretch to stretch, so stretches share T only through a Gaussian of
that width (`best_periods`). The score is compared with that of rows whose gaps were shuffled
(`shuffled`). `best_blur` and `refine` then estimate the width and the phase of the instants in each
stretch. Counting and likelihoods are compiled (numba).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True, error_model="numpy")
def most_hits(begin, end, periods, bins):
    """Most intervals that hold an instant of one lattice over `bins` phases, per period.

    `begin` and `end` have shape (intervals,), `periods` and the result (periods,); times are in
    seconds.
    """
    hits, edges = np.zeros(len(periods), np.int64), np.zeros(2 * bins + 1, np.int64)
    for i in range(len(periods)):
        edges[:] = 0
        for n in range(len(begin)):
            low = begin[n] / periods[i]
            first = int(np.floor((low - np.floor(low)) * bins))
            edges[first] += 1
            edges[first + int(np.rint(min((end[n] - begin[n]) / periods[i], 1.0) * bins))] -= 1
        for b in range(1, 2 * bins):
            edges[b] += edges[b - 1]
        for b in range(bins):
            hits[i] = max(hits[i], edges[b] + edges[b + bins])
    return hits


@njit(cache=True, nogil=True, error_model="numpy")
def log_likelihood(begin, end, periods, phases, blur, inside, outside):
    """Log-likelihood of intervals for every period and phase of a lattice, shape (periods, phases).

    An interval holds an instant with probability w, which falls linearly from 1 to 0 over the width
    `blur` [s]; its likelihood is `inside * w + outside`. `begin` and `end` [s], shape (intervals,),
    are relative to the instant of phase 0; `phases` are in periods; `outside` has shape
    (intervals,).
    """
    total = np.zeros((len(periods), len(phases)))
    for n in range(len(begin)):
        half = 0.5 * (end[n] - begin[n]) / blur + 0.5
        none, whole = np.log(outside[n]), np.log(inside + outside[n])
        for i in range(len(periods)):
            turns, scale = 0.5 * (begin[n] + end[n]) / periods[i] + 0.5, periods[i] / blur
            for j in range(len(phases)):
                away = turns - phases[j]
                share = half - abs(away - np.floor(away) - 0.5) * scale
                if share <= 0.0:  # most intervals are wholly inside or outside: no logarithm
                    total[i, j] += none
                elif share >= 1.0:
                    total[i, j] += whole
                else:
                    total[i, j] += np.log(inside * share + outside[n])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def summed_scores(
    begin, end, changed, value, stops, periods, phases, blur, outliers, success, track,
    track_start, track_step, scale,
):  # fmt: skip
    """Scores of every lattice, summed over the rows before each stop: (stops, periods * phases).

    A changed row scores `log((1 - outliers) * w + outliers * chance)`, w as in `log_likelihood`,
    less the soft-L1 cost of its `value` [rad] against the track at the instant it is dated to. A
    row that stayed the same scores `log(1 - (1 - outliers) * success * w)`.

    `begin`, `end` (previous read and read [s], relative to the instant of phase 0), `changed` and
    `value` are over rows; `stops` increase from 0 to the number of rows. `outliers` is the share of
    changed rows that may contradict the lattice, `success` the probability that a poll succeeds,
    `scale` the residuals' [rad]. `track` is the expected motion [rad] at `track_start + n *
    track_step` [s]; empty if there is none.
    """
    count = len(periods) * len(phases)
    sums, total = np.zeros((len(stops), count)), np.zeros(count)
    at = 1
    for n in range(len(begin)):
        half = 0.5 * (end[n] - begin[n]) / blur + 0.5
        for i in range(len(periods)):
            period = periods[i]
            middle = 0.5 * (begin[n] + end[n])
            turns, width = middle / period + 0.5, period / blur
            chance = outliers * min((end[n] - begin[n]) / period, 1.0)
            none, whole = np.log(chance), np.log(1.0 - outliers + chance)
            lost = np.log(1.0 - (1.0 - outliers) * success)
            for j in range(len(phases)):
                away = turns - phases[j]
                away -= np.floor(away) + 0.5
                share = half - abs(away) * width
                g = i * len(phases) + j
                if not changed[n]:
                    if share >= 1.0:
                        total[g] += lost
                    elif share > 0.0:
                        total[g] += np.log(1.0 - (1.0 - outliers) * success * share)
                    continue
                if share <= 0.0:
                    total[g] += none
                elif share >= 1.0:
                    total[g] += whole
                else:
                    total[g] += np.log((1.0 - outliers) * share + chance)
                if len(track):
                    time = min(max(middle - away * period, begin[n]), end[n])
                    step = min(max((time - track_start) / track_step, 0.0), len(track) - 1.001)
                    low = int(step)
                    model = track[low] + (step - low) * (track[low + 1] - track[low])
                    residual = (value[n] - model) / scale
                    total[g] -= np.sqrt(1.0 + residual * residual) - 1.0
        while at < len(stops) and stops[at] == n + 1:
            for g in range(count):  # assigning the row takes five times as long to compile
                sums[at, g] = total[g]
            at += 1
    return sums


@njit(cache=True, nogil=True, error_model="numpy")
def best_segments(summed, prior, least):
    """Best score of every segment between two stops, and the lattice that has it.

    Both have shape (stops, stops). `summed` is from `summed_scores`; `prior`, shape (lattices,),
    counts once per segment; a segment has at least `least` stops between its ends, or its score is
    -inf.
    """
    count = len(summed)
    score, lattice = np.full((count, count), -np.inf), np.zeros((count, count), np.int64)
    for a in range(count):
        for b in range(a + least, count):
            for g in range(summed.shape[1]):
                here = summed[b, g] - summed[a, g] + prior[g]
                if here > score[a, b]:
                    score[a, b], lattice[a, b] = here, g
    return score, lattice


OUTLIERS = 0.03
"""Share of changed rows that may contradict the lattice (a late reply, a missed row)."""

BLURS_S = (0.0012, 0.0025, 0.005)
"""Full widths of the uncertainty of one poll instant, to choose from [s]."""

BLUR_S = BLURS_S[1]  # the width before it is estimated [s]

DRIFT = 0.0045
"""Relative standard deviation of the period between stretches, measured on a Mini Pupper 2."""

_BINS = 64
LOCK = 0.125  # how far a phase may be from the one that it refines, in periods
_PEAKS, _APART = 12, 0.02  # best periods of the search, and how far apart
_MOST_OUTLIERS = 0.4


@dataclass(frozen=True)
class Stretch:
    """Evidence on the poll instants from one stretch of one trial."""

    trial: int
    """Number of the trial."""
    start_s: float
    stop_s: float
    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    """`begin` and `end`: previous read and read of each changed row [s], shape (changed,)."""
    same_begin: NDArray[np.float64]
    same_end: NDArray[np.float64]
    """`same_begin` and `same_end`: the same of each row whose value did not change although the
    servo must have moved [s], shape (same,)."""
    moving: NDArray[np.bool_]
    """By which changed rows the servo must have moved, so that without a change they would be among
    those that stayed the same, shape (changed,)."""

    def between(self, start_s: float, stop_s: float) -> Stretch:
        """Rows read within a part of the stretch."""
        new, same = ((e > start_s) & (e <= stop_s) for e in (self.end, self.same_end))
        return Stretch(
            self.trial, start_s, stop_s, self.begin[new], self.end[new],
            self.same_begin[same], self.same_end[same], self.moving[new],
        )  # fmt: skip


@dataclass(frozen=True)
class Phase:
    """The lattice in one stretch of one trial: instants at `phase_s + n * period_s`."""

    trial: int
    """Number of the trial."""
    start_s: float
    stop_s: float
    """`start_s` and `stop_s`: the stretch."""
    period_s: float
    phase_s: float
    phase_sd_s: float
    """`period_s`, `phase_s` and `phase_sd_s`: period, an instant near the stretch's middle, and the
    standard error of that."""

    def nearest(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """The instant nearest to each time [s]."""
        return self.phase_s + self.period_s * np.round((time_s - self.phase_s) / self.period_s)


def best_periods(
    stretches: Sequence[Stretch], grid: NDArray[np.float64]
) -> list[tuple[float, float]]:
    """Common periods [s] and their scores, the best first: the peaks of a quick search.

    Scores are log-likelihoods against intervals placed at random. `grid` has trial periods [s],
    evenly spaced in their logarithm. The period is NaN if none is possible.
    """
    pooled = _pool([_score(s.begin, s.end, grid) for s in stretches], grid)
    peaks = []
    for _ in range(_PEAKS):
        peak = int(np.argmax(pooled))
        if not np.isfinite(pooled[peak]):
            break
        peaks.append((float(grid[peak]), _evidence(stretches, grid[peak], BLUR_S, None)))
        pooled[np.abs(np.log(grid / grid[peak])) < _APART] = -np.inf
    return sorted(peaks, key=lambda pair: -pair[1]) or [(float("nan"), -np.inf)]


def shuffled(stretch: Stretch, rng: np.random.Generator) -> Stretch:
    """The same changes with the gaps between them in another order: no lattice is left."""
    order = rng.permutation(len(stretch.end) - 1)
    end = stretch.end[0] + np.concatenate([[0.0], np.cumsum(np.diff(stretch.end)[order])])
    return replace(stretch, begin=end - (stretch.end - stretch.begin), end=end)


def best_blur(stretches: Sequence[Stretch], period_s: float, loss: float) -> float:
    """Which of `BLURS_S` explains best which rows changed and which did not [s]."""
    evidence = [_evidence(stretches, period_s, blur, loss) for blur in BLURS_S]
    return BLURS_S[int(np.argmax(evidence))]


def refine(
    stretch: Stretch,
    period_s: float,
    blur_s: float,
    loss: float | None,
    near_s: float | None = None,
) -> Phase:
    """Posterior mean of a stretch's period and phase near the common period.

    `loss` is the probability that a poll fails; with None only rows that changed count. `near_s` is
    an instant of the lattice, to within an eighth of a period.
    """
    posterior, periods, steps, _ = _posterior(stretch, period_s, blur_s, loss, 61, 128)
    reference = 0.5 * (stretch.start_s + stretch.stop_s)
    if near_s is not None:
        away = (steps - (near_s - reference) / period_s + 0.5) % 1.0 - 0.5
        posterior = np.where(np.abs(away) <= LOCK, posterior, -np.inf)
    weight = np.exp(posterior - posterior.max())
    weight /= weight.sum()
    best_period = float(np.sum(weight.sum(axis=1) * periods))
    # the phase is an angle: average around the peak, not across the seam
    peak = steps[int(np.argmax(weight.sum(axis=0)))]
    near = (steps - peak + 0.5) % 1.0 - 0.5
    marginal = weight.sum(axis=0)
    mean = float(np.sum(marginal * near))
    sd = float(np.sqrt(np.sum(marginal * (near - mean) ** 2)))
    instant = reference + (peak + mean) * best_period
    return Phase(
        stretch.trial, stretch.start_s, stretch.stop_s, best_period, instant, sd * best_period
    )


def contains(stretch: Stretch, phase: Phase) -> NDArray[np.bool_]:
    """Which changed rows have a lattice instant in their interval, shape (changed,)."""
    middle = 0.5 * (stretch.begin + stretch.end)
    reach = 0.5 * (stretch.end - stretch.begin) + 0.5 * BLUR_S
    return np.abs(phase.nearest(middle) - middle) <= reach


def _score(begin: NDArray, end: NDArray, periods: NDArray) -> NDArray[np.float64]:
    """Best log-likelihood over phases for each period, against intervals placed at random."""
    # No blur here: intervals meet end to end, so with one a poll on a common edge would explain
    # every row at periods of two loops. Polls that jitter over an edge count as outliers.
    chance = np.minimum(np.median(end - begin) / periods, 1.0)  # for an interval at random
    hits = most_hits(begin, end, periods, _BINS)
    share = (hits / len(begin) - chance) / np.maximum(1 - chance, 1e-3)
    # polls that jitter by much of a loop miss more often
    outliers = np.clip(1 - share, OUTLIERS, _MOST_OUTLIERS)
    hit = np.log((1 - outliers) + outliers * chance) - np.log(chance)
    return hits * hit + (len(begin) - hits) * np.log(outliers)


def _pool(profiles: list[NDArray], grid: NDArray) -> NDArray[np.float64]:
    """Sum of the profiles, each free to sit a little beside the common period."""
    log_period = np.log(grid)
    reach = int(np.ceil(3 * DRIFT / (log_period[1] - log_period[0])))
    offsets = np.arange(-reach, reach + 1)
    penalty = -0.5 * (offsets * (log_period[1] - log_period[0]) / DRIFT) ** 2
    total = np.zeros(len(grid))
    for profile in profiles:
        padded = np.pad(profile, reach, constant_values=-np.inf)
        windows = np.lib.stride_tricks.sliding_window_view(padded, len(offsets))
        total += np.max(windows + penalty, axis=1)
    return total


def _evidence(
    stretches: Sequence[Stretch], period: float, blur: float, loss: float | None
) -> float:
    """Score of a common period [s], summed over the stretches."""
    return float(sum(_posterior(s, period, blur, loss, 25, 64)[3] for s in stretches))


def _posterior(
    stretch: Stretch,
    period: float,
    blur: float,
    loss: float | None,
    period_count: int,
    phase_count: int,
) -> tuple[NDArray, NDArray, NDArray, float]:
    """Log-posterior over (period, phase) near `period`, the two axes, and the peak's score.

    Without a `loss`, only rows that changed count. With one, a row that did not change although
    the servo moved says that no poll, or a failed one, lies in its interval.
    """
    reference = 0.5 * (stretch.start_s + stretch.stop_s)
    periods = period * np.exp(np.linspace(-2.5 * DRIFT, 2.5 * DRIFT, period_count))
    steps = np.linspace(-0.5, 0.5, phase_count, endpoint=False)

    chance = np.minimum((stretch.end - stretch.begin) / period, 1.0)
    total = log_likelihood(
        stretch.begin - reference, stretch.end - reference, periods, steps, blur, 1 - OUTLIERS,
        OUTLIERS * chance,
    )  # fmt: skip
    if loss is not None and len(stretch.same_end):
        total += log_likelihood(
            stretch.same_begin - reference, stretch.same_end - reference, periods, steps, blur,
            -(1 - OUTLIERS) * (1 - loss), np.ones(len(stretch.same_end)),
        )  # fmt: skip
    total -= 0.5 * (np.log(periods / period) / DRIFT)[:, None] ** 2
    return total, periods, steps, float(total.max() - np.log(chance).sum())
