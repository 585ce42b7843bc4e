"""Frequency response of one joint: gain and phase per tone, bandwidth, fitted transfer functions.

Every tone of a sweep gives one complex number, the response from the zero-order-held command to the
measured motion, with a covariance from the bootstrap over periods. The describing gain belongs to
the amplitude it was measured at: friction and the speed limit make a servo's gain depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import Result, derived, internal
from pupper_sysid.sysid.doctor.checks import cautions
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice, readings
from pupper_sysid.sysid.lag.multisine import line_responses
from pupper_sysid.sysid.lag.phase_slope import tone_lags
from pupper_sysid.sysid.lag.ripple import without_ripple
from pupper_sysid.sysid.lag.tone import ToneResponse
from pupper_sysid.sysid.lag.transfer_function import TransferFunction, fit_transfer_functions
from pupper_sysid.sysid.recordings.recording import Trial

if TYPE_CHECKING:
    import control


@dataclass(frozen=True, kw_only=True)
class FrequencyPoint(Result):
    """Response to one tone.

    Attributes
    ----------
    frequency_hz, amplitude_rad : float
        Of the command.
    gain, phase_deg : float
        Describing gain, and phase unwrapped by the lag that all tones share.
    raw_gain : float
        Of all rows against their commands.
    covariance : ndarray, shape (2, 2)
        Of the response's real and imaginary parts.
    """

    frequency_hz: float
    amplitude_rad: float
    gain: float
    phase_deg: float
    raw_gain: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FrequencyResponse(Result):
    """Measured response of one joint; arrays are over its tones, by frequency.

    Attributes
    ----------
    frequency_hz, amplitude_rad : ndarray
    response, raw_response : ndarray of complex
        Of fresh readings against the held command; of all rows against their commands.
    covariance : ndarray, shape (tones, 2, 2)
        Of the response's real and imaginary parts.
    bandwidth_hz : Interval or None
        Where the gain falls below -3 dB of the lowest tone's; None if no tone reaches that. An
        upper end of infinity lies above the highest tone.
    transfer_functions : dict of str to TransferFunction
        Those with fewer parameters than there are numbers measured.
    warnings : tuple of str
        What asks for care in these recordings.
    """

    joint: str
    bandwidth_hz: Interval | None
    transfer_functions: dict[str, TransferFunction]
    warnings: tuple[str, ...] = ()
    frequency_hz: NDArray[np.float64] = internal()
    amplitude_rad: NDArray[np.float64] = internal()
    response: NDArray[np.complex128] = internal()
    raw_response: NDArray[np.complex128] = internal()
    covariance: NDArray[np.float64] = internal()

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
            lines.append(f"  {name}: {fit.text}   (chi²/dof {fit.chi2_per_dof:.1f})")
            if fit.at_bound:
                names = ", ".join(n.replace("_", " ") for n in fit.at_bound)
                lines.append(f"    at its bound, so not identified: {names}")
        return "\n".join(lines)


def joint_response(
    joint: str,
    trials: Sequence[Trial],
    rng: np.random.Generator,
    lattice: PollLattice | None = None,
) -> FrequencyResponse:
    """Measure the frequency response of one joint.

    Parameters
    ----------
    joint : str
    trials : sequence of Trial
        All of this joint.
    rng : numpy.random.Generator
        For the bootstrap.
    lattice : PollLattice, optional
        If it has been found already.

    Raises
    ------
    InputError
        If the recording has neither tones nor a multisine.
    """
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
        transfer_functions=fit_transfer_functions(tones, draws),
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
