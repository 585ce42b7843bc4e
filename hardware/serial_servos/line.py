"""A half-duplex serial line: the vendor's SDK sends the requests, replies are read here.

The SDKs build and send every frame. Their ports and receivers are replaced, for faults that were
measured: they wait 34 ms for a missing servo, take a late reply for the answer to the next request,
stay "busy" after an error, take an adapter's echo for a reply, spin while they wait, and let two
programs open one port. Here

* every exchange has its own deadline, and ends as soon as all addressed servos have answered;
* bytes that arrived before the request are discarded; a reply must have the requested length and
  come from an addressed servo; two different replies of one servo count as none;
* an adapter that echoes is detected when the port is opened, and its echo is removed;
* an error of the port (unplugged) closes it; the next exchange tries to open it again.

How long a reply may take is measured (`SerialLine.find`): a USB adapter holds bytes back for up to
16 ms. The first requests go out without waiting for each reply, and replies are matched by their
ids however late they come.
"""

from __future__ import annotations

import contextlib
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import serial

from pupper_sysid.common.errors import BusError, MissingDevice
from pupper_sysid.common.files import resolved

try:
    from termios import error as _TermiosError
except ImportError:  # Windows
    _TermiosError = OSError

PORT_ERRORS = (OSError, serial.SerialException, _TermiosError)

REPLY_TIMEOUT_S = 0.003
"""Allowance for delays of the host, beyond the time that bytes and servos need."""
SLOWEST_ADAPTER_S = 0.06
"""Longest latency that is waited for: three times the 16 ms of an FTDI's timer, and a margin."""
SLOW_ADAPTER_S = 0.002
"""Latency from which the adapter is named: half of it is in every reading's time."""

_POLL_S = 0.001
_PAUSE_S = 0.003
_REOPEN_S = 0.01
_ATTEMPTS = 4
_MORE_PATIENCE = 10
_MEASURED_ON = 8  # exchanges
_GARBLED_AT_LEAST, _CONFIRMED_BY = 3, 6


@dataclass(frozen=True)
class LineFrame:
    """A frame with a correct checksum, of any vendor."""

    id: int
    code: int
    """Instruction of a request, error byte of a reply."""
    data: bytes
    """Parameters."""


class Reader(Protocol):
    """Finds replies in a stream of bytes."""

    rejected_bytes: int

    def feed(self, data: bytes) -> Sequence[LineFrame]:
        """Frames completed by `data`."""
        ...


@dataclass(frozen=True)
class Reply:
    """Reply of a servo, with `time.monotonic()` around its own part of the exchange."""

    frame: LineFrame
    before_s: float
    after_s: float
    waited_s: float = 0.0
    """Between the request and `before_s`, as far as it belongs to no servo's part."""


