"""Deployment stacks side by side: the same emulated robots, walked by the same policy.

Every robot has servos of its own, drawn as `sim.emulator.robot` draws them, and each stack walks
the same robots under the same commands, in virtual time, through guard, bus and log as on a robot.
A servo model is one robot's, and walks only that one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.analysis.rhythm import mean_of
from pupper_sysid.policies.deploy.assembly import assemble
from pupper_sysid.policies.deploy.commands import constant
from pupper_sysid.policies.deploy.deployment import Outcome, Rows, deploy
from pupper_sysid.policies.deploy.stacks import Stack
from pupper_sysid.policies.deploy.walk_score import WalkScore
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.walking.bus import WalkingBus

Command = tuple[float, float, float]


def walk_once(
    policy: Policy,
    stack: Stack,
    command: Command,
    seconds: float,
    seed: int,
    actuator: str,
    servo: Path | None = None,
    log: Path | None = None,
    rows: Rows | None = None,
    noise: int = 0,
) -> tuple[Outcome, WalkScore]:
    """One walk of one emulated robot, in virtual time.

    Parameters
    ----------
    policy : Policy
    stack : Stack
    command : (float, float, float)
        Forward and sideways speed [m/s], turn rate [rad/s].
    seconds : float
    seed : int
        Of the robot.
    actuator : str
        Calibration of a simulated PD; see `policies.deploy.assembly.assemble`.
    servo : Path, optional
        Servo model's folder.
    log : Path, optional
        Where to keep the log; thrown away if not given.
    rows : Rows, optional
        Is given the servos' rows, as of a recording.
    noise : int
        Seed of what is not the robot: lost polls, noise, timing.
    """
    truth = draw_robot(np.random.default_rng(seed))
    joint_map = load_joint_map("mini_pupper_2")
    inner = WalkingBus(truth, np.random.default_rng([seed, noise]))
    with closing(GuardedBus(inner)) as bus, tempfile.TemporaryDirectory() as folder:
        parts = assemble(policy, stack, joint_map, actuator, servo)
        score = WalkScore(bus, inner.robot)
        outcome = deploy(
            bus, inner, parts.controller, constant(command), seconds,
            log or Path(folder) / "walk.csv", parts.header, rows, [score],
        )  # fmt: skip
    return outcome, score


@dataclass(frozen=True)
class Walker:
    """One robot for one round of walks: its seed, its servo model, and the seed of the noise."""

    seed: int
    servo: Path | None = None
    noise: int = 0


def compare_stacks(
    policy: Policy,
    stacks: Mapping[str, Stack],
    walkers: Sequence[Walker],
    commands: Sequence[Command],
    seconds: float,
    actuator: str,
    progress: Callable[[str], None] = lambda what: None,
) -> list[dict[str, Any]]:
    """Each stack on each robot.

    Parameters
    ----------
    policy : Policy
    stacks : dict of str to Stack
    walkers : sequence of Walker
    commands : sequence of (float, float, float)
        One after the other, a walk each; a walker's errors are means over them.
    seconds : float
        Of each walk.
    actuator : str
    progress : callable
        Told what is about to be done.

    Returns
    -------
    list of dict
        `stack`, `falls` (share of walks), `mae_vx_m_s`, `mae_vy_m_s`, `mae_yaw_rad_s` as (value,
        low, high) over walkers, and from the second stack on `less_...`: this stack's error less
        the first one's, walker by walker.
    """
    found: list[dict[str, Any]] = []
    first: np.ndarray | None = None
    for name, stack in stacks.items():
        errors, falls = [], []
        for walker in walkers:
            progress(f"{name}, robot {walker.seed}, round {walker.noise}")
            servo = walker.servo if stack.observer == "servo-model" else None
            each = []
            for command in commands:
                outcome, score = walk_once(
                    policy, stack, command, seconds, walker.seed, actuator, servo,
                    noise=walker.noise,
                )  # fmt: skip
                falls.append(outcome.fell)
                summary = score.summary()
                each.append([summary[key] for key in WalkScore.NAMES])
            errors.append(np.mean(np.array(each, float), axis=0))
        table = np.array(errors)
        row: dict[str, Any] = {"stack": name, "falls": float(np.mean(falls))}
        row |= _means("", table)
        if first is not None:
            row |= _means("less_", table - first)
        first = table if first is None else first
        found.append(row)
    return found


def _means(prefix: str, table: np.ndarray) -> dict[str, Any]:
    """A mean over walkers per error."""
    named = zip(WalkScore.NAMES, table.T, strict=True)
    return {prefix + key: mean_of(column) for key, column in named}
