"""What robots measure of themselves: joint angles as their bus reports them, and their IMUs.

Joint rates are differences of readings over a few control steps, as the controller of a real robot
computes them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.robot.motion import Moved
from pupper_sysid.sim.robot.robot_batch import RobotBatch
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.held_readings import HeldReadings
from pupper_sysid.sim.walking.imu import Imu
from pupper_sysid.sim.walking.observation import VELOCITY_STEPS
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

Array = NDArray[np.float64]
Rows = slice | NDArray[np.intp]


class Senses:
    """Readings and IMU of n robots.

    Parameters
    ----------
    config : Walking
    servos : ServoRanges
    robots : RobotBatch
        Whose joints and trunks are measured.
    environments : int
        How many robots, n.
    rng : numpy.random.Generator
        Of the readings.

    Attributes
    ----------
    readings : HeldReadings
        Of the servos.
    imu : Imu
    kept : ndarray, shape (VELOCITY_STEPS + 1, n, 12)
        Joint angles [rad] as read at the last control steps, in turn.
    """

    def __init__(
        self,
        config: Walking,
        servos: ServoRanges,
        robots: RobotBatch,
        environments: int,
        rng: np.random.Generator,
    ):
        self._robots, self._span = robots, config.control_step_s
        self.readings = HeldReadings(
            servos.feedback, environments, config.physics_step_s, rng, robots.linked,
            config.differences.poll_period[0],
        )  # fmt: skip
        self.imu = Imu(config.differences, environments, config.control_step_s)
        self.kept = np.zeros((VELOCITY_STEPS + 1, environments, len(robots.body.joints)))

    def reset(
        self,
        ids: NDArray[np.intp],
        servo_rad: Array,
        rate: Array,
        gravity: Array,
        rng: np.random.Generator,
    ) -> None:
        """Start robots that have long been as they are; `rng` draws their IMUs."""
        self.readings.reset(ids, servo_rad, self._robots.bodies.poll[ids])
        self.kept[:, ids] = self.angles(ids)
        self.imu.reset(ids, rate, gravity, rng)

    def advance(self, moved: Moved, chances: Array, step: int) -> None:
        """Let the bus poll the servos of robots that have moved; `step` counts control steps."""
        self.readings.advance(moved.start, moved.qpos, moved.load, chances, moved.rows)
        self.kept[step % len(self.kept), moved.rows] = self.angles(moved.rows)

    def angles(self, rows: Rows) -> Array:
        """Joint angles [rad] as the controller reads them now, shape (k, 12)."""
        position = self.readings.position[rows] - self._robots.bodies.zero_rad[rows]
        return self._robots.from_servo(position)

    def joints(self, rows: Rows, step: int) -> tuple[Array, Array, Array]:
        """Angles [rad], rates [rad/s] and efforts [N·m] of joints at the last control step.

        Efforts are 0 on buses without load readings.
        """
        newest = step % len(self.kept)
        angle = self.kept[newest, rows]
        rate = angle - self.kept[(newest + 1) % len(self.kept), rows]
        rate /= VELOCITY_STEPS * self._span
        return angle, rate, self.readings.load[rows] * self._robots.bodies.effort[rows, None]
