"""A bus of a test in virtual time, whose servos follow at once."""

import numpy as np

from pupper_sysid.hardware.bus import BusSample, PositionLimits, Sent
from support.virtual_time import VirtualTime


class FollowingBus(VirtualTime):
    """Servos that are where they were commanded to be [rad], from `goal` on.

    `log` has torque and close, `written` and `written_s` what was commanded when.
    """

    name = "following"

    def __init__(
        self, joints=("LF_hip",), limits: PositionLimits | None = None, reach_rad: float = 2.0
    ):
        count = len(joints)
        self.joint_names = tuple(joints)
        self.limits = limits or PositionLimits(
            np.full(count, -reach_rad), np.full(count, reach_rad)
        )
        self.metadata: dict = {}
        self.time, self.goal = 0.0, np.zeros(count)
        self.log: list[str] = []
        self.written: list[np.ndarray] = []
        self.written_s: list[float] = []

    def write(self, position_rad) -> Sent:
        self.goal = position_rad.copy()
        self.written.append(self.goal)
        self.written_s.append(self.time)
        return Sent(self.time, self.goal)

    def sample(self, position_rad, **more) -> BusSample:
        """Readings of now."""
        count = len(self.joint_names)
        return BusSample(np.full(count, self.time), position_rad, np.full(count, 500), **more)

    def read(self) -> BusSample:
        return self.sample(self.goal.copy())

    def torque(self, on: bool) -> bool:
        self.log.append(f"torque {on}")
        return True

    def close(self) -> None:
        self.log.append("close")
