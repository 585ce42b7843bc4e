"""A `ServoBus` through the proxy of the Mini Pupper 2: `esp32-proxy`, a socket on the robot.

The proxy shares one block of memory among all its clients: the last writer wins, a client that died
goes unnoticed, and the feedback is 20 to 100 ms old without a time stamp. Hence one owner at a time
(`hardware.lock`), a time-out on every exchange and a new connection after anything unexpected.
Stale readings are passed on as they come; `sysid` estimates their feedback age.

A datagram is one message, little endian, `length, opcode, payload`; layouts are those of the
vendor's proxy, servos in the order of their ids, 1 to 12. `AF_UNIX` datagrams have no checksum:
length, opcode and range are checked, and every position is read twice.

Counts are those of the firmware's stored calibration, not raw ones.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError, InputError, MissingDevice
from pupper_sysid.hardware.address import SOCKET, BusAddress
from pupper_sysid.hardware.bus import BusSample, Sent, finite_angles
from pupper_sysid.hardware.imu import ImuSample, from_chip
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.lock import acquire
from pupper_sysid.hardware.loop import HostClock

SERVOS = 12
SET_POSITION, GET_POSITION, GET_LOAD, GET_IMU, GET_POWER = 1, 2, 3, 4, 5

TORQUE_OFF, TORQUE_ON = 0, 1
SAVE_CALIBRATION = 99
"""As first torque byte it makes the proxy store a calibration: never sent from here."""

NO_COUNT = -1
HIGHEST_COUNT = 1023

_SET = struct.Struct("<BB12B12H")
_REPLIES = {
    GET_POSITION: struct.Struct("<BB12H"), GET_LOAD: struct.Struct("<BB12h"),
    GET_IMU: struct.Struct("<BB6f"), GET_POWER: struct.Struct("<BB2f"),
}  # fmt: skip
"""Layouts of replies that carry numbers."""
_IMU_FULL_SCALE = np.repeat([2.0, 2048.0], 3)  # g, °/s
ACKNOWLEDGED = bytes([2, SET_POSITION])


def set_position(on: NDArray[np.bool_], counts: NDArray[np.int64]) -> bytes:
    """Request to drive the servos, in order of id, to `counts`, or to switch their torque off.

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
    if (numbers := _numbers(reply, GET_POSITION)) is None:
        return None
    counts = np.array(numbers, np.int64)
    return np.where((counts > 0) & (counts <= HIGHEST_COUNT), counts, NO_COUNT)


def parse_load(reply: bytes) -> NDArray[np.float64] | None:
    """Signed fraction of full duty by id, NaN where impossible; None if another message."""
    if (numbers := _numbers(reply, GET_LOAD)) is None:
        return None
    load = np.array(numbers, float) / 1000.0
    return np.where(np.abs(load) <= 1.03, load, np.nan)


def parse_imu(reply: bytes) -> NDArray[np.float64] | None:
    """Acceleration [g] and rate [°/s] along the chip's axes, shape (6,).

    None if it is another message or a number is beyond the chip's range. Six zeros are a failed
    read.
    """
    if (numbers := _numbers(reply, GET_IMU)) is None:
        return None
    raw = np.array(numbers, float)
    return raw if np.all(np.abs(raw) <= _IMU_FULL_SCALE) else None  # refuses NaN, too


def parse_supply(reply: bytes) -> float | None:
    """Voltage of the servos [V]; None if another message or a number is impossible."""
    volts, amperes = _numbers(reply, GET_POWER) or (np.nan, np.nan)
    # the divider's full scale is 10.3 V and 13.2 A
    return volts if 0 <= volts <= 11 and -1 <= amperes <= 14 else None


def _numbers(reply: bytes, opcode: int) -> tuple[Any, ...] | None:
    """Numbers of the reply to a request; None if it is another message."""
    layout = _REPLIES[opcode]
    if len(reply) != layout.size or reply[:2] != bytes([layout.size, opcode]):
        return None
    return layout.unpack(reply)[2:]


TIMEOUT_S = 0.03
VOLTAGE_BAND_V = (4.2, 8.7)
"""Below, the firmware soon switches the servos off for good; no pack of this robot exceeds it."""
SPEED_LIMIT_RAD_S = 7.5

