"""Emulated servos on a serial line in virtual time: no thread serves them, and no host is busy.

What a line does in real time, through a terminal of the system, is the matter of other tests.
"""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import serial

from pupper_sysid.hardware import loop
from pupper_sysid.hardware.serial_servos import line, settings
from pupper_sysid.sim.emulator.serial_line import LineEmulator
from support.virtual_time import VirtualTime


class VirtualSerial:
    """What `serial.Serial` is to the product: bytes of an emulator arrive when they are due."""

    def __init__(
        self,
        emulator: LineEmulator,
        clock: VirtualTime,
        latency_s: float,
        baud: int,
        timeout_s: float,
    ):
        self._emulator, self._clock, self._latency_s = emulator, clock, latency_s
        self._baud, self._timeout_s = baud, timeout_s
        self._due: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> int:
        for due, piece in self._emulator.receive(bytes(data), self._clock.time, self._baud):
            ticks = self._latency_s and math.ceil(due / self._latency_s)
            self._due.append((ticks * self._latency_s or due, piece))
        self._due.sort(key=lambda piece: piece[0])
        return len(data)

    @property
    def in_waiting(self) -> int:
        return sum(len(piece) for due, piece in self._due if due <= self._clock.time)

    def read(self, size: int) -> bytes:
        if not self.in_waiting:
            next_s = self._due[0][0] if self._due else float("inf")
            self._clock.sleep_until(min(next_s, self._clock.time + self._timeout_s))
        size = self.in_waiting
        got = b"".join(piece for _, piece in self._due)[:size]
        self.reset_input_buffer()
        return got

    def reset_input_buffer(self) -> None:
        self._due = [piece for piece in self._due if piece[0] > self._clock.time]

    def close(self) -> None:
        self._due.clear()

    def set_low_latency_mode(self, on: bool) -> None:
        raise NotImplementedError("as on an emulated line")


@contextmanager
def on_a_virtual_line(
    folder: Path, *emulators: LineEmulator, latency_s: float = 0.0
) -> Iterator[list[str]]:
    """Devices of the servos, whose time passes only while this process waits for them.

    `latency_s` is the period of the adapter's timer, with whose ticks it delivers.
    """
    clock = VirtualTime()
    served = {str(folder / f"line{k}"): emulator for k, emulator in enumerate(emulators)}

    def opened(device: str, baud: int, timeout: float, **_: object) -> VirtualSerial:
        return VirtualSerial(served[device], clock, latency_s, baud, timeout)

    def sleep(seconds: float) -> None:
        clock.time += max(seconds, 1e-6)  # the product's clock tells microseconds apart

    passing = SimpleNamespace(**vars(time) | {"monotonic": clock.now, "sleep": sleep})
    port = SimpleNamespace(**vars(serial) | {"Serial": opened})
    for device in served:
        Path(device).touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(line, "serial", port)
        for module in (line, loop, settings):
            patch.setattr(module, "time", passing)
        yield list(served)
