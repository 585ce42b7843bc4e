"""Plausible ranges of twelve servos: a calibration's intervals, from which episodes draw.

`servo_ranges` turns an actuator's name (a calibration file or preset, or `ideal`) into arrays of
twelve: the value and the ends of every interval. A joint that the calibration does not have falls
back on the same kind of joint on another leg (`fallbacks`). `draw` makes one set of servos per
environment. The feedback comes along, apart from the actuator.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import as_path
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.calibration.calibration import (
    PRESETS,
    Calibration,
    is_shipped,
    load_calibration,
)
from pupper_sysid.servo_models.calibration.parts import (
    NO_SPEED_LIMIT_RAD_S,
    PARAMETER_KEYS,
    JointCalibration,
)
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, TORQUES, DelayedPDParameters
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.servo_models.networks import JointArrays
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.servo_models.step_size import at_step, delay_at_step
from pupper_sysid.sim.robot.body import Body

IDEAL = "ideal"
_NO_LIMIT_NM = 1e3


@dataclass(frozen=True)
class ServoRanges:
    """Ranges of twelve servos, in the order of `JOINT_NAMES`."""

    source: str
    """A path, a preset's name or `ideal`."""
    low: dict[str, NDArray[np.float64]]
    value: dict[str, NDArray[np.float64]]
    high: dict[str, NDArray[np.float64]]
    """`low`, `value` and `high`: by field of `DelayedPDParameters`: ends of the interval, and the
    value; shape (12,)."""
    feedback: tuple[HeldFeedback, ...]
    """Of each servo."""
    fallbacks: dict[str, str]
    """Joints that were not calibrated, and the joint whose numbers they have."""
    command_jitter_s: float = 0.0
    """Standard deviation of the (exponential) latency of a robot's commands, whose mean is in the
    dead times [s]: the median of the joints that show one."""
    joints: tuple[str, ...] = JOINT_NAMES
    """Of the robot, the Mini Pupper's twelve by default."""

    @property
    def longest_dead_time_s(self) -> float:
        """Longest dead time that can be drawn [s]."""
        return float(self.high["dead_time_s"].max())

    @property
    def dead_band_share(self) -> NDArray[np.float64]:
        """Friction over stiffness of each joint, relative to their mean; 1 without friction."""
        dead_zone = self.value["friction_loss"] / self.value["stiffness"]
        mean = dead_zone.mean()
        return dead_zone / mean if mean > 0 else np.ones_like(dead_zone)

    def later(self, extra_s: ArrayLike) -> ServoRanges:
        """The same servos, every dead time longer by `extra_s` [s], one or twelve; none below 0."""
        moved = {}
        for name in ("low", "value", "high"):
            bound = getattr(self, name)
            moved[name] = {**bound, "dead_time_s": np.maximum(bound["dead_time_s"] + extra_s, 0.0)}
        return replace(self, **moved)

    def in_steps_of(self, time_step_s: float) -> ServoRanges:
        """The same servos for a simulation in other steps, with the lag that was measured."""
        middle = DelayedPDParameters(**self.value)
        return self.later(delay_at_step(middle, time_step_s) - self.value["dead_time_s"])

    def nominal(self) -> dict[str, DelayedPDParameters]:
        """The value of every number, by joint."""
        return {
            name: DelayedPDParameters(**{f: self.value[f][i] for f in PARAMETER_KEYS})
            for i, name in enumerate(self.joints)
        }

    def draw(
        self, count: int, torque_scale: tuple[float, float], rng: np.random.Generator
    ) -> dict[str, NDArray[np.float64]]:
        """Servos of `count` robots, each number uniform in its interval.

        `torque_scale` is the range of a factor on all torques and the armature of a robot: free-air
        recordings leave their common scale open. The numbers are by field of `DelayedPDParameters`,
        shape (count, 12).
        """
        drawn = {
            f: rng.uniform(self.low[f], self.high[f], (count, len(self.joints)))
            for f in PARAMETER_KEYS
        }
        scale = rng.uniform(*torque_scale, (count, 1))
        for f in (*TORQUES, "armature"):
            drawn[f] *= scale
        return drawn


def servo_ranges(
    actuator: str | Path, feedback: str | Path = "held", body: Body | None = None
) -> ServoRanges:
    """Ranges of the servos of an actuator, and its feedback or another.

    An actuator is a calibration file, a preset, or `ideal`: no delay, no friction, no limits. The
    folder of a learned servo model gives the same: that model predicts the position itself.
    Feedback is `held`: the calibration's own; `ideal`: every reading fresh and exact; or another
    calibration, whose feedback is taken. The robot is the Mini Pupper 2 by default.
    """
    joints = JOINT_NAMES if body is None else body.joints
    servo_of = {} if body is None else body.servo_of
    as_path(actuator, "An actuator")
    if str(actuator) == IDEAL or is_servo_model(actuator):
        ranges = _ideal(str(actuator), joints)
    else:
        ranges = _from_calibration(load_calibration(actuator), str(actuator), joints, servo_of)
    if str(feedback) == "held":
        return ranges
    if str(feedback) == "ideal":
        held = (HeldFeedback(),) * len(joints)
    else:
        feedback_source = load_calibration(feedback)
        held = _from_calibration(feedback_source, str(feedback), joints, servo_of).feedback
    return replace(ranges, feedback=held)


