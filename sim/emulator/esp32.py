"""The Mini Pupper 2's proxy and firmware, emulated: datagrams in, datagrams out.

`ProxyEmulator` is the shared block, the firmware's loop behind it and the servos, without a socket;
`ProxySocket` serves it to any number of clients. It has the real one's quirks: no owner and no
watchdog, an acknowledgement that does not depend on the servos, zeros until the first feedback,
feedback polled one servo after the other with silent losses, an unknown request answered with the
previous answer, the last request executed once more when a client leaves, and a torque byte that
stores a calibration.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import struct
import threading
import time
from pathlib import Path

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware import esp32
from pupper_sysid.hardware.imu import to_chip
from pupper_sysid.sim.emulator.bench import BusFaults, PollSchedule, ServoBench

TICK_S = 0.002
"""Period of the firmware's servo task [s], which writes goal positions."""
STAND_UP_S = 4.0
"""Time to stand up after a start or a stored calibration, in which commands are ignored [s]."""
LOW_VOLTAGE_V = 4.0

_SET = struct.Struct("<BB12B12H")
_CENTRE = 512


class ProxyEmulator:
    """Proxy, firmware and servos.

    The bench has a joint map of the proxy's counts, ids 1 to 12; `rng` decides lost polls, and the
    answers to unknown requests.
    """

    def __init__(
        self, bench: ServoBench, rng: np.random.Generator, faults: BusFaults | None = None
    ):
        spec = bench.robot.spec
        if not spec.poll_period_s > 0:
            raise InputError("emulated proxy: poll_period_s is 0, and the firmware always polls.")
        self.bench, self.rng = bench, rng
        self.faults = faults or BusFaults({}, rng)
        phase = np.array([s.poll_phase_s for s in bench.robot.servos])
        self._polls = PollSchedule(
            spec.poll_period_s, phase, spec.loss, spec.poll_jitter_s, spec.poll_drift, rng
        )
        servos = esp32.SERVOS
        self._index = [bench.index_of_id[i] for i in range(1, servos + 1)]
        self._counts = np.zeros(servos, int)
        self._loads = np.zeros(servos, int)
        self._measured = np.full(servos, -np.inf)
        self._stuck_until = np.full(servos, -np.inf)
        self._deaf_until = -np.inf
        self._block: tuple[tuple[int, ...], tuple[int, ...]] | None = None
        self._undone = False
        self._calibration = np.zeros(servos, int)
        self._time = 0.0
        self.unplug_for_s = 0.0
        """Set by a fault: the server shall close and come back after this time [s]."""
        self.history: list[tuple[float, tuple[int, ...]]] = []
        """The block's positions by id, from each time on."""

    def answer(self, request: bytes, previous: bytes, now: float) -> bytes:
        """The reply to one datagram at `now` (seconds, not going backwards)."""
        opcode = request[1] if len(request) > 1 and request[0] == len(request) else 0
        if opcode == esp32.SET_POSITION and len(request) == _SET.size:
            values = _SET.unpack(request)[2:]
            self._execute(values[:12], values[12:], now)
            return esp32.ACKNOWLEDGED
        if request == esp32.request(esp32.GET_IMU):
            return self._imu(now)
        self._refresh(now)
        if len(request) == 2:
            if opcode == esp32.GET_POSITION:
                return struct.pack("<BB12H", 26, opcode, *self._counts)
            if opcode == esp32.GET_LOAD:
                return struct.pack("<BB12h", 26, opcode, *self._loads)
            if opcode == esp32.GET_POWER:
                return struct.pack("<BB2f", 10, opcode, self.bench.supply_v, 0.4)
        return previous or self.rng.bytes(2)

    def resend(self, now: float) -> None:
        """Repeat the last command once deaf servos hear again, as the proxy does all the time."""
        if self._undone and self._block and now >= self._deaf_until:
            self._execute(*self._block, now)

    def inject_fault(self, now: float) -> str | None:
        """Draw a fault for the next answer; start it if it lasts. Returns its kind."""
        kind = self.faults.draw()
        servo = int(self.rng.integers(esp32.SERVOS))
        # any status bit makes the firmware drop the answer: the servo's feedback freezes
        if kind in ("frozen", "error-bits"):
            self._refresh(now)
            self._stuck_until[servo] = now + self.faults.lasts_s
        elif kind == "brown-out":
            self._refresh(now)
            self._stuck_until[:] = now + self.faults.lasts_s
            self._deaf_until = max(self._deaf_until, now + self.faults.lasts_s)
            self._undone = True
            for k in self._index:
                self.bench.torque(k, now, False)
            self.faults.ended.append((kind, now + self.faults.lasts_s))
        elif kind == "unplugged":
            self.unplug_for_s = self.faults.lasts_s
        elif kind == "second-writer":
            self._refresh(now)
            goal = np.clip(self._counts + self.rng.integers(-8, 9, 12), 1, esp32.HIGHEST_COUNT)
            self._execute((1,) * 12, tuple(int(c) for c in goal), now)
        return kind

    def apply_fault(self, kind: str | None, reply: bytes) -> list[tuple[float, bytes]]:
        """What is sent instead of `reply`: pieces, each with its delay [s]."""
        if kind == "wrong-length":
            return [(0.0, reply + b"\0" if self.rng.random() < 0.5 else reply[:-1] or b"\0")]
        foreign = struct.pack("<BB2f", 10, esp32.GET_POWER, self.bench.supply_v, 0.4)
        return self.faults.apply(kind, reply, foreign)

    def _imu(self, now: float) -> bytes:
        sample = self.bench.imu(now)
        raw = np.zeros(6) if sample is None else to_chip(sample)
        return struct.pack("<BB6f", 26, esp32.GET_IMU, *raw)

    def _execute(self, torque: tuple[int, ...], counts: tuple[int, ...], now: float) -> None:
        """A command reaches the servos with the firmware's next tick."""
        if torque[0] == esp32.SAVE_CALIBRATION:
            # the present goals become the new centre; then the firmware stands up anew
            shifted = self._calibration + _CENTRE - np.array(counts)
            self._calibration = np.clip(shifted, -_CENTRE, _CENTRE - 1)
            self._deaf_until, self._block = now + STAND_UP_S, None
            for k in self._index:
                self.bench.torque(k, now, False)
            return
        self._block = torque, counts
        self._undone = now < self._deaf_until
        if self._undone or self.bench.supply_v < LOW_VOLTAGE_V:
            return
        at = math.ceil(now / TICK_S) * TICK_S
        raw = np.clip(np.array(counts) - self._calibration, 0, esp32.HIGHEST_COUNT)
        for k, on, count in zip(self._index, torque, raw, strict=True):
            if on == esp32.TORQUE_ON:
                self.bench.torque(k, at, True)
                self.bench.command(k, at, int(count))
            elif on == esp32.TORQUE_OFF:
                self.bench.torque(k, at, False)

    def _refresh(self, now: float) -> None:
        """Bring the block's feedback up to what was polled by `now`."""
        self._time = max(self._time, now)
        measured = self._polls.advance(self._time)
        for servo, k in enumerate(self._index):
            at = measured[k]
            if at > self._measured[servo] and at >= 0 and at >= self._stuck_until[servo]:
                calibrated = self.bench.count(k, at) + self._calibration[servo]
                self._counts[servo] = min(max(calibrated, 1), esp32.HIGHEST_COUNT)
                self._loads[servo] = self.bench.load(k)
                self._measured[servo] = at
        block = tuple(int(c) for c in self._counts)
        if self.bench.keep_log and (not self.history or self.history[-1][1] != block):
            self.history.append((self._time, block))


