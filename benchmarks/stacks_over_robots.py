"""What a policy is shown of its joints, over robots: stale readings, or a model's prediction?

    .venv/bin/python benchmarks/stacks_over_robots.py --robots 8

Every emulated robot has servos of its own, and servo networks of its own, fitted to 40 s of its
walks. The shipped LSTM walks each in five directions: shown the readings, shown what its servo
networks predict, and shown what a PD with the calibration's numbers would do; smoothed alike.
Errors are compared robot by robot.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import astuple, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # reproduction/ is not installed

import torch
from deploy_protocols import CALIBRATION, DIRECTIONS, POLICIES, servo_model

from pupper_sysid.policies.deploy.stacks import STACKS
from pupper_sysid.policies.network.policy_file import load_policy
from reproduction.stacks import Walker, compare_stacks

ERRORS = {"mae_vx_m_s": "forward m/s", "mae_vy_m_s": "sideways m/s", "mae_yaw_rad_s": "turn rad/s"}
CLOSED = STACKS["closed-loop"]
SHOWN = {
    "readings": CLOSED,
    "servo networks": replace(CLOSED, observer="servo-model"),
    "simulated PD": replace(CLOSED, observer="synthetic-pd"),
}


def say(what: str) -> None:
    """One line on standard error."""
    print(what, file=sys.stderr, flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each walk")
    options = parser.parse_args()
    torch.set_num_threads(1)
    walkers = []
    with tempfile.TemporaryDirectory() as name:
        for seed in range(options.robots):
            say(f"servo networks of robot {seed}")
            folder = Path(name) / str(seed)
            folder.mkdir()
            walkers.append(Walker(seed, servo_model(folder, seed)))
        found = compare_stacks(
            load_policy(POLICIES / "lstm"), SHOWN, walkers, list(DIRECTIONS.values()),
            options.seconds, CALIBRATION, say,
        )  # fmt: skip
    print(f"| shown | fell % | {' | '.join(ERRORS.values())} |\n|---|---|---|---|---|")
    for row in found:
        cells = ["{:.4f} ({:.4f} to {:.4f})".format(*astuple(row[key])) for key in ERRORS]
        print(f"| {row['stack']} | {100 * row['falls']:.0f} | {' | '.join(cells)} |")
    for row in found[1:]:
        cells = [
            "{:+.4f} ({:+.4f} to {:+.4f})".format(*astuple(row[f"less_{key}"])) for key in ERRORS
        ]
        print(f"| {row['stack']} less readings | – | {' | '.join(cells)} |")
    print(f"\n90 % intervals over {options.robots} robots.")


if __name__ == "__main__":
    main()
