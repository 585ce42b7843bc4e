"""A serial line of Feetech servos: the vendor's SDK sends the requests, replies are read here.

The SDK (`scservo_sdk`) builds and sends every frame. Its port and its receiver are replaced for
faults that were measured on version 1.0.0: it keeps byte order in a module global, waits 34 ms for
a missing servo, takes a late reply for the answer to the next request, does not check a reply's
length, loses the replies of a group read after one silent servo, stays "busy" after an error, takes
an adapter's echo for a reply, spins while it waits, and lets two programs open one port. Here

* every exchange has its own deadline, and ends as soon as all addressed servos have answered;
* bytes that arrived before the request are discarded; a reply must have the requested length and
  come from an addressed servo; two different replies of one servo count as none;
* an adapter that echoes is detected when the port is opened, and its echo is removed;
* an error of the port (unplugged) closes it; the next exchange tries to open it again.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import serial

from pupper_sysid.common.errors import BusError, MissingDevice
from pupper_sysid.common.files import resolved
from pupper_sysid.hardware.feetech.frames import Frame, FrameReader
from pupper_sysid.hardware.feetech.registers import (
    BROADCAST_ID,
    MODEL_ADDRESS,
    PING,
    SERIES,
    TORQUE_ADDRESS,
    Series,
    series_of_model_bytes,
)

try:
    from termios import error as _TermiosError
except ImportError:  # Windows
    _TermiosError = OSError

PORT_ERRORS = (OSError, serial.SerialException, _TermiosError)

REPLY_TIMEOUT_S = 0.003
"""Allowance for the host's own delays, beyond the time that bytes and servos need."""

RETURN_DELAY_S = 0.00051
"""Longest return delay of a servo (254 units of 2 µs)."""

FRAME_BYTES = 6
"""Length of a reply without its data."""

_POLL_S = 0.001
_REOPEN_S = 0.01
_ATTEMPTS = 4


@dataclass(frozen=True)
class Reply:
    """Reply of a servo, with `time.monotonic()` around its own part of the exchange."""

    frame: Frame
    before_s: float
    after_s: float


