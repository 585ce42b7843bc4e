"""Comparison of a robot with the training of its policy: of its observer, and of its servos.

A policy has learned how far and how late its joints follow its targets. `compare` drives observer
and trained actuator with the same sines, at frequencies up to that of a gait, and finds where they
differ most. The paper's observer, for example, has a gain of three at 3 Hz, where the actuator of
its training has no resonance.

`servo_match` compares the servos themselves. Numbers that a recording in free air leaves open are
not compared: all torques of a servo may have a common factor, so stiffness, damping and effort
limit are taken per inertia, friction as the dead band it leaves. A number is outside if its whole
interval is outside of the training's range.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES, KINDS
from pupper_sysid.common.results import Result
from pupper_sysid.common.tones import fit_sine
from pupper_sysid.policies.deploy.stacks import Observer, SyntheticPD
from pupper_sysid.policies.network.policy_file import (
    Range,
    ServoFeedback,
    ServoNumbers,
    TrainedServo,
    joints_of,
)
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

Array = NDArray[np.float64]

FREQUENCIES_HZ = np.arange(2, 25) / 4
"""Frequencies of the comparison, up to the band of a gait [Hz]."""

AMPLITUDE_RAD = 0.15
"""Typical amplitude of a walking policy's targets; friction and limits depend on it [rad]."""

MOST_GAIN_ERROR = 0.25
"""Largest accepted deviation of the gain ratio from 1."""

MOST_PHASE_DEG = 20.0
"""Largest accepted phase difference: 9 ms at 6 Hz, about the uncertainty of a dead time."""

_SETTLE_S = 3.0
_WINDOW_S = 4.0
_STILL = 1e-9  # a gain below it has no phase


