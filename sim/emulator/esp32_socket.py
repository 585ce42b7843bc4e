"""The emulated proxy on its socket: one server, any number of clients, one shared block."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
from pathlib import Path

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.emulator.esp32 import ProxyEmulator

_BACKLOG, _BUFFER, _IDLE_S = 20, 38, 0.05
_LONGEST_PATH = 107  # bytes, of a socket on Linux


class ProxySocket:
    """Serves a `ProxyEmulator` at a path.

    Parameters
    ----------
    emulator : ProxyEmulator
    path : Path
        Of the socket; removed at the end.

    Raises
    ------
    InputError
        If something else is there.
    """

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
            for one in ready:
                if one is self._server:
                    client, _ = self._server.accept()
                    self._previous[client] = b""
                else:
                    self._talk(one)

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
