"""Limit of a command's speed and acceleration, per tick of the rate at which commands come.

A late tick counts for one and a half of them and a pause is a new start from rest, so that nothing
is saved up for a jump.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.safety.limits import PositionLimits

_FIRST_TICK_S = 0.02  # until the driver's own rate is known
_LATE = 1.5
_SHORTEST_TICK_S, _LONGEST_TICK_S = 0.001, 0.06
_REST_S = 0.1  # longer than any tick: the command has been at rest
_RECENT_TICKS = 9


class RateLimit:
    """Speed and acceleration limits of the servo angles of a bus.

    Parameters
    ----------
    limits : PositionLimits
    speed_rad_s, acceleration_rad_s2 : float
        Deceleration is free.
    """

    def __init__(self, limits: PositionLimits, speed_rad_s: float, acceleration_rad_s2: float):
        self._limits = limits
        self._speed, self._acceleration = speed_rad_s, acceleration_rad_s2
        self._velocity = np.zeros(len(limits.low_rad))
        self._ticks: deque[float] = deque(maxlen=_RECENT_TICKS)

    def rest(self) -> None:
        """Begin from rest."""
        self._velocity[:] = 0.0

    def limited(
        self, command: NDArray[np.float64], sent: NDArray[np.float64], since_s: float
    ) -> NDArray[np.float64]:
        """`command`, or a point towards it that the limits allow; `command` itself if they do.

        Parameters
        ----------
        command, sent : ndarray, shape (joints,)
            The command, and the last one that was sent [rad].
        since_s : float
            Time since then.
        """
        limits = self._limits
        wanted, here = limits.servo_angles(command), limits.servo_angles(sent)
        tick = float(np.median(self._ticks)) if self._ticks else _FIRST_TICK_S
        dt = max(min(since_s, _LATE * tick), 1e-4)
        if since_s > _REST_S:
            self.rest()
            dt = min(tick, _FIRST_TICK_S)
        else:
            self._ticks.append(min(max(since_s, _SHORTEST_TICK_S), _LONGEST_TICK_S))
        asked = (wanted - here) / dt
        gain = self._acceleration * dt
        low = np.maximum(np.minimum(self._velocity, 0.0) - gain, -self._speed)
        high = np.minimum(np.maximum(self._velocity, 0.0) + gain, self._speed)
        velocity = np.clip(asked, low, high)
        exceeded = velocity != asked
        # over all of a late tick the joint was slower than that
        self._velocity = velocity * min(dt / min(max(since_s, 1e-4), _LONGEST_TICK_S), 1.0)
        if not exceeded.any():
            return command
        slower = np.where(exceeded, here + velocity * dt, wanted)
        return limits.clip(limits.from_servo_angles(slower))
