"""Does an export move as its calibration does? Both are simulated, side by side.

The exported MJCF is compiled into a model of free hinges, whose bodies have the inertia of the
links that were taken off, inside of defaults that a robot's model may have. The calibration's own
model is the servo that was fitted, in its own steps: under load with all its frictions, which an
export cannot carry. Both run freely on commands that no recording had: tones between the usual
ones, and a walk.

The distance has three parts, each simulated alone: what MuJoCo makes of the written
numbers (the same numbers in the same steps, in the arithmetic of the fit), what an actuator cannot
carry of a servo fitted under load, and what the length of the physics step costs. For the last,
terms of the servo are switched off one at a time, in the steps of the fit and in those of the
export.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import JointResults, Result
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.calibration.parts import JointCalibration
from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayLine
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.servo_models.loaded_servo import LoadedServo
from pupper_sysid.servo_models.step_size import (
    CONTINUOUS_S,
    CONTROL_S,
    MUJOCO_PID,
    in_loop,
    nearest_in_loop,
)
from pupper_sysid.sim.export.mjcf import to_mjcf
from pupper_sysid.sim.export.shared import ExportedServos
from pupper_sysid.sim.robot.servo_mjcf import hold

Array = NDArray[np.float64]

TONES_HZ, AMPLITUDE_RAD, TONE_S = (1.7, 2.7, 3.7), 0.25, 1.0
WALK_S = 2.0
_SETTLE_S = 0.5
_SEEN_MRAD = 0.005  # of tables with two decimals
WHOLE = "whole servo"
SWITCHED_OFF: dict[str, dict[str, float]] = {
    WHOLE: {},
    "no speed limit": {"velocity_limit": np.inf},
    "no dry friction": {"friction_loss": 0.0},
    "no torque limit": {"effort_limit": np.inf},
    "PD loop alone": {"velocity_limit": np.inf, "friction_loss": 0.0, "effort_limit": np.inf},
}
"""Terms of a servo that are switched off to see what the physics step costs them."""
_MODEL_DEFAULTS = '<joint damping="0.6" frictionloss="0.05"/><position kp="20"/>'


@dataclass(frozen=True)
class JointCheck(Result):
    """How far one joint's export is from its calibration."""

    tones_rad: float
    """RMS apart on tones [rad]."""
    walk_rad: float
    """RMS apart on a walk's commands [rad]."""
    same_steps_rad: float
    """What MuJoCo adds: RMS from the same numbers in the same steps, on the tones [rad]."""
    not_carried_rad: float
    """What of a servo under load an actuator does not carry, RMS on the tones [rad]."""
    step_rad: dict[str, float]
    """What the physics step costs, RMS on the tones [rad]: of the whole servo, without one of its
    terms, and of the PD loop alone."""
    step_of_full_torque_rad: float
    """How far the largest torque moves the servo in one physics step from rest [rad]."""
    reading_counts: float
    """RMS apart of the readings on the walk, in counts of the servo."""
    whole_steps_rad: float
    """What a delay of the nearest whole step would cost at 4 Hz, 0.3 rad, RMS [rad]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Check(JointResults[JointCheck]):
    """How far an export is from its calibration; `notes` say what the numbers mean."""

    physics_step_s: float
    notes: tuple[str, ...]


def check(servos: ExportedServos) -> Check:
    """Simulate an export in MuJoCo beside its calibration."""
    names = servos.calibration.joint_names
    tones, walk = unseen_tones(), walk_commands()
    model = compiled(servos)
    costs, joints = servos.whole_step_costs(), {}
    on_tones = moved_by(model, names, tones, servos.physics_step_s)
    on_walk = moved_by(model, names, walk, servos.physics_step_s)
    at = [servos.physics_step_s * np.arange(1, len(moved) + 1) for moved in (on_tones, on_walk)]
    step_errors = step_costs(servos, tones)
    for n, name in enumerate(names):
        joint = servos.moving.joint(name)
        fitted_at, fitted = _fitted_motion(joint, tones)
        walk_at, walked = _fitted_motion(joint, walk)
        pd = joint.actuator
        pd_at, pd_moved = in_loop(pd.parameters, pd.fitted_step_s, tones)
        stepped = servos.actuators(MUJOCO_PID)[name].parameters
        same_armature = replace(stepped, armature=pd.parameters.armature)
        _, same = in_loop(same_armature, servos.physics_step_s, tones)
        feedback = servos.calibration.held_feedback(name)
        torque = pd.effort_limit_nm.value / pd.armature_kg_m2.value
        joints[name] = JointCheck(
            tones_rad=_rms_difference(at[0], on_tones[:, n], fitted_at, fitted),
            walk_rad=_rms_difference(at[1], on_walk[:, n], walk_at, walked),
            same_steps_rad=_rms_difference(at[0], on_tones[:, n], at[0], same[1:, 0]),
            not_carried_rad=_rms_difference(pd_at, pd_moved[:, 0], fitted_at, fitted),
            step_rad={part: errors[n] for part, errors in step_errors.items()},
            step_of_full_torque_rad=torque * servos.physics_step_s**2,
            reading_counts=_rms_counts(feedback, on_walk[:, n], at[1], walk_at, walked),
            whole_steps_rad=costs[name],
        )
    return Check(
        joints=joints, physics_step_s=servos.physics_step_s, notes=tuple(_notes(servos, joints))
    )


def step_costs(servos: ExportedServos, commands: NDArray) -> dict[str, list[float]]:
    """What the physics step costs servos and servos without terms, RMS by joint [rad]."""
    h = servos.physics_step_s
    costs: dict[str, list[float]] = {part: [] for part in SWITCHED_OFF}
    for joint in servos.moving.joints.values():
        fitted_s = joint.actuator.fitted_step_s
        all_terms = joint.actuator.parameters
        for part, terms in SWITCHED_OFF.items():
            servo = replace(all_terms, **terms)
            at, moved = in_loop(servo, fitted_s, commands)
            stepped_at, stepped = in_loop(
                nearest_in_loop(servo, h, fitted_s, MUJOCO_PID), h, commands
            )
            costs[part].append(_rms_difference(stepped_at, stepped[:, 0], at, moved[:, 0]))
    return costs


def _fitted_motion(joint: JointCalibration, commands: NDArray) -> tuple[Array, Array]:
    """Times and positions of the calibration's model, in the steps of its fit."""
    actuator, loaded = joint.actuator, joint.servo
    step_s, start = actuator.fitted_step_s, np.array(commands[0])
    servo: DelayedPD | LoadedServo = DelayedPD(actuator.parameters, step_s)
    arriving = held(commands, step_s)
    if loaded is not None:
        # this model has no limit on the set-point's speed, which a card states
        servo = LoadedServo(loaded.parameters(0.0), loaded.p_gain, time_step_s=step_s)
        line = DelayLine(np.array(actuator.dead_time_s.value), step_s)
        line.reset(start)
        most = actuator.velocity_limit_rad_s.value * step_s
        targets, target = line.shift(arriving), float(start)
        for n, arrived in enumerate(targets):
            targets[n] = target = target + min(max(arrived - target, -most), most)
        arriving = targets
    servo.reset(start)
    moved = servo.rollout(arriving)
    return step_s * np.arange(len(moved) + 1, dtype=float), np.append(start, moved)


