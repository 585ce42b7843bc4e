"""The one place where a DelayedPD servo becomes MuJoCo's: the same physics, in C.

`servo_models.delayed_pd.DelayedPD` is what is fitted. `joint_attributes` and `actuator_attributes`
give the MJCF with which MuJoCo steps the same servo, so that a calibration is simulated without
change; integrate with `implicitfast`. The time step is chosen here: dry friction is a constraint
that stops the joint within one step, and the delay line holds one value per step. A compiled model
is changed through `write_servos` (other parameters, per environment), `hold` (a command held for
long, delay line included) and `switch_torque`.

`free_air_xml` is the smallest model, hinges without load or gravity. MuJoCo itself is imported only
where a model is stepped or filled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import FRICTION_IMPEDANCE, DelayedPDParameters

Array = NDArray[np.float64]

INTEGRATOR = "implicitfast"
MASSLESS = '<inertial pos="0 0 0" mass="1e-9" diaginertia="1e-15 1e-15 1e-15"/>'
"""Of a body that moves by its joint's armature alone."""
FRICTION_SOLIMP = (FRICTION_IMPEDANCE, FRICTION_IMPEDANCE, 0.001, 0.5, 2.0)
BATCH_FIELDS = (
    "actuator_biasprm", "actuator_dynprm", "actuator_forcerange", "actuator_delay",
    "dof_armature", "dof_frictionloss", "dof_damping",
)  # fmt: skip
"""Model fields that `write_servos` writes; with servos on tendons `TENDON_FIELDS`, too."""
TENDON_FIELDS = ("tendon_armature", "tendon_frictionloss", "tendon_damping")


_ACTUATOR = (
    "gear", "ctrllimited", "ctrlrange", "forcelimited", "forcerange", "actlimited", "actrange",
    "actearly", "actdim", "dyntype", "dynprm", "gaintype", "gainprm", "biastype", "biasprm",
    "armature", "damping", "cranklength", "lengthrange", "inheritrange", "delay", "nsample",
    "interp", "group",
)  # fmt: skip
"""What a file's default class can say of all actuators."""


def forget_actuator_defaults(spec: Any) -> None:
    """Actuators added to a robot's file from here on have nothing of its default class.

    `<motor gear="150"/>` there would be a servo of 150 times the torque.

    `spec`: a `mujoco.MjSpec`.
    """
    from pupper_sysid.sim.robot.engine import mujoco

    fresh = mujoco.MjSpec()
    of_file, of_none = spec.default.actuator, fresh.default.actuator
    for name in _ACTUATOR:
        setattr(of_file, name, getattr(of_none, name))


def friction_solref(time_step_s: float) -> tuple[float, float]:
    """MuJoCo `solreffriction` in its direct form: stop within one time step, no spring.

    MuJoCo divides a direct damping by the impedance, hence the factor.
    """
    return 0.0, -FRICTION_IMPEDANCE / time_step_s


def joint_attributes(parameters: DelayedPDParameters, time_step_s: float) -> dict[str, str]:
    """Attributes of the `<joint>` (or tendon) that one servo turns: inertia, friction, back-EMF."""
    return {
        "armature": numbers(parameters.armature),
        "frictionloss": numbers(parameters.friction_loss),
        "solreffriction": numbers(*friction_solref(time_step_s)),
        "solimpfriction": numbers(*FRICTION_SOLIMP),
    } | ({"damping": numbers(parameters.back_emf)} if np.any(parameters.back_emf) else {})


def actuator_attributes(parameters: DelayedPDParameters, time_step_s: float) -> dict[str, str]:
    """Attributes of the `<pid>` actuator: delay, gains, limits.

    An infinite `effort_limit` or `velocity_limit` leaves its attribute out.
    """
    delay = float(np.asarray(parameters.dead_time_s))
    if not (np.isfinite(delay) and delay >= 0):
        raise InputError(
            f"servo actuator: dead_time_s is {delay}; it must be a number of seconds ≥ 0."
        )
    effort = float(np.asarray(parameters.effort_limit))
    speed = float(np.asarray(parameters.velocity_limit))
    attributes_ = {
        "kp": numbers(parameters.stiffness),
        "kv": numbers(parameters.damping),
        "input": "pos",
        # two more than whole steps: MuJoCo silently truncates a delay beyond its buffer
        "nsample": str(int(delay / time_step_s) + 2),
        "delay": numbers(delay),
        "interp": "linear",
    }
    if np.isfinite(speed):
        attributes_["slewmax"] = numbers(speed)
    if np.isfinite(effort):
        attributes_["forcerange"] = numbers(-effort, effort)
    return attributes_


def pid_element(
    names: Mapping[str, str], parameters: DelayedPDParameters, time_step_s: float
) -> str:
    """The `<pid>` actuator with its `names`: `name`, and `joint` or `tendon`."""
    pid = actuator_attributes(parameters, time_step_s)
    return f"<pid {attributes({**names, **pid})}/>"


