"""Transfer functions with exact delay, fitted to a measured frequency response.

    FOPDT   K exp(-Ts) / (τ s + 1)
    SOPDT   K exp(-Ts) ω² / (s² + 2 ζ ω s + ω²)

Least squares weighted with the tones' covariances; the delay is a factor exp(-jωT), without a Padé
approximation. Below some 4 Hz the phase shows the sum of delay and dynamics, hardly their split,
and the intervals are wide accordingly. Where a servo is less linear than its tones are precise,
they are widened by the square root of chi²/dof.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result, derived
from pupper_sysid.sysid.lag.phase_slope import tone_lags
from pupper_sysid.sysid.lag.tone import ToneResponse

if TYPE_CHECKING:
    import control

_DRAWS = 60  # refits behind the intervals
_STARTS = 4
_DELAY_MARGIN_S = 0.02


@dataclass(frozen=True, kw_only=True)
class TransferFunction(Result):
    """A fitted transfer function with exact delay.

    Attributes
    ----------
    name : {"FOPDT", "SOPDT"}
    parameters : dict of str to Interval
        By name, each name ending in its unit.
    chi2_per_dof : float
        Misfit in units of the tones' uncertainty; far above 1 means the servo is not linear.
    at_bound : tuple of str
        Parameters at the bound of their search, which the data do not identify.
    """

    name: str
    parameters: dict[str, Interval]
    chi2_per_dof: float
    at_bound: tuple[str, ...] = ()

    @property
    def dead_time_s(self) -> float:
        """The delay beside `rational()`; exact in `evaluate`, `control.pade` may approximate it."""
        return self.parameters["dead_time_s"].value

    def values(self) -> NDArray[np.float64]:
        """Parameters in the order of their names."""
        return np.array([p.value for p in self.parameters.values()])

    def evaluate(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Response at `frequency_hz`, delay included."""
        return _MODELS[self.name].response(self.values(), np.asarray(frequency_hz, float))

    def rational(self) -> control.TransferFunction:
        """The part without the delay, for python-control."""
        import control

        v = self.values()
        if self.name == "FOPDT":
            return control.TransferFunction([v[0]], [v[2], 1.0])
        return control.TransferFunction([v[0] * v[2] ** 2], [1.0, 2 * v[3] * v[2], v[2] ** 2])

    @derived
    def text(self) -> str:
        """The formula with its numbers."""
        p = {name: interval.value for name, interval in self.parameters.items()}
        delay = f"exp(-{p['dead_time_s']:.4f} s)"
        if self.name == "FOPDT":
            return f"{p['gain']:.3f} {delay} / ({p['time_constant_s']:.4f} s + 1)"
        w, z = p["natural_frequency_rad_s"], p["damping_ratio"]
        return f"{p['gain']:.3f} {delay} · {w**2:.0f} / (s² + {2 * z * w:.1f} s + {w**2:.0f})"


@dataclass(frozen=True)
class _Model:
    """A form to fit: bounds, scales and first guesses (all but the gain) of its parameters."""

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


_MODELS = {
    "FOPDT": _Model(
        ("gain", "dead_time_s", "time_constant_s"),
        (0.05, 0.0, 1e-4), (5.0, 0.5, 0.5), (1.0, 0.02, 0.02),
        ((1e-3, 3e-3, 0.01, 0.02, 0.04, 0.08, 0.2),), _fopdt,
    ),
    "SOPDT": _Model(
        ("gain", "dead_time_s", "natural_frequency_rad_s", "damping_ratio"),
        (0.05, 0.0, 5.0, 0.1), (5.0, 0.5, 600.0, 4.0), (1.0, 0.02, 50.0, 0.5),
        ((10.0, 20.0, 35.0, 60.0, 100.0, 170.0, 300.0), (0.3, 0.6, 1.0, 1.8)), _sopdt,
    ),
}  # fmt: skip


def fit_transfer_functions(
    tones: Sequence[ToneResponse], draws: NDArray
) -> dict[str, TransferFunction]:
    """FOPDT and SOPDT, unless there are too few frequencies for their parameters.

    Parameters
    ----------
    tones : sequence of ToneResponse
    draws : ndarray of complex, shape (tones, draws)
        Bootstrap of the tones' responses.
    """
    numbers = 2 * len({round(t.frequency_hz, 2) for t in tones})
    return {n: _fit(n, tones, draws) for n, model in _MODELS.items() if numbers > len(model.names)}


def _fit(name: str, tones: Sequence[ToneResponse], draws: NDArray) -> TransferFunction:
    """Weighted least squares from the best points of a grid, refitted to the bootstrap's draws."""
    model = _MODELS[name]
    frequency = np.array([t.frequency_hz for t in tones])
    measured = np.array([t.response for t in tones])
    covariance = np.stack([np.cov(d.real, d.imag) for d in draws])
    factor = np.linalg.inv(np.linalg.cholesky(covariance + 1e-10 * np.eye(2)))
    # dynamics only add lag: no delay is longer than the shortest lag, whole periods settled
    longest = float(np.min(tone_lags(measured, frequency))) + _DELAY_MARGIN_S
    low, high = np.array(model.low), np.array(model.high)
    high[1] = np.clip(longest, _DELAY_MARGIN_S, high[1])

    def whitened(response: NDArray[np.complex128]) -> NDArray[np.float64]:
        parts = np.stack([response.real, response.imag], axis=-1)
        white = np.einsum("nij,...nj->...ni", factor, parts)
        return white.reshape(*white.shape[:-2], -1)

    def solve(target: NDArray[np.complex128], starts: NDArray):
        fits = [
            least_squares(
                lambda v: whitened(model.response(v, frequency) - target),
                np.clip(start, low, high), bounds=(low, high), x_scale=model.scale,
            )
            for start in starts
        ]  # fmt: skip
        return min(fits, key=lambda fit: fit.cost)

    guesses = np.stack(
        [g.ravel() for g in np.meshgrid(np.linspace(0, high[1], 16), *model.guesses)]
    )
    shapes = whitened(model.response((1.0, *guesses[..., None]), frequency))
    gain = (shapes @ whitened(measured)) / np.sum(shapes**2, axis=1)
    misfit = np.sum((gain[:, None] * shapes - whitened(measured)) ** 2, axis=1)
    starts = np.column_stack([gain, *guesses])[np.argsort(misfit, kind="stable")[:_STARTS]]

    best = solve(measured, starts)
    chi2 = 2 * best.cost / (2 * len(tones) - len(model.names))
    refits = np.array([solve(d, best.x[None]).x for d in draws.T[:_DRAWS]])
    spread = np.clip(best.x + np.sqrt(max(chi2, 1.0)) * (refits - best.x), low, high)
    on_bound = np.minimum(best.x - low, high - best.x) < 1e-3 * (high - low)
    return TransferFunction(
        name=name,
        parameters={
            n: Interval.of_draws(best.x[k], spread[:, k]) for k, n in enumerate(model.names)
        },
        chi2_per_dof=float(chi2),
        at_bound=tuple(n for n, bound in zip(model.names, on_bound, strict=True) if bound),
    )
