"""A calibration as MJCF: defaults, actuators and sensors to include in a model of MuJoCo ≥ 4.0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from textwrap import wrap
from typing import Any

import numpy as np

from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sim.export.shared import (
    FEEDBACK_KEYS,
    KNOWN,
    TORQUE_KEYS,
    delays_at_step,
    origin,
    step_note,
)
from pupper_sysid.sim.robot.servo_mjcf import INTEGRATOR, attributes, joint_attributes, pid_element


def to_mjcf(calibration: Calibration, physics_step_s: float) -> str:
    """Defaults, actuators and sensors to `<include>` in a model that has joints of these names.

    Parameters
    ----------
    calibration : Calibration
    physics_step_s : float
        Of the model [s].

    Raises
    ------
    InputError
        If the step is not a sensible one.
    """
    delays = delays_at_step(calibration, physics_step_s)
    defaults, actuators, sensors = [], [], []
    for name, joint in calibration.joints.items():
        servo = replace(joint.actuator.parameters, dead_time_s=delays[name].value)
        feedback = joint.feedback
        period, age = feedback.poll_period_s.value, feedback.mean_age_s.value
        defaults += [
            _numbers_comment(name, joint.actuator, (*TORQUE_KEYS, "dead_time_s")),
            f'<default class="servo_{name}">'
            f"<joint {attributes(joint_attributes(servo, physics_step_s))}/></default>",
        ]
        actuators.append(pid_element({"name": name, "joint": name}, servo, physics_step_s))
        sensor = {"name": f"{name}_reading", "joint": name}
        if period > 0:
            # half a period is the sensor's own mean age; what polls are lost adds is a delay
            late = max(age - period / 2, 0.0)
            sensor |= {
                "nsample": str(int(np.ceil(late / period)) + 2),
                "interval": repr(period),
                "delay": repr(late),
            }
        sensors += [
            _numbers_comment(name, feedback, FEEDBACK_KEYS),
            f"<jointpos {attributes(sensor)}/>",
        ]
    notes = (
        *origin(calibration),
        f"For a time step of {physics_step_s:g} s: delay and the dry friction's reference time "
        "depend on it, so export again for another one.",
        *step_note(calibration, delays, physics_step_s),
        "Include this file in your model, and give each servo's joint its class, such as class=\""
        f'servo_{calibration.joint_names[0]}". A position in ctrl is the command of the servo.',
        "After a reset fill the delay lines (mj_initCtrlHistory), which MuJoCo sets to zero: a "
        "robot that is not at zero would be thrown there for one delay.",
        "Carried over: delay (to fractions of a step), gains, limits of torque and of the "
        "set-point's speed, dry friction, armature; of the feedback the poll period and, as a "
        "delay, the mean age that lost polls add.",
        "Not carried over: which polls are lost (the age is even here), the readings' counts and "
        "offset, and that servos are polled one after the other.",
    )
    comment = [line for note in notes for line in (*wrap(_xml(note), 94), "")]
    return "\n".join(
        [
            f'<mujoco model="{_xml(calibration.robot)}: servos">',
            "  <!--", *(f"    {line}".rstrip() for line in comment[:-1]), "  -->",
            f'  <option timestep="{physics_step_s!r}" integrator="{INTEGRATOR}"/>',
            *_group("default", defaults), *_group("actuator", actuators),
            *_group("sensor", sensors), "</mujoco>", "",
        ]
    )  # fmt: skip


def _numbers_comment(name: str, numbers: Any, keys: Sequence[str]) -> str:
    """Numbers with their intervals, and how well they are known, as an XML comment."""
    texts = []
    for key in keys:
        quantity = getattr(numbers, key)
        text = f"{key} {quantity.value:.4g}"
        if quantity.low is not None and quantity.high is not None:
            text += f" ({quantity.low:.4g} to {quantity.high:.4g})"
        texts.append(
            text if quantity.identified == "yes" else f"{text} [{KNOWN[quantity.identified]}]"
        )
    return f"<!-- {_xml(name)}: {_xml(', '.join(texts))} -->"


def _xml(text: str) -> str:
    """Text for a comment or an attribute: two hyphens would end the one, a quote the other."""
    return text.translate(str.maketrans({"<": "‹", ">": "›", "&": "+", '"': "'"})).replace(
        "--", "–"
    )


def _group(name: str, lines: list[str]) -> list[str]:
    return [f"  <{name}>", *(f"    {line}" for line in lines), f"  </{name}>"]
