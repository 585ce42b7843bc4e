"""Compiled counting and likelihood of the search for a poll lattice (numba; see `poll_search`)."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def most_hits(begin, end, periods, bins):
    """Largest number of intervals that hold an instant of one lattice, over its phases.

    Parameters
    ----------
    begin, end : ndarray, shape (intervals,)
        In seconds.
    periods : ndarray, shape (periods,)
        In seconds.
    bins : int
        Phases tried per period.

    Returns
    -------
    ndarray of int, shape (periods,)
    """
    found, edges = np.zeros(len(periods), np.int64), np.zeros(2 * bins + 1, np.int64)
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
            found[i] = max(found[i], edges[b] + edges[b + bins])
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def log_likelihood(begin, end, periods, phases, blur, inside, outside):
    """Log-likelihood of intervals for every period and phase of a lattice.

    An interval holds an instant with probability w, which falls linearly from 1 to 0 over the
    width `blur`; its likelihood is `inside * w + outside`.

    Parameters
    ----------
    begin, end : ndarray, shape (intervals,)
        In seconds, relative to the instant of phase 0.
    periods : ndarray, shape (periods,)
        In seconds.
    phases : ndarray, shape (phases,)
        In periods.
    blur : float
        In seconds.
    inside : float
    outside : ndarray, shape (intervals,)

    Returns
    -------
    ndarray, shape (periods, phases)
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
    """Scores of every lattice, summed over the rows before each stop.

    A changed row scores `log((1 - outliers) * w + outliers * chance)`, w as in `log_likelihood`,
    less the soft-L1 cost of its value against the track at the instant it is dated to. A row that
    stayed the same scores `log(1 - (1 - outliers) * success * w)`.

    Parameters
    ----------
    begin, end : ndarray, shape (rows,)
        Previous read and read of each row [s], relative to the instant of phase 0.
    changed : ndarray of bool, shape (rows,)
    value : ndarray, shape (rows,)
        Reading of each changed row [rad].
    stops : ndarray of int, shape (stops,)
        Increasing, from 0 to the number of rows.
    periods : ndarray, shape (periods,)
        In seconds.
    phases : ndarray, shape (phases,)
        In periods.
    blur : float
        In seconds.
    outliers, success : float
        Share of changed rows that may contradict the lattice; probability that a poll succeeds.
    track : ndarray, shape (times,)
        Expected motion [rad] at `track_start + n * track_step` [s]; empty if there is none.
    track_start, track_step : float
    scale : float
        Of the residuals [rad].

    Returns
    -------
    ndarray, shape (stops, periods * phases)
    """
    count = len(periods) * len(phases)
    found, total = np.zeros((len(stops), count)), np.zeros(count)
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
                found[at, g] = total[g]
            at += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def best_segments(summed, prior, least):
    """Best score of every segment between two stops, and the lattice that has it.

    Parameters
    ----------
    summed : ndarray, shape (stops, lattices)
        From `summed_scores`.
    prior : ndarray, shape (lattices,)
        Log-prior, counted once per segment.
    least : int
        Stops between the ends of a segment, at least.

    Returns
    -------
    score : ndarray, shape (stops, stops)
        From stop to stop; -inf where a segment is too short.
    lattice : ndarray of int, shape (stops, stops)
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
