"""Feetech servos (STS, SCS and SMS series) as a `ServoBus`: `--bus feetech:/dev/ttyUSB0`.

The series differ: address 48 locks the EEPROM of one and limits the torque of the other, and 34 is
a protection of STS and a gain of HLS servos. So a servo's model number, at address 3 in all, is
read before anything else. One that is not known here belongs to a series by its firmware and byte
order, as the vendor's FD program has it.

Frames are `FF FF ID LEN X ... CHK`, found in a stream that may hold anything: `X` is the
instruction or the error byte, `LEN` counts it, the parameters and the checksum, which is the
inverted sum of all bytes from ID on. `FrameReader` is the only parser: the bus reads replies with
it, the emulator reads requests. Where a frame is incomplete or its checksum wrong, its first byte
is dropped and the search goes on, so garbage before, between or around frames is skipped.

Beside the faults that all SDKs share (`hardware.serial_servos.line`), version 1.0.0 of
`scservo_sdk` keeps the byte order in a module global, does not check a reply's length, and loses
the replies of a group read after one silent servo. All three are therefore handled here.

Sources: the vendor's memory tables (wiki, ST3215 sheet, STS and HLS tables of 2026), its headers
SMS_STS.h, SCSCL.h and HLSCL.h, the model list of its FD program, LeRobot's tables, the Mini
Pupper's firmware. Entries on which they disagree are left out, such as address 44 of STS servos,
the time of a motion or the duty of the PWM mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from pupper_sysid.common.data_sheet import counts_of
from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.serial_servos.bus import SerialBus
from pupper_sysid.hardware.serial_servos.line import LineFrame, Reply, SerialLine
from pupper_sysid.hardware.serial_servos.series import ERROR_BITS, Family, Profile, Register, Series
from pupper_sysid.hardware.serial_servos.settings import RegisterFault

PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
BROADCAST_ID = 0xFE
HIGHEST_ID = 253
_TRIES = 3

BAUD_RATES = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""By the value of the servo's baud register."""

MODEL_ADDRESS, TORQUE_ADDRESS = 3, 40
_SPEED_SIGN, _LOAD_SIGN = 15, 10


_COMMON = {
    "firmware_major": Register(0),
    "firmware_minor": Register(1),
    "big_endian": Register(2),
    "model": Register(MODEL_ADDRESS, 2),
    "id": Register(5),
    "baud": Register(6),
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
    "goal_speed": Register(46, 2),
    "present_speed": Register(58, 2, _SPEED_SIGN),
    "present_load": Register(60, 2, _LOAD_SIGN),
    "present_voltage": Register(62),
    "present_temperature": Register(63),
    "registered": Register(64),
    "status": Register(65),
    "moving": Register(66),
}


_MAGNETIC = _COMMON | {
    "min_start_force": Register(24),  # the byte behind it limits the integral, on newer firmware
    "protection_current": Register(28, 2),
    "mode": Register(33),
    "goal_position": Register(42, 2, 15),
    "torque_limit": Register(48, 2),
    "present_position": Register(56, 2, 15),
    "current": Register(69, 2, 15),
}
_MULTI_TURN = 16  # of the phase: several turns are reported, instead of one (LeRobot clears it)

SCS0009 = Series(
    "SCS0009", 1284, True, 1024, False, 48,
    _COMMON
    | {
        "return_delay": Register(7),
        "goal_position": Register(42, 2),
        "goal_time": Register(44, 2),
        "present_position": Register(56, 2),
    },
)  # fmt: skip
STS3215 = Series(
    "STS3215", 777, False, 4096, True, 55,
    _MAGNETIC
    | {
        "return_delay": Register(7),
        "homing_offset": Register(31, 2, 11),
        "protective_torque": Register(34),
        "protection_time": Register(35),
        "overload_torque": Register(36),
    },
    multi_turn_bit=_MULTI_TURN,
)  # fmt: skip
HLS3625 = Series(
    "HLS3625", 3338, False, 4096, True, 55,
    _MAGNETIC
    | {
        "homing_offset": Register(31, 2, 15),
        "goal_current": Register(44, 2, 15),
        # in use; those at 21 to 23 are loaded at power on
        "p": Register(50),
        "d": Register(51),
        "i": Register(52),
    },
    # position without a current loop: the HD-1910's as delivered
    more_position_modes=frozenset({4}),
    multi_turn_bit=_MULTI_TURN,
)  # fmt: skip
HD1910 = replace(HLS3625, name="HD-1910", model=0)
"""Microduck's servo, an HLS by its firmware 3.46. No source states its model number, so that only a
joint map names it."""

