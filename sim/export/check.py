"""Does an export move as its calibration does? Both are simulated, side by side.

The exported MJCF is compiled into a model of free hinges, whose bodies have the inertia of the
links that were taken off, inside of defaults that a robot's model may have. The calibration's own
model is the servo that was fitted, in its own steps: under load with all its frictions, which an
export cannot carry. Both run freely on commands that no recording had: tones between the usual
ones, and a walk.

In steps of another length than those of the fit a servo moves otherwise by some mrad, whatever its
numbers: dry friction holds it until the end of a step.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import JointResults, Result
from pupper_sysid.servo_models.calibration.parts import JointCalibration
from pupper_sysid.servo_models.delayed_pd import DelayedPD
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.servo_models.loaded_servo import LoadedServo
from pupper_sysid.servo_models.step_size import CONTINUOUS_S
from pupper_sysid.sim.export.mjcf import to_mjcf
from pupper_sysid.sim.export.shared import ExportedServos
from pupper_sysid.sim.robot.servo_mjcf import hold

TONES_HZ, AMPLITUDE_RAD, TONE_S = (1.7, 2.7, 3.7), 0.25, 1.0
WALK_S, LOOP_S = 2.0, 0.02
_SETTLE_S = 0.5
_MODEL_DEFAULTS = '<joint damping="0.6" frictionloss="0.05"/><position kp="20"/>'


@dataclass(frozen=True)
class JointCheck(Result):
    """How far one joint's export is from its calibration."""

    tones_rad: float
    """RMS apart on tones [rad]."""
    walk_rad: float
    """RMS apart on a walk's commands [rad]."""
    reading_counts: float
    """RMS apart of the readings on the walk, in counts of the servo."""
    whole_steps_rad: float
    """What a delay of the nearest whole step would cost at 4 Hz, 0.3 rad, RMS [rad]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Check(JointResults[JointCheck]):
    """How far an export is from its calibration.

    Attributes
    ----------
    joints : dict of str to JointCheck
    physics_step_s : float
    notes : tuple of str
        What the numbers mean, in sentences.
    """

    physics_step_s: float
    notes: tuple[str, ...]


def check(servos: ExportedServos) -> Check:
    """Simulate an export in MuJoCo beside its calibration.

    Raises
    ------
    InputError
        If the step is too long for the servos.
    """
    names = servos.calibration.joint_names
    tones = unseen_tones()
    walk = walk_commands()
    model = compiled(servos)
    ours = {name: own_model(servos.moving.joint(name)) for name in names}
    apart: dict[str, dict[str, float]] = {name: {} for name in names}
    counts = {}
    for kind, commands in (("tones", tones), ("walk", walk)):
        there = moved_by(model, names, commands, servos.physics_step_s)
        at = servos.physics_step_s * np.arange(1, len(there) + 1)
        for name, exported in zip(names, there.T, strict=True):
            servo = ours[name]
            servo.reset(commands[0])
            own = servo.rollout(held(commands, servo.time_step_s))
            own_at = servo.time_step_s * np.arange(1, len(own) + 1)
            here = np.interp(at, np.append(0.0, own_at), np.append(commands[0], own))
            late = at > _SETTLE_S
            apart[name][kind] = float(np.sqrt(np.mean((exported - here)[late] ** 2)))
            if kind == "walk":
                feedback = servos.calibration.held_feedback(name)
                counts[name] = _counts_apart(feedback, exported, at, own_at, own)
    costs = servos.whole_step_costs()
    joints = {
        name: JointCheck(errors["tones"], errors["walk"], counts[name], costs[name])
        for name, errors in apart.items()
    }
    fitted = {joint.actuator.fitted_step_s for joint in servos.calibration.joints.values()}
    loaded = [n for n in names if servos.calibration.joint(n).under_load is not None]
    notes = (
        f"Free run on tones of {', '.join(f'{hz:g}' for hz in TONES_HZ)} Hz and a walk's "
        "commands, in free air. The last column is what a delay of the nearest whole step would "
        "cost at 4 Hz, 0.3 rad: simulators on torch get a class with delays of any fraction.",
    )
    if fitted != {servos.physics_step_s}:
        continuous = min(fitted) <= CONTINUOUS_S
        basis = "in continuous time" if continuous else f"for steps of {1e3 * min(fitted):g} ms"
        notes += (
            f"The servos' numbers are {basis}; another step moves them otherwise by some mrad, "
            "since dry friction holds until the end of a step.",
        )
    if loaded:
        notes += (
            f"{', '.join(loaded)}: fitted under load, so the calibration's own model has frictions "
            "that no simulator's actuator carries; the distance is mostly theirs.",
        )
    return Check(joints=joints, physics_step_s=servos.physics_step_s, notes=notes)


def own_model(joint: JointCalibration) -> DelayedPD | LoadedServo:
    """The servo model of a joint's calibration, in the steps of its fit."""
    actuator = joint.actuator
    if joint.under_load is not None:
        servo = joint.under_load.servo(actuator.dead_time_s.value)
        return LoadedServo(servo, joint.under_load.p_gain, time_step_s=actuator.fitted_step_s)
    return DelayedPD(actuator.parameters, actuator.fitted_step_s)


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


