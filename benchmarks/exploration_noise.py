"""What exploration costs a good gait: the open-loop trot with noise on its actions.

    .venv/bin/python benchmarks/exploration_noise.py

A policy learns from walks with noise. This is how much worse the reference trot walks with it, and
what it earns of the reward of `--start teacher`: as long as noise costs more than the differences
between gaits that PPO is to find, it cannot find them. Joints have equal noise here.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from pupper_sysid.policies.network.hyperparameters import Exploration
from pupper_sysid.policies.walks.conditions import evaluation_task, random_commands
from pupper_sysid.policies.walks.tracking import planar_velocity
from pupper_sysid.sim.walking.config import PRESETS
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

CALIBRATED = "data/samples/calibrated.yaml"
NOISES = (
    (0.0, 0.15), (0.015, 0.15), (0.03, 0.15), (0.06, 0.15), (0.12, 0.15), (0.12, 0.3), (0.12, 1.0),
    (0.03, 0.0), (0.12, 0.0),
)  # fmt: skip
_IGNORED = 50  # steps of the start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    print("| deviation of the noise | lasts s | errors vx, vy m/s, yaw rad/s | reward per s |")
    print("|---|---|---|---|")
    for std, lasts_s in NOISES:
        error, reward = walk(std, lasts_s, options.robots, options.seconds)
        shown = " / ".join(f"{e:.3f}" for e in error)
        print(f"| {std:g} | {lasts_s:g} | {shown} | {reward:.1f} |", flush=True)


def walk(std: float, lasts_s: float, robots: int, seconds: float) -> tuple[np.ndarray, float]:
    """Mean absolute errors, shape (3,), and reward per second of the trot with such noise."""
    scratch = PRESETS["scratch"]
    task = replace(
        evaluation_task(scratch), physics="training", physics_step_s=scratch.physics_step_s
    )
    env = PupperEnv(task, servo_ranges(CALIBRATED, "held"), robots, seed=3)
    span, steps = task.control_step_s, round(seconds / task.control_step_s)
    commands = random_commands(robots, steps, span, seed=5)
    rng = np.random.default_rng(0)
    keeps = Exploration(persistence_s=lasts_s).correlation(span)
    noise = std * rng.standard_normal((robots, 12))
    phase, errors, rewards = np.zeros(robots), [], []
    for command in commands:
        env.set_command(command)
        phase += 2 * np.pi * env.trot.frequency_hz * span
        drawn = rng.standard_normal(noise.shape)
        noise = keeps * noise + np.sqrt(1 - keeps**2) * std * drawn
        joints = env.trot.joints(phase, env.command)
        found = env.step((joints - env.default) / task.action_scale + noise)
        errors.append(np.abs(planar_velocity(found.facts) - command).mean(axis=0))
        rewards.append(found.reward.mean() / span)
    return np.mean(errors[_IGNORED:], axis=0), float(np.mean(rewards[_IGNORED:]))


if __name__ == "__main__":
    main()
