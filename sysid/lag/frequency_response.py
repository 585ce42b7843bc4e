"""Frequency response of joints: gain and phase per tone, bandwidth, fitted transfer functions.

Every tone of a sweep gives one complex number, the response from the zero-order-held command to the
measured motion, with a covariance from the bootstrap over periods. The describing gain belongs to
the amplitude it was measured at: friction and the speed limit make a servo's gain depend on it.

Transfer functions with exact delay are fitted to it:

    FOPDT   K exp(-Ts) / (τ s + 1)
    SOPDT   K exp(-Ts) ω² / (s² + 2 ζ ω s + ω²)

Least squares are weighted with the tones' covariances; the delay is a factor exp(-jωT), without a
Padé approximation. Below some 4 Hz the phase shows the sum of delay and dynamics, hardly their
split, and the intervals are wide accordingly. Where a servo is less linear than its tones are
precise, they are widened by the square root of chi²/dof.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import JointResults, Result, derived, internal
from pupper_sysid.servo_models.calibration.quantity import words_of
from pupper_sysid.sysid.doctor.checks import Joints, Recordings, cautions, each_joint, joint_rng
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice, readings
from pupper_sysid.sysid.lag.tone import ToneResponse, line_responses, tone_lags, without_ripple
from pupper_sysid.sysid.recordings.recording import Trial

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure

_DRAWS = 60  # refits behind the intervals
_STARTS = 4
_DELAY_MARGIN_S = 0.02


@dataclass(frozen=True, kw_only=True)
class TransferFunction(Result):
    """A fitted transfer function with exact delay."""

    name: str
    """FOPDT or SOPDT."""
    parameters: dict[str, Interval]
    """By name, each name ending in its unit."""
    chi2_per_dof: float
    """Misfit in units of the tones' uncertainty; far above 1 means the servo is not linear."""
    at_bound: tuple[str, ...] = ()
    """Parameters at the bound of their search, which the data do not identify."""

    @property
    def dead_time_s(self) -> float:
        """The delay of the form; exact in `evaluate`, `control.pade` may approximate it."""
        return self.parameters["dead_time_s"].value

    def values(self) -> NDArray[np.float64]:
        """Parameters in the order of their names."""
        return np.array([p.value for p in self.parameters.values()])

    def evaluate(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Response at `frequency_hz`, delay included."""
        return _MODELS[self.name].response(self.values(), np.asarray(frequency_hz, float))

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


@dataclass(frozen=True, kw_only=True)
class FrequencyPoint(Result):
    """Response to one tone."""

    frequency_hz: float
    amplitude_rad: float
    """`frequency_hz` and `amplitude_rad`: of the command."""
    gain: float
    phase_deg: float
    """`gain` and `phase_deg`: describing gain, and phase unwrapped by the lag that all tones
    share."""
    raw_gain: float
    """Of all rows against their commands."""
    covariance: NDArray[np.float64]
    """Of the response's real and imaginary parts, shape (2, 2)."""


@dataclass(frozen=True, kw_only=True)
class FrequencyResponse(Result):
    """Measured response of one joint; arrays are over its tones, by frequency."""

    joint: str
    bandwidth_hz: Interval | None
    """Where the gain falls below -3 dB of the lowest tone's; None if no tone reaches that. An upper
    end of infinity lies above the highest tone."""
    transfer_functions: dict[str, TransferFunction]
    """Those with fewer parameters than there are numbers measured."""
    warnings: tuple[str, ...] = ()
    """What asks for care in these recordings."""
    frequency_hz: NDArray[np.float64] = internal()
    amplitude_rad: NDArray[np.float64] = internal()
    response: NDArray[np.complex128] = internal()
    raw_response: NDArray[np.complex128] = internal()
    """`response` and `raw_response`: of fresh readings against the held command; of all rows
    against their commands."""
    covariance: NDArray[np.float64] = internal()
    """Of the response's real and imaginary parts, shape (tones, 2, 2)."""

    @property
    def gain(self) -> NDArray[np.float64]:
        """Describing gain, response amplitude over command amplitude."""
        return np.abs(self.response)

    @property
    def phase_deg(self) -> NDArray[np.float64]:
        """Phase [degrees], unwrapped by the lag that all tones share."""
        return -360.0 * self.frequency_hz * tone_lags(self.response, self.frequency_hz)

    @derived
    def by_frequency(self) -> tuple[FrequencyPoint, ...]:
        """The tones, by frequency."""
        return tuple(
            FrequencyPoint(
                frequency_hz=f, amplitude_rad=a, gain=g, phase_deg=p, raw_gain=n, covariance=c
            )
            for f, a, g, p, n, c in zip(
                self.frequency_hz, self.amplitude_rad, self.gain, self.phase_deg,
                np.abs(self.raw_response), self.covariance, strict=True,
            )
        )  # fmt: skip

    def frd(self) -> control.FrequencyResponseData:
        """The measurement as python-control holds it, over rad/s."""
        import control

        return control.frd(self.response, 2 * np.pi * self.frequency_hz)

    @derived
    def bandwidth_text(self) -> str:
        """The bandwidth in words."""
        if np.ptp(self.frequency_hz) < 0.01:
            return "unknown: one frequency only"
        if self.bandwidth_hz is None:
            return f"above {self.frequency_hz[-1]:.1f} Hz, the highest tone"
        b = self.bandwidth_hz
        high = f"{b.high:.1f}" if np.isfinite(b.high) else f"above {self.frequency_hz[-1]:.1f}"
        return f"{b.value:.1f} Hz ({b.low:.1f} … {high})"

    def rows(self) -> list[dict[str, Any]]:
        """One row per tone."""
        return [row for point in self.by_frequency for row in point.rows()]

    def __repr__(self) -> str:
        f = self.frequency_hz
        return (
            f"FrequencyResponse({len(f)} tones, {f[0]:.3g}–{f[-1]:.3g} Hz; "
            f"bandwidth {self.bandwidth_text})"
        )

    def __str__(self) -> str:
        lines = ["    Hz  amplitude rad   gain      dB  phase °  raw gain"]
        for p in self.by_frequency:
            lines.append(
                f"{p.frequency_hz:6.2f} {p.amplitude_rad:14.3f} {p.gain:6.3f} "
                f"{20 * np.log10(p.gain):+7.2f} {p.phase_deg:8.1f} {p.raw_gain:11.3f}"
            )
        lines.append(f"  −3 dB bandwidth: {self.bandwidth_text}")
        for name, fit in self.transfer_functions.items():
            order = {"FOPDT": "first order", "SOPDT": "second order"}[name]
            lines.append(f"  {order} and delay ({name}), χ²/dof {fit.chi2_per_dof:.1f}:")
            lines.append(f"    {fit.text}")
            if fit.at_bound:
                names = ", ".join(map(words_of, fit.at_bound))
                lines.append(f"    at its bound, so not identified: {names}")
        return "\n".join(lines)


def joint_response(
    joint: str,
    trials: Sequence[Trial],
    rng: np.random.Generator,
    lattice: PollLattice | None = None,
) -> FrequencyResponse:
    """Measure the frequency response of one joint from all of its trials."""
    lattice = lattice or find_poll_lattice(trials, rng.spawn(1)[0])
    tones: list[ToneResponse] = []
    read = [readings(trial, lattice) for trial in trials]
    for trial, reading in zip(trials, read, strict=True):
        tones += line_responses(trial, reading, rng)
    if not tones:
        raise InputError(
            f"{joint}: this recording has no tone of two periods or more, and no multisine, so "
            "there is no frequency response. Was the joint moving? Record tones of 1 to 10 Hz with "
            "`pupper-sysid sweep`."
        )
    if lattice.kind != "lattice":
        tones = without_ripple(trials, read, tones, rng)
    tones.sort(key=lambda t: t.frequency_hz)
    draws = np.stack([t.response_draws for t in tones])
    return FrequencyResponse(
        joint=joint,
        bandwidth_hz=_bandwidth(tones, draws),
        # not where there are too few frequencies for their parameters
        transfer_functions={
            n: _fit(n, tones, draws)
            for n, model in _MODELS.items()
            if 2 * len({round(t.frequency_hz, 2) for t in tones}) > len(model.names)
        },
        warnings=cautions(joint, trials),
        frequency_hz=np.array([t.frequency_hz for t in tones]),
        amplitude_rad=np.array([abs(t.command_held) for t in tones]),
        response=np.array([t.response for t in tones]),
        raw_response=np.array([t.raw / t.command_rows for t in tones]),
        covariance=np.stack([np.cov(d.real, d.imag) for d in draws]),
    )


def _bandwidth(tones: Sequence[ToneResponse], draws: NDArray) -> Interval | None:
    frequency = np.array([t.frequency_hz for t in tones])

    def crossing(gain: NDArray) -> float:
        below = np.flatnonzero(gain < gain[0] / np.sqrt(2))
        if not len(below):
            return float("inf")
        k = below[0]
        target = 0.5 * np.log(0.5) + np.log(gain[0])
        rise = np.log(gain[k - 1 : k + 1])
        share = (rise[0] - target) / (rise[0] - rise[1])
        return float(frequency[k - 1] + share * (frequency[k] - frequency[k - 1]))

    value = crossing(np.abs(np.array([t.response for t in tones])))
    if not np.isfinite(value):
        return None
    # a draw that never crosses is an infinite one: left out, it would make the interval too sure
    drawn = np.sort([crossing(g) for g in np.abs(draws).T])
    low, high = (round(q * (len(drawn) - 1)) for q in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(value, float(drawn[low]), float(drawn[high]))


@dataclass(frozen=True, kw_only=True, eq=False)
class FrequencyResponses(JointResults[FrequencyResponse]):
    """Frequency responses by joint."""

    def plot(self) -> Figure:
        """Gain and phase over frequency."""
        from pupper_sysid.sysid.report.figures import bode_figure

        return bode_figure(self)

    def __str__(self) -> str:
        return "\n".join(f"{joint}\n{response}" for joint, response in self.items())


def frequency_response(
    recordings: Recordings,
    joints: Joints = None,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> FrequencyResponses:
    """Measure the frequency response of every joint.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Trials of one joint are pooled.
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    seed : int
        Of the bootstrap.
    workers : int
        Processes.
    progress : callable, optional
        Called with a joint's name when it is done.

    Returns
    -------
    FrequencyResponses
        Response by joint.

    Raises
    ------
    InputError
        If a joint has neither tones nor a multisine.
    """
    work = partial(_measure, seed=seed)
    return FrequencyResponses(joints=each_joint(work, recordings, joints, workers, progress))


def _measure(joint: str, trials: tuple[Trial, ...], seed: int) -> FrequencyResponse:
    return joint_response(joint, trials, joint_rng(seed, joint))
