"""Walks of a policy under many conditions at once.

A condition is a task, a command, a longer dead time, altered observations or pushed robots. All
conditions of one task (one kind of ground) share an environment, since commands and dead times are
each robot's own; two environments run at a time, so that one computes its physics while the other
acts and reads. Robot k of every condition is the same robot (servos, friction, start, noise,
random commands) until one falls, so that conditions differ in nothing else.

`walk_together` runs them, and a `Recorder` keeps what is wanted of each step.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.sim.walking.config import Commands, Curriculum, Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.observation import OBSERVATION_PARTS
from pupper_sysid.sim.walking.rewards import Step
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_model_of
from pupper_sysid.sim.walking.shared_draws import Twins

Array = NDArray[np.float64]
T = TypeVar("T")
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

_AT_A_TIME = 2  # environments: one steps while the other acts
_COMMAND = OBSERVATION_PARTS["command"]

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


class Recorder(Protocol[Kept]):
    """Keeps what is wanted of the walks in an environment."""

    def keep(self, now: Moment) -> None:
        """Take the next control step."""
        ...

    def of(self, condition: Condition, robots: slice, steps: int) -> Kept:
        """What was kept of the robots of a condition in the first `steps`."""
        ...


def evaluation_task(task: Walking, seconds: float | None = None) -> Walking:
    """`task` as it is evaluated: random commands, no curriculum, no pushes, no thrown start.

    In the physics of evaluation (`Walking.evaluated`).
    """
    gentle = replace(
        task.randomisation, push_m_s=0.0, on_the_move=0.0, joint_rad=0.05, joint_rad_s=0.0,
        base_velocity_m_s=(0.0, 0.0, 0.0), base_rate_rad_s=(0.0, 0.0, 0.0),
    )  # fmt: skip
    return replace(
        task.evaluated(), commands=RANDOM, curriculum=Curriculum(), randomisation=gentle,
        episode_s=task.episode_s if seconds is None else seconds,
    )  # fmt: skip


def walk_together(
    policy: Policy | None,
    servos: ServoRanges,
    conditions: Sequence[Condition],
    seconds: float,
    seed: int,
    threads: int,
    recorder: Callable[[PupperEnv, Policy | None, Sequence[Condition]], Recorder[T]],
    progress: Callable[[float], None] = lambda share: None,
) -> list[T]:
    """Walk from a gentle start under every condition.

    Parameters
    ----------
    policy : Policy or None
        Keeps its own state; None stands still.
    servos : ServoRanges
    conditions : sequence of Condition
    seconds : float
        Duration; a walk ends sooner when no robot of the condition is up any more.
    seed : int
        Of servos, friction, start, noise and random commands.
    threads : int
        Of the physics; 0 for all cores. Results do not depend on it.
    recorder : callable
        Makes the recorder of an environment, with its conditions in the order of its robots and
        its policy, which acts there alone.
    progress : callable
        Called with the share of the work that is done, from any thread.

    Returns
    -------
    list
        What the recorders kept, by condition.

    Raises
    ------
    InputError
        If `seconds` is shorter than a step, or an environment cannot be made.
    """
    step_s = max(c.task.control_step_s for c in conditions)
    if round(seconds / step_s) < 1:
        raise InputError(f"A rollout of {seconds} s is shorter than one step of {step_s} s.")
    different = max(c.robots for c in conditions)
    done, lock, stop = 0.0, threading.Lock(), threading.Event()
    total = seconds * sum(c.robots for c in conditions)
    found: dict[int, T] = {}

    def advance(robot_seconds: float) -> bool:
        """Count what was walked; whether to go on."""
        nonlocal done
        with lock:
            done += robot_seconds
            progress(min(done / total, 1.0))
        return not stop.is_set()

    def walk(environments: list[list[int]], threads: int) -> None:
        for chosen in environments:
            own = [conditions[i] for i in chosen]
            group = _Group(policy, servos, own, seconds, seed, threads, different, recorder)
            if not group.walk(advance):
                return
            found.update(zip(chosen, group.found(), strict=True))

    shares = _shares(conditions)
    cores = threads or os.cpu_count() or 1
    workers = min(len(shares), cores)
    with ThreadPoolExecutor(workers) as pool:
        each = [cores // workers + (k < cores % workers) for k in range(workers)]
        running = [pool.submit(walk, s, each[k % workers]) for k, s in enumerate(shares)]
        try:
            wait(running, return_when="FIRST_EXCEPTION")
        finally:  # after Ctrl-C, or an error in one of them, the others end with their step
            stop.set()
        for one in running:
            one.result()
    return [found[i] for i in range(len(conditions))]


def _shares(conditions: Sequence[Condition]) -> list[list[list[int]]]:
    """Conditions by worker, of like amounts of work, and by environment."""
    shares: list[list[int]] = [[] for _ in range(_AT_A_TIME)]

    def work(share: list[int]) -> int:
        return sum(conditions[i].robots for i in share)

    for i in sorted(range(len(conditions)), key=lambda i: -conditions[i].robots):
        min(shares, key=work).append(i)
    return [_by_task(conditions, sorted(share)) for share in shares if share]


def _by_task(conditions: Sequence[Condition], chosen: Sequence[int]) -> list[list[int]]:
    groups: list[list[int]] = []
    for i in chosen:
        same = (g for g in groups if conditions[g[0]].task == conditions[i].task)
        group = next(same, None)
        if group is None:
            groups.append([i])
        else:
            group.append(i)
    return groups


class _Group:
    """An environment, and the conditions of its robots."""

    def __init__(
        self, policy: Policy | None, servos: ServoRanges, conditions: Sequence[Condition],
        seconds: float, seed: int, threads: int, different: int,
        recorder: Callable[[PupperEnv, Policy | None, Sequence[Condition]], Recorder],
    ):  # fmt: skip
        step_s = conditions[0].task.control_step_s
        self.conditions, self.step_s, self.steps = conditions, step_s, round(seconds / step_s)
        ends = np.cumsum([0, *(c.robots for c in conditions)]).tolist()
        self.robots = [slice(a, b) for a, b in pairwise(ends)]
        number = np.concatenate([np.arange(c.robots) for c in conditions])
        extra = np.concatenate([np.full(c.robots, c.extra_dead_time_s) for c in conditions])
        # a step longer, so that no episode times out within it
        task = replace(conditions[0].task, episode_s=(self.steps + 1) * step_s)
        self.env = PupperEnv(
            task, servos, ends[-1], seed, threads, servo_model_of(servos.source, step_s), extra,
            Twins(number, different),
        )  # fmt: skip
        self.policy = deepcopy(policy)  # hooks of a recorder hear this environment only
        self.recorder = recorder(self.env, self.policy, conditions)
        random = _random_commands(different, self.steps, step_s, seed)
        self.commands = np.concatenate(
            [
                random[:, : c.robots] if c.command is None
                else np.broadcast_to(c.command, (self.steps, c.robots, 3))
                for c in conditions
            ],
            axis=1,
        )  # fmt: skip
        self.last = np.zeros(len(conditions), int)  # steps until none of a condition was up

    def walk(self, advance: Callable[[float], bool]) -> bool:
        """Walk to the end; False if `advance` said to stop."""
        env, policy, n = self.env, self.policy, self.env.environments
        observation, _ = env.observe()
        alive = np.ones(n, bool)
        if policy:
            policy.reset(env.action)
        for step, command in enumerate(self.commands):
            env.set_command(command)
            observation[:, _COMMAND] = command
            for own, robots in zip(self.conditions, self.robots, strict=True):
                if own.change:
                    observation[robots] = own.change(step, observation[robots])
            action = policy.act(observation) if policy else np.zeros((n, 12), np.float32)
            for own, robots in zip(self.conditions, self.robots, strict=True):
                if own.disturb:
                    own.disturb(step, env, np.arange(n)[robots])
            result = env.step(action)
            up = np.array([alive[robots].any() for robots in self.robots])
            self.last[up] = step + 1
            fell = alive & result.done & ~result.timed_out
            alive = alive & ~result.done
            self.recorder.keep(Moment(observation, action, command, result.facts, alive, fell))
            observation = result.observation
            left = self.steps - step - 1 if not alive.any() else 0
            if not advance((1 + left) * n * self.step_s):
                return False
            if left:
                break
        return True

    def found(self) -> list:
        """What was kept, by condition."""
        given = zip(self.conditions, self.robots, self.last.tolist(), strict=True)
        return [self.recorder.of(c, robots, steps) for c, robots, steps in given]


def _random_commands(robots: int, steps: int, step_s: float, seed: int) -> Array:
    """Commands of `RANDOM` for each robot and step, shape (steps, robots, 3)."""
    rng = np.random.default_rng([seed, 3])
    low, high = np.array([RANDOM.forward_m_s, RANDOM.sideways_m_s, RANDOM.yaw_rad_s]).T
    drawn = rng.uniform(low, high, (steps, robots, 3))
    # of exponential intervals, memoryless: in each step a new one comes with this chance
    new = rng.random((steps, robots)) < 1 - np.exp(-step_s / RANDOM.every_s)
    new[0] = True
    since = np.maximum.accumulate(np.where(new, np.arange(steps)[:, None], 0), axis=0)
    return np.take_along_axis(drawn, since[..., None], axis=0)
