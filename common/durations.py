"""Statistics of durations in constant memory."""

from __future__ import annotations

import math

import numpy as np

_SHORTEST_S, _LONGEST_S, _STEP = 1e-7, 1e3, 0.01
_BINS = math.ceil(math.log(_LONGEST_S / _SHORTEST_S) / _STEP)


class Durations:
    """Count, mean, standard deviation, largest and quantiles of durations [s].

    Mean and deviation are exact (Welford), quantiles within 1 %: they come from a histogram with
    logarithmic bins from 0.1 µs to 1000 s.
    """

    def __init__(self):
        self.count, self.mean_s, self.largest_s = 0, 0.0, 0.0
        self._squares = 0.0
        self._bins = np.zeros(_BINS, np.int64)

    def add(self, seconds: float) -> None:
        """Add one duration [s], ≥ 0."""
        self.count += 1
        away = seconds - self.mean_s
        self.mean_s += away / self.count
        self._squares += away * (seconds - self.mean_s)
        self.largest_s = max(self.largest_s, seconds)
        place = math.log(max(seconds, _SHORTEST_S) / _SHORTEST_S) / _STEP
        self._bins[min(int(place), _BINS - 1)] += 1

    @property
    def sd_s(self) -> float:
        """Standard deviation [s]; 0 for a single duration."""
        return math.sqrt(self._squares / max(self.count, 1))

    def quantile(self, share: float) -> float:
        """Duration [s] that `share` of them stay below; NaN without any."""
        if not self.count:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), share * self.count))
        return min(_SHORTEST_S * math.exp(_STEP * (place + 0.5)), self.largest_s)
