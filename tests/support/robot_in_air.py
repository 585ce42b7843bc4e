"""The robot without gravity, ground and weight: where each of its servos should move as fitted."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.common.tones import fit_sine
from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import default_pose
from pupper_sysid.sim.robot.servo_mjcf import hold


def standing(model: Any) -> Any:
    """The default pose, at rest, commanded there for long."""
    data = mujoco.MjData(model)
    data.qpos[7:] = default_pose()
    held = default_pose()
    if model.ntendon:
        held[2::3] += held[1::3]
    for i in range(model.nu):
        hold(model, data, i, held[i])
    mujoco.mj_forward(model, data)
    return data


def in_free_space(model: Any, data: Any) -> None:
    """No gravity, no ground, and a trunk that nothing moves."""
    model.opt.gravity[:] = 0
    trunk = model.body("trunk").id
    model.body_mass[trunk] = model.body_inertia[trunk] = 1e6
    data.qpos[2] = 1.0


def error_in_air(
    model: Any, servos: Sequence[DelayedPDParameters], exactly_solved: bool = True
) -> np.ndarray:
    """Largest difference [rad] of each servo from `DelayedPD` while all swing weightless links."""
    step = model.opt.timestep
    _weightless(model)
    if exactly_solved:
        model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 100, 1e-15
    data = standing(model)
    in_free_space(model, data)
    start = data.ctrl.copy()
    swing = np.sin(2 * np.pi * 2.5 * np.arange(300) * step)[:, None]
    commands = start + 0.2 * swing * np.linspace(0.6, 1, 12)
    found = []
    for command in commands:
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        found.append(data.qpos[7:].copy())
    angles = np.array(found)
    if model.ntendon:
        angles[:, 2::3] += angles[:, 1::3]
    expected = np.empty_like(angles)
    for i, servo in enumerate(servos):
        alone = DelayedPD(servo, step)
        alone.reset(start[i])
        expected[:, i] = alone.rollout(commands[:, i])
    assert np.ptp(expected, axis=0).min() > 0.1, "servos must move for this to be a comparison"
    return np.abs(angles - expected).max(axis=0)


def lags_in_air(model: Any, control_step_s: float) -> np.ndarray:
    """Lag [s] of each servo behind a tone of 2 Hz commanded every `control_step_s`."""
    _weightless(model)
    data = standing(model)
    in_free_space(model, data)
    start, turn, step = data.ctrl.copy(), 2 * np.pi * 2.0, model.opt.timestep
    share, held = np.linspace(0.6, 1, 12), round(control_step_s / step)
    angles = []
    for tick in range(100):
        data.ctrl[:] = start + 0.2 * np.sin(turn * tick * control_step_s) * share
        for _ in range(held):
            mujoco.mj_step(model, data)
            angles.append(data.qpos[7:].copy())
    moved = np.array(angles)
    if model.ntendon:
        moved[:, 2::3] += moved[:, 1::3]
    half = len(moved) // 2  # whole periods, from the middle on
    time = step * np.arange(1, len(moved) + 1)[half:]
    phasor = fit_sine(turn * time, moved[half:]).phasor
    return np.arctan2(-phasor.real, -phasor.imag) / turn


def _weightless(model: Any) -> None:
    """Links that weigh next to nothing."""
    for name in JOINT_NAMES:
        body = model.body(name).id
        model.body_mass[body], model.body_inertia[body] = 1e-9, 1e-15
    mujoco.mj_setConst(model, mujoco.MjData(model))
