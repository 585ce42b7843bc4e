"""Joint map of a robot from readings of its servos while it is moved by hand.

    travel = Travel(joints=12, counts=1024)          # one `add` per reading
    new = calibrated(start, Measured(offsets, limits), "2026-11-21")

Three things are measured, all in counts: the *offset* of a servo's horn (count of the middle pose
less the centre of the encoder), the *limits* (ends of a joint's travel, less a margin) and the
*scale* (counts per radian), which is checked by moving one joint through a known angle. Published
sources disagree on the scale, so limits stay in counts whatever it is.

LeRobot's calibration of an arm, `{"shoulder_pan": {"id": 1, "drive_mode": 0, …}}`, is read and
written, too. LeRobot homes an arm in the middle of its range: it writes into each servo's register
homing_offset what makes the position there the encoder's centre, and keeps offset, range and
direction in a JSON file. The counts of its ranges are therefore those that a servo reports with
that offset, and a joint map made from it holds only while the register has it; a bus with another
value is refused.

A `drive_mode` of 1 turns the direction around. With Feetech servos LeRobot does that itself; with
Dynamixel the servo does, by its own register, so that counts keep their direction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pupper_sysid.common.border import Part, read_json, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.joint_map import FARTHEST_OFFSET, JointMap, JointMapFile, joint_map_from

MARGIN = 0.02
"""Distance of the limits from each end, as a fraction of the travel."""
SMALLEST_TRAVEL = 40 / 1024
"""Least travel that counts as the whole range, as a fraction of the encoder's range."""
SCALE_AGREES = 0.03
"""Relative accuracy of a scale measured by hand: 2 degrees of 90 are 2.2 %."""
STILL = 8 / 1024
"""Largest motion of a held joint while it is measured, as a fraction of the encoder's range."""

_SILENT_AFTER = 25  # readings: half a second of the command's
_FAR_OFFSET_DEG = 30.0
_WHOLE_RANGE_DEG = (150.0, 400.0)  # no servo of this kind has less or more
_KNOWN_SCALES = {
    1024: {
        "550/pi, the vendor's library": 550 / np.pi,
        "1024/pi, measured by hand on a Mini Pupper 2 (its issue 65)": 1024 / np.pi,
        "1024 counts over 300 degrees, the SCS0009's data sheet": 1024 / np.radians(300),
    },
    4096: {"4096 counts over 360 degrees, the STS3215's data sheet": 4096 / (2 * np.pi)},
}
_SIDES = {
    "hip": ("foot to the robot's left", "foot to the robot's right"),
    "thigh": ("knee behind the hip", "knee ahead of the hip"),
    "calf": ("foot behind the knee", "foot ahead of the knee"),
}
_MARK = " Calibrated by calibrate-joints"


class Travel:
    """Lowest and highest counts seen so far, `low` and `high`, -1 where nothing has been read.

    An extreme counts once two successive readings have been there: the checksum of a serial frame
    lets one garbled frame in 256 by, and a joint at the end of its travel stands still anyway.
    `wrapped` joints jumped from one end of the encoder to the other; `silent` ones have stopped
    answering.

    Examples
    --------
    >>> travel = Travel(1, 1024)
    >>> for count in (500, 300, 300, 700, 710, 40, 600):  # 40 is a garbled reading
    ...     travel.add(np.array([count]))
    >>> travel.low.tolist(), travel.high.tolist()
    ([300], [700])
    """

    def __init__(self, joints: int, counts: int):
        self.counts = counts
        self.now, self._before = np.full(joints, -1), np.full(joints, -1)
        self.low, self.high = np.full(joints, -1), np.full(joints, -1)
        self.wrapped = np.zeros(joints, bool)
        self._missing = np.zeros(joints, int)

    @property
    def silent(self) -> NDArray[np.bool_]:
        """Joints whose last readings are all missing."""
        return self._missing >= _SILENT_AFTER

    def add(self, count: NDArray[np.int64]) -> None:
        """Add one reading, shape (joints,); -1 where there is none."""
        answered = count >= 0
        self._missing = np.where(answered, 0, self._missing + 1)
        sure = answered & (self.now >= 0)
        lower, higher = np.maximum(count, self.now), np.minimum(count, self.now)
        self.low = np.where(
            sure, np.where(self.low < 0, lower, np.minimum(self.low, lower)), self.low
        )
        self.high = np.where(sure, np.maximum(self.high, higher), self.high)
        half = self.counts / 2
        stayed = (np.abs(count - self._before) > half) & (np.abs(self.now - self._before) > half)
        self.wrapped |= sure & (self._before >= 0) & stayed
        self._before = np.where(answered, self.now, self._before)
        self.now = np.where(answered, count, self.now)

    def forget(self, joint: int) -> None:
        """Reset one joint."""
        self.low[joint] = self.high[joint] = self._before[joint] = -1
        self.wrapped[joint] = False

    def limits(self, joint: int) -> tuple[int, int]:
        """Limits of one joint that keep `MARGIN` of its travel to both of its ends."""
        low, high = int(self.low[joint]), int(self.high[joint])
        margin = MARGIN * (high - low)
        return int(np.ceil(low + margin)), int(np.floor(high - margin))

    def refusals(self, names: tuple[str, ...]) -> dict[str, str]:
        """Reasons by joint why its travel does not show its limits."""
        least = SMALLEST_TRAVEL * self.counts
        why: dict[str, str] = {}
        for k, name in enumerate(names):
            low, high = int(self.low[k]), int(self.high[k])
            if low < 0:
                why[name] = "did not answer"
            elif self.silent[k]:
                why[name] = "does not answer any more; check its cable and power"
            elif self.wrapped[k]:
                why[name] = (
                    f"went over the end of its encoder (0 and {self.counts - 1} are neighbours "
                    "there); its horn must be mounted nearer to the middle"
                )
            elif low == high:
                why[name] = f"did not move from count {low}"
            elif high - low < least:
                why[name] = f"moved by {high - low} counts only; {least:.0f} are the least"
        return why

    def cut_off(self, names: tuple[str, ...]) -> list[str]:
        """Joints whose travel reached an end of the encoder before its mechanical end."""
        at_end = (self.low == 0) | (self.high >= self.counts - 1)
        return [name for name, cut in zip(names, at_end, strict=True) if cut]