def _from_calibration(
    calibration: Calibration, source: str, joints: tuple[str, ...], servo_of: Mapping[str, str]
) -> ServoRanges:
    calibrations: list[JointCalibration] = []
    fallbacks = {}
    for name in joints:
        stated = servo_of.get(name)
        if stated is not None and stated not in calibration.joint_names:
            raise InputError(
                f"The robot's YAML gives {name} the servo of '{stated}' (`servos`), but {source} "
                f"has none of that name. It has {', '.join(calibration.joint_names)}."
            )
        nearest = stated or nearest_joint(name, calibration.joint_names)
        if stated is None and nearest != name:
            fallbacks[name] = nearest
        calibrations.append(calibration.joint(nearest))
    low, value, high = {}, {}, {}
    for field, key in PARAMETER_KEYS.items():
        ends = [astuple(getattr(p.actuator, key).interval) for p in calibrations]
        value[field], low[field], high[field] = np.array(ends).T.copy()
    delays = np.array([p.actuator.dead_time_interval_s for p in calibrations])
    low["dead_time_s"], high["dead_time_s"] = delays[:, 0], delays[:, 1]
    # the armature is the torque's scale, drawn for the robot as a whole
    low["armature"] = high["armature"] = value["armature"]
    continuous = np.array([p.actuator.numbers_in == "continuous time" for p in calibrations])
    if continuous.any():  # what a simulation in steps needs, as older files have it
        stepped = at_step(DelayedPDParameters(**value), TIME_STEP_S).arrays()
        for field, number in value.items():
            more = np.where(continuous, stepped[field] - number, 0.0)
            grows, positive = continuous & (number > 0), np.maximum(number, 1e-12)
            longer = np.where(grows, stepped[field] / positive, 1.0)
            for ends in (low, high):
                ends[field] = (
                    np.maximum(ends[field] + more, 0.0)
                    if field == "dead_time_s"
                    else ends[field] * longer
                )
        value = {field: np.where(continuous, stepped[field], value[field]) for field in value}
    feedback = tuple(
        calibration.held_feedback(servo_of.get(n) or fallbacks.get(n, n)) for n in joints
    )
    jitters = [p.actuator.command_jitter_s for p in calibrations]
    known = [q.value for q in jitters if q.low]  # seen, if only as an upper bound
    jitter = float(np.median(known)) if known else 0.0
    return ServoRanges(source, low, value, high, feedback, fallbacks, jitter, joints)


def nearest_joint(name: str, known: Sequence[str]) -> str:
    """The one of the `known` joints nearest to `name`: itself, its kind on another leg, any.

    Examples
    --------
    >>> nearest_joint("RF_thigh", ["LF_hip", "LF_thigh"]), nearest_joint("gripper", ["wrist_roll"])
    ('LF_thigh', 'wrist_roll')
    """
    leg, _, kind = name.partition("_")
    return min(
        known, key=lambda j: (j != name, j.partition("_")[2] != kind, j.partition("_")[0] != leg)
    )


def _ideal(source: str, joints: tuple[str, ...]) -> ServoRanges:
    """Servos that follow their command, as nearly as a 2 ms step can hold."""
    ideal = dict.fromkeys(PARAMETER_KEYS, 0.0) | {
        "stiffness": 20.0, "damping": 0.25, "armature": 8e-4,
        "effort_limit": _NO_LIMIT_NM, "velocity_limit": NO_SPEED_LIMIT_RAD_S,
    }  # fmt: skip
    value = {f: np.full(len(joints), x) for f, x in ideal.items()}
    held = (HeldFeedback(),) * len(joints)
    return ServoRanges(source, value, value, value, held, {}, joints=joints)


def is_servo_model(actuator: str | Path) -> bool:
    """Whether this is the folder of a learned servo model."""
    return Path(actuator).is_dir()


def servo_model_of(actuator: str | Path, control_step_s: float) -> JointArrays | None:
    """The learned servo model in a folder; None for anything that is not a folder."""
    if not is_servo_model(actuator):
        return None
    model = load_servo_model(Path(actuator), JOINT_NAMES, control_step_s).model
    if not isinstance(model, JointArrays):
        raise InputError(
            f"{actuator} is not a learned model. Give `pupper-sysid calibrate`'s calibration "
            "instead: MuJoCo simulates it natively."
        )
    return model


def check_actuator(actuator: str) -> None:
    """Refuse what is neither a preset, a shipped card, `ideal`, nor something that exists."""
    if actuator != IDEAL and not is_shipped(actuator) and not Path(actuator).exists():
        near = difflib.get_close_matches(actuator, (*PRESETS, IDEAL), n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise InputError(
            f"`actuator` {actuator}: there is no such file.{hint} Give a calibration "
            "(`pupper-sysid calibrate` writes one, `pupper-sysid samples` copies one of an "
            "emulated robot), a servo model's folder, a servo "
            f"card (`pupper-sysid servo list`), or one of {', '.join((*PRESETS, IDEAL))}."
        )