def _rms_difference(at: NDArray, moved: NDArray, other_at: NDArray, other: NDArray) -> float:
    """RMS difference of two motions, after they have settled [rad]."""
    late = at > _SETTLE_S
    return rms((moved - np.interp(at, other_at, other))[late])


def _notes(servos: ExportedServos, joints: Mapping[str, JointCheck]) -> Iterator[str]:
    yield (
        f"Free run on tones of {', '.join(f'{hz:g}' for hz in TONES_HZ)} Hz and a walk's "
        "commands, in free air. 'Same steps' is what MuJoCo adds to the same numbers in the same "
        "steps. 'Whole steps' is what a delay of the nearest whole step would cost at 4 Hz, "
        "0.3 rad: simulators on torch get a class with delays of any fraction."
    )
    h = servos.physics_step_s
    steps_s = {joint.actuator.fitted_step_s for joint in servos.calibration.joints.values()}
    if steps_s != {h}:
        continuous = min(steps_s) <= CONTINUOUS_S
        basis = "in continuous time" if continuous else f"for steps of {1e3 * min(steps_s):g} ms"
        worst = max(joints, key=lambda name: joints[name].step_rad[WHOLE])
        error_mrad = 1e3 * joints[worst].step_rad[WHOLE]
        far = 1e3 * joints[worst].step_of_full_torque_rad
        actuator = servos.moving.joint(worst).actuator
        half = nearest_in_loop(actuator.parameters, h / 2, actuator.fitted_step_s, MUJOCO_PID)
        fitted = in_loop(actuator.parameters, actuator.fitted_step_s, unseen_tones())
        at, moved = in_loop(half, h / 2, unseen_tones())
        half_step_mrad = 1e3 * _rms_difference(at, moved[:, 0], fitted[0], fitted[1][:, 0])
        yield (
            f"The servos' numbers are {basis}, and no numbers of an actuator make up for steps of "
            f"{1e3 * h:g} ms: in one, the largest torque moves {worst} by {far:.2g} mrad, and "
            "torque, friction and set-point change once. The second table says what that costs, "
            "and what it would cost without a term."
            + (
                f" Steps of {1e3 * h / 2:g} ms would leave {half_step_mrad:.2g} mrad of {worst}'s "
                f"{error_mrad:.2g}."
                if half_step_mrad < error_mrad
                else ""
            )
        )
    yield from servos.short_delays()
    costs = {
        name: 1e3 * row.not_carried_rad
        for name, row in joints.items()
        if servos.calibration.joint(name).servo is not None
    }
    # without frictions of the load such a servo moves like its actuator, up to rounding
    if loaded := [name for name, cost in costs.items() if cost >= _SEEN_MRAD]:
        most = max(costs[name] for name in loaded)
        yield (
            f"{', '.join(loaded)}: fitted under load, so the calibration's own model has frictions "
            f"that no simulator's actuator carries; they cost up to {most:.2g} mrad."
        )


