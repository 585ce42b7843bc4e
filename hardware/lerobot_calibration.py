"""LeRobot's calibration of an arm, in and out: `{"shoulder_pan": {"id": 1, "drive_mode": 0, …}}`.

LeRobot homes an arm in the middle of its range: it writes into each servo's register homing_offset
what makes the position there the encoder's centre, and keeps offset, range and direction in a JSON
file. The counts of its ranges are therefore those that a servo reports with that offset, and a
joint map made from it holds only while the register has it; a bus with another value is refused.

A `drive_mode` of 1 turns the direction around. With Feetech servos LeRobot does that itself; with
Dynamixel the servo does, by its own register, so that counts keep their direction.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pupper_sysid.common.border import read_json, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import write_text
from pupper_sysid.hardware.joint_map import JointMap

_FARTHEST_OFFSET = 1_044_479  # of a Dynamixel's register; Feetech's goes to 2047
_FARTHEST_COUNT = 1_048_575


class LeRobotJoint(BaseModel):
    """One joint of LeRobot's file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    id: int = Field(ge=0, le=253)
    """Servo id on its bus."""
    drive_mode: Literal[0, 1]
    """1: the joint turns against the counts."""
    homing_offset: int = Field(ge=-_FARTHEST_OFFSET, le=_FARTHEST_OFFSET)
    """Value of the servo's register [counts]."""
    range_min: int = Field(ge=-_FARTHEST_COUNT, le=_FARTHEST_COUNT)
    """Lowest count of the joint's range."""
    range_max: int = Field(ge=-_FARTHEST_COUNT, le=_FARTHEST_COUNT)
    """Highest count of the joint's range."""

    @model_validator(mode="after")
    def _range_rises(self) -> LeRobotJoint:
        if self.range_min >= self.range_max:
            raise ValueError(
                f"range_min is {self.range_min} and range_max {self.range_max}: the joint was not "
                "moved through its range. Calibrate it again in LeRobot"
            )
        return self


def read_lerobot(path: Path) -> dict[str, LeRobotJoint]:
    """LeRobot's calibration by joint."""
    data = read_json(path)
    fields = set(LeRobotJoint.model_fields)
    if not isinstance(data, dict) or not data:
        raise InputError(f"{path} is no calibration of LeRobot: it must map joints to entries.")
    joints = {}
    for name, entry in data.items():
        if not isinstance(entry, dict) or not fields & set(entry):
            wanted = ", ".join(sorted(fields))
            raise InputError(f"{path} is no calibration of LeRobot: {name} must have {wanted}.")
        joints[name] = validated(LeRobotJoint, entry, f"{path}, {name}")
    ids = [joint.id for joint in joints.values()]
    if len(set(ids)) < len(ids):
        raise InputError(f"{path}: two joints have the same id ({sorted(ids)}).")
    return joints


def apply_lerobot(data: dict[str, Any], joints: Mapping[str, LeRobotJoint], path: Path) -> None:
    """Put ids, directions, homing offsets and ranges into the data of a joint map, in place."""
    entries, top = data["joints"], data["counts"] - 1
    missing = [name for name in entries if name not in joints]
    if missing:
        raise InputError(
            f"{path} has the joints {', '.join(entries)}, and LeRobot's calibration "
            f"{', '.join(joints)}: {', '.join(missing)} has no entry. Rename one of them."
        )
    software = data["servo"].startswith(("STS", "SCS", "HD"))
    for name, entry in entries.items():
        joint = joints[name]
        low, high = joint.range_min, joint.range_max
        if low < 0 or high > top:
            raise InputError(
                f"LeRobot's calibration: the range of {name} is {low} to {high}, beyond the "
                f"encoder's 0 to {top}. Calibrate it again with its horn nearer to the middle."
            )
        entry |= {
            "id": joint.id,
            "sign": -1 if joint.drive_mode and software else 1,
            "limits_counts": [low, high],
            "homing_offset": joint.homing_offset,
            "source": "LeRobot's calibration: id, direction, homing offset and range; limits_rad "
            "of the model; the zero is the pose in which LeRobot homed it",
        }
    data["source"] += "; ids, directions, offsets and ranges of LeRobot's calibration"


def lerobot_calibration(
    joint_map: JointMap, homing_offsets: Mapping[str, int]
) -> dict[str, dict[str, int]]:
    """Entries of LeRobot's file for a joint map.

    Parameters
    ----------
    joint_map : JointMap
    homing_offsets : mapping of str to int
        Of the servos' registers, by joint; those of servos without one are 0.
    """
    software = not (joint_map.file.servo or "STS").startswith(("X", "MX"))
    entries = {}
    for name in joint_map.joint_names:
        entry = joint_map.file.joints[name]
        offset = homing_offsets.get(name)
        kept = entry.homing_offset if offset is None else offset
        entries[name] = {
            "id": entry.id,
            "drive_mode": int(entry.sign < 0) if software else 0,
            "homing_offset": kept or 0,
            "range_min": entry.limits_counts[0],
            "range_max": entry.limits_counts[1],
        }
    return entries


def write_lerobot(
    path: Path, joint_map: JointMap, homing_offsets: Mapping[str, int], force: bool = False
) -> None:
    """Write LeRobot's calibration of a joint map."""
    entries = lerobot_calibration(joint_map, homing_offsets)
    write_text(path, json.dumps(entries, indent=4) + "\n", force)