def free_air_xml(servos: Sequence[DelayedPDParameters], time_step_s: float) -> str:
    """MJCF of free-air hinges, one per servo, named `joint0`, `joint1`, …, without gravity."""
    bodies, actuators = [], []
    for i, servo in enumerate(servos):
        joint = attributes({"name": f"joint{i}"} | joint_attributes(servo, time_step_s))
        bodies.append(f'<body><joint type="hinge" axis="0 1 0" {joint}/>{MASSLESS}</body>')
        actuators.append(pid_element({"joint": f"joint{i}"}, servo, time_step_s))
    option = (
        f'<option timestep="{numbers(time_step_s)}" integrator="{INTEGRATOR}" gravity="0 0 0"/>'
    )
    return (
        f"<mujoco>{option}<worldbody>{''.join(bodies)}</worldbody>"
        f"<actuator>{''.join(actuators)}</actuator></mujoco>"
    )


def numbers(*values: Any) -> str:
    """As they stand in an attribute, with all digits."""
    return " ".join(repr(float(np.asarray(value))) for value in values)


def attributes(values: Mapping[str, str]) -> str:
    """As they stand in an MJCF element."""
    return " ".join(f'{name}="{value}"' for name, value in values.items())


def for_commands_between_steps(
    parameters: DelayedPDParameters, time_step_s: float, name: str
) -> DelayedPDParameters:
    """The servo for a caller that gives MuJoCo the mean command over the step before.

    That keeps the timing of commands that come between steps, and delays them by one step, which is
    taken off the dead time here.
    """
    delay = float(np.asarray(parameters.dead_time_s))
    if not delay >= 2 * time_step_s:
        raise InputError(
            f"emulated {name}: dead_time_s is {delay}; it must be at least two physics "
            f"steps of {time_step_s} s."
        )
    return replace(parameters, dead_time_s=delay - time_step_s)


# ------------------------------------------------------------------------ a compiled model


def hold(model: Any, data: Any, index: int, position_rad: float) -> None:
    """Set actuator `index` as if it had been commanded to `position_rad` for long.

    A reset zeroes the delay line, which would drive the servo to 0 rad for one dead time.
    """
    from pupper_sysid.sim.robot.engine import mujoco

    data.ctrl[model.actuator_ctrladr[index]] = position_rad
    if model.actuator_actnum[index]:
        data.act[model.actuator_actadr[index]] = position_rad
    line = np.full((int(model.actuator_history[index][0]), 1), float(position_rad))
    mujoco.mj_initCtrlHistory(model, data, index, None, line)


def rest_at(model: Any, data: Any, position_rad: Sequence[float]) -> None:
    """Reset a `free_air_xml` model to rest at `position_rad`, one per servo, commanded for long."""
    from pupper_sysid.sim.robot.engine import mujoco

    mujoco.mj_resetData(model, data)
    data.qpos[:] = position_rad
    for i, position in enumerate(position_rad):
        hold(model, data, i, position)


def switch_torque(model: Any, gains: Array, on: bool, index: int | slice = slice(None)) -> None:
    """Switch servos on, with the `gains` that `actuator_biasprm` had, or limp, without any."""
    model.actuator_biasprm[index] = gains[index] if on else 0.0


def write_servos(
    fields: Mapping[str, Array],
    ids: NDArray[np.intp],
    servos: Mapping[str, Array],
    dof_of: Mapping[int, int],
    tendon_of: Mapping[int, int],
) -> None:
    """Write servos into the expanded fields of a `mujoco.batch.Batch`, for environments `ids`.

    `fields` are `BATCH_FIELDS`, and `TENDON_FIELDS` if a servo turns a tendon; environments first.
    `servos` are arrays of shape (len(ids), servos) by field of `DelayedPDParameters`; `dof_of` and
    `tendon_of` the degree of freedom, or the tendon, that a servo turns.
    """
    fields["actuator_biasprm"][ids, :, 1] = -servos["stiffness"]
    fields["actuator_biasprm"][ids, :, 2] = -servos["damping"]
    fields["actuator_dynprm"][ids, :, 1] = servos["velocity_limit"]
    effort = servos["effort_limit"]
    fields["actuator_forcerange"][ids] = np.stack([-effort, effort], axis=-1)
    fields["actuator_delay"][ids] = servos["dead_time_s"]
    for kind, places in (("dof", dof_of), ("tendon", tendon_of)):
        if places:
            names, at = list(places), list(places.values())
            fields[f"{kind}_armature"][ids[:, None], at] = servos["armature"][:, names]
            fields[f"{kind}_frictionloss"][ids[:, None], at] = servos["friction_loss"][:, names]
            fields[f"{kind}_damping"][ids[:, None], at] = servos["back_emf"][:, names]


def empty_delay_lines(model: Any) -> Array:
    """Delay lines after a command of 0 held for long, shape (actuators, length)."""
    from pupper_sysid.sim.robot.engine import mujoco

    data = mujoco.MjData(model)
    for i in range(model.nu):
        hold(model, data, i, 0.0)
    return data.history.reshape(model.nu, -1).copy()


def delay_lines(empty: Array, position_rad: Array) -> Array:
    """Delay lines after commands held for long, shape (n, actuators · length), for `history`.

    `empty` is from `empty_delay_lines`; `position_rad` has the shape (n, actuators).
    """
    lines = np.repeat(empty[None], len(position_rad), axis=0)
    # a line is two numbers, the times and the values, as many of each
    lines[:, :, -((lines.shape[2] - 2) // 2) :] = position_rad[:, :, None]
    return lines.reshape(len(lines), -1)
