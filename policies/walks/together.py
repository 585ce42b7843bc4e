"""Walks under many conditions at once: by which walker, on which ground, at which command.

Robots walk by the policy, by the open-loop trot, which sees nothing and has a clock, or they stand.
A `StepRecorder` keeps what is wanted of each step. All conditions of one task (one kind of ground)
share an environment, since commands, dead times and handicaps are each robot's own; two
environments run at a time, so that one computes its physics while the other acts and reads. Robot k
of every condition is the same robot (servos, friction, start, noise, random commands, pushes,
missed ticks) until one falls, whatever it walks by, so that conditions differ in nothing else.
Robots and terrain are others than those of a training with the same seed.

A handicap makes a walk harder for some robots of a batch. A slope is a plane whose gravity is
tilted, which is the same physics; the direction of gravity that a policy sees is tilted with it. So
robots on slopes, with loads, weak legs or slippery feet share a batch with all others on flat
ground. Robots begin at random headings, so a slope is walked up, down and across.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from copy import deepcopy
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Generic, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import TRUNK_BOX_AT_M, TRUNK_BOX_M
from pupper_sysid.sim.robot.robot_batch import RobotBatch, trunk_velocity
from pupper_sysid.sim.robot.terrain import STAIRS_M
from pupper_sysid.sim.walking.config import Commands, Curriculum, Walking
from pupper_sysid.sim.walking.draws import OF_MOTOR, Twins, at_rest, command_ends
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_model_of
from pupper_sysid.sim.walking.step import OBSERVATION_PARTS, Step

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
command (that of the task, with which a training began); or set-points that stay."""

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
    largest, usual = (np.abs(command_ends(c)).max(axis=0) for c in (task.commands, RANDOM))
    share = largest / usual
    if not share.all():
        share = np.where(share > 0, share, task.body.command_scale)
    return share if task.robot else np.minimum(share, 1.0)


def within(task: Walking, usual: Array) -> Array:
    """Commands that are as far within a task's ranges as `usual` ones within those of `RANDOM`.

    Both have the shape (n, 3).
    """
    return np.clip(share_of_usual(task) * usual, *command_ends(task.commands))


def random_commands(
    robots: int, steps: int, step_s: float, seed: int, commands: Commands = RANDOM
) -> Array:
    """Commands of `RANDOM`, or others, for each robot and step, shape (steps, robots, 3)."""
    rng = np.random.default_rng([seed, 3])
    low, high = command_ends(commands)
    drawn = rng.uniform(low, high, (steps, robots, 3))
    # of exponential intervals, memoryless: in each step a new one comes with this chance
    new = rng.random((steps, robots)) < 1 - np.exp(-step_s / commands.every_s)
    new[0] = True
    since = np.maximum.accumulate(np.where(new, np.arange(steps)[:, None], 0), axis=0)
    return np.take_along_axis(drawn, since[..., None], axis=0)


T = TypeVar("T")
PolicyT = TypeVar("PolicyT", bound=Actor)

_SEED = 2_000_003  # added to a seed: a training with the same one has other robots
_MOST_ROBOT_S = 1e6
_MOST_DELAY_S = 2.0
_AT_A_TIME = 2  # environments: one steps while the other acts
_COMMAND = OBSERVATION_PARTS["command"]


