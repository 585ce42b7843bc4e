"""The servos with which a policy was trained, as its file carries them.

A walk is learnt for servos with some gains, dead times and readings. So that another robot can be
compared with these long after the calibration has gone, the policy's contract holds them whole: the
identity of the actuator, and for each joint the plausible range of every number of the simulated
servo, the jitter of commands and the feedback, in full precision, with a schema version of its own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pupper_sysid.common.files import sha256
from pupper_sysid.servo_models.servo_file import WEIGHTS
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.differences import OF_UNIT
from pupper_sysid.sim.walking.servo_ranges import IDEAL, ServoRanges, is_servo_model

SERVO_SCHEMA, SERVO_VERSION = "pupper-policy-servo", 1

_Number = Annotated[float, Field(ge=0, le=1e9)]
_Seconds = Annotated[float, Field(ge=0, le=10)]
_Angle = Annotated[float, Field(ge=-2 * np.pi, le=2 * np.pi)]
_Sha = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Range(_Part):
    """Plausible range of a number."""

    low: _Number
    value: _Number
    high: _Number

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low <= self.value <= self.high:
            raise ValueError("low, value and high must not fall")
        return self


class DeadTimeRange(Range):
    """Plausible range of a dead time [s]."""

    low: _Seconds
    value: _Seconds
    high: _Seconds


class ServoFeedback(_Part):
    """Readings of one servo, see `servo_models.held_feedback`."""

    poll_period_s: _Seconds
    loss: Annotated[float, Field(ge=0, lt=1)]
    quantum_rad: Annotated[float, Field(ge=0, le=2 * np.pi)]
    offset_rad: _Angle


class ServoNumbers(_Part):
    """One servo: the numbers of `servo_models.delayed_pd`, and its readings."""

    stiffness: Range
    """Torque per angle [N·m/rad]."""
    damping: Range
    """Torque per speed [N·m s/rad]."""
    friction_loss: Range
    """Dry friction [N·m]."""
    armature: Range
    """Reflected inertia [kg m²]."""
    effort_limit: Range
    """Largest torque [N·m]."""
    velocity_limit: Range
    """Largest speed of the set-point [rad/s]."""
    back_emf: Range
    """Torque lost per speed [N·m s/rad]."""
    dead_time_s: DeadTimeRange
    feedback: ServoFeedback


class TrainedServo(_Part):
    """Servos of a training."""

    schema_name: Annotated[Literal["pupper-policy-servo"], Field(alias="schema")]
    schema_version: Literal[1]
    kind: Literal["calibration", "ideal", "learned"]
    """`learned`: a servo model predicted the positions, and there are no joints."""
    actuator: Annotated[str, Field(max_length=4096)]
    """Name of the calibration, preset or folder."""
    actuator_sha256: _Sha | None
    """Of the calibration, or of the learned model's weights; null for presets."""
    feedback: Annotated[str, Field(max_length=4096)]
    """`held`, `ideal` or the name of another calibration."""
    command_jitter_s: DeadTimeRange
    """Standard deviation of the latency of commands; 0 without."""
    torque_scale: Range
    """Factor on all torques and the armature, drawn for each robot."""
    voltage_scale: Range
    """Factor on stiffness, effort limit and speed limit, drawn for each robot."""
    poll_scale: Range
    """Factor on the poll period, drawn for each robot."""
    joints: dict[str, ServoNumbers] | None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.joints is None) != (self.kind == "learned"):
            raise ValueError("joints must be null if, and only if, kind is learned")
        return self

    @property
    def dead_times_s(self) -> tuple[float, float] | None:
        """Shortest and longest dead time; None of a learned model."""
        if self.joints is None:
            return None
        own = [joint.dead_time_s for joint in self.joints.values()]
        return min(r.low for r in own), max(r.high for r in own)


def trained_servo(actuator: str, feedback: str, task: Walking, servos: ServoRanges) -> TrainedServo:
    """The servos of a training, for its policy's file.

    Parameters
    ----------
    actuator, feedback : str
        As the run names them.
    task : Walking
        Of the training: what it draws is part of the ranges.
    servos : ServoRanges
    """
    source = Path(actuator)
    learned = is_servo_model(actuator)
    hashed = source / WEIGHTS if learned else source
    differences, torque = task.differences, task.randomisation.torque_scale
    jitter = servos.command_jitter_s
    return TrainedServo.model_validate(
        {
            "schema": SERVO_SCHEMA, "schema_version": SERVO_VERSION,
            "kind": "learned" if learned else "ideal" if actuator == IDEAL else "calibration",
            "actuator": source.name if source.exists() else actuator,
            "actuator_sha256": sha256(hashed) if hashed.is_file() else None,
            "feedback": Path(feedback).name if Path(feedback).exists() else feedback,
            "command_jitter_s": _scaled(jitter, differences.command_jitter),
            "torque_scale": _scaled(1.0, torque),
            "voltage_scale": _scaled(1.0, differences.battery),
            "poll_scale": _scaled(1.0, differences.poll_period),
            "joints": None if learned else joints_of(servos, differences.servo_spread),
        }
    )  # fmt: skip


def joints_of(servos: ServoRanges, spread: float = 0.0) -> dict[str, ServoNumbers]:
    """The numbers of each joint's servo, wider by a share `spread` where units differ."""
    return {name: _numbers(servos, i, spread) for i, name in enumerate(servos.joints)}


def _numbers(servos: ServoRanges, joint: int, spread: float) -> ServoNumbers:
    factors = {"low": 1.0 - spread, "value": 1.0, "high": 1.0 + spread}
    ranges = {
        field: {
            k: float(getattr(servos, k)[field][joint] * (factor if field in OF_UNIT else 1.0))
            for k, factor in factors.items()
        }
        for field in servos.value
    }
    own = servos.feedback[joint]
    feedback = {
        "poll_period_s": float(own.poll_period_s), "loss": float(own.loss),
        "quantum_rad": float(own.quantum_rad), "offset_rad": float(own.offset_rad),
    }  # fmt: skip
    return ServoNumbers.model_validate({**ranges, "feedback": feedback})


def _scaled(value: float, ends: tuple[float, float]) -> dict[str, float]:
    """A range around a value, which is one end if it is outside."""
    low, high = (float(value * end) for end in ends)
    return {"low": low, "value": float(min(max(value, low), high)), "high": high}
