"""Frequency of a rhythm, and the share of a signal that a sine explains.

A frequency is estimated from at least five seconds, with an interval, not read off a spectrum of
one second, whose bins are 1 Hz apart. A sine's R² is given with that of noise (`null_r2`): the best
of many sines explains a good part of any slow signal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter
from scipy.stats import t as student_t

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.tones import fit_sine, least_squares, sine_design

Array = NDArray[np.float64]
Signal = NDArray[np.floating] | NDArray[np.bool_]

SHORTEST_S = 5.0
"""Shortest signal whose frequency is estimated [s]."""

_SLOWEST_HZ = 0.5  # what is slower is drift: a leg of 0.1 m swings freely at 1.6 Hz
STILL = 1e-9
"""Deviation below which a signal does not move, in its own unit."""
_FEWEST_PHASES = 6
_WALKS = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 29)])


UNKNOWN = Interval(float("nan"), float("nan"), float("nan"))
"""Of a quantity without a value."""


def frequency(signal: Signal, step_s: float) -> Interval:
    """Common gait frequency of several channels: the mean rate of their common phase [Hz].

    The search begins at the best common sine (`sine_frequency`). Every stride then gives one phase,
    by least squares of a sine, a cosine and an offset over all channels, weighted by how well the
    sine fits them and without the second harmonic of the whole signal; the slope of these phases is
    the frequency. The line has two kinds of error: white ones, from noise on the signal, and a
    random walk, since a gait keeps no clock. Their ratio follows from restricted maximum
    likelihood, the line from generalised least squares, its 90 % interval from Student's t.

    Residuals of the sine alone give intervals that cover 20-40 % where the rhythm itself wanders.
    This interval covers 91-98 % for noise on a steady rhythm and 70-88 % for one that wanders,
    which a few seconds hardly show.

    The signal has the shape (steps, channels).
    """
    best = sine_frequency(signal, step_s)
    y = standardised(signal)
    steps, time = len(y), times(len(y), step_s)
    angle = 2 * np.pi * best * time
    design = sine_design(angle, 2 * angle)
    whole = least_squares(design, y)
    y = y - design[:, 3:] @ whole[3:]
    phasor = whole[1] - 1j * whole[2]
    strides = max(_FEWEST_PHASES, int(steps * step_s * best))
    parts = np.array_split(np.arange(steps), strides)
    ahead = np.zeros(strides, complex)
    for k, part in enumerate(parts):
        # with its own offset, or slow noise would leak into the phases
        ahead[k] = (fit_sine(angle[part], y[part]).phasor * phasor.conj()).sum()
    middle = np.array([time[part].mean() for part in parts])
    slope, error = _slope(np.unwrap(np.angle(ahead)), middle)
    rate, half = best + slope / (2 * np.pi), t_quantile(strides - 2) * error / (2 * np.pi)
    return Interval(rate, rate - half, rate + half)


def sine_frequency(signal: Signal, step_s: float) -> float:
    """Frequency of the sine that explains most of several channels, each with its own phase [Hz].

    Maximises the mean R² over channels, between 0.5 Hz and a quarter of the sampling rate: the
    highest point of a periodogram padded to eighths of a bin, refined continuously. A gait and its
    harmonics differ by their size only.

    The signal has the shape (steps, channels).
    """
    y = standardised(signal)
    if len(y) < int(SHORTEST_S / step_s + 1e-9):  # whole steps, of any control rate
        raise InputError(
            f"A signal of {len(y) * step_s:.2f} s is too short for a gait's frequency: "
            f"{SHORTEST_S:g} s are needed."
        )
    if not y.any():
        raise InputError("Nothing moves in this signal: it has no frequency.")
    coarse, within = _peak(y, step_s), 0.5 / (len(y) * step_s)
    low, high = max(coarse - within, _SLOWEST_HZ), min(coarse + within, 0.25 / step_s)
    found: Any = minimize_scalar(
        lambda f: -sine_fit_r2(y, step_s, f).sum(),
        bounds=(low, high), method="bounded", options={"xatol": 1e-7},
    )  # fmt: skip
    return float(found.x)


def sine_fit_r2(signal: Signal, step_s: float, frequency_hz: float) -> Array:
    """R² of the least-squares sine of one frequency, with its own phase and offset per channel.

    The signal has the shape (steps, channels). R² has the shape (channels,); it is 0 for a channel
    that does not move.
    """
    y = standardised(signal)
    design = sine_design(2 * np.pi * frequency_hz * times(len(y), step_s))
    left = y - design @ least_squares(design, y)
    moves = np.any(y, axis=0)
    return np.where(moves, 1.0 - (left**2).mean(axis=0), 0.0)


def null_r2(signal: Signal, step_s: float, rng: np.random.Generator, draws: int = 200) -> Array:
    """R² of the best common sine in noise like a signal, but without a rhythm.

    The noise is AR(1) with each channel's own autocorrelation at one step, its innovations
    correlated between channels as the channels are.

    The signal has the shape (steps, channels). R² has the shape (draws, channels), each draw at its
    own best frequency.
    """
    y = standardised(signal)
    steps, channels = y.shape
    memory = np.clip((y[1:] * y[:-1]).mean(axis=0), -0.999, 0.999)
    variance, axes = np.linalg.eigh(y.T @ y / steps)
    mix = (axes * np.sqrt(np.clip(variance, 0.0, None))).T
    found = np.zeros((draws, channels))
    for row in found:
        pushes = rng.standard_normal((steps, channels)) @ mix
        # stationary from the first step, or that would look like a slow oscillation
        pushes[0] /= np.sqrt(1.0 - memory**2)
        noise = np.stack(
            [lfilter([1.0], [1.0, -m], x) for m, x in zip(memory, pushes.T, strict=True)], axis=1
        )
        row[:] = sine_fit_r2(noise, step_s, _peak(standardised(noise), step_s))
    return found


def standardised(signal: Signal) -> Array:
    """Each channel about its mean, in units of its deviation; zeros if it stands still."""
    y = np.asarray(signal, float)
    deviation = y.std(axis=0)
    return (y - y.mean(axis=0)) / np.where(deviation > STILL, deviation, np.inf)


def times(steps: int, step_s: float) -> Array:
    """Times about the middle [s], where offset, phase and frequency hardly correlate."""
    return step_s * (np.arange(steps, dtype=float) - (steps - 1) / 2)


def t_quantile(freedom: int) -> float:
    """Half width of a 90 % interval in standard errors."""
    return float(student_t.ppf((1 + LEVEL) / 2, freedom))


def mean_of(values: Array) -> Interval:
    """Mean of the finite values, with its 90 % interval by Student's t."""
    values = values[np.isfinite(values)]
    if not len(values):
        return UNKNOWN
    mean = float(values.mean())
    half = float("nan")
    if len(values) > 1:
        half = t_quantile(len(values) - 1) * float(values.std(ddof=1) / np.sqrt(len(values)))
    return Interval(mean, mean - half, mean + half)


