"""Interface of a servo bus, real or emulated.

A bus owns its clock. A real bus uses the host's monotonic clock; an emulated one may run in virtual
time, where `sleep_until` costs nothing. All times are seconds of that clock; all arrays are over
`joint_names`, in that order; all angles are radians of the simulator frame, absolute.

Faults of a bus are returned, not raised: a missing reading is NaN, and so is the send time of a
command that could not be sent. `hardware.safety.guard` stops the robot when a fault lasts.

Position limits of its joints are a box, and a bound that the knee's push rod adds. The calf's servo
sets the calf's absolute angle. So both the angle between thigh and calf and the servo's own angle
are limited: one of them is the bus's coordinate of the calf, the other is that coordinate plus or
minus the thigh's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.serial_servos.series import ERROR_BITS, bits_in_words


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
            # where the two bounds of a calf contradict each other, the box applies
            calf = np.clip(allowed[c.calf], c.low_rad - thigh, c.high_rad - thigh)
            allowed[c.calf] = np.clip(calf, self.low_rad[c.calf], self.high_rad[c.calf])
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
            servo_angle = pose[c.calf] + c.sign * pose[c.thigh]
            coupled = np.minimum(servo_angle - c.low_rad, c.high_rad - servo_angle)
            margin[c.calf] = np.minimum(margin[c.calf], coupled)
        return np.maximum(margin, 0.0)


@dataclass(frozen=True)
class BusSample:
    """One reading of all joints, as the host received it; it may be stale."""

    time_s: NDArray[np.float64]
    """Host time of each reading: the mean of the clock before and after its exchange, shape
    (joints,)."""
    position_rad: NDArray[np.float64]
    """Shape (joints,). Reported position; NaN where the bus has no reading."""
    position_count: NDArray[np.int64]
    """Shape (joints,). The raw count behind it, which a homing offset may move below 0 or over the
    encoder's range; -1 where the bus has none: there the position is NaN."""
    voltage_v: NDArray[np.float64] | None = None
    temperature_c: NDArray[np.float64] | None = None
    load: NDArray[np.float64] | None = None
    """Shape (joints,). `voltage_v`, `temperature_c` and `load`: where the bus has them; load is a
    fraction of full duty, signed."""
    status: NDArray[np.int64] | None = None
    """Error bits of the servo (`error_words`), shape (joints,)."""


@dataclass(frozen=True)
class Sent:
    """What one `write` sent."""

    time_s: float
    """Host time of sending [s]; NaN if it failed, and the servos keep the last command."""
    position_rad: NDArray[np.float64]
    """The commands after all limits, before the bus rounds them to counts, shape (joints,)."""


class ServoBus(Protocol):
    """A line of position servos.

    One that is opened by an address also has a `joint_map`, which its watchdog switches off.
    """

    name: str
    joint_names: tuple[str, ...]
    limits: PositionLimits
    metadata: dict[str, Any]
    """For the header of a recording: `JointMap.metadata`, `kind`, `speed_limit_rad_s`, and what
    else is known; `readings` is "live" where the servo itself answers each read, "polled" where a
    read returns the bus's last poll."""

    def now(self) -> float:
        """Time of the bus's clock [s]."""
        ...

    def sleep_until(self, time_s: float) -> None:
        """Return when `now()` has reached `time_s`; at once if it has passed."""
        ...

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send commands, shape (joints,)."""
        ...

    def read(self) -> BusSample:
        """Read all joints once."""
        ...

    def torque(self, on: bool) -> bool:
        """Switch the torque of all servos; whether it is confirmed for every servo."""
        ...

    def close(self) -> None:
        """Release the bus. May be called twice."""
        ...


def finite_angles(position_rad: NDArray[np.float64], joints: int, bus: str) -> NDArray[np.float64]:
    """`position_rad` as an array of shape (joints,); `BusError` if it is none, or not finite."""
    angles = np.asarray(position_rad, float)
    if angles.shape != (joints,) or not np.isfinite(angles).all():
        raise BusError(f"{bus}: commands must be {joints} finite angles, got {angles}.")
    return angles


def error_words(bus: ServoBus, status: int) -> str:
    """Error bits of a sample's status in words, as the bus names them."""
    return bits_in_words(status, getattr(bus, "error_bits", ERROR_BITS))


def header_entries(bus: ServoBus) -> dict[str, Any]:
    """Entries of a recording's header that describe its bus.

    `bus`, and where they are known `readings` and `servos`.
    """
    about = {"name": bus.name} | bus.metadata
    readings = about.pop("readings", None)
    setups = getattr(bus, "servo_setups", dict)()
    return (
        {"bus": about}
        | ({} if readings is None else {"readings": readings})
        | ({"servos": setups} if setups else {})
    )
