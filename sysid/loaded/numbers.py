"""What a fit under load says: its numbers, their intervals, and what the data leave open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.servo_models.loaded_servo import COLUMNS
from pupper_sysid.sysid.identify.posterior import STEPPING_SD_S
from pupper_sysid.sysid.loaded.kernel import OFFSET
from pupper_sysid.sysid.loaded.structures import Structure

_STEPPING_SHARE = 0.006
"""Relative error that physics steps leave, whatever the number of readings: standard deviation over
eight random emulated servos with other steps (world `pendulum` of `benchmarks/coverage.py`)."""

_SHARP_DEAD_TIME_S = 0.015


def numbers_of(structure: Structure, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """What a fit says, (draws,) each, under the names of `LoadedServoParameters`."""
    columns = structure.columns(values)
    fitted = set(structure.names)
    shown = {"dead_time_s": values[:, 0]}
    also = {"duty_per_rad", "stall_torque", "back_emf", "friction_loss"}
    also |= {"armature"} if structure.scales.known_load else set()
    also |= {"off_brake"} if structure.scales.torque_off else set()
    for column, name in (("stribeck_speed", "stribeck_speed_rad_s"), ("duty_s_per_rad", "damping"),
                         ("torque_limit", "torque_limit_share")):  # fmt: skip
        also |= {column} if name in fitted else set()
    for j, name in enumerate(COLUMNS):
        if name in also or name in fitted:
            shown[name] = columns[:, j]
    gain = structure.scales.p_gain
    shown["stiffness_nm_per_rad"] = columns[:, 0] * gain * columns[:, 2]
    shown["no_load_speed_rad_s"] = columns[:, 2] / columns[:, 3]
    if structure.scales.gravity:
        shown["gravity_nm"] = columns[:, OFFSET - 2]
    shown["hanging_rad"] = columns[:, OFFSET - 1]
    shown["offset_rad"] = columns[:, OFFSET]
    return shown


def why_unidentified(
    name: str, interval: Interval, draws: NDArray[np.float64], structure: Structure
) -> str | None:
    """Reason why the data leave a number open; None where they determine it."""
    if name in ("hanging_rad", "offset_rad"):
        return None
    if name == "dead_time_s" and interval.high - interval.low < _SHARP_DEAD_TIME_S:
        return None  # a short one may well be close to none
    if interval.low > 0 and interval.high > 4 * interval.low:
        return "its interval is wider than a factor of 4"
    if interval.low <= 0 and name not in ("off_brake",):
        return "it cannot be told from none"
    for p in structure.parameters:
        if p.name == name and p.logarithmic and np.std(np.log(draws)) > 0.7 * p.prior_sd:
            return "these recordings do not excite it; the value is the prior's"
    return None


def stepped(name: str, interval: Interval) -> Interval:
    """A torque, inertia or ratio with the error of a model that moves in steps."""
    if name in ("dead_time_s", "hanging_rad", "offset_rad") or interval.value <= 0:
        return interval
    grain = float(ndtri(0.5 + LEVEL / 2)) * _STEPPING_SHARE * interval.value
    low, high = interval.value - interval.low, interval.high - interval.value
    return Interval(
        interval.value,
        max(interval.value - float(np.hypot(low, grain)), 0.0),
        interval.value + float(np.hypot(high, grain)),
    )


def grained(interval: Interval, doubt_s: float) -> Interval:
    """A dead time with the error that physics steps and doubtful dates leave."""
    grain = float(ndtri(0.5 + LEVEL / 2)) * STEPPING_SD_S
    low = interval.value - float(np.hypot(interval.value - interval.low, grain)) - doubt_s
    high = interval.value + float(np.hypot(interval.high - interval.value, grain)) + doubt_s
    return Interval(interval.value, max(low, 0.0), high)
