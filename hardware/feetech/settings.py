"""How a Feetech servo is set: its registers as a recording's header has them, and how to set one.

A changed register is read back before it counts as set. Registers below `EEPROM_END` are permanent
on some firmware and lost with the power on others: a write is first tried with the memory locked,
which the vendor describes as "in force, not stored", and unlocked only if that has no effect.
"""

from __future__ import annotations

import time
from typing import Any

from pupper_sysid.hardware.feetech.line import FeetechLine
from pupper_sysid.hardware.feetech.registers import RETURN_DELAY_UNIT_S, Series

GAINS = {"p_gain": "p", "i_gain": "i", "d_gain": "d"}
"""Registers of the position loop, by their names in a recording's header."""

SHAPING = (
    "return_delay", "min_start_force", "dead_zone_cw", "dead_zone_ccw", "max_torque",
    "torque_limit", "max_temperature", "max_voltage", "min_voltage", "min_angle", "max_angle",
    "mode", "acceleration", "goal_time", "goal_speed",
)  # fmt: skip
"""Other registers that shape how a servo moves and answers; a recording keeps them."""

SETTABLE = (*GAINS.values(), "min_start_force", "dead_zone_cw", "dead_zone_ccw", "acceleration",
            "goal_speed", "torque_limit")  # fmt: skip
"""Registers that may be set for the duration of a recording."""

VOLT_SCALE = 0.1
EEPROM_END = 40

_PIECES = (16, 15, 14, 13, 9)  # of registers 0 to 66; unequal: a late reply fits no later read
_READ_TRIES, _STORING_S = 5, 0.01


def memory_of(line: FeetechLine, servo: int) -> bytes | None:
    """Registers 0 to 66 of a servo, read in pieces; None if a read failed."""
    memory = b""
    for size in _PIECES:
        tries = (line.read(servo, len(memory), size) for _ in range(_READ_TRIES))
        reply = next((found for found in tries if found), None)
        if reply is None:
            return None
        memory += reply.frame.data
    return memory


def setup_of(servo: int, series: Series, memory: bytes | None) -> dict[str, Any]:
    """Entry of a servo in a recording's header (`sysid.recordings.servo_setup.ServoSetup`).

    Parameters
    ----------
    servo : int
        Its id.
    series : Series
    memory : bytes or None
        From `memory_of`; without it only id and model are known.
    """
    known: dict[str, Any] = {"id": servo, "model": series.name}
    if memory is None:
        return known

    def get(name: str) -> int:
        return series.decode(name, memory)

    known["firmware"] = f"{get('firmware_major')}.{get('firmware_minor')}"
    known |= {key: get(name) for key, name in GAINS.items()}
    if volts := get("present_voltage"):
        known["supply_voltage_v"] = round(VOLT_SCALE * volts, 3)
    known["temperature_c"] = get("present_temperature")
    known["registers"] = {name: get(name) for name in SHAPING if name in series.registers}
    return known


def return_delay_s(setup: dict[str, Any]) -> float:
    """Time that a servo waits before it answers [s]; 0 if its registers could not be read."""
    return RETURN_DELAY_UNIT_S * setup.get("registers", {}).get("return_delay", 0)


def read_register(line: FeetechLine, servo: int, series: Series, name: str) -> int | None:
    """Value of a register; None if it could not be read."""
    register = series.registers[name]
    for _ in range(_READ_TRIES):
        reply = line.read(servo, register.address, register.size)
        if reply:
            return series.decode(name, reply.frame.data, register.address)
    return None


def write_register(line: FeetechLine, servo: int, series: Series, name: str, value: int) -> bool:
    """Set a register; whether it was read back with this value."""
    if _written(line, servo, series, name, value):
        return True
    if series.registers[name].address >= EEPROM_END:
        return False
    line.write(servo, series.lock_address, bytes([0]))
    try:
        return _written(line, servo, series, name, value)
    finally:
        line.write(servo, series.lock_address, bytes([1]))


def _written(line: FeetechLine, servo: int, series: Series, name: str, value: int) -> bool:
    line.write(servo, series.registers[name].address, series.encode(name, value))
    time.sleep(_STORING_S)
    return read_register(line, servo, series, name) == value
