"""How a serial servo is set: its registers as a recording's header has them, and what is wrong.

`register_faults` judges the registers before the torque is switched on: a servo in wheel mode is
not driven as if it held positions. Each fault names the register, its value and the cure.

A changed register is read back before it counts as set. Registers of the EEPROM are permanent on
some firmware and lost with the power on others: a write is first tried with the memory locked,
which Feetech describes as "in force, not stored", and unlocked only if that has no effect.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pupper_sysid.common.data_sheet import no_load_speed, supply_range
from pupper_sysid.hardware.serial_servos.line import SerialLine
from pupper_sysid.hardware.serial_servos.series import Family, Series

GAINS = {"p_gain": "p", "i_gain": "i", "d_gain": "d"}
"""Registers of the position loop, by their names in a recording's header."""

_READ_TRIES, _STORING_S = 5, 0.01


@dataclass(frozen=True)
class RegisterFault:
    """A register that must not be as it is, or (`refused` False) that shapes what is measured."""

    register: str
    value: int
    meaning: str
    cure: str
    refused: bool = True

    def sentence(self, joints: str, series: Series) -> str:
        """The fault of the servos of these joints, for a message."""
        names = [series.name_of(name) for name in self.register.split(" and ")]
        where = ", ".join(str(series.registers[n].address) for n in names if n in series.registers)
        at = f" (address {where})" if where else ""
        return (
            f"{joints}: the register {' and '.join(names)}{at} is {self.value}: "
            f"{self.meaning}. {self.cure}."
        )


def memory_of(line: SerialLine, servo: int, pieces: Any = (16, 15, 14, 13, 9)) -> bytes | None:
    """All registers of a servo, read in pieces of these lengths; None if a read failed."""
    memory = b""
    for size in pieces:
        tries = (line.read(servo, len(memory), size) for _ in range(_READ_TRIES))
        reply = next((answer for answer in tries if answer), None)
        if reply is None:
            return None
        memory += reply.frame.data
    return memory


def registers_of(series: Series, memory: bytes) -> dict[str, int]:
    """Values of all registers in a memory that starts at address 0."""
    return {
        name: series.decode(name, memory)
        for name, register in series.registers.items()
        if register.address + register.size <= len(memory)
    }


def setup_of(
    servo: int, family: Family, series: Series, registers: Mapping[str, int] | None
) -> dict[str, Any]:
    """Entry in a recording's header (`sysid.recordings.table.ServoSetup`) of one servo.

    Without the registers, which are those of `registers_of`, only id and model are known.
    """
    setup: dict[str, Any] = {"id": servo, "model": series.name}
    if registers is None:
        return setup

    def get(name: str) -> int:
        return registers[series.name_of(name)]

    if "firmware_major" in registers:
        setup["firmware"] = f"{get('firmware_major')}.{get('firmware_minor')}"
    elif "firmware" in registers:
        setup["firmware"] = str(get("firmware"))
    setup |= {key: get(name) for key, name in GAINS.items()}
    if volts := get("present_voltage"):
        setup["supply_voltage_v"] = round(family.volt_scale * volts, 3)
    setup["temperature_c"] = get("present_temperature")
    setup["registers"] = {name: registers[name] for name in family.shaping if name in registers}
    profile = family.profile(series, registers)
    if math.isfinite(profile.speed_rad_s):
        setup["set_point_speed_rad_s"] = round(profile.speed_rad_s, 4)
    if math.isfinite(profile.acceleration_rad_s2):
        setup["set_point_acceleration_rad_s2"] = round(profile.acceleration_rad_s2, 3)
    if profile.duration_s:
        setup["set_point_duration_s"] = profile.duration_s
    return setup


def return_delay_s(family: Family, setup: Mapping[str, Any]) -> float:
    """Time that a servo waits before it answers [s]; 0 if its registers could not be read."""
    registers = setup.get("registers", {})
    delay = next((v for k, v in registers.items() if k.startswith("return_delay")), 0)
    return family.return_delay_unit_s * delay


