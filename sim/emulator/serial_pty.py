"""Emulated servos behind a pseudo-terminal: a serial device for any program.

A pseudo-terminal has no baud rate of its own, so the server holds bytes back for as long as a real
line would. It keeps one end open itself, or a client that closes would end it; an unplugged adapter
is a terminal that goes away and comes back behind the same link. A USB adapter collects bytes and
delivers them with the ticks of its latency timer.
"""

from __future__ import annotations

import contextlib
import heapq
import math
import os
import pty
import select
import termios
import threading
import time
import tty
from pathlib import Path

from pupper_sysid.sim.emulator.serial_line import LineEmulator

_SPEEDS = {
    getattr(termios, f"B{rate}"): rate
    for rate in (
        9_600,
        19_200,
        38_400,
        57_600,
        115_200,
        230_400,
        460_800,
        500_000,
        921_600,
        1_000_000,
        2_000_000,
        3_000_000,
        4_000_000,
    )
}
_IDLE_S = 0.05


class SerialPty:
    """Serves an emulator; `device` is what a client opens.

    Parameters
    ----------
    emulator : LineEmulator
    link : Path, optional
        A stable name for the device, which survives being unplugged.
    latency_s : float
        Period of the adapter's latency timer; 0 for an adapter that delivers at once.
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
                    heapq.heappush(self._due, (self._delivered(due), self._count, piece))

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

    def _delivered(self, due: float) -> float:
        """When the adapter delivers bytes that it has at `due`: at the next tick of its timer."""
        if not self.latency_s:
            return due
        return math.ceil(due / self.latency_s) * self.latency_s

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
        """Rate that the host has set; None if the terminal has none.

        A terminal does not distinguish rates without a name: such a one counts as the servos' if
        theirs has no name either, and else as 0, at which no servo listens.
        """
        with contextlib.suppress(termios.error):
            named = _SPEEDS.get(termios.tcgetattr(self._host)[4])
            if named is not None:
                return named
            return 0 if self.emulator.baud in _SPEEDS.values() else self.emulator.baud
        return None