class FeetechLine:
    """An open serial line.

    Parameters
    ----------
    device : str
        Serial port.
    baud : int
        Bits per second.
    exclusive : bool
        Whether to refuse a port that another program has open.

    Raises
    ------
    BusError
        If the port cannot be opened, is in use, or the other SDK of the same name is installed.
    """

    def __init__(self, device: str, baud: int, exclusive: bool = True):
        self.device, self.baud, self.echoes = device, baud, False
        self.patience_s = REPLY_TIMEOUT_S
        self._port = _sdk_port(device, baud, exclusive)
        self._packets = _sdk().protocol_packet_handler()
        self._retry_s = self._busy_s = 0.0
        try:
            self._port.openPort()
        except PORT_ERRORS as error:
            if not Path(device).exists():  # a wrong name, not a fault of the line
                raise MissingDevice(_cannot_open(device, error)) from error
            raise BusError(_cannot_open(device, error)) from error
        # a USB adapter may collect bytes for 16 ms
        self.patience_s += _latency_s(device)

    def ping(self, servo: int) -> Frame | None:
        """Status frame of `servo`, or None if it does not answer."""
        reply = self._exchange(
            lambda: self._packets.txPacket(self._port, [0, 0, servo, 2, PING, 0]), [servo], 6, 0
        ).get(servo)
        return reply.frame if reply else None

    def read(self, servo: int, address: int, size: int) -> Reply | None:
        """`size` bytes of the memory of `servo`, or None if they did not come complete."""
        return self._exchange(
            lambda: self._packets.readTx(self._port, servo, address, size), [servo], 8, size
        ).get(servo)

    def sync_read(self, servos: Sequence[int], address: int, size: int) -> dict[int, Reply]:
        """The same bytes of several servos with one request (not on the SCS series)."""
        ids = list(servos)
        return self._exchange(
            lambda: self._packets.syncReadTx(self._port, address, size, ids, len(ids)),
            ids, 8 + len(ids), size,
        )  # fmt: skip

    def write(self, servo: int, address: int, data: bytes) -> bool:
        """Write to one servo; whether it acknowledged."""
        sent = self._exchange(
            lambda: self._packets.writeTxOnly(self._port, servo, address, len(data), list(data)),
            [servo], 7 + len(data), 0,
        )  # fmt: skip
        return servo in sent

    def sync_write(self, address: int, values: dict[int, bytes]) -> float:
        """Write to several servos, unacknowledged; `time.monotonic()` of sending, NaN if failed.

        Raises
        ------
        ValueError
            If the values differ in length.
        """
        sizes = {len(v) for v in values.values()}
        if len(sizes) != 1:
            raise ValueError(f"sync_write: values of {sorted(sizes)} bytes; all must be as long.")
        size = sizes.pop()
        params = [byte for servo, value in values.items() for byte in (servo, *value)]
        before = time.monotonic()
        ok = self._sent(
            lambda: self._packets.syncWriteTxOnly(self._port, address, size, params, len(params))
        )
        # the port accepts the bytes at once; the wire takes longer
        self._busy_s = before + len(self._port.sent) * self._byte_s()
        if ok and self.echoes:  # or the echo would come between the next request and its reply
            self._arrived(len(self._port.sent))
        return before if ok else float("nan")

    def torque_off(self, servos: Sequence[int]) -> None:
        """Switch the torque of all these off at once; it needs no reply, and confirms nothing."""
        self.sync_write(TORQUE_ADDRESS, {servo: b"\0" for servo in servos})

    def model(self, servo: int) -> int | Series | None:
        """Series of `servo`; its model number (little endian) if unknown; None if no reply."""
        reply = self.read(servo, MODEL_ADDRESS, 2)
        if reply is None:
            return None
        raw = reply.frame.data
        return series_of_model_bytes(raw) or int.from_bytes(raw, "little")

    def detect_echo(self) -> bool:
        """Whether the adapter echoes requests; the echo is removed from then on."""
        request = Frame(BROADCAST_ID - 1, PING, b"").encode()
        self.echoes = False
        if not self._sent(lambda: self._send_raw(request)):
            return False
        self.echoes = self._arrived(len(request)).startswith(request)
        return self.echoes

    def find(self, servos: Sequence[int]) -> dict[int, int | Series]:
        """Those of `servos` that answer, with their series or unknown model number."""
        found: dict[int, int | Series] = {}
        for servo in servos:
            # a first frame can be lost to earlier bytes on the line
            for _ in range(_ATTEMPTS):
                model = self.model(servo)
                if model is not None:
                    found[servo] = model
                    break
        return found

    def close(self) -> None:
        """Release the port; may be called twice."""
        self._retry_s = float("inf")
        with contextlib.suppress(*PORT_ERRORS):
            self._port.shut()

    def _byte_s(self) -> float:
        return 10.0 / self.baud

    def _drop_port(self) -> None:
        with contextlib.suppress(*PORT_ERRORS):
            self._port.shut()
        self._port.is_open = False

    def _arrived(self, count: int) -> bytes:
        """About `count` bytes, as far as they arrive in time."""
        until, got = time.monotonic() + 2 * count * self._byte_s() + self.patience_s, b""
        with contextlib.suppress(*PORT_ERRORS):
            while len(got) < count and time.monotonic() < until:
                got += self._port.read_some()
        return got

    def _send_raw(self, packet: bytes) -> int:
        self._port.clearPort()
        self._port.writePort(packet)
        return 0

    def _sent(self, send: Callable[[], int]) -> bool:
        """Send; whether that succeeded. Opens the port again if it was lost."""
        port = self._port
        try:
            if not port.is_open:
                if time.monotonic() < self._retry_s:
                    return False
                self._retry_s = time.monotonic() + _REOPEN_S
                port.openPort()
            return send() == 0
        except PORT_ERRORS:
            self._drop_port()
            return False
        finally:
            port.is_using = False  # the SDK leaves it set after an error

    def _exchange(
        self, send: Callable[[], int], servos: Sequence[int], asked: int, size: int
    ) -> dict[int, Reply]:
        """Send, and collect one reply of `size` parameter bytes from each of `servos`."""
        before = time.monotonic()
        if not self._sent(send):
            return {}
        wanted = set(servos)
        reader = FrameReader(lambda frame_id, length: frame_id in wanted and length == size + 2)
        answer = size + FRAME_BYTES
        wire = (asked + len(servos) * answer) * self._byte_s()
        deadline = max(before, self._busy_s) + wire + len(servos) * RETURN_DELAY_S + self.patience_s
        owed = self._port.sent if self.echoes else b""
        found: dict[int, tuple[Frame, float]] = {}
        contradicted: set[int] = set()
        try:
            while len(found) < len(wanted) and time.monotonic() < deadline:
                data = self._port.read_some()
                if owed:
                    data, owed = _strip(data, owed)
                for frame in reader.feed(data):
                    first = found.setdefault(frame.id, (frame, time.monotonic()))
                    if first[0] != frame:
                        contradicted.add(frame.id)
        except PORT_ERRORS:
            self._drop_port()
        # replies come evenly, in the order of the request; the host's buffers blur each arrival
        begin = max(before, self._busy_s) + asked * self._byte_s()
        last = max((k for k, servo in enumerate(servos) if servo in found), default=0)
        after = max((arrived for _, arrived in found.values()), default=begin)
        share = max(after - begin, 0.0) / (last + 1)
        return {
            servo: Reply(found[servo][0], begin + k * share, begin + (k + 1) * share)
            for k, servo in enumerate(servos)
            if servo in found and servo not in contradicted
        }


