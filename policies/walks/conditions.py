"""Conditions of a walk: who walks, on which ground, at which command, and what makes it harder.

Robots walk by the policy, by the open-loop trot, which sees nothing and has a clock, or they stand.
`policies.walks.together` lets them walk under many conditions at once, and a `Recorder` keeps what
is wanted of each step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.policies.walks.handicaps import Handicap
from pupper_sysid.sim.walking.config import Commands, Curriculum, Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.step import Step

Array = NDArray[np.float64]
Kept = TypeVar("Kept", covariant=True)

DIRECTIONS = {
    "forward": (0.15, 0.0, 0.0),
    "backward": (-0.15, 0.0, 0.0),
    "left": (0.0, 0.08, 0.0),
    "right": (0.0, -0.08, 0.0),
    "turn left": (0.0, 0.0, 0.4),
    "turn right": (0.0, 0.0, -0.4),
    "stand": (0.0, 0.0, 0.0),
}
"""Commands [m/s, m/s, rad/s] of the table by direction."""

RANDOM = Commands((-0.2, 0.2), (-0.1, 0.1), (-0.5, 0.5), standing=0.0, single=0.0, every_s=5.0)
"""Random commands: uniform in all three at once, new ones at exponential intervals."""

Walker = Literal["policy", "trot", "standing"]
"""By what a robot walks: the policy; an open-loop trot with a clock, which sees nothing but its
command (`Trot()`, or the one that the training fitted to its servos); or set-points that stay."""

Change = Callable[[int, NDArray[np.float32]], NDArray[np.floating]]
"""`change(step, observation)` returns the observation, shape (n, 60), for the policy; it may alter
the one it was given."""

Disturb = Callable[[int, PupperEnv, NDArray[np.intp]], None]
"""`disturb(step, environment, robots)` acts on the robots of its condition before their action,
such as a push."""


@dataclass(frozen=True)
class Condition:
    """What some robots walk under."""

    task: Walking
    """See `evaluation_task`."""
    robots: int
    command: tuple[float, float, float] | None = None
    """Forward and sideways speed [m/s], turn rate [rad/s]; None for those of `RANDOM`."""
    extra_dead_time_s: float = 0.0
    """Added to the dead time of every servo."""
    change: Change | None = None
    """Alters observations."""
    disturb: Disturb | None = None
    """Acts on the robots."""
    walker: Walker = "policy"
    handicap: Handicap = field(default_factory=Handicap)


@dataclass(frozen=True)
class Moment:
    """One control step of all robots of an environment."""

    observation: NDArray[np.float32]
    """As given to the policy, shape (n, 60)."""
    action: NDArray[np.floating]
    command: Array
    facts: Step
    """After the step."""
    alive: NDArray[np.bool_]
    """Robots that have neither fallen nor left the ground's edge so far."""
    fell: NDArray[np.bool_]
    """Robots that fell in this step."""


class Actor(Protocol):
    """Acts for many robots at once and keeps their states: a `Policy`, or one of another trainer.

    Observations and actions are those of the walking task; see `Policy`.
    """

    def reset(self, action: np.ndarray) -> None:
        """Start an episode of all robots after their last `action`."""
        ...

    def act(self, observation: np.ndarray, missed: np.ndarray | None = None) -> np.ndarray:
        """Actions for observations; the states of robots in the mask `missed` stay."""
        ...


class Recorder(Protocol[Kept]):
    """Keeps what is wanted of the walks in an environment."""

    def keep(self, now: Moment) -> None:
        """Take the next control step."""
        ...

    def of(self, condition: Condition, robots: slice, steps: int, commands: Array) -> Kept:
        """What was kept of the robots of a condition in the first `steps`.

        `commands` are those of the whole walk, shape (all steps, robots, 3), also of steps that
        were not taken because no robot was up.
        """
        ...


def evaluation_task(task: Walking, seconds: float | None = None) -> Walking:
    """`task` as it is evaluated: random commands, no curriculum, no pushes, no thrown start.

    In the physics of evaluation (`Walking.evaluated`).
    """
    gentle = replace(
        task.randomisation, push_m_s=0.0, on_the_move=0.0, joint_rad=0.05, joint_rad_s=0.0,
        base_velocity_m_s=(0.0, 0.0, 0.0), base_rate_rad_s=(0.0, 0.0, 0.0),
    )  # fmt: skip
    commands = RANDOM
    if task.robot:  # as far within the robot's own ranges
        own = task.commands
        commands = replace(
            RANDOM, forward_m_s=own.forward_m_s, sideways_m_s=own.sideways_m_s,
            yaw_rad_s=own.yaw_rad_s, dead_band=own.dead_band,
        )  # fmt: skip
    return replace(
        task.evaluated(), commands=commands, curriculum=Curriculum(), randomisation=gentle,
        episode_s=task.episode_s if seconds is None else seconds,
    )  # fmt: skip


def share_of_usual(task: Walking) -> Array:
    """Largest commands of a task over those of `RANDOM`, shape (3,)."""
    own, usual = (
        np.abs([c.forward_m_s, c.sideways_m_s, c.yaw_rad_s]).max(axis=1)
        for c in (task.commands, RANDOM)
    )
    return own / usual


def random_commands(
    robots: int, steps: int, step_s: float, seed: int, commands: Commands = RANDOM
) -> Array:
    """Commands of `RANDOM`, or others, for each robot and step, shape (steps, robots, 3)."""
    rng = np.random.default_rng([seed, 3])
    low, high = np.array([commands.forward_m_s, commands.sideways_m_s, commands.yaw_rad_s]).T
    drawn = rng.uniform(low, high, (steps, robots, 3))
    # of exponential intervals, memoryless: in each step a new one comes with this chance
    new = rng.random((steps, robots)) < 1 - np.exp(-step_s / commands.every_s)
    new[0] = True
    since = np.maximum.accumulate(np.where(new, np.arange(steps)[:, None], 0), axis=0)
    return np.take_along_axis(drawn, since[..., None], axis=0)
