"""Calibrations for other simulators: one function for every target (`sim.export.targets`).

    paths = export(load_calibration("calibrated.yaml"), "isaaclab", "out/", physics_step_s=0.005)

`exported_text` gives the text of a file without writing it. What each target carries stands in its
own module; JSON, for any other program, is here.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import versions, write_text
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.delayed_pd import whole_steps
from pupper_sysid.sim.export.mjcf import to_model
from pupper_sysid.sim.export.shared import FEEDBACK_KEYS, MUJOCO, TORQUE_KEYS, ExportedServos
from pupper_sysid.sim.export.targets import TARGETS

SCHEMA = "pupper-actuators"
SCHEMA_VERSION = 3


def to_json(servos: ExportedServos) -> str:
    """All of it as JSON: every number with its interval, delays also in steps, the feedback."""
    calibration, stepped = servos.calibration, servos.actuators()
    joints = {}
    for name, joint in calibration.joints.items():
        actuator, f, a = joint.actuator, joint.feedback, stepped[name]
        low, high = whole_steps(*a.dead_time_interval_s, servos.physics_step_s)
        keys = (*TORQUE_KEYS, "velocity_limit_rad_s", "command_jitter_s")
        joints[name] = {
            "operating_point": joint.holds_at.model_dump(mode="json"),
            "link_taken_off_kg_m2": servos.links.get(name, 0.0),
            "actuator": {key: getattr(a, key).model_dump(mode="json") for key in keys}
            | {
                "dead_time_s": actuator.dead_time_s.model_dump(mode="json"),
                "delay_s": a.dead_time_s.value, "delay_steps_min": low, "delay_steps_max": high,
            },
            "feedback": {key: getattr(f, key).model_dump(mode="json") for key in FEEDBACK_KEYS},
            "torque_scale": actuator.scale.model_dump(mode="json"),
        }  # fmt: skip
    return json.dumps(
        {
            "schema": SCHEMA, "schema_version": SCHEMA_VERSION, "robot": calibration.robot,
            "created": calibration.created, "exported_by": versions(),
            "calibration_sha256": servos.sha256,
            "inputs": [f.model_dump(mode="json") for f in calibration.inputs],
            "notes": servos.head(
                MUJOCO,
                "Torques and delay_s are for this step in MuJoCo, dead_time_s is the servo's own; "
                "delays in steps are rounded outward.",
            ),
            "units": calibration.units, "physics_step_s": servos.physics_step_s, "joints": joints,
        },
        indent=1, ensure_ascii=False,
    ) + "\n"  # fmt: skip


def exported_text(
    calibration: Calibration,
    to: str,
    physics_step_s: float | None = None,
    gain: float | None = None,
    link_inertia: Mapping[str, float] | None = None,
    model: Path | None = None,
    out: Path = Path("servos.xml"),
    sha256: str | None = None,
) -> tuple[str, ExportedServos]:
    """Text of an export, and the servos that it holds.

    Parameters are those of `export` and `ExportedServos.of`.
    """
    target = TARGETS.get(to)
    if target is None:
        raise InputError(f"There is no export to {to}; there are {', '.join(TARGETS)}.")
    if model is not None:
        if to != "mjcf":
            raise InputError(f"A model is of the export to mjcf; {to} takes link inertias.")
        return to_model(calibration, model, out, physics_step_s, gain, link_inertia, sha256)
    if link_inertia and (unknown := [n for n in link_inertia if n not in calibration.joints]):
        raise InputError(
            f"`link_inertia` names {', '.join(unknown)}; the calibration has "
            f"{', '.join(calibration.joint_names)}."
        )
    step_s = target.physics_step_s if physics_step_s is None else physics_step_s
    servos = ExportedServos.of(calibration, step_s, gain, link_inertia, sha256)
    return target.text(servos), servos


def export(
    calibration: Calibration | Any,
    to: str,
    out: Path | str = ".",
    *,
    physics_step_s: float | None = None,
    gain: float | None = None,
    link_inertia: Mapping[str, float] | None = None,
    model: Path | str | None = None,
    force: bool = False,
) -> Path:
    """Write a calibration for another simulator.

    Parameters
    ----------
    calibration : Calibration, Path or str
        Also what `calibrate` returns, the name of a preset or servo card, or the file of one.
    to : str
        "mjcf", "isaaclab", "isaaclab-bam", "mjlab", "newton" or "json" (`sim.export.targets`).
    out : Path or str
        File, or a folder, in which the file is called `servos` with the target's ending.
    physics_step_s : float, optional
        Of that simulator [s]; by default 0.002 for mjcf, or its model's, and 0.005 for the others.
    gain : float, optional
        P gain, the register's value; by default that at which the calibration holds.
    link_inertia : dict of str to float, optional
        By joint, the inertia of link and load to take off an armature that holds it [kg·m²].
    model : Path or str, optional
        MJCF of the robot, to write a whole model with these servos; it also gives the inertia of
        the links.
    force : bool
        Replace the file if it exists.

    Returns
    -------
    Path
        The file that was written.
    """
    if isinstance(calibration, Path | str):
        calibration = load_calibration(calibration)
    calibration = getattr(calibration, "calibration", calibration)  # of a result
    if not isinstance(calibration, Calibration):
        raise InputError(
            f"A calibration is needed, not a {type(calibration).__name__}. Make one with "
            "pupper_sysid.calibrate(recording) or pupper_sysid.load_calibration(path)."
        )
    path = Path(out)
    if not path.suffix or path.is_dir():
        path = path / f"servos{TARGETS[to].ending if to in TARGETS else ''}"
    source = None if model is None else Path(model)
    text, _ = exported_text(calibration, to, physics_step_s, gain, link_inertia, source, path)
    write_text(path, text, force)
    return path
