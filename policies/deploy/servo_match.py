"""Comparison of a robot's servos with those a policy was trained for.

Numbers that a recording in free air leaves open are not compared: all torques of a servo may have a
common factor, so stiffness, damping and effort limit are taken per inertia, friction as the dead
band it leaves. A number is outside if its whole interval is outside of the training's range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result
from pupper_sysid.policies.network.policy_file import Range, ServoNumbers, TrainedServo, joints_of
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

_NOTHING = Range(low=1.0, value=1.0, high=1.0)


@dataclass(frozen=True, kw_only=True)
class Outside(Result):
    """One number of one servo that is outside of the training's range."""

    quantity: str
    unit: str
    joint: str | None
    """None for what all servos share."""
    trained_low: float
    trained_high: float
    here: Interval
    """Of the robot at hand."""
    beyond: float
    """Value minus the nearest end of the training's range."""
    relative: bool
    """Whether to speak of it as a factor."""

    def amount(self) -> str:
        """By how much it is outside, in words."""
        unit = f" {self.unit}" if self.unit else ""
        end = self.trained_high if self.beyond > 0 else self.trained_low
        if self.relative and end > 0:
            most = "largest" if self.beyond > 0 else "smallest"
            return f"{self.here.value / end:.2g} times the {most} of the training"
        more = "more" if self.beyond > 0 else "less"
        return f"{abs(self.beyond):.3g}{unit} {more} than in the training"


@dataclass(frozen=True, kw_only=True)
class ServoMatch(Result):
    """A robot's servos beside those of a training."""

    trained: str
    """Name of the training's actuator."""
    here: str
    """Name of the calibration of the robot at hand."""
    compared: int
    """How many numbers were compared."""
    outside: tuple[Outside, ...]

    def sentences(self) -> list[str]:
        """One sentence per quantity that is outside, or one that none is."""
        if not self.outside:
            return [
                f"The servos of {self.here} are within the ranges that the policy was trained for "
                f"({self.trained}; {self.compared} numbers compared)."
            ]
        groups: dict[str, list[Outside]] = {}
        for one in self.outside:
            groups.setdefault(one.quantity, []).append(one)
        return [_sentence(quantity, own) for quantity, own in groups.items()]


def servo_match(trained: TrainedServo, here: ServoRanges) -> ServoMatch | None:
    """Compare a robot's servos with those of a training.

    `here` are those of the calibration of the robot at hand. None if the training's servos were a
    learned model, which has no numbers.
    """
    if trained.joints is None:
        return None
    outside: list[Outside] = []
    compared = 0
    for name, own in joints_of(here).items():
        for quantity, unit, relative, of in _QUANTITIES:
            expected = of(trained.joints[name], trained.voltage_scale, trained.poll_scale)
            found = of(own, _NOTHING, _NOTHING)
            if expected is not None and found is not None:
                compared += 1
                outside += _outside(quantity, unit, relative, name, expected, found)
    jitter = 1e3 * here.command_jitter_s
    found, expected = Interval(jitter, jitter, jitter), _times(trained.command_jitter_s, 1e3)
    outside += _outside("command jitter", "ms", False, None, expected, found)
    return ServoMatch(
        trained=trained.actuator, here=here.source, compared=compared + 1, outside=tuple(outside)
    )


_SLACK = 1e-3  # of a number: less is of the digits that two files write


def _outside(
    quantity: str, unit: str, relative: bool, joint: str | None, trained: Interval, here: Interval
) -> list[Outside]:
    low, high = trained.low, trained.high
    slack = _SLACK * max(abs(low), abs(high))
    if here.low <= high + slack and here.high >= low - slack:
        return []
    beyond = here.value - (high if here.low > high else low)
    return [
        Outside(
            quantity=quantity, unit=unit, joint=joint, trained_low=low, trained_high=high,
            here=here, beyond=beyond, relative=relative,
        )
    ]  # fmt: skip


def _sentence(quantity: str, own: Sequence[Outside]) -> str:

    def distance(one: Outside) -> float:
        return abs(one.beyond) / max(abs(one.trained_low), abs(one.trained_high), 1e-12)

    worst = max(own, key=distance)
    joint = f" ({worst.joint})" if worst.joint else ""
    among = f", and {len(own) - 1} more joints differ" if len(own) > 1 else ""
    unit = f" {worst.unit}" if worst.unit else ""
    return (
        f"{quantity.capitalize()}{joint}: {worst.here.value:.3g}{unit}, {worst.amount()} "
        f"({worst.trained_low:.3g} to {worst.trained_high:.3g}{unit}){among}."
    )


# ---------------------------------------------------------------------------------- quantities


def _dead_time(own: ServoNumbers, voltage: Range, poll: Range) -> Interval:
    return _times(own.dead_time_s, 1e3)


def _per_inertia(field: str, with_voltage: bool) -> Quantity:
    def of(own: ServoNumbers, voltage: Range, poll: Range) -> Interval | None:
        top, inertia = getattr(own, field), own.armature
        scale = voltage if with_voltage else _NOTHING
        if not inertia.low > 0:
            return None
        return Interval(
            top.value * scale.value / inertia.value,
            top.low * scale.low / inertia.high,
            top.high * scale.high / inertia.low,
        )

    return of


def _dead_band(own: ServoNumbers, voltage: Range, poll: Range) -> Interval | None:
    friction, stiff = own.friction_loss, own.stiffness
    if not stiff.low * voltage.low > 0:
        return None
    return Interval(
        1e3 * friction.value / (stiff.value * voltage.value),
        1e3 * friction.low / (stiff.high * voltage.high),
        1e3 * friction.high / (stiff.low * voltage.low),
    )


def _top_speed(own: ServoNumbers, voltage: Range, poll: Range) -> Interval:
    """Of the motor without load, or of the set-point, whichever is slower."""

    def speed(limit: float, effort: float, back_emf: float, scale: float) -> float:
        return scale * min(limit, effort / back_emf) if back_emf else scale * limit

    limit, effort, back = own.velocity_limit, own.effort_limit, own.back_emf
    return Interval(
        speed(limit.value, effort.value, back.value, voltage.value),
        speed(limit.low, effort.low, back.high, voltage.low),
        speed(limit.high, effort.high, back.low, voltage.high),
    )


def _age(own: ServoNumbers, voltage: Range, poll: Range) -> Interval:
    feedback = own.feedback
    periods = 0.5 + feedback.loss / (1.0 - feedback.loss)
    return _times(poll, 1e3 * feedback.poll_period_s * periods)


def _quantum(own: ServoNumbers, voltage: Range, poll: Range) -> Interval:
    step = 1e3 * own.feedback.quantum_rad
    return Interval(step, step, step)


def _times(own: Range, factor: float) -> Interval:
    return Interval(factor * own.value, factor * own.low, factor * own.high)


Quantity = Callable[[ServoNumbers, Range, Range], Interval | None]
_QUANTITIES: tuple[tuple[str, str, bool, Quantity], ...] = (
    ("dead time", "ms", False, _dead_time),
    ("stiffness per inertia", "1/s²", True, _per_inertia("stiffness", True)),
    ("damping per inertia", "1/s", True, _per_inertia("damping", False)),
    ("effort limit per inertia", "rad/s²", True, _per_inertia("effort_limit", True)),
    ("dead band", "mrad", False, _dead_band),
    ("top speed", "rad/s", True, _top_speed),
    ("mean age of readings", "ms", False, _age),
    ("quantisation step", "mrad", False, _quantum),
)
"""Name, unit, whether differences are factors, and the number of a servo in that unit."""
