"""Position limits of the joints of a bus: a box, and a bound that the knee's push rod adds.

The calf's servo sets the calf's absolute angle. So both the angle between thigh and calf and the
servo's own angle are limited: one of them is the bus's coordinate of the calf, the other is that
coordinate plus or minus the thigh's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Coupling:
    """Bounds of `q[calf] + sign * q[thigh]`."""

    calf: NDArray[np.intp]
    thigh: NDArray[np.intp]
    """`calf` and `thigh`: indices of the legs' joints, shape (legs,)."""
    sign: int
    """1 or -1."""
    low_rad: NDArray[np.float64]
    high_rad: NDArray[np.float64]
    """Shape (legs,)."""


@dataclass(frozen=True)
class PositionLimits:
    """Bounds of the commands of a bus."""

    low_rad: NDArray[np.float64]
    high_rad: NDArray[np.float64]
    """`low_rad` and `high_rad`: infinite where there is none, shape (joints,)."""
    coupling: Coupling | None = None

    def clip(self, position_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Nearest allowed positions, shape (joints,); a thigh takes precedence over its calf."""
        allowed = np.clip(position_rad, self.low_rad, self.high_rad)
        c = self.coupling
        if c is not None:
            thigh = c.sign * allowed[c.thigh]
            # where the two bounds of a calf contradict each other, the box wins
            wanted = np.clip(allowed[c.calf], c.low_rad - thigh, c.high_rad - thigh)
            allowed[c.calf] = np.clip(wanted, self.low_rad[c.calf], self.high_rad[c.calf])
        return allowed

    def servo_angles(self, position_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Angles of the servos, up to a constant: a linked calf's servo turns with its thigh."""
        return self._linked(position_rad, +1)

    def from_servo_angles(self, servo_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse of `servo_angles`."""
        return self._linked(servo_rad, -1)

    def _linked(self, angles: NDArray[np.float64], direction: int) -> NDArray[np.float64]:
        linked, c = np.array(angles, float), self.coupling
        # with the other sign the bus itself counts in servo angles, and the joint is the sum
        if c is not None and c.sign > 0:
            linked[c.calf] += direction * linked[c.thigh]
        return linked

    def margin(self, position_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Travel of each joint alone to the nearer limit [rad], shape (joints,); 0 if outside."""
        pose = np.asarray(position_rad, float)
        margin = np.minimum(pose - self.low_rad, self.high_rad - pose)
        c = self.coupling
        if c is not None:
            both = pose[c.calf] + c.sign * pose[c.thigh]
            own = np.minimum(both - c.low_rad, c.high_rad - both)
            margin[c.calf] = np.minimum(margin[c.calf], own)
        return np.maximum(margin, 0.0)
