"""Emulated servos on a serial line: bytes of the real protocol in, bytes out, each with its time.

`LineEmulator` is the line and its servos without a port: `receive` takes what the host sent
and returns what comes back and when its last byte has arrived, at the line's baud rate and after
each servo's return delay. `SerialPty` puts it behind a pseudo-terminal, a serial device for any
program. A vendor's emulator (`sim.emulator.feetech`, `sim.emulator.dynamixel`) adds frames and
instructions.

Every servo has its memory table and acts by it: operating mode, angle limits, homing offset,
response level, id and rate; gains, ramps and torque limits as far as the bench's servos have them.
Commands and torque act on `ServoBench` when the last byte of their frame has arrived, and a
position is measured when its answer begins.

A pseudo-terminal has no baud rate, so the server holds bytes back for as long as a real
line would. It keeps one end open itself, or a client that closes would end it; an unplugged adapter
is a terminal that goes away and comes back behind the same link. A USB adapter collects bytes and
delivers them with the ticks of its latency timer.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import math
import os
import pty
import select
import struct
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from pupper_sysid.hardware.serial_servos.series import Family, Series
from pupper_sysid.sim.emulator.bench import AMBIENT_C, BusFaults, ServoBench

Pieces = list[tuple[float, bytes]]
"""Bytes that come back, each piece with the time at which it has arrived."""

TWIN_COUNTS = 333
"""How far the second servo of an id stands from the first."""


@dataclass
class EmulatedMemory:
    """Memory and faults of one servo."""

    memory: bytearray
    frozen_until: float = -np.inf
    faulty_until: float = -np.inf
    frozen_count: int = 0
    error: int = 0
    loaded_since: float = np.inf
    overloaded: bool = False
    """Its protection has acted; until its power is switched off."""
    heard_s: float = 0.0
    """Last request of the host."""
    stopped: bool = False
    """Its communication watchdog has acted."""
    state: dict[str, Any] = field(default_factory=dict)


class LineEmulator(ABC):
    """A line of servos of one series, at the ids of the bench's joint map (`ids`: only these).

    `baud` is the rate at which they listen. With `echo` the adapter returns the host's bytes.
    `registers` differ from the factory's, by id, of all servos under None. Each of the ids
    `doubled` is that of two servos, whose answers destroy each other.
    """

    family: ClassVar[Family]
    reader: ClassVar[type[Any]]
    """Of requests."""
    memory_bytes: int
    factory: ClassVar[Mapping[str, Mapping[str, int]]]
    """Registers as a servo leaves the factory, by series' name."""
    rates: ClassVar[Sequence[int]]
    """By the value of the servo's baud register."""

    def __init__(
        self,
        bench: ServoBench,
        series: Series,
        rng: np.random.Generator,
        ids: Sequence[int] | None = None,
        baud: int = 1_000_000,
        faults: BusFaults | None = None,
        echo: bool = False,
        registers: Mapping[int | None, Mapping[str, int]] | None = None,
        doubled: Sequence[int] = (),
    ):
        self.bench, self.series, self.echo = bench, series, echo
        self.faults = faults or BusFaults({}, rng)
        self._rng, self.baud, self._doubled = rng, baud, set(doubled)
        self._reader = self.reader()
        self._free_at = 0.0
        self._brown_out_until = -np.inf
        self._heard_at = baud
        self._renamed: set[int] = set()
        self.unplug_for_s = 0.0
        """Set by a fault: the port shall vanish for this time [s]."""
        self.readings: list[tuple[float, int, int]] = []
        """Every position measured for an answer: time, id, count."""
        self.servos: dict[int, EmulatedMemory] = {}
        self._acting = [n for n in bench.acting_registers if series.has(n)]
        for servo_id in ids if ids is not None else bench.map.ids:
            self.servos[servo_id] = EmulatedMemory(bytearray(self.memory_bytes))
            changed: dict[str, int] = {}
            for target in (None, servo_id):
                changed |= (registers or {}).get(target, {})
            k = bench.index_of_id[servo_id]
            as_built = {name: bench.register(k, name) for name in self._acting}
            self._load(servo_id, {"torque_enable": 1} | as_built)
            self._limits_in_force(servo_id)
            for name, value in changed.items():
                self._set(servo_id, name, value)
                if name in self._acting:
                    bench.set_register(k, 0.0, name, value)
            goal = int(np.clip(self._present(servo_id, 0.0), 0, series.counts - 1))
            self._set(servo_id, "goal_position", goal)

    def _load(self, servo_id: int, more: Mapping[str, int]) -> None:
        """Fill a servo's memory as it leaves the factory, but for its id, rate and offset."""
        settings = dict(self.factory[self.series.name]) | {
            "model": self.series.model, "id": servo_id, "baud": self.rates.index(self.baud),
        } | dict(more)  # fmt: skip
        if self.series.has("homing_offset"):
            settings["homing_offset"] = self._mapped_offset(servo_id)
        for name, value in settings.items():
            self._set(servo_id, name, value)
        if self.series.lock_address is not None:
            self.servos[servo_id].memory[self.series.lock_address] = 1

    def _limits_in_force(self, servo_id: int) -> None:
        """Copy the limits of the EEPROM to where they act, as a servo does when it is powered."""
        for name, limit in (("torque_limit", "max_torque"), ("goal_current", "current_limit")):
            if self.series.has(name) and self.series.has(limit):
                self._set(servo_id, name, self._get(servo_id, limit))

    def restart(self, servo_id: int, at: float, keeps_eeprom: bool = True) -> None:
        """Limp, and with the registers of a servo that was switched on, as after its power failed.

        Without its EEPROM it is as it left the factory.
        """
        servo, end = self.servos[servo_id], self.series.eeprom_end * keeps_eeprom
        k, eeprom = self.bench.index_of_id[servo_id], bytes(servo.memory[:end])
        servo.memory[end:] = bytes(self.memory_bytes - end)
        self._load(servo_id, {"torque_enable": 0})
        servo.memory[:end] = eeprom
        self._limits_in_force(servo_id)
        self.bench.torque(k, at, False)
        servo.stopped = servo.overloaded = False
        servo.state.clear()
        for name in self._acting:
            self.bench.set_register(k, at, name, self._get(servo_id, name))
        goal = int(np.clip(self._present(servo_id, at), 0, self.series.counts - 1))
        self._set(servo_id, "goal_position", goal)

    # ----- what a vendor's emulator adds

    @abstractmethod
    def _execute(self, frame: Any, byte_s: float) -> Pieces:
        """Execute a request; what comes back."""

    @abstractmethod
    def _status(self, servo_id: int, error: int, data: bytes) -> bytes:
        """A reply on the wire."""

    @abstractmethod
    def _write_request(self, servo_id: int, address: int, data: bytes) -> bytes:
        """A write request on the wire."""

    def _error_byte(self, servo_id: int, bits: int) -> int:
        """Error byte of a reply of a servo with these faults."""
        return bits

    # ----- what all share

    def receive(self, data: bytes, now: float, baud: int | None = None) -> Pieces:
        """What comes back, in order of time, for `data` that the host began to send at `now`.

        `now` [s] must not go backwards. Servos of another rate than `baud` receive only noise.
        """
        byte_s, self._free_at = self._byte_s(baud), max(now, self._free_at)
        self._heard_at = self.baud if baud is None else baud
        pieces = [(self._free_at + len(data) * byte_s, data)] if self.echo else []
        for byte in data:  # a request acts when its last byte has arrived
            self._free_at += byte_s
            for frame in self._reader.feed(bytes([byte])):
                pieces += self._execute(frame, byte_s)
                self._rename()
        return sorted(pieces, key=lambda p: p[0])

    def _hears(self, servo_id: int) -> bool:
        """Whether there is such a servo, and the present bytes come at its rate."""
        if servo_id not in self.servos:
            return False
        rate = self._get(servo_id, "baud")
        return rate < len(self.rates) and self.rates[rate] == self._heard_at

    def _rename(self) -> None:
        """Move a servo to the id that was written into it, where another one may be."""
        for old in self._renamed:
            new, servo = self._get(old, "id"), self.servos.pop(old)
            index = self.bench.index_of_id.pop(old)
            if new in self.servos:
                self._doubled.add(new)
            else:
                self.servos[new], self.bench.index_of_id[new] = servo, index
        self._renamed.clear()

    def _byte_s(self, baud: int | None) -> float:
        return 10.0 / (self.baud if baud is None or baud <= 0 else baud)

    def _holds_position(self, servo_id: int) -> bool:
        """Whether a servo goes to the positions that it is commanded, by its mode."""
        mode = self._get(servo_id, "mode") if self.series.has("mode") else None
        if mode is not None:
            position_modes = {self.family.position_mode, *self.series.more_position_modes}
            return mode in position_modes or mode in self.family.turns_freely
        return bool(self._get(servo_id, "min_angle") or self._get(servo_id, "max_angle"))

    def _offset(self, servo_id: int) -> int:
        """Counts of the bench minus present position: the offset that its map does not have."""
        if not self.series.has("homing_offset"):
            return 0
        more = self._get(servo_id, "homing_offset") - self._mapped_offset(servo_id)
        return self.series.offset_sign * more

    def _mapped_offset(self, servo_id: int) -> int:
        """Homing offset with which the bench's joint map holds."""
        joint = self.bench.map.joint_names[self.bench.index_of_id[servo_id]]
        return self.bench.map.file.joints[joint].homing_offset or 0

    def _present(self, servo_id: int, at: float) -> int:
        """Position that a servo reports [counts]."""
        encoder = self.bench.count(self.bench.index_of_id[servo_id], at)
        count, offset = encoder - self._offset(servo_id), self._offset(servo_id)
        if offset and self.series.wraps(lambda name: self._get(servo_id, name)):
            count %= self.series.counts
        return count

    def _store(self, servo_id: int, address: int, data: bytes, at: float) -> None:
        servo = self.servos.get(servo_id)
        if servo is None or address + len(data) > self.memory_bytes or at < self._brown_out_until:
            return
        locked = self.series.lock_address  # without error the vendor's emulator has decided
        if locked is not None and address < self.series.eeprom_end and servo.memory[locked]:
            return
        servo.memory[address : address + len(data)] = data
        touched = range(address, address + len(data))
        if self.series.register("id").address in touched and self._get(servo_id, "id") != servo_id:
            self._renamed.add(servo_id)
        k = self.bench.index_of_id[servo_id]
        for name in self._acting:
            if self.series.register(name).address in touched:
                self.bench.set_register(k, at, name, self._get(servo_id, name))
        if self.series.register("goal_position").address in touched:
            self._go(servo_id, k, at)
        if self.series.register("torque_enable").address in touched:
            self.bench.torque(k, at, bool(self._get(servo_id, "torque_enable")))

    def _go(self, servo_id: int, k: int, at: float) -> None:
        """Move a servo to its goal, within its angle limits."""
        low, high = self._get(servo_id, "min_angle"), self._get(servo_id, "max_angle")
        goal = self._get(servo_id, "goal_position")
        if not self._holds_position(servo_id) or self.servos[servo_id].stopped:
            return
        if low < high:
            goal = int(np.clip(goal, low, high))
        self.bench.command(k, at, goal + self._offset(servo_id))

    def _answer(
        self, servo_id: int, address: int, size: int, byte_s: float, error: int = 0,
        encode: Callable[[int, int, bytes], bytes] | None = None, waits: bool = True,
    ) -> Pieces:  # fmt: skip
        """The answer of one servo, after its return delay, as the line delivers it.

        `encode` makes another answer than a frame of the servo's own from id, error and data.
        """
        servo, encode = self.servos.get(servo_id), encode or self._status
        if servo is None or self._free_at < self._brown_out_until:
            return []
        delays = self.series.has("return_delay") and waits
        delay = (
            self.family.return_delay_unit_s * self._get(servo_id, "return_delay") if delays else 0.0
        )
        begin = self._free_at + delay
        kind = self._inject_fault(servo_id, begin)
        if begin < self._brown_out_until:
            return []
        self._refresh(servo_id, begin)
        bits = servo.error if begin < servo.faulty_until else 0
        bits |= 32 * servo.overloaded  # overload, of every family
        error = self._error_byte(servo_id, bits) | error
        data = bytes(servo.memory[address : address + size])
        answer = encode(servo_id, error, data)
        # the answer of another servo to another request
        foreign = self._status((servo_id + 100) % 250, 0, bytes(len(data)))
        if kind == "wrong-length":
            shorter = len(data) and self._rng.random() < 0.5
            more = bytes([int(self._rng.integers(256))])
            answer = encode(servo_id, error, data[:-1] if shorter else data + more)
        if servo_id in self._doubled:
            answer = self._collided(servo_id, address, data, error, encode)
        arrived = []
        for late, piece in self.faults.apply(kind, answer, foreign):
            self._free_at = max(self._free_at, begin) + len(piece) * byte_s
            arrived.append((self._free_at + late, piece))
        if kind == "second-writer":
            arrived += self._second_writer(byte_s)
        return arrived

    def _collided(
        self, servo_id: int, address: int, data: bytes, error: int,
        encode: Callable[[int, int, bytes], bytes],
    ) -> bytes:  # fmt: skip
        """Answers of two servos at once: the line is low where either pulls it."""
        twin = bytearray(data)
        where = self.series.register("present_position")
        at = where.address - address
        if 0 <= at and at + where.size <= len(data):
            count = self._get(servo_id, "present_position") + TWIN_COUNTS
            twin[at : at + where.size] = self.series.encode("present_position", count)
        first = encode(servo_id, error, data)
        second = encode(servo_id, error, bytes(twin))
        late = int(self._rng.integers(0, 3))  # bytes by which one clock starts later
        longest = max(len(first), late + len(second))
        padded = first.ljust(longest, b"\xff"), (b"\xff" * late + second).ljust(longest, b"\xff")
        return bytes(a & b for a, b in zip(*padded, strict=True))

    def _inject_fault(self, servo_id: int, at: float) -> str | None:
        """Draw a fault; start it if it lasts. Returns its kind."""
        kind = self.faults.draw()
        servo = self.servos[servo_id]
        if kind == "frozen":
            servo.frozen_until = at + self.faults.lasts_s
            servo.frozen_count = self._present(servo_id, at)
        elif kind == "error-bits":
            bits = int(self._rng.choice([1, 2, 4, 8, 32, 33]))
            self.fail(servo_id, at, bits, self.faults.lasts_s)
        elif kind == "brown-out":
            self.brown_out(at, self.faults.lasts_s)
        elif kind == "reboot":
            self.restart(servo_id, at)
        elif kind == "unplugged":
            self.unplug_for_s = self.faults.lasts_s
        return kind

    def brown_out(self, at: float, seconds: float) -> None:
        """Supply too low from `at` on: all servos are limp, and deaf for some seconds."""
        self._brown_out_until = at + seconds
        for servo_id in self.servos:
            self.restart(servo_id, at)
        self.faults.ended.append(("brown-out", self._brown_out_until))

    def fail(self, servo_id: int, at: float, bits: int, seconds: float) -> None:
        """Error bits of one servo from `at` on, for some seconds."""
        self.servos[servo_id].faulty_until = at + seconds
        self.servos[servo_id].error = bits

    def _second_writer(self, byte_s: float) -> Pieces:
        """Another host's request on the wire, which the first host receives, too."""
        victim = int(self._rng.choice(list(self.servos)))
        k = self.bench.index_of_id[victim]
        count = int(np.clip(self.bench.count(k, self._free_at) + self._rng.integers(-40, 40), 0,
                            self.series.counts - 1))  # fmt: skip
        goal = self.series.register("goal_position")
        data = self.series.encode("goal_position", count)
        request = self._write_request(victim, goal.address, data)
        self._free_at += len(request) * byte_s
        self._store(victim, goal.address, data, self._free_at)
        return [(self._free_at, request)]

    def _refresh(self, servo_id: int, at: float) -> None:
        """Measure: the present registers hold values of this moment."""
        k = self.bench.index_of_id[servo_id]
        servo = self.servos[servo_id]
        frozen = at < servo.frozen_until
        count = servo.frozen_count if frozen else self._present(servo_id, at)
        if self.bench.keep_log:
            self.readings.append((at, servo_id, count))
        self._set(servo_id, "present_position", count)
        name, scale = self.family.load
        self._set(servo_id, name, round(self.bench.load(k) / (1000 * scale)))
        volts = round(self.bench.supply_v / self.family.volt_scale)
        self._set(servo_id, "present_voltage", volts)
        self._set(servo_id, "present_temperature", round(AMBIENT_C))
        self._protect(servo_id, at)

    def _protect(self, servo_id: int, at: float) -> None:
        """The servo's own overload protection, where it has one."""
        return

    def _set(self, servo_id: int, name: str, value: int) -> None:
        register = self.series.register(name)
        encoded = self.series.encode(name, value)
        self.servos[servo_id].memory[register.address : register.address + register.size] = encoded

    def _get(self, servo_id: int, name: str) -> int:
        return self.series.decode(name, bytes(self.servos[servo_id].memory))


