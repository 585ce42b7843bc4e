"""How long does an evaluation take, and where do its seconds go?

    .venv/bin/python benchmarks/evaluation_speed.py data/samples/policies/lstm

The conditions of `pupper-eval` (100 episodes of random commands, seven directions, three kinds of
ground, two added dead times; policy, trot and standing) walk one after the other and all together,
in turns, for --seconds of simulated time each; the median of the ratios of processor and wall time
is printed with their middle half, beside the load of the machine. Then the shares of one
environment, on one core, by the number of its robots, with one and with two threads of torch.
`time pupper-eval POLICY` and `time pupper-eval --quick POLICY` on a quiet machine give the whole.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch
import tyro

from pupper_sysid.cli.policy_choice import policy_at, simulator
from pupper_sysid.policies.evaluation.evaluate import RANDOM, WALKERS, table, usual_robots
from pupper_sysid.policies.evaluation.figures import Recorder
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.conditions import Condition, evaluation_task
from pupper_sysid.policies.walks.together import walk_together
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

EPISODES, ROUNDS = 100, 3
ROBOTS = (16, 50, 170, 340)


@dataclass(frozen=True)
class Options:
    """What is timed."""

    policies: tyro.conf.Positional[tuple[Path, ...]]
    seconds: float = 1.0
    """Simulated time of each condition and round."""


def conditions(task: Walking) -> list[Condition]:
    """Those of `pupper-eval`: policy, trot and standing under each."""
    robots = usual_robots(EPISODES)
    return [c.condition(task, robots(c, w), w) for c in (RANDOM, *table()) for w in WALKERS]


def timed(work: Callable[[], Any]) -> tuple[float, float]:
    """Processor and wall time of some work [s]."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.process_time() - processor, time.perf_counter() - wall


def in_turns(policy: Policy, task: Walking, servos: ServoRanges, seconds: float) -> None:
    """Conditions one after the other and together."""
    each = conditions(evaluation_task(task))

    def walk(some: list[Condition]) -> None:
        walk_together(policy, servos, some, seconds, 0, 0, Recorder)

    def one_by_one() -> None:
        for condition in each:
            walk([condition])

    walk(each[:1])  # imports, caches
    load = os.getloadavg()[0]
    found = np.array([[timed(one_by_one), timed(lambda: walk(each))] for _ in range(ROUNDS)])
    steps = round(seconds / task.control_step_s)
    for name, times, some in (
        ("one after the other", found[:, 0], each), ("together", found[:, 1], each)
    ):  # fmt: skip
        count = sum(c.robots for c in some)
        processor, wall = np.median(times, axis=0)
        whole = task.episode_s / seconds
        print(
            f"| {name} | {count} | {1e6 * processor / count / steps:.0f} | "
            f"{processor * whole:.0f} | {wall * whole:.0f} |"
        )
    ratio = found[:, 1] / found[:, 0]
    for kind, values in zip(("processor", "wall"), ratio.T, strict=True):
        low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
        ends = f"({low:.2f} to {high:.2f})"
        print(f"together over one after the other, {kind} time: {middle:.2f} {ends}")
    print(f"Load of the machine at the start {load:.1f}, at the end {os.getloadavg()[0]:.1f}.\n")


def shares(policy: Policy, task: Walking, servos: ServoRanges) -> None:
    """Processor time of physics, policy and all else, per robot and control step."""
    for count in ROBOTS:
        env = PupperEnv(evaluation_task(task), servos, count, 0, 1)
        rollout, spent = env.robots.batch.rollout, {"physics": 0.0, "policy": 0.0, "two": 0.0}

        def stepped(*given: Any, rollout: Any = rollout, spent: Any = spent, **more: Any) -> Any:
            began = time.process_time()
            found = rollout(*given, **more)
            spent["physics"] += time.process_time() - began
            return found

        env.robots.batch = _Timed(env.robots.batch, stepped)  # type: ignore[assignment]
        observation, _ = env.observe()
        policy.reset(env.action)
        steps = max(30, 6000 // count)
        began = time.process_time()
        for _ in range(steps):
            before = time.process_time()
            action = policy.act(observation)
            spent["policy"] += time.process_time() - before
            observation = env.step(action).observation
        whole = time.process_time() - began
        torch.set_num_threads(2)
        for _ in range(steps):
            before = time.process_time()
            policy.act(observation)
            spent["two"] += time.process_time() - before
        torch.set_num_threads(1)
        each = {k: 1e6 * v / (count * steps) for k, v in (spent | {"whole": whole}).items()}
        rest = each["whole"] - each["physics"] - each["policy"]
        print(
            f"| {count} | {each['whole']:.0f} | {each['physics']:.0f} | {each['policy']:.1f} | "
            f"{rest:.1f} | {each['two']:.1f} |"
        )


class _Timed:
    """A batch whose rollouts are timed."""

    def __init__(self, batch: Any, rollout: Callable[..., Any]):
        self._batch, self.rollout = batch, rollout

    def __getattr__(self, name: str) -> Any:
        return getattr(self._batch, name)


def main() -> None:
    """Measure and print."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    for path in options.policies:
        policy, run = policy_at(path)
        task, servos = simulator(path, policy, run, None, None)
        print(f"\n{path.name}, {EPISODES} episodes of {task.episode_s:g} s and all conditions\n")
        print("| conditions | episodes | µs per control step | processor s | wall s |")
        print("|---|---|---|---|---|")
        in_turns(policy, task, servos, options.seconds)
        print("Processor time on one core, µs per robot and control step:\n")
        print("| robots | whole | physics | policy | rest | policy, two threads of torch |")
        print("|---|---|---|---|---|---|")
        shares(policy, task, servos)


if __name__ == "__main__":
    main()
