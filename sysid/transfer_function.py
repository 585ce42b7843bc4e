"""Transfer functions with an exact delay, fitted to a measured frequency response.

Two forms, fitted by least squares weighted with the tones' covariances; the delay is a factor
exp(-jωT), no Padé approximation:

    FOPDT   K exp(-Ts) / (τ s + 1)
    SOPDT   K exp(-Ts) ω² / (s² + 2 ζ ω s + ω²)

Below some 4 Hz the split between delay and dynamics is soft: their sum is what the phase shows. The
intervals say so, and where a servo is less linear than its tones are precise they are widened by
the square root of chi²/dof.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import control
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sysid.delay import Interval, tone_lags

_DRAWS = 200  # refits behind the intervals
_STARTS = 4
_REFIT_STEPS = 25
_DELAY_MARGIN_S = 0.02


@dataclass(frozen=True)
class TransferFunction:
    """A fitted transfer function with exact delay.

    Attributes
    ----------
    name : {"FOPDT", "SOPDT"}
    parameters : dict of str to Interval
        By name, each name ending in its unit.
    chi2_per_dof : float
        Misfit in units of the tones' uncertainty; far above 1 means the servo is not linear.
    at_bound : tuple of str
        Parameters that ended on their bound: the data do not ask for them.
    """

    name: str
    parameters: dict[str, Interval]
    chi2_per_dof: float
    at_bound: tuple[str, ...] = ()

    @property
    def delay_s(self) -> float:
        """The delay beside `rational()`; exact in `evaluate`, `control.pade` may approximate it."""
        return self.parameters["delay_s"].value

    def values(self) -> NDArray[np.float64]:
        """Parameters in the order of their names."""
        return np.array([p.value for p in self.parameters.values()])

    def evaluate(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Response at `frequency_hz`, delay included."""
        return FORMS[self.name].response(self.values(), np.asarray(frequency_hz, float))

    def rational(self) -> control.TransferFunction:
        """The part without the delay, for python-control."""
        v = self.values()
        if self.name == "FOPDT":
            return control.TransferFunction([v[0]], [v[2], 1.0])
        return control.TransferFunction([v[0] * v[2] ** 2], [1.0, 2 * v[3] * v[2], v[2] ** 2])

    def __str__(self) -> str:
        p = {name: interval.value for name, interval in self.parameters.items()}
        delay = f"exp(-{p['delay_s']:.4f} s)"
        if self.name == "FOPDT":
            return f"{p['gain']:.3f} {delay} / ({p['time_constant_s']:.4f} s + 1)"
        w, z = p["natural_frequency_rad_s"], p["damping_ratio"]
        return f"{p['gain']:.3f} {delay} · {w**2:.0f} / (s² + {2 * z * w:.1f} s + {w**2:.0f})"


