"""A fleet of emulated robots: time against workers, and whether the odd servo is found.

    .venv/bin/python benchmarks/fleet.py --robots 1000 --workers 1 2

Sweeps of one joint at two tones, every robot with servos of its own; the last robot's servo has
twice the friction of the others. Each number of workers calibrates the same recordings anew.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from pupper_sysid.sysid.fleet.calibration import Settings, calibrate_fleet
from pupper_sysid.sysid.sweep.excitation import plan
from pupper_sysid.sysid.sweep.recorder import record

JOINT, TONES_HZ, SECONDS = "LF_hip", (2.0, 4.0), 2.0


def write_robots(count: int, folder: Path) -> None:
    """One recording per robot."""
    usual = RobotSpec()
    for k in range(count):
        odd = k == count - 1
        spec = replace(
            usual, friction_per_inertia=(2.0 if odd else 1.0) * usual.friction_per_inertia
        )
        rng = np.random.default_rng([7, k])
        bus = EmulatedBus(draw_robot(rng, spec), rng, keep_log=False)
        chosen = plan("sine", [JOINT], TONES_HZ, duration_s=SECONDS)
        record(bus, chosen, folder / f"robot{k:04d}.csv")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name) / "robots"
        root.mkdir()
        write_robots(options.robots, root)
        print("| workers | robots | s | s per robot | failed | named as outliers |")
        print("|---|---|---|---|---|---|")
        for jobs in options.workers:
            begun = time.perf_counter()
            fleet = calibrate_fleet(root, Path(name) / f"out{jobs}", Settings(), jobs)
            took = time.perf_counter() - begun
            odd = fleet.table.query("problem == '' and outliers != ''")
            named = ", ".join(f"{r.robot} ({r.outliers})" for r in odd.itertuples()) or "none"
            print(
                f"| {jobs} | {options.robots} | {took:.0f} | {took / options.robots:.2f} | "
                f"{len(fleet.failed)} | {named} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
