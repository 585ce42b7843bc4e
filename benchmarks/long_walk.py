"""A walk of many hours in virtual time: does anything drift, grow or break?

    .venv/bin/python benchmarks/long_walk.py --hours 24

The shipped LSTM walks the emulated robot through guard, bus and controller, told something else
every ten seconds, and every input and output is checked. Printed per virtual hour: errors, memory
of the process, the controller's step, deadlines, readings that were missing. Nothing is logged to
disk (a log grows by a quarter of a gigabyte per hour): everything else is as in a walk.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy.assembly import assemble
from pupper_sysid.policies.deploy.deployment import Tick, deploy
from pupper_sysid.policies.deploy.stacks import STACKS
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.walking.bus import WalkingBus

POLICY, CALIBRATION = Path("data/samples/policies/lstm"), "data/samples/calibrated.yaml"
_EVERY_S = 10.0


def resident_mb() -> float:
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


class Hourly:
    """Watches the ticks, and prints a row per virtual hour."""

    def __init__(self, bus: GuardedBus, robot: Any):
        self.bus, self.robot = bus, robot
        self.begun, self.hour, self.wrong = time.monotonic(), 0, 0
        self._clear()

    def _clear(self) -> None:
        self.errors, self.count = np.zeros(3), 0

    def __call__(self, tick: Tick) -> None:
        decision = tick.decision
        numbers = (decision.observation, decision.action, decision.target, tick.sent)
        self.wrong += not all(np.isfinite(x).all() for x in numbers)
        trunk = self.robot.trunk(self.bus.now())
        moved = np.array([*trunk.velocity_m_s[:2], trunk.yaw_rate_rad_s])
        self.errors += np.abs(moved - tick.senses.command)
        self.count += 1
        if tick.elapsed_s >= 3600 * (self.hour + 1):
            self.hour += 1
            cells = " | ".join(f"{e:.4f}" for e in self.errors / self.count)
            print(
                f"| {self.hour} | {cells} | {resident_mb():.1f} | {self.wrong} | "
                f"{self.bus.report.missing} | {time.monotonic() - self.begun:.0f} |",
                flush=True,
            )
            self._clear()


def commands(seed: int):
    """Something else every ten seconds, repeatably."""

    @lru_cache(maxsize=1)
    def drawn(number: int) -> np.ndarray:
        rng = np.random.default_rng([seed, number])
        return rng.uniform([-0.2, -0.1, -0.5], [0.2, 0.1, 0.5])

    return lambda elapsed_s: drawn(int(elapsed_s / _EVERY_S))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    inner = WalkingBus(draw_robot(rng), rng)
    print("| hour | forward m/s | sideways m/s | turn rad/s | MB | not a number | missing | s |")
    print("|" + "---|" * 8)
    with closing(GuardedBus(inner)) as bus:
        parts = assemble(
            load_policy(POLICY), STACKS["closed-loop"], load_joint_map("mini_pupper_2"),
            CALIBRATION, None,
        )  # fmt: skip
        outcome = deploy(
            bus, inner, parts.controller, commands(0), 3600 * options.hours + 1,
            Path(os.devnull), parts.header, None, [Hourly(bus, inner.robot)], force=True,
        )  # fmt: skip
    print(
        f"\n{outcome.stop_reason}: {outcome.seconds / 3600:.2f} h, fell: {outcome.fell}, missed "
        f"deadlines: {outcome.deadline_misses}, control step p50 "
        f"{1e3 * outcome.steps.quantile(0.5):.2f} ms, p99 {1e3 * outcome.steps.quantile(0.99):.2f}."
    )


if __name__ == "__main__":
    main()
