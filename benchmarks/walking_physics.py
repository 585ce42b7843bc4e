"""The robot's physics side by side: cost, walking statistics, and servos in the air.

    .venv/bin/python benchmarks/walking_physics.py --episodes 32

`before` is the model up to commit 9ed8b0a, rebuilt here: feet of cylinders, contacts and touch
sensors of every body, ten iterations of PGS. First the processor time of one control step of 512
robots, all models in turns in slices of 0.2 s; then how the open-loop trot and the shipped policies
walk in each, the same robots under the same commands; then how far servos in the air are from those
of a converged solver.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from pupper_sysid.common.joints import LEGS
from pupper_sysid.common.processes.memory import keep_freed_memory
from pupper_sysid.policies.network.policy_file import Policy, load_policy
from pupper_sysid.policies.train.speed import Paces, load
from pupper_sysid.policies.walks.conditions import evaluation_task
from pupper_sysid.sim.robot import robot_batch
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import default_pose, robot_xml
from pupper_sysid.sim.robot.servo_mjcf import hold
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

SAMPLES = Path("data/samples")
ACTUATOR = SAMPLES / "calibrated.yaml"
MODELS = {
    "before, 2 ms": Walking(physics="evaluation"),
    "training, 2 ms": Walking(),
    "training, 4 ms": Walking(physics_step_s=0.004),
    "evaluation, 2 ms": Walking(physics="evaluation"),
}
QUANTITIES = {
    "error vx, mm/s": 1e3, "vy, mm/s": 1e3, "yaw, mrad/s": 1e3, "slip, mm/s": 1e3, "duty": 1.0,
    "height, mm": 1e3, "tilt, mrad": 1e3,
}  # fmt: skip
AIR_S = 5.0


def xml_before(*given: Any) -> str:
    """The MJCF of the model before, for the arguments of `robot_xml`."""
    servos, step, knee, ground, assets = given[:5]
    xml = robot_xml(servos, step, knee, ground, assets, "evaluation", True)
    xml = re.sub(r'solver="Newton".*?/>', 'solver="PGS" iterations="10"/>', xml)
    for leg in LEGS:
        foot = f'<geom name="{leg}_foot" type='
        assert foot + '"sphere" size="0.0085"' in xml
        xml = xml.replace(
            foot + '"sphere" size="0.0085"',
            foot + '"cylinder" size="0.0085 0.003" zaxis="0 1 0"',
        )
    sensors = ""
    for body in ("trunk", *(f"{leg}_{part}" for leg in LEGS for part in ("hip", "thigh"))):
        geom = f'<geom name="{body}" '
        site = f'<site name="{body}_touch" type="sphere" size="0.08" group="4"/>'
        xml = xml.replace(geom, site + geom)
        sensors += f'<touch name="{body}_touch" site="{body}_touch"/>'
    return xml.replace("</sensor>", sensors + "</sensor>")


@contextmanager
def model_of(name: str) -> Iterator[None]:
    """Environments made inside have the robot of this name."""
    if name.startswith("before"):
        robot_batch.robot_xml = xml_before
    try:
        yield
    finally:
        robot_batch.robot_xml = robot_xml


def costs(robots: int, slices: int, threads: int) -> None:
    """Processor time of a control step: physics alone, and the environment."""
    paces, times = {}, {name: [] for name in MODELS}
    for name, task in MODELS.items():
        with model_of(name):
            paces[name] = Paces(PupperEnv(task, servo_ranges(ACTUATOR), robots, 0, threads))
    for i in range(slices):
        for name, own in paces.items():
            times[name].append(own.slice(bool(i % 2)))
    found = {name: 1e6 * np.array(each)[:, :, 1] for name, each in times.items()}
    first = next(iter(found.values()))
    print(f"{robots} robots, {threads} thread(s), {slices} slices; load {load():.1f}.\n")
    print("| physics | bare, µs | times before | environment, µs | times before |")
    print("|---|---|---|---|---|")
    for name, each in found.items():
        cells = []
        for side in (1, 0):
            low, middle, high = np.quantile(each[:, side] / first[:, side], [0.25, 0.5, 0.75])
            cells += [f"{np.median(each[:, side]):.0f}", f"{middle:.2f} ({low:.2f}–{high:.2f})"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def walked(task: Walking, episodes: int, policy: Policy | None) -> tuple[np.ndarray, int]:
    """Quantities of each episode, shape (quantities, episodes), and how many robots fell."""
    env = PupperEnv(task, servo_ranges(ACTUATOR), episodes, 100, 1)
    observation, _ = env.observe()
    if policy:
        policy.reset(env.action)
    step = 2 * np.pi * env.trot.frequency_hz * task.control_step_s
    alive, rows = np.ones(episodes, bool), []
    for i in range(task.episode_steps - 1):
        if policy:
            action = policy.act(observation)
        else:
            target = env.trot.joints(np.full(episodes, step * i), env.command)
            action = (target - env.default) / task.action_scale
        found = env.step(action)
        observation, f = found.observation, found.facts
        alive &= ~found.done
        error = np.abs(f.linear_velocity[:, :2] - f.command[:, :2])
        standing = f.contact.sum(axis=1)
        slip = np.divide((f.foot_speed_m_s * f.contact).sum(axis=1), np.maximum(standing, 1))
        row = [
            *error.T, np.abs(f.angular_velocity[:, 2] - f.command[:, 2]), slip, standing / 4,
            env.robots.qpos[:, 2], np.arccos(np.clip(-f.gravity[:, 2], -1, 1)),
        ]  # fmt: skip
        rows.append(np.where(alive, row, np.nan))
    return np.nanmean(np.array(rows), axis=0), int((~alive).sum())


def statistics(episodes: int) -> None:
    """How the trot and the shipped policies walk in each kind of physics."""
    policies = {"open-loop trot": None} | {
        kind: load_policy(SAMPLES / "policies" / kind) for kind in ("mlp", "lstm")
    }
    print(f"\n{episodes} episodes of 20 s each, random commands; mean, and below `before` the")
    print("difference to it on the same robots, each ± its standard error.\n")
    print(f"| gait | physics | falls | {' | '.join(QUANTITIES)} |")
    print("|---" * (3 + len(QUANTITIES)) + "|")
    scale = np.array(list(QUANTITIES.values()))[:, None]
    for gait, policy in policies.items():
        first = None
        for name, task in MODELS.items():
            settings = replace(
                evaluation_task(task), physics=task.physics, physics_step_s=task.physics_step_s
            )
            with model_of(name):
                found, fallen = walked(settings, episodes, policy)
            found = found * scale
            shown, sign = (found, "") if first is None else (found - first, "+")
            first = found if first is None else first
            cells = [
                f"{own.mean():{sign}.3g} ± {own.std(ddof=1) / np.sqrt(episodes):.1g}"
                for own in shown
            ]
            print(f"| {gait} | {name} | {fallen} | {' | '.join(cells)} |", flush=True)


def in_the_air(actuator: str, change: Callable[[Any], None], heavy: float) -> np.ndarray:
    """Servo angles [rad] over 5 s of tones, without gravity, shape (steps, 12)."""
    model = mujoco.MjModel.from_xml_string(robot_xml(servo_ranges(actuator).nominal(), 0.002))
    change(model.opt)
    model.opt.gravity[:] = 0
    trunk = model.body("trunk").id
    model.body_mass[trunk] *= heavy
    model.body_inertia[trunk] *= heavy
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[2], data.qpos[7:] = 1.0, default_pose()
    start = default_pose()
    start[2::3] += start[1::3]
    for i, angle in enumerate(start):
        hold(model, data, i, angle)
    frequency, size, found = rng.uniform(0.5, 4.0, 12), rng.uniform(0.05, 0.4, 12), []
    for k in range(round(AIR_S / 0.002)):
        if k % 10 == 0:
            data.ctrl[:] = start + size * np.sin(2 * np.pi * frequency * k * 0.002)
        mujoco.mj_step(model, data)
        found.append(data.qpos[7:].copy())
    return np.array(found)


def air() -> None:
    """Largest distance from a converged solver."""

    def converged(option: Any) -> None:
        option.iterations, option.ls_iterations = 100, 200
        option.tolerance, option.ls_tolerance = 0.0, 1e-8

    def pgs(iterations: int) -> Callable[[Any], None]:
        def change(option: Any) -> None:
            option.solver, option.iterations = mujoco.mjtSolver.mjSOL_PGS, iterations
            option.tolerance = 1e-8

        return change

    ways: dict[str, Callable[[Any], None]] = {
        "evaluation": lambda option: None, "PGS 8 (training)": pgs(8), "PGS 10": pgs(10),
    }  # fmt: skip
    print(
        f"\nServos in the air over {AIR_S:g} s: largest distance from a converged solver [rad].\n"
    )
    print(f"| actuator | trunk | {' | '.join(ways)} |")
    print("|---" * (2 + len(ways)) + "|")
    for actuator in (str(ACTUATOR), "paper", "release"):
        for heavy, trunk in ((1.0, "free"), (1e3, "held")):
            exact = in_the_air(actuator, converged, heavy)
            off = [np.abs(in_the_air(actuator, w, heavy) - exact).max() for w in ways.values()]
            name = Path(actuator).name
            print(f"| {name} | {trunk} | {' | '.join(f'{o:.1e}' for o in off)} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--robots", type=int, default=512)
    parser.add_argument("--slices", type=int, default=25)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    costs(options.robots, options.slices, options.threads)
    air()
    statistics(options.episodes)


if __name__ == "__main__":
    main()
