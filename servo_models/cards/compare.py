"""Two servos number by number, whatever states them: cards, calibrations, presets, BAM's files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import Result, derived
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S, PARAMETER_KEYS
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.cards.files import is_card, load_card
from pupper_sysid.servo_models.cards.numbers import TorquePD, unit


@dataclass(frozen=True)
class Servo(Result):
    """One servo as a PD in torque, and where it comes from."""

    name: str
    """Card, file or preset."""
    part: str | None
    """Joint or specimen, or None where there is only one."""
    p_gain: float | None
    """P gain at which the numbers hold, where it is known."""
    supply_v: float | None
    """Supply voltage [V], where it is known."""
    pd: TorquePD
    """The numbers."""


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

    @derived
    def ratio(self) -> float | None:
        """Second over first; None where one is missing or 0."""
        one, other = (0.0 if q is None else q.value for q in (self.first, self.second))
        return other / one if one and other else None

    @property
    def distance(self) -> float:
        """Size of the difference: |log ratio|."""
        return abs(math.log(self.ratio)) if self.ratio else 0.0


def servo_of(path_or_name: str, part: str | None = None, p_gain: float | None = None) -> Servo:
    """One servo of a card, a calibration file, a preset or a parameter file of BAM.

    Parameters
    ----------
    path_or_name : str
    part : str, optional
        Joint of a calibration or specimen of a card; by default the first of the one, the default
        of the other.
    p_gain : float, optional
        P gain, for a card of a position loop.

    Raises
    ------
    InputError
        If it cannot be read, or has no such joint.
    """
    name = Path(path_or_name).name
    if is_card(path_or_name):
        card = load_card(path_or_name)
        several = len(card.specimens) > 1
        own = part if part in card.specimens else card.default
        gain = card.gains.p if p_gain is None else p_gain
        return Servo(name, own if several else None, gain, card.supply_v, card.pd(own, p_gain))
    if p_gain is not None and Path(path_or_name).suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"`p_gain` is for servo cards; {path_or_name} is none.")
    calibration = load_calibration(path_or_name)
    joint = part or calibration.joint_names[0]
    actuator = calibration.joint(joint).actuator
    keys = [key for key in PARAMETER_KEYS.values() if key in TorquePD.model_fields]
    numbers = {key: getattr(actuator, key) for key in keys}
    if numbers["velocity_limit_rad_s"].value >= NO_SPEED_LIMIT_RAD_S:
        numbers["velocity_limit_rad_s"] = None
    return Servo(name, joint, None, None, TorquePD(model="delayed_pd", **numbers))


def differences(first: Servo, second: Servo) -> list[Difference]:
    """Every number of two servos side by side, in the order of `TorquePD`, and their top speed."""
    found = []
    for key in TorquePD.model_fields:
        one, other = (getattr(s.pd, key) for s in (first, second))
        if key != "model" and not (one is None and other is None):
            found.append(Difference(_TITLES[key], unit(key), one, other))
    speeds = [_quantity(s.pd.top_speed_rad_s) for s in (first, second)]
    return [*found, Difference("top speed", "rad/s", *speeds)]


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