@dataclass(frozen=True)
class Match:
    """Frequency responses of an observer and of the trained actuator to their targets.

    Each is the swing of a joint over that of its target, shape (frequencies, 12); the angle is the
    phase. A target is held for its control period and the estimate is of the period's end, so the
    lag includes half a period of zero-order hold, as on the robot.
    """

    frequencies_hz: Array
    """Shape (frequencies,)."""
    observer: NDArray[np.complex128]
    actuator: NDArray[np.complex128]
    joints: tuple[str, ...] = JOINT_NAMES

    @property
    def gain_ratio(self) -> Array:
        """Gain of the observer over that of the actuator, shape (frequencies, 12)."""
        return np.abs(self.observer) / np.abs(self.actuator)

    @property
    def phase_difference_deg(self) -> Array:
        """Phase of the observer minus the actuator's, shape (frequencies, 12); later is negative.

        Unwrapped from the lowest frequency up, so that a long delay is not mistaken for an advance.
        """
        quotient = self.observer * self.actuator.conj()
        quotient = np.where(np.abs(self.observer) > _STILL, quotient, 1.0)
        return np.degrees(np.unwrap(np.angle(quotient), axis=0))

    @property
    def worst_gain_ratio(self) -> float:
        """The gain ratio that is farthest from 1."""
        return float(self.gain_ratio.flat[np.abs(self.gain_ratio - 1).argmax()])

    @property
    def worst_phase_difference_deg(self) -> float:
        """The phase difference that is farthest from 0."""
        phase = self.phase_difference_deg
        return float(phase.flat[np.abs(phase).argmax()])

    @property
    def fits(self) -> bool:
        """Whether both are within `MOST_GAIN_ERROR` and `MOST_PHASE_DEG`."""
        return (
            abs(self.worst_gain_ratio - 1) <= MOST_GAIN_ERROR
            and abs(self.worst_phase_difference_deg) <= MOST_PHASE_DEG
        )

    def sentence(self) -> str:
        """The worst frequency and both values there, as a sentence for the user."""
        gain_fits = abs(self.worst_gain_ratio - 1) <= MOST_GAIN_ERROR
        errors = np.abs(self.phase_difference_deg if gain_fits else self.gain_ratio - 1)
        i, j = map(int, np.unravel_index(errors.argmax(), errors.shape))
        alike = all(np.allclose(h[i], h[i, j], atol=0.01) for h in (self.observer, self.actuator))
        joints = "all joints" if alike else self.joints[j]
        if not gain_fits:
            estimated, trained = abs(self.observer[i, j]), abs(self.actuator[i, j])
            meaning = (
                "the policy would follow the observer's resonance instead of its legs"
                if estimated > trained
                else "the policy would not see how far its legs move"
            )
            return (
                f"The observer swings {estimated:#.2g} times as far as commanded at "
                f"{self.frequencies_hz[i]:.1f} Hz where the trained actuator swings "
                f"{trained:#.2g} times ({joints}): {meaning}. {_ADVICE}"
            )
        if not self.fits:
            phase = self.phase_difference_deg[i, j]
            late = -phase / 360 / self.frequencies_hz[i]
            return (
                f"The observer is {1e3 * abs(late):.0f} ms {'later' if late > 0 else 'earlier'} "
                f"than the trained actuator at {self.frequencies_hz[i]:.1f} Hz, {abs(phase):.0f}° "
                f"({joints}): the policy would time its steps by legs that are "
                f"elsewhere. {_ADVICE}"
            )
        return (
            f"The observer moves like the trained actuator from {self.frequencies_hz[0]:g} to "
            f"{self.frequencies_hz[-1]:g} Hz: gain ratio {self.worst_gain_ratio:.2f} and phase "
            f"{self.worst_phase_difference_deg:+.0f}° at worst."
        )

    def table(self) -> list[dict[str, str | float]]:
        """One row per kind of joint, or joint of another robot, and frequency: gain and phase."""
        rows: list[dict[str, str | float]] = []
        kinds = {name: [i] for i, name in enumerate(self.joints)}
        if self.joints == JOINT_NAMES:
            kinds = {kind: list(range(k, len(self.joints), 3)) for k, kind in enumerate(KINDS)}
        for kind, legs in kinds.items():
            observer, actuator = (h[:, legs].mean(axis=1) for h in (self.observer, self.actuator))
            phases = [np.degrees(np.unwrap(np.angle(h))) for h in (observer, actuator)]
            rows += [
                {
                    "joints": kind,
                    "frequency_hz": float(f),
                    "observer_gain": float(abs(observer[i])),
                    "actuator_gain": float(abs(actuator[i])),
                    "observer_phase_deg": float(phases[0][i]),
                    "actuator_phase_deg": float(phases[1][i]),
                }
                for i, f in enumerate(self.frequencies_hz)
            ]
        return rows


_ADVICE = (
    "Use an observer with the parameters that the policy was trained with, or train one with this "
    "robot's calibration."
)


def compare(
    observer: Observer,
    actuator: DelayedPDParameters,
    period_s: float,
    robot: DelayedPDParameters | None = None,
    pose: Mapping[str, float] = DEFAULT_POSE,
) -> Match:
    """Compare an observer with the actuator a policy was trained with.

    Its state changes: reset it before use. `actuator` (scalars or arrays of 12) is the middle of
    what the training drew from; the observer's readings are those of `robot`, by default the same.
    Joints swing about their default `pose` [rad] at the controller's period [s].

    Examples
    --------
    >>> trained = DelayedPDParameters(
    ...     stiffness=70.0, damping=1.2, friction_loss=0.03, armature=0.005, effort_limit=5.0,
    ...     velocity_limit=10.5, dead_time_s=0.076)
    >>> compare(SyntheticPD(trained, 0.02), trained, 0.02).fits
    True
    """
    targets = _sines(FREQUENCIES_HZ, AMPLITUDE_RAD, period_s, pose)
    count = len(pose)
    nothing = np.full_like(targets, np.nan)
    moved = _drive(SyntheticPD(actuator, period_s, joints=count), targets, nothing)
    readings = moved
    if robot is not None and robot is not actuator:
        readings = _drive(SyntheticPD(robot, period_s, joints=count), targets, nothing)
    seen = _drive(observer, targets, readings)
    estimated, trained = (
        _phasors(x, FREQUENCIES_HZ, period_s) / AMPLITUDE_RAD for x in (seen, moved)
    )
    return Match(FREQUENCIES_HZ.copy(), estimated, trained, tuple(pose))


