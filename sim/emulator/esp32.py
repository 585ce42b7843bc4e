"""The Mini Pupper 2's proxy and firmware, emulated: datagrams in, datagrams out.

`ProxyEmulator` is the shared block, the firmware's loop behind it and the servos, without a socket;
`sim.emulator.esp32_socket` serves it. It has the real one's quirks: no owner and no watchdog, an
acknowledgement that does not depend on the servos, zeros until the first feedback, feedback polled
one servo after the other with silent losses, an unknown request answered with the previous answer,
the last request executed once more when a client leaves, and a torque byte that stores a
calibration.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware.esp32 import datagrams
from pupper_sysid.hardware.imu import to_chip
from pupper_sysid.sim.emulator.faults import BusFaults
from pupper_sysid.sim.emulator.poll_schedule import PollSchedule
from pupper_sysid.sim.emulator.servos.bench import ServoBench

TICK_S = 0.002
"""Period of the firmware's servo task [s], which writes goal positions."""
STAND_UP_S = 4.0
"""Time to stand up after a start or a stored calibration, in which commands are ignored [s]."""
LOW_VOLTAGE_V = 4.0

_SET = struct.Struct("<BB12B12H")
_CENTRE = 512


class ProxyEmulator:
    """Proxy, firmware and servos.

    Parameters
    ----------
    bench : ServoBench
        With a joint map of the proxy's counts, ids 1 to 12.
    rng : numpy.random.Generator
        Lost polls, and the answers to unknown requests.
    faults : BusFaults, optional

    Raises
    ------
    InputError
        If the robot's readings are not polled.
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
        servos = datagrams.SERVOS
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
        if opcode == datagrams.SET_POSITION and len(request) == _SET.size:
            values = _SET.unpack(request)[2:]
            self._execute(values[:12], values[12:], now)
            return datagrams.ACKNOWLEDGED
        if request == datagrams.request(datagrams.GET_IMU):
            return self._imu(now)
        self._refresh(now)
        if len(request) == 2:
            if opcode == datagrams.GET_POSITION:
                return struct.pack("<BB12H", 26, opcode, *self._counts)
            if opcode == datagrams.GET_LOAD:
                return struct.pack("<BB12h", 26, opcode, *self._loads)
            if opcode == datagrams.GET_POWER:
                return struct.pack("<BB2f", 10, opcode, self.bench.supply_v, 0.4)
        return previous or self.rng.bytes(2)

    def resend(self, now: float) -> None:
        """Repeat the last command once deaf servos hear again, as the proxy does all the time."""
        if self._undone and self._block and now >= self._deaf_until:
            self._execute(*self._block, now)

    def inject_fault(self, now: float) -> str | None:
        """Draw a fault for the next answer; start it if it lasts. Returns its kind."""
        kind = self.faults.draw()
        servo = int(self.rng.integers(datagrams.SERVOS))
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
            goal = np.clip(self._counts + self.rng.integers(-8, 9, 12), 1, datagrams.HIGHEST_COUNT)
            self._execute((1,) * 12, tuple(int(c) for c in goal), now)
        return kind

    def apply_fault(self, kind: str | None, reply: bytes) -> list[tuple[float, bytes]]:
        """What is sent instead of `reply`: pieces, each with its delay [s]."""
        if kind == "wrong-length":
            return [(0.0, reply + b"\0" if self.rng.random() < 0.5 else reply[:-1] or b"\0")]
        other = struct.pack("<BB2f", 10, datagrams.GET_POWER, self.bench.supply_v, 0.4)
        return self.faults.apply(kind, reply, other)

    def _imu(self, now: float) -> bytes:
        sample = self.bench.imu(now)
        raw = np.zeros(6) if sample is None else to_chip(sample)
        return struct.pack("<BB6f", 26, datagrams.GET_IMU, *raw)

    def _execute(self, torque: tuple[int, ...], counts: tuple[int, ...], now: float) -> None:
        """A command reaches the servos with the firmware's next tick."""
        if torque[0] == datagrams.SAVE_CALIBRATION:
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
        raw = np.clip(np.array(counts) - self._calibration, 0, datagrams.HIGHEST_COUNT)
        for k, on, count in zip(self._index, torque, raw, strict=True):
            if on == datagrams.TORQUE_ON:
                self.bench.torque(k, at, True)
                self.bench.command(k, at, int(count))
            elif on == datagrams.TORQUE_OFF:
                self.bench.torque(k, at, False)

    def _refresh(self, now: float) -> None:
        """Bring the block's feedback up to what was polled by `now`."""
        self._time = max(self._time, now)
        measured = self._polls.advance(self._time)
        for servo, k in enumerate(self._index):
            at = measured[k]
            if at > self._measured[servo] and at >= 0 and at >= self._stuck_until[servo]:
                calibrated = self.bench.count(k, at) + self._calibration[servo]
                self._counts[servo] = min(max(calibrated, 1), datagrams.HIGHEST_COUNT)
                self._loads[servo] = self.bench.load(k)
                self._measured[servo] = at
        block = tuple(int(c) for c in self._counts)
        if self.bench.keep_log and (not self.history or self.history[-1][1] != block):
            self.history.append((self._time, block))


class ImuProxy(ProxyEmulator):
    """A proxy that answers for the IMU alone; the robot's servos are on another line."""

    def answer(self, request: bytes, previous: bytes, now: float) -> bytes:
        """The reply to one datagram at `now`; all but GET_IMU are unknown."""
        if request == datagrams.request(datagrams.GET_IMU):
            return self._imu(now)
        return previous or self.rng.bytes(2)
