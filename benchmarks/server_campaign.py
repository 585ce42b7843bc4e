"""Hostile proxies and serial lines, eight at once: is every call bounded, is garbage ever believed?

    .venv/bin/python benchmarks/server_campaign.py --seed 0

Each server answers in a way of its own: never, a byte per second, with garbage, too much, too late,
with another's answer. Others are no servers at all but files, FIFOs and links. A client opens the
bus, reads it twenty times, switches the torque off and closes it. Printed are the longest times of
each, the joint readings that were called good, and exceptions that are not the project's own. Exits
with 1 if there is one, if a call took longer than its bound, or if garbage was believed.
"""

from __future__ import annotations

import argparse
import os
import pty
import select
import socket
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from pupper_sysid.common.errors import PupperError
from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.connect import open_bus
from pupper_sysid.hardware.esp32 import datagrams
from pupper_sysid.hardware.feetech.frames import Frame, FrameReader

AT_ONCE, READS = 8, 20
OPEN_S, READ_S, OFF_S = 30.0, 2.0, 5.0
"""Bounds; opening tries six baud rates and twelve servos, several times each."""

Answer = Callable[[bytes, int, np.random.Generator], list[tuple[float, bytes]]]
"""Of a request and its number: delays [s] and bytes."""


def proper(request: bytes) -> bytes:
    """What an honest proxy answers."""
    size = datagrams.REPLY_SIZES.get(request[1], 2) if len(request) > 1 else 2
    body = {
        datagrams.GET_POSITION: np.full(12, 512, "<u2").tobytes(),
        datagrams.GET_LOAD: bytes(24),
        datagrams.GET_POWER: np.array([7.4, 0.5], "<f4").tobytes(),
        datagrams.GET_IMU: np.array([0, 0, 1, 0, 0, 0], "<f4").tobytes(),
    }.get(request[1] if len(request) > 1 else 0, b"")
    return bytes([size, request[1] if len(request) > 1 else 0]) + body


def counts(values: np.ndarray) -> bytes:
    """A positions' answer."""
    return bytes([26, datagrams.GET_POSITION]) + values.astype("<u2").tobytes()


PROXIES: dict[str, Answer] = {
    "never answers": lambda q, k, rng: [],
    "a byte per second": lambda q, k, rng: [(1.0 * n, b"\x1a") for n in range(5)],
    "garbage of the right size": lambda q, k, rng: [(0, rng.bytes(len(proper(q))))],
    "right header, garbage": lambda q, k, rng: [(0, proper(q)[:2] + rng.bytes(len(proper(q)) - 2))],
    "garbage of any size": lambda q, k, rng: [(0, rng.bytes(int(rng.integers(1, 2000))))],
    "60 kilobytes": lambda q, k, rng: [(0, bytes(60_000))],
    "closes after the first": lambda q, k, rng: [(0, proper(q)), (0, b"")],
    "closes at once": lambda q, k, rng: [(0, b"")],
    "a thousand answers each": lambda q, k, rng: [(0, rng.bytes(26))] * 1000,
    "half a second late": lambda q, k, rng: [(0.5, rng.bytes(26))],
    "loads for positions": lambda q, k, rng: [(0, proper(bytes([2, 3])))],
    "zeros": lambda q, k, rng: [(0, bytes(len(proper(q))))],
    "positions of zero": lambda q, k, rng: [(0, counts(np.zeros(12)))],
    "positions of 65535": lambda q, k, rng: [(0, counts(np.full(12, 65535)))],
    "positions never twice the same": lambda q, k, rng: [(0, counts(rng.integers(1, 1023, 12)))],
    "a byte too few": lambda q, k, rng: [(0, proper(q)[:-1])],
    "a byte too many": lambda q, k, rng: [(0, proper(q) + b"\0")],
    "wrong length byte": lambda q, k, rng: [(0, b"\xff" + proper(q)[1:])],
    "nothing is acknowledged": lambda q, k, rng: [(0, proper(q))] if q[1:2] != b"\x01" else [],
    "only every third answer": lambda q, k, rng: [(0, proper(q))] if k % 3 == 0 else [],
    "good, bad in turns": lambda q, k, rng: [(0, proper(q) if k % 2 else rng.bytes(26))],
}
HONEST = {"nothing is acknowledged"}
"""Whose readings are good."""