def _sines(
    frequencies: Array,
    amplitude_rad: float,
    period_s: float,
    pose: Mapping[str, float] = DEFAULT_POSE,
) -> Array:
    """Targets [rad], shape (steps, frequencies, joints), at the start of each control period."""
    if not (np.all(frequencies > 0) and np.all(frequencies * period_s < 0.5)):
        raise InputError(
            f"The frequencies are {frequencies.min():g} … {frequencies.max():g} Hz; a controller "
            f"with a period of {period_s:g} s can only command between 0 and {0.5 / period_s:g} Hz."
        )
    span = _SETTLE_S + max(_WINDOW_S, 2 / frequencies.min())
    time = period_s * np.arange(int(np.ceil(span / period_s)))
    swing = amplitude_rad * np.sin(2 * np.pi * time[:, None] * frequencies)
    return swing[..., None] + np.array([*pose.values()])


def _drive(observer: Observer, targets: Array, readings: Array) -> Array:
    """Positions [rad] at the end of each control period, shape (steps, frequencies, 12)."""
    observer.reset(targets[0])
    return np.stack([observer.step(t, r).position for t, r in zip(targets, readings, strict=True)])


def _phasors(positions: Array, frequencies: Array, period_s: float) -> NDArray[np.complex128]:
    """Swing of each joint as a multiple of sin(2πft), shape (frequencies, 12) [rad]."""
    steps = len(positions)
    time = period_s * np.arange(1, steps + 1)
    window = steps * period_s - _SETTLE_S
    swings = []
    for i, f in enumerate(frequencies):
        cycles = np.floor(window * f + 1e-9)
        last = slice(steps - round(cycles / f / period_s), None)
        swings.append(1j * fit_sine(2 * np.pi * f * time[last], positions[last, i]).phasor)
    return np.array(swings)


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
        for outlier in self.outside:
            groups.setdefault(outlier.quantity, []).append(outlier)
        return [_sentence(quantity, outliers) for quantity, outliers in groups.items()]


def servo_match(trained: TrainedServo, servos: ServoRanges) -> ServoMatch | None:
    """Compare a robot's servos with those of a training.

    `servos` are those of the calibration of the robot at hand. None if the training's servos were a
    learned model, which has no numbers.
    """
    if trained.joints is None:
        return None
    outside: list[Outside] = []
    compared = 0
    for name, servo in joints_of(servos).items():
        for quantity, unit, factor, relative, number_of in _QUANTITIES:
            expected = number_of(trained.joints[name], trained.voltage_scale, trained.poll_scale)
            measured = number_of(servo, _NOTHING, _NOTHING)
            if expected is not None and measured is not None:
                compared += 1
                expected, measured = expected.times(factor), measured.times(factor)
                outside += _outside(quantity, unit, relative, name, expected, measured)
    jitter = 1e3 * servos.command_jitter_s
    measured, expected = Interval(jitter, jitter, jitter), trained.command_jitter_s.times(1e3)
    outside += _outside("command jitter", "ms", False, None, expected, measured)
    return ServoMatch(
        trained=trained.actuator, here=servos.source, compared=compared + 1, outside=tuple(outside)
    )


_SLACK = 1e-3  # of a number: less is of the digits that two files write


def _outside(
    quantity: str, unit: str, relative: bool, joint: str | None, trained: Interval, robot: Interval
) -> list[Outside]:
    low, high = trained.low, trained.high
    slack = _SLACK * max(abs(low), abs(high))
    if robot.low <= high + slack and robot.high >= low - slack:
        return []
    beyond = robot.value - (high if robot.low > high else low)
    return [
        Outside(
            quantity=quantity, unit=unit, joint=joint, trained_low=low, trained_high=high,
            here=robot, beyond=beyond, relative=relative,
        )
    ]  # fmt: skip


