"""What every servo bus can do, real or emulated, and all that the recorder knows of one.

A bus owns its clock. A real bus uses the host's monotonic clock; an emulated one may live in
virtual time, where `sleep_until` costs nothing. All times are seconds of that clock; all arrays
are over `joint_names`, in that order; all angles are radians of the simulator frame, absolute.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class BusSample:
    """One reading of all joints, as the host received it: possibly old, and not saying so.

    Attributes
    ----------
    time_s : float
        Host time of the reading: the mean of the clock before and after the exchange.
    position_rad : ndarray, shape (joints,)
        Reported position; NaN where the bus has no reading.
    position_count : ndarray of int, shape (joints,)
        The raw count behind it; -1 where the bus has none.
    voltage_v, temperature_c, load : ndarray, shape (joints,), or None
        Where the bus has them; load is a fraction of full duty, signed.
    """

    time_s: float
    position_rad: NDArray[np.float64]
    position_count: NDArray[np.int64]
    voltage_v: NDArray[np.float64] | None = None
    temperature_c: NDArray[np.float64] | None = None
    load: NDArray[np.float64] | None = None


class ServoBus(Protocol):
    """A line of position servos."""

    name: str
    joint_names: tuple[str, ...]
    metadata: dict[str, Any]
    """What a reader of a recording should know of this bus: kind, model, quantum, truncation."""

    def now(self) -> float:
        """Time of the bus's clock [s]."""
        ...

    def sleep_until(self, time_s: float) -> None:
        """Return when `now()` has reached `time_s`; at once if it has passed."""
        ...

    def write(self, position_rad: NDArray[np.float64]) -> float:
        """Send goal positions, shape (joints,); returns the host time of sending [s]."""
        ...

    def read(self) -> BusSample:
        """Read all joints once."""
        ...

    def torque(self, on: bool) -> None:
        """Switch all servos' torque on or off."""
        ...

    def close(self) -> None:
        """Release the bus. May be called twice."""
        ...
