"""Rerun and MCAP while a loop runs: the channels of `view`, from a second process.

`SideProcess` is a process beside a loop that moves or reads servos, which takes messages and may be
slow; here it is this module, whose `main` writes. The loop hands it a message per tick and never
waits: one for which there is no space is dropped, so that a slow disk or viewer delays no servo.
How many were dropped is printed at the end.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import select
import signal
import socket
import subprocess
import sys
import threading
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus
from pupper_sysid.hardware.safety.guard import GuardedBus

if TYPE_CHECKING:
    from pupper_sysid.policies.deploy.deployment import Tick
    from pupper_sysid.sysid.view import McapStream, RerunStream

LONGEST_MESSAGE = 65536


class SideProcess:
    """A module in a second process, behind a socket whose descriptor is its argument.

    Its reading end ends with this process, however that ends.
    """

    def __init__(self, module: str):
        self.here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with there:
            self.process = subprocess.Popen(
                # -P: a file in the user's folder, such as json.py, must not stand in for a module
                [sys.executable, "-P", "-m", module, str(there.fileno())],
                pass_fds=[there.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            )  # fmt: skip
        self.here.setblocking(False)

    def send(self, message: bytes, within_s: float = 0.0) -> bool:
        """Hand over a message, at most `LONGEST_MESSAGE`; whether it was taken.

        For `within_s` space is awaited.
        """
        try:
            if within_s:
                select.select([], [self.here], [], within_s)
            self.here.send(message)
        except OSError:  # the writer is behind, or has ended: the loop continues
            return False
        return True

    def answer(self, within_s: float) -> bytes:
        """A message of the process; empty if it ended."""
        if not select.select([self.here], [], [], within_s)[0]:
            raise InputError(
                f"A helping process did not answer within {within_s:.0f} s. Check the machine's "
                "load and memory, then try again."
            )
        try:
            return self.here.recv(LONGEST_MESSAGE)
        except OSError:
            return b""

    def end(self, within_s: float) -> bool:
        """Say that nothing follows, and wait; whether the process ended by itself."""
        self.here.close()
        try:
            self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return False
        return True


Array = NDArray[np.float64]

TICK, TEXTS = b"S", b"T"
VIEWER = "viewer"
VIEWER_ADDRESS = "rerun+http://127.0.0.1:9876/proxy"

_ENDINGS = {"rerun": ".rrd", "mcap": ".mcap"}
_START_S = 60.0  # libraries on a slow memory card
_END_S = 30.0  # for the writer's backlog; the robot is parked by then
_WAIT_S = 10.0  # in virtual time


def refuse_files(force: bool, **files: Path | None) -> None:
    """Refuse files for viewers that are there, or have not the ending that the viewer knows."""
    for option, path in files.items():
        if path is not None:
            if path.suffix != _ENDINGS[option]:
                raise InputError(f"--{option} {path}: its name must end in {_ENDINGS[option]}.")
            refuse_overwrite(path, force)


@dataclass(frozen=True)
class ViewTargets:
    """Viewers and files that a command writes to while it runs."""

    rerun: str | None
    mcap: Path | None
    force: bool = False

    def __bool__(self) -> bool:
        return self.rerun is not None or self.mcap is not None

    @property
    def rerun_file(self) -> Path | None:
        """The file for Rerun, if it is no viewer."""
        return None if self.rerun is None or self.rerun_address else Path(self.rerun)

    @property
    def rerun_address(self) -> str | None:
        """Address of the viewer, if it is one."""
        if self.rerun == VIEWER:
            return VIEWER_ADDRESS
        return self.rerun if self.rerun and "://" in self.rerun else None

    def check(self) -> None:
        """Refuse files that are there or have another ending."""
        refuse_files(self.force, mcap=self.mcap)
        if self.rerun_file is not None:
            if self.rerun_file.suffix != _ENDINGS["rerun"]:
                raise InputError(
                    f"--rerun {self.rerun}: give a file whose name ends in .rrd, the word "
                    f"{VIEWER}, or a viewer's address such as {VIEWER_ADDRESS}."
                )
            refuse_overwrite(self.rerun_file, self.force)


class LiveViews:
    """The loop's side: starts the writer, and finishes the files at the end of the block.

    With `waits` a writer that is behind is awaited: of a bus in virtual time, where that delays
    nothing.
    """

    def __init__(self, bus: ServoBus, targets: ViewTargets, waits: bool = False):
        from pupper_sysid.sysid.view import packed

        self._packed = packed
        self._targets, self._within_s = targets, _WAIT_S if waits else 0.0
        self._report = bus.report if isinstance(bus, GuardedBus) else None
        self.dropped = self._events_sent = 0
        self._last_s = 0.0
        joints = bus.joint_names
        knee = "serial" if bus.metadata.get("linkage") == "none" else "linkage"
        about = {
            "mcap": targets.mcap and str(targets.mcap),
            "rerun_file": targets.rerun_file and str(targets.rerun_file),
            "rerun_address": targets.rerun_address,
            "force": targets.force,
            "joints": list(joints),
            "live": bus.metadata.get("readings") == "live",
            "knee": knee if set(joints) <= set(JOINT_NAMES) else None,
        }
        self._process = SideProcess(__spec__.name)
        try:
            self._process.send(json.dumps(about).encode())
            refused = self._answer(_START_S)
        except BaseException:
            self._process.end(_END_S)
            raise
        if refused:
            self._process.end(_END_S)
            raise InputError(refused)

    def __enter__(self) -> LiveViews:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(str(error) if isinstance(error, PupperError) else "")

    def tick(
        self, trial: int, sent: Sent, reading: BusSample, gravity: Array | None = None
    ) -> None:
        """Show one tick; NaN where nothing was sent.

        Ages of readings begin anew with each trial. `gravity`, shape (3,), is its direction in the
        trunk's frame.
        """
        more = () if gravity is None else (gravity,)
        # a tick that was dropped may have held the first reading of a value
        row = self._packed(trial + self.dropped, sent, reading, *more)
        self.dropped += not self._process.send(TICK + row.tobytes(), self._within_s)
        self._last_s = float(np.nanmax([sent.time_s, self._last_s, reading.time_s.max()]))
        if self._report and len(self._report.events) > self._events_sent:
            self._send_events()

    def walk_tick(self, to_servo: Callable[[Array], Array], tick: Tick) -> None:
        """Show one tick of a walk in servo angles, which `to_servo` makes of joint angles."""
        from pupper_sysid.sim.walking.step import OBSERVATION_PARTS

        reading = replace(tick.reading, position_rad=to_servo(tick.reading.position_rad))
        gravity = tick.decision.observation[OBSERVATION_PARTS["projected_gravity"]]
        self.tick(0, Sent(tick.sent_s, to_servo(tick.sent)), reading, gravity.astype(float))

    def say(self, *texts: str, within_s: float = 1.0) -> None:
        """Show sentences at the time of the last tick; after the loop, since it may wait."""
        events = [[self._last_s, text] for text in texts]
        self._process.send(TEXTS + json.dumps({"events": events}).encode(), within_s)

    def close(self, reason: str = "") -> None:
        """Finish what was written, and print where it is, or why it is not whole."""
        from pupper_sysid.sysid.view import guard_counts

        if self._report:
            self._send_events()
        texts = guard_counts(self._report.summary()) if self._report else []
        self.say(*texts, *filter(None, [reason]), within_s=_WAIT_S)
        self._process.send(TEXTS + json.dumps({"events": [], "end": True}).encode(), _WAIT_S)
        try:
            wrong = self._answer(_END_S)
        except InputError:
            wrong = f"the writer was still behind after {_END_S:.0f} s and was ended."
        self._process.end(1.0 if wrong else _END_S)
        targets = self._targets
        names = [str(name) for name in (targets.rerun, targets.mcap) if name is not None]
        if wrong:
            terminal.warn(f"{' and '.join(names)}: {wrong}")
            return
        for path in filter(None, (targets.rerun_file, targets.mcap)):
            terminal.err.print(f"Wrote {path}.")
        if self.dropped:
            terminal.warn(
                f"{' and '.join(names)}: {self.dropped} ticks were dropped, for the writer was "
                "behind. Recordings of this command are whole."
            )

    def _send_events(self) -> None:
        """Send what the guard changed since the last time."""
        from pupper_sysid.sysid.view import guard_text

        assert self._report is not None
        events = self._report.events[self._events_sent :]
        texts = [[time_s, guard_text(kind)] for time_s, kind in events]
        if self._process.send(TEXTS + json.dumps({"events": texts}).encode(), self._within_s):
            self._events_sent += len(events)

    def _answer(self, within_s: float) -> str:
        """What the writer says is wrong; empty if nothing is."""
        message = self._process.answer(within_s)
        if not message:
            return "the writer ended by itself; what it printed says why."
        return json.loads(message)["error"]


# ----- the writing process

_VIEWED_EVERY_S, _FILED_EVERY_S = 0.2, 1.0  # per part: a file of few large parts is smaller
_MOST_TOGETHER = 500
_MOST_WAITING = 20_000  # ticks; minutes of a slow disk
_NICENESS = 5
_VIEWER_S = 5.0
_VIEWER_PORT = 9876


class Writer:
    """Files and viewers that ticks are written to; `about` is what `live_views` sends."""

    def __init__(self, about: dict[str, Any]):
        from pupper_sysid.sysid.view import TickChannels

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
        from pupper_sysid.sysid.view import McapStream, RerunStream

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