class SerialLine(ABC):
    """An open serial line of one vendor's servos; see the module's docstring.

    `exclusive` refuses a port that another program has open. `latency_s` is the time by which
    replies came later than bytes and servos need, the adapter's; 0 until `find` has measured it.
    For `patience_s` beyond that a reply is awaited.
    """

    reply_bytes: int
    """Length of a reply without its data."""
    longest_return_delay_s: float
    """By which a servo may postpone its reply."""
    model_bytes: int
    """Data of the reply to `ask_model`; the first two are the model number."""
    rates_in_words: str
    """Rates that the SDK can set."""
    unused_id: int
    """At which no servo is expected."""
    torque_address: int
    """Of the register that switches a servo's torque."""
    all_off: bytes
    """The request that switches the torque of all servos off."""
    echo_probe: bytes
    """A request to which no servo answers."""
    _packets: Any
    """The SDK's packet handler."""

    def __init__(self, device: str, baud: int, exclusive: bool = True):
        self.device, self.baud, self.echoes = device, baud, False
        self.patience_s = REPLY_TIMEOUT_S
        self.latency_s = 0.0
        self.answered: Counter[int] = Counter()
        """Replies by id, of exchanges with one servo."""
        self.garbled: Counter[int] = Counter()
        """Exchanges with one servo that gave bytes and no frame, or two different ones."""
        self.chatters = False
        """Whether bytes come that belong to no reply, as far as `doubled` has seen."""
        self._port = self._new_port(device, baud, exclusive)
        self._fastest_s: dict[tuple[int, ...], float] = {}
        self._retry_s = self._busy_s = 0.0
        try:
            self._port.openPort()
        except PORT_ERRORS as error:
            if not Path(device).exists():  # a wrong name, not a fault of the line
                raise MissingDevice(_cannot_open(device, error)) from error
            raise BusError(_cannot_open(device, error)) from error
        # a USB adapter may collect bytes for 16 ms
        self.patience_s += latency_timer_s(device) or 0.0

    # ----- what a vendor's line adds

    @abstractmethod
    def _sdk(self) -> Any:
        """The vendor's SDK."""

    @abstractmethod
    def _reader(self, accepted: Callable[[int, int], bool]) -> Reader:
        """A reader of replies; `accepted(id, data length)` says which can occur."""

    @abstractmethod
    def _request(self, frame: LineFrame) -> bytes:
        """Bytes that a request with the content of `frame` would have."""

    @abstractmethod
    def ask_model(self, servo: int) -> int:
        """Send the request whose reply holds the model number; 0 if sent."""

    @abstractmethod
    def sync_read(self, servos: Sequence[int], address: int, size: int) -> dict[int, Reply]:
        """The same bytes of several servos with one request."""

    def sync_read_s(self, delays_s: Sequence[float], size: int) -> float:
        """Time that replies of `size` bytes to the last `sync_read` need on the wire [s].

        `delays_s` are the return delays of the servos that replied, in order.
        """
        return sum(delays_s) + len(delays_s) * (size + self.reply_bytes) * self._byte_s()

    # ----- what all share

    def sync_write(self, address: int, values: dict[int, bytes]) -> float:
        """Write to several servos, unacknowledged; `time.monotonic()` of sending, NaN if failed."""
        sizes = {len(v) for v in values.values()}
        if len(sizes) != 1:
            raise ValueError(f"sync_write: values of {sorted(sizes)} bytes; all must be as long.")
        size = sizes.pop()
        params = [byte for servo, value in values.items() for byte in (servo, *value)]
        return self._sync_written(
            lambda: self._packets.syncWriteTxOnly(self._port, address, size, params, len(params))
        )

    def torque_off(self, servos: Sequence[int] | None = None) -> None:
        """Switch the torque of these (default: all) off at once; unacknowledged."""
        if servos is None:
            self._sync_written(lambda: self._send_raw(self.all_off))
        else:
            self.sync_write(self.torque_address, {servo: b"\0" for servo in servos})

    def read(self, servo: int, address: int, size: int) -> Reply | None:
        """`size` bytes of the memory of `servo`, or None if they did not come complete."""
        return self._exchange(
            lambda: self._packets.readTx(self._port, servo, address, size), [servo], size
        ).get(servo)

    def write(self, servo: int, address: int, data: bytes) -> bool:
        """Write to one servo; whether it acknowledged."""
        sent = self._exchange(
            lambda: self._packets.writeTxOnly(self._port, servo, address, len(data), list(data)),
            [servo], 0,
        )  # fmt: skip
        return servo in sent

    def detect_echo(self) -> bool:
        """Whether the adapter echoes requests; the echo is removed from then on."""
        request = self.echo_probe
        self.echoes = False
        if not self._sent(lambda: self._send_raw(request)):
            return False
        self.echoes = self._arrived(len(request)).startswith(request)
        return self.echoes

    def roll_call(self, servos: Iterable[int]) -> dict[int, tuple[int, float]]:
        """Model number (its bytes as little endian) and latency [s] of each servo that answers.

        Requests go out as soon as a servo would have answered on a fast adapter, or earlier if it
        did. Replies of a slow adapter arrive during later requests, and are matched by their ids.
        """
        requests: dict[int, float] = {}
        sent: set[bytes] = set()
        models: dict[int, tuple[int, float]] = {}
        reader = self._reader(lambda servo, size: servo in requests and size == self.model_bytes)
        wire = (self.model_bytes + self.reply_bytes) * self._byte_s()
        pause_s = _PAUSE_S + self.longest_return_delay_s

        def collect(until_s: float, servo: int | None) -> None:
            with contextlib.suppress(*PORT_ERRORS):
                while time.monotonic() < until_s and servo not in models:
                    for frame in reader.feed(self._port.read_some()):
                        if self._request(frame) in sent:
                            self.echoes = True  # of a slow adapter, too late for `detect_echo`
                            continue
                        model = int.from_bytes(frame.data[:2], "little")
                        late_s = time.monotonic() - requests[frame.id]
                        models.setdefault(frame.id, (model, max(late_s, 0.0)))

        for servo in servos:
            if not self._sent(lambda servo=servo: self.ask_model(servo)):
                continue
            self._port.keeps_old = True  # until each has had its request
            sent.add(self._port.sent)
            need_s = len(self._port.sent) * self._byte_s() + wire
            requests[servo] = time.monotonic() + need_s
            collect(requests[servo] + pause_s, servo)
        waiting = [servo for servo in requests if servo not in models]
        if waiting:
            last_s = requests[waiting[-1]] + max(self.patience_s, SLOWEST_ADAPTER_S)
            while time.monotonic() < last_s and any(servo not in models for servo in waiting):
                collect(min(last_s, time.monotonic() + 0.005), None)
        self._port.keeps_old = False
        return models

    def find(self, servos: Sequence[int], patiently: bool = True) -> dict[int, int]:
        """Those of `servos` that answer, with their model numbers; measures the latency.

        All are pinged once (`roll_call`). Silent ones are pinged again with the patience that the
        replies show to be needed, and once more with ten times that; not `patiently`, by another
        roll call only.
        """
        servos = list(servos)
        models = {servo: model for servo, (model, _) in self.roll_call(servos).items()}
        self._measure_latency([servo for servo in servos if servo in models])
        if models and not patiently:
            silent = [servo for servo in servos if servo not in models]
            models |= {servo: model for servo, (model, _) in self.roll_call(silent).items()}
            return {servo: models[servo] for servo in servos if servo in models}
        usual_s = self.patience_s
        # a first frame can be lost to earlier bytes on the line
        rounds = [usual_s] * (_ATTEMPTS - 1)
        rounds.append(max(usual_s, min(_MORE_PATIENCE * usual_s, SLOWEST_ADAPTER_S)))
        if not models and len(servos) > _ATTEMPTS:
            rounds = rounds[:1]  # a silent line or the wrong rate
        for patience_s in rounds:
            self.patience_s = patience_s
            for servo in servos:
                if servo not in models and (model := self.model(servo)) is not None:
                    models[servo] = model
        self.patience_s = usual_s
        return {servo: models[servo] for servo in servos if servo in models}

    def model(self, servo: int) -> int | None:
        """Model number of `servo`, its bytes as little endian; None if it does not answer."""
        reply = self._exchange(lambda: self.ask_model(servo), [servo], self.model_bytes)
        return int.from_bytes(reply[servo].frame.data[:2], "little") if servo in reply else None

    def answers_ping(self, servo: int) -> bool:
        """Whether `servo` answers a ping, which no register can forbid."""
        return self.model(servo) is not None

    def doubled(self, servos: Sequence[int], address: int, size: int) -> list[int]:
        """Ids whose replies are garbled while those of the other ids are clean.

        Two servos of one id answer at the same time, and destroy each other's replies, at the
        registers at `address` in which they differ: their positions. Suspects are read again,
        patiently: a late or half reply is no sign of a second servo, nor are bytes that come from
        an id without a servo, too (`chatters`).
        """
        suspects = [servo for servo in servos if self.garbled[servo] >= _GARBLED_AT_LEAST]
        others = [servo for servo in servos if servo not in suspects]
        noisy = sum(self.garbled[servo] for servo in others)
        if noisy > sum(self.answered[servo] for servo in others) / 20:
            return []
        usual_s, self.patience_s = self.patience_s, max(self.patience_s, SLOWEST_ADAPTER_S)

        def is_garbled(servo: int) -> bool:
            before = self.garbled[servo]
            for _ in range(_CONFIRMED_BY):
                self._arrived(_CONFIRMED_BY * self.reply_bytes)  # what is late, to be discarded
                self.read(servo, address, size)
            return self.garbled[servo] - before >= _CONFIRMED_BY / 2

        doubled = [servo for servo in suspects if is_garbled(servo)]
        self.chatters = bool(doubled) and is_garbled(self.unused_id)
        self.patience_s = usual_s
        return [] if self.chatters else doubled

    def close(self) -> None:
        """Release the port; may be called twice."""
        self._retry_s = float("inf")
        with contextlib.suppress(*PORT_ERRORS):
            self._port.shut()

    def _measure_latency(self, servos: Sequence[int]) -> None:
        """Latency of replies to requests that follow each other; sets the patience.

        An adapter's timer runs freely, so a single reply may come early in its period: the next
        request right after a reply waits for a whole one.
        """
        usual_s, late_s = self.patience_s, []
        self.patience_s = max(usual_s, SLOWEST_ADAPTER_S)
        wire = (self.model_bytes + self.reply_bytes) * self._byte_s()
        for servo in (list(servos) * _MEASURED_ON)[:_MEASURED_ON]:
            before = time.monotonic()
            if self.model(servo) is not None:
                need_s = len(self._port.sent) * self._byte_s() + wire
                late_s.append(max(time.monotonic() - before - need_s, 0.0))
        self.patience_s = usual_s
        if late_s:
            self.latency_s = sorted(late_s)[len(late_s) // 2]
            # a free-running timer delivers up to a whole period later
            self.patience_s = max(usual_s, 1.5 * max(late_s) + 0.002)

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

    def _sync_written(self, send: Callable[[], int]) -> float:
        """Send a request without replies; see `sync_write`."""
        before = time.monotonic()
        ok = self._sent(send)
        # the port accepts the bytes at once; the wire takes longer
        self._busy_s = before + len(self._port.sent) * self._byte_s()
        if ok and self.echoes:  # or the echo would come between the next request and its reply
            self._arrived(len(self._port.sent))
        return before if ok else float("nan")

    def _exchange(
        self, send: Callable[[], int], servos: Sequence[int], size: int
    ) -> dict[int, Reply]:
        """Send, and collect one reply of `size` parameter bytes from each of `servos`."""
        expected = set(servos)
        reader = self._reader(lambda servo, length: servo in expected and length == size)
        replies: dict[int, tuple[LineFrame, float]] = {}
        contradicted: set[int] = set()
        arrived = bytearray()

        def take(data: bytes) -> bool:
            arrived.extend(data)
            for frame in reader.feed(data):
                first = replies.setdefault(frame.id, (frame, time.monotonic()))
                if first[0] != frame:
                    contradicted.add(frame.id)
            return len(replies) == len(expected)

        begin = self._listen(send, len(servos) * (size + self.reply_bytes), len(servos), take)
        if begin is None:
            return {}
        if len(servos) == 1 and arrived:
            self._count(servos[0], bytes(arrived), bool(replies), bool(contradicted), reader)
        # replies come evenly, in the order of the request; the host's buffers blur each arrival
        last = max((k for k, servo in enumerate(servos) if servo in replies), default=0)
        after = max((at for _, at in replies.values()), default=begin)
        share = self._least_s(
            (size, len(servos)), max(after - begin, 0.0) / (last + 1), len(replies) == len(expected)
        )
        return {
            servo: Reply(replies[servo][0], begin + k * share, begin + (k + 1) * share)
            for k, servo in enumerate(servos)
            if servo in replies and servo not in contradicted
        }

    def _listen(
        self, send: Callable[[], int], size: int, delays: int, take: Callable[[bytes], bool]
    ) -> float | None:
        """Send, and hand what arrives, without echo, to `take` until it has all or time is over.

        `size` bytes should come, after the return delays of `delays` servos. Gives
        `time.monotonic()` when the request's last byte was on the wire; None if it was not sent.
        """
        before = time.monotonic()
        if not self._sent(send):
            return None
        begin = max(before, self._busy_s) + len(self._port.sent) * self._byte_s()
        deadline = begin + size * self._byte_s() + self.patience_s
        deadline += delays * self.longest_return_delay_s
        owed = self._port.sent if self.echoes else b""
        complete, late = take(b""), False
        try:
            while not (complete or late):
                late = time.monotonic() >= deadline  # but what a busy host has not read yet
                data = self._port.read_some()
                if owed:
                    data, owed = _strip(data, owed)
                complete = take(data)
        except PORT_ERRORS:
            self._drop_port()
        return begin

    def _least_s(self, kind: tuple[int, ...], took_s: float, complete: bool) -> float:
        """Time of an exchange without what was spent on the way back to this program.

        That is what exceeds the fastest complete exchange of this kind.
        """
        if complete:
            self._fastest_s[kind] = min(took_s, self._fastest_s.get(kind, took_s))
        return min(took_s, self._fastest_s.get(kind, took_s))

    def _count(
        self, servo: int, arrived: bytes, replied: bool, contradicted: bool, reader: Reader
    ) -> None:
        """Count a reply, or what is no reply at all; a late reply to another request is neither."""
        if replied and not contradicted and not reader.rejected_bytes:
            self.answered[servo] += 1
        elif contradicted or not self._reader(lambda servo, size: True).feed(arrived):
            self.garbled[servo] += 1

    def _new_port(self, device: str, baud: int, exclusive: bool) -> Any:
        """Port of the SDK, without busy waiting."""

        class Port(self._sdk().PortHandler):
            """Exclusive; sleeps while it waits; discards old bytes before it sends."""

            def __init__(self) -> None:
                super().__init__(device)
                self.sent = b""
                self.keeps_old = False

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
                if not self.keeps_old:
                    self.ser.reset_input_buffer()

            def writePort(self, packet: Any) -> int:
                self.sent = bytes(packet)
                return self.ser.write(self.sent) or 0

            def setPacketTimeout(self, packet_length: int) -> None:
                """Without effect: each exchange of `SerialLine` has its own deadline."""

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
                f"{device}: {baud} baud is not possible with this SDK. Use {self.rates_in_words}."
            )
        port.baudrate = baud
        return port


