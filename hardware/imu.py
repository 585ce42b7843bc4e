"""The IMU of the robot: the chip's readings in the trunk's axes and in SI units.

The trunk's axes are x forward, y left, z up. The Mini Pupper 2's chip, a QMI8658C, is mounted
upside down and with x and y exchanged (vendor's ROS driver, `imu_interface.py`): its z points down,
its x to the left and its y forward, so

    x = y_chip,  y = x_chip,  z = -z_chip

for both of its sensors (a rotation, and its own inverse). The accelerometer measures the *specific
force*, acceleration minus gravity: at rest it points up with 9.81 m/s², which the chip reports as
about -1 g on its z. Its range is ±2 g, which walking exceeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

GRAVITY_M_S2 = 9.80665
"""One g, the chip's unit."""
ACCELERATION_QUANTUM_G = 1 / 16384
RATE_QUANTUM_DEG_S = 1 / 16
SAMPLE_RATE_HZ = 235.0
"""New values of the chip per second."""

_LOWEST, _HIGHEST = -(2**15), 2**15 - 1  # 16-bit words: ±2 g, ±2048 °/s
_QUANTA = np.repeat([ACCELERATION_QUANTUM_G, RATE_QUANTUM_DEG_S], 3)
_TRUNK_FROM_CHIP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class ImuSample:
    """One reading of the IMU in the trunk's axes (x forward, y left, z up)."""

    time_s: float
    """Time of the read on the clock of the bus [s]."""
    rate_rad_s: NDArray[np.float64]
    """Angular velocity: rolling to the right, nose going down, turning to the left [rad/s], shape
    (3,)."""
    acceleration_m_s2: NDArray[np.float64]
    """Shape (3,). Specific force; (0, 0, 9.81) while standing level."""
    clipped: bool
    """Whether a value is at the end of its range and may be larger in truth."""


@runtime_checkable
class Imu(Protocol):
    """A bus with an IMU, real or emulated."""

    def imu(self) -> ImuSample | None:
        """The latest reading; None if there is none."""
        ...


def from_chip(time_s: float, raw: NDArray[np.float64]) -> ImuSample | None:
    """Sample from the chip's acceleration [g] and rate [°/s] along its own axes, shape (6,).

    None if all six are 0, which is how the firmware reports a failed read.

    Examples
    --------
    >>> sample = from_chip(0.0, np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]))
    >>> sample.acceleration_m_s2.tolist()
    [0.0, 0.0, 9.80665]
    """
    if not np.any(raw):
        return None
    word = np.asarray(raw, float) / _QUANTA
    clipped = bool(np.any((word <= _LOWEST) | (word >= _HIGHEST)))
    acceleration = GRAVITY_M_S2 * (_TRUNK_FROM_CHIP @ raw[:3])
    return ImuSample(time_s, np.radians(_TRUNK_FROM_CHIP @ raw[3:]), acceleration, clipped)


def to_chip(sample: ImuSample) -> NDArray[np.float64]:
    """The chip's six numbers of a sample, shape (6,): the inverse of `from_chip`."""
    acceleration = _TRUNK_FROM_CHIP.T @ sample.acceleration_m_s2 / GRAVITY_M_S2
    rate = np.degrees(_TRUNK_FROM_CHIP.T @ sample.rate_rad_s)
    return np.concatenate([acceleration, rate])


def as_words(raw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Six true numbers [g, °/s], shape (6,), quantised to the chip's 16-bit words."""
    return np.clip(np.rint(raw / _QUANTA), _LOWEST, _HIGHEST) * _QUANTA
