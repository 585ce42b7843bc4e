"""Frequency response of one joint: gain and phase per tone, bandwidth, fitted transfer functions.

Every tone of a sweep gives one complex number, the response from the command as held to the motion
as measured, with a covariance from the bootstrap over periods. The describing gain belongs to the
amplitude it was measured at: friction and the speed limit make a servo's gain depend on it.

The fits over them are in `sysid.transfer_function`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control
import numpy as np
from numpy.typing import NDArray

from common.errors import InputError
from sysid.delay import LEVEL, Interval, tone_lags
from sysid.multisine import multisine_responses
from sysid.poll_lattice import PollLattice, find_poll_lattice, readings
from sysid.recording import Trial
from sysid.tone import ToneResponse, tone_response
from sysid.transfer_function import FORMS, TransferFunction, fit_transfer_function


@dataclass(frozen=True)
class FrequencyResponse:
    """Measured response of one joint; arrays are over its tones, by frequency.

    Attributes
    ----------
    frequency_hz, amplitude_rad : ndarray
    response, naive_response : ndarray of complex
        Of fresh readings against the held command; of all rows against their commands.
    covariance : ndarray, shape (tones, 2, 2)
        Of the response's real and imaginary parts.
    bandwidth_hz : Interval or None
        Where the gain falls below -3 dB of the lowest tone's; None if no tone reaches that. An
        upper end of infinity lies above the highest tone.
    fits : tuple of TransferFunction
        Those with fewer parameters than there are numbers measured.
    """

    joint: str
    frequency_hz: NDArray[np.float64]
    amplitude_rad: NDArray[np.float64]
    response: NDArray[np.complex128]
    naive_response: NDArray[np.complex128]
    covariance: NDArray[np.float64]
    bandwidth_hz: Interval | None
    fits: tuple[TransferFunction, ...]

    @property
    def gain(self) -> NDArray[np.float64]:
        """Describing gain, response amplitude over command amplitude."""
        return np.abs(self.response)

    @property
    def phase_deg(self) -> NDArray[np.float64]:
        """Phase [degrees], unwrapped by the lag that all tones share."""
        return -360.0 * self.frequency_hz * tone_lags(self.response, self.frequency_hz)

    def frd(self) -> control.FrequencyResponseData:
        """The measurement as python-control holds it, over rad/s."""
        return control.frd(self.response, 2 * np.pi * self.frequency_hz)

    def bandwidth_text(self) -> str:
        """The bandwidth in words."""
        if np.ptp(self.frequency_hz) < 0.01:
            return "unknown, for there is one frequency only"
        if self.bandwidth_hz is None:
            return f"above {self.frequency_hz[-1]:.1f} Hz, the highest tone"
        b = self.bandwidth_hz
        high = f"{b.high:.1f}" if np.isfinite(b.high) else f"above {self.frequency_hz[-1]:.1f}"
        return f"{b.value:.1f} Hz ({b.low:.1f} … {high})"

    def summary(self) -> str:
        """Table and fits as plain text."""
        lines = ["    Hz  amplitude rad   gain      dB  phase °  naive gain"]
        for row in zip(
            self.frequency_hz, self.amplitude_rad, self.gain, 20 * np.log10(self.gain),
            self.phase_deg, np.abs(self.naive_response), strict=True,
        ):  # fmt: skip
            lines.append("{:6.2f} {:14.3f} {:6.3f} {:+7.2f} {:8.1f} {:11.3f}".format(*row))
        lines.append(f"  −3 dB bandwidth: {self.bandwidth_text()}")
        for fit in self.fits:
            lines.append(f"  {fit.name}: {fit}   (chi²/dof {fit.chi2_per_dof:.1f})")
            if fit.at_bound:
                names = ", ".join(n.replace("_", " ") for n in fit.at_bound)
                lines.append(f"    on its bound, so without meaning: {names}")
        return "\n".join(lines)


def frequency_response(
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
    lattice = lattice or find_poll_lattice(trials)
    tones: list[ToneResponse] = []
    for trial in trials:
        reading = readings(trial, lattice)
        if trial.frequency_hz > 0:
            tone = tone_response(trial, reading, rng)
            tones += [] if tone is None else [tone]
        else:
            tones += multisine_responses(trial, reading, rng)
    if not tones:
        raise InputError(
            f"{joint}: this recording has no tone of two periods or more, and no multisine, so "
            "there is no frequency response to show. Was the joint moving? Record tones with "
            "`pupper-sysid sweep --freqs 1-10`."
        )
    tones.sort(key=lambda t: t.frequency_hz)
    frequency = np.array([t.frequency_hz for t in tones])
    response = np.array([t.response for t in tones])
    draws = np.stack([t.response_draws for t in tones])
    different = len({round(t.frequency_hz, 2) for t in tones})
    return FrequencyResponse(
        joint,
        frequency,
        np.array([abs(t.command_held) for t in tones]),
        response,
        np.array([t.naive / t.command_rows for t in tones]),
        np.stack([np.cov(d.real, d.imag) for d in draws]),
        _bandwidth(frequency, response, draws),
        tuple(
            fit_transfer_function(name, frequency, response, draws)
            for name, form in FORMS.items()
            if 2 * different > len(form.names)
        ),
    )


def to_json(found: FrequencyResponse) -> dict[str, Any]:
    """Object of one joint in `bode --json`."""
    bandwidth = found.bandwidth_hz
    return {
        "by_frequency": [
            {
                "frequency_hz": f, "amplitude_rad": a, "gain": g, "phase_deg": p,
                "naive_gain": n, "covariance": c.tolist(),
            }
            for f, a, g, p, n, c in zip(
                found.frequency_hz, found.amplitude_rad, found.gain, found.phase_deg,
                np.abs(found.naive_response), found.covariance, strict=True,
            )
        ],
        "bandwidth_hz": None if bandwidth is None else bandwidth.value,
        "bandwidth_ci_hz": (
            None if bandwidth is None else [_finite(bandwidth.low), _finite(bandwidth.high)]
        ),
        "bandwidth_text": found.bandwidth_text(),
        "transfer_functions": {
            fit.name: {
                "parameters": {n: p.value for n, p in fit.parameters.items()},
                "intervals": {n: [p.low, p.high] for n, p in fit.parameters.items()},
                "chi2_per_dof": fit.chi2_per_dof,
                "at_bound": list(fit.at_bound),
                "text": str(fit),
            }
            for fit in found.fits
        },
    }  # fmt: skip


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _bandwidth(
    frequency: NDArray[np.float64], response: NDArray[np.complex128], draws: NDArray[np.complex128]
) -> Interval | None:
    def crossing(gain: NDArray) -> float:
        below = np.flatnonzero(gain < gain[0] / np.sqrt(2))
        if not len(below):
            return float("inf")
        k = below[0]
        target = 0.5 * np.log(0.5) + np.log(gain[0])
        rise = np.log(gain[k - 1 : k + 1])
        share = (rise[0] - target) / (rise[0] - rise[1])
        return float(frequency[k - 1] + share * (frequency[k] - frequency[k - 1]))

    value = crossing(np.abs(response))
    if not np.isfinite(value):
        return None
    # a draw that never crosses is an infinite one: left out, it would make the interval too sure
    drawn = np.sort([crossing(g) for g in np.abs(draws).T])
    low, high = (round(q * (len(drawn) - 1)) for q in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(value, float(drawn[low]), float(drawn[high]))
