"""What an episode draws: the commanded motion, and the pose in which a robot starts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Commands, Randomisation

Array = NDArray[np.float64]


def draw_commands(commands: Commands, count: int, share: float, rng: np.random.Generator) -> Array:
    """Commanded motions [m/s, m/s, rad/s], shape (count, 3), from a `share` of the ranges."""
    ranges = np.array([commands.forward_m_s, commands.sideways_m_s, commands.yaw_rad_s])
    found = rng.uniform(ranges[:, 0], ranges[:, 1], (count, 3)) * share
    alone = rng.random(count) < commands.single
    found[alone] *= np.eye(3)[rng.integers(0, 3, count)][alone]
    found[rng.random(count) < commands.standing] = 0.0
    return at_rest(commands, found)


def at_rest(commands: Commands, command: Array) -> Array:
    """Commands (n, 3) with those within the dead band as 0: stand."""
    speed, turn = commands.dead_band
    small = np.linalg.norm(command[:, :2], axis=1) < speed
    small &= np.abs(command[:, 2]) < turn
    return np.where(small[:, None], 0.0, command)


def draw_pose(
    random: Randomisation, body: Body, trot: Trot, command: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Joint angles [rad] and velocities [rad/s] at the start, (n, joints), of commands (n, 3)."""
    n, joints = len(command), len(body.joints)
    start = body.pose + rng.uniform(-random.joint_rad, random.joint_rad, (n, joints))
    speed = rng.uniform(-random.joint_rad_s, random.joint_rad_s, (n, joints))
    trotting = rng.random(n) < random.on_the_move
    phase = rng.uniform(0.0, 2 * np.pi, n)
    if trotting.any():
        start[trotting] = trot.joints(phase, command, body)[trotting]
    return np.clip(start, body.low, body.high), speed * ~trotting[:, None]