@dataclass(frozen=True)
class Form:
    """A form to fit: names, bounds, scales and first guesses of its parameters.

    Attributes
    ----------
    names : tuple of str
        Gain and delay first; each name ends in its unit.
    low, high, scale : tuple of float
    guesses : tuple of tuple of float
        For every parameter after gain and delay, which follow from the data.
    response : callable
        `response(parameters, frequency_hz)`; parameters broadcast against the frequencies.
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    scale: tuple[float, ...]
    guesses: tuple[tuple[float, ...], ...]
    response: Callable[[Sequence[Any] | NDArray, NDArray], NDArray[np.complex128]]


def _fopdt(v: Sequence[Any] | NDArray, f: NDArray) -> NDArray[np.complex128]:
    s = 2j * np.pi * f
    return v[0] * np.exp(-v[1] * s) / (v[2] * s + 1)


def _sopdt(v: Sequence[Any] | NDArray, f: NDArray) -> NDArray[np.complex128]:
    s = 2j * np.pi * f
    return v[0] * np.exp(-v[1] * s) * v[2] ** 2 / (s**2 + 2 * v[3] * v[2] * s + v[2] ** 2)


FORMS = {
    "FOPDT": Form(
        ("gain", "delay_s", "time_constant_s"),
        (0.05, 0.0, 1e-4), (5.0, 0.5, 0.5), (1.0, 0.02, 0.02),
        ((1e-3, 3e-3, 0.01, 0.02, 0.04, 0.08, 0.2),), _fopdt,
    ),
    "SOPDT": Form(
        ("gain", "delay_s", "natural_frequency_rad_s", "damping_ratio"),
        (0.05, 0.0, 5.0, 0.1), (5.0, 0.5, 600.0, 4.0), (1.0, 0.02, 50.0, 0.5),
        ((10.0, 20.0, 35.0, 60.0, 100.0, 170.0, 300.0), (0.3, 0.6, 1.0, 1.8)), _sopdt,
    ),
}  # fmt: skip


def fit_transfer_function(
    name: str,
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    draws: NDArray[np.complex128],
) -> TransferFunction:
    """Fit the form `name` by weighted least squares from the best points of a grid.

    Parameters
    ----------
    name : {"FOPDT", "SOPDT"}
    frequency_hz : ndarray, shape (tones,)
        With more numbers (two a tone) than the form has parameters.
    response : ndarray of complex, shape (tones,)
    draws : ndarray of complex, shape (tones, draws)
        Equally likely responses: they give the weights and, refitted, the intervals.
    """
    form = FORMS[name]
    covariance = np.stack([np.cov(d.real, d.imag) for d in draws])
    factor = np.linalg.inv(np.linalg.cholesky(covariance + 1e-10 * np.eye(2)))
    # dynamics only add lag: no delay is longer than the shortest lag, whole periods settled
    longest = float(np.min(tone_lags(response, frequency_hz))) + _DELAY_MARGIN_S
    low, high, scale = np.array(form.low), np.array(form.high), np.array(form.scale)
    high[1] = np.clip(longest, _DELAY_MARGIN_S, high[1])

    def whitened(value: NDArray[np.complex128]) -> NDArray[np.float64]:
        parts = np.stack([value.real, value.imag], axis=-1)
        white = np.einsum("nij,...nj->...ni", factor, parts)
        return white.reshape(*white.shape[:-2], -1)

    def model(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        return whitened(form.response(np.moveaxis(parameters, -1, 0)[..., None], frequency_hz))

    guesses = np.meshgrid([1.0], np.linspace(0.0, high[1], 16), *form.guesses)
    starts = np.stack([g.ravel() for g in guesses], axis=-1)
    target, shapes = whitened(response), model(starts)
    starts[:, 0] = np.clip((shapes @ target) / np.sum(shapes**2, axis=1), low[0], high[0])
    misfit = np.sum((starts[:, :1] * shapes - target) ** 2, axis=1)
    fits = [
        least_squares(lambda v: model(v) - target, start, bounds=(low, high), x_scale=scale)
        for start in starts[np.argsort(misfit, kind="stable")[:_STARTS]]
    ]
    best = min(fits, key=lambda fit: fit.cost)
    chi2 = 2 * best.cost / (len(target) - len(form.names))
    refits = _refit(model, whitened(draws.T[:_DRAWS]), best.x, low, high, scale)
    spread = np.clip(best.x + np.sqrt(max(chi2, 1.0)) * (refits - best.x), low, high)
    on_bound = np.minimum(best.x - low, high - best.x) < 1e-3 * (high - low)
    return TransferFunction(
        name,
        {n: Interval.of_draws(best.x[k], spread[:, k]) for k, n in enumerate(form.names)},
        float(chi2),
        tuple(n for n, bound in zip(form.names, on_bound, strict=True) if bound),
    )


def _refit(
    model: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    targets: NDArray[np.float64],
    start: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    scale: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Parameters for each of `targets`: Levenberg-Marquardt within bounds, all of them at once."""
    found = np.tile(start, (len(targets), 1))
    damping = np.full(len(targets), 1e-3)
    away = model(found) - targets
    for _ in range(_REFIT_STEPS):
        columns = []
        for k in range(len(start)):
            step = 1e-6 * scale * (np.arange(len(start)) == k)
            columns.append((model(found + step) - model(found - step)) / 2e-6)
        jacobian = np.stack(columns, axis=-1)
        slope = np.einsum("dmk,dm->dk", jacobian, away)
        free = ~(((found <= low) & (slope > 0)) | ((found >= high) & (slope < 0)))
        jacobian = jacobian * free[:, None, :]
        curve = np.einsum("dmk,dml->dkl", jacobian, jacobian)
        size = np.einsum("dkk->dk", curve)
        curve = curve + (damping[:, None] * size + ~free + 1e-12)[:, :, None] * np.eye(len(start))
        move = np.linalg.solve(curve, (slope * free)[..., None])[..., 0]
        tried = np.clip(found - move * scale, low, high)
        missed = model(tried) - targets
        better = np.sum(missed**2, axis=1) < np.sum(away**2, axis=1)
        found = np.where(better[:, None], tried, found)
        away = np.where(better[:, None], missed, away)
        damping = np.where(better, damping / 5, damping * 5)
    return found
