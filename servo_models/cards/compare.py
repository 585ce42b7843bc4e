"""Two servos number by number, whatever states them: cards, calibrations, presets, BAM's files."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import Result, derived
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.calibration.parts import (
    ARMATURES,
    NO_SPEED_LIMIT_RAD_S,
    PARAMETER_KEYS,
    Armature,
)
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.cards.card import ServoCard
from pupper_sysid.servo_models.cards.files import card_names, is_card, load_card
from pupper_sysid.servo_models.cards.numbers import PositionLoop, TorquePD, unit
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.step_size import lag_of_steps, tones_in_steps_of


@dataclass(frozen=True)
class Servo(Result):
    """One servo as a PD in torque, and where it comes from."""

    name: str
    """Card, file or preset."""
    part: str | None
    """Joint or specimen, or None where there is only one."""
    p_gain: float | None
    """P gain at which the numbers hold, where it is known."""
    any_gain: bool
    """Whether the numbers follow for any P gain; otherwise they hold at their own."""
    armature: Armature
    """What the armature includes."""
    supply_v: float | None
    """Supply voltage [V], where it is known."""
    pd: TorquePD
    """The numbers."""
    link_kg_m2: float = 0.0
    """Inertia of link and load beside the armature, where it is known [kg·m²]."""
    notes: tuple[str, ...] = ()
    """Reasons for distrust, in sentences."""
    as_it_stands: bool = False
    """Whether a simulator's file states the numbers, which are compared as they are."""
    assumed: tuple[str, ...] = ()
    """Keys of `pd` that stand for what the file does not state: they move, and are not compared."""

    @property
    def parameters(self) -> DelayedPDParameters:
        """What moves: the servo with its link."""
        return replace(self.pd.parameters, armature=self.pd.armature_kg_m2.value + self.link_kg_m2)

    @property
    def title(self) -> str:
        """Name and part."""
        return self.name if self.part is None else f"{self.name} {self.part}"


@dataclass(frozen=True)
class Difference(Result):
    """One number of two servos."""

    quantity: str
    """Its name in words."""
    unit: str
    """Its unit."""
    first: Quantity | None
    """Of the first; None where it states none."""
    second: Quantity | None
    """Of the second."""
    comparable: bool = True
    """Whether both mean the same; otherwise there is no ratio."""

    @derived
    def ratio(self) -> float | None:
        """Second over first; None where one is missing or 0, or they are not comparable."""
        first, second = (0.0 if q is None else q.value for q in (self.first, self.second))
        return second / first if first and second and self.comparable else None

    @property
    def distance(self) -> float:
        """Size of the difference: |log ratio|."""
        return abs(math.log(self.ratio)) if self.ratio else 0.0


@dataclass(frozen=True)
class Motion(Result):
    """How two servos move on the same commands: tones of 1, 2 and 4 Hz, 0.2 rad, in free air."""

    first_lag_s: float | None
    """Lag of the first, dead time included, mean over the tones [s]; None if it is not stable."""
    second_lag_s: float | None
    """Of the second."""
    apart_rad: float | None
    """RMS difference of their positions [rad]."""


@dataclass(frozen=True)
class Comparison(Result):
    """Two servos at one P gain, as far as both know theirs."""

    first: Servo
    second: Servo
    differences: tuple[Difference, ...]
    p_gain: float | None
    """Of both; None where they could not be brought to one."""
    motion: Motion
    notes: tuple[str, ...]
    """What is compared at which gain, and what is not comparable, in sentences."""


