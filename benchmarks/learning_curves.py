"""Learning curves of training runs of several architectures and seeds, in one picture.

    .venv/bin/python benchmarks/learning_curves.py runs/mlp-0 runs/mlp-1 runs/lstm-0 … \
        --out learning_curves.png

The runs must have been trained with the same task, learner, imitation, environments and critic; it
refuses others. The table puts, per architecture, the mean and range over seeds of the reward after
as many samples as the shortest run has, and how the last policies walk.
"""

from __future__ import annotations

import argparse
import csv
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch
from matplotlib.figure import Figure

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.figure_style import (
    BLUE,
    GREEN,
    ORANGE,
    RED,
    SKY,
    axes_column,
    save,
    styled,
)
from pupper_sysid.policies.evaluation.evaluate import summary, walk
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.policies.train.curves import IMITATION, PROGRESS
from pupper_sysid.policies.train.run_file import Run, load_run
from pupper_sysid.policies.walks.conditions import evaluation_task
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

COLOURS = {"mlp": BLUE, "mlp-actions": SKY, "lstm": RED, "gru": ORANGE, "transformer": GREEN}
ERRORS = ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")


def curve(folder: Path) -> dict[str, np.ndarray]:
    """Samples, time and reward per second (mean over ten updates) of a run's `progress.csv`."""
    with (folder / PROGRESS).open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = ("samples", "elapsed_s", "reward")
    samples, elapsed, reward = (np.array([float(r[k]) for r in rows]) for k in columns)
    per_s = _smooth(reward) / load_run(folder).task.control_step_s
    return {"samples": samples, "elapsed_s": elapsed, "reward": per_s}


def first_gait_minutes(folder: Path) -> float:
    """How long imitation took."""
    with (folder / IMITATION).open(newline="") as file:
        return float(list(csv.DictReader(file))[-1]["elapsed_s"]) / 60


def same(runs: dict[Path, Run]) -> None:
    """Refuse runs that differ in more than policy, seed and length."""

    def rest(run: Run) -> Run:
        own = replace(run.architecture, kind="mlp", hidden=(1,), memory=1)
        return replace(run, architecture=own, seed=0, iterations=0, minutes=0.0)

    first, *others = runs
    for folder in others:
        if rest(runs[folder]) != rest(runs[first]):
            raise InputError(f"{folder} was trained with other settings than {first}.")


def main() -> None:
    """Print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--out", type=Path, default=Path("learning_curves.png"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    runs = {folder: load_run(folder) for folder in options.runs}
    same(runs)
    curves = {folder: curve(folder) for folder in runs}
    shared = min(c["samples"][-1] for c in curves.values())
    task = evaluation_task(next(iter(runs.values())).task)
    print(f"After {shared:,.0f} samples of PPO (mean, and range over seeds):\n")
    print(
        "| policy | seeds | reward per s | minutes | of them imitation | fell % | vx m/s | vy m/s |"
        " yaw rad/s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for kind in COLOURS:
        folders = [f for f in runs if runs[f].architecture.kind == kind]
        if not folders:
            continue
        rewards, minutes, walked = [], [], []
        for folder in folders:
            found = curves[folder]
            at = np.searchsorted(found["samples"], shared)
            rewards.append(found["reward"][at])
            minutes.append(found["elapsed_s"][at] / 60)
            run = runs[folder]
            servos = servo_ranges(run.actuator, run.feedback)
            policy = load_policy(folder / "policy_last")
            walked.append(summary(walk(policy, task, servos, options.episodes, 0)))
        cells = [
            _range(rewards, 2), _range(minutes, 0),
            _range([first_gait_minutes(f) for f in folders], 0),
            _range([100 * w.fall_rate for w in walked], 0),
            *(_range([getattr(w, k) for w in walked], 3) for k in ERRORS),
        ]  # fmt: skip
        print(f"| {kind} | {len(folders)} | " + " | ".join(cells) + " |", flush=True)
    save(picture(runs, curves), options.out, force=True)


@styled
def picture(runs: dict[Path, Run], curves: dict[Path, dict[str, np.ndarray]]) -> Figure:
    """Reward against samples and against time, a line per run, a colour per architecture."""
    figure, (by_samples, by_time) = axes_column(2, 6.0)
    seen = set()
    for folder, found in curves.items():
        kind = runs[folder].architecture.kind
        label = None if kind in seen else kind
        seen.add(kind)
        look = {"color": COLOURS[kind], "lw": 1}
        by_samples.plot(found["samples"] / 1e6, found["reward"], label=label, **look)
        by_time.plot(found["elapsed_s"] / 60, found["reward"], **look)
    by_samples.set_xlabel("samples of PPO [million]")
    by_time.set_xlabel("time, imitation included [min]")
    for axes in (by_samples, by_time):
        axes.set_ylabel("reward per second")
    by_samples.legend(loc="lower right")
    return figure


def _smooth(values: np.ndarray) -> np.ndarray:
    """Mean over the last ten updates."""
    total = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - 10, 0)
    return (total[ends] - total[starts]) / (ends - starts)


def _range(values: list[float], digits: int) -> str:
    low, high = min(values), max(values)
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ({low:.{digits}f}–{high:.{digits}f})"


if __name__ == "__main__":
    main()
