"""Closed loop on stale encoders against a servo model's prediction, over robots.

    .venv/bin/python benchmarks/stacks_over_robots.py --robots 4

Every emulated robot has servos of its own and a servo model of its own, fitted to 30 s of its own
walk. The shipped LSTM then walks it in three directions, once shown the readings, once shown what
the servo model predicts, both smoothed alike. Errors are compared robot by robot.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torch

from policies.policy_file import load_policy
from policies.stack_trials import Walker, compare_stacks, walk_once
from policies.stacks import STACKS
from sysid.recording import RecordingWriter, load
from sysid.servo_fit import Split, fit_servo, save_fit

POLICY, ACTUATOR = Path("data/samples/policies/lstm"), "data/samples/calibrated.yaml"
COMMANDS = ((0.15, 0.0, 0.0), (0.0, 0.08, 0.0), (0.0, 0.0, 0.4))
ERRORS = {"mae_vx_m_s": "forward m/s", "mae_vy_m_s": "sideways m/s", "mae_yaw_rad_s": "turn rad/s"}
_LEARN_S = 30.0


def servo_model(policy, seed: int, folder: Path) -> Path:
    """A model of one robot's servos, fitted to a walk of its own."""
    path, out = folder / f"walk{seed}.csv", folder / f"servo{seed}"
    about = {"bus": {"kind": "emulated walking robot", "coordinates": "servo"}}
    with RecordingWriter(path, about) as rows:
        walk_once(
            policy, STACKS["closed-loop"], COMMANDS[0], _LEARN_S + 5, seed, ACTUATOR, rows=rows
        )
        rows.close({})
    recording = load(path)
    split = Split(
        f"trained on the first {_LEARN_S:g} s, tested on the rest",
        lambda number, elapsed, group: elapsed < _LEARN_S,
        lambda number, elapsed, group: elapsed >= _LEARN_S,
    )
    save_fit(out, fit_servo([recording], recording.joints, split=split), [recording], 0)
    return out


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    policy, closed = load_policy(POLICY), STACKS["closed-loop"]
    stacks = {"readings": closed, "servo model": replace(closed, observer="servo-model")}
    with tempfile.TemporaryDirectory() as name:
        walkers = [
            Walker(seed, servo_model(policy, seed, Path(name))) for seed in range(options.robots)
        ]
        found = compare_stacks(policy, stacks, walkers, COMMANDS, options.seconds, ACTUATOR)
    print(f"| shown | fell % | {' | '.join(ERRORS.values())} |\n|---|---|---|---|---|")
    for row in found:
        cells = [f"{row[key][0]:.4f}" for key in ERRORS]
        print(f"| {row['stack']} | {100 * row['falls']:.0f} | {' | '.join(cells)} |")
    less = ["{:+.4f} ({:+.4f} to {:+.4f})".format(*found[1][f"less_{key}"]) for key in ERRORS]
    print(f"| model less readings (90 % interval over {options.robots} robots) | – | "
          f"{' | '.join(less)} |")  # fmt: skip


if __name__ == "__main__":
    main()
