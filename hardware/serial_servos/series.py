"""Memory table of one series of serial servos: where each register lies and how it is encoded.

    series.decode("present_position", memory)      # a register of a whole memory
    series.encode("goal_position", 2048)           # bytes to write

Registers have the names of the vendor's table. Every series that has them also answers to model,
id, p, i, d, mode, min_angle, max_angle, homing_offset, response_level, return_delay, min_voltage,
max_voltage, torque_enable, goal_position and present_position, _load, _voltage and _temperature, so
that guard, recorder and scan need not know the vendor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

ERROR_BITS = {1: "voltage", 2: "angle sensor", 4: "overheat", 8: "overcurrent", 32: "overload"}
"""Bits of a status byte in words, where a bus does not name others."""


@dataclass(frozen=True)
class Register:
    """An entry of a memory table."""

    address: int
    size: int = 1
    """Bytes: 1, 2 or 4."""
    sign_bit: int | None = None
    """Of a value stored as sign and magnitude."""
    signed: bool = False
    """Whether the value is stored as two's complement."""


@dataclass(frozen=True)
class Series:
    """One series of servos."""

    name: str
    model: int
    """Model number."""
    big_endian: bool
    """Byte order inside a register."""
    counts: int
    """Of the encoder's whole range."""
    has_sync_read: bool
    lock_address: int | None
    """Of the register that write-protects the EEPROM; None where the torque does."""
    registers: dict[str, Register]
    aliases: Mapping[str, str] = field(default_factory=dict)
    """Vendor's name by common name, where the two differ."""
    eeprom_end: int = 40
    """First address of the registers that are lost with the power."""
    offset_sign: int = 1
    """Encoder = present position + this * homing offset."""
    more_position_modes: frozenset[int] = frozenset()
    """Values of the mode register beside the family's at which it goes where it is commanded."""
    multi_turn_bit: int | None = None
    """Of the register phase: while it is clear, counts with a homing offset wrap at the encoder's
    end; None where they never do."""

    def wraps(self, get: Callable[[str], int]) -> bool:
        """Whether counts wrap at the encoder's end, by the registers."""
        return self.multi_turn_bit is not None and not get("phase") & self.multi_turn_bit

    def name_of(self, name: str) -> str:
        """The vendor's name of a register."""
        return self.aliases.get(name, name)

    def has(self, name: str) -> bool:
        """Whether there is such a register."""
        return self.name_of(name) in self.registers

    def register(self, name: str) -> Register:
        """Entry of a register; `KeyError` if the series has none of this name."""
        return self.registers[self.name_of(name)]

    def decode(self, name: str, memory: bytes, start: int = 0) -> int:
        """Value of register `name` in `memory`, which starts at address `start`."""
        register = self.register(name)
        at = register.address - start
        raw = memory[at : at + register.size]
        if at < 0 or len(raw) != register.size:
            raise IndexError(f"register {name} is not in memory {start}..{start + len(memory)}")
        order = "big" if self.big_endian else "little"
        return signed(int.from_bytes(raw, order, signed=register.signed), register.sign_bit)

    def encode(self, name: str, value: int) -> bytes:
        """Bytes of register `name`; `OverflowError` if the value does not fit."""
        register = self.register(name)
        if register.sign_bit is not None:
            if abs(value) >> register.sign_bit:
                raise OverflowError(f"{name}: {value} does not fit beside its sign bit")
            value = abs(value) | (value < 0) << register.sign_bit
        order = "big" if self.big_endian else "little"
        return int(value).to_bytes(register.size, order, signed=register.signed)


@dataclass(frozen=True)
class Profile:
    """How a servo ramps its set-point by itself; infinite where it does not."""

    speed_rad_s: float = math.inf
    acceleration_rad_s2: float = math.inf
    duration_s: float = 0.0
    """Of every motion, whatever its length."""
    registers: tuple[str, ...] = ()
    """That ask for it."""


@dataclass(frozen=True)
class Family:
    """What the shared code needs to know of one vendor's servos."""

    name: str
    """As in `--bus NAME:DEVICE`."""
    open_line: Callable[[str, int, bool], Any]
    """Opens a `serial_servos.line.SerialLine`: device, rate, exclusive."""
    rates: tuple[int, ...]
    """Baud rates tried, in this order, where none is given."""
    highest_id: int
    series: Mapping[int, Series]
    """By model number."""
    by_firmware: Callable[[Any, int, int], Series | None]
    """Series of a servo whose model number is none of them, from its line, id and model number;
    None if nothing shows it."""
    profiles: Mapping[str, Series]
    """By the servo's name in a joint map, for servos whose model number is not published."""
    presets: Mapping[str, str]
    """Joint map of the Mini Pupper's layout, by series' name."""
    error_bits: Mapping[int, str]
    """Bits of a reply's error byte in words."""
    present: str
    """First register of a reading."""
    reading_bytes: Sequence[int]
    """Lengths of successive readings, all different: a late reply fits no later request."""
    memory_pieces: Sequence[int]
    """Lengths of the reads that together give all registers; unequal for the same reason."""
    shaping: tuple[str, ...]
    """Registers beside the gains that shape how a servo moves and answers; a recording keeps them,
    as far as a series has them."""
    modes: Mapping[int, str]
    """Operating modes in which a servo does not go where it is commanded, in words."""
    position_mode: int
    """Value of the mode register to write instead."""
    turns_freely: frozenset[int]
    """Modes that count several turns and have no angle limits."""
    acknowledges: int
    """Value of the response level at which every write is answered."""
    profile: Callable[[Series, Mapping[str, int]], Profile]
    """From the registers."""
    family_faults: Callable[[Series, Mapping[str, int]], list[Any]]
    """Faults of registers that only this family has (`serial_servos.settings.RegisterFault`)."""
    protections: Callable[[Series, Mapping[str, int]], dict[str, int]]
    """Registers to set while the torque is on: the servo's own protections."""
    volt_scale: float
    """Volt per unit of the voltage registers."""
    load: tuple[str, float]
    """Register of the load, and the share of full duty or current per unit."""
    return_delay_unit_s: float
    tool: str
    """Vendor's program that writes registers."""


def signed(value: int, sign_bit: int | None) -> int:
    """Value of a number stored as sign and magnitude.

    Examples
    --------
    >>> signed(0x8005, 15), signed(5, 15)
    (-5, 5)
    """
    if sign_bit is None or not value >> sign_bit & 1:
        return value
    return -(value & (1 << sign_bit) - 1)


def bits_in_words(status: int, names: Mapping[int, str]) -> str:
    """Set bits of a status byte in words.

    Examples
    --------
    >>> bits_in_words(33, {1: "voltage", 32: "overload"})
    'voltage, overload'
    """
    named = [word for bit, word in names.items() if status & bit]
    unknown = status & ~sum(names)
    return ", ".join([*named, *([f"unknown bits {unknown:#04x}"] if unknown else [])])
