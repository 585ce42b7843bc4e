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