def _replies(make: Callable[[Frame, np.random.Generator], bytes], delay_s: float = 0.0) -> Answer:
    """Answers to every frame of a request."""

    def answer(request: bytes, k: int, rng: np.random.Generator) -> list[tuple[float, bytes]]:
        return [(delay_s, make(frame, rng)) for frame in FrameReader().feed(request)]

    return answer


def _size(frame: Frame) -> int:
    return frame.data[1] if len(frame.data) > 1 else 0


LINES: dict[str, Answer] = {
    "silent line": lambda q, k, rng: [],
    "line: its own echo": lambda q, k, rng: [(0, q)],
    "line: endless garbage": lambda q, k, rng: [(0, rng.bytes(4000))],
    "line: endless headers": lambda q, k, rng: [(0, b"\xff" * 4000)],
    "line: a byte per second": lambda q, k, rng: [(1.0 * n, b"\xff") for n in range(5)],
    "line: other ids": _replies(
        lambda f, rng: Frame((f.id + 1) % 250, 0, rng.bytes(_size(f))).encode()
    ),
    "line: wrong checksums": _replies(
        lambda f, rng: Frame(f.id, 0, rng.bytes(_size(f))).encode()[:-1] + b"\x5a"
    ),
    "line: garbage in good frames": _replies(
        lambda f, rng: Frame(f.id, 0, rng.bytes(_size(f))).encode()
    ),
    "line: two answers that differ": _replies(
        lambda f, rng: b"".join(Frame(f.id, 0, rng.bytes(_size(f))).encode() for _ in range(2))
    ),
    "line: too long": _replies(lambda f, rng: Frame(f.id, 0, bytes(_size(f) + 1)).encode()),
    "line: too short": _replies(lambda f, rng: Frame(f.id, 0, b"").encode()),
    "line: half of each": _replies(lambda f, rng: Frame(f.id, 0, bytes(_size(f))).encode()[:5]),
    "line: 50 ms late": _replies(
        lambda f, rng: Frame(f.id, 0, bytes(_size(f))).encode(), delay_s=0.05
    ),
}
PLACES = (
    "a file", "a FIFO", "a link to nowhere", "a folder", "/dev/zero", "/dev/null",
    "a stream socket", "a socket without a server", "a socket that never accepts",
)  # fmt: skip


class Deliveries:
    """Bytes that are due later."""

    def __init__(self, send: Callable[[bytes], None]):
        self._send = send
        self._due: list[tuple[float, bytes]] = []

    def add(self, pieces: list[tuple[float, bytes]]) -> None:
        """Take answers."""
        now = time.monotonic()
        self._due += [(now + delay, piece) for delay, piece in pieces]
        del self._due[:-2000]

    def deliver(self) -> None:
        """Send what is due."""
        now = time.monotonic()
        due = [piece for at, piece in self._due if at <= now]
        self._due = [item for item in self._due if item[0] > now]
        for piece in due:
            self._send(piece)


def serve_proxy(
    server: socket.socket, answer: Answer, rng: np.random.Generator, stop: threading.Event
) -> None:
    """Answer one client after the other."""
    server.settimeout(0.05)
    number = 0
    while not stop.is_set():
        try:
            client, _ = server.accept()
        except OSError:
            continue
        with client, suppress(OSError):
            client.setblocking(False)
            deliveries = Deliveries(partial(_send_or_close, client))
            while not stop.is_set():
                ready, _, _ = select.select([client], [], [], 0.005)
                if ready:
                    request = client.recv(64)
                    if not request:
                        break
                    deliveries.add(answer(request, number, rng))
                    number += 1
                deliveries.deliver()


def _send_or_close(client: socket.socket, piece: bytes) -> None:
    if not piece:
        raise OSError
    with suppress(BlockingIOError):
        client.send(piece)


def serve_line(host: int, answer: Answer, rng: np.random.Generator, stop: threading.Event) -> None:
    """Answer what comes along a line."""
    os.set_blocking(host, False)

    def send(piece: bytes) -> None:
        with suppress(OSError):
            os.write(host, piece)

    deliveries, number = Deliveries(send), 0
    while not stop.is_set():
        ready, _, _ = select.select([host], [], [], 0.005)
        if ready:
            with suppress(OSError):
                deliveries.add(answer(os.read(host, 4096), number, rng))
                number += 1
        deliveries.deliver()


