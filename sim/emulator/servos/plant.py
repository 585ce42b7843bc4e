"""What moves behind the emulators: twelve servos in free air, or one robot that walks.

A `ServoPlant` gives the truth; `EmulatedBus` and `ServoBench` make of it what a host reads. Servos
are counted in the order of `JOINT_NAMES`, their angles are in servo coordinates
(`hardware.joint_map`): a calf's servo angle is that with its thigh at neutral.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from pupper_sysid.hardware.imu import GRAVITY_M_S2, ImuSample
from pupper_sysid.sim.emulator.robot import EmulatedRobot


class ServoPlant(Protocol):
    """Twelve servos and an IMU. Time starts at 0, in the default pose with the torque on.

    Time passes only as far as a call asks. A call may ask for an instant a little before the last
    one, since servos are not polled at the same time; commands come in order.
    """

    def command(self, index: int, time_s: float, angle_rad: float) -> None:
        """Command one servo from `time_s` on; a limp one ignores it."""
        ...

    def torque(self, index: int, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp, from `time_s` on."""
        ...

    def angle(self, index: int, time_s: float) -> float:
        """True angle of a servo [rad]."""
        ...

    def load(self, index: int) -> float:
        """Signed share of a servo's effort limit in use at the time of the last `angle` call."""
        ...

    def imu(self, time_s: float) -> ImuSample | None:
        """Latest sample of the IMU; None if it gives none."""
        ...


class FreeAirServos:
    """A `ServoPlant` on a stand: level and at rest, legs in free air."""

    def __init__(self, robot: EmulatedRobot):
        from pupper_sysid.sim.emulator.servos.free_air import FreeAirServo  # imports MuJoCo

        pose = robot.joint_map.rest_pose().tolist()
        self._servos = [
            FreeAirServo(s.actuator, x) for s, x in zip(robot.servos, pose, strict=True)
        ]

    def command(self, index: int, time_s: float, angle_rad: float) -> None:
        """Command one servo from `time_s` on; a limp one ignores it."""
        self._servos[index].command(time_s, angle_rad)

    def torque(self, index: int, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp, from `time_s` on."""
        self._servos[index].torque(time_s, on)

    def angle(self, index: int, time_s: float) -> float:
        """True angle of a servo [rad]."""
        return self._servos[index].position_at(time_s)

    def load(self, index: int) -> float:
        """Signed share of a servo's effort limit in use at the time of the last `angle` call."""
        return self._servos[index].load

    def imu(self, time_s: float) -> ImuSample:
        """Gravity alone."""
        return ImuSample(time_s, np.zeros(3), np.array([0.0, 0.0, GRAVITY_M_S2]), False)
