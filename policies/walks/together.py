"""Walks under many conditions at once.

All conditions of one task (one kind of ground) share an environment, since commands, dead times and
handicaps are each robot's own; two environments run at a time, so that one computes its physics
while the other acts and reads. Robot k of every condition is the same robot (servos, friction,
start, noise, random commands, pushes) until one falls, whatever it walks by, so that conditions
differ in nothing else.

Robots and terrain are others than those of a training with the same seed.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.walks.conditions import (
    RANDOM,
    Actor,
    Condition,
    Moment,
    StepRecorder,
    impose,
    missed_ticks,
    push_directions,
    random_commands,
    see_slope,
)
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import PRESETS, Walking
from pupper_sysid.sim.walking.draws import Twins, at_rest
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.observation import OBSERVATION_PARTS
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_model_of

Array = NDArray[np.float64]
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
        self.trot = _reference(task)
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


def _reference(task: Walking) -> Trot:
    """The trot beside a policy: the usual one, or that which was fitted to its servos."""
    usual = [preset.trot for preset in PRESETS.values()]
    return Trot() if task.trot in usual and task.body.is_mini_pupper else task.trot


def _numbers(robots: slice) -> NDArray[np.intp]:
    return np.arange(robots.start, robots.stop)
