"""Response of a servo to one tone: phasors of command and position, with their uncertainty.

A tone `offset + Re(P exp(2πj f t))`, with a third harmonic for the flat tops that friction makes,
is fitted by least squares to readings at irregular times; a bootstrap over its periods gives the
uncertainty (`common.tones`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import block_bootstrap, least_squares, phasors, sine_design
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.lag.held_command import HeldCommand
from pupper_sysid.sysid.recordings.recording import Trial

_ALIASED = 30.0  # condition number beyond which a harmonic looks like the tone or the offset
_GRID_S = 5e-4
_SETTLE_S = 0.2  # after the tone is at full amplitude: several times the servo's slowest pole


@dataclass(frozen=True)
class ToneResponse:
    """Phasors of one trial's tone, of `Re(P exp(2πj f t))`.

    Attributes
    ----------
    trial : int
    frequency_hz : float
        Of the command as it was sent, fitted.
    command_rows, command_held : complex
        Command at the rows' send times, and as the bus holds it between them.
    raw : complex
        Position of all rows, each at its row's send time.
    fresh : complex
        Position of fresh rows at the times they were measured.
    raw_draws, fresh_draws : ndarray of complex, shape (draws,)
        The same under random weights of the periods.
    fresh_count : int
        Fresh rows in the window.
    residual_rad : float
        RMS of the fresh rows about the fitted tone.
    time_sd_s : float
        Standard error of a shift common to all times of measurement.
    start_s, stop_s, steady_s : float
        Window of the fit, and since when the command is this tone.
    ripple : complex
        Part of `fresh` that is ripple of the staircase (`sysid.lag.ripple`); 0 if it was not
        computed.
    ripple_draws : ndarray of complex, shape (draws,)
    """

    trial: int
    frequency_hz: float
    command_rows: complex
    command_held: complex
    raw: complex
    fresh: complex
    raw_draws: NDArray[np.complex128]
    fresh_draws: NDArray[np.complex128]
    fresh_count: int
    residual_rad: float
    time_sd_s: float
    start_s: float
    stop_s: float
    steady_s: float
    ripple: complex = 0j
    ripple_draws: NDArray[np.complex128] | complex = 0j

    @property
    def response(self) -> complex:
        """Frequency response from the held command to the measured motion."""
        return (self.fresh - self.ripple) / self.command_held

    @property
    def response_draws(self) -> NDArray[np.complex128]:
        """Bootstrap draws of `response`."""
        return (self.fresh_draws - self.ripple_draws) / self.command_held

    @property
    def lag_variance_s2(self) -> float:
        """Cramér-Rao bound of one tone's time shift, 2 s² / (N A² ω²), plus the common shift [s²].

        A and ω are the tone's; its N fresh rows scatter by s.
        """
        speed = abs(self.command_held) * 2 * np.pi * self.frequency_hz
        return 2 * (self.residual_rad / speed) ** 2 / self.fresh_count + self.time_sd_s**2


def tone_response(
    trial: Trial,
    reading: Readings,
    rng: np.random.Generator,
    draws: int = 1000,
) -> ToneResponse | None:
    """Fit the tone of `trial`; None if it is no tone or has fewer than two steady periods.

    Parameters
    ----------
    trial : Trial
    reading : Readings
        Of the same trial: when its fresh rows were measured.
    rng : numpy.random.Generator
        Weights the periods.
    draws : int
    """
    if not trial.frequency_hz > 0 or len(reading.rows) < 8:
        return None
    send = trial.send_time_s
    frequency = _command_frequency(trial)
    start = _steady_from(trial, frequency) + _SETTLE_S
    stop = send[-1]
    if (stop - start) * frequency < 1.5:
        return None
    window = (send >= start) & (send <= stop)
    rows = window & np.isfinite(trial.position_rad)
    fresh = (reading.time_s >= start) & (reading.time_s <= stop)
    if rows.sum() < 8 or fresh.sum() < 8:
        return None
    if np.linalg.cond(tone_design(send[rows], frequency)) > _ALIASED:  # two rows per period
        return None

    def fitted(time: NDArray, value: NDArray) -> tuple[complex, NDArray, float]:
        return _fit(time, value, frequency, start, rng, draws)

    raw, raw_draws, _ = fitted(trial.read_time_s[rows], trial.position_rad[rows])
    result, fresh_draws, residual = fitted(reading.time_s[fresh], reading.position_rad[fresh])
    held = _phasor(*HeldCommand.of(trial).levels(start, stop, _GRID_S), frequency)
    sent = _phasor(send[window], trial.command_rad[window], frequency)
    # an error of the poll's phase shifts all times of the trial together
    shift = rng.normal(0.0, reading.time_sd_s, draws)
    fresh_draws = fresh_draws * np.exp(2j * np.pi * frequency * shift)
    return ToneResponse(
        trial.number, frequency, sent, held, raw, result, raw_draws, fresh_draws,
        int(fresh.sum()), residual, reading.time_sd_s, start, stop, start - _SETTLE_S,
    )  # fmt: skip


def tone_design(time_s: NDArray, frequency_hz: float) -> NDArray[np.float64]:
    """Columns for offset, tone and, where the sampling tells it apart, its third harmonic."""
    angle = 2 * np.pi * frequency_hz * time_s
    design = sine_design(angle, 3 * angle)
    return design if np.linalg.cond(design) < _ALIASED else design[:, :3]


def _phasor(time_s: NDArray, value: NDArray, frequency_hz: float) -> complex:
    return complex(phasors(least_squares(tone_design(time_s, frequency_hz), value))[0])


def _fit(
    time: NDArray,
    value: NDArray,
    frequency: float,
    start: float,
    rng: np.random.Generator,
    draws: int,
) -> tuple[complex, NDArray[np.complex128], float]:
    """Phasor, its draws, and the RMS about the fit; blocks are periods."""
    design = tone_design(time, frequency)
    period = np.floor((time - start) * frequency).astype(int)
    # rows that stand alone in a period carry no spread of their own: never fewer than 8 blocks
    fit = block_bootstrap(design, value, period, rng, draws, fewest=8)
    residual = float(np.sqrt(np.mean((design @ fit.solution - value) ** 2)))
    # the spread of few blocks around their own fit is too small by their lost degrees of freedom
    drawn = fit.inflated(np.sqrt(fit.blocks / max(fit.blocks - design.shape[1] / 2, 1.0)))
    return complex(phasors(fit.solution)[0]), phasors(drawn)[:, 0], residual


def _command_frequency(trial: Trial) -> float:
    """Frequency of the command as sent, by Gauss-Newton from the nominal one [Hz]."""
    time, value, frequency = trial.send_time_s, trial.command_rad, trial.frequency_hz
    half = len(time) // 4  # beyond any soft start
    time, value = time[half:], value[half:]
    middle = time.mean()
    for _ in range(4):
        tone = sine_design(2 * np.pi * frequency * (time - middle))
        _, cosine, sine = least_squares(tone, value)
        slope = 2 * np.pi * (time - middle) * (-cosine * tone[:, 2] + sine * tone[:, 1])
        step = least_squares(np.column_stack([tone, slope]), value)[3]
        frequency += float(np.clip(step, -0.02 * frequency, 0.02 * frequency))
    # a command that is no tone at all must not run away
    return frequency if abs(frequency / trial.frequency_hz - 1) < 0.05 else trial.frequency_hz


def _steady_from(trial: Trial, frequency: float) -> float:
    """Time from which the command is the tone at full amplitude [s]."""
    time, value = trial.send_time_s, trial.command_rad
    half = len(time) // 2
    design = tone_design(time, frequency)[:, :3]
    solution = least_squares(design[half:], value[half:])
    wrong = np.abs(design @ solution - value) > 0.05 * np.hypot(solution[1], solution[2])
    last = np.flatnonzero(wrong[:half])
    return float(time[min(last[-1] + 1, len(time) - 1)]) if len(last) else float(time[0])
