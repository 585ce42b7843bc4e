"""The controller: from a robot's sensors in one tick to its joint targets.

A pure function of its inputs and its own state, without clock or bus: a log of its inputs gives the
same actions again, bit for bit (`policies.deploy.walk_log`).

    controller = Controller(policy, stack, observer)
    controller.reset(position, rest)          # standing, at rest
    for senses in ...:
        decision = controller.step(senses)    # decision.target goes to the servos
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError, SafetyStop
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.policies.deploy.filters import ComplementaryFilter, LowPass, Rest
from pupper_sysid.policies.deploy.observers import Observer
from pupper_sysid.policies.deploy.stacks import Stack
from pupper_sysid.policies.network.policy_file import Policy, refuse_other_observation

Array = NDArray[np.float64]

_PUBLISHED_SPEED_SHARE = 0.7


@dataclass(frozen=True)
class Senses:
    """Inputs of a tick."""

    elapsed_s: float
    """Since the first tick."""
    command: Array
    """Forward and sideways speed [m/s], turn rate [rad/s]; shape (3,)."""
    position: Array
    """Reported joint angles [rad]; NaN where a reading is missing; shape (12,)."""
    load: Array
    """Reported torque [N·m]; 0 where the bus has none; shape (12,)."""
    rate: Array
    """Of the IMU, in the trunk's frame [rad/s, m/s²]; NaN if it did not answer; shape (3,)."""
    acceleration: Array


@dataclass(frozen=True)
class Decision:
    """Outputs of a tick."""

    observation: NDArray[np.float32]
    """Shape (60,)."""
    action: NDArray[np.float32]
    """Raw output of the policy; shape (12,)."""
    target: Array
    """Joint angles to send [rad], within the limits; shape (12,)."""
    margin: Array
    """Distance of each target from its nearest limit [rad]; shape (12,)."""


class Controller:
    """A policy with its observer and filters.

    The observer is in servo coordinates and at the loop's period; `joint_map` is that of the bus,
    in joint coordinates: limits, and the linkage of the knees; `stall_torque_nm` is the torque at a
    reported load of 1 [N·m].
    """

    def __init__(
        self,
        policy: Policy,
        stack: Stack,
        observer: Observer,
        joint_map: JointMap,
        stall_torque_nm: float = 0.35,
    ):
        contract = policy.contract
        refuse_other_observation(contract)
        self.joints = tuple(contract.default_pose_rad)
        if joint_map.joint_names != self.joints or joint_map.coordinates != "joint":
            raise InputError(
                f"A policy needs a bus of all its {len(self.joints)} joints, in joint coordinates."
            )
        self.policy, self.stack, self.observer = policy.for_one(), stack, observer
        self.stall_torque_nm = stall_torque_nm
        self.period_s = stack.period_s(contract)
        self._to_servo = _affine(joint_map, joint_map.per_servo())
        self._to_joint = _affine(joint_map.per_servo(), joint_map)
        self._limits = joint_map.position_limits()
        self.default = np.array([*contract.default_pose_rad.values()])
        self._scale = contract.action_scale_rad if stack.scale_rad is None else stack.scale_rad
        self._smooth = (
            LowPass(stack.lowpass_hz, 1 / self.period_s, len(self.joints))
            if stack.lowpass_hz is not None
            else None
        )
        self._attitude = ComplementaryFilter()
        self._target = self.default.copy()
        self._action = np.zeros(len(self.joints), np.float32)
        self._last_s: float | None = None
        self._rate = np.zeros(3)

    def reset(self, position: Array, rest: Rest) -> None:
        """Begin from standing still.

        `position` is that of the joints and their target [rad], shape (12,).
        """
        self.observer.reset(self.to_servo(position))
        self._attitude.reset(rest)
        self._target = np.asarray(position, float).copy()
        self._action = np.zeros(len(self.joints), np.float32)
        self.policy.reset(self._action[None])
        if self._smooth:
            self._smooth.reset(np.zeros(len(self.joints)))
        self._last_s = None
        self._rate = rest.bias_rad_s

    def step(self, senses: Senses) -> Decision:
        """One tick; a `SafetyStop` if the policy's output is not a number."""
        since = self.period_s if self._last_s is None else senses.elapsed_s - self._last_s
        self._last_s = senses.elapsed_s
        answered = np.isfinite(senses.rate).all() and np.isfinite(senses.acceleration).all()
        if answered:
            self._rate = senses.rate
        # without an IMU sample the trunk is assumed to turn on; zero force has no direction
        force = senses.acceleration if answered else np.zeros(3)
        attitude = self._attitude.step(self._rate, force, since)
        # the joints as the policy observes them, in joint coordinates
        joints = self.observer.step(self.to_servo(self._target), self.to_servo(senses.position))
        position = _apply(self._to_joint, joints.position)
        measured = self.stack.observer == "readings"
        # the trunk's speed is not measured: zeros, or the paper's estimate from commands
        speed = np.zeros(3)
        if self.policy.contract.base_velocity != "zero":
            speed[:2] = _PUBLISHED_SPEED_SHARE * senses.command[:2]
        # a reading beyond the range of single precision becomes infinite; the output tells
        with np.errstate(over="ignore"):
            observation = np.concatenate(
                [
                    speed, attitude.rate_rad_s, attitude.gravity, senses.command,
                    position - self.default, joints.velocity @ self._to_joint[0],
                    senses.load if measured else joints.effort, self._action,
                ],
                dtype=np.float32,
            )  # fmt: skip
        action = self.policy.act(observation[None])[0]
        if not np.isfinite(action).all():
            raise SafetyStop(
                f"the policy's output is not a number after {senses.elapsed_s:.2f} s; its inputs "
                "are in the last row of the log."
            )
        self._action = action
        sent = np.asarray(action, float)
        if self._smooth:
            sent = self._smooth(sent)
        fade = self.stack.fade_in_s
        grown = min(senses.elapsed_s / fade, 1.0) if fade > 0 else 1.0
        target = self._limits.clip(self.default + grown * self._scale * sent)
        self._target = target
        return Decision(observation, action, target, self._limits.margin(target))

    def to_servo(self, joints: Array) -> Array:
        """Joint angles as the servos' own (`hardware.joint_map`, servo coordinates)."""
        return _apply(self._to_servo, joints)


def _affine(source: JointMap, target: JointMap) -> tuple[Array, Array]:
    """Matrix and constant of the conversion between two maps of the same counts."""
    count = len(source.joint_names)
    constant = target.to_angles(source.to_counts(np.zeros(count)))
    return target.to_angles(source.to_counts(np.eye(count))) - constant, constant


def _apply(affine: tuple[Array, Array], angles: Array) -> Array:
    """Convert angles; a missing one makes only those missing that depend on it."""
    matrix, constant = affine
    missing = np.isnan(angles)
    if not missing.any():
        return angles @ matrix + constant
    lost = missing @ (matrix != 0) > 0
    return np.where(lost, np.nan, np.where(missing, 0.0, angles) @ matrix + constant)
