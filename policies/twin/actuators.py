"""The robot of a recording, and the numbers of an actuator for each of its joints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS, JointCalibration
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.walking.servo_ranges import (
    IDEAL,
    check_actuator,
    is_servo_model,
    nearest_joint,
    servo_ranges,
)

if TYPE_CHECKING:
    from pupper_sysid.sim.robot.servo_robot import ServoRobot
    from pupper_sysid.sysid.recordings.recording import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Actuator:
    """Servos of all joints of a robot.

    Attributes
    ----------
    values : dict of str to ndarray, shape (joints,)
        By field of `DelayedPDParameters`.
    calibration : Calibration or None
        The same with their feedback, for every joint; None of ideal servos.
    fallbacks : dict of str to str
        Joints that were not calibrated, and the joint whose numbers they have.
    """

    values: dict[str, Array]
    calibration: Calibration | None
    fallbacks: dict[str, str]


def actuator_of(name: str, robot: ServoRobot, recording: Recording) -> Actuator:
    """The servos that `name` means, on the joints of a robot.

    Parameters
    ----------
    name : str
        A calibration file, a servo card, a preset, or `ideal`.
    robot : ServoRobot
    recording : Recording
    """
    check_actuator(name)
    if is_servo_model(name):
        raise InputError(
            f"{name} is a learned servo model: it predicts positions, whatever the servo carries. "
            "`pupper-sysid compare` takes it; give a calibration here."
        )
    if name == IDEAL:
        count = len(robot.joints)
        return Actuator(
            {f: np.full(count, x[0]) for f, x in servo_ranges(IDEAL).value.items()}, None, {}
        )
    return of_calibration(load_calibration(name), robot, recording)


def of_calibration(calibration: Calibration, robot: ServoRobot, recording: Recording) -> Actuator:
    """The servos of a calibration, on the joints of a robot.

    Parameters
    ----------
    calibration : Calibration
        One that knows other P gains is taken at the one that the recording names.
    robot : ServoRobot
    recording : Recording
    """
    calibration, fallbacks = spread_over(calibration, robot.joints)
    gains = {t.p_gain for joint in recording.joints for t in recording.trials(joint)}
    if len(gains) == 1 and np.isfinite(gain := gains.pop()):
        joints = {
            joint: own.at_p_gain(gain) if own.under_load else own
            for joint, own in calibration.joints.items()
        }
        calibration = calibration.model_copy(update={"joints": joints})
    servos = [calibration.joint(joint).actuator for joint in robot.joints]
    values = {
        field: np.array([getattr(servo, key).value for servo in servos])
        for field, key in PARAMETER_KEYS.items()
    }
    return Actuator(values, calibration, fallbacks)


def stronger(values: dict[str, Array], factor: float) -> dict[str, Array]:
    """Servos with the same motion in free air whose torques are larger by a factor.

    Parameters
    ----------
    values : dict of str to ndarray, shape (joints,)
        By field of `DelayedPDParameters`.
    factor : float
    """
    servo = DelayedPDParameters(**values)
    scaled = servo.scaled(factor * values["armature"])
    return {name: np.asarray(getattr(scaled, name)) for name in values}


def spread_over(
    calibration: Calibration, joints: tuple[str, ...]
) -> tuple[Calibration, dict[str, str]]:
    """A calibration for all of some joints, and those that have another's numbers.

    Parameters
    ----------
    calibration : Calibration
    joints : tuple of str
    """
    near = {joint: nearest_joint(joint, calibration.joint_names) for joint in joints}
    spread: dict[str, JointCalibration] = {j: calibration.joint(n) for j, n in near.items()}
    fallbacks = {joint: n for joint, n in near.items() if n != joint}
    return calibration.model_copy(update={"joints": spread}), fallbacks


def robot_for(recording: Recording, model: Path | None = None) -> ServoRobot:
    """The robot that a recording is of.

    Parameters
    ----------
    recording : Recording
    model : Path, optional
        Its MJCF or URDF; by default the Mini Pupper, if the joints are its.
    """
    from pupper_sysid.sim.robot.servo_robot import mini_pupper_robot, robot_of

    joints = recording.joints
    if model is not None:
        return robot_of(model, joints)
    if strange := [joint for joint in joints if joint not in JOINT_NAMES]:
        raise InputError(
            f"{recording.name} has the joint {strange[0]}, which is none of the Mini Pupper's, so "
            "its robot is not known here. Give the robot's MJCF or URDF with `robot`."
        )
    bus = recording.metadata.get("bus") or {}
    return mini_pupper_robot("serial" if bus.get("linkage") == "none" else "linkage")
