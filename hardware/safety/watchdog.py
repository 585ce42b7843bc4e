"""A small second process that parks the robot when the first one is killed, or hangs.

Neither the robot's proxy nor a servo notices that its host has died: the last goal is held for
ever, with full torque. So whoever drives a robot starts a `Watchdog` and calls `beat` often. When
the pipe between the two ends without a goodbye, or when the beat stops for a second, the watchdog
ends what is left of the driver, opens the bus itself, stops the joints, takes them back to the
pose the robot was found in, and switches the torque off. If the watchdog itself dies, the next beat
stops the driver.

    python -m pupper_sysid.hardware.safety.watchdog          (started by `Watchdog`, never by hand)
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError, PupperError, SafetyStop
from pupper_sysid.hardware.joint_map import JointMap, joint_map_from

if TYPE_CHECKING:
    from pupper_sysid.hardware.connect import BusAddress
    from pupper_sysid.hardware.safety.guard import GuardedBus

HANG_S = 1.0
"""Without a beat for so long, the driver counts as hung."""
SWITCH_ON_S = 5.0
"""So long it may take to switch the torque on, servo by servo on a line in trouble."""
PARK_WITHIN_S = 0.5
"""The way back takes at most this long, so that all is over within a second."""

_BEAT_S = 0.05
_OPEN_WITHIN_S = 0.4
_GIVE_UP_S = 10.0  # a cable has been put back by then, or someone is at the switch
_START_WITHIN_S = 20.0


class Watchdog:
    """The driver's end: starts the process and keeps it quiet.

    Parameters
    ----------
    address : BusAddress
    joint_map : JointMap or None
        As given to `open_bus`.

    Raises
    ------
    BusError
        If the process does not start.
    """

    def __init__(self, address: BusAddress, joint_map: JointMap | None):
        orders = {
            "kind": address.kind,
            "where": address.where,
            "baud": address.baud,
            "map": joint_map.file.model_dump(mode="json", by_alias=True) if joint_map else None,
            "coordinates": joint_map.coordinates if joint_map else None,
            "driver": os.getpid(),
        }
        # a session of its own: Ctrl-C at the terminal is for the driver
        self._process = subprocess.Popen(
            # -P: a file in the user's folder, such as json.py, must not stand in for a module
            [sys.executable, "-P", "-m", "pupper_sysid.hardware.safety.watchdog"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        self._beaten = 0.0
        self._say(orders)
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], _START_WITHIN_S)
        if not ready or self._process.stdout.readline() != b"ready\n":
            self._process.kill()
            raise BusError(
                "the watchdog process did not start, and without it nobody would park the robot "
                "if this one died. Check the machine's load and memory, then try again."
            )

    def arm(self, joints: Sequence[str], pose_rad: NDArray[np.float64]) -> None:
        """The torque of `joints` is about to go on: from now on beats are expected; this is home.

        Said before the first servo is on, so that a driver that is killed meanwhile is followed.
        """
        self._say({"arm": dict(zip(joints, map(float, pose_rad), strict=True))})

    def disarm(self) -> None:
        """The torque is off: there is nothing to watch over."""
        self._say({"disarm": True})

    def beat(self) -> None:
        """Someone is in control; cheap enough for every tick.

        Raises
        ------
        SafetyStop
            If the watchdog process has ended.
        """
        now = time.monotonic()
        if now - self._beaten > _BEAT_S:
            self._beaten = now
            if self._process.poll() is not None:
                raise SafetyStop(
                    "the watchdog process has ended, and without it nobody would park the robot if "
                    "this one died. Look for who ends processes here (the system's log names a "
                    "lack of memory), then start again."
                )
            self._say({"beat": True})

    def only_limp(self) -> None:
        """There is no way home any more: whatever happens to the driver now, torque off."""
        self._say({"limp": True})

    def leave_limp(self) -> None:
        """Say that the robot would not go limp, and leave the bus: it is to be tried further."""
        self.only_limp()
        pipe = self._process.stdin
        with contextlib.suppress(OSError):
            if pipe is not None and not pipe.closed:
                pipe.close()

    def close(self) -> None:
        """Say goodbye; may be called twice."""
        self._say({"bye": True})
        pipe = self._process.stdin
        with contextlib.suppress(OSError):
            if pipe is not None and not pipe.closed:
                pipe.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)

    def _say(self, message: dict[str, Any]) -> None:
        pipe = self._process.stdin
        if pipe is None or pipe.closed:
            return
        with contextlib.suppress(OSError):
            pipe.write(json.dumps(message).encode() + b"\n")
            pipe.flush()


def main() -> None:
    """The other end: wait, and park if need be."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    orders = json.loads(sys.stdin.buffer.readline())
    # everything that parking needs is loaded now, not when it is urgent
    importlib.import_module("pupper_sysid.hardware.connect")

    sys.stdout.write("ready\n")
    sys.stdout.flush()
    pipe, heard, pose, only_limp = sys.stdin.fileno(), b"", None, False
    last, patience_s = time.monotonic(), HANG_S
    while True:
        ready, _, _ = select.select([pipe], [], [], 0.1)
        if ready:
            data = os.read(pipe, 65_536)
            last = time.monotonic()
            *lines, heard = (heard + data).split(b"\n")
            for line in lines:
                message = json.loads(line)
                if "bye" in message:
                    return
                patience_s = SWITCH_ON_S if "arm" in message else HANG_S
                if "arm" in message:
                    pose, only_limp = message["arm"], False
                if "disarm" in message:
                    pose = None
                only_limp |= "limp" in message
            if not data:
                break
        elif pose is not None and time.monotonic() - last > patience_s:
            with contextlib.suppress(OSError):
                os.kill(orders["driver"], signal.SIGKILL)
            break
    if pose is not None:
        park(orders, pose, only_limp)