_NAMES: tuple[tuple[Series, int, dict[int, str]], ...] = (
    (SCS0009, 5, {
        1: "SCS0002", 2: "SCS0037", 3: "SCS2304", 4: "SCS0009", 5: "SCS1025", 6: "SCS0018",
        7: "SCS0017", 8: "SCS2332", 9: "SCS0005", 10: "SCS0043", 12: "SCS45", 15: "SCS15",
        16: "SCS315", 25: "SCS115", 35: "SCS215", 40: "SCS40", 60: "SCS6560",
    }),
    (STS3215, 9, {
        1: "STS3015", 2: "STS3032", 3: "STS3215", 4: "STS3040", 5: "STS3020", 6: "STS3046",
        7: "STS3045", 8: "STS3235", 9: "STS3095", 10: "STS3095", 11: "STS3250", 12: "STS3036",
        13: "STS3120",
    }),
    (STS3215, 10, {
        1: "HTS3235", 2: "HTS3032", 3: "HTS3240", 4: "HTS3235", 5: "STS3045BL", 6: "STS3046BL",
        7: "HTS3032", 8: "HTS3045", 9: "STS3009BL", 25: "STS3025BL", 26: "STS3200BL",
    }),
    (HLS3625, 10, {
        10: "HLS3606", 11: "HLS3612", 12: "HLS3620", 13: "HLS3625", 14: "HLS3640", 15: "HLS3925",
        16: "HLS3930", 17: "HLS3935", 18: "HLS3950", 19: "HLS3955", 20: "HLS3915", 21: "HLS3615",
        22: "HLS3960", 23: "HLS3608", 24: "HLS3604", 27: "HLS2915", 28: "HLS3906", 29: "HLS2606",
    }),
)  # fmt: skip
"""By series and the first byte of the model number: names by its second byte."""
SERIES = {
    minor << 8 | major: replace(
        series, name=name, model=major << 8 | minor if series.big_endian else minor << 8 | major
    )
    for series, major, names in _NAMES
    for minor, name in names.items()
}
"""By model number, its bytes as little endian."""


def by_firmware(line: SerialLine, servo: int, model: int) -> Series | None:
    """STS, HLS or SCS, for a servo whose model number is not known; None if its firmware is not."""
    # repeated after a lost answer, which would otherwise look like an unknown servo
    replies = (line.read(servo, 0, 3) for _ in range(_TRIES))
    reply = next((r for r in replies if r is not None), None)
    if reply is None:
        return None
    major, minor, big_endian = reply.frame.data
    kinds = ((SCS0009, 1, 0, range(40)), (STS3215, 0, 3, range(40)), (HLS3625, 0, 3, range(40, 60)))
    series = next(
        (
            s
            for s, end, first, rest in kinds
            if (end, first) == (big_endian, major) and minor in rest
        ),
        None,
    )
    if series is None:
        return None
    return replace(series, name=series.name[:3], model=model)


SHAPING = (
    "return_delay", "response_level", "min_start_force", "dead_zone_cw", "dead_zone_ccw",
    "max_torque", "torque_limit", "max_temperature", "max_voltage", "min_voltage", "min_angle",
    "max_angle", "homing_offset", "phase", "mode", "acceleration", "goal_time", "goal_speed",
    "goal_current", "protection_current",
)  # fmt: skip
"""Registers beside the gains that shape how a servo moves and answers."""