def servo_of(path_or_name: str, part: str | None = None, p_gain: float | None = None) -> Servo:
    """One servo of a card, a calibration file, a preset or a parameter file of BAM.

    `part` is a joint of a calibration or specimen of a card; by default the first of the one, the
    default of the other. `p_gain` is another P gain than the numbers' own.
    """
    name = Path(path_or_name).name
    if is_card(path_or_name):
        card = load_card(path_or_name)
        specimen = part if part in card.specimens else card.default
        return Servo(
            name, specimen if len(card.specimens) > 1 else None,
            card.gains.p if p_gain is None else p_gain,
            not isinstance(card.specimens[specimen], TorquePD), card.armature, card.supply_v,
            card.pd(specimen, p_gain), notes=implausible(card, specimen),
        )  # fmt: skip
    calibration = load_calibration(path_or_name)
    part = part or calibration.joint_names[0]
    joint = calibration.joint(part)
    if p_gain is not None and p_gain != joint.holds_at.p_gain:
        if joint.servo is None:
            raise InputError(
                f"`p_gain`: {path_or_name} holds at {joint.holds_at.gain_text} only, so there are "
                "no numbers for another. Leave `p_gain` out."
            )
        joint = joint.at_p_gain(p_gain)
    actuator, point = joint.actuator, joint.holds_at
    keys = [key for key in PARAMETER_KEYS.values() if key in TorquePD.model_fields]
    numbers = {key: getattr(actuator, key) for key in keys}
    if numbers["velocity_limit_rad_s"].value >= NO_SPEED_LIMIT_RAD_S:
        numbers["velocity_limit_rad_s"] = None
    pd = TorquePD(model="delayed_pd", **numbers)
    any_gain = joint.servo is not None and point.p_gain is not None
    return Servo(name, part, point.p_gain, any_gain, point.armature, None, pd)


def compared(
    first: str,
    second: str,
    part: str | None = None,
    p_gain: float | None = None,
    read: Callable[[str, str | None, float | None], Servo] = servo_of,
) -> Comparison:
    """Two servos at equal P gain, number by number, read by name or file with `read`.

    The gain is `p_gain`; else that of a servo whose numbers hold at no other; else the first's own.
    Where one does not state its gain, or two fixed ones differ, each stays as it is, and numbers
    that depend on the gain are not compared.
    """
    names, notes = (first, second), []
    servos = [read(name, part, None) for name in names]
    fixed = [s.p_gain for s in servos if not s.any_gain]
    common = p_gain
    if common is None and all(s.p_gain is not None for s in servos) and len(set(fixed)) < 2:
        common = fixed[0] if fixed else servos[0].p_gain
    if common is not None:
        for n, (name, servo) in enumerate(zip(names, servos, strict=True)):
            if servo.any_gain or servo.p_gain is not None:
                servos[n] = read(name, part, common)
    one, other = servos
    equal = one.p_gain is not None and one.p_gain == other.p_gain
    file = next((s for s in servos if s.as_it_stands), None)
    if equal:
        notes.append(f"Both at P gain {one.p_gain:g}.")
    elif file is not None:
        gains = ", ".join(f"{s.title}: {_gain(s)}" for s in servos if not s.as_it_stands)
        notes.append(
            f"{file.title} is compared as it stands" + (f" (P gain of {gains})." if gains else ".")
        )
    else:
        stated = "; ".join(f"{s.title}: {_gain(s)}" for s in servos)
        notes.append(f"Not at one P gain ({stated}), so stiffness and damping are not compared.")
    alike = one.armature == other.armature
    if not alike:
        stated = "; ".join(f"{s.title}: {ARMATURES[s.armature]}" for s in servos)
        notes.append(f"The armatures differ in what they include ({stated}); not compared.")
        arm, bare = (one, other) if other.armature == "servo" else (other, one)
        inertia, least = (s.pd.armature_kg_m2.value for s in (arm, bare))
        # a configuration's number may be this one, rounded
        largest = max(arm.pd.armature_kg_m2.high or 0.0, 1.02 * inertia)
        if largest < least + bare.link_kg_m2:
            notes.append(
                f"{arm.title}: an arm cannot have less inertia than its servo; {inertia:.3g} kg·m² "
                f"with the link are less than {least + bare.link_kg_m2:.3g} of {bare.title}. One "
                "of their torque scales is wrong."
            )
    notes += [note for servo in servos for note in servo.notes]
    not_comparable = (set() if equal or file else _AT_GAIN) | (set() if alike else {"armature"})
    return Comparison(
        one, other,
        tuple(
            replace(d, comparable=d.quantity not in not_comparable)
            for d in differences(one, other)
        ),
        one.p_gain if equal else None, motion_of(one, other), tuple(dict.fromkeys(notes)),
    )  # fmt: skip


