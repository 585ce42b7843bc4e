"""Where the joints of a bus may go: a box, and one more bound that the knee's push rod brings.

The calf's servo sets the calf's absolute angle, so two things can be too far: the angle between
thigh and calf, and the servo itself. Whichever of the two a bus counts in, the other one is the
calf's coordinate plus or minus the thigh's, and has a bound of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Coupling:
    """Bounds of `q[calf] + sign * q[thigh]`.

    Attributes
    ----------
    calf, thigh : ndarray of int, shape (legs,)
        Indices of the legs' joints.
    sign : {1, -1}
    low_rad, high_rad : ndarray, shape (legs,)
    """

    calf: NDArray[np.intp]
    thigh: NDArray[np.intp]
    sign: int
    low_rad: NDArray[np.float64]
    high_rad: NDArray[np.float64]


@dataclass(frozen=True)
class PositionLimits:
    """Bounds of the goals of a bus.

    Attributes
    ----------
    low_rad, high_rad : ndarray, shape (joints,)
        Infinite where there is none.
    coupling : Coupling or None
    """

    low_rad: NDArray[np.float64]
    high_rad: NDArray[np.float64]
    coupling: Coupling | None = None

    def clip(self, position_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """The nearest allowed goals, shape (joints,); a thigh takes precedence over its calf."""
        allowed = np.clip(position_rad, self.low_rad, self.high_rad)
        c = self.coupling
        if c is not None:
            thigh = c.sign * allowed[c.thigh]
            # where the two bounds of a calf contradict each other, the servo's own one wins
            wanted = np.clip(allowed[c.calf], c.low_rad - thigh, c.high_rad - thigh)
            allowed[c.calf] = np.clip(wanted, self.low_rad[c.calf], self.high_rad[c.calf])
        return allowed

    def servo_angles(self, position_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the servos turn by, up to a constant: a linked calf's servo moves with its thigh."""
        return self._sheared(position_rad, +1)

    def from_servo_angles(self, servo_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `servo_angles`."""
        return self._sheared(servo_rad, -1)

    def _sheared(self, angles: NDArray[np.float64], direction: int) -> NDArray[np.float64]:
        sheared, c = np.array(angles, float), self.coupling
        # with the other sign the bus itself counts in servo angles, and the joint is the sum
        if c is not None and c.sign > 0:
            sheared[c.calf] += direction * sheared[c.thigh]
        return sheared

    def room(self, position_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far each joint alone may swing to both sides of a pose [rad]; 0 if it is outside."""
        pose = np.asarray(position_rad, float)
        room = np.minimum(pose - self.low_rad, self.high_rad - pose)
        c = self.coupling
        if c is not None:
            both = pose[c.calf] + c.sign * pose[c.thigh]
            room[c.calf] = np.minimum(room[c.calf], np.minimum(both - c.low_rad, c.high_rad - both))
        return np.maximum(room, 0.0)
