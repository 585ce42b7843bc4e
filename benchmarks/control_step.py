"""Where the time of a control step goes: the full LSTM stack, on the clock and in CPU.

    .venv/bin/python benchmarks/control_step.py servo/

`servo/` is a model of all twelve joints (`pupper-sysid fit-servo` of a walk). The step is computed
once per 20 ms, as in a walk, and then without pauses; readings are random.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gc
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.policies.deploy.assembly import assemble
from pupper_sysid.policies.deploy.controller import Senses
from pupper_sysid.policies.deploy.filters import Rest
from pupper_sysid.policies.deploy.stacks import STACKS
from pupper_sysid.policies.network.policy_file import load_policy

SAMPLES = Path(__file__).resolve().parents[1] / "data/samples"
PERIOD_S = 0.02


class Timed:
    """Seconds of calls, on the clock and of the thread."""

    def __init__(self):
        self.found: dict[str, list[tuple[float, float]]] = {}

    def part(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """`call`, timed under a name."""

        def timed(*given: Any) -> Any:
            wall, own = time.perf_counter(), time.thread_time()
            result = call(*given)
            row = (time.perf_counter() - wall, time.thread_time() - own)
            self.found.setdefault(name, []).append(row)
            return result

        return timed


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("servo", type=Path)
    parser.add_argument("--ticks", type=int, default=1500)
    options = parser.parse_args()
    torch.set_num_threads(1)
    controller = assemble(
        load_policy(SAMPLES / "policies/lstm"), replace(STACKS["lstm-servo"], rate_hz=50.0),
        load_joint_map("mini_pupper_2"), str(SAMPLES / "calibrated.yaml"), options.servo,
    ).controller  # fmt: skip
    timed = Timed()
    for owner, call, name in (
        (controller._attitude, "step", "attitude"),
        (controller.observer, "step", "servo networks, 12"),
        (controller.policy, "act", "policy, LSTM"),
        (controller, "step", "whole step"),
    ):
        setattr(owner, call, timed.part(name, getattr(owner, call)))
    controller.reset(
        controller.default, Rest(bias_rad_s=np.zeros(3), gravity=np.array([0.0, 0.0, -1.0]))
    )
    rng = np.random.default_rng(0)
    gc.collect()
    gc.freeze()
    print("| pace | part | ms on the clock: p50 | p99 | ms of CPU: p50 | p99 |")
    print("|---|---|---|---|---|---|")
    with real_time_priority() as priority:
        for paced in (True, False):
            timed.found.clear()
            begun = time.perf_counter()
            for k in range(options.ticks):
                if paced:
                    time.sleep(max(0.0, begun + PERIOD_S * k - time.perf_counter()))
                controller.step(
                    Senses(
                        PERIOD_S * k, np.array([0.15, 0.0, 0.0]),
                        controller.default + 0.05 * rng.standard_normal(12), np.zeros(12),
                        0.1 * rng.standard_normal(3), np.array([0.0, 0.0, 9.81]),
                    )
                )  # fmt: skip
            for name, rows in timed.found.items():
                p = 1e3 * np.quantile(rows, [0.5, 0.99], axis=0)
                print(
                    f"| {'20 ms' if paced else 'none'} | {name} | {p[0, 0]:.2f} | {p[1, 0]:.2f} | "
                    f"{p[0, 1]:.2f} | {p[1, 1]:.2f} |"
                )
    print(
        f"\nWith {priority}. Load of the machine: {' '.join(f'{x:.1f}' for x in os.getloadavg())}."
    )


if __name__ == "__main__":
    main()
