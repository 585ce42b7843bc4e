"""Recursive digital filters, compiled: scipy.signal takes most of a second to import."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def filtered(
    numerator: NDArray[np.float64], denominator: NDArray[np.float64], signal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """A signal behind a filter at rest, as `scipy.signal.lfilter` (direct form II, transposed).

    Numerator and denominator, of equal length, are in rising powers of the delay; `denominator[0]`
    is 1.
    """
    order = len(denominator) - 1
    state = np.zeros(order + 1)
    out = np.empty_like(signal)
    for n in range(len(signal)):
        out[n] = numerator[0] * signal[n] + state[0]
        for k in range(order):
            state[k] = state[k + 1] + numerator[k + 1] * signal[n] - denominator[k + 1] * out[n]
    return out
