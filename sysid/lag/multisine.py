"""Responses of one trial at every frequency of its command: tones in turn, or a multisine.

`line_responses` fits the tones that a log names or that are found in its command, one after the
other (`sysid.lag.tone`), and else the lines of a multisine (`multisine_responses`). Those lines are
found in the command: the strongest is fitted and subtracted until next to nothing is left. A chirp,
steps or a walk leave too much and are no multisine. Enough lines fit any motion within its own
time, so those of a multisine must also predict each half of the command from the other half, and
the motion of the joint must be at these frequencies. All lines are then fitted to the fresh
readings together, because sines at irregular times are not orthogonal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import block_bootstrap, least_squares, phasors, sine_design
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.lag.held_command import HeldCommand
from pupper_sysid.sysid.lag.tone import ToneResponse, tone_response
from pupper_sysid.sysid.recordings.excitation import split_tones
from pupper_sysid.sysid.recordings.recording import Trial

_MOST_LINES = 24
_LEFT_OVER = 0.005  # of the command's variance: quantisation, no signal
_APART = 1.5  # periods over the trial: closer lines are what a random motion looks like
_LEAST_PERIODS = 1.9  # of a line, over the trial
_UNPREDICTED = 0.05  # of the command's variance, in one half from the other
_INCOHERENT = 0.3  # of the readings' variance: motion at other frequencies
_SETTLE_S = 0.5  # past the soft start: several times the servo's slowest pole
_ROWS_PER_UNKNOWN = 3
_BLOCK_S = 0.5
_GRID_S = 1e-3


def line_responses(trial: Trial, reading: Readings, rng: np.random.Generator) -> list[ToneResponse]:
    """Response at every frequency that the command of `trial` is made of; empty if it is of none.

    Parameters
    ----------
    trial : Trial
    reading : Readings
        Of the same trial: when its fresh rows were measured.
    rng : numpy.random.Generator
        Weights the periods.
    """
    parts = split_tones(trial)
    if not parts[0].frequency_hz > 0:
        return multisine_responses(trial, reading, rng)
    tones = [tone_response(part, reading, rng) for part in parts]
    return [tone for tone in tones if tone is not None]


def multisine_responses(
    trial: Trial, reading: Readings, rng: np.random.Generator, draws: int = 400
) -> list[ToneResponse]:
    """Response at each line of the command of `trial`; empty if it is no multisine.

    Parameters
    ----------
    trial : Trial
    reading : Readings
        Of the same trial: when its fresh rows were measured.
    rng : numpy.random.Generator
        Weights stretches of half a second for the draws.
    draws : int
    """
    send = trial.send_time_s
    if len(send) < 100 or np.ptp(trial.command_rad) < 1e-3:
        return []
    first = send[0] + 0.15 * (send[-1] - send[0])
    lines = _lines(send[send >= first], trial.command_rad[send >= first])
    if not len(lines):
        return []
    start = first + _SETTLE_S
    rows = (send >= start) & np.isfinite(trial.position_rad)
    fresh = (reading.time_s >= start) & (reading.time_s <= send[-1])
    unknown = 1 + 2 * len(lines)
    if min(fresh.sum(), rows.sum()) < _ROWS_PER_UNKNOWN * unknown:
        return []
    command_held = _phasors(*HeldCommand.of(trial).levels(start, send[-1], _GRID_S), lines)
    command_rows = _phasors(send[rows], trial.command_rad[rows], lines)
    raw = _draw(trial.read_time_s[rows], trial.position_rad[rows], lines, rng, draws)
    measured = _draw(reading.time_s[fresh], reading.position_rad[fresh], lines, rng, draws)
    if measured[2] ** 2 > _INCOHERENT * float(np.var(reading.position_rad[fresh])):
        return []
    shift = rng.normal(0.0, reading.time_sd_s, draws)
    return [
        ToneResponse(
            trial.number, float(f), complex(command_rows[k]), complex(command_held[k]),
            complex(raw[0][k]), complex(measured[0][k]), raw[1][:, k],
            measured[1][:, k] * np.exp(2j * np.pi * f * shift),
            int(fresh.sum()), measured[2], reading.time_sd_s, start, send[-1], first,
        )
        for k, f in enumerate(lines)
    ]  # fmt: skip


def _lines(time: NDArray[np.float64], command: NDArray[np.float64]) -> NDArray[np.float64]:
    """Frequencies of the command's lines [Hz], rising; empty if lines do not explain it."""
    loop, span = float(np.median(np.diff(time))), float(time[-1] - time[0])
    even = np.arange(time[0], time[-1], loop)
    spectrum_hz = np.fft.rfftfreq(8 * len(even), loop)
    usable = spectrum_hz > 1.0 / span
    variance = float(np.var(command))
    lines, left = np.zeros(0), command - command.mean()
    while np.var(left) > _LEFT_OVER * variance:
        if len(lines) == _MOST_LINES:
            return np.zeros(0)
        strength = np.abs(np.fft.rfft(np.interp(even, time, left), 8 * len(even)))
        lines = np.append(lines, spectrum_hz[int(np.argmax(strength * usable))])
        lines, left = _sharpened(time, command, lines)
        if len(lines) > 1 and np.min(np.diff(np.sort(lines))) < _APART / span:
            return np.zeros(0)
    if np.min(lines, initial=np.inf) < _LEAST_PERIODS / span or not _predicts(time, command, lines):
        return np.zeros(0)
    return np.sort(lines)


def _predicts(time: NDArray, command: NDArray, lines: NDArray) -> bool:
    """Whether the lines as fitted to one half of the command go on in the other half."""
    half = time < 0.5 * (time[0] + time[-1])
    for known, other in ((half, ~half), (~half, half)):
        solution = least_squares(_design(time[known], lines), command[known])
        wrong = command[other] - _design(time[other], lines) @ solution
        if np.mean(wrong**2) > _UNPREDICTED * np.var(command):
            return False
    return True


def _sharpened(
    time: NDArray[np.float64], command: NDArray[np.float64], lines: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lines after two Gauss-Newton steps on their frequencies, and the residual."""
    clock, farthest = time - time.mean(), 0.25 / float(np.ptp(time))
    for _ in range(2):
        turning = _phasors(clock, command, lines) * np.exp(2j * np.pi * np.outer(clock, lines))
        slopes = (2j * np.pi * clock[:, None] * turning).real
        design = np.hstack([_design(clock, lines), slopes])
        step = least_squares(design, command)[1 + 2 * len(lines) :]
        lines = lines + np.clip(step, -farthest, farthest)
    design = _design(clock, lines)
    return lines, command - design @ least_squares(design, command)


def _design(time: NDArray, lines: NDArray) -> NDArray[np.float64]:
    return sine_design(*(2 * np.pi * np.outer(lines, time)))


def _phasors(time: NDArray, value: NDArray, lines: NDArray) -> NDArray[np.complex128]:
    return phasors(least_squares(_design(time, lines), value))


def _draw(
    time: NDArray, value: NDArray, lines: NDArray, rng: np.random.Generator, draws: int
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], float]:
    """Phasors at all lines, draws of them, and the RMS about the fit."""
    design = _design(time, lines)
    fit = block_bootstrap(
        design, value, np.floor((time - time[0]) / _BLOCK_S).astype(int), rng, draws
    )
    left = design @ fit.solution - value
    # what was fitted away from the residuals is missing from their spread
    inflate = np.sqrt(len(value) / (len(value) - design.shape[1]))
    return (
        phasors(fit.solution),
        phasors(fit.inflated(inflate)),
        float(inflate * np.sqrt(np.mean(left**2))),
    )
