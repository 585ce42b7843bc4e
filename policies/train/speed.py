"""How fast training is here: the environment against the bare simulator, and PPO end to end.

Everything is measured in one run, so that the ratios hardly depend on the machine's load:
`env_ratio` is the rate of `PupperEnv.step` over that of a bare `Batch.step` on the same model,
threads and substeps; `end_to_end_ratio` is the rate of whole updates over that of environment and
update one after the other.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from pupper_sysid.policies.train.learner import Ranks
from pupper_sysid.policies.train.run_file import Run
from pupper_sysid.policies.train.training import make_env, make_learner
from pupper_sysid.sim.walking.env import PupperEnv

_ROUNDS = 5
_STEPS = range(5, 101)  # few of many robots, many of few
_ROBOT_STEPS = 20_000


class _Paces:
    """Timed stretches of one environment: its own steps, and the same physics without it."""

    def __init__(self, env: PupperEnv):
        self.env, n = env, env.environments
        steps = int(np.clip(_ROBOT_STEPS // n, _STEPS[0], _STEPS[-1]))
        self.robot_steps = n * steps
        rng = np.random.default_rng(0)
        # a trot with noise: robots at rest would have other contacts
        phase = 2 * np.pi * env.trot.frequency_hz * env.config.control_step_s * np.arange(steps)
        self._actions = [
            (env.trot.joints(np.full(n, p), env.command) - env.default) / env.config.action_scale
            + 0.05 * rng.standard_normal((n, 12))
            for p in phase
        ]
        self.own()

    def own(self) -> float:
        """Seconds of `PupperEnv.step`s."""
        self._controls = []
        begun = time.perf_counter()
        for action in self._actions:
            self.env.step(action)
            self._controls.append(self.env.robots.batch.bind("ctrl").copy())
        return time.perf_counter() - begun

    def bare(self) -> float:
        """Seconds of `Batch.step`s under the controls of the last `own`, from its end."""
        batch, begun = self.env.robots.batch, time.perf_counter()
        for control in self._controls:
            batch.bind("ctrl")[:] = control
            batch.step(nstep=self.env.config.substeps)
        return time.perf_counter() - begun


def environment_rates(env: PupperEnv) -> tuple[float, float]:
    """Steps per second of a bare `Batch.step` and of the environment: medians of rounds."""
    paces = _Paces(env)
    times = [(paces.own(), paces.bare()) for _ in range(_ROUNDS)]
    own, bare = np.median(times, axis=0).tolist()
    return paces.robot_steps / bare, paces.robot_steps / own


def measure(run: Run) -> dict[str, Any]:
    """Object of `pupper-train --benchmark --json`."""
    ranks = Ranks()
    paces = _Paces(make_env(run, ranks))
    learner = make_learner(run, ranks)
    samples = learner.env.num_envs * learner.hyper.steps_per_environment
    learner.rollout()
    learner.update()
    rounds = []
    for _ in range(_ROUNDS):
        own, bare, begun = paces.own(), paces.bare(), time.perf_counter()
        learner.rollout()
        between = time.perf_counter()
        learner.update()
        ended = time.perf_counter()
        rounds.append((own, bare, ended - between, ended - begun))
    own, bare, update, whole = np.median(rounds, axis=0).tolist()
    own_rate, update_rate = paces.robot_steps / own, samples / update
    return {
        "policy": run.architecture.kind,
        "num_envs": learner.env.num_envs,
        "threads": torch.get_num_threads(),
        "bare_env_steps_per_s": paces.robot_steps / bare,
        "env_steps_per_s": own_rate,
        "env_ratio": bare / own,
        "update_samples_per_s": update_rate,
        "end_to_end_samples_per_s": samples / whole,
        "end_to_end_ratio": samples / whole * (1 / own_rate + 1 / update_rate),
    }
