"""A joint map for any robot with hobby servos, from its MJCF (or URDF).

    robot = joint_map_of(Path("arm.xml"), "sts3215")      # robot.joint_map, robot.left_out
    robot = joint_map_of_servos({"pan": 1, "tilt": 2}, "xl330-m288")       # without a model

Each hinge that an actuator drives, by itself or through a tendon, becomes a joint with a servo; in
a model without actuators, each hinge that does not follow another one (URDF `mimic`, MJCF
equality). Three things are guesses: ids run from 1 in the file's order, a servo's centre is at the
joint's zero (or in the middle of its range, if zero is outside), and counts grow with the joint's
angle. `pupper-sysid calibrate-joints` measures the centres; ids and signs are checked in
`pupper-sysid monitor` while a joint is moved by hand.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import strange_joint
from pupper_sysid.hardware import dynamixel, feetech
from pupper_sysid.hardware.joint_calibration import LeRobotJoint, apply_lerobot
from pupper_sysid.hardware.joint_map import SCHEMA, SCHEMA_VERSION, JointMap, joint_map_from
from pupper_sysid.sim.robot.hinges import Hinge, hinges_of

FAMILIES = {
    series.name.lower(): family
    for family in (feetech.FAMILY, dynamixel.FAMILY)
    for series in (*family.series.values(), *family.profiles.values())
} | dict.fromkeys(("sts", "hls", "scs"), feetech.FAMILY)
"""Vendor's family by type of servo; `sts`, `hls` and `scs` are servos without another name here."""
_SCS_COUNTS, _SCS_RAD = 1024, np.radians(300)

_MARGIN_COUNTS = 20  # servos clip goals near the ends of their range
_MOST_SERVOS = 253
_FARTHEST_RAD = 4 * np.pi
"""Two turns: a limit beyond is in degrees."""
_UNKNOWN_RAD = 0.5


@dataclass(frozen=True)
class RobotMap:
    """What a model file says of a robot's servos."""

    joint_map: JointMap
    left_out: list[str]
    """Hinges that no actuator drives and that follow no other."""
    following: dict[str, str]
    """Hinges without a servo of their own, and the joint that each follows."""
    doubts: list[str]
    """Sentences about limits that are probably not meant."""


def joint_map_of(
    path: Path, servo: str, lerobot: Mapping[str, LeRobotJoint] | None = None
) -> RobotMap:
    """Joint map of the robot described in `path`, and what was left out of it.

    It is a MJCF or URDF; all servos are of one type of `FAMILIES`. With LeRobot's calibration of an
    arm its ids, directions and ranges are taken.
    """
    hinges = hinges_of(path)
    if not hinges:
        raise InputError(f"{path} has no hinge joint: there is nothing for a servo to turn.")
    joints = [hinge for hinge in hinges if hinge.driven]
    following = {h.name: h.follows for h in hinges if h.follows and not h.driven}
    left_out = [
        hinge.name or "one without a name"
        for hinge in hinges
        if not hinge.driven and not hinge.follows
    ]
    if not joints:
        raise InputError(
            f"{path}: its actuators drive none of its hinges ({', '.join(left_out)}). Give each "
            "hinge that has a servo an actuator there, or take all actuators out to use every one."
        )
    if len(joints) > _MOST_SERVOS:
        raise InputError(f"{path} has {len(joints)} hinges; a bus has at most {_MOST_SERVOS} ids.")
    joints, renamed = _with_sound_names(joints)
    names = [hinge.name for hinge in joints]
    if strange := strange_joint(names):
        name = strange[0] or "without a name"
        raise InputError(f"{path}: a joint is called '{name}'; {strange[1]} Rename it there.")
    joints, doubts = _with_sound_limits(joints)
    doubts = renamed + doubts
    guesses = "ids, centres and signs are guesses"
    known = "ids, directions, offsets and ranges of LeRobot's calibration"
    source = f"made from {path.name} for {servo} servos; {guesses if lerobot is None else known}"
    ids = range(1, len(joints) + 1)
    data = _map_data(path, joints, ids, servo, source, "limits of the model; the rest is a guess")
    if lerobot is not None:
        apply_lerobot(data, lerobot, path)
    return RobotMap(joint_map_from(data, str(path)), left_out, following, doubts)


