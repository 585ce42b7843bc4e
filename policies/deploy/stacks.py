"""Deployment stacks: the settings between a policy and the servos, and their observers.

A stack defines the source of the joint observation (`observer`), the smoothing of actions, and the
rate of the loop. `closed-loop` uses the servos' own held readings, as in this project's simulator.
The two others are the published ones, which use a prediction: `lstm-servo` of learned servo models,
`mlp-observer` of a simulated PD.

In training a policy observes its joints as the measured bus would report them. On a robot it
observes the readings themselves (`HeldEncoder`), a model of the servos driven by the same commands
(`SyntheticPD`, `ServoModelObserver`), or joints at rest (`Zero`). An observer steps at the end of
each control period: `target` is the command of that period, `reading` the bus's report at its end,
and the estimate is of that instant. A controller reads the bus, steps its observer with the target
of the period that ended, and then the policy acts.

Arrays are (..., joints) in the order of the policy's joints, by default the twelve of
`common.joints.JOINT_NAMES`, with any leading axes (environments). Angles are radians in servo
coordinates: one number per servo, as its `DelayedPD` or servo model was fitted (see
`hardware.joint_map.JointMap.per_servo`); the caller converts.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.delayed_pd import substeps as physics_substeps
from pupper_sysid.servo_models.networks import JointArrays

if TYPE_CHECKING:
    from pupper_sysid.policies.network.policy_file import Contract

ObserverKind = Literal["readings", "servo-model", "synthetic-pd", "published-pd", "rest"]
StackName = Literal["closed-loop", "lstm-servo", "mlp-observer"]


@dataclass(frozen=True)
class Stack:
    """Settings of a deployment."""

    observer: ObserverKind = "readings"
    """Source of the joint observation: the servos' readings, a learned servo model's prediction,
    that of a PD with the calibration's parameters, that of the paper's PD, or rest at the default
    pose."""
    lowpass_hz: float | None = None
    """Cut-off of the Butterworth filter on the targets; none by default: its lag (19 to 27 ms at
    8 Hz) is not in the training."""
    fade_in_s: float = 1.0
    """Time over which targets grow from the standing pose to the policy's."""
    scale_rad: float | None = None
    """Radians per unit of action, instead of the trained scale (it does not multiply it)."""
    rate_hz: float | None = None
    """Rate of the loop; by default the policy's own. Another rate scales the policy's time."""

    def __post_init__(self):
        for name in ("lowpass_hz", "scale_rad", "rate_hz"):
            value = getattr(self, name)
            if value is not None and not 0 < value < 1e4:
                raise InputError(f"`{name}` is {value:g}; it must be a positive number.")
        if self.scale_rad is not None and self.scale_rad > math.pi:
            raise InputError(
                f"`scale_rad` is {self.scale_rad:g} rad per unit of action, and no joint turns by "
                f"more than half a turn. Write radians: {self.scale_rad:g} degrees are "
                f"{math.radians(self.scale_rad):.2g}."
            )
        if not 0 <= self.fade_in_s < 1e3:
            raise InputError(f"`fade_in_s` is {self.fade_in_s:g}; it must be 0 or more.")

    def period_s(self, contract: Contract) -> float:
        """Time between two actions [s]."""
        return contract.control_step_s if self.rate_hz is None else 1 / self.rate_hz


STACKS: dict[StackName, Stack] = {
    "closed-loop": Stack(),
    "lstm-servo": Stack("servo-model", lowpass_hz=8.0, fade_in_s=4.0),
    "mlp-observer": Stack("synthetic-pd", lowpass_hz=10.0, fade_in_s=4.0),
}


def suited(contract: Contract) -> StackName:
    """The stack with the kind of joint observation that a policy was trained with."""
    if contract.feedback != "ideal":
        return "closed-loop"
    return "mlp-observer" if contract.kind in ("mlp", "mlp-actions") else "lstm-servo"


Array = NDArray[np.float64]

_JOINTS = len(JOINT_NAMES)
_PAPER_SUBSTEPS = 4
_PAPER_DELAY_STEPS = {0.02: 9, 0.04: 5}  # by control period: 180 and 200 ms


@dataclass(frozen=True)
class JointEstimate:
    """An observer's estimate of the joints at the end of a control period."""

    position: Array
    """[rad], servo coordinates; shape (..., 12)."""
    velocity: Array
    """[rad/s]; shape (..., 12)."""
    effort: Array
    """Torque [N·m]; 0 where unknown; shape (..., 12)."""


