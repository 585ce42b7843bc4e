"""The controller: from a robot's sensors in one tick to its joint targets.

A pure function of its inputs and its state, without clock or bus: a log of its inputs gives the
same actions again, bit for bit (`policies.deploy.walk_log`).

    controller = Controller(policy, stack, observer)
    controller.reset(position, rest)          # standing, at rest
    for senses in ...:
        decision = controller.step(senses)    # decision.target goes to the servos

Its filters: `LowPass` smooths the joint targets before they reach the servos. `ComplementaryFilter`
estimates the trunk's rate and the direction of gravity from an IMU: the gyro turns the last
estimate of gravity, and the accelerometer slowly corrects it towards the mean force. `at_rest`
determines the filter's start from samples of a robot that stands still. The body's frame is the
simulator's: x forward, y left, z up. Rates are radians per second, right handed. Accelerations are
what an ideal accelerometer measures, the specific force: +9.81 m/s² on z at rest. Gravity is its
direction in the trunk's frame, (0, 0, -1) when level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal
from scipy.constants import g as STANDARD_GRAVITY

from pupper_sysid.common.errors import InputError, SafetyStop
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.policies.deploy.stacks import Observer, Stack
from pupper_sysid.policies.network.policy_file import Policy, refuse_other_observation

Array = NDArray[np.float64]

_SHORTEST_S = 1e-3  # least time between samples
_NO_FORCE_M_S2 = 0.1  # below: free fall, or a failed read of zeros
_CLIPPED_M_S2 = 0.999 * 2 * STANDARD_GRAVITY  # the highest code is one short of ±2 g
_MOST_GYRO_SPREAD_RAD_S = 0.03  # 27 counts of the robot's gyro
_MOST_GYRO_BIAS_RAD_S = 0.3  # 17°/s; more without spread is an even rotation, not a bias
_MOST_FORCE_ERROR_M_S2 = 1.0
_MOST_TILT_DEG = 30.0


class LowPass:
    """Butterworth low-pass filter of second order, one per channel, sample by sample.

    Starts in the steady state of zeros. At `cutoff_hz`, below half of the rate, the gain is 1/√2.
    It delays: at 25 Hz and a cut-off of 8 Hz, a gait of 2.8 Hz comes 19 ms later.

    Examples
    --------
    >>> smooth = LowPass(cutoff_hz=8.0, rate_hz=25.0, channels=2)
    >>> smooth.reset([0.5, -1.0])
    >>> smooth([0.5, -1.0]).round(12).tolist()
    [0.5, -1.0]
    """

    def __init__(self, cutoff_hz: float, rate_hz: float, channels: int):
        if not 0 < cutoff_hz < rate_hz / 2:
            raise InputError(
                f"The cut-off of the low-pass filter is {cutoff_hz:g} Hz at {rate_hz:g} samples "
                f"per second; it must be below half the rate, {rate_hz / 2:g} Hz."
            )
        self._sos = np.asarray(signal.butter(2, cutoff_hz, fs=rate_hz, output="sos"))
        self.reset(np.zeros(channels))

    def reset(self, value: ArrayLike) -> None:
        """Set the steady state of the constant input `value`, shape (channels,)."""
        self._state = signal.sosfilt_zi(self._sos)[0][:, None] * np.asarray(value, float)

    def __call__(self, value: ArrayLike) -> Array:
        """The next filtered sample, for the next sample; both shape (channels,)."""
        value = np.asarray(value, float)
        # transposed direct form II, as scipy's sosfilt, whose checks cost more than a tick has
        b0, b1, b2, _, a1, a2 = self._sos[0]
        near, far = self._state
        filtered = b0 * value + near
        self._state = np.stack([b1 * value - a1 * filtered + far, b2 * value - a2 * filtered])
        return filtered


@dataclass(frozen=True)
class Attitude:
    """The trunk's motion from an IMU."""

    rate_rad_s: Array
    """Angular velocity in the trunk's frame, without the gyro's bias; shape (3,)."""
    gravity: Array
    """Unit vector, the direction of gravity in the trunk's frame: (0, 0, -1) when level; shape
    (3,)."""
    clipped: bool
    """Whether the accelerometer was at its limit, and so was ignored."""


@dataclass(frozen=True)
class Rest:
    """Start of a `ComplementaryFilter`."""

    gravity: Array
    """Unit vector in the trunk's frame; shape (3,)."""
    bias_rad_s: Array
    """Gyro reading of a robot that does not turn; shape (3,)."""