def joint_map_of_servos(ids: Mapping[str, int], servo: str) -> RobotMap:
    """Joint map of servos without a model file: a bench, or a part of a robot.

    `ids` are servo ids by joint; all servos are of one type of `FAMILIES`.
    """
    hinges = [Hinge(name, True, -_UNKNOWN_RAD, _UNKNOWN_RAD, driven=True) for name in ids]
    source = f"names and ids as stated, for {servo} servos; centres, signs and limits are guesses"
    data = _map_data(Path("joints"), hinges, ids.values(), servo, source, "a guess")
    doubt = (
        f"no limits are known, so the map allows ±{_UNKNOWN_RAD:g} rad about each servo's middle "
        "until `pupper-sysid calibrate-joints` has measured them. Turn the servos there by hand."
    )
    return RobotMap(joint_map_from(data, "`joints`"), [], {}, [doubt])


def _map_data(
    path: Path, joints: list[Hinge], ids: Iterable[int], servo: str, source: str, of_joint: str
) -> dict:
    """A joint map's file; `of_joint` is the source of each joint's values."""
    if servo.lower() not in FAMILIES:
        raise InputError(f"`servo` {servo} is not known; choose one of {', '.join(FAMILIES)}.")
    scs = servo.lower().startswith("scs")
    counts, span = (_SCS_COUNTS, _SCS_RAD) if scs else (4096, 2 * np.pi)
    return {
        "schema": SCHEMA, "schema_version": SCHEMA_VERSION, "name": path.stem, "frame": "raw",
        "counts": counts, "servo": servo.upper(), "linkage": "none", "source": source,
        "joints": {
            hinge.name: _entry(path, hinge, servo_id, counts, counts / span, of_joint)
            for hinge, servo_id in zip(joints, ids, strict=True)
        },
    }  # fmt: skip


def _with_sound_names(joints: list[Hinge]) -> tuple[list[Hinge], list[str]]:
    """Hinges whose names can be those of files and columns, and a sentence about those renamed."""
    taken = {hinge.name for hinge in joints}
    sound, renamed = [], []
    for hinge in joints:
        name = re.sub(r"[^A-Za-z0-9_]+", "_", hinge.name)
        name = name if name[:1].isalpha() or not hinge.name else f"joint_{name.lstrip('_')}"
        if name != hinge.name:
            while name in taken:
                name += "_"
            taken.add(name)
            renamed.append(f"{hinge.name} is {name}")
        sound.append(replace(hinge, name=name))
    if not renamed:
        return sound, []
    return sound, [
        f"joints are called otherwise here, by letters, digits and _: {', '.join(renamed)}."
    ]


def _with_sound_limits(joints: list[Hinge]) -> tuple[list[Hinge], list[str]]:
    """Hinges with limits that can be meant, and sentences about those that cannot."""
    sound, degrees, zero = [], [], []
    for hinge in joints:
        low, high = hinge.low, hinge.high
        if low is None or high is None:
            sound.append(hinge)
            continue
        far = max(abs(low), abs(high)) > _FARTHEST_RAD
        if hinge.limited and far and low < high:
            degrees.append(f"{hinge.name} ({low:g} to {high:g})")
            hinge = replace(hinge, low=float(np.radians(low)), high=float(np.radians(high)))
        elif hinge.zero_range:
            zero.append(hinge.name)
            hinge = replace(hinge, limited=True, low=-_UNKNOWN_RAD, high=_UNKNOWN_RAD)
        sound.append(hinge)
    doubts = []
    if degrees:
        doubts.append(
            f"limits of {', '.join(degrees)} cannot be radians, and were taken as degrees. URDF "
            "counts in radians: mend them there, or check limits_rad in the map."
        )
    if zero:
        doubts.append(
            f"limits of {', '.join(zero)} are 0 to 0, which says nothing of the range; the map "
            f"allows ±{_UNKNOWN_RAD:g} rad until `pupper-sysid calibrate-joints` has measured it."
        )
    return sound, doubts


def _entry(
    path: Path, hinge: Hinge, servo_id: int, counts: int, per_rad: float, source: str
) -> dict:
    reach = (counts / 2 - _MARGIN_COUNTS) / per_rad
    low, high = hinge.low, hinge.high
    if low is None or high is None or (low >= high and (low, high) != (0.0, 0.0)):
        # MuJoCo ignores such a range, which would leave the servo a full turn
        raise InputError(
            f"{path}: the range of joint {hinge.name} is not two rising numbers. Mend it there."
        )
    if not hinge.limited:
        low, high = -reach, reach
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
        "source": source,
    }  # fmt: skip
