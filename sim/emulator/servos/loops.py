"""Position loops of emulated servos: what their registers mean for the motion, by model.

A `PendulumServo` runs such a loop each millisecond. The defaults of a bench (`BenchSpec`) go with
the model: torque, speed and factory gains of its data sheet; dead time, armature and friction to
the accuracy to which published models of such servos agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pupper_sysid.hardware.dynamixel.registers import SERIES, profile

FEETECH_REGISTERS = {
    "p": 32, "d": 32, "i": 0, "min_start_force": 16, "dead_zone_cw": 1, "dead_zone_ccw": 1,
    "acceleration": 0, "goal_speed": 0, "torque_limit": 1000, "max_torque": 1000,
}  # fmt: skip
"""Registers that act on the motion, as an STS3215 leaves the factory (`i` does not act here)."""

ACCELERATION_UNIT = 100
"""Counts/s² per unit of Feetech's register acceleration."""

DYNAMIXEL_GAINS = {
    "XL330-M288": (400, 0, 0), "XL330-M077": (400, 0, 0), "XC330-M288": (400, 0, 0),
    "XL430-W250": (640, 0, 4000), "XM430-W210": (800, 0, 0), "XM430-W350": (800, 0, 0),
    "MX-28": (850, 0, 0), "MX-64": (850, 0, 0), "MX-106": (850, 0, 0), "XH430-W350": (900, 0, 0),
}  # fmt: skip
"""Position P, I and D gain as a servo leaves the factory (Robotis e-Manual)."""

_TICK_S = 0.001
_FULL_PWM = 885
_CURRENT_BASED = 5


@dataclass(frozen=True)
class Loop:
    """Constants of a position loop."""

    p: float
    """Duty per radian of error."""
    d: float
    """Duty per speed [s/rad]."""
    least: float
    """Smallest duty outside the dead zone."""
    most: float
    """Largest duty."""
    zone_cw: int = 0
    """Dead zone [counts]."""
    zone_ccw: int = 0
    top_speed_rad_s: float = math.inf
    """Of the set-point's ramp."""
    top_acceleration_rad_s2: float = math.inf


def feetech_loop(registers: Mapping[str, int], servo: Any) -> Loop:
    """Loop of an STS servo: gains per radian, ramps in counts."""
    count = servo.count_rad or math.tau / 4096
    return Loop(
        servo.duty_per_rad * registers["p"],
        servo.duty_per_rad * registers["d"] * servo.d_time_s,
        registers["min_start_force"] / 1000 if servo.count_rad else 0.0,
        min(registers["torque_limit"], registers["max_torque"], 1000) / 1000,
        registers["dead_zone_cw"],
        registers["dead_zone_ccw"],
        registers["goal_speed"] * count or math.inf,
        registers["acceleration"] * ACCELERATION_UNIT * count or math.inf,
    )


def dynamixel_loop(registers: Mapping[str, int], servo: Any) -> Loop:
    """Loop of an X or MX servo: P over 128 and D over 16 per count, full duty at a PWM of 885.

    Profiles by speed only; the current limit acts in the current-based position mode.
    """
    ramp = profile(SERIES[1200], registers)
    most = min(registers["pwm_limit"], registers["goal_pwm"], _FULL_PWM) / _FULL_PWM
    if registers["operating_mode"] == _CURRENT_BASED:
        most *= min(registers["goal_current"] / max(registers["current_limit"], 1), 1.0)
    return Loop(
        servo.duty_per_rad * registers["position_p_gain"],
        servo.duty_per_rad * 128 / 16 * registers["position_d_gain"] * _TICK_S,
        0.0,
        most,
        top_speed_rad_s=ramp.speed_rad_s,
        top_acceleration_rad_s2=ramp.acceleration_rad_s2,
    )


def dynamixel_registers(model: str) -> dict[str, int]:
    """Registers of a Dynamixel that act on the motion, as it leaves the factory."""
    p, i, d = DYNAMIXEL_GAINS[model]
    return {
        "position_p_gain": p, "position_i_gain": i, "position_d_gain": d, "pwm_limit": _FULL_PWM,
        "goal_pwm": _FULL_PWM, "current_limit": 1193, "goal_current": 1193, "operating_mode": 3,
        "drive_mode": 0, "profile_velocity": 0, "profile_acceleration": 0,
    }  # fmt: skip