def moved_by(
    model: Any, joints: tuple[str, ...], commands: NDArray, step_s: float
) -> NDArray[np.float64]:
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


def held(commands: NDArray, step_s: float) -> NDArray[np.float64]:
    """Mean of the held commands of a loop over each physics step."""
    edges = LOOP_S * np.arange(len(commands) + 1)
    area = np.append(0.0, np.cumsum(commands) * LOOP_S)
    steps = int(edges[-1] / step_s + 1e-9)
    return np.diff(np.interp(step_s * np.arange(steps + 1), edges, area)) / step_s


def walk_commands() -> NDArray[np.float64]:
    """Commands of one thigh in the sample's walk, from where it begins [rad]."""
    file = resources.files("pupper_sysid.data") / "samples" / "walk_commands.csv"
    with resources.as_file(file) as path:
        rows = np.genfromtxt(path, delimiter=",", names=True)
    time = np.arange(0.0, min(WALK_S, rows["time_s"][-1]), LOOP_S)
    row = np.searchsorted(rows["time_s"], time + 1e-9, side="right") - 1
    return (rows["LF_thigh_command_rad"] - rows["LF_thigh_command_rad"][0])[row]


def unseen_tones() -> NDArray[np.float64]:
    """Commands of the tones, one after the other [rad]."""
    time = np.arange(0.0, TONE_S, LOOP_S)
    return AMPLITUDE_RAD * np.sin(2 * np.pi * np.outer(TONES_HZ, time)).ravel()


def _counts_apart(
    feedback: HeldFeedback, exported: NDArray, at: NDArray, own_at: NDArray, own: NDArray
) -> float:
    """RMS difference of readings in counts: stepped on the export, polled on the calibration."""
    period, quantum = feedback.poll_period_s, feedback.quantum_rad or 2 * np.pi / 4096
    if period <= 0:
        return float(np.sqrt(np.mean((exported - np.interp(at, own_at, own)) ** 2)) / quantum)
    without_loss = HeldFeedback(poll_period_s=period, quantum_rad=quantum)
    without_loss.reset(exported[0], float(at[1] - at[0]), until_poll_s=period / 2)
    there = np.array([without_loss.step(x) for x in exported])
    polls = period / 2 + period * np.arange(int(at[-1] / period) + 1)
    reported = np.round(np.interp(polls, own_at, own) / quantum) * quantum
    here = reported[np.clip(np.searchsorted(polls, at + 1e-12, side="right") - 1, 0, None)]
    late = at > _SETTLE_S
    return float(np.sqrt(np.mean(((there - here)[late] / quantum) ** 2)))