def _strip(data: bytes, owed: bytes) -> tuple[bytes, bytes]:
    """Remove the echo that is still expected from the front of `data`."""
    n = min(len(data), len(owed))
    if data[:n] == owed[:n]:
        return data[n:], owed[n:]
    return data, b""  # no echo: the checksums of the frames decide


def _sdk() -> Any:
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


def _sdk_port(device: str, baud: int, exclusive: bool) -> Any:
    """Port of the SDK, without busy waiting."""

    class Port(_sdk().PortHandler):
        """Exclusive; sleeps while it waits; discards old bytes before it sends."""

        def __init__(self) -> None:
            super().__init__(device)
            self.sent = b""

        def setupPort(self, cflag_baud: int) -> bool:
            self.shut()
            # an exclusive lock: two programs on one line would destroy each other's frames
            self.ser = serial.Serial(
                self.port_name, cflag_baud, timeout=_POLL_S, write_timeout=0.5,
                exclusive=exclusive,
            )  # fmt: skip
            # some adapters and an emulated line do not have it
            with contextlib.suppress(ValueError, NotImplementedError, *PORT_ERRORS):
                self.ser.set_low_latency_mode(True)
            self.is_open = True
            self.clearPort()
            return True

        def clearPort(self) -> None:
            self.ser.reset_input_buffer()

        def writePort(self, packet: Any) -> int:
            self.sent = bytes(packet)
            return self.ser.write(self.sent) or 0

        def setPacketTimeout(self, packet_length: int) -> None:
            """Without effect: each exchange of `FeetechLine` has its own deadline."""

        def read_some(self) -> bytes:
            """Bytes that have arrived, or arrive within a millisecond."""
            return self.ser.read(max(1, self.ser.in_waiting))

        def shut(self) -> None:
            """Close if open."""
            if self.is_open and self.ser is not None:
                self.is_open = False
                self.ser.close()

    port = Port()
    if port.getCFlagBaud(baud) < 0:
        raise BusError(
            f"{device}: {baud} baud is not possible with this SDK. Use 1000000, 500000, 250000, "
            "128000, 115200, 57600 or 38400."
        )
    port.baudrate = baud
    return port


def _cannot_open(device: str, error: BaseException) -> str:
    text = str(error).lower()
    if "permission denied" in text:
        hint = "You may not use it: add yourself to the group dialout and log in again."
    elif "exclusively" in text or "busy" in text or "resource temporarily" in text:
        hint = "Another program has it open; stop that first, only one may command the servos."
    elif not Path(device).exists():
        hint = "There is no such device: check the cable and the name (ls /dev/tty*)."
    else:
        hint = "Check the cable and the name."
    return f"{device} cannot be opened. {hint} ({error})"


def _latency_s(device: str) -> float:
    """Latency timer of a USB adapter; 0 if unknown."""
    timer = Path("/sys/class/tty") / resolved(Path(device)).name / "device" / "latency_timer"
    try:
        return float(timer.read_text()) / 1e3
    except (OSError, ValueError):
        return 0.0


def known_models() -> str:
    """The supported servos in words."""
    return ", ".join(f"{s.name} ({s.model})" for s in SERIES.values())
