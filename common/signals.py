"""Sizes of residuals and of motions: root mean square, and that of the bulk."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SD_OVER_MEDIAN_SIZE = 1.4826  # of a normal distribution


def rms(*parts: ArrayLike) -> float:
    """Root mean square of all numbers of all parts; NaN if there are none."""
    values = np.concatenate([np.ravel(np.asarray(part, float)) for part in parts or ([],)])
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def robust_sd(values: NDArray[np.float64]) -> float:
    """Standard deviation of the bulk of zero-mean numbers, by their median size; 0 of none."""
    return _SD_OVER_MEDIAN_SIZE * float(np.median(np.abs(values))) if len(values) else 0.0