def middle_pose_in_words(file: JointMapFile, joints: tuple[str, ...]) -> str:
    """The pose in which the servos of `joints` stand at their neutral.

    A line per kind of joint of the Mini Pupper; another robot's joints one by one, by their angle.
    """
    degrees = {n: round(np.degrees(file.joints[n].neutral_rad)) for n in joints}
    lines = [f"  {n}: {d} degrees" for n, d in degrees.items() if n not in JOINT_NAMES]
    if lines:
        lines.append("Angles are those of the robot's model: its MJCF or URDF says where zero is.")
    for kind, (positive, negative) in _SIDES.items():
        mine = {n: d for n, d in degrees.items() if n in JOINT_NAMES and n.endswith(kind)}
        for angle in sorted(set(mine.values())):
            same = [n for n, d in mine.items() if d == angle]
            which = f"every {kind}" if len(same) == len(mine) else ", ".join(same)
            side = positive if angle > 0 else negative
            serial_calf = kind == "calf" and file.linkage == "none"
            zero = "in line with its thigh" if serial_calf else "straight down"
            how = f"{abs(angle)} degrees from {zero}, {side}" if angle else zero
            lines.append(f"  {which}: {how}")
    if file.linkage != "none" and {45, -45} <= set(degrees.values()):
        lines.append("The knees are at a right angle then, the feet below the hips.")
    lines.append("Every servo's horn is then in the middle of its range.")
    return "\n".join(lines)


