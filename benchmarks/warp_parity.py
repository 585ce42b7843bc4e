"""How near the robots on mujoco-warp stay to MuJoCo's; see benchmarks/README.md.

Random robots with servos of the sample calibration trot in the air and on the ground for one
second, on both engines from the same states under the same commands; and on MuJoCo once more, with
all positions moved by 1e-7 (and velocities by 3e-6) at random before every control step.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from pupper_sysid.sim.gpu.warp_robots import WarpRobots
from pupper_sysid.sim.robot.mini_pupper import default_pose
from pupper_sysid.sim.robot.robot_batch import RobotBatch
from pupper_sysid.sim.robot.terrain import make_ground
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

TASK = replace(Walking(), physics="evaluation")
SERVOS = servo_ranges(Path(__file__).resolve().parents[1] / "data/samples/calibrated.yaml")
STEPS = 50
AIR_M = 10.0
MOVED, MOVED_PER_S = 1e-7, 3e-6


class _Shaken(RobotBatch):
    """MuJoCo's robots, which something moves by about what single precision does not tell apart."""

    shaker = np.random.default_rng(99)

    def step(self, target: np.ndarray):
        self.qpos[:] += self.shaker.normal(0.0, MOVED, self.qpos.shape)
        self.qvel[:] += self.shaker.normal(0.0, MOVED_PER_S, self.qvel.shape)
        return super().step(target)


def walked(device: str | None, lift_m: float, robots: int, seed: int) -> np.ndarray:
    """Joint angles, shape (robots, physics steps, 12)."""
    ground, rng = make_ground(TASK.terrain, np.random.default_rng(0)), np.random.default_rng(seed)
    if device in (None, "shaken"):
        batch = (_Shaken if device else RobotBatch)(TASK, SERVOS, ground, robots, 1, None)
    else:
        batch = WarpRobots(TASK, SERVOS, ground, robots, device)
    everyone, still = np.arange(robots), np.zeros((robots, 12))
    batch.draw(everyone, 1.0, rng)
    batch.place(everyone, still + default_pose(), still, 0.5, rng)
    batch.qpos[:, 2] += lift_m
    command = rng.uniform([-0.15, -0.1, -0.5], [0.15, 0.1, 0.5], (robots, 3))
    begun = rng.uniform(0, 2 * np.pi, robots)
    found = []
    for k in range(STEPS):
        phase = begun + 2 * np.pi * Trot().frequency_hz * k * TASK.control_step_s
        found += [m.qpos[..., 7:].copy() for m in batch.step(Trot().joints(phase, command))]
    return np.concatenate(found, axis=1)


def main() -> None:
    """Print one row per place and seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=64)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    print("| engine | where | seed | median rad | 90 % | worst | robots beyond 1e-3 |")
    print("|---|---|---|---|---|---|---|")
    for where, lift_m in (("in the air", AIR_M), ("walking", 0.0)):
        for seed in range(options.seeds):
            expected = walked(None, lift_m, options.robots, seed)
            for engine, device in (("mujoco-warp", options.device), ("MuJoCo, moved", "shaken")):
                found = walked(device, lift_m, options.robots, seed)
                apart = np.abs(found - expected).max(axis=(1, 2))
                middle, most = np.quantile(apart, [0.5, 0.9])
                print(
                    f"| {engine} | {where} | {seed} | {middle:.1e} | {most:.1e} | "
                    f"{apart.max():.1e} | {(apart > 1e-3).sum()} of {len(apart)} |"
                )


if __name__ == "__main__":
    main()