class ImuProxy(ProxyEmulator):
    """A proxy that answers for the IMU alone; the robot's servos are on another line."""

    def answer(self, request: bytes, previous: bytes, now: float) -> bytes:
        """The reply to one datagram at `now`; all but GET_IMU are unknown."""
        if request == esp32.request(esp32.GET_IMU):
            return self._imu(now)
        return previous or self.rng.bytes(2)


_BACKLOG, _BUFFER, _IDLE_S = 20, 38, 0.05
_LONGEST_PATH = 107  # bytes, of a socket on Linux


class ProxySocket:
    """Serves a `ProxyEmulator` at a path."""

    def __init__(self, emulator: ProxyEmulator, path: Path):
        self.emulator, self.path = emulator, path
        self._stop = threading.Event()
        self._start = time.monotonic()
        self._previous: dict[socket.socket, bytes] = {}
        self._last: dict[socket.socket, bytes] = {}
        self._due: list[tuple[float, socket.socket, bytes]] = []
        self._free(path)
        self._listen()

    def now(self) -> float:
        """Seconds of the emulator's time."""
        return time.monotonic() - self._start

    def serve(self) -> None:
        """Answer until `stop`."""
        while not self._stop.is_set():
            if self.emulator.unplug_for_s > 0:
                self._unplug()
            self._deliver()
            self.emulator.resend(self.now())
            wait = min((d[0] for d in self._due), default=self.now() + _IDLE_S) - self.now()
            watched = [self._server, *self._previous]
            ready, _, _ = select.select(watched, [], [], max(min(wait, _IDLE_S), 0))
            for connection in ready:
                if connection is self._server:
                    client, _ = self._server.accept()
                    self._previous[client] = b""
                else:
                    self._talk(connection)

    def stop(self) -> None:
        """End `serve`; may be called from anywhere."""
        self._stop.set()

    def close(self) -> None:
        """Remove the socket and all connections."""
        for client in list(self._previous):
            self._drop(client)
        self._server.close()
        self.path.unlink(missing_ok=True)

    def _talk(self, client: socket.socket) -> None:
        try:
            request = client.recv(_BUFFER)
        except OSError:
            request = b""
        now = self.now()
        if not request:
            # the real proxy's child executes the last request once more before it ends
            if client in self._last:
                self.emulator.answer(self._last[client], self._previous[client], now)
            self._drop(client)
            return
        self._last[client] = request
        kind = self.emulator.inject_fault(now)
        reply = self.emulator.answer(request, self._previous[client], now)
        self._previous[client] = reply
        for delay, piece in self.emulator.apply_fault(kind, reply):
            if delay > 0:
                self._due.append((now + delay, client, piece))
            else:
                self._send(client, piece)

    def _deliver(self) -> None:
        now = self.now()
        for item in [d for d in self._due if d[0] <= now]:
            self._due.remove(item)
            self._send(item[1], item[2])

    def _send(self, client: socket.socket, piece: bytes) -> None:
        with contextlib.suppress(OSError):
            client.send(piece, socket.MSG_DONTWAIT)

    def _drop(self, client: socket.socket) -> None:
        self._previous.pop(client, None)
        self._last.pop(client, None)
        self._due = [d for d in self._due if d[1] is not client]
        client.close()

    def _unplug(self) -> None:
        self.close()
        time.sleep(self.emulator.unplug_for_s)
        self.emulator.unplug_for_s = 0.0
        self._listen()
        self.emulator.faults.ended.append(("unplugged", self.now()))

    def _listen(self) -> None:
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if len(os.fsencode(self.path)) > _LONGEST_PATH:
            raise InputError(
                f"{str(self.path)[:40]}… is too long for a socket, whose path has at most "
                f"{_LONGEST_PATH} bytes. Choose a shorter one."
            )
        self._server.bind(str(self.path))
        self._server.listen(_BACKLOG)

    def _free(self, path: Path) -> None:
        """Remove the socket of a server that has ended; refuse if one is running."""
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            return
        if not path.is_socket():
            raise InputError(f"{path} exists and is no socket. Choose another path for the socket.")
        probe = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with probe:
            try:
                probe.connect(str(path))
            except OSError:
                path.unlink()
                return
        raise InputError(
            f"{path}: a proxy is already running there. Choose another path for the socket."
        )
