"""Conditions of a walk: which walker, on which ground, at which command, and what makes it harder.

Robots walk by the policy, by the open-loop trot, which sees nothing and has a clock, or they stand.
`policies.walks.together` lets them walk under many conditions at once, and a `StepRecorder` keeps
what is wanted of each step.

A handicap makes a walk harder for some robots of a batch. A slope is a plane whose gravity is
tilted, which is the same physics; the direction of gravity that a policy sees is tilted with it. So
robots on slopes, with loads, weak legs or slippery feet share a batch with all others on flat
ground. Robots begin at random headings, so a slope is walked up, down and across. What is random
comes from the seed and the robot's number: the same robot has the same pushes and missed ticks
under every condition and by whatever it walks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import TRUNK_BOX_AT_M, TRUNK_BOX_M
from pupper_sysid.sim.robot.robot_batch import RobotBatch, trunk_velocity
from pupper_sysid.sim.robot.terrain import STAIRS_M
from pupper_sysid.sim.walking.config import Commands, Curriculum, Walking
from pupper_sysid.sim.walking.differences import OF_MOTOR
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.observation import OBSERVATION_PARTS
from pupper_sysid.sim.walking.step import Step

Array = NDArray[np.float64]

FIRST_PUSH_S, PUSH_EVERY_S = 3.0, 4.0
_GRAVITY = OBSERVATION_PARTS["projected_gravity"]
_ABOVE_M = TRUNK_BOX_AT_M[2] + TRUNK_BOX_M[2]  # loads lie on the trunk


@dataclass(frozen=True)
class Handicap:
    """What makes a robot's walk harder; the default is nothing."""

    push_m_s: float = 0.0
    """Horizontal speed that a push adds to the trunk, in a random direction, every 4 s from 3 s
    on."""
    slope_deg: float = 0.0
    """Slope of the ground."""
    riser_m: float | None = None
    """Height of steps, one of `STAIRS_M`; the task's ground must be `stairs`."""
    payload_kg: float = 0.0
    """Point mass on the trunk."""
    payload_at_m: tuple[float, float] = (0.0, 0.0)
    """Where it lies: forward and to the left of the trunk's origin."""
    weak_leg: float = 1.0
    """Factor on the torque of the motors of one leg, robot k's leg k of the body's and again;
    their friction stays."""
    missed_ticks: float = 0.0
    """Chance that a control tick is missed: the set-points stay, and the policy does not run."""
    extra_jitter_s: float = 0.0
    """Added to the standard deviation of the commands' latency [s]; its mean stays."""
    friction: float | None = None
    """Sliding friction of the feet on the ground, instead of the task's."""

    @property
    def gravity_direction(self) -> Array:
        """Unit vector, shape (3,), in axes of which the third is the ground's normal."""
        angle = np.radians(self.slope_deg)
        return np.array([np.sin(angle), 0.0, -np.cos(angle)])

    def since_push_s(self, time_s: float) -> float | None:
        """Time since the last push; None if there was none."""
        if not self.push_m_s or time_s < FIRST_PUSH_S:
            return None
        return (time_s - FIRST_PUSH_S) % PUSH_EVERY_S


def impose(robots: RobotBatch, ids: NDArray[np.intp], handicap: Handicap) -> None:
    """Give robots a handicap, at the start of their walk.

    `ids` are robots in the order of their numbers, from 0 on.
    """
    if handicap.weak_leg != 1.0:
        leg_of, legs = robots.body.leg_of, len(robots.body.feet)
        of_weak_leg = leg_of == (np.arange(len(ids)) % legs)[:, None]
        for name in OF_MOTOR:
            robots.drawn[name][ids] *= np.where(of_weak_leg, handicap.weak_leg, 1.0)
    if handicap.friction is not None:
        robots.friction[ids] = handicap.friction
    if handicap.weak_leg != 1.0 or handicap.friction is not None:
        robots.write(ids)
    if handicap.payload_kg:
        above_m = _ABOVE_M * robots.body.scale
        _load(robots, ids, handicap.payload_kg, np.array([*handicap.payload_at_m, above_m]))
    if handicap.slope_deg:
        size = np.linalg.norm(robots.model.opt.gravity)
        robots.field("opt.gravity")[ids] = size * handicap.gravity_direction
    if handicap.riser_m is not None:
        # pyramids are wider than the square in which robots are placed
        robots.move(ids, STAIRS_M[handicap.riser_m] + 3.0 * robots.qpos[ids, :2])


def _load(robots: RobotBatch, ids: NDArray[np.intp], mass_kg: float, at: Array) -> None:
    """Fix a point mass to the trunk."""
    trunk = robots.model.body(robots.body.trunk).id
    mass, place, axes, inertia = (
        robots.field(name) for name in ("body_mass", "body_ipos", "body_iquat", "body_inertia")
    )
    for i in ids:
        before, centre = mass[i, trunk], place[i, trunk].copy()
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, axes[i, trunk])
        turn = turn.reshape(3, 3)
        total_kg = before + mass_kg
        away = at - centre
        # of both about their common centre: parallel axes with the reduced mass
        tensor = turn @ np.diag(inertia[i, trunk]) @ turn.T
        tensor += before * mass_kg / total_kg * (away @ away * np.eye(3) - np.outer(away, away))
        moments, turn = np.linalg.eigh(tensor)
        turn[:, 0] *= np.linalg.det(turn)
        mujoco.mju_mat2Quat(axes[i, trunk], turn.ravel())
        mass[i, trunk], inertia[i, trunk] = total_kg, moments
        place[i, trunk] = centre + mass_kg / total_kg * away
    robots.batch.set_const(ids)


