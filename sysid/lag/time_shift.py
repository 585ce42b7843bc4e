"""Lag of a motion of any kind: the time shift of the held command that resembles it best.

Definition: the lag is the shift τ at which the correlation of y(t) and c(t - τ) over continuous
time is largest; y is the joint's motion, c the command as the bus holds it. For one tone that is
its phase delay. For any other motion it is the phase delay of the cross-spectrum S between command
and position, averaged over frequency f with the weight f² |S(f)|: over the band that was excited.

A staircase read at one phase of the loop correlates alike for every shift within a loop, so
readings and commands are not correlated here. An impulse response is fitted to them
(`sysid.lag.step_response`), and its correlation with the command's own, in continuous time, has its
largest value at the lag. That is as uncertain as the response between two readings.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from pupper_sysid.common.interval import LEVEL
from pupper_sysid.sysid.lag.step_response import LONGEST_S, ImpulseResponse
from pupper_sysid.sysid.recordings.recording import Trial

EARLIEST_S = -0.05
"""Search range of a lag: from here to `LONGEST_S`."""

_STEP_S = 0.002
_NEAR_S = 0.2
_MOST_ROWS = 4000

_Product = tuple[NDArray[np.float64], NDArray[np.float64]]


def shift_draws(response: ImpulseResponse, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draws of the lag that impulse responses and the recording's own command give [s].

    Parameters
    ----------
    response : ImpulseResponse
    rng : numpy.random.Generator
        Where the mass within a bin sits.

    Returns
    -------
    ndarray, shape (draws,)
    """
    edges, masses = response.edges_s, response.masses
    gain = -1.0 if response.gain < 0 else 1.0
    products = [s.autocorrelation(LONGEST_S + edges[-1]) for s in response.stretches]
    everywhere = np.arange(EARLIEST_S, LONGEST_S, 2.5 * _STEP_S)
    # of the mean: draws differ in where they begin, and medians of single bins are no response
    whole = masses.mean(axis=0) @ _correlation(products, edges, everywhere).sum(axis=0)
    centre = everywhere[int(np.argmax(gain * whole))]
    shift = np.arange(max(EARLIEST_S, centre - _NEAR_S), min(LONGEST_S, centre + _NEAR_S), _STEP_S)
    command = _correlation(products, edges, shift)
    draws, blocks = response.weights.shape
    mixed = (response.weights @ command.reshape(blocks, -1)).reshape(draws, *command.shape[1:])
    lag = _peaks(gain * np.einsum("dj,djt->dt", masses, mixed), shift)
    # the response is constant within a bin; a jump may be anywhere in it
    share = np.sqrt(np.sum((masses * np.diff(edges)) ** 2, axis=1) / 12)
    share /= np.maximum(np.abs(masses.sum(axis=1)), 0.1)
    lag = lag + share * rng.standard_normal(draws)
    # few blocks: Student's quantile instead of the normal one
    wider = stdtrit(max(blocks - 1, 1), (1 + LEVEL) / 2) / stdtrit(1e6, (1 + LEVEL) / 2)
    return np.median(lag) + wider * (lag - np.median(lag))


def _correlation(
    products: Sequence[_Product], edges: NDArray, shift_s: NDArray
) -> NDArray[np.float64]:
    """Correlation of the command with its mean over each bin, shape (blocks, bins, shifts)."""
    before = shift_s - edges[:, None]
    parts = []
    for time, product in products:
        step = time[1] - time[0]
        pieces = 0.5 * step * (product[:, 1:] + product[:, :-1])
        area = np.concatenate([np.zeros((len(product), 1)), np.cumsum(pieces, axis=1)], axis=1)
        at = (before - time[0]) / step
        row = np.clip(at.astype(int), 0, len(time) - 2)
        part = np.clip(at - row, 0.0, 1.0)
        inside = area[:, row] + part * (area[:, row + 1] - area[:, row])
        parts.append((inside[:, :-1] - inside[:, 1:]) / np.diff(edges)[:, None])
    return np.concatenate(parts)


def _peaks(score: NDArray, shift: NDArray) -> NDArray[np.float64]:
    """Position of the maximum of each row, refined by the parabola through its top."""
    k = np.clip(np.argmax(score, axis=1), 1, len(shift) - 2)
    row = np.arange(len(score))
    left, top, right = score[row, k - 1], score[row, k], score[row, k + 1]
    bend = left - 2 * top + right
    part = 0.5 * (left - right) / np.where(bend < 0, bend, -np.inf)
    return shift[k] + np.clip(part, -1.0, 1.0) * (shift[1] - shift[0])


def command_hold(trials: Sequence[Trial]) -> float:
    """By how much the held command lags the line through its rows, weighted by its motion [s].

    Half a loop where the loop is even.
    """
    gap = np.concatenate([np.diff(t.send_time_s) for t in trials])
    moved = np.concatenate([np.diff(t.command_rad) for t in trials]) ** 2
    moved = moved if moved.sum() > 0 else np.ones(len(gap))
    return float(0.5 * moved.sum() / np.sum(moved / gap))


def row_shift(
    trial: Trial, time_s: NDArray, position_rad: NDArray, earliest_s: float, latest_s: float
) -> float:
    """Shift at which readings correlate best with the line through the rows' commands [s].

    Parameters
    ----------
    trial : Trial
    time_s, position_rad : ndarray, shape (readings,)
        NaN where a reading is missing.
    earliest_s, latest_s : float
        Search range.

    Returns
    -------
    float
        NaN if there are fewer than 8 readings.
    """
    here = np.flatnonzero(np.isfinite(position_rad))
    if len(here) < 8:
        return float("nan")
    here = here[:: len(here) // _MOST_ROWS + 1]  # bounded, however long the recording
    shift = np.arange(earliest_s, max(latest_s, earliest_s + 4 * _STEP_S), _STEP_S)
    past = np.interp(time_s[here, None] - shift, trial.send_time_s, trial.command_rad)
    past -= past.mean(axis=0)
    y = position_rad[here] - position_rad[here].mean()
    scale = np.sqrt(np.maximum(np.sum(past**2, axis=0), 1e-18))
    return float(_peaks((y @ past / scale)[None], shift)[0])
