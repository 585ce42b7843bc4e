"""How well an emulated robot did what it was told: its true motion against the commands."""

from __future__ import annotations

from typing import Any

import numpy as np

from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.policies.deploy.deployment import Tick
from pupper_sysid.sim.walking.robot import WalkingRobot


class WalkScore:
    """Watches the ticks of a walk; see `policies.deploy.deployment.deploy`.

    Parameters
    ----------
    bus : ServoBus
        Whose clock counts.
    robot : WalkingRobot
    """

    NAMES = ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")

    def __init__(self, bus: ServoBus, robot: WalkingRobot):
        self._bus, self._robot = bus, robot
        self._ticks, self._errors, self._moved = 0, np.zeros(3), np.zeros(3)

    def __call__(self, tick: Tick) -> None:
        """Look at the robot."""
        trunk = self._robot.trunk(self._bus.now())
        moved = np.array([*trunk.velocity_m_s[:2], trunk.yaw_rate_rad_s])
        self._ticks += 1
        self._moved += moved
        self._errors += np.abs(moved - tick.senses.command)

    def summary(self) -> dict[str, Any]:
        """Mean absolute errors and the mean motion."""
        if not self._ticks:
            return dict.fromkeys((*self.NAMES, "mean_motion"))
        errors, moved = (x / self._ticks for x in (self._errors, self._moved))
        found: dict[str, Any] = dict(zip(self.NAMES, errors.tolist(), strict=True))
        return found | {"mean_motion": moved.tolist()}
