"""What the advantages of PPO are made of: what the noise of actions decided, and what it did not.

    .venv/bin/python benchmarks/advantage_variance.py RUN

Every robot of a run goes through the same few steps twice, from the same state and with the same
chance events, but with other noise of its actions. What both advantages have in common says nothing
about the actions: only the rest is signal. `RUN` is a folder of `pupper-train`; its critic goes on
for some updates where the task is not that of the run.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from pupper_sysid.policies.train.checkpoint import read_checkpoint
from pupper_sysid.policies.train.learner import Learner
from pupper_sysid.policies.train.ranks import Ranks
from pupper_sysid.policies.train.run_file import Run, load_run
from pupper_sysid.policies.train.training import make_learner
from pupper_sysid.sim.walking.config import Curriculum, Ramp

_ROUNDS = 6
_NONE = torch.zeros(0, dtype=torch.long)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--std", type=float, default=0.02, help="of the noise of actions")
    parser.add_argument("--updates", type=int, default=60, help="of the critic, before")
    options = parser.parse_args()
    run = load_run(options.run)
    print("| task | values | variance | not from the noise | from the noise | share of it |")
    print("|---|---|---|---|---|---|")
    for task in ("as trained", "no pushes", "no new commands", "neither"):
        for values in ("plain", "without chance"):
            learner = _learner(options.run, _changed(run, task, options.std))
            for _ in range(options.updates):
                _rollout(learner, values)
                learner.update()
            whole, common = _twice(learner, values)
            own = whole - common
            print(
                f"| {task} | {values} | {whole:.3f} | {common:.3f} | {own:.3f} "
                f"| {100 * own / whole:.0f} % |",
                flush=True,
            )


def _changed(run: Run, task: str, std: float) -> Run:
    """The run at the end of its curriculum, without some chance events."""
    ends = {name: Ramp(value.last, value.last) for name, value in vars(run.task.curriculum).items()}
    changed = replace(run.task, curriculum=Curriculum(**ends))
    if task in ("no pushes", "neither"):
        changed = replace(changed, randomisation=replace(changed.randomisation, push_m_s=0.0))
    if task in ("no new commands", "neither"):
        changed = replace(changed, commands=replace(changed.commands, every_s=1e6))
    exploration = replace(run.learner.exploration, std=(std, std))
    learner = replace(
        run.learner, exploration=exploration, critic_warmup=10**9, freeze_normaliser=True
    )
    return replace(run, task=changed, learner=learner, threads=1)


def _learner(folder: Path, run: Run) -> Learner:
    learner = make_learner(run, Ranks())
    best = read_checkpoint(folder / "best.pt")
    learner.ppo.actor.load_state_dict(best["actor_state_dict"])
    learner.ppo.critic.load_state_dict(best["critic_state_dict"])
    learner.iteration = 0
    return learner


def _rollout(learner: Learner, values: str) -> None:
    """`Learner.rollout`, with or without the values that leave chance out."""
    step = learner.env.step

    def plain(actions: torch.Tensor):
        *found, extras = step(actions)
        return *found, extras | {"unforeseen_ids": _NONE}

    learner.env.step = plain if values == "plain" else step
    try:
        learner.rollout()
    finally:
        learner.env.step = step


def _twice(learner: Learner, values: str) -> tuple[float, float]:
    """Variance of the first steps' advantages, and what two runs of them have in common."""
    whole, common = [], []
    storage = learner.ppo.storage
    for round_ in range(_ROUNDS):
        state, seen = learner.env.state, learner.observations
        pair = []
        for twin in range(2):
            learner.env.restore(state)
            learner.observations = seen
            torch.manual_seed(2 * round_ + twin)
            _rollout(learner, values)
            # `advantages` are normalised; returns are advantages plus values
            pair.append((storage.returns[0] - storage.values[0])[:, 0].numpy().copy())
            storage.clear()
        both = np.cov(np.array(pair))
        whole.append(0.5 * np.trace(both))
        common.append(both[0, 1])
    return float(np.mean(whole)), float(np.mean(common))


if __name__ == "__main__":
    main()
