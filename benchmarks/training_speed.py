"""How fast the walking environment and PPO are, both sides of every ratio measured in one run.

    .venv/bin/python benchmarks/training_speed.py --threads 2

Prints three tables: the environment against a bare `Batch.step` on the same model, threads, states
and controls, in turns in slices of 0.2 s, for 20 to 8,192 environments; what delay, feedback model,
terrain and physics cost; PPO end to end for each architecture. `--only environments` prints the
first alone.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from typing import get_args

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch

from pupper_sysid.common.processes.workers import keep_freed_memory
from pupper_sysid.policies.network.hyperparameters import Kind
from pupper_sysid.policies.train.run_file import preset
from pupper_sysid.policies.train.speed import Paces, load, measure, ratios
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

ACTUATOR = "data/samples/calibrated.yaml"
SIZES = (20, 100, 512, 2048, 8192)
PAPER = {"mlp": "30,000", "lstm": "15,000–20,000", "transformer": "5,500"}


def row(found: dict[str, float]) -> str:
    """Cells of a table."""
    low, high = found["env_ratio_low"], found["env_ratio_high"]
    return (
        f"{found['bare_env_steps_per_s']:,.0f} | {found['env_steps_per_s']:,.0f} | "
        f"{found['env_ratio']:.3f} ({low:.3f}–{high:.3f}) | {found['env_processor_ratio']:.3f}"
    )


def environments(threads: int) -> None:
    """Cost against number of environments."""
    print(
        f"Threads {threads}, load {load():.1f}; median of slices of 0.2 s, and their middle half.\n"
    )
    print(
        "| environments | bare Batch.step, steps/s | PupperEnv, steps/s | ratio | "
        "of processor time |\n|---|---|---|---|---|"
    )
    for size in SIZES:
        env = PupperEnv(Walking(), servo_ranges(ACTUATOR), size, 0, threads)
        print(f"| {size:,} | {row(ratios(Paces(env).slices()))} |", flush=True)


def parts(threads: int) -> None:
    """What delay, feedback, terrain and physics cost."""
    print(
        "\n| 512 environments | bare Batch.step, steps/s | PupperEnv, steps/s | ratio | "
        "of processor time |"
    )
    print("|---|---|---|---|---|")
    late = servo_ranges(ACTUATOR)
    at_once = replace(
        late,
        **{k: {**getattr(late, k), "dead_time_s": np.zeros(12)} for k in ("low", "value", "high")},
    )
    cases = {
        "delay, held feedback, flat": (Walking(), late),
        "no delay": (Walking(), at_once),
        "ideal feedback": (Walking(), servo_ranges(ACTUATOR, "ideal")),
        "rough ground": (Walking(terrain="rough"), late),
        "slopes": (Walking(terrain="slopes"), late),
        "serial knee": (Walking(knee="serial"), late),
        "physics in steps of 4 ms": (Walking(physics_step_s=0.004), late),
        "physics of evaluation": (Walking(physics="evaluation"), late),
    }
    for name, (task, servos) in cases.items():
        found = ratios(Paces(PupperEnv(task, servos, 512, 0, threads)).slices())
        print(f"| {name} | {row(found)} |", flush=True)


def end_to_end(threads: int) -> None:
    """PPO with each architecture, in this project's sizes and in the paper's."""
    print(
        "\n| policy | sizes | environment, steps/s | update, samples/s | end to end, samples/s | "
        "of the ideal | paper, RTX 4090 |"
    )
    print("|---|---|---|---|---|---|---|")
    for sizes in ("fast", "paper"):
        for kind in get_args(Kind) if sizes == "fast" else PAPER:
            run = preset(sizes, kind)
            run = replace(
                run, actuator=ACTUATOR, threads=threads, environments=512,
                task=Walking(), learner=preset("fast", kind).learner,
            )  # fmt: skip
            found = measure(run)
            print(
                f"| {kind} | {sizes} | {found['env_steps_per_s']:,.0f} | "
                f"{found['update_samples_per_s']:,.0f} | "
                f"{found['end_to_end_samples_per_s']:,.0f} | {found['end_to_end_ratio']:.2f} | "
                f"{PAPER.get(kind, '–') if sizes == 'paper' else ''} |",
                flush=True,
            )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", choices=("environments",), default=None)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()
    environments(options.threads)
    if options.only is None:
        parts(options.threads)
        end_to_end(options.threads)


if __name__ == "__main__":
    main()
