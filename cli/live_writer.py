"""The process that writes what `cli.live_views` hands over, to Rerun and to MCAP."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import socket
import sys
import threading
import uuid
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.cli.live_views import LONGEST_MESSAGE, TICK
from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.view import McapStream, RerunStream, TickChannels

Array = NDArray[np.float64]

_VIEWED_EVERY_S, _FILED_EVERY_S = 0.2, 1.0  # per part: a file of few large parts is smaller
_MOST_TOGETHER = 500
_MOST_WAITING = 20_000  # ticks; minutes of a slow disk
_NICENESS = 5
_VIEWER_S = 5.0
_VIEWER_PORT = 9876


class Writer:
    """Files and viewers that ticks are written to; `about` is what `live_views` sends."""

    def __init__(self, about: dict[str, Any]):
        self.every_s = _VIEWED_EVERY_S if about["rerun_address"] else _FILED_EVERY_S
        self._joints = list(about["joints"])
        self._channels = TickChannels(self._joints, about["live"])
        self._rerun: RerunStream | None = None
        self._mcap: McapStream | None = None
        self._files: list[Path] = []
        self._any = False
        self._posed_s = -np.inf
        try:
            self._open(about)
        except BaseException:
            self._remove_files()
            raise

    def _open(self, about: dict[str, Any]) -> None:
        if about["mcap"]:
            self._file = self._new(Path(about["mcap"]), about["force"])
            self._mcap = McapStream(self._file)
        address, path = about["rerun_address"], about["rerun_file"]
        if not address and not path:
            return
        self._rerun = RerunStream(uuid.uuid4().hex)
        if address:
            try:  # Rerun itself would wait for a viewer
                url = urlsplit(address)
                where = url.hostname or "", url.port or _VIEWER_PORT
                socket.create_connection(where, _VIEWER_S).close()
            except (OSError, ValueError) as error:
                raise InputError(
                    f"No Rerun viewer answers at {address}: {error}. Start one by the command "
                    "rerun, or give a file whose name ends in .rrd."
                ) from error
            self._rerun.connect(address)
        else:
            self._new(Path(path), about["force"]).close()
            self._rerun.save(Path(path))
        self._robot = None
        if about["knee"]:
            from pupper_sysid.policies.twin.drawing import HungRobot
            from pupper_sysid.sim.robot.replay import mini_pupper_robot

            self._robot = HungRobot(mini_pupper_robot(about["knee"]))
            self._rerun.show(self._robot.bodies(self._robot.robot.rest_rad[None]))

    def take(self, rows: Array, events: list[tuple[float, str]]) -> None:
        """Write ticks, shape (n, numbers of a tick), and sentences with their times."""
        messages = self._channels.take(rows) if len(rows) else []
        self._any |= bool(messages or events)
        if self._mcap:
            self._mcap.add(messages, events)
        if self._rerun:
            self._rerun.add(messages, events)
            if self._robot and len(rows):
                self._move(rows)

    def _move(self, rows: Array) -> None:
        """The robot's poses at some of the ticks."""
        from pupper_sysid.policies.twin.drawing import POSES_PER_S

        assert self._robot and self._rerun
        time_s, held, gravity = self._channels.poses(rows)
        rows_shown = []
        for k, now in enumerate(time_s):
            if now >= self._posed_s + 1 / POSES_PER_S:
                self._posed_s = now
                rows_shown.append(k)
        if not rows_shown:
            return
        robot = self._robot.robot
        servo = np.tile(robot.rest_rad, (len(rows_shown), 1))
        at = [robot.joints.index(joint) for joint in self._joints]
        servo[:, at] = np.where(np.isfinite(held[rows_shown]), held[rows_shown], servo[:, at])
        self._rerun.move(time_s[rows_shown], self._robot.bodies(servo, gravity[rows_shown]))

    def close(self) -> None:
        """Finish the files; those without content are removed."""
        if self._rerun:
            self._rerun.close(_VIEWER_S)
        if self._mcap:
            self._mcap.close()
            self._file.close()
        if not self._any:
            self._remove_files()

    def _new(self, path: Path, force: bool) -> Any:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("wb" if force else "xb")
        except OSError as error:
            raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error
        self._files.append(path)
        return file

    def _remove_files(self) -> None:
        for path in self._files:
            path.unlink(missing_ok=True)


def main() -> None:
    """Write what comes through the socket whose descriptor is the argument."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # Ctrl-C is for the loop, which then ends this
    with contextlib.suppress(OSError):
        os.nice(_NICENESS)
    source = socket.socket(fileno=int(sys.argv[1]))

    def answer(error: str) -> None:
        with contextlib.suppress(OSError):  # the loop's process was killed
            source.send(json.dumps({"error": error}).encode())

    first = source.recv(LONGEST_MESSAGE)
    if not first:
        return
    try:
        writer = Writer(json.loads(first))
    except InputError as error:
        answer(str(error))
        return
    answer("")
    waiting: queue.Queue[bytes] = queue.Queue(_MOST_WAITING)
    over = threading.Event()
    threading.Thread(target=_receive, args=(source, waiting, over), daemon=True).start()
    wrong = ""
    try:
        _write(writer, waiting, over)
    except (OSError, InputError) as error:
        wrong = f"{getattr(error, 'strerror', None) or error}".rstrip(".")
        wrong = f"what follows could not be written: {wrong}."
    try:
        writer.close()
    except (OSError, InputError) as error:
        wrong = wrong or f"it has no end: {getattr(error, 'strerror', None) or error}"
    answer(wrong)


def _receive(source: socket.socket, waiting: queue.Queue[bytes], over: threading.Event) -> None:
    """Take messages as they come: the socket itself has space for few."""
    message = b"-"
    while message:
        try:
            message = source.recv(LONGEST_MESSAGE)
        except OSError:
            message = b""
        if not message or message[:1] != TICK:  # perhaps the end
            over.set()
        waiting.put(message)


def _write(writer: Writer, waiting: queue.Queue[bytes], over: threading.Event) -> None:
    """Write parts until the message of the end, or until the loop's process has ended."""
    ended = False
    while not ended:
        messages = [waiting.get()]
        if waiting.qsize() < _MOST_TOGETHER:
            over.wait(writer.every_s)
            over.clear()
        with contextlib.suppress(queue.Empty):
            while len(messages) < _MOST_TOGETHER:
                messages.append(waiting.get_nowait())
        rows, events = [], []
        for message in messages:
            if not message:
                ended = True
            elif message[:1] == TICK:
                rows.append(np.frombuffer(message[1:]))
            else:
                content = json.loads(message[1:])
                events += [(float(at), text) for at, text in content["events"]]
                ended |= content.get("end", False)
        writer.take(np.array(rows), events)


if __name__ == "__main__":
    main()
