"""Gentle ways from pose to pose, at the rate of a control loop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hardware.loop import FixedRateLoop

GENTLE_RAD_S = 1.0
"""Highest speed of a joint on the way."""


def raised_cosine(share: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """From 0 to 1, starting and ending at rest, for a share of the way's time."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(share, 0.0, 1.0))


def glide(
    loop: FixedRateLoop,
    send: Callable[[NDArray[np.float64]], object],
    origin: NDArray[np.float64],
    goal: NDArray[np.float64],
    least_s: float,
) -> None:
    """Go from `origin` to `goal` [rad] on a raised cosine, in `least_s` or longer.

    Parameters
    ----------
    loop : FixedRateLoop
    send : callable
        Is given the pose of each tick.
    origin, goal : ndarray, shape (joints,)
    least_s : float
    """
    way = goal - origin
    farthest = float(np.max(np.abs(way)))
    if farthest == 0:
        return
    # the fastest point of a raised cosine is π/2 times its mean speed
    duration = max(least_s, 0.5 * np.pi * farthest / GENTLE_RAD_S)
    for elapsed in loop.ticks(duration):
        send(origin + raised_cosine(elapsed / duration) * way)
    send(goal)
