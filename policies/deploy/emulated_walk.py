"""Walks of an emulated robot, in virtual time, through guard, bus and log as on a robot.

Every robot has servos of its own, drawn as `sim.emulator.robot` draws them, and its true motion is
known: `WalkScore` compares it with the commands.
"""

from __future__ import annotations

import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy.assembly import assemble
from pupper_sysid.policies.deploy.commands import constant
from pupper_sysid.policies.deploy.deployment import Outcome, Rows, Tick, deploy
from pupper_sysid.policies.deploy.stacks import Stack
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.tracking import ERRORS, named, tracking_errors
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.walking.bus import WalkingBus
from pupper_sysid.sim.walking.robot import WalkingRobot


class WalkScore:
    """Tracking errors of an emulated robot; a watcher of `policies.deploy.deployment.deploy`.

    Times are those of `bus`.
    """

    def __init__(self, bus: ServoBus, robot: WalkingRobot):
        self._bus, self._robot = bus, robot
        self._moved: list[np.ndarray] = []
        self._commands: list[np.ndarray] = []

    def __call__(self, tick: Tick) -> None:
        """Record the robot's true motion at a tick."""
        trunk = self._robot.trunk(self._bus.now())
        self._moved.append(np.array([*trunk.velocity_m_s[:2], trunk.yaw_rate_rad_s]))
        self._commands.append(tick.senses.command)

    def summary(self) -> dict[str, Any]:
        """Mean absolute errors and `mean_motion` up to the last tick; None before the first."""
        if not self._moved:
            return dict.fromkeys((*ERRORS, "mean_motion"))
        moved, commands = (np.array(x)[:, None] for x in (self._moved, self._commands))
        up, fell = np.ones((len(moved), 1), bool), np.zeros(1, bool)
        errors = tracking_errors(moved, commands, up, fell)[0]
        return {**named(errors), "mean_motion": (moved[:, 0].sum(axis=0) / len(moved)).tolist()}


def walk_once(
    policy: Policy,
    stack: Stack,
    command: tuple[float, float, float],
    seconds: float,
    seed: int,
    actuator: str,
    servo: Path | None = None,
    rows: Rows | None = None,
    noise: int = 0,
) -> tuple[Outcome, WalkScore]:
    """One walk of one emulated robot; its log is discarded.

    The command is forward and sideways speed [m/s] and turn rate [rad/s]; `seed` is that of the
    robot, `noise` of all else: lost polls, noise, timing. `actuator` and `servo` are as for
    `policies.deploy.assembly.assemble`; `rows` takes the servos' rows, as of a recording.
    """
    truth = draw_robot(np.random.default_rng(seed))
    joint_map = load_joint_map("mini_pupper_2")
    inner = WalkingBus(truth, np.random.default_rng([seed, noise]))
    with closing(GuardedBus(inner)) as bus, tempfile.TemporaryDirectory() as folder:
        parts = assemble(policy, stack, joint_map, actuator, servo)
        score = WalkScore(bus, inner.robot)
        outcome = deploy(
            bus, inner, parts.controller, constant(command), seconds,
            Path(folder) / "walk.csv", parts.header, rows, [score, parts.frozen_readings],
        )  # fmt: skip
    return outcome, score
