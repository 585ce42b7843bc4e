"""Clearance of the feet and effort of the servos, from every physics step: rewards and evaluations.

A swing of a third of a stride lasts three control steps, and a servo is at its torque limit for
parts of one, so both are taken from the state after each physics step (`Moved`).

A swing is the time between two contacts of a foot, of `SHORTEST_SWING_S` at least: shorter ones are
flickers of a foot that carries. Its clearance is the largest height of the sole over the ground in
it; a foot that stumbles in the air makes two swings. Mechanical power is the positive work of all
servos over time: none of them gives back what it brakes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.imu import GRAVITY_M_S2
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.motion import Moved
from pupper_sysid.sim.robot.robot_batch import RobotBatch

Array = NDArray[np.float64]

SHORTEST_SWING_S = 0.04
LOW_SWING_M = 0.002
"""Clearance below which a swing is low: the next pebble or seam ends it."""
_AT_LIMIT = 0.999


class EffortMeter:
    """Effort of robots, step by step."""

    def __init__(self, robots: RobotBatch, step_s: float):
        self._robots, self._step_s = robots, step_s
        self._highest = np.full((robots.environments, len(robots.body.feet)), -np.inf)

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, live."""
        return {"highest_m": self._highest}

    def reset(self, ids: NDArray[np.intp]) -> None:
        """Begin anew with some robots."""
        self._highest[ids] = -np.inf

    def advance(self, moved: Moved, facts: dict[str, Any]) -> None:
        """Write clearance and effort of one control step of some robots into `facts` of a `Step`.

        `facts` already has the contacts.
        """
        rows, robots = moved.rows, self._robots
        highest = np.maximum(self._highest[rows], robots.sole_heights(moved.feet).max(axis=1))
        ended = facts["contact"] & (facts["contact_s"] <= self._step_s + 1e-9)
        ended &= facts["last_air_s"] > SHORTEST_SWING_S - 1e-9
        facts["swing_ended"][:] = ended
        facts["clearance_m"][:] = np.where(ended, highest, np.nan)
        self._highest[rows] = np.where(facts["contact"], -np.inf, highest)
        limit = robots.field("actuator_forcerange")[rows, None, :, 1]
        share = np.abs(moved.load) / limit
        facts["saturated"][:] = (share >= _AT_LIMIT).mean(axis=1)
        facts["torque_square"][:] = (share * share).mean(axis=1)
        angles = np.concatenate([moved.start[:, None], moved.qpos[..., 7:]], axis=1)
        turned = np.diff(robots.to_servo(angles), axis=1)
        work = np.maximum(moved.load * turned, 0.0).sum(axis=(1, 2))
        facts["power_w"][:] = work / self._step_s
        facts["weight_n"][:] = GRAVITY_M_S2 * robots.field("body_mass")[rows].sum(axis=1)


def by_kind(body: Body, each: Array) -> Array:
    """Means over the joints of each of `Body.kinds`, shape (n, kinds), of values of all servos."""
    return np.stack([each[:, joints].mean(axis=1) for joints in body.kinds.values()], axis=1)