@contextmanager
def hostile(name: str, folder: Path, rng: np.random.Generator) -> Iterator[BusAddress]:
    """The address of a server of this kind, or of what is none."""
    path = folder / "".join(c if c.isalnum() else "-" for c in name)
    stop = threading.Event()
    with ExitStack() as held:
        threads = []
        if name in PROXIES or name.startswith("a so") or name == "a stream socket":
            kind = socket.SOCK_STREAM if name == "a stream socket" else socket.SOCK_SEQPACKET
            server = held.enter_context(socket.socket(socket.AF_UNIX, kind))
            server.bind(str(path))
            if name != "a socket without a server":
                server.listen(0 if name == "a socket that never accepts" else 20)
            if name in PROXIES or name == "a stream socket":
                answer = PROXIES.get(name, PROXIES["zeros"])
                threads = [threading.Thread(target=serve_proxy, args=(server, answer, rng, stop))]
            address = BusAddress("esp32", str(path))
        elif name in LINES:
            host, servo = pty.openpty()
            held.callback(os.close, host)
            held.callback(os.close, servo)
            tty.setraw(servo)
            threads = [threading.Thread(target=serve_line, args=(host, LINES[name], rng, stop))]
            address = BusAddress("feetech", os.ttyname(servo))
        else:
            place = Path(name) if name.startswith("/") else path
            if name == "a file":
                path.write_bytes(b"x" * 1000)
            elif name == "a FIFO":
                os.mkfifo(path)
            elif name == "a link to nowhere":
                path.symlink_to(folder / "nowhere")
            elif name == "a folder":
                path.mkdir()
            address = BusAddress(str(rng.choice(["esp32", "feetech"])), str(place))
        for thread in threads:
            thread.start()
        try:
            yield address
        finally:
            stop.set()
            for thread in threads:
                thread.join()


@dataclass
class Tally:
    """What came of one server."""

    name: str
    open_s: float = 0.0
    read_s: float = 0.0
    off_s: float = 0.0
    good: int = 0
    refusal: str = ""
    other: str = ""

    def failed(self) -> bool:
        """Whether a call was not bounded, or garbage was believed."""
        believed = self.good > 0 and self.name not in HONEST
        slow = self.open_s > OPEN_S or self.read_s > READ_S or self.off_s > OFF_S
        return bool(believed or slow or self.other)


def visit(name: str, seed: int, folder: Path) -> Tally:
    """Open, read, switch off and close."""
    tally = Tally(name)
    with hostile(name, folder, np.random.default_rng(seed)) as address:
        begun = time.monotonic()
        try:
            try:
                bus = open_bus(address)
            finally:
                tally.open_s = time.monotonic() - begun
            try:
                for _ in range(READS):
                    begun = time.monotonic()
                    sample = bus.read()
                    tally.read_s = max(tally.read_s, time.monotonic() - begun)
                    tally.good += int(np.isfinite(sample.position_rad).sum())
                begun = time.monotonic()
                bus.torque(False)
                tally.off_s = time.monotonic() - begun
            finally:
                bus.close()
        except PupperError as error:
            tally.refusal = type(error).__name__
        except Exception as error:
            tally.other = repr(error)
    return tally


def descriptors() -> int:
    """Open file descriptors of this process."""
    return len(os.listdir("/proc/self/fd"))


def main() -> None:
    """Run it, and print a table."""
    parser = argparse.ArgumentParser(description="Hostile proxies and lines.")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    names = [*PROXIES, *LINES, *PLACES]
    before, threads = descriptors(), threading.active_count()
    print("| server | refused with | open s | read s: worst of 20 | torque off s | joint readings "
          "called good, of 240 | other errors |")  # fmt: skip
    print("|" + "---|" * 7)
    with tempfile.TemporaryDirectory(prefix="servers") as name:
        os.environ["XDG_RUNTIME_DIR"] = name
        with ThreadPoolExecutor(AT_ONCE) as pool:
            seeds = range(options.seed, options.seed + len(names))
            tallies = list(pool.map(visit, names, seeds, [Path(name)] * len(names)))
    for t in tallies:
        print(f"| {t.name} | {t.refusal or '–'} | {t.open_s:.2f} | {t.read_s:.3f} | {t.off_s:.3f} "
              f"| {t.good} | {t.other or '–'} |")  # fmt: skip
    failed = sum(t.failed() for t in tallies)
    load = " ".join(f"{x:.1f}" for x in os.getloadavg())
    print(
        f"\n{len(tallies)} servers, {AT_ONCE} at once: {failed} that were believed, not bounded or "
        f"answered with another error. Descriptors {before} before and {descriptors()} after, "
        f"threads {threads} and {threading.active_count()}. Load of the machine: {load}."
    )
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