def mean_counts(readings: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean count of held joints, NaN without a reading, and by how far they moved meanwhile.

    `readings` have the shape (readings, joints), -1 where one is missing.
    """
    known = np.where(readings < 0, np.nan, readings.astype(float))
    mean, strayed = np.full((2, readings.shape[1]), np.nan)
    read = np.isfinite(known).any(axis=0)
    mean[read] = np.nanmean(known[:, read], axis=0)
    strayed[read] = np.nanmax(known[:, read], axis=0) - np.nanmin(known[:, read], axis=0)
    return mean, strayed


def scales_agree(measured: float, stated: float) -> bool:
    """Whether a scale measured by hand agrees with the stated one."""
    return abs(measured / stated - 1) <= SCALE_AGREES


def is_plausible_scale(measured: float, counts: int) -> bool:
    """Whether the encoder's whole range would be an angle that hobby servos have."""
    low, high = _WHOLE_RANGE_DEG
    return low <= np.degrees(counts / measured) <= high if measured > 0 else False


def known_scale_near(measured: float, counts: int) -> str | None:
    """The published scale nearest to a measured one, in words; None if none agrees."""
    near = {
        name: abs(measured / scale - 1)
        for name, scale in _KNOWN_SCALES[counts].items()
        if scales_agree(measured, scale)
    }
    return min(near, key=lambda name: near[name]) if near else None


@dataclass(frozen=True)
class Measured:
    """Result of a calibration by hand."""

    offset_counts: Mapping[str, int]
    """For all calibrated joints."""
    limits_counts: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """For joints moved through their range; the others keep the starting map's, shifted."""
    scale_joint: str | None = None
    """Joint on which the scale was measured."""
    counts_per_rad: float | None = None
    """Scale measured there."""
    use_scale: bool = False
    """Use the measured scale for all joints; else each keeps that of the starting map."""


def calibrated(start: JointMapFile, measured: Measured, date: str) -> JointMap:
    """The starting map with the measured values; `limits_rad`, signs and ids stay."""
    data = start.model_dump(by_alias=True)
    data["name"] = f"{start.name.partition(', calibrated ')[0]}, calibrated {date}"
    data["source"] = f"{start.source.partition(_MARK)[0].rstrip('. ')}.{_MARK} {date}."
    for joint, entry in data["joints"].items():
        origin: list[str] = []
        if joint in measured.offset_counts:
            origin = _place(entry, joint, start, measured)
        if measured.scale_joint and measured.counts_per_rad:
            on = f"measured on {measured.scale_joint}"
            if measured.use_scale:
                entry["counts_per_rad"] = float(measured.counts_per_rad)
                origin.append(f"counts_per_rad {on}")
            elif origin:
                origin.append(
                    f"counts_per_rad of {start.name} ({on}: {measured.counts_per_rad:.1f})"
                )
        if joint in measured.offset_counts:
            entry["source"] = f"calibrate-joints {date}, {', '.join(origin)}"
        elif origin:
            before = entry["source"].partition("; calibrate-joints ")[0]
            entry["source"] = f"{before}; calibrate-joints {date}, {', '.join(origin)}"
    return joint_map_from(data, "the new joint map")


def doubts(new: JointMap, joints: Mapping[str, int]) -> list[str]:
    """Warnings about the offsets and limits of `joints`, as sentences."""
    sentences, far = [], []
    file = new.file
    for joint in new.joint_names:
        if joint not in joints:
            continue
        entry = file.joints[joint]
        zero = file.counts // 2 + entry.offset_counts
        degrees = abs(float(np.degrees(entry.offset_counts / entry.counts_per_rad)))
        low, high = entry.limits_counts
        if degrees > _FAR_OFFSET_DEG:
            far.append(f"{joint} {entry.offset_counts:+d} ({degrees:.0f}°)")
        if not low <= zero <= high:
            sentences.append(
                f"{joint}: its middle (count {zero}) lies outside its limits {low} to {high}. "
                "Either the pose was not the middle one or it was not moved through its range."
            )
    if far:
        sentences.append(
            f"{', '.join(far)}: that many counts lie between the middle pose and the encoder's "
            "centre. The horn sits teeth away from where it should, or the pose was not the "
            "middle one."
        )
    return sentences


def _place(entry: dict, joint: str, start: JointMapFile, measured: Measured) -> list[str]:
    """Set offset and limits of one entry; their origin in words."""
    shift = measured.offset_counts[joint] - entry["offset_counts"]
    entry["offset_counts"] = measured.offset_counts[joint]
    if joint in measured.limits_counts:
        entry["limits_counts"] = measured.limits_counts[joint]
        return ["offset measured", "limits measured"]
    # the leg's ends keep their distance from the middle pose
    low, high = entry["limits_counts"]
    entry["limits_counts"] = (max(low + shift, 0), min(high + shift, start.counts - 1))
    if entry["limits_counts"][0] >= entry["limits_counts"][1]:
        raise InputError(
            f"{joint}: with its middle at count {start.counts // 2 + entry['offset_counts']} the "
            f"limits of {start.name} leave the encoder. Mount its horn nearer to the middle, or "
            "move it through its range so that its limits are measured."
        )
    return ["offset measured", f"limits of {start.name}, moved by the offset"]


_FARTHEST_COUNT = 1_048_575


class LeRobotJoint(Part):
    """One joint of LeRobot's file."""

    id: int = Field(ge=0, le=253)
    """Servo id on its bus."""
    drive_mode: Literal[0, 1]
    """1: the joint turns against the counts."""
    homing_offset: Annotated[int, FARTHEST_OFFSET]
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
    if "motor_names" in data:
        raise InputError(
            f"{path} is of an older LeRobot, whose zeros were not in the servos. Calibrate the arm "
            "again with `lerobot-calibrate`."
        )
    joints = {}
    for name, entry in data.items():
        if not isinstance(entry, dict) or not fields & set(entry):
            expected = ", ".join(sorted(fields))
            raise InputError(f"{path} is no calibration of LeRobot: {name} must have {expected}.")
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
    software = _reversed_by_software(data["servo"])
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


def _reversed_by_software(servo: str | None) -> bool:
    """Whether LeRobot itself turns a drive mode of 1 around, and not the servo."""
    return not (servo or "STS").startswith(("X", "2X", "MX"))


def lerobot_calibration(
    joint_map: JointMap, homing_offsets: Mapping[str, int]
) -> dict[str, dict[str, int]]:
    """Entries of LeRobot's file for a joint map.

    `homing_offsets` are those of the servos' registers, by joint; of servos without one they are 0.
    """
    software = _reversed_by_software(joint_map.file.servo)
    entries = {}
    for name in joint_map.joint_names:
        entry = joint_map.file.joints[name]
        offset = homing_offsets.get(name)
        homing_offset = entry.homing_offset if offset is None else offset
        entries[name] = {
            "id": entry.id,
            "drive_mode": int(entry.sign < 0) if software else 0,
            "homing_offset": homing_offset or 0,
            "range_min": entry.limits_counts[0],
            "range_max": entry.limits_counts[1],
        }
    return entries
