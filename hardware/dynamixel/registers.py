"""Control table of Dynamixel's X series and MX(2.0), protocol 2.0, by model number.

One table serves them all: models differ in factory values, and XL430 and MX-28 report a load where
the others report a current. Registers below 64 are EEPROM, which a servo writes with the torque off
only.

Sources: Robotis e-Manual, control tables of XL330-M288, XL430-W250, XM430-W350, XH430-W350 and
MX-28(2.0), which agree on every address here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from pupper_sysid.hardware.serial_servos.series import Profile, Register, Series
from pupper_sysid.hardware.serial_servos.settings import RegisterFault

PING, READ, WRITE, REG_WRITE, ACTION, REBOOT = 1, 2, 3, 4, 5, 8
SYNC_READ, SYNC_WRITE = 0x82, 0x83
BROADCAST_ID, HIGHEST_ID = 0xFE, 252

ALERT = 0x80
"""Bit of the error byte: `hardware_error_status` is not 0."""
RESULT_FAIL, INSTRUCTION, CRC, DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS = range(1, 8)
"""Numbers of the error byte."""
HARDWARE_ERRORS = {
    1: "input voltage", 4: "overheating", 8: "encoder", 16: "electrical shock", 32: "overload",
}  # fmt: skip
"""Bits of the register hardware_error_status."""
BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
"""By the value of the servo's baud register."""

POSITION_MODE, EXTENDED_POSITION_MODE, CURRENT_BASED_POSITION_MODE = 3, 4, 5
MODES = {0: "current mode", 1: "velocity mode", 16: "PWM mode"}
ACKNOWLEDGES = 2
REVERSE, TIME_BASED = 1, 4
"""Bits of the drive mode: counts fall with the angle; profiles are durations."""
FULL_PWM = 885
WATCHDOG_UNIT_S = 0.02
WATCHDOG_UNITS = 100
"""2 s: longer than the second after which the watchdog process takes over."""
TRIGGERED = 255
"""Value of the bus watchdog once it has stopped the servo."""

_SPEED_RAD_S = 0.229 * math.tau / 60
_ACCELERATION_RAD_S2 = 214.577 * math.tau / 3600
_OVERLOAD_AND_HEAT = 36

_TABLE = {
    "model_number": Register(0, 2),
    "firmware": Register(6),
    "id": Register(7),
    "baud_rate": Register(8),
    "return_delay_time": Register(9),
    "drive_mode": Register(10),
    "operating_mode": Register(11),
    "secondary_id": Register(12),
    "homing_offset": Register(20, 4, signed=True),
    "moving_threshold": Register(24, 4),
    "temperature_limit": Register(31),
    "max_voltage_limit": Register(32, 2),
    "min_voltage_limit": Register(34, 2),
    "pwm_limit": Register(36, 2),
    "current_limit": Register(38, 2),
    "velocity_limit": Register(44, 4),
    "max_position_limit": Register(48, 4),
    "min_position_limit": Register(52, 4),
    "shutdown": Register(63),
    "torque_enable": Register(64),
    "status_return_level": Register(68),
    "hardware_error_status": Register(70),
    "position_d_gain": Register(80, 2),
    "position_i_gain": Register(82, 2),
    "position_p_gain": Register(84, 2),
    "feedforward_2nd_gain": Register(88, 2),
    "feedforward_1st_gain": Register(90, 2),
    "bus_watchdog": Register(98),
    "goal_pwm": Register(100, 2, signed=True),
    "goal_current": Register(102, 2, signed=True),
    "profile_acceleration": Register(108, 4),
    "profile_velocity": Register(112, 4),
    "goal_position": Register(116, 4, signed=True),
    "moving": Register(122),
    "present_pwm": Register(124, 2, signed=True),
    "present_current": Register(126, 2, signed=True),
    "present_velocity": Register(128, 4, signed=True),
    "present_position": Register(132, 4, signed=True),
    "present_input_voltage": Register(144, 2),
    "present_temperature": Register(146),
}
_ALIASES = {
    "model": "model_number", "p": "position_p_gain", "i": "position_i_gain",
    "d": "position_d_gain", "mode": "operating_mode", "min_angle": "min_position_limit",
    "max_angle": "max_position_limit", "response_level": "status_return_level",
    "return_delay": "return_delay_time", "min_voltage": "min_voltage_limit",
    "max_voltage": "max_voltage_limit", "present_load": "present_pwm",
    "present_voltage": "present_input_voltage", "baud": "baud_rate",
}  # fmt: skip
MEMORY_BYTES = 147

