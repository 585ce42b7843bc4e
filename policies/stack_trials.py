"""Deployment stacks side by side: the same emulated robots, walked by the same policy.

Every robot has servos of its own, drawn as `sim.emulated_robot` draws them, and each stack walks
the same robots under the same commands, in virtual time, through guard, bus and log as on a robot.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from hardware.guard import GuardedBus
from hardware.joint_map import load_joint_map
from policies.assembly import assemble
from policies.commands import constant
from policies.deployment import Outcome, Rows, deploy
from policies.policy_file import Policy
from policies.rhythm import mean_of
from policies.stacks import Stack
from policies.walk_score import WalkScore
from sim.emulated_robot import draw_robot
from sim.walking_bus import WalkingBus

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
        Calibration of a simulated PD; see `policies.assembly.assemble`.
    servo : Path, optional
        Servo model's folder.
    log : Path, optional
        Where to keep the log; thrown away if not given.
    rows : Rows, optional
        Is given the servos' rows, as of a recording.
    """
    rng = np.random.default_rng(seed)
    joint_map = load_joint_map("mini_pupper_2")
    inner = WalkingBus(draw_robot(rng), rng)
    with closing(GuardedBus(inner)) as bus, tempfile.TemporaryDirectory() as folder:
        parts = assemble(policy, stack, joint_map, actuator, servo)
        score = WalkScore(bus, inner.robot)
        outcome = deploy(
            bus, inner, parts.controller, constant(command), seconds,
            log or Path(folder) / "walk.csv", parts.header, rows, [score],
        )  # fmt: skip
    return outcome, score


def compare_stacks(
    policy: Policy,
    stacks: Mapping[str, tuple[Stack, Path | None]],
    commands: Sequence[Command],
    seeds: Sequence[int],
    seconds: float,
    actuator: str,
    progress: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Each stack on each robot.

    Parameters
    ----------
    policy : Policy
    stacks : dict of str to (Stack, Path or None)
        By name: the stack and its servo model's folder.
    commands : sequence of (float, float, float)
        One after the other, a walk each; a robot's errors are means over them.
    seeds : sequence of int
        Of the robots.
    seconds : float
        Of each walk.
    actuator : str
    progress : callable, optional
        Told what is about to be done.

    Returns
    -------
    list of dict
        `stack`, `falls` (share of walks), `mae_vx_m_s`, `mae_vy_m_s`, `mae_yaw_rad_s` as (value,
        low, high) over robots, and from the second stack on `less_...`: this stack's error less
        the first one's, robot by robot.
    """
    found: list[dict[str, Any]] = []
    first: np.ndarray | None = None
    for name, (stack, servo) in stacks.items():
        errors, falls = [], []
        for seed in seeds:
            if progress:
                progress(f"{name}, robot {seed}")
            each = []
            for command in commands:
                outcome, score = walk_once(policy, stack, command, seconds, seed, actuator, servo)
                falls.append(outcome.fell)
                summary = score.summary()
                each.append([summary[key] for key in WalkScore.NAMES])
            errors.append(np.mean(np.array(each, float), axis=0))
        table = np.array(errors)
        row: dict[str, Any] = {"stack": name, "falls": float(np.mean(falls))}
        row |= {key: mean_of(column) for key, column in zip(WalkScore.NAMES, table.T, strict=True)}
        if first is not None:
            row |= {
                f"less_{key}": mean_of(column)
                for key, column in zip(WalkScore.NAMES, (table - first).T, strict=True)
            }
        first = table if first is None else first
        found.append(row)
    return found