def park(orders: dict[str, Any], pose_rad: dict[str, float], only_limp: bool = False) -> None:
    """Open the bus that the driver has left, and park the robot, or let it go where it is.

    All joints are taken home together if they answer soon, and those that do not are left behind:
    they get further chances of their own. Where a joint's angle takes two servos (joint
    coordinates), a servo that does not answer costs the others their way home: all go limp.
    """
    from pupper_sysid.hardware.connect import BusAddress, open_bus
    from pupper_sysid.hardware.safety.guard import GuardedBus, GuardLimits

    address = BusAddress(orders["kind"], orders["where"], orders["baud"])
    joint_map = joint_map_from(orders["map"], "the joint map") if orders["map"] else None
    servo_map = joint_map.per_servo() if joint_map else None
    if orders["coordinates"] == "servo":
        joint_map = servo_map
    left, start = list(pose_rad), time.monotonic()
    while left and time.monotonic() - start < _GIVE_UP_S:
        try:
            answering = left
            if time.monotonic() - start > _OPEN_WITHIN_S:
                answering = _answering(address, servo_map, left)
                only_limp |= joint_map is not servo_map and len(answering) < len(left)
            bus = open_bus(address, servo_map if only_limp else joint_map, answering)
        except PupperError:
            # the driver's lock goes with its last thread, which can take a moment
            time.sleep(0.02)
            continue
        guard = GuardedBus(bus, GuardLimits(park_within_s=PARK_WITHIN_S))
        try:
            if not only_limp:
                _take_home(guard, pose_rad)
            if guard.torque(False):  # who does not confirm is not done with
                left = [name for name in left if name not in guard.joint_names]
        finally:
            guard.close()


def _take_home(guard: GuardedBus, pose_rad: dict[str, float]) -> None:
    """Park the joints of this bus where they were found, or let them go if that cannot be."""
    try:
        guard.take_over()
        guard.park(np.array([pose_rad[name] for name in guard.joint_names]))
    except PupperError:
        guard.limp()


def _answering(address: BusAddress, servo_map: JointMap | None, joints: list[str]) -> list[str]:
    """Those of `joints` whose servos are there."""
    from pupper_sysid.hardware.connect import open_bus

    there = open_bus(address, servo_map)
    there.close()
    found = [name for name in joints if name in there.joint_names]
    if not found:
        raise BusError("None of the joints answers.")
    return found


if __name__ == "__main__":
    main()
