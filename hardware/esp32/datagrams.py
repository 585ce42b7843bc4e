"""Datagrams of the robot's proxy: one message each, little endian, `length, opcode, payload`.

`AF_UNIX` datagrams have no checksum. Length, opcode and range are checked here;
`hardware.esp32.bus` reads everything twice. Layouts are those of the vendor's proxy; servos are in
the order of their ids, 1 to 12.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SERVOS = 12
SET_POSITION, GET_POSITION, GET_LOAD, GET_IMU, GET_POWER = 1, 2, 3, 4, 5

TORQUE_OFF, TORQUE_ON = 0, 1
SAVE_CALIBRATION = 99
"""As first torque byte it makes the proxy store a calibration: never sent from here."""

NO_COUNT = -1
HIGHEST_COUNT = 1023

_SET = struct.Struct("<BB12B12H")
_COUNTS = struct.Struct("<BB12H")
_LOADS = struct.Struct("<BB12h")
_IMU = struct.Struct("<BB6f")
_POWER = struct.Struct("<BB2f")
_IMU_FULL_SCALE = np.repeat([2.0, 2048.0], 3)  # g, °/s
ACKNOWLEDGED = bytes([2, SET_POSITION])
REPLY_SIZES = {SET_POSITION: 2, GET_POSITION: 26, GET_LOAD: 26, GET_IMU: 26, GET_POWER: 10}


@dataclass(frozen=True)
class Power:
    """Supply of the servos."""

    voltage_v: float
    current_a: float


def set_position(on: NDArray[np.bool_], counts: NDArray[np.int64]) -> bytes:
    """Request to drive the servos, in order of id, to `counts`, or to switch their torque off.

    Raises
    ------
    ValueError
        If there are not twelve of each, or a count is outside 0..1023.

    Examples
    --------
    >>> set_position(np.ones(12, bool), np.full(12, 512))[:4].hex(" ")
    '26 01 01 01'
    """
    if len(on) != SERVOS or len(counts) != SERVOS:
        raise ValueError(f"set_position: {len(on)} and {len(counts)} values instead of {SERVOS}.")
    if np.min(counts) < 0 or np.max(counts) > HIGHEST_COUNT:
        raise ValueError(f"set_position: counts {list(counts)} leave 0..{HIGHEST_COUNT}.")
    # one of two constants, so never the byte that stores a calibration
    torque = [TORQUE_ON if x else TORQUE_OFF for x in on]
    return _SET.pack(_SET.size, SET_POSITION, *torque, *(int(c) for c in counts))


def request(opcode: int) -> bytes:
    """A request without payload."""
    return bytes([2, opcode])


def parse_counts(reply: bytes) -> NDArray[np.int64] | None:
    """Counts by id, `NO_COUNT` where there is no reading; None if `reply` is another message.

    The proxy starts with zeros and keeps a zero for a servo that never answers, so a zero is no
    reading; neither is a count beyond the encoder.
    """
    if not _is(reply, GET_POSITION):
        return None
    counts = np.array(_COUNTS.unpack(reply)[2:], np.int64)
    return np.where((counts > 0) & (counts <= HIGHEST_COUNT), counts, NO_COUNT)


def parse_load(reply: bytes) -> NDArray[np.float64] | None:
    """Signed fraction of full duty by id, NaN where impossible; None if another message."""
    if not _is(reply, GET_LOAD):
        return None
    load = np.array(_LOADS.unpack(reply)[2:], float) / 1000.0
    return np.where(np.abs(load) <= 1.03, load, np.nan)


def parse_imu(reply: bytes) -> NDArray[np.float64] | None:
    """Acceleration [g] and rate [°/s] along the chip's axes, shape (6,).

    None if it is another message or a number is beyond the chip's range. Six zeros are a failed
    read.
    """
    if not _is(reply, GET_IMU):
        return None
    raw = np.array(_IMU.unpack(reply)[2:], float)
    return raw if np.all(np.abs(raw) <= _IMU_FULL_SCALE) else None  # refuses NaN, too


def parse_power(reply: bytes) -> Power | None:
    """Voltage and current; None if it is another message or a number is impossible."""
    if not _is(reply, GET_POWER):
        return None
    volts, amperes = _POWER.unpack(reply)[2:]
    # the divider's full scale is 10.3 V and 13.2 A
    if not (0 <= volts <= 11 and -1 <= amperes <= 14):
        return None
    return Power(volts, amperes)


def _is(reply: bytes, opcode: int) -> bool:
    size = REPLY_SIZES[opcode]
    return len(reply) == size and reply[0] == size and reply[1] == opcode
