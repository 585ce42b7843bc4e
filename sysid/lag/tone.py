"""What a servo does to one tone: phasors of command and position, with honest uncertainty.

A tone `offset + Re(P exp(2πj f t))`, with a third harmonic for friction's flat tops, is fitted by
least squares to readings at irregular times. Because the normal equations of a trial are sums over
periods, weighting the periods at random (a Bayesian bootstrap) repeats the fit a thousand times
for the price of one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.recordings.recording import Trial

HARMONICS = (1, 3)
_ALIASED = 30.0  # condition number beyond which a harmonic looks like the tone or the offset
_SETTLE_S = 0.2  # after the tone is at full amplitude: several times the servo's slowest pole


@dataclass(frozen=True)
class ToneResponse:
    """One trial's tone, seen three ways. Phasors are of `Re(P exp(2πj f t))`.

    Attributes
    ----------
    trial : int
    frequency_hz : float
        Of the command as it was sent, fitted.
    command_rows, command_held : complex
        Command at the rows' send times, and as the bus holds it between them.
    naive : complex
        Position of all rows, each at its row's send time: what a spreadsheet would do.
    fresh : complex
        Position of fresh rows at the times they were measured.
    naive_draws, fresh_draws : ndarray of complex, shape (draws,)
        The same under random weights of the periods.
    fresh_count : int
        Fresh rows in the window.
    residual_rad : float
        RMS of the fresh rows about the fitted tone.
    time_sd_s : float
        Standard error of a shift common to all times of measurement.
    """

    trial: int
    frequency_hz: float
    command_rows: complex
    command_held: complex
    naive: complex
    fresh: complex
    naive_draws: NDArray[np.complex128]
    fresh_draws: NDArray[np.complex128]
    fresh_count: int
    residual_rad: float
    time_sd_s: float

    @property
    def response(self) -> complex:
        """Frequency response from the held command to the motion the host sees."""
        return self.fresh / self.command_held

    @property
    def response_draws(self) -> NDArray[np.complex128]:
        """Bootstrap draws of `response`."""
        return self.fresh_draws / self.command_held

    @property
    def lag_variance_s2(self) -> float:
        """Cramér-Rao bound of one tone's time shift, 2 s² / (N A² ω²), plus the common shift [s²].

        A and ω are the tone's; its N fresh rows scatter by s.
        """
        speed = abs(self.command_held) * 2 * np.pi * self.frequency_hz
        return 2 * (self.residual_rad / speed) ** 2 / self.fresh_count + self.time_sd_s**2


def tone_response(
    trial: Trial, reading: Readings, rng: np.random.Generator, draws: int = 1000
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
    if np.linalg.cond(_design(send[rows], frequency)) > _ALIASED:  # two rows per period
        return None

    def phasors(time: NDArray, value: NDArray) -> tuple[complex, NDArray, float]:
        return _fit(time, value, frequency, start, rng, draws)

    naive, naive_draws, _ = phasors(send[rows], trial.position_rad[rows])
    result, fresh_draws, residual = phasors(reading.time_s[fresh], reading.position_rad[fresh])
    grid = np.arange(start, stop, 5e-4)
    row = np.clip(np.searchsorted(send, grid, side="right") - 1, 0, None)
    held = fit_phasor(grid, trial.command_rad[row], frequency)
    sent = fit_phasor(send[window], trial.command_rad[window], frequency)
    # an error of the poll's phase shifts all times of the trial together
    shift = rng.normal(0.0, reading.time_sd_s, draws)
    fresh_draws = fresh_draws * np.exp(2j * np.pi * frequency * shift)
    return ToneResponse(
        trial.number, frequency, sent, held, naive, result, naive_draws, fresh_draws,
        int(fresh.sum()), residual, reading.time_sd_s,
    )  # fmt: skip


def fit_phasor(time_s: NDArray, value: NDArray, frequency_hz: float) -> complex:
    """Least-squares phasor of `value` at `frequency_hz`, beside an offset and a third harmonic."""
    design = _design(time_s, frequency_hz)
    solution = np.linalg.lstsq(design, value, rcond=None)[0]
    return complex(solution[1], -solution[2])


def _design(time_s: NDArray, frequency_hz: float) -> NDArray[np.float64]:
    """Offset, tone and, where the sampling lets it be seen, its third harmonic."""
    angle = 2 * np.pi * frequency_hz * time_s
    columns = [np.ones_like(time_s)]
    for n in HARMONICS:
        columns += [np.cos(n * angle), np.sin(n * angle)]
    design = np.stack(columns, axis=1)
    return design if np.linalg.cond(design) < _ALIASED else design[:, :3]


def _fit(
    time: NDArray,
    value: NDArray,
    frequency: float,
    start: float,
    rng: np.random.Generator,
    draws: int,
) -> tuple[complex, NDArray[np.complex128], float]:
    design = _design(time, frequency)
    block = np.floor((time - start) * frequency).astype(int)
    names, block = np.unique(block, return_inverse=True)
    gram = np.zeros((len(names), design.shape[1], design.shape[1]))
    moment = np.zeros((len(names), design.shape[1]))
    np.add.at(gram, block, design[:, :, None] * design[:, None, :])
    np.add.at(moment, block, design * value[:, None])
    solution = np.linalg.solve(gram.sum(0), moment.sum(0))
    residual = float(np.sqrt(np.mean((design @ solution - value) ** 2)))
    # Rows that stand alone in a period carry no spread of their own: never fewer than 8 blocks
    if len(names) < 8:
        return (*_fit_blocks(design, value, solution, 8, rng, draws), residual)
    weights = rng.exponential(size=(draws, len(names)))
    return (*_weighted(gram, moment, weights, solution), residual)


def _fit_blocks(
    design: NDArray,
    value: NDArray,
    solution: NDArray,
    count: int,
    rng: np.random.Generator,
    draws: int,
) -> tuple[complex, NDArray[np.complex128]]:
    """As `_fit`, over `count` runs of neighbouring rows where there are too few periods."""
    parts = np.array_split(np.arange(len(value)), count)
    gram = np.stack([design[p].T @ design[p] for p in parts])
    moment = np.stack([design[p].T @ value[p] for p in parts])
    weights = rng.exponential(size=(draws, count))
    return _weighted(gram, moment, weights, solution)


def _weighted(
    gram: NDArray, moment: NDArray, weights: NDArray, solution: NDArray
) -> tuple[complex, NDArray[np.complex128]]:
    grams = np.tensordot(weights, gram, axes=1)
    moments = weights @ moment
    drawn = np.linalg.solve(grams, moments[..., None])[..., 0]
    blocks, columns = len(gram), gram.shape[1]
    # the spread of few blocks around their own fit is too small by their lost degrees of freedom
    inflate = np.sqrt(blocks / max(blocks - columns / 2, 1.0))
    drawn = solution + inflate * (drawn - solution)
    return complex(solution[1], -solution[2]), drawn[:, 1] - 1j * drawn[:, 2]


def _command_frequency(trial: Trial) -> float:
    """Frequency of the command as sent, by Gauss-Newton from the nominal one [Hz]."""
    time, value, frequency = trial.send_time_s, trial.command_rad, trial.frequency_hz
    half = len(time) // 4  # beyond any soft start
    time, value = time[half:], value[half:]
    middle = time.mean()
    for _ in range(4):
        angle = 2 * np.pi * frequency * (time - middle)
        c, s = np.cos(angle), np.sin(angle)
        linear = np.linalg.lstsq(np.stack([np.ones_like(c), c, s], 1), value, rcond=None)[0]
        slope = 2 * np.pi * (time - middle) * (-linear[1] * s + linear[2] * c)
        design = np.stack([np.ones_like(c), c, s, slope], 1)
        step = np.linalg.lstsq(design, value, rcond=None)[0][3]
        frequency += float(np.clip(step, -0.02 * frequency, 0.02 * frequency))
    # a command that is no tone at all must not run away
    return frequency if abs(frequency / trial.frequency_hz - 1) < 0.05 else trial.frequency_hz


def _steady_from(trial: Trial, frequency: float) -> float:
    """Time from which the command is the tone at full amplitude [s]."""
    time, value = trial.send_time_s, trial.command_rad
    half = len(time) // 2
    design = _design(time, frequency)[:, :3]
    solution = np.linalg.lstsq(design[half:], value[half:], rcond=None)[0]
    wrong = np.abs(design @ solution - value) > 0.05 * np.hypot(solution[1], solution[2])
    last = np.flatnonzero(wrong[:half])
    return float(time[min(last[-1] + 1, len(time) - 1)]) if len(last) else float(time[0])