def motion_of(first: Servo, second: Servo) -> Motion:
    """How two servos move on the same tones, each with the link that it is known to move."""
    time = TIME_STEP_S * np.arange(round(1.0 / TIME_STEP_S))
    tones = 0.2 * np.sin(2 * np.pi * np.outer((1.0, 2.0, 4.0), time))
    lags, moved = [], []
    for servo in (first, second):
        parameters = servo.parameters
        (more,) = lag_of_steps(parameters, TIME_STEP_S)
        (lag,), _ = tones_in_steps_of(parameters, TIME_STEP_S)
        stable = bool(np.isfinite(more) and np.isfinite(lag))
        lags.append(float(lag + parameters.dead_time_s) if stable else None)
        model = DelayedPD(parameters)
        model.reset(np.zeros(len(tones)))
        moved.append(model.rollout(tones.T))
    apart = rms(moved[0] - moved[1])
    return Motion(lags[0], lags[1], apart if np.isfinite(apart) else None)


def implausible(card: ServoCard, specimen: str | None = None) -> tuple[str, ...]:
    """What in a card contradicts the other cards of that servo, in sentences.

    An armature that holds link and load must be larger than that of motor and gears alone, the
    least of the cards that state it.
    """
    if card.armature != "servo and load":
        return ()
    names = [specimen] if specimen else list(card.specimens)
    bare = {
        name: candidate.pd().armature_kg_m2.value
        for name in card_names()
        if (candidate := load_card(name)).servo == card.servo and candidate.armature == "servo"
        if isinstance(candidate.numbers, PositionLoop)
    }
    if not bare:
        return ()
    least = min(bare, key=lambda name: bare[name])
    below = [n for n in names if card.pd(n).armature_kg_m2.value < bare[least]]
    if not below:
        return ()
    return (
        f"{card.name}, {', '.join(below)}: an arm cannot have less inertia than its servo, whose "
        f"motor and gears alone have {bare[least]:.3g} kg·m² ({least}). The torque scale is "
        "implausible: use ratios and times of this card, not its torques.",
    )


_AT_GAIN = {"stiffness", "damping"}


def _gain(servo: Servo) -> str:
    return "not stated" if servo.p_gain is None else f"P {servo.p_gain:g}"


def differences(first: Servo, second: Servo) -> list[Difference]:
    """Every number of two servos side by side, in the order of `TorquePD`, and their top speed."""
    rows, servos = [], (first, second)
    for key in TorquePD.model_fields:
        one, other = (None if key in s.assumed else getattr(s.pd, key) for s in servos)
        if key != "model" and not (one is None and other is None):
            rows.append(Difference(_TITLES[key], unit(key), one, other))
    one, other = (
        s.pd.velocity_limit_rad_s if "effort_limit_nm" in s.assumed
        else _quantity(s.pd.top_speed_rad_s)
        for s in servos
    )  # fmt: skip
    rows.append(Difference("top speed", "rad/s", one, other))
    if first.link_kg_m2 or second.link_kg_m2:
        one, other = (
            _quantity(
                None if "armature_kg_m2" in s.assumed else s.pd.armature_kg_m2.value + s.link_kg_m2
            )
            for s in servos
        )
        rows.append(Difference("armature and link", "kg·m²", one, other))
    return rows


_TITLES = {
    "stiffness_nm_per_rad": "stiffness",
    "damping_nm_s_per_rad": "damping",
    "friction_loss_nm": "dry friction",
    "armature_kg_m2": "armature",
    "effort_limit_nm": "effort limit",
    "velocity_limit_rad_s": "set-point speed",
    "back_emf_nm_s_per_rad": "back-EMF",
    "dead_time_s": "dead time",
}


def _quantity(value: float | None) -> Quantity | None:
    if value is None:
        return None
    return Quantity(value=value, identified="no", why="follows from the numbers above")
