"""The linear baseline: a servo as a filter of its last commands, fitted robustly.

position = bias + Σ fir[k] · command[t - k], by ridge regression under Huber's loss (iteratively
re-weighted least squares), so that outliers, such as a fall or a delayed poll, have little weight.
The prior size of a coefficient decays with the age of its command by `FADE_S` (the diagonal kernel
of regularised FIR identification; Chen, Ohlsson and Ljung, Automatica 2012), so that no filter
length has to be chosen. The ridge is chosen by held-out groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.servo_fit.windows import Samples

HISTORY_S = 0.4
"""Memory of a model [s]: a servo responds after 40 ms and oscillates for up to 200 ms more."""

FADE_S = 0.1
RIDGES = (1e-4, 1e-3, 1e-2)
_HUBER = 1.5  # in robust standard deviations
_ITERATIONS = 8


@dataclass(frozen=True)
class LinearFits:
    """Linear models of all joints, one per training set, in normalised units.

    Attributes
    ----------
    fir : ndarray, shape (joints, sets, taps)
    bias : ndarray, shape (joints, sets)
    residual : ndarray, shape (joints, windows, readings, sets)
        Reading minus model.
    scale : ndarray, shape (joints, sets)
        RMS of the residuals the model was fitted to.
    spread : ndarray, shape (joints, sets)
        The same, robust: 1.4826 times their median size.
    """

    fir: NDArray[np.float64]
    bias: NDArray[np.float64]
    residual: NDArray[np.float64]
    scale: NDArray[np.float64]
    spread: NDArray[np.float64]


def taps(period_s: float) -> int:
    """Number of commands in `HISTORY_S` at a control period [s]."""
    return max(3, round(HISTORY_S / period_s))


def fading(count: int, period_s: float) -> NDArray[np.float64]:
    """Prior size of the coefficients of the last `count` commands, newest first."""
    return np.exp(-np.arange(count) * period_s / FADE_S)


def fit_linear(
    data: Samples, sets: Sequence[frozenset[int]], period_s: float, ridge: float
) -> LinearFits:
    """Fit every joint on every training set.

    Parameters
    ----------
    data : Samples
    sets : sequence of frozenset of int
        Groups that each fit leaves out.
    period_s : float
        Time between commands [s].
    ridge : float
        In units of the number of readings; commands and positions have unit variance.
    """
    count = taps(period_s)
    fade = fading(count, period_s)
    x = data.at_readings(count) * fade
    joints = len(x)
    fir, bias = np.zeros((joints, len(sets), count)), np.zeros((joints, len(sets)))
    residual = np.zeros((*data.target.shape, len(sets)))
    scale, spread = np.ones((joints, len(sets))), np.ones((joints, len(sets)))
    for j in range(joints):
        for n, left_out in enumerate(sets):
            use = learns_from(data, left_out)[j]
            if not use.any():  # a joint with no other group: the mean, which is zero
                residual[j, :, :, n] = data.target[j]
                continue
            a = np.column_stack([x[j][use], np.ones(int(use.sum()))])
            w, r = _robust(a, data.target[j][use].astype(float), ridge)
            fir[j, n], bias[j, n] = w[:-1] * fade, w[-1]
            residual[j, :, :, n] = data.target[j] - x[j] @ w[:-1] - w[-1]
            scale[j, n] = max(float(np.sqrt(np.mean(r**2))), 1e-3)
            spread[j, n] = max(1.4826 * float(np.median(np.abs(r))), 1e-3)
    return LinearFits(fir, bias, residual, scale, spread)


def learns_from(data: Samples, left_out: frozenset[int]) -> NDArray[np.bool_]:
    """Mask of the readings of a fit that leaves out some groups; none close to a boundary."""
    if not left_out:
        return data.used
    return data.used & (data.group >= 0) & ~np.isin(data.group, list(left_out))


def _robust(a: NDArray, y: NDArray, ridge: float) -> tuple[NDArray, NDArray]:
    penalty = np.eye(a.shape[1])
    penalty[-1, -1] = 1e-9  # the bias is free
    weight, w = np.ones(len(y)), np.zeros(a.shape[1])
    r = y
    for _ in range(_ITERATIONS):
        left = a * weight[:, None]
        w = np.linalg.solve(left.T @ a + ridge * weight.sum() * penalty, left.T @ y)
        r = y - a @ w
        sigma = max(1.4826 * float(np.median(np.abs(r))), 1e-6)
        weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(r), 1e-12))
    return w, r
