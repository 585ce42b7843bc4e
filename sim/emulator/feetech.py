"""Emulated Feetech servos: bytes of the real protocol in, bytes out, each with its time.

`FeetechEmulator` is the line and its servos without a port: `receive` takes what the host sent
and returns what comes back and when its last byte has arrived, at the line's baud rate and after
each servo's return delay. `sim.emulator.feetech_pty` puts it behind a pseudo-terminal.

Every servo has its memory table; commands and torque act on `ServoBench` when the last byte of
their frame has arrived, and a position is measured when its answer begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pupper_sysid.hardware.feetech.frames import Frame, FrameReader
from pupper_sysid.hardware.feetech.registers import (
    BAUD_RATES,
    BROADCAST_ID,
    PING,
    READ,
    RETURN_DELAY_UNIT_S,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    Series,
)
from pupper_sysid.sim.emulator.faults import BusFaults, with_wrong_length
from pupper_sysid.sim.emulator.servos.bench import AMBIENT_C, ServoBench

MEMORY_BYTES = 80
_OVERLOAD = 32  # of `hardware.feetech.registers.ERROR_BITS`

_SETTINGS = {
    "SCS0009": {
        "firmware_major": 0, "firmware_minor": 16, "return_delay": 0, "response_level": 1,
        "min_angle": 20, "max_angle": 1003, "max_temperature": 80, "max_voltage": 84,
        "min_voltage": 40, "max_torque": 1000, "p": 15, "d": 15, "i": 0, "min_start_force": 24,
        "dead_zone_cw": 1, "dead_zone_ccw": 1, "unload_condition": 37,
    },
    "STS3215": {
        "firmware_major": 3, "firmware_minor": 9, "return_delay": 250, "response_level": 1,
        "min_angle": 0, "max_angle": 4095, "max_temperature": 70, "max_voltage": 80,
        "min_voltage": 40, "max_torque": 1000, "p": 32, "d": 32, "i": 0, "min_start_force": 16,
        "dead_zone_cw": 1, "dead_zone_ccw": 1, "torque_limit": 1000, "mode": 0,
        "unload_condition": 44, "protective_torque": 20, "protection_time": 200,
        "overload_torque": 80,
    },
}  # fmt: skip


@dataclass
class _Servo:
    """Memory and faults of one servo."""

    memory: bytearray
    frozen_until: float = -np.inf
    faulty_until: float = -np.inf
    frozen_count: int = 0
    error: int = 0
    loaded_since: float = np.inf
    overloaded: bool = False
    """Its protection has acted; until its power is switched off."""


class FeetechEmulator:
    """A line of Feetech servos.

    Parameters
    ----------
    bench : ServoBench
        The servos; ids are those of its joint map.
    series : Series
        Of all of them.
    rng : numpy.random.Generator
    ids : sequence of int, optional
        Servos on the line; default all of the map.
    baud : int
        Rate at which the servos listen.
    faults : BusFaults, optional
    echo : bool
        Whether the adapter returns the host's own bytes.
    """

    def __init__(
        self,
        bench: ServoBench,
        series: Series,
        rng: np.random.Generator,
        ids=None,
        baud: int = 1_000_000,
        faults: BusFaults | None = None,
        echo: bool = False,
    ):
        self.bench, self.series, self.echo = bench, series, echo
        self.faults = faults or BusFaults({}, rng)
        self._rng, self.baud = rng, baud
        self._reader = FrameReader()
        self._free_at = 0.0
        self._brown_out_until = -np.inf
        self.unplug_for_s = 0.0
        """Set by a fault: the port shall vanish for this time [s]."""
        self.readings: list[tuple[float, int, int]] = []
        """Every position measured for an answer: time, id, count."""
        self.servos: dict[int, _Servo] = {}
        self._acting = [n for n in bench.acting_registers if n in series.registers]
        for servo_id in ids if ids is not None else bench.map.ids:
            memory = bytearray(MEMORY_BYTES)
            self.servos[servo_id] = _Servo(memory)
            settings = _SETTINGS[series.name] | {
                "model": series.model, "id": servo_id, "baud": BAUD_RATES.index(baud),
                "torque_enable": 1,
            }  # fmt: skip
            for name, value in settings.items():
                self._set(servo_id, name, value)
            memory[series.lock_address] = 1
            k = bench.index_of_id[servo_id]
            for name in self._acting:
                self._set(servo_id, name, bench.register(k, name))
            self._set(servo_id, "goal_position", bench.count(k, 0.0))

    def receive(
        self, data: bytes, now: float, baud: int | None = None
    ) -> list[tuple[float, bytes]]:
        """What comes back for `data`, which the host began to send at about `now`.

        Parameters
        ----------
        data : bytes
        now : float
            Seconds; must not go backwards.
        baud : int, optional
            Rate at which the host sends; at another than theirs the servos receive only noise.

        Returns
        -------
        list of (time, bytes)
            Pieces in order of the time at which they have arrived.
        """
        byte_s = 10.0 / (baud or self.baud)
        end = max(now, self._free_at) + len(data) * byte_s
        self._free_at = end
        pieces = [(end, data)] if self.echo else []
        if baud is None or baud == self.baud:
            for frame in self._reader.feed(data):
                pieces += self._execute(frame, byte_s)
        return sorted(pieces, key=lambda p: p[0])

    def _execute(self, frame: Frame, byte_s: float) -> list[tuple[float, bytes]]:
        at, params = self._free_at, frame.data
        if frame.code == SYNC_WRITE and len(params) > 2:
            address, size = params[0], params[1]
            for k in range(2, len(params) - size, size + 1):
                self._store(params[k], address, params[k + 1 : k + 1 + size], at)
            return []
        if frame.code == SYNC_READ and len(params) > 2 and self.series.has_sync_read:
            address, size, ids = params[0], params[1], params[2:]
            pieces = []
            for servo_id in ids:
                pieces += self._answer(servo_id, address, size, byte_s)
            return pieces
        if frame.id == BROADCAST_ID:
            return []
        if frame.code == PING:
            return self._answer(frame.id, 0, 0, byte_s)
        if frame.code == READ and len(params) == 2:
            return self._answer(frame.id, params[0], params[1], byte_s)
        if frame.code == WRITE and len(params) > 1:
            self._store(frame.id, params[0], params[1:], at)
            return self._answer(frame.id, 0, 0, byte_s)
        return []

    def _store(self, servo_id: int, address: int, data: bytes, at: float) -> None:
        servo = self.servos.get(servo_id)
        if servo is None or address + len(data) > MEMORY_BYTES or at < self._brown_out_until:
            return
        if address < 40 and servo.memory[self.series.lock_address]:
            return
        servo.memory[address : address + len(data)] = data
        touched = range(address, address + len(data))
        k = self.bench.index_of_id[servo_id]
        for name in self._acting:
            if self.series.registers[name].address in touched:
                self.bench.set_register(k, at, name, self._get(servo_id, name))
        if self.series.registers["goal_position"].address in touched:
            # the goal clips at the servo's own angle limits, and switches the torque on
            low, high = self._get(servo_id, "min_angle"), self._get(servo_id, "max_angle")
            self._set(servo_id, "torque_enable", 1)
            self.bench.torque(k, at, True)
            self.bench.command(k, at, int(np.clip(self._get(servo_id, "goal_position"), low, high)))
        if self.series.registers["torque_enable"].address in touched:
            self.bench.torque(k, at, bool(self._get(servo_id, "torque_enable")))

    def _answer(
        self, servo_id: int, address: int, size: int, byte_s: float
    ) -> list[tuple[float, bytes]]:
        """The answer of one servo, after its return delay, as the line delivers it."""
        servo = self.servos.get(servo_id)
        if servo is None or self._free_at < self._brown_out_until:
            return []
        begin = self._free_at + RETURN_DELAY_UNIT_S * self._get(servo_id, "return_delay")
        kind = self._inject_fault(servo_id, begin)
        if begin < self._brown_out_until:
            return []
        self._refresh(servo_id, begin)
        error = servo.error if begin < servo.faulty_until else 0
        error |= _OVERLOAD * servo.overloaded
        frame = Frame(servo_id, error, bytes(servo.memory[address : address + size]))
        answer = frame.encode()
        # the answer of another servo to another request
        other = Frame((servo_id + 100) % 250, 0, bytes(len(frame.data))).encode()
        if kind == "wrong-length":
            answer = with_wrong_length(frame, self._rng)
        pieces = self.faults.apply(kind, answer, other)
        arrived = []
        for delay, data in pieces:
            self._free_at = max(self._free_at, begin) + len(data) * byte_s
            arrived.append((self._free_at + delay, data))
        if kind == "second-writer":
            arrived += self._second_writer(byte_s)
        return arrived

    def _inject_fault(self, servo_id: int, at: float) -> str | None:
        """Draw a fault; start it if it lasts. Returns its kind."""
        kind = self.faults.draw()
        servo = self.servos[servo_id]
        if kind == "frozen":
            servo.frozen_until = at + self.faults.lasts_s
            servo.frozen_count = self.bench.count(self.bench.index_of_id[servo_id], at)
        elif kind == "error-bits":
            servo.faulty_until = at + self.faults.lasts_s
            servo.error = int(self._rng.choice([1, 2, 4, 8, 32, 33]))
        elif kind == "brown-out":
            self._brown_out_until = at + self.faults.lasts_s
            for other in self.servos:
                self._set(other, "torque_enable", 0)
                self.bench.torque(self.bench.index_of_id[other], at, False)
            self.faults.ended.append((kind, self._brown_out_until))
        elif kind == "unplugged":
            self.unplug_for_s = self.faults.lasts_s
        return kind

    def _second_writer(self, byte_s: float) -> list[tuple[float, bytes]]:
        """Another host's request on the wire, which the first host receives, too."""
        victim = int(self._rng.choice(list(self.servos)))
        k = self.bench.index_of_id[victim]
        count = int(np.clip(self.bench.count(k, self._free_at) + self._rng.integers(-40, 40), 0,
                            self.series.counts - 1))  # fmt: skip
        goal = self.series.registers["goal_position"]
        frame = Frame(
            victim, WRITE, bytes([goal.address]) + self.series.encode("goal_position", count)
        )
        self._free_at += len(frame.encode()) * byte_s
        self._store(victim, goal.address, frame.data[1:], self._free_at)
        return [(self._free_at, frame.encode())]

    def _refresh(self, servo_id: int, at: float) -> None:
        """Measure: the memory from 56 on holds values of this moment."""
        k = self.bench.index_of_id[servo_id]
        servo = self.servos[servo_id]
        frozen = at < servo.frozen_until
        count = servo.frozen_count if frozen else self.bench.count(k, at)
        if self.bench.keep_log:
            self.readings.append((at, servo_id, count))
        self._set(servo_id, "present_position", count)
        self._set(servo_id, "present_load", self.bench.load(k))
        self._set(servo_id, "present_voltage", round(10 * self.bench.supply_v))
        self._set(servo_id, "present_temperature", round(AMBIENT_C))
        self._protect(servo_id, at)

    def _protect(self, servo_id: int, at: float) -> None:
        """The servo's own overload protection, as its registers have it."""
        if "overload_torque" not in self.series.registers:
            return
        servo, k = self.servos[servo_id], self.bench.index_of_id[servo_id]
        loaded = abs(self._get(servo_id, "present_load")) > 10 * self._get(
            servo_id, "overload_torque"
        )
        servo.loaded_since = min(servo.loaded_since, at) if loaded else np.inf
        lasted_s = at - servo.loaded_since
        enabled = self._get(servo_id, "unload_condition") & _OVERLOAD
        if enabled and lasted_s >= 0.01 * self._get(servo_id, "protection_time"):
            servo.overloaded = True
            if "torque_limit" in self._acting:
                limit = 10 * self._get(servo_id, "protective_torque")
                self.bench.set_register(k, at, "torque_limit", limit)

    def _set(self, servo_id: int, name: str, value: int) -> None:
        register = self.series.registers[name]
        encoded = self.series.encode(name, value)
        self.servos[servo_id].memory[register.address : register.address + register.size] = encoded

    def _get(self, servo_id: int, name: str) -> int:
        return self.series.decode(name, bytes(self.servos[servo_id].memory))
