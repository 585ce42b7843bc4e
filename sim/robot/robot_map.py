"""A joint map for any robot with hobby servos, from its MJCF (or URDF).

    joint_map, left_out = joint_map_of(Path("arm.xml"), "sts3215")

Each hinge that an actuator drives, by itself or through a tendon, becomes a joint with a servo;
in a model without actuators, each hinge. Three things are guesses: ids run from 1 in the file's
order, a servo's centre is at the joint's zero (or in the middle of its range, if zero is outside),
and counts grow with the joint's angle. `pupper-sysid calibrate-joints` measures the centres; ids
and signs are checked in `pupper-sysid monitor` while a joint is moved by hand.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import strange_joint
from pupper_sysid.hardware.joint_map import SCHEMA, SCHEMA_VERSION, JointMap, joint_map_from
from pupper_sysid.sim.robot.engine import mujoco

SERVOS = {"sts3215": (4096, 2 * np.pi), "scs0009": (1024, np.radians(300))}
"""Counts of the encoder, and the angle that they span [rad]."""

_MARGIN_COUNTS = 20  # servos clip goals near the ends of their range
_LARGEST_BYTES = 50_000_000
_MOST_SERVOS = 253


def joint_map_of(path: Path, servo: str) -> tuple[JointMap, list[str]]:
    """Joint map of the robot described in `path`, and the hinges that no actuator drives.

    Parameters
    ----------
    path : Path
        MJCF or URDF.
    servo : {"sts3215", "scs0009"}
        Type of all servos.

    Raises
    ------
    InputError
        If MuJoCo cannot read the file, or it has no hinge that a servo turns.
    """
    model = _model(path)
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    if not hinges:
        raise InputError(f"{path} has no hinge joint: there is nothing for a servo to turn.")
    driven = _driven(model) if model.nu else set(hinges)
    joints = [j for j in hinges if j in driven]
    left_out = [model.joint(j).name or "one without a name" for j in hinges if j not in driven]
    if not joints:
        raise InputError(
            f"{path}: its actuators drive none of its hinges ({', '.join(left_out)}). Give each "
            "hinge that has a servo an actuator there, or take all actuators out to use every one."
        )
    if len(joints) > _MOST_SERVOS:
        raise InputError(f"{path} has {len(joints)} hinges; a bus has at most {_MOST_SERVOS} ids.")
    names = [model.joint(j).name for j in joints]
    if strange := strange_joint(names):
        name = strange[0] or "without a name"
        raise InputError(f"{path}: a joint is called '{name}'; {strange[1]} Rename it there.")
    counts, span = SERVOS[servo]
    data = {
        "schema": SCHEMA, "schema_version": SCHEMA_VERSION, "name": path.stem, "frame": "raw",
        "counts": counts, "linkage": "none",
        "source": f"made from {path.name} for {servo} servos; ids, centres and signs are guesses",
        "joints": {
            name: _entry(model, j, k + 1, counts, counts / span)
            for k, (j, name) in enumerate(zip(joints, names, strict=True))
        },
    }  # fmt: skip
    return joint_map_from(data, str(path)), left_out


def _driven(model) -> set[int]:
    """Joints that an actuator drives."""
    found: set[int] = set()
    trn = mujoco.mjtTrn
    for kind, (target, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        if kind == trn.mjTRN_JOINT or kind == trn.mjTRN_JOINTINPARENT:
            found.add(int(target))
        elif kind == trn.mjTRN_TENDON:
            first = model.tendon_adr[target]
            for wrap in range(first, first + model.tendon_num[target]):
                if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT:
                    found.add(int(model.wrap_objid[wrap]))
    return found


def _model(path: Path):
    if not path.is_file():
        raise InputError(f"{path} is no file. Give your robot's MJCF or URDF.")
    if path.stat().st_size > _LARGEST_BYTES:
        raise InputError(f"{path} has more than {_LARGEST_BYTES / 1e6:.0f} MB: no robot's MJCF.")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path} cannot be read as a robot: {reason}. Give an MJCF or URDF that MuJoCo's "
            "viewer opens, with its meshes beside it."
        ) from None


def _entry(model, joint: int, servo_id: int, counts: int, per_rad: float) -> dict:
    reach = (counts / 2 - _MARGIN_COUNTS) / per_rad
    low, high = -reach, reach
    if model.jnt_limited[joint]:
        low, high = map(float, model.jnt_range[joint])
    neutral = 0.0 if low < 0 < high else (low + high) / 2
    low, high = max(low, neutral - reach), min(high, neutral + reach)
    return {
        "id": servo_id, "sign": 1, "neutral_rad": neutral, "counts_per_rad": per_rad,
        "offset_counts": 0,
        "limits_counts": [
            int(np.ceil(counts / 2 + per_rad * (low - neutral))),
            int(np.floor(counts / 2 + per_rad * (high - neutral))),
        ],
        "limits_rad": [low, high],
        "source": "limits of the model; the rest is a guess",
    }  # fmt: skip