MODELS = {
    1190: "XL330-M077", 1200: "XL330-M288", 1240: "XC330-M288", 1060: "XL430-W250",
    1030: "XM430-W210", 1020: "XM430-W350", 1110: "XH430-W350", 1130: "XM540-W150",
    1120: "XM540-W270", 30: "MX-28", 311: "MX-64", 321: "MX-106",
}  # fmt: skip
"""Names by model number; MX are those with the firmware for protocol 2.0."""


def _series(name: str, model: int) -> Series:
    return Series(
        name, model, big_endian=False, counts=4096, has_sync_read=True, lock_address=None,
        registers=_TABLE, aliases=_ALIASES, eeprom_end=64,
        offset_sign=-1,  # present = encoder + homing offset
    )  # fmt: skip


SERIES = {model: _series(name, model) for model, name in MODELS.items()}

SHAPING = (
    "return_delay_time", "drive_mode", "operating_mode", "homing_offset", "pwm_limit",
    "current_limit", "velocity_limit", "min_position_limit", "max_position_limit",
    "temperature_limit", "min_voltage_limit", "max_voltage_limit", "shutdown",
    "status_return_level", "feedforward_1st_gain", "feedforward_2nd_gain", "bus_watchdog",
    "goal_pwm", "goal_current", "profile_acceleration", "profile_velocity",
)  # fmt: skip
"""Registers beside the gains that shape how a servo moves and answers."""


def profile(series: Series, registers: Mapping[str, int]) -> Profile:
    """Ramp of the set-point, whose units the drive mode sets.

    By speed: 0.229 rev/min and 214.577 rev/min² per unit. By time: `profile_velocity` is the
    duration of a motion in ms, and `profile_acceleration` that of its beginning.
    """
    speed, acceleration = registers["profile_velocity"], registers["profile_acceleration"]
    named = {"profile_velocity": speed, "profile_acceleration": acceleration}
    names = tuple(name for name, value in named.items() if value)
    if registers["drive_mode"] & TIME_BASED:
        return Profile(duration_s=speed / 1e3, registers=names)
    return Profile(
        speed * _SPEED_RAD_S if speed else math.inf,
        acceleration * _ACCELERATION_RAD_S2 if speed and acceleration else math.inf,
        registers=names,
    )


def own_faults(series: Series, registers: Mapping[str, int]) -> list[RegisterFault]:
    """Faults of registers that only these servos have."""
    faults = []
    if errors := registers["hardware_error_status"]:
        words = ", ".join(word for bit, word in HARDWARE_ERRORS.items() if errors & bit)
        meaning = f"the servo has shut down ({words or 'unknown bits'}), and takes no torque"
        cure = "Remove the cause, and switch its power off and on (or send a reboot)"
        faults.append(RegisterFault("hardware_error_status", errors, meaning, cure))
    if registers["bus_watchdog"] == TRIGGERED:
        meaning = "its watchdog has stopped the servo, because an earlier program ended"
        cure = "Nothing has to be done: it is cleared before the torque is switched on"
        faults.append(RegisterFault("bus_watchdog", TRIGGERED, meaning, cure, False))
    if registers["drive_mode"] & REVERSE:
        meaning = "counts fall as the horn turns counter-clockwise"
        cure = "The signs of the joint map must have been checked with it"
        faults.append(RegisterFault("drive_mode", registers["drive_mode"], meaning, cure, False))
    if registers["pwm_limit"] < FULL_PWM:
        share = 100 * registers["pwm_limit"] / FULL_PWM
        meaning = f"the servo uses {share:.0f} % of its duty at most, and so of its torque"
        cure = f"Write {FULL_PWM} into it to measure the whole servo"
        faults.append(RegisterFault("pwm_limit", registers["pwm_limit"], meaning, cure, False))
    if registers["operating_mode"] == CURRENT_BASED_POSITION_MODE:
        meaning = (
            f"position mode with a limited current (goal_current {registers['goal_current']}, "
            f"current_limit {registers['current_limit']})"
        )
        cure = "Write 3 into it to measure the servo without that limit"
        faults.append(RegisterFault("operating_mode", 5, meaning, cure, False))
    return faults


def protections(series: Series, registers: Mapping[str, int]) -> dict[str, int]:
    """Registers to set while the torque is on: shutdown by overload and heat, and the bus watchdog.

    The bus watchdog stops the servo itself if no program talks to it for 2 s.

    Examples
    --------
    >>> protections(SERIES[1200], {"shutdown": 52, "bus_watchdog": 0})
    {'bus_watchdog': 100}
    """
    wanted = {
        "shutdown": registers["shutdown"] | _OVERLOAD_AND_HEAT, "bus_watchdog": WATCHDOG_UNITS,
    }  # fmt: skip
    return {name: value for name, value in wanted.items() if value != registers[name]}
