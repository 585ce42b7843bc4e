"""What every servo bus can do, real or emulated, and all that the recorder knows of one.

A bus owns its clock. A real bus uses the host's monotonic clock; an emulated one may live in
virtual time, where `sleep_until` costs nothing. All times are seconds of that clock; all arrays
are over `joint_names`, in that order; all angles are radians of the simulator frame, absolute.

A bus that has trouble says so in what it returns, not by raising: a reading that did not come is
missing (NaN), a command that could not be sent has no send time (NaN). `hardware.safety.guard`
decides when trouble has lasted too long.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.safety.limits import PositionLimits


@dataclass(frozen=True)
class BusSample:
    """One reading of all joints, as the host received it: possibly old, and not saying so.

    Attributes
    ----------
    time_s : ndarray, shape (joints,)
        Host time of each reading: the mean of the clock before and after its exchange.
    position_rad : ndarray, shape (joints,)
        Reported position; NaN where the bus has no reading.
    position_count : ndarray of int, shape (joints,)
        The raw count behind it; -1 where the bus has none.
    voltage_v, temperature_c, load : ndarray, shape (joints,), or None
        Where the bus has them; load is a fraction of full duty, signed.
    status : ndarray of int, shape (joints,), or None
        Error bits that the servo reported with the reading (`feetech_registers.ERROR_BITS`).
    """

    time_s: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    position_count: NDArray[np.int64]
    voltage_v: NDArray[np.float64] | None = None
    temperature_c: NDArray[np.float64] | None = None
    load: NDArray[np.float64] | None = None
    status: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class Sent:
    """What went out with one `write`.

    Attributes
    ----------
    time_s : float
        Host time of sending [s]; NaN if it could not be sent, and the servos keep the last goal.
    position_rad : ndarray, shape (joints,)
        The goals after all limits, before the bus rounds them to counts.
    """

    time_s: float
    position_rad: NDArray[np.float64]


class ServoBus(Protocol):
    """A line of position servos."""

    name: str
    joint_names: tuple[str, ...]
    limits: PositionLimits
    metadata: dict[str, Any]
    """What a reader of a recording should know of this bus: kind, model, quantum, truncation."""

    def now(self) -> float:
        """Time of the bus's clock [s]."""
        ...

    def sleep_until(self, time_s: float) -> None:
        """Return when `now()` has reached `time_s`; at once if it has passed."""
        ...

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send goal positions, shape (joints,)."""
        ...

    def read(self) -> BusSample:
        """Read all joints once."""
        ...

    def torque(self, on: bool) -> bool:
        """Switch all servos' torque on or off; whether every servo was told."""
        ...

    def close(self) -> None:
        """Release the bus. May be called twice."""
        ...