class Observer(ABC):
    """Source of a policy's joint observation; see the module's docstring."""

    def __init__(self, period_s: float, joints: int = _JOINTS):
        self.period_s, self.joints = float(period_s), joints
        self.reset(np.zeros(joints))

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position` [rad], shape (..., 12), its target and reading so far."""
        self._position = np.array(position, float)

    @abstractmethod
    def step(self, target: ArrayLike, reading: ArrayLike) -> JointEstimate:
        """Estimate the joints at the end of one more control period.

        `target` is the command of this period, `reading` what was read at its end, NaN where
        nothing was; both [rad], shape (..., 12).
        """

    def _target(self, target: ArrayLike) -> Array:
        """A checked target: one NaN would stay in a model's state."""
        value = np.asarray(target, float)
        if not np.isfinite(value).all():
            raise InputError("A target is not finite: the policy or a filter before it failed.")
        return np.broadcast_to(value, self._position.shape)


class SyntheticPD(Observer):
    """A `DelayedPD` per joint, stopped at joint limits, in free run on targets.

    With the parameters of the training, it is the trained actuator in free air. A period has as
    many substeps as in training, of 2 ms each, by default; a joint that reaches one of its limits
    (lowest and highest position, scalars or arrays of 12 [rad]) stops.
    """

    def __init__(
        self,
        parameters: DelayedPDParameters,
        period_s: float,
        substeps: int | None = None,
        limits_rad: tuple[ArrayLike, ArrayLike] = (-np.inf, np.inf),
        joints: int = _JOINTS,
    ):
        substeps = physics_substeps(period_s) if substeps is None else substeps
        low, high = (np.asarray(limit, float) for limit in limits_rad)
        self._substeps = substeps
        self._servo = _StoppedServo(parameters, period_s / substeps, low, high)
        needed = self._servo.longest_time_step_s()
        if period_s / substeps > needed:
            raise InputError(
                f"SyntheticPD: {substeps} substeps of {1e3 * period_s / substeps:.3g} ms are too "
                f"long for so stiff a servo; take {int(np.ceil(period_s / needed))} or more."
            )
        super().__init__(period_s, joints)

    @classmethod
    def paper(
        cls, period_s: float, limits_rad: tuple[ArrayLike, ArrayLike] = (-np.inf, np.inf)
    ) -> SyntheticPD:
        """The observer of the Mini Pupper 2 paper's deployment, to compare with.

        Stiffness 70, damping 1.2, inertia 0.20, friction 0.03, delay 9 control steps at 50 Hz and 5
        at 25 Hz. It resonates: near 3 Hz its gain is three. As in the authors' final controller its
        torque has no limit, and the effort it reports is 0.
        """
        delay = next((n for t, n in _PAPER_DELAY_STEPS.items() if abs(t - period_s) < 1e-9), None)
        if delay is None:
            raise InputError(
                f"The paper's observer is known for control periods of 0.02 and 0.04 s, not "
                f"{period_s:g} s."
            )
        damping, inertia = 1.2, 0.20
        parameters = DelayedPDParameters(
            stiffness=70.0,
            damping=damping,
            friction_loss=0.03,
            # the authors integrate damping explicitly, v += h / I (torque - d v); the implicit
            # v = (v + h / J torque) / (1 + h d / J) is the same number with J = I - h d
            armature=inertia - damping * period_s / _PAPER_SUBSTEPS,
            effort_limit=np.inf,
            velocity_limit=np.inf,
            dead_time_s=delay * period_s,
        )
        return cls(parameters, period_s, _PAPER_SUBSTEPS, limits_rad)

    def reset(self, position: ArrayLike) -> None:
        """See `Observer`."""
        super().reset(position)
        self._servo.reset(self._position)

    def step(self, target: ArrayLike, reading: ArrayLike) -> JointEstimate:
        """See `Observer`; `reading` is not used."""
        target = self._target(target)
        self._servo.rollout(np.broadcast_to(target, (self._substeps, *self._servo.batch)))
        return self._servo.estimate()


class _StoppedServo(DelayedPD):
    """`DelayedPD` whose joint stops at its limits."""

    def __init__(
        self, parameters: DelayedPDParameters, time_step_s: float, low: Array, high: Array
    ):
        super().__init__(parameters, time_step_s)
        self._low, self._high = low, high

    def longest_time_step_s(self) -> float:
        """Longest time step for which the explicitly integrated spring is stable [s].

        With k and d, stiffness and damping over inertia, the characteristic polynomial
        (1 + h d) z² - (2 + h d - h² k) z + 1 leaves the unit circle at z = -1, where
        h² k = 4 + 2 h d.
        """
        ratios = self.parameters.per_inertia()
        k, d = np.broadcast_arrays(np.asarray(ratios.stiffness), np.asarray(ratios.damping))
        with np.errstate(divide="ignore", invalid="ignore"):
            longest = (d + np.sqrt(d * d + 4 * k)) / k
        return float(np.min(np.where(k > 0, longest, np.inf)))

    def _integrate(self, delayed: Array) -> Array:
        start = self._state
        path = super()._integrate(delayed)
        if not ((path < self._low) | (path > self._high)).any():
            return path
        # again, one time step after the other: a joint stops where it meets its limit
        self._state = start
        for k in range(len(delayed)):
            super()._integrate(delayed[k : k + 1])
            position, velocity, setpoint = self._state
            path[k] = within = np.clip(position, self._low, self._high)
            self._state = (within, np.where(within == position, velocity, 0.0), setpoint)
        return path

    def estimate(self) -> JointEstimate:
        """The present state; the scale of a torque without a limit is unknown."""
        (position, velocity, setpoint), numbers = self._state, self._values
        torque = numbers["stiffness"] * (setpoint - position) - numbers["damping"] * velocity
        limit = np.broadcast_to(numbers["effort_limit"], self.batch)
        effort = np.where(np.isfinite(limit), np.clip(torque, -limit, limit), 0.0)
        return JointEstimate(position.copy(), velocity.copy(), effort)


class ServoModelObserver(Observer):
    """A learned servo model in free run on targets.

    The model is of all twelve joints, in order, one step per control period; the observer owns its
    state.
    """

    def __init__(self, model: JointArrays, period_s: float):
        self._model = model
        super().__init__(period_s)

    def reset(self, position: ArrayLike) -> None:
        """See `Observer`."""
        super().reset(position)
        self._model.reset(self._position)

    def step(self, target: ArrayLike, reading: ArrayLike) -> JointEstimate:
        """See `Observer`; `reading` is not used. Effort is not known."""
        position = self._model.step(self._target(target)).astype(float)
        velocity = (position - self._position) / self.period_s
        self._position = position
        return JointEstimate(position.copy(), velocity, np.zeros_like(position))


class HeldEncoder(Observer):
    """The readings themselves, as the policy observes them in training.

    A missing reading is replaced by the last one. Velocity is the difference of readings
    `velocity_steps` control periods apart: cheap buses poll too rarely for less.
    """

    def __init__(self, period_s: float, velocity_steps: int, joints: int = _JOINTS):
        self._velocity_steps = velocity_steps
        super().__init__(period_s, joints)

    def reset(self, position: ArrayLike) -> None:
        """See `Observer`."""
        super().reset(position)
        # readings, newest first
        self._seen = np.stack([self._position] * (self._velocity_steps + 1))

    def step(self, target: ArrayLike, reading: ArrayLike) -> JointEstimate:
        """See `Observer`; `target` is not used. Effort is not known."""
        now = np.broadcast_to(np.asarray(reading, float), self._position.shape)
        self._seen[1:] = self._seen[:-1].copy()
        self._seen[0] = np.where(np.isfinite(now), now, self._seen[1])
        velocity = (self._seen[0] - self._seen[-1]) / (self._velocity_steps * self.period_s)
        return JointEstimate(self._seen[0].copy(), velocity, np.zeros_like(velocity))


class Zero(Observer):
    """Joints that always rest: a walk without joint feedback."""

    def step(self, target: ArrayLike, reading: ArrayLike) -> JointEstimate:
        """See `Observer`; neither is used."""
        nothing = np.zeros_like(self._position)
        return JointEstimate(self._position.copy(), nothing, nothing.copy())


def make_observer(
    kind: ObserverKind,
    period_s: float,
    velocity_steps: int,
    actuator: DelayedPDParameters,
    limits_rad: tuple[ArrayLike, ArrayLike],
    servo_model: JointArrays | None,
    joints: int = _JOINTS,
) -> Observer:
    """The observer of a stack, of the kinds of `policies.deploy.stacks.Stack`.

    Velocities of `readings` are over `velocity_steps` control periods, as the policy's contract
    says. `actuator` and the limits of the servos' angles, arrays of (12,), are those of a simulated
    servo; `servo_model` is needed for the kind of that name only.
    """
    if kind == "readings":
        return HeldEncoder(period_s, velocity_steps, joints)
    if kind == "synthetic-pd":
        return SyntheticPD(actuator, period_s, limits_rad=limits_rad, joints=joints)
    if kind == "published-pd":
        return SyntheticPD.paper(period_s, limits_rad)
    if kind == "rest":
        return Zero(period_s, joints)
    if servo_model is None:
        raise InputError(
            "This stack uses a servo model's prediction: give one with `servo` "
            "(`pupper-sysid fit-servo` makes one)."
        )
    return ServoModelObserver(servo_model, period_s)
