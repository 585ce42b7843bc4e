"""Memory tables of the Feetech servo series, by model number: addresses, sizes and byte order.

The series differ: address 48 locks the EEPROM of one and limits the torque of the other. So a
servo's model number, at address 3 in both, is read before anything else.

Sources: the vendor's memory tables (wiki and ST3215 sheet), the Mini Pupper's firmware, LeRobot's
tables; entries on which they disagree are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from pupper_sysid.common.data_sheet import counts_of
from pupper_sysid.hardware.serial_servos.series import Profile, Register, Series

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
BROADCAST_ID = 0xFE
HIGHEST_ID = 253

BAUD_RATES = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""By the value of the servo's baud register."""
RETURN_DELAY_UNIT_S = 2e-6

MODEL_ADDRESS, TORQUE_ADDRESS = 3, 40
MULTI_TURN_FEEDBACK = 16
_SPEED_SIGN, _LOAD_SIGN, _OFFSET_SIGN = 15, 10, 11


_COMMON = {
    "firmware_major": Register(0),
    "firmware_minor": Register(1),
    "model": Register(MODEL_ADDRESS, 2),
    "id": Register(5),
    "baud": Register(6),
    "return_delay": Register(7),
    "response_level": Register(8),
    "min_angle": Register(9, 2),
    "max_angle": Register(11, 2),
    "max_temperature": Register(13),
    "max_voltage": Register(14),
    "min_voltage": Register(15),
    "max_torque": Register(16, 2),
    "phase": Register(18),
    "unload_condition": Register(19),
    "p": Register(21),
    "d": Register(22),
    "i": Register(23),
    "min_start_force": Register(24, 2),
    "dead_zone_cw": Register(26),
    "dead_zone_ccw": Register(27),
    "torque_enable": Register(TORQUE_ADDRESS),
    "acceleration": Register(41),
    "goal_time": Register(44, 2),
    "goal_speed": Register(46, 2),
    "present_speed": Register(58, 2, _SPEED_SIGN),
    "present_load": Register(60, 2, _LOAD_SIGN),
    "present_voltage": Register(62),
    "present_temperature": Register(63),
    "registered": Register(64),
    "status": Register(65),
    "moving": Register(66),
}


SCS0009 = Series(
    "SCS0009", 1284, True, 1024, False, 48,
    _COMMON | {"goal_position": Register(42, 2), "present_position": Register(56, 2)},
)  # fmt: skip
STS3215 = Series(
    "STS3215", 777, False, 4096, True, 55,
    _COMMON
    | {
        "homing_offset": Register(31, 2, _OFFSET_SIGN),
        "mode": Register(33),
        "protective_torque": Register(34),
        "protection_time": Register(35),
        "overload_torque": Register(36),
        "goal_position": Register(42, 2, 15),
        "torque_limit": Register(48, 2),
        "present_position": Register(56, 2, 15),
        "current": Register(69, 2, 15),
    },
    # several turns are reported, instead of one (LeRobot clears it)
    multi_turn_bit=MULTI_TURN_FEEDBACK,
)  # fmt: skip
HD1910 = replace(
    STS3215,
    name="HD-1910",
    model=0,
    registers=STS3215.registers | {"p": Register(50), "d": Register(51)},
    more_position_modes=frozenset({4}),  # as delivered, by a builder's notes on firmware 3.46
)
"""Microduck's Feetech servo: STS protocol, with the gains in use at 50 and 51. No source states its
model number, so that a joint map has to name it."""
SERIES = {int.from_bytes(s.word(s.model), "little"): s for s in (SCS0009, STS3215)}
"""By model number, its bytes as little endian."""

POSITION_MODE = 0
MODES = {1: "wheel mode", 2: "PWM mode", 3: "step mode"}
ACKNOWLEDGES = 1

SHAPING = (
    "return_delay", "response_level", "min_start_force", "dead_zone_cw", "dead_zone_ccw",
    "max_torque", "torque_limit", "max_temperature", "max_voltage", "min_voltage", "min_angle",
    "max_angle", "homing_offset", "phase", "mode", "acceleration", "goal_time", "goal_speed",
)  # fmt: skip
"""Registers beside the gains that shape how a servo moves and answers."""

_ACCELERATION_COUNTS_S2 = 100
_HEAT, _OVERLOAD = 4, 32  # of ERROR_BITS
_MOST = {"protective_torque": 20, "protection_time": 200, "overload_torque": 80}
"""Factory settings: share of the torque afterwards [%], duration [10 ms], share before [%]."""
_OFF_AT_ZERO = ("protection_time", "overload_torque")

PROTECTIONS = ("unload_condition", *_MOST)
"""Registers of which a servo's protections consist, as far as its series has them."""


def protections_to_set(series: Series, registers: Mapping[str, int]) -> dict[str, int]:
    """Values that bring a servo's protections to at least the factory's; {} if they are.

    If every process of the host is gone, only these act: above a temperature, or when a joint has
    been blocked for some time, the servo reduces its torque by itself. No series has a
    communication time-out: a servo that is free to move holds its last command for ever. Registers
    37 to 39 of the SCS series are left alone: sources name them, the vendor's table does not.

    Examples
    --------
    >>> protections_to_set(SCS0009, {"unload_condition": 1})
    {'unload_condition': 37}
    """
    wanted = {"unload_condition": registers["unload_condition"] | _HEAT | _OVERLOAD}
    for name, most in _MOST.items():
        if name in series.registers:
            off = registers[name] == 0 and name in _OFF_AT_ZERO
            wanted[name] = most if off else min(registers[name], most)
    return {name: value for name, value in wanted.items() if value != registers[name]}


def profile(series: Series, registers: Mapping[str, int]) -> Profile:
    """Ramp of the set-point: acceleration in 100 counts/s², speed in counts/s, time in ms.

    A speed overrides the time.
    """
    count = math.tau / (counts_of(series.name) or series.counts)
    acceleration, speed = registers.get("acceleration", 0), registers.get("goal_speed", 0)
    duration = 0 if speed else registers.get("goal_time", 0)
    named = {"acceleration": acceleration, "goal_speed": speed, "goal_time": duration}
    return Profile(
        speed * count if speed else math.inf,
        _ACCELERATION_COUNTS_S2 * acceleration * count if acceleration else math.inf,
        duration / 1e3,
        tuple(name for name, value in named.items() if value),
    )