def supply_band(
    family: Family, series: Series, registers: Mapping[str, int]
) -> tuple[float, float] | None:
    """Range of a servo's supply [V]: that of its registers, within its data sheet's.

    None if neither is known. Registers whose range is empty are not used.
    """
    low = family.volt_scale * registers.get(series.name_of("min_voltage"), 0)
    high = family.volt_scale * registers.get(series.name_of("max_voltage"), 0)
    sheet = supply_range(series.name)
    if sheet is None:
        return (low, high) if low < high else None
    inside = max(low, sheet[0]), min(high, sheet[1])
    return inside if inside[0] < inside[1] else sheet


def register_faults(
    family: Family, series: Series, registers: Mapping[str, int], limits: tuple[int, int]
) -> list[RegisterFault]:
    """What is wrong with a servo's registers for driving it within `limits` [counts]."""

    def get(name: str, default: int = 0) -> int:
        return registers.get(series.name_of(name), default)

    def write(value: int | str, name: str) -> str:
        return f"Write {value} into {series.name_of(name)} with {family.tool}, then start again"

    faults: list[RegisterFault] = []
    mode = get("mode", family.position_mode)
    free = mode in family.turns_freely
    holds = free or mode == family.position_mode or mode in series.more_position_modes
    if not holds:
        words = family.modes.get(mode, "a mode that is not known here")
        meaning = f"{words}, in which the servo does not go to the positions that it is commanded"
        faults.append(RegisterFault("mode", mode, meaning, write(family.position_mode, "mode")))
    faults += [] if free else _limit_faults(series, get, limits, write)
    faults += _offset_faults(series, get, limits, write, free)
    level = get("response_level", family.acknowledges)
    if level != family.acknowledges:
        meaning = (
            "the servo does not acknowledge what is written to it, so nothing can confirm that its "
            "torque is off"
        )
        cure = write(family.acknowledges, "response_level")
        faults.append(RegisterFault("response_level", level, meaning, cure))
    faults += _supply_faults(family, series, registers)
    faults += family.family_faults(series, registers)
    return faults + _profile_remarks(family, series, registers)


def _limit_faults(series: Series, get: Any, limits: tuple[int, int], write: Any) -> list:
    low, high = get("min_angle"), get("max_angle", series.counts - 1)
    if low == high == 0:
        meaning = (
            "with both at 0 the servo is a wheel, which turns without end"
            if not series.has("mode")
            else "with both at 0 the servo has no angle limits of its own, and counts turns"
        )
        cure = write(f"0 and {series.counts - 1}", "min_angle and max_angle")
        return [RegisterFault("min_angle and max_angle", 0, meaning, cure)]
    faults = []
    span = f"the joint map allows {limits[0]} to {limits[1]}"
    for name, value, narrow, end in (
        ("min_angle", low, low > limits[0], limits[0]),
        ("max_angle", high, high < limits[1], limits[1]),
    ):
        if narrow:
            meaning = f"the servo clips its commands there, but {span}"
            cure = (
                f"{write(end, name).removesuffix(', then start again')}, or narrow "
                "limits_counts of the joint map (`pupper-sysid calibrate-joints` measures them)"
            )
            faults.append(RegisterFault(name, value, meaning, cure))
    return faults


