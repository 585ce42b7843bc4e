"""How fast training is here: the environment against the bare simulator, and PPO end to end.

Everything is measured in one run, so the ratios hold whatever the machine does: `env_ratio` is the
rate of `PupperEnv.step` over that of a bare `Batch.step` on the same model, threads and substeps;
`end_to_end_ratio` is the rate of whole updates over what environment and update would give one
after the other.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from policies.learner import Ranks
from policies.run_file import Run
from policies.training import make_env, make_learner
from sim.walking_env import PupperEnv

_ROUNDS = 3
_STEPS = range(5, 21)  # few of many robots, many of few
_ROBOT_STEPS = 20_000


def environment_rates(env: PupperEnv) -> tuple[float, float]:
    """Steps per second of a bare `Batch.step` and of the environment, each the best of rounds.

    The bare steps repeat the controls, from where the environment's steps left the robots.
    """
    n, substeps = env.environments, env.config.substeps
    steps = int(np.clip(_ROBOT_STEPS // n, _STEPS[0], _STEPS[-1]))
    rng = np.random.default_rng(0)
    # a trot with noise: robots at rest would have other contacts
    phase = 2 * np.pi * env.trot.frequency_hz * env.config.control_step_s * np.arange(steps)
    actions = [
        (env.trot.joints(np.full(n, p), env.command) - env.default) / env.config.action_scale
        + 0.05 * rng.standard_normal((n, 12))
        for p in phase
    ]
    for action in actions:
        env.step(action)
    bare, own = [], []
    for _ in range(_ROUNDS):
        controls = []
        begun = time.perf_counter()
        for action in actions:
            env.step(action)
            controls.append(env.robots.batch.bind("ctrl").copy())
        own.append(n * steps / (time.perf_counter() - begun))
        begun = time.perf_counter()
        for control in controls:
            env.robots.batch.bind("ctrl")[:] = control
            env.robots.batch.step(nstep=substeps)
        bare.append(n * steps / (time.perf_counter() - begun))
    return max(bare), max(own)


def measure(run: Run) -> dict[str, Any]:
    """Object of `pupper-train --benchmark --json`."""
    ranks = Ranks()
    bare, own = environment_rates(make_env(run, ranks))
    learner = make_learner(run, ranks)
    samples = learner.env.num_envs * learner.hyper.steps_per_environment
    learner.rollout()
    learner.update()
    collect, update = [], []
    for _ in range(_ROUNDS):
        begun = time.perf_counter()
        learner.rollout()
        between = time.perf_counter()
        learner.update()
        ended = time.perf_counter()
        collect.append(between - begun)
        update.append(ended - between)
    update_rate = samples / min(update)
    whole = samples / min(c + u for c, u in zip(collect, update, strict=True))
    return {
        "policy": run.architecture.kind,
        "num_envs": learner.env.num_envs,
        "threads": torch.get_num_threads(),
        "bare_env_steps_per_s": bare,
        "env_steps_per_s": own,
        "env_ratio": own / bare,
        "update_samples_per_s": update_rate,
        "end_to_end_samples_per_s": whole,
        "end_to_end_ratio": whole * (1 / own + 1 / update_rate),
    }
