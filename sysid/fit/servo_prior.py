"""What a calibration or a servo card says of another unit of the servo: a prior for its fit.

Units of one servo differ by little, so numbers of one narrow what a short recording of another has
to tell. Positions in free air tell torques per inertia, and the joint's link is a part of the
inertia: all torques per inertia are larger or smaller together by a factor that the card does not
know, while their ratios are the servo's. So the prior is a normal distribution of logarithms: each
number has a spread of its own, and those of `PER_INERTIA` one in common.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import HALF_WIDTH_SD
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S, JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.cards.numbers import UNSTATED

PER_INERTIA = ("stiffness_per_s2", "damping_per_s", "friction_rad_s2", "effort_rad_s2")
"""Numbers of a fit that an unknown inertia divides."""

_AT_GAIN = ("stiffness_per_s2", "damping_per_s", "stiffness", "damping")
UNIT_SD = 0.15
"""Of the logarithm of a number, between units: a tenth in stall torques and speeds of one batch of
hobby servos (the default spread in training), more between batches. With 20 s of one joint of an
SO-101 and the four others as the prior, errors on a chirp are 0.71 to 1.05 of those with 60 s."""
_DEAD_TIME_SD = 0.3  # the bus and the host are a part of the dead time, and another robot's
_GAIN_SD = 0.5  # of stiffness and damping where the P gain of one of the two is not known
_DOUBTED_SD = 0.3  # of a number whose interval is not to be trusted: the model does not describe it
_LINK_SD = 0.7  # a link of the armature's inertia halves all torques per inertia
_WEIGHT = 4.0  # joints that each of these spreads counts as, beside those of the calibration


@dataclass(frozen=True)
class ServoPrior:
    """A normal distribution of the logarithms of a servo's numbers.

    Attributes
    ----------
    source : str
        File or card that it comes from.
    logarithms : mapping of str to (float, float)
        Mean and standard deviation by the name of a fitted number, per inertia and in N·m.
    shared_sd : float
        Standard deviation of what the logarithms of `PER_INERTIA` have in common.
    effort_limit_nm : float, optional
        Of that unit: the scale of the torques, where the recording does not name its servo.
    """

    source: str
    logarithms: Mapping[str, tuple[float, float]]
    shared_sd: float
    effort_limit_nm: float | None = None


def servo_prior(
    calibration: Calibration, source: str, joint: str, p_gain: float | None
) -> ServoPrior:
    """The prior of a joint from the same joint of a calibration, or else from all joints of it.

    `calibration`: of another unit, or a servo card. `source`: its name in messages. `joint`: joint
    to be fitted. `p_gain`: P gain at which that was recorded; None if not known. Raises InputError
    if the calibration has no joint with numbers that are known.
    """
    every = calibration.joints
    units = [every[joint]] if joint in every else list(every.values())
    rows = [dict(_logarithms(unit, p_gain)) for unit in units]
    rows = [row for row in rows if row]
    if not rows:
        raise InputError(
            f"{source} has no number with an interval, so it says nothing of another unit. "
            "Name a calibration of measured servos or a servo card."
        )
    links = _links(rows)
    names = dict.fromkeys(name for row in rows for name in row)
    logarithms = {}
    for name in names:
        other_units = [
            (row[name][0] - (link if name in PER_INERTIA else 0.0), row[name][1])
            for row, link in zip(rows, links, strict=True)
            if name in row
        ]
        spread = _DEAD_TIME_SD if name == "dead_time_s" else UNIT_SD
        logarithms[name] = _pooled(other_units, spread)
    shared = math.sqrt((_LINK_SD**2 * _WEIGHT + sum(x * x for x in links)) / (
        _WEIGHT + len(links) - 1
    ))  # fmt: skip
    torque = median(unit.actuator.effort_limit_nm.value for unit in units)
    return ServoPrior(source, logarithms, shared, torque)


def _logarithms(
    unit: JointCalibration, p_gain: float | None
) -> Iterator[tuple[str, tuple[float, float]]]:
    """Logarithm of each known number of one joint, and its standard deviation."""
    actuator, ratios, point = unit.actuator, unit.actuator.ratios_to_armature, unit.operating_point
    numbers = {n: q for n, q in actuator.per_inertia.items() if n != "back_emf_per_s"} | {
        "stiffness": actuator.stiffness_nm_per_rad, "damping": actuator.damping_nm_s_per_rad,
        "friction_loss": actuator.friction_loss_nm,
    }  # fmt: skip
    if actuator.scale.anchor != "stall torque":  # else it is an assumption of that fit
        numbers["stall_torque"] = actuator.effort_limit_nm
    if point is not None and point.armature == "servo":
        numbers["armature"] = actuator.armature_kg_m2
    if ratios.back_emf.value > 0 and _known(ratios.back_emf):
        speed = math.log(ratios.effort_limit.value / ratios.back_emf.value)
        yield "no_load_speed_rad_s", (speed, _sd(ratios.back_emf))
    gain = None if point is None else point.p_gain
    scale = None if gain is None or p_gain is None else p_gain / gain
    for name, quantity in numbers.items():
        limitless = name == "velocity_limit_rad_s" and quantity.value >= NO_SPEED_LIMIT_RAD_S
        if not quantity.value > 0 or limitless or not _known(quantity):
            continue
        mean, sd = math.log(quantity.value), _sd(quantity)
        if name in _AT_GAIN:
            mean, sd = (
                (mean, math.hypot(sd, _GAIN_SD)) if scale is None else (mean + math.log(scale), sd)
            )
        yield name, (mean, sd)


def _known(quantity: Quantity) -> bool:
    """Whether a number says anything: measured with an interval, or cited without one."""
    measured = quantity.low is not None and quantity.high is not None
    return quantity.why == UNSTATED or (measured and quantity.high != quantity.low)


def _sd(quantity: Quantity) -> float:
    if quantity.low is None or quantity.high is None or quantity.low <= 0:
        return 0.0
    sd = math.log(quantity.high / quantity.low) / (2 * HALF_WIDTH_SD)
    return math.hypot(sd, _DOUBTED_SD) if quantity.identified == "no" else sd


def _links(rows: Sequence[Mapping[str, tuple[float, float]]]) -> list[float]:
    """What the torques per inertia of each joint have in common, about their mean over joints."""
    mean = {
        name: _pooled([row[name] for row in rows if name in row], _LINK_SD)[0]
        for name in PER_INERTIA
        if any(name in row for row in rows)
    }
    links = []
    for row in rows:
        apart = [row[name][0] - mean[name] for name in mean if name in row]
        links.append(sum(apart) / len(apart) if apart else 0.0)
    return links


def _pooled(numbers: Sequence[tuple[float, float]], spread: float) -> tuple[float, float]:
    """Mean over units and the standard deviation of another unit about it.

    The variance between units is that of the numbers, shrunk toward `spread` squared.
    """
    weights = [1.0 / (sd**2 + spread**2) for _, sd in numbers]
    mean = sum(w * x for w, (x, _) in zip(weights, numbers, strict=True)) / sum(weights)
    between = sum(max((x - mean) ** 2 - sd**2, 0.0) for x, sd in numbers)
    variance = (_WEIGHT * spread**2 + between) / (_WEIGHT + len(numbers) - 1)
    return mean, math.sqrt(variance + 1.0 / sum(weights))
