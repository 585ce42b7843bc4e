"""Gentle motions between poses, and the pose at the start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.loop import FixedRateLoop

GENTLE_RAD_S = 1.0
"""Highest speed of a joint in a gentle motion."""

_FIRST_READING_S = 2.0


def raised_cosine(share: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Ramp from 0 to 1 over `share` 0 to 1 of a motion's time, at rest at both ends."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(share, 0.0, 1.0))


def minimum_jerk(share: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Quintic ramp from 0 to 1 over `share` 0 to 1: at rest, unaccelerated, at both ends.

    Examples
    --------
    >>> minimum_jerk(np.array([0.0, 0.5, 2.0])).tolist()
    [0.0, 0.5, 1.0]
    """
    s = np.clip(share, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def first_pose(bus: ServoBus, period_s: float) -> NDArray[np.float64]:
    """Pose of the robot, shape (joints,) [rad]; waits up to 2 s for the first readings.

    Raises
    ------
    BusError
        If a joint returns no position.
    """
    until = bus.now() + _FIRST_READING_S
    pose = np.full(len(bus.joint_names), np.nan)
    while True:
        reading = bus.read().position_rad
        pose = np.where(np.isfinite(reading), reading, pose)
        if np.isfinite(pose).all():
            return pose
        if bus.now() >= until:
            silent = [n for n, x in zip(bus.joint_names, pose, strict=True) if np.isnan(x)]
            raise BusError(
                f"the bus {bus.name} gives no position of {', '.join(silent)}. Check that the "
                "robot is on and its servos connected, then try again."
            )
        bus.sleep_until(bus.now() + period_s)


def glide(
    loop: FixedRateLoop,
    send: Callable[[NDArray[np.float64]], object],
    origin: NDArray[np.float64],
    goal: NDArray[np.float64],
    least_s: float,
) -> None:
    """Move from `origin` to `goal` [rad], shape (joints,), on a raised cosine.

    Parameters
    ----------
    loop : FixedRateLoop
    send : callable
        Called with the pose of each tick.
    origin, goal : ndarray, shape (joints,)
    least_s : float
        Shortest duration; longer if `GENTLE_RAD_S` asks for it.
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