def compiled(servos: ExportedServos, defaults: str = _MODEL_DEFAULTS) -> Any:
    """A model of free hinges that includes the export, in classes with `defaults`."""
    from pupper_sysid.sim.robot.engine import mujoco

    bodies = []
    for name in servos.calibration.joint_names:
        inertia = max(servos.links.get(name, 0.0), 1e-15)
        bodies.append(
            f'<body><joint name="{name}" class="servo_{name}" type="hinge" axis="0 1 0"/>'
            f'<inertial pos="0 0 0" mass="1e-9" diaginertia="{inertia} {inertia} {inertia}"/>'
            "</body>"
        )
    text = (
        f'<mujoco><default>{defaults}</default><include file="servos.xml"/>'
        f'<option gravity="0 0 0"/><worldbody>{"".join(bodies)}</worldbody></mujoco>'
    )
    return mujoco.MjModel.from_xml_string(text, {"servos.xml": to_mjcf(servos).encode()})


def moved_by(model: Any, joints: tuple[str, ...], commands: NDArray, step_s: float) -> Array:
    """Positions of hinges after each step, (steps, joints), from rest at the first command."""
    from pupper_sysid.sim.robot.engine import mujoco

    data = mujoco.MjData(model)
    of = {int(model.actuator_trnid[i, 0]): i for i in range(model.nu)}
    actuators = [of[model.joint(name).id] for name in joints]
    places = [int(model.joint(name).qposadr[0]) for name in joints]
    data.qpos[places] = commands[0]
    for index in actuators:
        hold(model, data, index, float(commands[0]))
    positions = []
    for command in held(commands, step_s):
        data.ctrl[actuators] = command
        mujoco.mj_step(model, data)
        positions.append(data.qpos[places].copy())
    return np.array(positions)


def held(commands: NDArray, step_s: float) -> Array:
    """Mean of the held commands of a loop over each physics step."""
    edges = CONTROL_S * np.arange(len(commands) + 1)
    area = np.append(0.0, np.cumsum(commands) * CONTROL_S)
    steps = int(edges[-1] / step_s + 1e-9)
    return np.diff(np.interp(step_s * np.arange(steps + 1), edges, area)) / step_s


def walk_commands() -> Array:
    """Commands of one thigh in the sample's walk, from where it begins [rad]."""
    file = resources.files("pupper_sysid.data") / "samples" / "walk_commands.csv"
    with resources.as_file(file) as path:
        rows = np.genfromtxt(path, delimiter=",", names=True)
    time = np.arange(0.0, min(WALK_S, rows["time_s"][-1]), CONTROL_S)
    row = np.searchsorted(rows["time_s"], time + 1e-9, side="right") - 1
    return (rows["LF_thigh_command_rad"] - rows["LF_thigh_command_rad"][0])[row]


def unseen_tones() -> Array:
    """Commands of the tones, one after the other [rad]."""
    time = np.arange(0.0, TONE_S, CONTROL_S)
    return AMPLITUDE_RAD * np.sin(2 * np.pi * np.outer(TONES_HZ, time)).ravel()


def _rms_counts(
    feedback: HeldFeedback, exported: NDArray, at: NDArray, fitted_at: NDArray, fitted: NDArray
) -> float:
    """RMS difference of readings in counts: stepped on the export, polled on the calibration."""
    period, quantum = feedback.poll_period_s, feedback.quantum_rad or 2 * np.pi / 4096
    if period <= 0:
        return rms(exported - np.interp(at, fitted_at, fitted)) / quantum
    without_loss = HeldFeedback(poll_period_s=period, quantum_rad=quantum)
    without_loss.reset(exported[0], float(at[1] - at[0]), until_poll_s=period / 2)
    exported_readings = np.array([without_loss.step(x) for x in exported])
    polls = period / 2 + period * np.arange(int(at[-1] / period) + 1)
    reported = np.round(np.interp(polls, fitted_at, fitted) / quantum) * quantum
    last_poll = np.clip(np.searchsorted(polls, at + 1e-12, side="right") - 1, 0, None)
    errors = (exported_readings - reported[last_poll])[at > _SETTLE_S] / quantum
    return rms(errors)