def see_slope(
    observation: NDArray[np.float32], ids: NDArray[np.intp], robots: RobotBatch, handicap: Handicap
) -> None:
    """Tilt the gravity that robots on a slope see; `observation` is theirs, shape (k, 60)."""
    if handicap.slope_deg:
        flat = np.array([0.0, 0.0, -1.0])
        added = np.zeros((len(ids), 6))
        added[:, :3] = handicap.gravity_direction - flat
        observation[:, _GRAVITY] += trunk_velocity(robots.qpos[ids], added)


def push_directions(robots: int, steps: int, step_s: float, seed: int) -> dict[int, Array]:
    """Unit vectors, shape (robots, 2), by the control step before which robots are pushed."""
    first, interval = round(FIRST_PUSH_S / step_s), round(PUSH_EVERY_S / step_s)
    rng = np.random.default_rng([seed, 5])
    directions = {}
    for step in range(first, steps, interval):
        angle = rng.uniform(-np.pi, np.pi, robots)
        directions[step] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return directions


def missed_ticks(robots: int, steps: int, seed: int) -> Array:
    """Numbers in 0–1, shape (steps, robots): a tick is missed where they are below its chance."""
    chances = np.random.default_rng([seed, 4]).random((steps, robots))
    chances[0] = 1.0  # the first tick begins the walk
    return chances


Kept = TypeVar("Kept")

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


class StepRecorder(Generic[Kept]):
    """Keeps what is wanted of the walks in an environment: arrays of each step, and the falls."""

    def __init__(self, env: PupperEnv, policy: Actor | None, conditions: Sequence[Condition]):
        self.env, self.fell = env, np.zeros(env.environments, bool)
        self.steps: list[dict[str, NDArray]] = []

    def keep(self, now: Moment) -> None:
        """Take the next control step."""
        self.fell |= now.fell
        self.steps.append(self.arrays(now))

    def arrays(self, now: Moment) -> dict[str, NDArray]:
        """What is kept of a step by name, (n, …), not to be overwritten."""
        raise NotImplementedError

    def of(self, condition: Condition, robots: slice, steps: int, commands: Array) -> Kept:
        """What was kept of the robots of a condition in the first `steps`.

        `commands` are those of the whole walk, shape (all steps, robots, 3), also of steps that
        were not taken because no robot was up.
        """
        raise NotImplementedError

    def stacked(self, robots: slice, steps: int) -> dict[str, NDArray]:
        """Arrays of some robots over the first steps, (steps, k, …)."""
        first = self.steps[:steps]
        return {name: np.stack([step[name][robots] for step in first]) for name in first[0]}


def evaluation_task(task: Walking, seconds: float | None = None) -> Walking:
    """`task` as it is evaluated: random commands, no curriculum, no pushes, no thrown start.

    In the physics of evaluation (`Walking.evaluated`).
    """
    gentle = replace(
        task.randomisation, push_m_s=0.0, on_the_move=0.0, joint_rad=0.05, joint_rad_s=0.0,
        base_velocity_m_s=(0.0, 0.0, 0.0), base_rate_rad_s=(0.0, 0.0, 0.0),
    )  # fmt: skip
    commands = RANDOM
    if task.robot:  # as far within the robot's ranges
        commands = replace(task.commands, standing=0.0, single=0.0, every_s=RANDOM.every_s)
    return replace(
        task.evaluated(), commands=commands, curriculum=Curriculum(), randomisation=gentle,
        episode_s=task.episode_s if seconds is None else seconds,
    )  # fmt: skip


def share_of_usual(task: Walking) -> Array:
    """Largest commands of a task over those of `RANDOM`, shape (3,); Froude's where it has none.

    Of the Mini Pupper at most 1; those of another robot are its own, as large as they are.
    """
    largest, usual = (np.abs(_ranges(c)).max(axis=1) for c in (task.commands, RANDOM))
    share = largest / usual
    if not share.all():
        share = np.where(share > 0, share, task.body.command_scale)
    return share if task.robot else np.minimum(share, 1.0)


def within(task: Walking, usual: Array) -> Array:
    """Commands that are as far within a task's ranges as `usual` ones within those of `RANDOM`.

    Both have the shape (n, 3).
    """
    return np.clip(share_of_usual(task) * usual, *_ranges(task.commands).T)


def _ranges(commands: Commands) -> Array:
    """Lowest and highest of each part, shape (3, 2)."""
    return np.array([commands.forward_m_s, commands.sideways_m_s, commands.yaw_rad_s])


def random_commands(
    robots: int, steps: int, step_s: float, seed: int, commands: Commands = RANDOM
) -> Array:
    """Commands of `RANDOM`, or others, for each robot and step, shape (steps, robots, 3)."""
    rng = np.random.default_rng([seed, 3])
    low, high = _ranges(commands).T
    drawn = rng.uniform(low, high, (steps, robots, 3))
    # of exponential intervals, memoryless: in each step a new one comes with this chance
    new = rng.random((steps, robots)) < 1 - np.exp(-step_s / commands.every_s)
    new[0] = True
    since = np.maximum.accumulate(np.where(new, np.arange(steps)[:, None], 0), axis=0)
    return np.take_along_axis(drawn, since[..., None], axis=0)
