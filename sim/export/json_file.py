"""A calibration as JSON for any program: numbers with intervals, delays in steps, the feedback."""

from __future__ import annotations

import json

from pupper_sysid.common.files import versions
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.delayed_pd import whole_steps
from pupper_sysid.sim.export.shared import (
    FEEDBACK_KEYS,
    TORQUE_KEYS,
    delays_at_step,
    operating_points,
    step_note,
)

SCHEMA = "pupper-actuators"
SCHEMA_VERSION = 2


def to_json(calibration: Calibration, physics_step_s: float) -> str:
    """All of it as JSON: every number with its interval, delays also in steps, the feedback.

    Raises
    ------
    InputError
        If the step is not a sensible one.
    """
    delays = delays_at_step(calibration, physics_step_s)
    joints = {}
    for name, joint in calibration.joints.items():
        a, f = joint.actuator, joint.feedback
        low, high = whole_steps(delays[name].low, delays[name].high, physics_step_s)
        keys = (*TORQUE_KEYS, "velocity_limit_rad_s", "dead_time_s")
        joints[name] = {
            "operating_point": joint.holds_at.model_dump(mode="json"),
            "actuator": {key: getattr(a, key).model_dump(mode="json") for key in keys}
            | {"delay_steps_min": low, "delay_steps_max": high},
            "feedback": {key: getattr(f, key).model_dump(mode="json") for key in FEEDBACK_KEYS},
            "torque_scale": a.scale.model_dump(mode="json"),
        }
    return json.dumps(
        {
            "schema": SCHEMA, "schema_version": SCHEMA_VERSION, "robot": calibration.robot,
            "created": calibration.created, "exported_by": versions(),
            "inputs": [f.model_dump(mode="json") for f in calibration.inputs],
            "notes": [
                *calibration.notes, *operating_points(calibration),
                "Delays in steps are rounded outward.",
                *step_note(calibration, delays, physics_step_s),
            ],
            "units": calibration.units, "physics_step_s": physics_step_s, "joints": joints,
        },
        indent=1, ensure_ascii=False,
    ) + "\n"  # fmt: skip