def _sentence(quantity: str, outliers: Sequence[Outside]) -> str:
    def distance(outlier: Outside) -> float:
        return abs(outlier.beyond) / max(abs(outlier.trained_low), abs(outlier.trained_high), 1e-12)

    worst = max(outliers, key=distance)
    joint = f" ({worst.joint})" if worst.joint else ""
    among = f", and {len(outliers) - 1} more joints differ" if len(outliers) > 1 else ""
    unit = f" {worst.unit}" if worst.unit else ""
    above = worst.beyond > 0
    end = worst.trained_high if above else worst.trained_low
    amount = f"{abs(worst.beyond):.3g}{unit} {'more' if above else 'less'} than in the training"
    if worst.relative and end > 0:
        most = "largest" if above else "smallest"
        amount = f"{worst.here.value / end:.2g} times the {most} of the training"
    return (
        f"{quantity.capitalize()}{joint}: {worst.here.value:.3g}{unit}, {amount} "
        f"({worst.trained_low:.3g} to {worst.trained_high:.3g}{unit}){among}."
    )


def _product(first: Range | Interval, second: Range) -> Interval:
    return Interval(first.value * second.value, first.low * second.low, first.high * second.high)


def _quotient(top: Range | Interval, bottom: Range | Interval) -> Interval | None:
    if not bottom.low > 0:
        return None
    return Interval(top.value / bottom.value, top.low / bottom.high, top.high / bottom.low)


def _top_speed(servo: ServoNumbers, voltage: Range) -> Interval:
    """Of the motor without load, or of the set-point, whichever is slower."""

    def speed(limit: float, effort: float, back_emf: float, scale: float) -> float:
        return scale * min(limit, effort / back_emf) if back_emf else scale * limit

    limit, effort, back = servo.velocity_limit, servo.effort_limit, servo.back_emf
    return Interval(
        speed(limit.value, effort.value, back.value, voltage.value),
        speed(limit.low, effort.low, back.high, voltage.low),
        speed(limit.high, effort.high, back.low, voltage.high),
    )


def _age(feedback: ServoFeedback, poll: Range) -> Interval:
    return poll.times(feedback.poll_period_s * (0.5 + feedback.loss / (1.0 - feedback.loss)))


Quantity = Callable[[ServoNumbers, Range, Range], Interval | None]
_QUANTITIES: tuple[tuple[str, str, float, bool, Quantity], ...] = (
    ("dead time", "ms", 1e3, False, lambda s, voltage, poll: s.dead_time_s.times(1.0)),
    (
        "stiffness per inertia", "1/s²", 1.0, True,
        lambda s, voltage, poll: _quotient(_product(s.stiffness, voltage), s.armature),
    ),
    (
        "damping per inertia", "1/s", 1.0, True,
        lambda s, voltage, poll: _quotient(s.damping, s.armature),
    ),
    (
        "effort limit per inertia", "rad/s²", 1.0, True,
        lambda s, voltage, poll: _quotient(_product(s.effort_limit, voltage), s.armature),
    ),
    (
        "dead band", "mrad", 1e3, False,
        lambda s, voltage, poll: _quotient(s.friction_loss, _product(s.stiffness, voltage)),
    ),
    ("top speed", "rad/s", 1.0, True, lambda s, voltage, poll: _top_speed(s, voltage)),
    ("mean age of readings", "ms", 1e3, False, lambda s, voltage, poll: _age(s.feedback, poll)),
    (
        "quantisation step", "mrad", 1e3, False,
        lambda s, voltage, poll: Interval(*[s.feedback.quantum_rad] * 3),
    ),
)  # fmt: skip
"""Name, unit, its factor on SI, whether differences are factors, and the number of a servo."""