def walk_together(
    policy: PolicyT | None,
    servos: ServoRanges,
    conditions: Sequence[Condition],
    seconds: float,
    seed: int,
    threads: int,
    recorder: Callable[[PupperEnv, PolicyT | None, Sequence[Condition]], StepRecorder[T]],
    progress: Callable[[float], None] = lambda share: None,
) -> list[T]:
    """Walk from a gentle start under every condition; what the recorders kept, by condition.

    The policy keeps its own state; None stands still. A walk ends sooner when no robot of the
    condition is up any more. The seed is that of servos, friction, start, noise and random
    commands; results do not depend on `threads` (of the physics; 0 for all cores). `recorder` makes
    the recorder of an environment, with its conditions in the order of its robots and its policy,
    which acts there alone; `progress` is called with the share of the work that is done, from any
    thread.
    """
    _refuse_impossible(conditions, seconds, threads)
    step_s = max(c.task.control_step_s for c in conditions)
    if round(seconds / step_s) < 1:
        raise InputError(f"A rollout of {seconds} s is shorter than one step of {step_s} s.")
    # environments draw alike: of as many different robots, and with jitter if any condition has it
    count = max(c.robots for c in conditions)
    jitter = any(c.handicap.extra_jitter_s for c in conditions)
    done, lock, stop = 0.0, threading.Lock(), threading.Event()
    total = seconds * sum(c.robots for c in conditions)
    results: dict[int, T] = {}

    def advance(robot_seconds: float) -> bool:
        """Count what was walked; whether to go on."""
        nonlocal done
        with lock:
            done += robot_seconds
            progress(min(done / total, 1.0))
        return not stop.is_set()

    def walk(environments: list[list[int]], threads: int) -> None:
        for chosen in environments:
            batch = [conditions[i] for i in chosen]
            group = _Group(policy, servos, batch, seconds, seed, threads, count, jitter, recorder)
            if not group.walk(advance):
                return
            results.update(zip(chosen, group.results(), strict=True))

    shares = _shares(conditions)
    cores = threads or os.cpu_count() or 1
    workers = min(len(shares), cores)
    with ThreadPoolExecutor(workers) as pool:
        threads_of = [cores // workers + (k < cores % workers) for k in range(workers)]
        running = [pool.submit(walk, s, threads_of[k % workers]) for k, s in enumerate(shares)]
        try:
            wait(running, return_when="FIRST_EXCEPTION")
        finally:  # after Ctrl-C, or an error in one of them, the others end with their step
            stop.set()
        for future in running:
            future.result()
    return [results[i] for i in range(len(conditions))]


def _refuse_impossible(conditions: Sequence[Condition], seconds: float, threads: int) -> None:
    """Refuse what no machine could walk."""
    robots = sum(c.robots for c in conditions)
    if not robots * seconds <= _MOST_ROBOT_S:
        raise InputError(
            f"{robots:.3g} robots for {seconds:g} s each are more than {_MOST_ROBOT_S:g} s of "
            "walking. Give fewer of them, or less time."
        )
    if threads < 0:
        raise InputError(f"`threads` is {threads}; it must be 0 (all cores) or more.")
    extra = max(c.extra_dead_time_s for c in conditions)
    if not extra <= _MOST_DELAY_S:
        raise InputError(
            f"A dead time of {1e3 * extra:g} ms more is beyond {1e3 * _MOST_DELAY_S:g} ms."
        )


def _shares(conditions: Sequence[Condition]) -> list[list[list[int]]]:
    """Conditions by worker, of like amounts of work, and by environment."""
    shares: list[list[int]] = [[] for _ in range(_AT_A_TIME)]

    def work(share: list[int]) -> int:
        return sum(conditions[i].robots for i in share)

    for i in sorted(range(len(conditions)), key=lambda i: -conditions[i].robots):
        min(shares, key=work).append(i)
    environments = []
    for share in filter(None, shares):
        groups: dict[Walking, list[int]] = {}
        for i in sorted(share):
            groups.setdefault(conditions[i].task, []).append(i)
        environments.append(list(groups.values()))
    return environments


class _Group:
    """An environment, and the conditions of its robots."""

    def __init__(
        self, policy: Actor | None, servos: ServoRanges, conditions: Sequence[Condition],
        seconds: float, seed: int, threads: int, count: int,
        jitter: bool, recorder: Callable[..., StepRecorder],
    ):  # fmt: skip
        step_s = conditions[0].task.control_step_s
        self.conditions, self.step_s, self.steps = conditions, step_s, round(seconds / step_s)
        ends = np.cumsum([0, *(c.robots for c in conditions)]).tolist()
        self.robots = [slice(a, b) for a, b in pairwise(ends)]
        number = np.concatenate([np.arange(c.robots) for c in conditions])

        def per_robot(values: Sequence[float]) -> Array:
            return np.repeat(np.array(values), [c.robots for c in conditions])

        # a step longer, so that no episode times out within it
        task = replace(conditions[0].task, episode_s=(self.steps + 1) * step_s)
        self.env = PupperEnv(
            task, servos, ends[-1], _SEED + seed, threads, servo_model_of(servos.source, step_s),
            per_robot([c.extra_dead_time_s for c in conditions]), Twins(number, count),
            per_robot([c.handicap.extra_jitter_s for c in conditions]) if jitter else None,
        )  # fmt: skip
        for condition, robots in zip(conditions, self.robots, strict=True):
            impose(self.env.robots, _numbers(robots), condition.handicap)
        self.policy = deepcopy(policy)  # a recorder's hooks must see this environment only
        self.recorder = recorder(self.env, self.policy, conditions)
        random = random_commands(
            count, self.steps, step_s, seed, task.commands if task.robot else RANDOM
        )
        commands = np.concatenate(
            [
                random[:, : c.robots] if c.command is None
                else np.broadcast_to(c.command, (self.steps, c.robots, 3))
                for c in conditions
            ],
            axis=1,
        )  # fmt: skip
        self.commands = at_rest(task.commands, commands.reshape(-1, 3)).reshape(commands.shape)
        self.pushes = push_directions(count, self.steps, step_s, seed)
        chance = per_robot([c.handicap.missed_ticks for c in conditions])
        self.missed = missed_ticks(count, self.steps, seed)[:, number] < chance
        self.led, self.trotting = (
            np.flatnonzero(np.repeat([c.walker == w for c in conditions], np.diff(ends)))
            for w in ("policy", "trot")
        )
        self.trot = task.trot
        self.last = np.zeros(len(conditions), int)  # steps until none of a condition was up

    def walk(self, advance: Callable[[float], bool]) -> bool:
        """Walk to the end; False if `advance` requested a stop."""
        env, n = self.env, self.env.environments
        observation, _ = env.observe()
        alive = np.ones(n, bool)
        if self.policy:
            self.policy.reset(env.action[self.led])
        for step, command in enumerate(self.commands):
            env.set_command(command)
            observation[:, _COMMAND] = command
            self._handicap(step, observation)
            action = self._action(step, observation)
            for condition, robots in zip(self.conditions, self.robots, strict=True):
                if condition.disturb:
                    condition.disturb(step, env, _numbers(robots))
            result = env.step(action)
            up = np.array([alive[robots].any() for robots in self.robots])
            self.last[up] = step + 1
            fell = alive & result.done & ~result.timed_out
            alive = alive & ~result.done
            self.recorder.keep(Moment(observation, action, command, result.facts, alive, fell))
            observation = result.observation
            skipped = self.steps - step - 1 if not alive.any() else 0
            if not advance((1 + skipped) * n * self.step_s):
                return False
            if skipped:
                break
        return True

    def _handicap(self, step: int, observation: NDArray[np.float32]) -> None:
        """Push robots, and alter what they see."""
        direction = self.pushes.get(step)
        for condition, robots in zip(self.conditions, self.robots, strict=True):
            if condition.handicap.push_m_s and direction is not None:
                ids, added = _numbers(robots), condition.handicap.push_m_s * direction
                self.env.robots.push(ids, self.env.robots.qvel[ids, :2] + added[: len(ids)])
            see_slope(observation[robots], _numbers(robots), self.env.robots, condition.handicap)
            if condition.change:
                observation[robots] = condition.change(step, observation[robots])

    def _action(self, step: int, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """What each robot does by its walker."""
        env, missed = self.env, self.missed[step]
        action = np.zeros((env.environments, len(env.default)), np.float32)
        if self.policy and len(self.led):
            late = missed[self.led]
            # policies need not support missed ticks where there are none
            more = (late,) if late.any() else ()
            action[self.led] = self.policy.act(observation[self.led], *more)
        if len(self.trotting):
            angle = 2 * np.pi * self.trot.frequency_hz * step * self.step_s
            phase = np.full(len(self.trotting), angle)
            joints = self.trot.joints(phase, self.commands[step, self.trotting], env.body)
            action[self.trotting] = (joints - env.default) / env.config.action_scale
        action[missed] = env.action[missed]
        return action

    def results(self) -> list:
        """What was kept, by condition."""
        groups = zip(self.conditions, self.robots, self.last.tolist(), strict=True)
        return [self.recorder.of(c, robots, n, self.commands[:, robots]) for c, robots, n in groups]


def _numbers(robots: slice) -> NDArray[np.intp]:
    return np.arange(robots.start, robots.stop)