def latency_timer_s(device: str) -> float | None:
    """Latency timer of a USB adapter [s]; None where it has none or it cannot be read."""
    try:
        return float(_latency_timer(device).read_text()) / 1e3
    except (OSError, ValueError):
        return None


def line_remarks(line: SerialLine) -> list[str]:
    """Sentences about bytes that no servo sent, and about an adapter that delays replies."""
    slow = slow_adapter(line)
    chatter = (
        f"{line.device}: bytes come that belong to no reply, and some readings are lost to them. "
        "Another program may use the line, or the adapter's own firmware writes to it."
    )
    return [chatter] * line.chatters + ([slow] if slow else [])


def slow_adapter(line: SerialLine) -> str | None:
    """Sentence about an adapter that delays replies, with the cure; None if it is fast."""
    if line.latency_s < SLOW_ADAPTER_S:
        return None
    late = (
        f"{line.device}: replies come {1e3 * line.latency_s:.0f} ms later than bytes and servos "
        "need, so every reading's time is uncertain by half of that and a loop can be no faster."
    )
    timer_s = latency_timer_s(line.device)
    if timer_s is None:
        return (
            f"{late} The USB adapter collects bytes, which another adapter or its driver cures, or "
            "this computer is busy with other work."
        )
    return (
        f"{late} The adapter's latency timer is {1e3 * timer_s:.0f} ms: "
        f"`echo 1 | sudo tee {_latency_timer(line.device)}`."
    )


def _latency_timer(device: str) -> Path:
    return Path("/sys/class/tty") / resolved(Path(device)).name / "device" / "latency_timer"


def _strip(data: bytes, owed: bytes) -> tuple[bytes, bytes]:
    """Remove the echo that is still expected from the front of `data`."""
    n = min(len(data), len(owed))
    if data[:n] == owed[:n]:
        return data[n:], owed[n:]
    return data, b""  # no echo: the checksums of the frames decide


def _cannot_open(device: str, error: BaseException) -> str:
    text = str(error).lower()
    if "permission denied" in text:
        hint = "You may not use it: add yourself to the group dialout and log in again."
    elif "exclusively" in text or "busy" in text or "resource temporarily" in text:
        hint = "Another program has it open; stop that first, only one may command the servos."
    elif not Path(device).exists():
        return (
            f"{device} cannot be opened: there is no such device. Check the cable and the name; "
            "`pupper-sysid scan` lists the serial ports (a USB adapter is /dev/ttyUSB0 or "
            "/dev/ttyACM0)."
        )
    else:
        hint = "Check the cable and the name."
    return f"{device} cannot be opened. {hint} ({error})"
