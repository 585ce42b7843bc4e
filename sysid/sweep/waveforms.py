"""Shapes of a motion over time: offsets from the start pose [rad] at times [s] since its start."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.loop import minimum_jerk, raised_cosine

Offset = Callable[[NDArray[np.float64]], NDArray[np.float64]]

PRBS_CLOCK_S = 0.11
"""Time between possible changes of a pseudo-random binary sequence [s]."""

FASTEST_OF_MINIMUM_JERK = 1.875
"""Highest speed of a minimum-jerk motion, as a multiple of its mean speed."""


def after(lead_in_s: float, offset: Offset) -> Offset:
    """`offset` after a rest."""

    def shifted(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        time_s = np.asarray(time_s, float) - lead_in_s
        return np.where(time_s > 0, offset(np.maximum(time_s, 0.0)), 0.0)

    return shifted


def scaled(offset: Offset, factor: float) -> Offset:
    """`factor` times `offset`."""
    return lambda t: factor * offset(t)


def sine(frequency_hz: float, amplitude: float) -> Offset:
    """Tone that grows over its first half period."""
    # full amplitude after half a period: smooth, and still an onset that excites the dynamics
    return lambda t: (
        amplitude * raised_cosine(2 * frequency_hz * t) * np.sin(2 * np.pi * frequency_hz * t)
    )


def square(frequency_hz: float, amplitude: float) -> Offset:
    """Square wave."""
    return lambda t: amplitude * np.where((t * frequency_hz) % 1.0 < 0.5, 1.0, -1.0)


def chirp(low: float, high: float, duration_s: float, amplitude: float, top_speed: float) -> Offset:
    """Logarithmic chirp from `low` to `high` Hz, its speed bounded by `top_speed`."""

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        rate = np.log(high / low) / duration_s
        grown = np.exp(rate * t)
        cycles = low * t if rate == 0 else low * (grown - 1) / rate
        bounded = np.minimum(amplitude, top_speed / (2 * np.pi * low * grown))
        return bounded * raised_cosine(2 * low * t) * np.sin(2 * np.pi * cycles)

    return offset


def multisine(frequencies: Sequence[float]) -> Offset:
    """Equal amplitudes, Schroeder phases (IEEE Trans. Inf. Theory 16, 1970): a low crest factor."""
    f = np.array(frequencies)
    k = np.arange(1, len(f) + 1)
    phase = -np.pi * k * (k - 1) / len(f)

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        tones = np.sin(2 * np.pi * f * np.asarray(t)[:, None] + phase)
        return raised_cosine(2 * f.min() * np.asarray(t)) * tones.sum(axis=-1)

    return offset


def peaks(offset: Offset, lowest_hz: float) -> tuple[float, float]:
    """Largest excursion and speed of `offset` over 20 of its longest periods."""
    t = np.arange(0.0, 20.0 / lowest_hz, 0.001)
    value = offset(t)
    return float(np.abs(value).max()), float(np.abs(np.diff(value)).max() / 0.001)


def steps(amplitude: float) -> tuple[Offset, float]:
    """Steps up and down in three sizes, and the duration of one pass [s]."""
    levels = amplitude * np.array([1, 0, -1, 0, 2, 0, -2, 0, 3, 0, -3, 3, -3, 0]) / 3
    # golden-ratio holds of 0.45 to 0.75 s: edges meet loop and poll at ever different phases
    holds = 0.45 + 0.3 * ((np.arange(len(levels)) * (np.sqrt(5) - 1) / 2) % 1.0)
    edges = np.concatenate([[0.0], np.cumsum(holds)])

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        index = np.searchsorted(edges, np.asarray(t) % edges[-1], side="right") - 1
        return levels[index]

    return offset, float(edges[-1])


def prbs(amplitude: float) -> Offset:
    """Pseudo-random binary sequence of 127 bits (x⁷ + x⁶ + 1), after a start at rest."""
    state, bits = 0x5A, []
    for _ in range(127):
        bits.append(state & 1)
        state = state >> 1 | ((state ^ state >> 1) & 1) << 6
    levels = amplitude * (2.0 * np.array(bits) - 1.0)

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        return levels[(np.asarray(t) / PRBS_CLOCK_S).astype(int) % len(levels)]

    return offset


def strokes(amplitude: float, speeds_rad_s: Sequence[float], times: int) -> tuple[Offset, float]:
    """Triangles between ± `amplitude`, `times` at each speed, and their duration [s].

    They begin and end at 0.
    """
    corners, at = [(0.0, 0.0)], 0.0
    for speed in speeds_rad_s:
        for level in [amplitude, -amplitude] * times:
            at += abs(level - corners[-1][1]) / speed
            corners.append((at, level))
    at += amplitude / speeds_rad_s[-1]
    corners.append((at, 0.0))
    time, level = np.array(corners).T
    return (lambda t: np.interp(t, time, level)), float(at)


def lift(height: float, duration_s: float) -> Offset:
    """Minimum-jerk motion to `height` within `duration_s`, held there."""
    return lambda t: height * minimum_jerk(np.asarray(t, float) / duration_s)
