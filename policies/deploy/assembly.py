"""Assembly of a controller from policy, stack and observer, with a check that they match."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.policies.deploy.controller import Controller
from pupper_sysid.policies.deploy.frozen_readings import FrozenReadings
from pupper_sysid.policies.deploy.observer_match import Match, compare
from pupper_sysid.policies.deploy.observers import SyntheticPD, make_observer
from pupper_sysid.policies.deploy.servo_match import ServoMatch, servo_match
from pupper_sysid.policies.deploy.stacks import Stack
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.network.trained_servo import trained_servo
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.servo_file import WEIGHTS
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.robot import body_joint_map
from pupper_sysid.sim.walking.servo_ranges import (
    ServoRanges,
    is_servo_model,
    servo_model_of,
    servo_ranges,
)


@dataclass(frozen=True)
class Assembly:
    """A controller, with the comparison of its observer and the header of its log."""

    controller: Controller
    frozen_readings: FrozenReadings
    """To be a watcher of the walk."""
    match: Match
    """The observer on this robot compared with the actuator the policy was trained with."""
    servo_match: ServoMatch | None
    """The robot's servos compared with those of the training; None if either is not known."""
    header: dict[str, Any]
    """Everything that `reassemble` needs."""


def assemble(
    policy: Policy,
    stack: Stack,
    joint_map: JointMap,
    actuator: str,
    servo: Path | None,
    trained: str | None = None,
    body: Body | None = None,
) -> Assembly:
    """Make a controller.

    Parameters
    ----------
    policy : Policy
    stack : Stack
    joint_map : JointMap
        Of the bus, in joint coordinates.
    actuator : str
        Calibration or preset of the robot, for a simulated PD.
    servo : Path or None
        A learned servo model's folder.
    trained : str, optional
        Calibration or preset with which the policy was trained, if not with `actuator`.
    body : Body, optional
        The robot; the Mini Pupper 2 by default.
    """
    contract = policy.contract
    period = stack.period_s(contract)
    servos = servo_ranges(actuator, body=body)
    pose = contract.default_pose_rad
    parameters = DelayedPDParameters(**servos.value)
    limits = joint_map.per_servo().position_limits()
    model = None
    if stack.observer == "servo-model" and servo is not None:
        if not servo.is_dir():
            raise InputError(f"`servo` is {servo}: there is no such folder.")
        model = servo_model_of(servo, period)
    observer = make_observer(
        stack.observer, period, contract.velocity_steps, parameters,
        (limits.low_rad, limits.high_rad), model, len(pose),
    )  # fmt: skip
    if trained is None or trained == actuator:
        match = compare(observer, parameters, period, pose=pose)
    else:
        of_training = DelayedPDParameters(**servo_ranges(trained, body=body).value)
        match = compare(observer, of_training, period, parameters, pose)
    controller = Controller(policy, stack, observer, joint_map, _stall_torque(servos))
    ends = (limits.low_rad, limits.high_rad)
    moving = SyntheticPD(parameters, period, limits_rad=ends, joints=len(pose))
    frozen = FrozenReadings(moving, controller.to_servo, controller.joints)
    header = {
        "policy_sha256": contract.weights_sha256, "stack": asdict(stack),
        "joint_map": joint_map.file.name, "actuator": actuator,
        "actuator_sha256": _hash(Path(actuator)),
        "servo": str(servo) if model else None,
        "servo_sha256": _hash(servo / WEIGHTS) if servo and model else None,
    }  # fmt: skip
    return Assembly(controller, frozen, match, _servo_match(policy, servos, trained), header)


def reassemble(
    policy: Policy, header: dict[str, Any], log: Path, body: Body | None = None
) -> Controller:
    """The controller of a log, from its header; `body` is another robot than the Mini Pupper 2."""
    try:
        if header["policy_sha256"] != policy.contract.weights_sha256:
            raise InputError(f"{log} was made with another policy. Give that one.")
        stack = Stack(**header["stack"])
        joint_map = (
            body_joint_map(body)
            if body is not None and header["joint_map"] == body_joint_map(body).file.name
            else load_joint_map(header["joint_map"])
        )
        servo = Path(header["servo"]) if header["servo"] else None
        found = assemble(policy, stack, joint_map, header["actuator"], servo, body=body)
        changed = [
            key for key in ("actuator_sha256", "servo_sha256") if header[key] != found.header[key]
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{log}: its header is damaged: {error}.") from error
    if changed:
        file = header[changed[0].removesuffix("_sha256")]
        raise InputError(f"{log} was made with another file at {file}. Restore that file.")
    return found.controller


def _servo_match(policy: Policy, here: ServoRanges, trained: str | None) -> ServoMatch | None:
    """Compare with the servos in the policy's file, or with the calibration of an older one."""
    if is_servo_model(here.source):
        return None
    own, feedback = policy.contract.servo, policy.contract.feedback
    if own is None and trained is not None:
        known = feedback if feedback in ("held", "ideal") else "held"
        own = trained_servo(trained, known, Walking(), servo_ranges(trained, known))
    return None if own is None else servo_match(own, here)


def _stall_torque(servos: ServoRanges) -> float:
    """Torque at full duty [N·m]."""
    limit = float(np.median(servos.value["effort_limit"]))
    return limit if np.isfinite(limit) else 0.0


def _hash(path: Path) -> str | None:
    return sha256(path) if path.is_file() else None