def _offset_faults(
    series: Series, get: Any, limits: tuple[int, int], write: Any, free: bool
) -> list[RegisterFault]:
    top, offset = series.counts - 1, get("homing_offset")
    present = get("present_position")
    if not 0 <= present <= top:
        why = (
            "its register homing_offset is " + str(offset) if offset else "it counts several turns"
        )
        meaning = (
            f"outside the encoder's 0 to {top} ({why}), so the joint map's limits do not hold there"
        )
        name = "homing_offset" if offset else "mode" if series.has("mode") else "min_angle"
        cure = (
            write(0, "homing_offset") + "; or calibrate anew with the horn nearer to its middle"
            if name == "homing_offset"
            else "Turn the joint back by hand into its range, or switch the servo off and on"
        )
        register = "present_position" + (" and homing_offset" if offset else "")
        return [RegisterFault(register, present, meaning, cure)]
    # Feetech: present = encoder - offset; Dynamixel: present = encoder + offset
    encoder = [count + offset * series.offset_sign for count in limits]
    if not offset or free or (encoder[0] >= 0 and encoder[1] <= top):
        return []
    meaning = (
        f"the joint map's {limits[0]} to {limits[1]} then run over the end of the encoder "
        f"({encoder[0]} to {encoder[1]} of 0 to {top})"
    )
    if series.wraps(get):
        meaning += ", and the servo's counts wrap there"
        cure = (
            "Nothing has to be done if the joint map was made with this offset, else measure it "
            "anew with `pupper-sysid calibrate-joints`"
        )
        return [RegisterFault("homing_offset", offset, meaning, cure, False)]
    meaning += ", where the position jumps by a turn"
    cure = write(0, "homing_offset") + "; or mount the horn so that the range is in the middle"
    return [RegisterFault("homing_offset", offset, meaning, cure)]


def _supply_faults(
    family: Family, series: Series, registers: Mapping[str, int]
) -> list[RegisterFault]:
    raw = registers.get(series.name_of("present_voltage"), 0)
    limits_v, volts = supply_band(family, series, registers), family.volt_scale * raw
    if limits_v is None or not raw or limits_v[0] <= volts <= limits_v[1]:
        return []
    cure = (
        "Charge the battery or check the supply"
        if volts < limits_v[0]
        else "Switch the supply off and check it: more destroys the servo"
    )
    meaning = f"a supply of {volts:.1f} V, outside {limits_v[0]:.1f} to {limits_v[1]:.1f} V"
    return [RegisterFault("present_voltage", raw, meaning, cure)]


def _profile_remarks(
    family: Family, series: Series, registers: Mapping[str, int]
) -> list[RegisterFault]:
    profile = family.profile(series, registers)
    speed = no_load_speed(series.name) or 7.5
    words = []
    if profile.speed_rad_s < speed:
        words.append(f"{profile.speed_rad_s:.2f} rad/s")
    if math.isfinite(profile.acceleration_rad_s2):
        words.append(f"{profile.acceleration_rad_s2:.1f} rad/s²")
    if profile.duration_s:
        words.append(f"{1e3 * profile.duration_s:.0f} ms for each motion")
    if not words:
        return []
    meaning = (
        f"the servo ramps its set-point by itself ({', '.join(words)}); that ramp is a part of "
        "what is measured, and the recording's header has it"
    )
    cure = f"Write 0 into it with {family.tool} to measure the servo itself"
    return [
        RegisterFault(name, registers[name], meaning, cure, False) for name in profile.registers
    ]


def read_register(
    line: SerialLine, servo: int, series: Series, name: str, tries: int = _READ_TRIES
) -> int | None:
    """Value of a register; None if it could not be read."""
    register = series.register(name)
    for _ in range(tries):
        reply = line.read(servo, register.address, register.size)
        if reply:
            return series.decode(name, reply.frame.data, register.address)
    return None


def write_register(line: SerialLine, servo: int, series: Series, name: str, value: int) -> bool:
    """Set a register; whether it was read back with this value."""
    if _written(line, servo, series, name, value):
        return True
    if series.lock_address is None or series.register(name).address >= series.eeprom_end:
        return False
    line.write(servo, series.lock_address, bytes([0]))
    try:
        return _written(line, servo, series, name, value)
    finally:
        line.write(servo, series.lock_address, bytes([1]))


def _written(line: SerialLine, servo: int, series: Series, name: str, value: int) -> bool:
    line.write(servo, series.register(name).address, series.encode(name, value))
    time.sleep(_STORING_S)
    return read_register(line, servo, series, name) == value