class ComplementaryFilter:
    """Rate and gravity from gyro and accelerometer; frames and signs as in the module's docstring.

    Gravity is fixed in the world; in a frame that turns with rate ω, dg/dt = -ω × g, which is
    integrated exactly over each sample. Then it moves towards the accelerometer's -a / |a| by
    `weight` (0 ≤ weight < 0.5), with a time constant of period / weight (2 s at 25 Hz), so that the
    accelerations of single steps hardly tilt it. Footfalls of small robots exceed ±2 g; a sample
    that is clipped at the accelerometer's full scale has lost its direction.
    """

    def __init__(self, weight: float = 0.02):
        self.weight = weight
        self.reset(Rest(gravity=np.array([0.0, 0.0, -1.0]), bias_rad_s=np.zeros(3)))

    def reset(self, rest: Rest) -> None:
        """Start from rest; see `at_rest`."""
        self._gravity = rest.gravity / np.linalg.norm(rest.gravity)
        self._bias = rest.bias_rad_s

    def step(self, gyro_rad_s: ArrayLike, acceleration_m_s2: ArrayLike, dt_s: float) -> Attitude:
        """Rate and gravity after one more sample.

        The rate has the gyro's bias, the acceleration is the specific force, shape (3,) each;
        `dt_s` is the measured time since the last sample, at least 1 ms.
        """
        rate = np.asarray(gyro_rad_s, float) - self._bias
        force = np.asarray(acceleration_m_s2, float)
        span = max(dt_s, _SHORTEST_S)
        # seen from the body, the world turns backwards
        gravity = _turned(self._gravity, -rate * span)
        clipped = bool((np.abs(force) >= _CLIPPED_M_S2).any())
        size = np.linalg.norm(force)
        if not clipped and size > _NO_FORCE_M_S2:
            gravity = (1 - self.weight) * gravity - self.weight * force / size
        self._gravity = gravity / np.linalg.norm(gravity)
        return Attitude(rate, self._gravity.copy(), clipped)


def at_rest(rates: Array, forces: Array) -> Rest:
    """The gyro's bias and the first direction of gravity, from samples of a robot at rest.

    About a second of samples [rad/s, m/s²], 50 or so, in the trunk's frame, shape (samples, 3).
    """
    bias, force = rates.mean(axis=0), forces.mean(axis=0)
    size = float(np.linalg.norm(force))
    if abs(size - STANDARD_GRAVITY) > _MOST_FORCE_ERROR_M_S2:
        raise InputError(
            f"The accelerometer measures {size:.2f} m/s² at rest, not {STANDARD_GRAVITY:.2f}: the "
            "robot is being moved, the unit is not m/s², or the IMU does not answer."
        )
    spread = float(rates.std(axis=0).max())
    if spread > _MOST_GYRO_SPREAD_RAD_S or np.abs(bias).max() > _MOST_GYRO_BIAS_RAD_S:
        raise InputError(
            f"The robot moved while its gyro was calibrated (rate {np.abs(bias).max():.2f} rad/s, "
            f"spread {spread:.3f} rad/s). Put it down, leave it alone and try again."
        )
    gravity = -force / size
    tilt = float(np.degrees(np.arccos(np.clip(-gravity[2], -1, 1))))
    if tilt > _MOST_TILT_DEG:
        raise InputError(
            f"The robot stands tilted by {tilt:.0f}°; it must stand level to start. Near 180° the "
            "samples are in the frame of a chip that is mounted upside down."
        )
    return Rest(gravity, bias)


def _turned(vector: Array, rotation: Array) -> Array:
    """`vector` turned by the rotation vector `rotation` [rad] (Rodrigues' formula)."""
    angle = math.hypot(*rotation.tolist())
    if angle == 0:
        return vector
    across = _cross(rotation, vector)
    half = math.sin(angle / 2) / (angle / 2)
    return vector + math.sin(angle) / angle * across + 0.5 * half**2 * _cross(rotation, across)


def _cross(a: Array, b: Array) -> Array:
    """The cross product; NumPy's takes ten times as long for a single one."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


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
        self._smooth = None
        if stack.lowpass_hz is not None:
            self._smooth = LowPass(stack.lowpass_hz, 1 / self.period_s, len(self.joints))
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
        # a reading beyond single precision becomes infinite, which the check of the output detects
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
        """Joint angles in servo coordinates (`hardware.joint_map`)."""
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
