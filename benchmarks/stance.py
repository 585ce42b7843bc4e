"""How low and wide a robot stands: falls of the open-loop trot when pushed, and its errors.

    .venv/bin/python benchmarks/stance.py

The trot sees nothing, so that only its stance decides. Robots with servos of the sample calibration
walk for 20 s under random commands, pushed by 1.2 m/s in a random direction every 4 s, and without.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from pupper_sysid.policies.evaluation.figures import share_interval
from pupper_sysid.policies.walks.conditions import evaluation_task, random_commands
from pupper_sysid.policies.walks.handicaps import push_directions
from pupper_sysid.policies.walks.tracking import planar_velocity
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

_SECONDS, _IGNORED, _PUSH = 20.0, 1.0, 1.2
_STANCES_MM = ((0, 0), (10, 7), (15, 7), (20, 7), (25, 7), (10, 15), (10, 25), (20, 20))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    print("| lower, wider mm | pushed: fell % | vx mm/s | vy mm/s | yaw mrad/s | torque N·m |")
    print("|---|---|---|---|---|---|")
    for crouch, spread in _STANCES_MM:
        trot = Trot(crouch_m=1e-3 * crouch, spread_m=1e-3 * spread)
        fell, *_ = _walk(trot, _PUSH, options)
        _, errors, torque = _walk(trot, 0.0, options)
        share = share_interval(int(fell.sum()), len(fell))
        print(
            f"| {crouch}, {spread} | {100 * share.value:.0f} "
            f"({100 * share.low:.0f}–{100 * share.high:.0f}) | "
            + " | ".join(f"{1e3 * error:.1f}" for error in errors)
            + f" | {torque:.3f} |",
            flush=True,
        )


def _walk(trot: Trot, push_m_s: float, options: argparse.Namespace):
    """Which robots fell, mean absolute errors of every instant, and the torques' mean size."""
    task, robots = evaluation_task(Walking(), 2 * _SECONDS), options.robots
    servos = servo_ranges("data/samples/calibrated.yaml", "held")
    env = PupperEnv(task, servos, robots, 7, options.threads)
    steps, dt = round(_SECONDS / task.control_step_s), task.control_step_s
    commands = random_commands(robots, steps, dt, 7)
    pushes = push_directions(robots, steps, dt, 7) if push_m_s else {}
    phase, up = np.zeros(robots), np.ones(robots, bool)
    errors, torques = [], []
    for step in range(steps):
        env.set_command(commands[step])
        if step in pushes:
            env.robots.push(np.arange(robots), push_m_s * pushes[step])
        phase += 2 * np.pi * trot.frequency_hz * dt
        result = env.step((trot.joints(phase, env.command) - env.default) / task.action_scale)
        up &= ~result.done
        if step * dt >= _IGNORED:
            errors.append(np.abs(planar_velocity(result.facts) - env.command)[up].mean(axis=0))
            torques.append(np.abs(result.facts.torque[up]).mean())
    return ~up, np.mean(errors, axis=0), float(np.mean(torques))


if __name__ == "__main__":
    main()
