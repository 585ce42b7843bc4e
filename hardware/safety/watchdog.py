"""The driver's end of the watchdog: a second process that parks the robot if this one is gone.

Neither the robot's proxy nor a servo notices that its host has died: the last command is held for
ever, with full torque. So a program that drives a robot starts a `Watchdog` and calls `beat` often.
If the pipe between the two closes without a message, or no beat comes for a second,
`hardware.safety.watchdog_process` parks the robot. That process answers what it receives: if it
ends, or does not answer for half a second, the next beat stops the driver. Nothing here waits for
it: a full pipe is the same as no answer.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import subprocess
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError, SafetyStop
from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.lock import remove_note, write_note
from pupper_sysid.hardware.loop import lasting_s

HANG_S = 1.0
"""Without a beat for so long, the driver counts as hung."""
SWITCH_ON_S = 5.0
"""Longest time to switch the torque on, servo by servo on a line with faults."""

_BEAT_S = 0.05
_SILENT_S = 0.5
_START_WITHIN_S = 20.0


class Watchdog:
    """Start the watchdog process and send it beats; `joint_map` is that of the bus."""

    def __init__(self, address: BusAddress, joint_map: JointMap):
        self._beaten_s, self._due_s = 0.0, math.inf
        self._unanswered: deque[float] = deque()
        self._pose: dict[str, float] = {}
        self._registers: Mapping[str, Mapping[str, int]] = {}
        self._orders = {
            "kind": address.kind,
            # from any folder
            "where": os.path.abspath(address.where),
            "baud": address.baud,
            "map": joint_map.file.model_dump(mode="json", by_alias=True),
            "coordinates": joint_map.coordinates,
            "driver": os.getpid(),
        }
        self._start()

    def _start(self) -> None:
        """Start the process, and wait until it is ready."""
        # another session: Ctrl-C at the terminal is for the driver
        self._process = subprocess.Popen(
            # -P: a file in the user's folder, such as json.py, must not stand in for a module
            [sys.executable, "-P", "-m", "pupper_sysid.hardware.safety.watchdog_process"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        assert self._process.stdin is not None and self._process.stdout is not None
        self._send(self._orders)
        ready, _, _ = select.select([self._process.stdout], [], [], _START_WITHIN_S)
        if not ready or self._process.stdout.readline() != b"ready\n":
            self._process.kill()
            raise BusError(
                "the watchdog process did not start, and without it the robot would not be parked "
                "if this process died. Check the machine's load and memory, then try again."
            )
        for pipe in (self._process.stdin, self._process.stdout):
            os.set_blocking(pipe.fileno(), False)
        self._unanswered.clear()

    def arm(self, joints: Sequence[str], pose_rad: NDArray[np.float64]) -> None:
        """Expect beats from now on, and park at this pose.

        To be called before the first servo is on: a driver may be killed while it switches them.
        """
        self._pose = dict(zip(joints, map(float, pose_rad), strict=True))
        self._arm()
        self._due_s = lasting_s() + SWITCH_ON_S

    def _arm(self) -> None:
        self._note()
        self._send({"arm": self._pose})

    def disarm(self) -> None:
        """Expect no beats: the torque is off."""
        self._due_s, self._pose = math.inf, {}
        self._send({"disarm": True})
        remove_note(self._orders["where"])

    def beat(self) -> None:
        """Report that the driver is in control; cheap enough for every tick.

        `SafetyStop` if the watchdog process has ended, or has not answered for half a second; or if
        this process, or the machine, stood still for so long that the torque may be off by now.
        """
        now, lasting = time.monotonic(), lasting_s()
        late_s = lasting - self._due_s
        if self._due_s < math.inf:
            self._due_s = lasting + HANG_S
        if late_s > 0:
            raise SafetyStop(
                f"this process stood still for {HANG_S + late_s:.1f} s while the torque was on. "
                "Find out what stopped it (a suspended machine, a debugger), then start again."
            )
        if now - self._beaten_s > _BEAT_S:
            self._beaten_s = now
            self._take_answers()
            if self._silent(now):
                raise SafetyStop(
                    f"the watchdog process has not answered for {_SILENT_S:g} s, and without it "
                    "the robot would not be parked if this process died. Find out what stopped "
                    "it, then start again."
                )
            if self._process.poll() is not None:
                raise SafetyStop(
                    "the watchdog process has ended, and without it the robot would not be parked "
                    "if this process died. Find out what ended it (the system's log names a lack "
                    "of memory), then start again."
                )
            self._send({"beat": True})

    def only_limp(self) -> None:
        """From now on only switch the torque off: the way back is not to be taken."""
        self._send({"limp": True})

    def restore(self, registers: Mapping[str, Mapping[str, int]]) -> None:
        """Set these registers back, by joint, if the driver ends without having done so."""
        changed = registers != self._registers
        self._registers = {joint: dict(values) for joint, values in registers.items()}
        self._send({"registers": registers})
        if changed and self._pose:
            self._note()

    def _note(self) -> None:
        """Note for `pupper-sysid park` what is on, and what is to be set back."""
        orders = self._orders | {"registers": self._registers}
        write_note(orders, list(self._pose), self._process.pid)

    def take_over(self) -> None:
        """Torque-off or a register was not confirmed and the bus is released: keep trying.

        A watchdog process that has ended or does not answer, which may be why, is replaced.
        """
        self._take_answers()
        if self._process.poll() is not None or self._silent(time.monotonic()):
            self._process.kill()
            self._close_pipe()
            self._start()
            if self._pose:
                self._arm()
            self.restore(self._registers)
        self.only_limp()
        self._close_pipe()

    def close(self) -> None:
        """End the watchdog process; may be called twice."""
        self._send({"bye": True})
        self._close_pipe()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)

    def _send(self, message: dict[str, Any]) -> None:
        """Write a message; a pipe that is full takes none, which leaves it unanswered."""
        pipe = self._process.stdin
        if pipe is None or pipe.closed:
            return
        self._unanswered.append(time.monotonic())
        unsent = json.dumps(message).encode() + b"\n"
        with contextlib.suppress(OSError):
            while unsent:  # the first message is longer than a pipe takes at once
                unsent = unsent[os.write(pipe.fileno(), unsent) :]

    def _silent(self, now: float) -> bool:
        """Whether a message has not been answered in time."""
        return bool(self._unanswered) and now - self._unanswered[0] > _SILENT_S

    def _take_answers(self) -> None:
        """Forget as many messages as have been answered."""
        assert self._process.stdout is not None
        with contextlib.suppress(OSError):
            for _ in os.read(self._process.stdout.fileno(), 65_536):
                if self._unanswered:
                    self._unanswered.popleft()

    def _close_pipe(self) -> None:
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
