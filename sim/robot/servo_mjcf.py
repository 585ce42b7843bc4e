"""MuJoCo's native actuator and joint for a DelayedPD servo: the same physics, in C.

`servo_models.DelayedPD` is what is fitted; this module writes the attributes with which MuJoCo
steps the same servo, so that a fitted calibration can be simulated without change. The time step
must be chosen here, because dry friction is a constraint that stops the joint within one step and
because the delay line holds one value per step. Integrate with `implicitfast`.

`joint_attributes` and `actuator_attributes` are for any model; `free_air_xml` is the smallest one,
hinges without load or gravity; `rest_at` fills the delay lines, which MuJoCo zeroes on reset.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import (
    FRICTION_SOLIMP,
    DelayedPDParameters,
    friction_solref,
)

# imported by name: type checkers cannot see into the compiled module
mujoco: Any = import_module("mujoco")

INTEGRATOR = "implicitfast"


def joint_attributes(parameters: DelayedPDParameters, time_step_s: float) -> dict[str, str]:
    """Attributes of the `<joint>` that the servo turns: inertia and dry friction.

    Parameters
    ----------
    parameters : DelayedPDParameters
        Of one servo (scalars).
    time_step_s : float
        Physics step of the model [s].
    """
    # MuJoCo divides a direct damping by the impedance
    solref = friction_solref(time_step_s)
    return {
        "armature": _number(parameters.armature),
        "frictionloss": _number(parameters.friction_loss),
        "solreffriction": " ".join(_number(x) for x in solref),
        "solimpfriction": " ".join(_number(x) for x in FRICTION_SOLIMP),
    }


def actuator_attributes(parameters: DelayedPDParameters, time_step_s: float) -> dict[str, str]:
    """Attributes of the `<pid>` actuator: delay, gains, limits.

    An infinite `effort_limit` or `velocity_limit` leaves its attribute out.

    Raises
    ------
    InputError
        If the delay is negative or not finite.
    """
    delay = float(np.asarray(parameters.dead_time_s))
    if not (np.isfinite(delay) and delay >= 0):
        raise InputError(
            f"servo actuator: dead_time_s is {delay}; it must be a number of seconds ≥ 0."
        )
    effort = float(np.asarray(parameters.effort_limit))
    speed = float(np.asarray(parameters.velocity_limit))
    attributes = {
        "kp": _number(parameters.stiffness),
        "kv": _number(parameters.damping),
        "input": "pos",
        # two more than whole steps: MuJoCo truncates a delay beyond its buffer without a word
        "nsample": str(int(delay / time_step_s) + 2),
        "delay": _number(delay),
        "interp": "linear",
    }
    if np.isfinite(speed):
        attributes["slewmax"] = _number(speed)
    if np.isfinite(effort):
        attributes["forcerange"] = f"{_number(-effort)} {_number(effort)}"
    return attributes


def free_air_xml(servos: Sequence[DelayedPDParameters], time_step_s: float) -> str:
    """MJCF of free-air hinges, one per servo, named `joint0`, `joint1`, …, without gravity."""
    bodies, actuators = [], []
    for i, servo in enumerate(servos):
        joint = attributes({"name": f"joint{i}"} | joint_attributes(servo, time_step_s))
        pid = attributes({"joint": f"joint{i}"} | actuator_attributes(servo, time_step_s))
        bodies.append(
            f'<body><joint type="hinge" axis="0 1 0" {joint}/>'
            '<inertial pos="0 0 0" mass="1e-9" diaginertia="1e-15 1e-15 1e-15"/></body>'
        )
        actuators.append(f"<pid {pid}/>")
    option = (
        f'<option timestep="{_number(time_step_s)}" integrator="{INTEGRATOR}" gravity="0 0 0"/>'
    )
    return (
        f"<mujoco>{option}<worldbody>{''.join(bodies)}</worldbody>"
        f"<actuator>{''.join(actuators)}</actuator></mujoco>"
    )


def rest_at(model: Any, data: Any, position_rad: Sequence[float]) -> None:
    """Rest every servo of a `free_air_xml` model at `position_rad`, commanded there for ever.

    Parameters
    ----------
    model, data : mujoco.MjModel, mujoco.MjData
    position_rad : sequence of float
        One per servo.
    """
    mujoco.mj_resetData(model, data)
    for i, position in enumerate(position_rad):
        data.qpos[i] = data.ctrl[i] = position
        if model.actuator_actnum[i]:
            data.act[model.actuator_actadr[i]] = position
        # a reset zeroes the delay line, which would drive the servo to 0 rad for one delay
        count = int(model.actuator_history[i][0])
        mujoco.mj_initCtrlHistory(model, data, i, None, np.full((count, 1), float(position)))


def _number(value) -> str:
    return repr(float(np.asarray(value)))


def attributes(values: dict[str, str]) -> str:
    """As they stand in an MJCF element."""
    return " ".join(f'{name}="{value}"' for name, value in values.items())
