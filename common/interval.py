"""An estimate with its 90 % interval: the one form in which results and files carry it."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

LEVEL = 0.90  # coverage of every interval of this project
HALF_WIDTH_SD = NormalDist().inv_cdf((1 + LEVEL) / 2)
"""Half the width of such an interval of a normal number, in standard deviations: 1.645."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its 90 % interval, all three in the same unit.

    Parameters
    ----------
    value : float
        The estimate.
    low, high : float
        Ends of the interval.
    """

    value: float
    low: float
    high: float

    def __repr__(self) -> str:
        return f"Interval({self.value:.4g}, {self.low:.4g}…{self.high:.4g})"

    @classmethod
    def of_draws(cls, value: float, draws: NDArray[np.float64]) -> Interval:
        """The interval that holds the middle 90 % of `draws`."""
        low, high = np.quantile(draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        return cls(float(value), float(low), float(high))

    def times(self, factor: float) -> Interval:
        """The estimate and its interval times a positive `factor`."""
        return Interval(factor * self.value, factor * self.low, factor * self.high)

    def widened(self, by: float) -> Interval:
        """The interval with `by` added on either side."""
        return Interval(self.value, self.low - by, self.high + by)


UNKNOWN = Interval(float("nan"), float("nan"), float("nan"))
"""Of a quantity without a value."""


def t_quantile(freedom: int) -> float:
    """Half width of a 90 % interval in standard errors, by Student's t."""
    from scipy.special import stdtrit  # slow to import

    return float(stdtrit(freedom, (1 + LEVEL) / 2))


def mean_of(values: NDArray[np.float64]) -> Interval:
    """Mean of the finite values, with its 90 % interval by Student's t."""
    values = values[np.isfinite(values)]
    if not len(values):
        return UNKNOWN
    mean = float(values.mean())
    half = float("nan")
    if len(values) > 1:
        half = t_quantile(len(values) - 1) * float(values.std(ddof=1) / np.sqrt(len(values)))
    return Interval(mean, mean - half, mean + half)