_ACCELERATION_COUNTS_S2 = 100
_FAST_SPEED_COUNTS_S = 50
_SINGLE_COUNTS, _ZERO_IS_FULL_SPEED = 4, 8  # of the phase of STS: unit and 0 of goal_speed
_HEAT, _OVERCURRENT, _OVERLOAD = 4, 8, 32  # of ERROR_BITS
_MOST = {"protective_torque": 20, "protection_time": 200, "overload_torque": 80}
"""Factory settings: share of the torque afterwards [%], duration [10 ms], share before [%]."""
_OFF_AT_ZERO = ("protection_time", "overload_torque")


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
    >>> protections_to_set(HLS3625, {"unload_condition": 4})  # protected by current, not by load
    {'unload_condition': 12}
    """
    blocked = _OVERCURRENT if series.has("goal_current") else _OVERLOAD
    safe = {"unload_condition": registers["unload_condition"] | _HEAT | blocked}
    for name, most in _MOST.items():
        if name in series.registers:
            off = registers[name] == 0 and name in _OFF_AT_ZERO
            safe[name] = most if off else min(registers[name], most)
    return {name: value for name, value in safe.items() if value != registers[name]}


def profile(series: Series, registers: Mapping[str, int]) -> Profile:
    """Ramp of the set-point: acceleration in 100 counts/s², speed, and time in ms (SCS).

    A speed overrides the time. It is in counts/s, in 50 counts/s of HLS servos and of STS servos
    whose phase says so.
    """
    count = math.tau / (counts_of(series.name) or series.counts)
    acceleration, speed = registers.get("acceleration", 0), registers.get("goal_speed", 0)
    duration = 0 if speed else registers.get("goal_time", 0)
    named = {"acceleration": acceleration, "goal_speed": speed, "goal_time": duration}
    fine = registers.get("phase", 0) & _SINGLE_COUNTS if _is_sts(series) else series.big_endian
    return Profile(
        speed * count * (1 if fine else _FAST_SPEED_COUNTS_S) if speed else math.inf,
        _ACCELERATION_COUNTS_S2 * acceleration * count if acceleration else math.inf,
        duration / 1e3,
        tuple(name for name, value in named.items() if value),
    )


def family_faults(series: Series, registers: Mapping[str, int]) -> list[RegisterFault]:
    """Registers with which a servo of these series does not move."""
    faults = []
    if registers.get("goal_current", 1) == 0:
        meaning = "the motor gets no current, so the servo does not move"
        cure = "Switch its power off and on, which loads protection_current (address 28) into it"
        faults.append(RegisterFault("goal_current", 0, meaning, cure))
    full_at_zero = series.big_endian or (
        _is_sts(series) and registers.get("phase", 0) & _ZERO_IS_FULL_SPEED
    )
    if not full_at_zero and registers.get("goal_speed", 1) == 0:
        meaning = "by the vendor's table 0 stops this servo, and is not its full speed"
        cure = "If it does not move, switch its power off and on, which loads its usual speed"
        faults.append(RegisterFault("goal_speed", 0, meaning, cure, False))
    return faults


def _is_sts(series: Series) -> bool:
    return series.has("protective_torque")


HEADER = b"\xff\xff"
_SHORTEST, _HIGHEST_LENGTH = 6, 252


class Frame(LineFrame):
    """A frame of these servos."""

    def encode(self) -> bytes:
        """The frame on the wire.

        Examples
        --------
        >>> Frame(1, 2, bytes([56, 2])).encode().hex(" ")
        'ff ff 01 04 02 38 02 be'
        """
        body = bytes([self.id, len(self.data) + 2, self.code]) + self.data
        return HEADER + body + bytes([checksum(body)])


def checksum(body: bytes | bytearray) -> int:
    """Checksum of the bytes from ID to the last parameter."""
    return ~sum(body) & 0xFF


class FrameReader:
    """Finds frames in a stream of bytes.

    `plausible(id, length byte)` says which can occur: garbage that looks like the start of a long
    frame would otherwise hide the true ones behind it.
    """

    def __init__(self, plausible: Callable[[int, int], bool] = lambda frame_id, length: True):
        self._plausible = plausible
        self._buffer = bytearray()
        self.rejected_bytes = 0
        """Bytes outside valid frames."""

    def feed(self, data: bytes) -> list[Frame]:
        """Frames completed by `data`."""
        self._buffer += data
        frames: list[Frame] = []
        buffer, start, end = self._buffer, 0, len(self._buffer)
        while end - start >= _SHORTEST:
            if buffer[start] != 0xFF or buffer[start + 1] != 0xFF:
                at = buffer.find(HEADER, start)
                # the last byte may be the first of a header
                at = at if at >= 0 else end - (buffer[end - 1] == 0xFF)
                self.rejected_bytes += at - start
                start = at
                continue
            frame_id, length = buffer[start + 2], buffer[start + 3]
            frame_end = start + length + 4
            possible = frame_id != 0xFF and 2 <= length <= _HIGHEST_LENGTH
            possible = possible and self._plausible(frame_id, length)
            if possible and frame_end > end:
                break
            if possible and checksum(buffer[start + 2 : frame_end - 1]) == buffer[frame_end - 1]:
                data = bytes(buffer[start + 5 : frame_end - 1])
                frames.append(Frame(frame_id, buffer[start + 4], data))
                start = frame_end
            else:
                start += 1
                self.rejected_bytes += 1
        del buffer[:start]
        return frames


class FeetechLine(SerialLine):
    """An open serial line of Feetech servos; parameters and errors are those of `SerialLine`."""

    reply_bytes = 6
    longest_return_delay_s = 0.00051  # 254 units of 2 µs
    model_bytes = 2
    rates_in_words = "1000000, 500000, 250000, 128000, 115200, 57600 or 38400"
    unused_id = HIGHEST_ID
    echo_probe = Frame(HIGHEST_ID, PING, b"").encode()
    torque_address = TORQUE_ADDRESS
    all_off = Frame(BROADCAST_ID, WRITE, bytes([TORQUE_ADDRESS, 0])).encode()

    def __init__(self, device: str, baud: int, exclusive: bool = True):
        super().__init__(device, baud, exclusive)
        self._packets = self._sdk().protocol_packet_handler()

    def answers_ping(self, servo: int) -> bool:
        """See `SerialLine`; the model number is another request."""
        request = [0, 0, servo, 2, PING, 0]
        return bool(self._exchange(lambda: self._packets.txPacket(self._port, request), [servo], 0))

    def sync_read(self, servos: Sequence[int], address: int, size: int) -> dict[int, Reply]:
        """The same bytes of several servos with one request (not on the SCS series)."""
        ids = list(servos)
        return self._exchange(
            lambda: self._packets.syncReadTx(self._port, address, size, ids, len(ids)), ids, size
        )

    def ask_model(self, servo: int) -> int:
        """Send the request whose reply holds the model number; 0 if sent."""
        return self._packets.readTx(self._port, servo, MODEL_ADDRESS, 2)

    def _reader(self, accepted: Callable[[int, int], bool]) -> FrameReader:
        return FrameReader(lambda servo, length: accepted(servo, length - 2))

    def _request(self, frame: Any) -> bytes:
        return frame.encode()

    def _sdk(self) -> Any:
        """The vendor's SDK; refuses another package of the same module name."""
        try:
            import scservo_sdk
        except ImportError as error:
            raise BusError(
                "the Feetech SDK is not installed. Run `pip install 'feetech-servo-sdk>=1.0,<2'`."
            ) from error
        if not hasattr(scservo_sdk, "PacketHandler"):
            raise BusError(
                "the package ftservo-python-sdk is installed, which puts another library under the "
                "name scservo_sdk. Run `pip uninstall ftservo-python-sdk` and then "
                "`pip install --force-reinstall 'feetech-servo-sdk>=1.0,<2'`."
            )
        return scservo_sdk


