"""Memory tables of the Feetech servo series, by model number: addresses, sizes and byte order.

The series differ: address 48 locks the EEPROM of one and limits the torque of the other. So a
servo's model number, at address 3 in both, is read before anything else.

Sources: the vendor's memory tables (wiki and ST3215 sheet), the Mini Pupper's firmware, LeRobot's
tables; entries on which they disagree are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
BROADCAST_ID = 0xFE
HIGHEST_ID = 253

ERROR_BITS = {1: "voltage", 2: "angle sensor", 4: "overheat", 8: "overcurrent", 32: "overload"}
BAUD_RATES = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""By the value of the servo's baud register."""
RETURN_DELAY_UNIT_S = 2e-6

MODEL_ADDRESS, TORQUE_ADDRESS = 3, 40
_SPEED_SIGN, _LOAD_SIGN, _OFFSET_SIGN = 15, 10, 11


@dataclass(frozen=True)
class Register:
    """An entry of a memory table."""

    address: int
    size: int = 1
    """Bytes, 1 or 2."""
    sign_bit: int | None = None
    """Of a value stored as sign and magnitude."""


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


@dataclass(frozen=True)
class Series:
    """One family of servos."""

    name: str
    model: int
    """Model number."""
    big_endian: bool
    """Byte order inside a two-byte register."""
    counts: int
    """Of the encoder's whole range."""
    has_sync_read: bool
    lock_address: int
    registers: dict[str, Register]

    def word(self, value: int) -> bytes:
        """Two bytes of a register in this series' byte order; `value` must fit."""
        return int(value).to_bytes(2, "big" if self.big_endian else "little")

    def decode(self, name: str, memory: bytes, start: int = 0) -> int:
        """Value of register `name` in `memory`, which starts at address `start`."""
        register = self.registers[name]
        at = register.address - start
        raw = memory[at : at + register.size]
        if at < 0 or len(raw) != register.size:
            raise IndexError(f"register {name} is not in memory {start}..{start + len(memory)}")
        value = int.from_bytes(raw, "big" if self.big_endian else "little")
        return signed(value, register.sign_bit)

    def encode(self, name: str, value: int) -> bytes:
        """Bytes of register `name`.

        Raises
        ------
        OverflowError
            If the value does not fit.
        """
        register = self.registers[name]
        if register.sign_bit is not None:
            if abs(value) >> register.sign_bit:
                raise OverflowError(f"{name}: {value} does not fit beside its sign bit")
            value = abs(value) | (value < 0) << register.sign_bit
        return int(value).to_bytes(register.size, "big" if self.big_endian else "little")


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
)  # fmt: skip
SERIES = {series.model: series for series in (SCS0009, STS3215)}


def series_of_model_bytes(raw: bytes) -> Series | None:
    """Series with the model number `raw` (2 bytes, in its own byte order); None if unknown."""
    return next((s for s in SERIES.values() if raw == s.word(s.model)), None)


def error_words(status: int) -> str:
    """Error bits of a status byte in words.

    Examples
    --------
    >>> error_words(33)
    'voltage, overload'
    """
    named = [word for bit, word in ERROR_BITS.items() if status & bit]
    rest = status & ~sum(ERROR_BITS)
    return ", ".join([*named, *([f"unknown bits {rest:#04x}"] if rest else [])])
