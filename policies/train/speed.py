"""How fast training is here: the environment against the bare simulator, and PPO end to end.

Both sides of a ratio take turns in slices of 0.2 s, from the same states under the same controls,
so that the load of the machine meets both alike; a ratio is the median over slices, with the
middle half of them. Processor time is printed next to wall time: what another program takes
from this one shows in the latter only.

`env_ratio` is the time of a bare `Batch.step` over that of `PupperEnv.step`, with the same model,
threads and substeps, and nothing recorded; `end_to_end_ratio` is the rate of whole updates over
that of environment and update one after the other. On two cores the former was 0.71 with 20
environments, 0.89 with 100 and 0.94 with 512, the latter 0.86 to 0.97 by policy (November 2026).
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.train.learner import Ranks
from pupper_sysid.policies.train.run_file import Run
from pupper_sysid.policies.train.training import make_env, make_learner
from pupper_sysid.sim.walking.env import PupperEnv

SLICE_S = 0.2
_SLICES, _ROUNDS = 25, 3
_STRIDE = 100  # steps of the trot after which its actions are used again
_SAMPLE = SAMPLES / "calibrated.yaml"


class Paces:
    """The steps of an environment, and the same physics without it, in turns.

    The environment trots on, as it is timed.
    """

    def __init__(self, env: PupperEnv):
        self.env, n = env, env.environments
        rng = np.random.default_rng(0)
        # a trot with noise: robots at rest would have other contacts
        step = 2 * np.pi * env.trot.frequency_hz * env.config.control_step_s
        self._phases = step * np.arange(_STRIDE)
        self._noise = 0.05 * rng.standard_normal((_STRIDE, n, len(env.default)))
        self._at = 0
        self._stepped(self._actions(5))
        begun = time.perf_counter()
        self._stepped(self._actions(3))
        self._count = max(round(3 * SLICE_S / (time.perf_counter() - begun)), 1)

    def slice(self, bare_first: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Wall and processor time per robot and step [s] of the environment, and of bare physics.

        Both start from the same state, and take the same steps.
        """
        batch, actions = self.env.robots.batch, self._actions(self._count)
        controls = [self.env.robots.to_servo(self.env.set_points(a)) for a in actions]
        before, bare = batch.state.copy(), np.zeros(2)
        if bare_first:
            bare = self._bare(controls)
            batch.state[:] = before
        env_time = self._stepped(actions)
        if not bare_first:
            after = batch.state.copy()
            batch.state[:] = before
            bare = self._bare(controls)
            batch.state[:] = after
        share = 1 / (self._count * self.env.environments)
        return env_time * share, bare * share

    def slices(self, count: int = _SLICES) -> NDArray[np.float64]:
        """Times of slices, shape (count, 2, 2): environment and bare, wall and processor."""
        return np.array([self.slice(bool(i % 2)) for i in range(count)])

    def _stepped(self, actions: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        begun = _now()
        for action in actions:
            self.env.step(action)
        return _now() - begun

    def _bare(self, controls: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        batch, substeps, begun = self.env.robots.batch, self.env.config.substeps, _now()
        for control in controls:
            batch.bind("ctrl")[:] = control
            batch.step(nstep=substeps)
        return _now() - begun

    def _actions(self, count: int) -> list[NDArray[np.float64]]:
        env, actions = self.env, []
        for _ in range(count):
            phase = np.full(env.environments, self._phases[self._at % _STRIDE])
            target = env.trot.joints(phase, env.command, env.body)
            noise = self._noise[self._at % _STRIDE]
            actions.append((target - env.default) / env.config.action_scale + noise)
            self._at += 1
        return actions


def ratios(times: NDArray[np.float64]) -> dict[str, float]:
    """Rates and ratios of `Paces.slices`, by their keys in `measure`."""
    env_times, bare_times = times[:, 0], times[:, 1]
    wall, processor = (bare_times / env_times).T
    low, middle, high = np.quantile(wall, [0.25, 0.5, 0.75])
    return {
        "bare_env_steps_per_s": float(1 / np.median(bare_times[:, 0])),
        "env_steps_per_s": float(1 / np.median(env_times[:, 0])),
        "env_ratio": float(middle),
        "env_ratio_low": float(low),
        "env_ratio_high": float(high),
        "env_processor_ratio": float(np.median(processor)),
    }


def with_sample(run: Run) -> Run:
    """The run, with the shipped calibration in place of its own if that is not here.

    A sample of the repository, or the preset `paper`.
    """
    if run.actuator != Run.actuator or Path(run.actuator).exists():
        return run
    return replace(run, actuator=str(_SAMPLE) if _SAMPLE.is_file() else "paper")


def measure(run: Run) -> dict[str, Any]:
    """Object of `pupper-train --benchmark --json`."""
    ranks = Ranks()
    paces = Paces(make_env(run, ranks))
    learner = make_learner(run, ranks)
    samples = learner.env.num_envs * learner.hyper.steps_per_environment
    learner.rollout()
    learner.update()
    times, rounds = [], []
    for _ in range(_ROUNDS):
        times.append(paces.slices(_SLICES // _ROUNDS))
        begun = time.perf_counter()
        learner.rollout()
        between = time.perf_counter()
        learner.update()
        ended = time.perf_counter()
        rounds.append((ended - between, ended - begun))
    update, total = np.median(rounds, axis=0).tolist()
    rates, update_rate = ratios(np.concatenate(times)), samples / update
    one_after_the_other = 1 / rates["env_steps_per_s"] + 1 / update_rate
    return {
        "policy": run.architecture.kind,
        "num_envs": learner.env.num_envs,
        "threads": torch.get_num_threads(),
        "actuator": run.actuator,
        "physics": run.task.physics,
        "physics_step_s": run.task.physics_step_s,
        **rates,
        "update_samples_per_s": update_rate,
        "end_to_end_samples_per_s": samples / total,
        "end_to_end_ratio": samples / total * one_after_the_other,
        "load": os.getloadavg()[0],
        "cores": os.cpu_count(),
    }


def _now() -> NDArray[np.float64]:
    """Wall and processor time [s]."""
    return np.array([time.perf_counter(), time.process_time()])