FAMILY = Family(
    name="feetech",
    open_line=FeetechLine,
    rates=(1_000_000, 500_000, 115_200, 250_000, 57_600, 38_400),
    highest_id=HIGHEST_ID,
    series=SERIES,
    by_firmware=by_firmware,
    profiles={HD1910.name: HD1910},
    presets={SCS0009.name: "mini_pupper_2_direct", STS3215.name: "sts3215"},
    error_bits=ERROR_BITS,
    present="present_position",
    reading_bytes=(6, 7, 8, 9, 10, 11),  # position, speed, load; voltage; temperature; …
    memory_pieces=(16, 15, 14, 13, 9),  # registers 0 to 66
    shaping=SHAPING,
    modes={
        1: "wheel mode",
        2: "PWM mode (HLS: current mode)",
        3: "step mode (HLS: PWM mode)",
    },
    position_mode=0,
    turns_freely=frozenset(),
    acknowledges=1,
    profile=profile,
    family_faults=family_faults,
    protections=protections_to_set,
    volt_scale=0.1,
    load=("present_load", 1e-3),
    return_delay_unit_s=2e-6,
    tool="Feetech's FD program",
)


class FeetechBus(SerialBus):
    """Feetech servos on a serial line; parameters and errors are those of `SerialBus`."""

    family = FAMILY
