"""What a wrong servo model costs: policies trained with one actuator, walking with others.

    .venv/bin/python benchmarks/actuator_transfer.py POLICY [POLICY ...] --episodes 100

Feedback stays as the sample calibration measured it, so that only the actuator differs.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torch

from pupper_sysid.policies.evaluation.evaluate import summary, walk
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.policies.walks.conditions import evaluation_task
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

CALIBRATED = "data/samples/calibrated.yaml"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policies", type=Path, nargs="+")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| policy | trained with | walks with | fell % | vx m/s | vy m/s | yaw rad/s |")
    print("|---|---|---|---|---|---|---|")
    for path in options.policies:
        policy = load_policy(path)
        contract = policy.contract
        for actuator in (CALIBRATED, "paper", "release"):
            task = Walking(knee=contract.knee)
            found = summary(
                walk(
                    policy, evaluation_task(task), servo_ranges(actuator, CALIBRATED),
                    options.episodes, 0, None, options.threads,
                )
            )  # fmt: skip
            print(
                f"| {contract.kind} | {contract.actuator} | {Path(actuator).name} | "
                f"{100 * found.fall_rate:.0f} | {found.mae_vx_m_s:.3f} | "
                f"{found.mae_vy_m_s:.3f} | {found.mae_yaw_rad_s:.3f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
