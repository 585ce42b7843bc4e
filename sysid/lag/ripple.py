"""Ripple of the staircase in tones that are read at one phase of the loop: `ripple_draws`.

Between two commands a servo moves in ripples of the loop's rate. Readings at one phase of the loop
see the ripple as part of the tone: the staircase's images at multiples of the loop rate f_s, plus
and minus the tone f, are sampled down onto it, the strongest with an amplitude of f / (f_s - f) of
the tone's, damped by the servo. At 30 Hz that is up to some milliseconds of lag.

The ripple is computed from the recording's own staircase and read times for every servo of a grid
of dead times, natural frequencies and damping ratios, each weighted by how well it predicts the
tones as they were read, ripple included. What the tones leave open becomes the draws' spread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import least_squares, phasors
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.lag.held_command import HeldCommand, past_tones
from pupper_sysid.sysid.lag.phase_slope import tone_lags
from pupper_sysid.sysid.lag.step_response import LONGEST_S
from pupper_sysid.sysid.lag.tone import ToneResponse, tone_design
from pupper_sysid.sysid.recordings.recording import Trial

_PER_LOOP = 10  # bins in a loop period
_FINEST_S = 0.001
_GROWTH = 1.1
_BEYOND_S = 0.1
_TIME_CONSTANTS_S = np.geomspace(0.001, 0.3, 16)
_DAMPING = (0.3, 0.5, 0.7, 1.0, 1.5, 2.5)
_DEAD_STEP_S, _DEAD_REACH_S = 0.002, 0.04
_NOT_LINEAR = 0.01  # of a tone's response: no servo is nearer to a linear one
_DRAWS = 400


def without_ripple(
    trials: Sequence[Trial],
    read: Sequence[Readings],
    tones: Sequence[ToneResponse],
    rng: np.random.Generator,
    near_s: float | None = None,
) -> list[ToneResponse]:
    """The tones with their ripple, which `ToneResponse.response` leaves out.

    Parameters
    ----------
    trials : sequence of Trial
    read : sequence of Readings
        Of each trial.
    tones : sequence of ToneResponse
        Found in these trials, at least one.
    rng : numpy.random.Generator
    near_s : float, optional
        As in `phase_slope.tone_lags`.
    """
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    frequency = np.array([t.frequency_hz for t in tones])
    lags = tone_lags(np.array([t.response for t in tones]), frequency, near_s)
    edges = _edges(max(float(lags.max()), 0.0), loop)
    masses = _servos(edges, frequency, lags)
    by_number = {t.number: (t, r) for t, r in zip(trials, read, strict=True)}
    turn = -2j * np.pi * np.outer(frequency, edges)
    own = np.diff(np.exp(turn)) / np.diff(turn)
    ripple = np.stack([_ripple_row(*by_number[t.trial], t, edges) for t in tones])
    held = np.array([t.command_held for t in tones])
    predicted = masses @ (ripple + held[:, None] * own).T
    chance, gain = _chances(predicted, tones)
    seen = gain[:, None] * (masses @ ripple.T)
    drawn = seen[rng.choice(len(chance), _DRAWS, p=chance)]
    picked = [rng.integers(_DRAWS, size=len(t.fresh_draws)) for t in tones]
    return [
        replace(t, ripple=complex(chance @ seen[:, k]), ripple_draws=drawn[picked[0], k])
        for k, t in enumerate(tones)
    ]


def _edges(lag_s: float, loop_s: float) -> NDArray[np.float64]:
    """Bins of past time: fine up to beyond the lag, then growing."""
    width = max(loop_s / _PER_LOOP, _FINEST_S)
    edges = list(np.arange(0.0, lag_s + _BEYOND_S, width))
    while edges[-1] < LONGEST_S:
        width *= _GROWTH
        edges.append(edges[-1] + width)
    return np.array(edges)


def _servos(edges: NDArray, frequency: NDArray, lags: NDArray) -> NDArray[np.float64]:
    """Masses per bin of second-order servos whose lag may be the one seen, shape (servos, bins)."""
    found = []
    for constant in _TIME_CONSTANTS_S:
        for damping in _DAMPING:
            s = 2j * np.pi * frequency * constant
            dynamics = -np.angle(1 / (s * s + 2 * damping * s + 1)) / (2 * np.pi * frequency)
            centre = float(np.mean(lags - dynamics))
            reach = np.arange(-_DEAD_REACH_S, _DEAD_REACH_S, _DEAD_STEP_S)
            dead_time = centre + reach
            dead_time = dead_time[dead_time >= 0]
            past = np.maximum(edges - dead_time[:, None], 0.0) / constant
            found.append(np.diff(_second_order(past, damping), axis=1))
    return np.concatenate(found)


def _second_order(past: NDArray, damping: float) -> NDArray[np.float64]:
    """Step response at times in units of 1 / (natural frequency)."""
    if damping == 1.0:
        return 1 - np.exp(-past) * (1 + past)
    root = np.emath.sqrt(damping**2 - 1)
    slow, fast = -damping + root, -damping - root
    step = 1 + (fast * np.exp(slow * past) - slow * np.exp(fast * past)) / (slow - fast)
    return np.real(step)


def _ripple_row(
    trial: Trial, reading: Readings, tone: ToneResponse, edges: NDArray
) -> NDArray[np.complex128]:
    """Phasor that the tone's fit finds in the images, per unit of mass in each bin."""
    time = reading.time_s[(reading.time_s >= tone.start_s) & (reading.time_s <= tone.stop_s)]
    images = HeldCommand.of(trial).means(time, edges)
    one = np.array([tone.frequency_hz]), np.array([tone.command_held])
    images -= past_tones(time, edges, *one)
    # before the tone was steady the command was no tone
    images = np.where(time[:, None] - edges[1:] >= tone.steady_s, images, 0.0)
    return phasors(least_squares(tone_design(time, tone.frequency_hz), images).T)[:, 0]


def _chances(
    predicted: NDArray, tones: Sequence[ToneResponse]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Probability of each servo and its static gain, from the tones as they were read."""
    seen = np.array([t.fresh for t in tones])
    spread = np.array([np.std(t.fresh_draws) for t in tones])
    weight = 1.0 / (spread**2 + (_NOT_LINEAR * np.abs(seen)) ** 2)
    cross = np.sum(weight * np.real(np.conj(predicted) * seen), axis=1)
    square = np.sum(weight * np.abs(predicted) ** 2, axis=1)
    gain = np.maximum(cross / np.maximum(square, 1e-300), 0.0)
    misfit = np.sum(weight * np.abs(seen - gain[:, None] * predicted) ** 2, axis=1)
    freedom = max(2 * len(tones) - 4, 1)
    scale = max(1.0, float(misfit.min()) / freedom)
    chance = np.exp(-0.5 * (misfit - misfit.min()) / scale)
    return chance / chance.sum(), gain
