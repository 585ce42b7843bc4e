"""Quantisation step of a joint's readings, from the histogram of their differences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.recordings.recording import Trial

_SMALLEST_RAD = 1e-4  # below it there is no telling a count from decimals
_SAME_RAD = 2e-5  # differences of one number of counts, in a file with five decimals
_NEAR = 0.2  # of a step: farther from a multiple a difference does not count
_SURE = 0.98
_FIRST_MULTIPLES = 4  # the smallest frequent difference may be several steps


def quantum(trials: Sequence[Trial]) -> float:
    """Find the quantisation step of readings.

    Differences of quantised readings gather at multiples of the step. The smallest frequent one
    gives a first guess, and least squares over all of them the step; a file's decimals only blur
    it.

    Parameters
    ----------
    trials : sequence of Trial
        All of one joint.

    Returns
    -------
    float
        The step [rad]; 0 if the differences are no multiples of one.
    """
    given = [t.position_rad for t in trials]
    steps = np.concatenate([np.zeros(0), *(np.abs(np.diff(p)) for p in given)])
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
        found = _multiples_of(different, first / divisor)
        if found:
            return found
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
