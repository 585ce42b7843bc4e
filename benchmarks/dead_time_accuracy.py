"""How well is a servo's dead time known? Random emulated robots through `calibrate`, one table.

    .venv/bin/python benchmarks/dead_time_accuracy.py --robots 60

Each robot has servos, losses, counts and noise of its own; one joint is swept. The truth is the
servo's own delay, as a simulation in the fit's steps has to have it: the emulated servo is stepped
twice as finely, and `servo_models.step_size` says what that is worth.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from random_robots import sweep_random_robot

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.identify.calibrate import calibrate


@dataclass(frozen=True)
class Result:
    """One robot; times in s."""

    loss: float
    truth: float
    value: float
    low: float
    high: float


def measure(seed: int, tones: str) -> Result:
    """Build, sweep and calibrate one robot."""
    rng = np.random.default_rng([20261123, seed])
    loss, noise = float(rng.uniform(0.0, 0.5)), float(rng.uniform(0.002, 0.012))
    robot = sweep_random_robot(rng, loss, noise, tones)
    dead = calibrate([robot.recording], [robot.joint], workers=1)[robot.joint].dead_time_s
    return Result(loss, robot.dead_time_s(TIME_STEP_S), dead.value, dead.low, dead.high)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=60)
    parser.add_argument("--tones", default="1,2,4,8")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    print("| robot | loss | true ms | found ms | 90 % interval | off ms | holds it |")
    print("|" + "---|" * 7)
    found: list[Result] = []
    with ProcessPoolExecutor(options.workers) as pool:
        work = pool.map(partial(measure, tones=options.tones), range(options.robots))
        for number, r in enumerate(work):
            found.append(r)
            holds = "yes" if r.low <= r.truth <= r.high else "no"
            print(
                f"| {number} | {r.loss:.2f} | {1e3 * r.truth:.1f} | {1e3 * r.value:.1f} | "
                f"{1e3 * r.low:.1f}–{1e3 * r.high:.1f} | {1e3 * (r.value - r.truth):+.1f} | "
                f"{holds} |",
                flush=True,
            )
    off = 1e3 * np.array([r.value - r.truth for r in found])
    held = np.array([r.low <= r.truth <= r.high for r in found])
    width = 1e3 * np.array([r.high - r.low for r in found])
    print(
        f"\n{len(found)} robots: the interval holds the truth in {held.sum()} "
        f"({100 * held.mean():.0f} %); width {np.median(width):.1f} ms (median); off by "
        f"{np.median(np.abs(off)):.1f} ms (median), {np.quantile(np.abs(off), 0.9):.1f} ms (90 %), "
        f"{np.abs(off).max():.1f} ms at worst; bias {off.mean():+.2f} ms."
    )


if __name__ == "__main__":
    main()