_POWER_EVERY_S = 0.5
_RECONNECT_S = 0.01
_LARGEST_REPLY = 64
_MOST_OLD_REPLIES = 16
_SAME_READINGS = 3
_TORQUE_TRIES = 5
_ANY_COUNT = 512

Answer = TypeVar("Answer")


class Esp32Bus(HostClock):
    """The twelve servos behind the proxy at this socket.

    `joint_map` is for the proxy's counts; by default the preset mini_pupper_2, in servo
    coordinates. `exclusive` refuses a robot that another program drives; only what switches the
    torque off goes without.
    """

    name = "esp32"

    def __init__(
        self, path: Path = SOCKET, joint_map: JointMap | None = None, exclusive: bool = True
    ):
        super().__init__()
        self.path = Path(path)
        self.joint_map = joint_map or load_joint_map("mini_pupper_2").per_servo()
        name = self.joint_map.file.name
        if self.joint_map.frame != "proxy":
            raise InputError(
                f"the joint map {name} holds raw counts, and the proxy uses calibrated ones. Make "
                "a map with `pupper-sysid calibrate-joints --bus esp32`."
            )
        if self.joint_map.file.counts != HIGHEST_COUNT + 1:
            raise InputError(
                f"the joint map {name} is for servos of {self.joint_map.file.counts} counts; the "
                f"proxy's have {HIGHEST_COUNT + 1}. Choose another map, such as mini_pupper_2."
            )
        if sorted(self.joint_map.ids) != list(range(1, SERVOS + 1)):
            raise InputError(
                f"the joint map {name} has the ids {sorted(self.joint_map.ids)}; the proxy drives "
                "the servos 1 to 12 together, so the map must have them all."
            )
        self._by_id = np.array(self.joint_map.ids) - 1
        if not hasattr(socket, "SOCK_SEQPACKET") or not hasattr(socket, "AF_UNIX"):
            raise BusError("the proxy's socket exists on Linux only; run this on the robot.")
        self._owner = acquire(self.path) if exclusive else None
        self._socket: socket.socket | None = None
        self._retry_s = 0.0
        self._supply_v: float | None = None
        self._supply_s = -np.inf
        self._on = np.ones(SERVOS, bool)
        self._command = np.full(SERVOS, NO_COUNT)  # which cannot be sent
        self.joint_names = self.joint_map.joint_names
        self.limits = self.joint_map.position_limits()
        self.metadata: dict[str, Any] = {
            "kind": "esp32 proxy",
            "readings": "polled",
            "socket": str(self.path),
            "speed_limit_rad_s": SPEED_LIMIT_RAD_S,
            "voltage_band_v": list(VOLTAGE_BAND_V),
            "real_time": True,
        } | self.joint_map.metadata()
        if not self._connected():
            self.close()
            raise (BusError if self.path.exists() else MissingDevice)(
                f"{self.path}: no answer. On the robot, check `systemctl status "
                "esp32-proxy`; without a robot, start one with `pupper-sysid emulate esp32`."
            )

    @classmethod
    def open_address(
        cls,
        address: BusAddress,
        joint_map: JointMap | None,
        joints: Sequence[str] | None,
        exclusive: bool,
    ) -> Esp32Bus:
        """The bus at an address; it always has all joints."""
        return cls(Path(address.where), joint_map, exclusive)

    @classmethod
    def limp_address(cls, address: BusAddress, ids: Sequence[int] | None) -> None:
        """Nothing can be sent to servos whose proxy is not known yet."""

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send commands; the proxy's acknowledgement does not mean that a servo has them."""
        command = finite_angles(position_rad, SERVOS, str(self.path))
        self._command[self._by_id] = self.joint_map.clip_counts(self.joint_map.to_counts(command))
        sent_s = self.now()
        return Sent(sent_s if self._send_command() else float("nan"), command)

    def read(self) -> BusSample:
        """Contents of the proxy's block; NaN where it is empty or the proxy did not answer."""
        before = self.now()
        by_id = self._settled_counts()
        at = round((before + self.now()) / 2, 6)
        count = by_id[self._by_id]
        load = self._ask(GET_LOAD, parse_load)
        if self.now() - self._supply_s > _POWER_EVERY_S:
            # an impossible voltage counts as missing: an older one would hide a change of supply
            self._supply_v = self._ask(GET_POWER, parse_supply)
            self._supply_s = self._supply_s if self._supply_v is None else self.now()
        joints = len(self.joint_names)
        missing = np.full(joints, np.nan)
        return BusSample(
            np.full(joints, at),
            self.joint_map.to_angles(np.where(count < 0, np.nan, count)),
            count,
            voltage_v=missing if self._supply_v is None else np.full(joints, self._supply_v),
            load=missing if load is None else load[self._by_id],
        )

    def imu(self) -> ImuSample | None:
        """Reading of the IMU, some milliseconds old; None if it or the proxy did not answer.

        As with positions, an answer is valid when a second one agrees.
        """
        before = self.now()
        seen: list[list[float]] = []
        for _ in range(_SAME_READINGS):
            raw = self._ask(GET_IMU, parse_imu)
            if raw is None:
                return None
            if raw.tolist() in seen:
                return from_chip(round((before + self.now()) / 2, 6), raw)
            seen.append(raw.tolist())
        return None

    def torque(self, on: bool) -> bool:
        """Hold the present pose, or switch the torque off.

        Nothing is sent while a position is missing: all commands go out together, and that servo's
        would be a guess.
        """
        if on and not self._hold_present():
            return False
        self._on[:] = on
        for _ in range(_TORQUE_TRIES):
            if self._send_command():
                return True
            time.sleep(_RECONNECT_S)
        return False

    def goals(self) -> NDArray[np.float64]:
        """NaN: the proxy does not report its set-points."""
        return np.full(len(self.joint_names), np.nan)

    def close(self) -> None:
        """Release the socket; the servos keep their last command."""
        self._retry_s = float("inf")
        self._disconnect()
        if self._owner is not None:
            os.close(self._owner)
            self._owner = None

    def _hold_present(self) -> bool:
        """Make the present counts the command; False if not all became known in time."""
        present = np.full(SERVOS, NO_COUNT)
        for _ in range(_TORQUE_TRIES):
            counts = self._settled_counts()
            present = np.where(counts > 0, counts, present)
            if (present > 0).all():
                self._command = present
                return True
            time.sleep(_RECONNECT_S)
        return False

    def _settled_counts(self) -> NDArray[np.int64]:
        """Counts by id on which two successive answers agree."""
        last = None
        settled = np.full(SERVOS, NO_COUNT)
        for _ in range(_SAME_READINGS):
            counts = self._ask(GET_POSITION, parse_counts)
            if counts is None:
                break
            if last is not None:
                # the block may be refreshed between the two readings: a third one decides
                settled = np.where(counts == last, counts, settled)
                if (counts == last).all():
                    break
            last = counts
        return settled

    def _send_command(self) -> bool:
        # with a torque byte of 0 the count is not used, but must be valid
        counts = np.where(self._on | (self._command > 0), self._command, _ANY_COUNT)
        request = set_position(self._on, counts)
        if self._exchange(request) == ACKNOWLEDGED:
            return True
        self._disconnect()
        return False

    def _ask(self, opcode: int, parse: Callable[[bytes], Answer | None]) -> Answer | None:
        reply = self._exchange(request(opcode))
        parsed = None if reply is None else parse(reply)
        if parsed is None:
            # a further answer would belong to no request
            self._disconnect()
        return parsed

    def _exchange(self, request: bytes) -> bytes | None:
        """Reply to one request; None if there was none in time."""
        if not self._connected():
            return None
        assert self._socket is not None
        try:
            # data that are there already belong to an earlier request
            for _ in range(_MOST_OLD_REPLIES):
                if not select.select([self._socket], [], [], 0)[0]:
                    break
                self._socket.recv(_LARGEST_REPLY)
            self._socket.sendall(request)
            if reply := self._socket.recv(_LARGEST_REPLY):
                return reply
        except OSError:  # time-outs too
            pass
        self._disconnect()
        return None

    def _connected(self) -> bool:
        """Whether there is a connection; tries to make one."""
        if self._socket is not None:
            return True
        if time.monotonic() < self._retry_s:
            return False
        self._retry_s = time.monotonic() + _RECONNECT_S
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        connection.settimeout(TIMEOUT_S)
        try:
            connection.connect(str(self.path))
        except OSError:
            connection.close()
            return False
        self._socket = connection
        return True

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