def _peak(y: Array, step_s: float) -> float:
    """Highest point of the periodogram, all channels together [Hz]."""
    size = 1 << (8 * len(y) - 1).bit_length()
    at = np.fft.rfftfreq(size, step_s)
    power = (np.abs(np.fft.rfft(y, size, axis=0)) ** 2).sum(axis=1)
    power[(at < _SLOWEST_HZ) | (at > 0.25 / step_s)] = -1.0
    return float(at[power.argmax()])


def _slope(phase: Array, time: Array) -> tuple[float, float]:
    """Slope of a phase with white errors and a random walk, and its standard error."""
    count = len(phase)
    line = np.stack([np.ones(count), time], axis=1)
    steps = np.arange(count)
    walk = np.minimum.outer(steps, steps).astype(float)
    # restricted likelihood: of what no straight line explains, along axes that both errors share
    free = null_space(line.T)
    spread, axes = np.linalg.eigh(free.T @ walk @ free)
    error = (free @ axes).T @ phase
    scale = 1.0 + _WALKS[:, None] * spread
    misfit = (error**2 / scale).sum(axis=1) + np.finfo(float).tiny
    likelihood = -np.log(scale).sum(axis=1) - len(error) * np.log(misfit)
    best = int(likelihood.argmax())
    factor = np.linalg.cholesky(np.eye(count) + _WALKS[best] * walk)
    white = np.linalg.solve(factor, line)
    covariance = np.linalg.inv(white.T @ white) * misfit[best] / len(error)
    found = np.linalg.lstsq(white, np.linalg.solve(factor, phase), rcond=None)[0]
    return float(found[1]), float(np.sqrt(covariance[1, 1]))
