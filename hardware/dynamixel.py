"""Dynamixel servos with protocol 2.0 as a `ServoBus`: `--bus dynamixel:/dev/ttyUSB0`.

One control table, by model number, serves the X series and MX(2.0): models differ in factory
values, and XL430 and MX-28 report a load where the others report a current. Registers below 64 are
EEPROM, which a servo writes with the torque off only.

Frames are `FF FF FD 00 ID LEN_L LEN_H INST ... CRC_L CRC_H`. A status frame has the instruction 55
and an error byte before its parameters. Bytes `FF FF FD` inside a frame are followed by a stuffed
`FD`, so that a header cannot occur there; LEN counts what follows it, stuffing included. The CRC is
CRC-16 with the polynomial 8005, from the header on.

While the torque is on, each servo's own bus watchdog is set: it stops the servo if no program talks
to it for 2 s, even if every process of the host is gone. `keep_alive` talks to the servos in
pauses of a driver.

Servos are read by fast sync read where all of them support it. They answer with one status frame of
the broadcast id, to which each adds error byte, id, data and the CRC of all bytes before it, right
behind the servo before it. Nothing in that frame is stuffed. One return delay remains instead of
one per servo. A servo that fails leaves those behind it without an answer, so after an incomplete
one plain sync read is used until all have answered again.

Sources: Robotis e-Manual, protocol 2.0, and control tables of XL330-M288, XL430-W250, XM430-W350,
XH430-W350 and MX-28(2.0), which agree on every address here, as does LeRobot's table; model numbers
of Robotis' ROS driver and of two users' drivers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.serial_servos.bus import LineServo, SerialBus
from pupper_sysid.hardware.serial_servos.line import SLOWEST_ADAPTER_S, LineFrame, Reply, SerialLine
from pupper_sysid.hardware.serial_servos.series import Family, Profile, Register, Series
from pupper_sysid.hardware.serial_servos.settings import RegisterFault, read_register

PING, READ, WRITE, REG_WRITE, ACTION, FACTORY_RESET, REBOOT, CLEAR = 1, 2, 3, 4, 5, 6, 8, 16
SYNC_READ, SYNC_WRITE, FAST_SYNC_READ = 0x82, 0x83, 0x8A
BULK_READ, BULK_WRITE, FAST_BULK_READ = 0x92, 0x93, 0x9A
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
    "registered_instruction": Register(69),
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
    1190: "XL330-M077", 1200: "XL330-M288", 1230: "XC330-M181", 1240: "XC330-M288",
    1210: "XC330-T181", 1220: "XC330-T288", 1060: "XL430-W250", 1090: "2XL430-W250",
    1070: "XC430-W150", 1080: "XC430-W240", 1160: "2XC430-W250", 1030: "XM430-W210",
    1020: "XM430-W350", 1010: "XH430-W210", 1000: "XH430-W350", 1050: "XH430-V210",
    1040: "XH430-V350", 1011: "XD430-T210", 1001: "XD430-T350", 1280: "XW430-T200",
    1270: "XW430-T333", 1130: "XM540-W150", 1120: "XM540-W270", 1110: "XH540-W150",
    1100: "XH540-W270", 1150: "XH540-V150", 1140: "XH540-V270", 1111: "XD540-T150",
    1101: "XD540-T270", 1180: "XW540-T140", 1170: "XW540-T260", 30: "MX-28", 311: "MX-64",
    321: "MX-106",
}  # fmt: skip
"""Names by model number; MX are those with the firmware for protocol 2.0."""


SERIES = {
    model: Series(
        name, model, big_endian=False, counts=4096, has_sync_read=True, lock_address=None,
        registers=_TABLE, aliases=_ALIASES, eeprom_end=64,
        offset_sign=-1,  # present = encoder + homing offset
    )
    for model, name in MODELS.items()
}  # fmt: skip

FAST_SINCE = {"X330": 46, "X430": 45, "X540": 45}
"""First firmware with fast sync read, by the models' size: Robotis e-Manual, protocol 2.0, section
Fast Sync Read. MX have none (Robotis' forum: "DYNAMIXEL X Series only"). Neither was tried."""


def has_fast_sync_read(series: Series, firmware: int) -> bool:
    """Whether a servo answers fast sync reads.

    Examples
    --------
    >>> [has_fast_sync_read(SERIES[model], 45) for model in (1200, 1020, 30)]
    [False, True, False]
    """
    size = "X" + series.name[2:5]  # XL330-M288: X330
    return series.name.startswith("X") and firmware >= FAST_SINCE.get(size, 256)


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


def family_faults(series: Series, registers: Mapping[str, int]) -> list[RegisterFault]:
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
    if (second_id := registers["secondary_id"]) <= HIGHEST_ID:
        meaning = f"the servo also obeys the commands to id {second_id}"
        cure = f"Write 255 into it with {FAMILY.tool}, or leave the servo out of the joint map"
        faults.append(RegisterFault("secondary_id", second_id, meaning, cure))
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
    safe = {
        "shutdown": registers["shutdown"] | _OVERLOAD_AND_HEAT, "bus_watchdog": WATCHDOG_UNITS,
    }  # fmt: skip
    return {name: value for name, value in safe.items() if value != registers[name]}


HEADER = b"\xff\xff\xfd\x00"
STATUS = 0x55
_STUFFED, _STUFFING = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
_SHORTEST, _LONGEST = 10, 1024
_POLYNOMIAL = 0x8005


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ _POLYNOMIAL if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """CRC of a frame's bytes before it; `crc` is that of the bytes before `data`.

    Examples
    --------
    >>> hex(crc16(bytes.fromhex("ff ff fd 00 01 03 00 01")))
    '0x4e19'
    """
    for byte in data:
        crc = (crc << 8 ^ _CRC_TABLE[crc >> 8 ^ byte]) & 0xFFFF
    return crc


@dataclass(frozen=True)
class Frame(LineFrame):
    """A frame of these servos; its data are without stuffing."""

    is_status: bool = False

    def encode(self) -> bytes:
        """The frame on the wire.

        Examples
        --------
        >>> Frame(1, 1, b"").encode().hex(" ")
        'ff ff fd 00 01 03 00 01 19 4e'
        """
        body = (bytes([STATUS]) if self.is_status else b"") + bytes([self.code]) + self.data
        body = body.replace(_STUFFED, _STUFFING)
        head = HEADER + bytes([self.id]) + (len(body) + 2).to_bytes(2, "little")
        return head + body + crc16(head + body).to_bytes(2, "little")


FAST_HEAD_BYTES, FAST_BLOCK_BYTES = 8, 4
"""Of the answer to a fast sync read: before the first servo's block; of a block without data."""


def fast_head(sizes: Sequence[int]) -> bytes:
    """First bytes of the answer to a fast read of so many bytes of each servo.

    Examples
    --------
    >>> fast_head([4, 4, 4]).hex(" ")
    'ff ff fd 00 fe 19 00 55'
    """
    length = 1 + sum(sizes) + len(sizes) * FAST_BLOCK_BYTES
    return HEADER + bytes([BROADCAST_ID]) + length.to_bytes(2, "little") + bytes([STATUS])


def fast_replies(answer: bytes, servos: Sequence[int], size: int) -> list[Frame]:
    """Status frames of servos, in the request's order, from the answer to a fast sync read.

    The answer, from its header on, may be incomplete: a block counts if all bytes up to its CRC are
    right, so those before a damaged byte are kept.
    """
    frames, at = [], FAST_HEAD_BYTES
    crc = crc16(answer[:at])
    for servo in servos:
        end = at + size + FAST_BLOCK_BYTES
        block = answer[at:end]
        crc = crc16(block[:-2], crc)
        if len(block) < end - at or block[1] != servo or crc != block[-2] | block[-1] << 8:
            break
        frames.append(Frame(servo, block[0], block[2:-2], is_status=True))
        crc, at = crc16(block[-2:], crc), end
    return frames


class FrameReader:
    """Finds status frames, or requests, in a stream that may hold anything.

    Where a frame is incomplete behind a new header, or its CRC wrong, its first byte is dropped and
    the search goes on, so garbage before, between or around frames is skipped. `plausible(id,
    parameter bytes)` says which frames can occur.
    """

    def __init__(
        self,
        plausible: Callable[[int, int], bool] = lambda frame_id, size: True,
        status: bool = False,
    ):
        self._plausible, self._status = plausible, status
        self._buffer = bytearray()
        self.rejected_bytes = 0
        """Bytes outside valid frames."""
        self.crc_errors: list[int] = []
        """Ids of frames whose CRC was wrong."""

    def feed(self, data: bytes) -> list[Frame]:
        """Frames completed by `data`."""
        self._buffer += data
        frames: list[Frame] = []
        buffer = self._buffer
        while len(buffer) >= _SHORTEST:
            if not buffer.startswith(HEADER):
                at = buffer.find(HEADER, 1)
                self._drop(at if at >= 0 else len(buffer) - (len(HEADER) - 1))
                continue
            length = buffer[5] | buffer[6] << 8
            size = length + 7
            if length < 3 or size > _LONGEST:
                self._drop(1)
                continue
            # byte stuffing keeps headers out of a frame: a header inside starts the next frame
            following = buffer.find(HEADER, 4, min(size - 2, len(buffer)))
            if following >= 0:
                self._drop(following)
                continue
            if size > len(buffer):
                break
            if crc16(buffer[: size - 2]) != buffer[size - 2] | buffer[size - 1] << 8:
                self.crc_errors.append(buffer[4])
                self._drop(1)
                continue
            body = bytes(buffer[7 : size - 2]).replace(_STUFFING, _STUFFED)
            is_status = body[0] == STATUS
            code, data = body[is_status : is_status + 1], body[is_status + 1 :]
            # a frame of the other kind, or without a code, is rejected
            if is_status == self._status and code and self._plausible(buffer[4], len(data)):
                frames.append(Frame(buffer[4], code[0], data, is_status))
            else:
                self.rejected_bytes += size
            del buffer[:size]
        return frames

    def _drop(self, count: int) -> None:
        self.rejected_bytes += count
        del self._buffer[:count]


_PROTOCOL = 2.0
_TORQUE = SERIES[1200].register("torque_enable").address


class DynamixelLine(SerialLine):
    """An open serial line of Dynamixel servos; parameters and errors are those of `SerialLine`."""

    reply_bytes = 11
    longest_return_delay_s = 0.00051  # 254 units of 2 µs
    model_bytes = 3  # model number and firmware, in the reply to a ping
    rates_in_words = "57600, 115200, 1000000, 2000000, 3000000 or 4000000"
    unused_id = HIGHEST_ID
    echo_probe = Frame(HIGHEST_ID, PING, b"").encode()
    torque_address = _TORQUE
    all_off = Frame(BROADCAST_ID, WRITE, _TORQUE.to_bytes(2, "little") + b"\0").encode()

    def __init__(self, device: str, baud: int, exclusive: bool = True):
        super().__init__(device, baud, exclusive)
        self._packets = self._sdk().PacketHandler(_PROTOCOL)
        self.fast: frozenset[int] = frozenset()
        """Ids of servos that answer fast sync reads."""
        self._was_fast = self._incomplete = False

    def sync_read(self, servos: Sequence[int], address: int, size: int) -> dict[int, Reply]:
        """The same bytes of several servos with one request; fast, if all of them can."""
        ids = list(servos)
        # one servo's plain answer is shorter
        self._was_fast = len(ids) > 1 and self.fast.issuperset(ids) and not self._incomplete
        if self._was_fast:
            replies = self.fast_sync_read(ids, address, size)
        else:
            replies = self._exchange(
                lambda: self._packets.syncReadTx(self._port, address, size, ids, len(ids), False),
                ids, size,
            )  # fmt: skip
        self._incomplete = len(replies) < len(ids)
        return replies

    def fast_sync_read(self, servos: Sequence[int], address: int, size: int) -> dict[int, Reply]:
        """`sync_read` by the fast request, whether or not all servos support it."""
        ids, arrived = list(servos), bytearray()
        head, block = fast_head([size] * len(ids)), size + FAST_BLOCK_BYTES
        reply_bytes, last_s = len(head) + len(ids) * block, 0.0
        kind = FAST_SYNC_READ, len(ids), 0  # the wait before the blocks depends on no size

        def take(data: bytes) -> bool:
            nonlocal last_s
            if data:
                arrived.extend(data)
                last_s = time.monotonic()
            at = arrived.find(head)
            return at >= 0 and len(arrived) - at >= reply_bytes

        begin = self._listen(
            lambda: self._packets.syncReadTx(self._port, address, size, ids, len(ids), True),
            reply_bytes, 1, take,
        )  # fmt: skip
        at = arrived.find(head)
        if begin is None or at < 0:
            return {}
        frames = fast_replies(bytes(arrived[at : at + reply_bytes]), ids, size)
        # the servos' blocks follow each other without a pause, so each ends at its own byte
        turn_s = block * self._byte_s()
        if len(frames) == len(ids):
            waited_s = self._least_s(kind, max(last_s - begin - len(ids) * turn_s, 0.0), True)
        else:
            waited_s = self._fastest_s.get(kind, len(head) * self._byte_s())
        first_s = begin + waited_s
        return {
            frame.id: Reply(
                frame, first_s + k * turn_s, first_s + (k + 1) * turn_s, 0.0 if k else waited_s
            )
            for k, frame in enumerate(frames)
        }

    def try_fast(self, servos: Sequence[int], address: int) -> bool:
        """Whether all of these servos answer one fast sync read; if so, it is used from then on."""
        usual_s, self.patience_s = self.patience_s, max(self.patience_s, SLOWEST_ADAPTER_S)
        replies = self.fast_sync_read(servos, address, 1)
        self.patience_s = usual_s
        self.fast = frozenset(replies) if len(replies) == len(servos) else frozenset()
        return bool(self.fast)

    def sync_read_s(self, delays_s: Sequence[float], size: int) -> float:
        """See `SerialLine.sync_read_s`; of a fast one, the first servo's return delay counts."""
        if not self._was_fast:
            return super().sync_read_s(delays_s, size)
        reply_bytes = FAST_HEAD_BYTES + len(delays_s) * (size + FAST_BLOCK_BYTES)
        return delays_s[0] + reply_bytes * self._byte_s()

    def ask_model(self, servo: int) -> int:
        """Send a ping, whose reply holds the model number; 0 if sent."""
        request = [0, 0, 0, 0, servo, 3, 0, PING, 0, 0]
        return self._packets.txPacket(self._port, request)

    def _reader(self, accepted: Callable[[int, int], bool]) -> FrameReader:
        return FrameReader(accepted, status=True)

    def _request(self, frame: Any) -> bytes:
        return b""  # an echo is no status frame

    def _sdk(self) -> Any:
        try:
            import dynamixel_sdk
        except ImportError as error:
            raise BusError(
                "the Dynamixel SDK is not installed. Run `pip install 'dynamixel-sdk>=3.8'`."
            ) from error
        return dynamixel_sdk


FAMILY = Family(
    name="dynamixel",
    open_line=DynamixelLine,
    rates=(1_000_000, 57_600, 2_000_000, 3_000_000, 4_000_000, 115_200),
    highest_id=HIGHEST_ID,
    series=SERIES,
    by_firmware=lambda line, servo, model: None,
    profiles={},
    presets={},
    error_bits=HARDWARE_ERRORS | {ALERT: "hardware error"},
    present="present_pwm",
    reading_bytes=(12, 13, 14, 15, 16, 23),  # PWM, current, velocity, position; … voltage, heat
    memory_pieces=(40, 38, 37, 32),
    shaping=SHAPING,
    modes={0: "current mode", 1: "velocity mode", 16: "PWM mode"},
    position_mode=POSITION_MODE,
    turns_freely=frozenset({EXTENDED_POSITION_MODE, CURRENT_BASED_POSITION_MODE}),
    acknowledges=2,
    profile=profile,
    family_faults=family_faults,
    protections=protections,
    volt_scale=0.1,
    load=("present_pwm", 1 / FULL_PWM),
    return_delay_unit_s=2e-6,
    tool="DYNAMIXEL Wizard",
)


class DynamixelBus(SerialBus):
    """Dynamixel servos on a serial line; parameters and errors are those of `SerialBus`."""

    family = FAMILY
    _turns = 256  # of the extended position mode

    def register(self, joint: str, name: str) -> int:
        """Present value of a register; that of a bus watchdog that has acted is 0 (off)."""
        value = super().register(joint, name)
        return 0 if name == "bus_watchdog" and value == TRIGGERED else value

    def set_register(self, joint: str, name: str, value: int) -> None:
        """Set a register and read it back; a bus watchdog that has acted is cleared before."""
        if name == "bus_watchdog" and value:
            super().set_register(joint, name, 0)
        super().set_register(joint, name, value)

    def keep_alive(self) -> None:
        """Talk to every servo, so that its bus watchdog does not act."""
        heat = self._servos[0].series.register("present_temperature").address
        self.line.sync_read([servo.id for servo in self._servos], heat, 1)

    def _choose_reading(self) -> str:
        """Fast sync read, if all servos support it by their firmware and answer to one trial."""
        able = [
            servo.id for servo in self._servos
            if has_fast_sync_read(servo.series, (servo.registers or {}).get("firmware", 0))
        ]  # fmt: skip
        assert isinstance(self.line, DynamixelLine)
        if len(able) > 1 and len(able) == len(self._servos):
            where = self._servos[0].series.register("present_temperature").address
            if self.line.try_fast(able, where):
                return "fast sync read"
        return super()._choose_reading()

    def _status(self, servo: LineServo, reply: Reply) -> int:
        if not reply.frame.code & ALERT:
            return 0
        errors = read_register(self.line, servo.id, servo.series, "hardware_error_status")
        return errors or ALERT