_IDLE_S = 0.05
_TCGETS2, _TERMIOS2 = 0x802C542A, struct.Struct("=4IB19s2I")
"""Linux: request of a terminal's settings with its rates as numbers, and their layout."""


class SerialPty:
    """Serves an emulator; `device` is what a client opens.

    `link` is a stable name for the device, which survives being unplugged; `latency_s` the period
    of the adapter's latency timer, 0 for an adapter that delivers at once.
    """

    def __init__(self, emulator: LineEmulator, link: Path | None = None, latency_s: float = 0.0):
        self.emulator, self._link, self.latency_s = emulator, link, latency_s
        self._stop = threading.Event()
        self._start = time.monotonic()
        self._due: list[tuple[float, int, bytes]] = []
        self._count = 0
        self._plug()

    def now(self) -> float:
        """Seconds of the emulator's time."""
        return time.monotonic() - self._start

    def serve(self) -> None:
        """Answer until `stop`."""
        while not self._stop.is_set():
            self._deliver()
            if self.emulator.unplug_for_s > 0:
                self._unplug()
            wait = self._due[0][0] - self.now() if self._due else _IDLE_S
            ready, _, _ = select.select([self._host], [], [], max(min(wait, _IDLE_S), 0))
            if not ready:
                continue
            with contextlib.suppress(OSError):
                data = os.read(self._host, 4096)
                for due, piece in self.emulator.receive(data, self.now(), self._baud()):
                    self._count += 1
                    if self.latency_s:  # the adapter delivers with the next tick of its timer
                        due = math.ceil(due / self.latency_s) * self.latency_s
                    heapq.heappush(self._due, (due, self._count, piece))

    def stop(self) -> None:
        """End `serve`; may be called from anywhere."""
        self._stop.set()

    def close(self) -> None:
        """Remove the device."""
        for descriptor in (self._host, self._servo):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        if self._link is not None:
            self._link.unlink(missing_ok=True)

    def _deliver(self) -> None:
        while self._due and self._due[0][0] <= self.now():
            _, _, piece = heapq.heappop(self._due)
            with contextlib.suppress(OSError):
                os.write(self._host, piece)

    def _plug(self) -> None:
        self._host, self._servo = pty.openpty()
        tty.setraw(self._servo)
        os.set_blocking(self._host, False)
        self.device = os.ttyname(self._servo)
        if self._link is not None:
            new = self._link.with_name(f".{self._link.name}.new")
            new.unlink(missing_ok=True)
            new.symlink_to(self.device)
            new.replace(self._link)
            self.device = str(self._link)

    def _unplug(self) -> None:
        self.close()
        self._due.clear()
        time.sleep(self.emulator.unplug_for_s)
        self.emulator.unplug_for_s = 0.0
        self._plug()
        self.emulator.faults.ended.append(("unplugged", self.now()))

    def _baud(self) -> int | None:
        """Rate that the host has set, which Linux has as a number; None elsewhere."""
        with contextlib.suppress(OSError):
            return _TERMIOS2.unpack(fcntl.ioctl(self._host, _TCGETS2, bytes(_TERMIOS2.size)))[-1]
        return None
