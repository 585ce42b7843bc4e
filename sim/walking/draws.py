"""What an episode draws: the commanded motion, the pose in which a robot starts, and twins.

Twins are one robot under several conditions. They have the same servos, friction, start, noise and
feedback faults, so that they differ in their conditions only (a command, a dead time, a push),
until one of them falls. Numbers are drawn for each different robot once and handed to all of its
twins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Commands, Randomisation

Array = NDArray[np.float64]


def draw_commands(commands: Commands, count: int, share: float, rng: np.random.Generator) -> Array:
    """Commanded motions [m/s, m/s, rad/s], shape (count, 3), from a `share` of the ranges."""
    motions = rng.uniform(*command_ends(commands), (count, 3)) * share
    alone = rng.random(count) < commands.single
    motions[alone] *= np.eye(3)[rng.integers(0, 3, count)][alone]
    motions[rng.random(count) < commands.standing] = 0.0
    return at_rest(commands, motions)


def command_ends(commands: Commands) -> Array:
    """Lowest and highest of forward and sideways speed and of the turn rate, shape (2, 3)."""
    return np.array([commands.forward_m_s, commands.sideways_m_s, commands.yaw_rad_s]).T


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


@dataclass(frozen=True)
class Twins:
    """Which robots of an environment are the same one."""

    number: NDArray[np.intp]
    """Of each robot, shape (n,), from 0 on; twins have the same."""
    count: int
    """Different robots. Environments of one seed and count agree on the robot of a number."""


def generator(seed: int | list[int], twins: Twins | None = None) -> np.random.Generator:
    """Generator of a seed; with twins, one whose draws for all n robots are theirs.

    A draw is for all robots if the first axis of its size is n; others are plain ones of a
    separate generator.
    """
    plain = np.random.default_rng(seed)
    return plain if twins is None else cast(np.random.Generator, _SharedDraws(plain, twins))


class _SharedDraws:
    """The methods of a generator that the environment uses."""

    def __init__(self, rng: np.random.Generator, twins: Twins):
        self._rng, self._twins = rng, twins
        self._other = rng.spawn(1)[0]
        self.bit_generator = rng.bit_generator

    def uniform(self, low: Any, high: Any, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.uniform(low, high, size), size)

    def random(self, size: Any, dtype: Any = np.float64) -> Any:
        return self._drawn(lambda rng, size: rng.random(size, dtype), size)

    def integers(self, low: int, high: int, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.integers(low, high, size), size)

    def exponential(self, scale: float, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.exponential(scale, size), size)

    def standard_normal(self, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.standard_normal(size), size)

    def _drawn(self, draw: Callable[[np.random.Generator, tuple[int, ...]], Any], size: Any) -> Any:
        first, *rest = np.atleast_1d(size).tolist()
        if first != len(self._twins.number):
            return draw(self._other, (first, *rest))
        return draw(self._rng, (self._twins.count, *rest))[self._twins.number]
