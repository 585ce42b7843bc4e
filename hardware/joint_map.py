"""Joint map: the servo of each joint and the meaning of its counts, as one YAML file.

    joint_map = load_joint_map("mini_pupper_2")      # a preset, or Path("joints.yaml")
    counts = joint_map.to_counts(angles)              # joints of the simulator -> servo counts
    angles = joint_map.to_angles(counts)              # and back, by the same transform

A servo's angle is `neutral_rad + sign * (count - centre - offset) / counts_per_rad`. On the Mini
Pupper a push rod makes the third servo of a leg set the *absolute* angle of the calf, thigh + calf
(`linkage: parallel knee`).

In *joint* coordinates the calf's angle is relative to its thigh, as in the simulator and in a
controller. In *servo* coordinates (`joint_map.per_servo()`) each joint is one servo's angle,
expressed as if the thigh stood at its neutral; a sweep uses these, so that one servo moves at a
time.

Counts have a frame: a direct bus uses raw counts, the robot's proxy counts that its firmware has
shifted by a stored calibration. A map of one frame is refused by a bus of the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pupper_sysid.common.border import Part, read_yaml, refuse_other_schema, validated
from pupper_sysid.common.data_sheet import counts_of
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import write_text
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES, in_order, strange_joint
from pupper_sysid.common.strict_yaml import dump
from pupper_sysid.hardware.bus import Coupling, PositionLimits

SCHEMA = "pupper-sysid joint map"
SCHEMA_VERSION = 1
REST_MARGIN_RAD = 0.4
"""Margin of the rest pose to both limits, where they allow it."""
PRESETS = (
    "mini_pupper_2", "mini_pupper_2_300deg", "mini_pupper_2_direct", "sts3215", "bench_sts3215",
)  # fmt: skip

Frame = Literal["proxy", "raw"]
Linkage = Literal["parallel knee", "none"]

_Number = TypeVar("_Number", int, float)
_Ends = Annotated[tuple[_Number, _Number], Field(strict=False)]  # a file has lists

FARTHEST_OFFSET = Field(ge=-1_044_479, le=1_044_479)
"""Range of a Dynamixel's register of the homing offset; Feetech's goes to 2047."""

_SCALE_FACTOR, _KNOWN_FACTOR = 2.5, 1.3
"""By how much a scale may differ from one turn per whole range (1,024 counts may be 300°, and
reports of the Mini Pupper's servos go up to twice that), and from a known servo's data sheet."""


class JointEntry(Part):
    """One joint of the file."""

    id: int = Field(ge=0, le=253)
    """Servo id on its bus."""
    sign: Literal[1, -1]
    """Direction of the counts as the servo's angle grows."""
    neutral_rad: float = Field(ge=-7, le=7)
    """The servo's angle at its centre count plus offset: absolute for a calf on a push rod."""
    counts_per_rad: float = Field(gt=1, lt=100_000)
    offset_counts: int = Field(ge=-4096, le=4096)
    """Offset of the servo's horn."""
    limits_counts: _Ends[int]
    """Lowest and highest count that may be commanded."""
    limits_rad: _Ends[float]
    """Lowest and highest angle of the simulator's joint."""
    homing_offset: Annotated[int, FARTHEST_OFFSET] | None = None
    """Of the servo's own register, where the map holds only with that value."""
    source: str
    """Origin of these values: a preset's source, or the calibration that measured them."""

    @model_validator(mode="after")
    def _limits_are_ordered(self) -> JointEntry:
        for name in ("limits_counts", "limits_rad"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} is [{low}, {high}]: the first must be the lower one")
        return self


class JointMapFile(Part):
    """The whole file."""

    schema_: Literal["pupper-sysid joint map"] = Field(alias="schema")
    schema_version: Literal[1]
    name: str
    frame: Frame
    counts: Literal[1024, 4096]
    """Counts of the encoder's whole range; the centre is half of it."""
    servo: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    """Manufacturer's model name of the servos, such as STS3215; its data sheet gives the torques
    their scale."""
    linkage: Linkage
    source: str
    joints: dict[str, JointEntry] = Field(min_length=1)

    @model_validator(mode="after")
    def _scales(self) -> JointMapFile:
        # every limit of the guard is in radians: a wrong scale would stretch them all
        known = counts_of(self.servo) if self.servo else None
        expected = (known or self.counts) / (2 * math.pi)
        factor = _KNOWN_FACTOR if known else _SCALE_FACTOR
        what = f"the {self.servo}" if known else f"a servo of {self.counts} counts a turn"
        for joint, entry in self.joints.items():
            if not 1 / factor <= entry.counts_per_rad / expected <= factor:
                raise ValueError(
                    f"{joint}: counts_per_rad is {entry.counts_per_rad:.4g}, but {what} has "
                    f"{expected:.4g}, and all limits scale with it. Measure it with "
                    "`pupper-sysid calibrate-joints`"
                )
        return self

    @model_validator(mode="after")
    def _names_and_ids(self) -> JointMapFile:
        if strange := strange_joint(self.joints):
            raise ValueError(f"{strange[0]} is no joint; {strange[1].rstrip('.?')}")
        if self.linkage != "none" and not set(self.joints) <= set(JOINT_NAMES):
            raise ValueError("linkage: push rods are the Mini Pupper's; write none")
        ids: dict[int, str] = {}
        for joint, entry in self.joints.items():
            if entry.id in ids:
                raise ValueError(f"{joint} and {ids[entry.id]} have the same id {entry.id}")
            ids[entry.id] = joint
            low, high = entry.limits_counts
            if low < 0 or high > self.counts - 1:
                raise ValueError(f"{joint}: limits_counts {[low, high]} leave 0..{self.counts - 1}")
            # a push rod's servo counts thigh + calf: it depends on the thigh
            if self.linkage != "none" and joint.endswith("_calf"):
                continue
            first, last = sorted(
                entry.neutral_rad
                + entry.sign * (x - self.counts / 2 - entry.offset_counts) / entry.counts_per_rad
                for x in entry.limits_counts
            )
            if max(first, entry.limits_rad[0]) >= min(last, entry.limits_rad[1]):
                raise ValueError(
                    f"{joint}: its limits in counts and its limits_rad have no angle in common. "
                    "Check the pose, and the sign in the joint map"
                )
        return self


@dataclass(frozen=True)
class JointMap:
    """Servos of the joints `joint_names`, in the project's order; see the module's docstring."""

    file: JointMapFile
    joint_names: tuple[str, ...]
    coordinates: Literal["joint", "servo"] = "joint"

    @property
    def frame(self) -> str:
        """Of the counts: "proxy" or "raw"."""
        return self.file.frame

    @property
    def ids(self) -> tuple[int, ...]:
        """Servo ids, in the order of `joint_names`."""
        return tuple(self._entry(j).id for j in self.joint_names)

    def select(self, joints: Sequence[str]) -> JointMap:
        """The map of some joints only."""
        missing = [j for j in joints if j not in self.file.joints]
        if missing:
            raise InputError(
                f"the joint map {self.file.name} has no {missing[0]}; "
                f"it has {', '.join(self.file.joints)}."
            )
        if self.coordinates == "joint" and self.file.linkage != "none":
            for calf in (j for j in joints if j.endswith("_calf")):
                thigh = calf.replace("calf", "thigh")
                if thigh not in joints:
                    raise InputError(
                        f"{calf} hangs on {thigh} by a push rod: use both, or neither."
                    )
        chosen = in_order(j for j in self.file.joints if j in joints)
        return replace(self, joint_names=tuple(chosen))

    def per_servo(self) -> JointMap:
        """The same map in servo coordinates."""
        return replace(self, coordinates="servo")

    def rest_pose(self) -> NDArray[np.float64]:
        """Pose in which a sweep starts, shape (joints,) [rad].

        The Mini Pupper's standing pose; for another robot the servos' neutral, moved until its
        margin to both limits is `REST_MARGIN_RAD`. A joint with a Mini Pupper's name belongs to
        another robot if the standing pose has less than half of this margin.
        """
        limits = self.per_servo().position_limits()
        margin = np.minimum(REST_MARGIN_RAD, (limits.high_rad - limits.low_rad) / 2)
        pose = np.clip(self.zero_rad(), limits.low_rad + margin, limits.high_rad - margin)
        standing = np.array([DEFAULT_POSE.get(n, np.nan) for n in self.joint_names])
        free = np.minimum(standing - limits.low_rad, limits.high_rad - standing)
        return np.where(free >= REST_MARGIN_RAD / 2, standing, pose)

    def counts_per_rad(self) -> NDArray[np.float64]:
        """Counts per radian, shape (joints,)."""
        return np.abs(self._scale)

    def zero_rad(self) -> NDArray[np.float64]:
        """Servo-coordinate angle of each joint's neutral count, shape (joints,) [rad]."""
        return self.per_servo().to_angles(self._zero_count)

    def sign(self) -> NDArray[np.float64]:
        """Direction of the counts, shape (joints,)."""
        return np.sign(self._scale)

    def to_counts(self, position_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Counts, not rounded, of angles, both shape (..., joints)."""
        servo = self._servo_from_joint(np.asarray(position_rad, float), +1)
        return self._zero_count + self._scale * (servo - self._neutral)

    def to_angles(self, counts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Angles of counts, both shape (..., joints); NaN stays NaN."""
        servo = self._neutral + (np.asarray(counts, float) - self._zero_count) / self._scale
        return self._servo_from_joint(servo, -1)

    def clip_counts(self, counts: NDArray[np.float64]) -> NDArray[np.int64]:
        """Counts rounded to integers within the servos' limits: the last step before sending."""
        low, high = self._ends.T
        return np.clip(np.rint(counts), low, high).astype(np.int64)

    def position_limits(self) -> PositionLimits:
        """Bounds of both the servos' counts and the joints' angles, in this map's coordinates."""
        turned = (self._ends - self._zero_count[:, None]) / self._scale[:, None]
        servo = np.sort(self._neutral[:, None] + turned, axis=1)
        joint = self._column("limits_rad")
        calf, thigh = self._legs
        limits = np.stack([np.maximum(servo, joint)[:, 0], np.minimum(servo, joint)[:, 1]], axis=1)
        if self.coordinates == "servo" and self.file.linkage != "none":
            # a calf without its thigh: the thigh is assumed to be at its neutral
            alone = [i for i in self._calves.tolist() if i not in calf]
            calf_travel = servo[alone] - self._thigh_neutral(alone)[:, None]
            limits[alone, 0] = np.maximum(calf_travel, joint[alone])[:, 0]
            limits[alone, 1] = np.minimum(calf_travel, joint[alone])[:, 1]
        if not len(calf):
            return PositionLimits(limits[:, 0], limits[:, 1])
        if self.coordinates == "joint":
            limits[calf] = joint[calf]
            calf_ends, sign = servo[calf], +1
        else:
            shift = self._thigh_neutral(calf)[:, None]
            limits[calf] = servo[calf] - shift
            calf_ends, sign = joint[calf] - shift, -1
        coupling = Coupling(calf, thigh, sign, calf_ends[:, 0], calf_ends[:, 1])
        return PositionLimits(limits[:, 0], limits[:, 1], coupling)

    def metadata(self) -> dict[str, Any]:
        """Entries for the header of a recording."""
        zero = self.zero_rad()
        names = self.joint_names
        return {
            "joint_map": self.file.name,
            "count_frame": self.frame,
            "coordinates": self.coordinates,
            "linkage": self.file.linkage,
            "command_quantum_rad": {j: 1 / self._entry(j).counts_per_rad for j in names},
            "command_rounding": dict.fromkeys(names, "nearest"),
            "count_zero_rad": {j: float(z) for j, z in zip(names, zero, strict=True)},
            "rest_pose_rad": {j: float(x) for j, x in zip(names, self.rest_pose(), strict=True)},
        }

    def servo_setups(self) -> dict[str, dict[str, Any]]:
        """By joint, what a recording's header says of its servo; empty where nothing is known."""
        model = self.file.servo
        return {joint: {"model": model} for joint in self.joint_names} if model else {}

    def save(self, path: Path, force: bool = False) -> None:
        """Write the map as YAML."""
        data = self.file.model_dump(by_alias=True)
        if self.file.servo is None:
            del data["servo"]
        for entry in data["joints"].values():
            for name in ("limits_counts", "limits_rad"):
                entry[name] = list(entry[name])
            if entry["homing_offset"] is None:
                del entry["homing_offset"]
        write_text(path, dump(data), force)

    def _entry(self, joint: str) -> JointEntry:
        return self.file.joints[joint]

    def _column(self, field: str) -> NDArray[np.float64]:
        """One field of all joints, shape (joints, ...)."""
        return np.array([getattr(self._entry(j), field) for j in self.joint_names], float)

    # cached: a file does not change, and a control loop needs them in every tick

    @cached_property
    def _neutral(self) -> NDArray[np.float64]:
        return self._column("neutral_rad")

    @cached_property
    def _scale(self) -> NDArray[np.float64]:
        """Counts per radian, with the sign."""
        return self._column("sign") * self._column("counts_per_rad")

    @cached_property
    def _zero_count(self) -> NDArray[np.float64]:
        return self.file.counts / 2 + self._column("offset_counts")

    @cached_property
    def _ends(self) -> NDArray[np.float64]:
        """Lowest and highest count, shape (joints, 2)."""
        return self._column("limits_counts")

    @cached_property
    def _calves(self) -> NDArray[np.intp]:
        names = self.joint_names
        return np.array([i for i, j in enumerate(names) if j.endswith("_calf")], np.intp)

    @cached_property
    def _bend(self) -> NDArray[np.float64]:
        """Neutrals of the thighs of `_calves`."""
        return self._thigh_neutral(self._calves)

    @cached_property
    def _legs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices of the calves that hang on a thigh, and of those thighs."""
        names = self.joint_names
        pairs = [
            (i, names.index(names[i].replace("calf", "thigh")))
            for i in self._calves.tolist()
            if self.file.linkage != "none" and names[i].replace("calf", "thigh") in names
        ]
        indices = np.array(pairs, np.intp).reshape(-1, 2)
        return indices[:, 0], indices[:, 1]

    def _thigh_neutral(self, calf: Sequence[int] | NDArray[np.intp]) -> NDArray[np.float64]:
        """Neutral of the thighs that the calves at these indices hang on."""
        thighs = (self.joint_names[i].replace("calf", "thigh") for i in calf)
        return np.array(
            [
                self._entry(t).neutral_rad if t in self.file.joints else DEFAULT_POSE[t]
                for t in thighs
            ]
        )

    def _servo_from_joint(self, angle: NDArray[np.float64], direction: int) -> NDArray[np.float64]:
        """The linkage: servo angles of joint angles (+1), or joint angles of servo angles (-1)."""
        angle = angle.copy()
        if self.file.linkage == "none":
            return angle
        if self.coordinates == "servo":
            angle[..., self._calves] += direction * self._bend
        else:
            calf, thigh = self._legs
            angle[..., calf] += direction * angle[..., thigh]
        return angle


def load_joint_map(path_or_preset: Path | str) -> JointMap:
    """Read a joint map, or a preset by its name.

    Examples
    --------
    >>> pupper = load_joint_map("mini_pupper_2")
    >>> standing = np.array([DEFAULT_POSE[j] for j in pupper.joint_names])
    >>> pupper.clip_counts(pupper.to_counts(standing)).tolist() == [512] * 12
    True
    """
    if isinstance(path_or_preset, str) and path_or_preset in PRESETS:
        with resources.as_file(resources.files("pupper_sysid.hardware") / "presets") as folder:
            return _load(folder / f"{path_or_preset}.yaml")
    path = Path(path_or_preset)
    if not path.exists():
        raise InputError(f"{path} does not exist. Presets of joint maps: {', '.join(PRESETS)}.")
    return _load(path)


def joint_map_from(data: dict[str, Any], name: str, lines: dict | None = None) -> JointMap:
    """A joint map from plain data, as in the file."""
    remedy = "Make one with `pupper-sysid calibrate-joints`."
    refuse_other_schema(name, data, "is no joint map", SCHEMA, SCHEMA_VERSION, remedy)
    file = validated(JointMapFile, data, name, lines)
    return JointMap(file, tuple(in_order(file.joints)))


def _load(path: Path) -> JointMap:
    data, lines = read_yaml(path)
    return joint_map_from(data, str(path), lines)
