"""The watchdog process: waits for beats of the driver, and parks the robot if they end.

Every message is answered with one byte. When the pipe closes without a message, or no beat comes
for a second, it kills what is left of the driver, opens the bus itself, stops the joints, takes
them back to the pose in which the robot was found, switches the torque off, and sets registers back
that the driver had changed.

Switching the torque off takes no lock: a program that waits for the driver's end, or a child that
inherited its descriptor, holds it. It is tried until every servo has confirmed, or until the line
has been gone for a minute; what did not succeed is said in the system's log and in `watchdog.log`
of the runtime folder (`hardware.lock`).

    python -P -m pupper_sysid.hardware.safety.watchdog_process    (started by `watchdog.Watchdog`)
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import sys
import time
from typing import Any

import numpy as np

# everything that parking needs is loaded at the start, not when it is urgent
from pupper_sysid.common.errors import BusError, PupperError
from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.connect import open_bus
from pupper_sysid.hardware.joint_map import JointMap, joint_map_from
from pupper_sysid.hardware.lock import LOG, open_here
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.hardware.safety.registers import ChangedRegisters

HANG_S = 1.0
"""Without a beat for so long, the driver counts as hung."""
SWITCH_ON_S = 5.0
"""Longest time to switch the torque on, servo by servo on a line with faults."""
PARK_WITHIN_S = 0.5
"""Longest way back, so that all is over within a second."""

_OPEN_WITHIN_S = 0.4
_SOON_S = 10.0  # until then it is tried all the time, then once a second
_GONE_S = 60.0
_SAY_EVERY_S = 60.0
_RESTORE_WITHIN_S = 10.0


def main() -> None:
    """Wait for messages of the driver; park the robot if it is gone."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    orders = json.loads(sys.stdin.buffer.readline())
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    pipe, received, pose, only_limp = sys.stdin.fileno(), b"", None, False
    answers = sys.stdout.fileno()
    os.set_blocking(answers, False)
    registers: dict[str, dict[str, int]] = {}
    last, patience_s = time.monotonic(), HANG_S
    while True:
        ready, _, _ = select.select([pipe], [], [], 0.1)
        if ready:
            data = os.read(pipe, 65_536)
            last = time.monotonic()
            *lines, received = (received + data).split(b"\n")
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
                registers = message.get("registers", registers)
            with contextlib.suppress(OSError):  # nobody reads, or the driver is gone
                os.write(answers, b"." * len(lines))
            if not data:
                break
        elif pose is not None and time.monotonic() - last > patience_s:
            with contextlib.suppress(OSError):
                os.kill(orders["driver"], signal.SIGKILL)
            break
    if pose is not None:
        park(orders, pose, only_limp)
    if registers:
        restore(orders, registers)


def park(orders: dict[str, Any], pose_rad: dict[str, float], only_limp: bool = False) -> None:
    """Open the bus that the driver has left; park the robot, or only switch its torque off.

    All joints go back together if they answer soon; those that do not are tried again by
    themselves. Where a joint's angle takes two servos (joint coordinates), a servo that does not
    answer prevents the way back of the others: only the torque of all is switched off then.

    Parameters
    ----------
    orders : dict
        First message of `Watchdog`: address and joint map.
    pose_rad : dict of str to float
        Joints whose torque is on, and where they were found.
    only_limp : bool
        Leave the way back out.
    """
    address = BusAddress(orders["kind"], orders["where"], orders["baud"])
    joint_map = joint_map_from(orders["map"], "the joint map") if orders["map"] else None
    servo_map = joint_map.per_servo() if joint_map else None
    if orders["coordinates"] == "servo":
        joint_map = servo_map
    left, start = list(pose_rad), time.monotonic()
    said_s, present_s = start + _SOON_S, start
    while left:
        now = time.monotonic()
        if _is_there(address):
            present_s = now
        elif now - present_s > _GONE_S:
            _say(f"{address.where} has been gone for {_GONE_S:g} s; {_may_be_on(left)}")
            return
        if now > said_s:
            _say(f"{address.where}: {_may_be_on(left)} It is tried on.")
            said_s = now + _SAY_EVERY_S
        try:
            answering, late = left, now - start > _OPEN_WITHIN_S
            if late:
                answering = _answering(address, servo_map, left)
                only_limp |= joint_map is not servo_map and len(answering) < len(left)
            bus, owned = _open(address, servo_map if only_limp else joint_map, answering, late)
        except PupperError:
            # the driver's lock goes with its last thread, which can take a moment
            time.sleep(0.02 if now - start < _SOON_S else 1.0)
            continue
        guard = GuardedBus(bus, GuardLimits(park_within_s=PARK_WITHIN_S))
        try:
            if not only_limp and owned:
                _go_home(guard, pose_rad)
            if guard.torque(False):  # else the servos that did not confirm are tried again
                left = [name for name in left if name not in guard.joint_names]
        finally:
            guard.close()
        if left and now - start > _SOON_S:
            time.sleep(1.0)


def _open(
    address: BusAddress, joint_map: JointMap | None, joints: list[str] | None, late: bool
) -> tuple[ServoBus, bool]:
    """The bus, and whether it is this process's alone; if `late`, it need not be."""
    try:
        return open_bus(address, joint_map, joints), True
    except PupperError:
        if not late:
            raise
        return open_bus(address, joint_map, joints, exclusive=False), False


def _is_there(address: BusAddress) -> bool:
    """Whether the line exists; a proxy's socket must have somebody behind it."""
    if address.kind != "esp32":
        return os.path.exists(address.where)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as line:
        line.settimeout(_OPEN_WITHIN_S)
        try:
            line.connect(address.where)
        except (FileNotFoundError, ConnectionRefusedError):
            return False
        except OSError:
            return True
    return True


def _may_be_on(joints: list[str]) -> str:
    return (
        f"the torque of {', '.join(joints)} could not be switched off and may be on: switch the "
        "robot's power off."
    )


def _say(text: str) -> None:
    """Into the system's log and `watchdog.log`: the driver's terminal may be gone."""
    with contextlib.suppress(Exception):
        import syslog

        syslog.openlog("pupper-sysid")
        syslog.syslog(syslog.LOG_ALERT, text)
    with contextlib.suppress(Exception):
        descriptor = open_here(LOG, os.O_WRONLY | os.O_APPEND)
        os.write(descriptor, f"{time.strftime('%Y-%m-%dT%H:%M:%S%z')} {text}\n".encode())
        os.close(descriptor)


def restore(orders: dict[str, Any], registers: dict[str, dict[str, int]]) -> None:
    """Set registers back; tries for some seconds. The torque is off.

    Parameters
    ----------
    orders : dict
        First message of `Watchdog`.
    registers : dict
        Values by joint and name.
    """
    address = BusAddress(orders["kind"], orders["where"], orders["baud"])
    servo_map = (
        joint_map_from(orders["map"], "the joint map").per_servo() if orders["map"] else None
    )
    start = time.monotonic()
    while registers and time.monotonic() - start < _RESTORE_WITHIN_S:
        try:
            bus, _ = _open(address, servo_map, list(registers), late=True)
        except PupperError:
            time.sleep(0.02)
            continue
        changed = ChangedRegisters(bus, found=registers)
        changed.restore()
        registers = changed.found
        bus.close()


def _go_home(guard: GuardedBus, pose_rad: dict[str, float]) -> None:
    """Park the joints of this bus where they were found; torque off where that is impossible."""
    try:
        guard.take_over()
        guard.park(np.array([pose_rad[name] for name in guard.joint_names]))
    except PupperError:
        guard.limp()


def _answering(address: BusAddress, servo_map: JointMap | None, joints: list[str]) -> list[str]:
    """Those of `joints` whose servos answer."""
    bus, _ = _open(address, servo_map, None, late=True)
    bus.close()
    found = [name for name in joints if name in bus.joint_names]
    if not found:
        raise BusError("None of the joints answers.")
    return found


if __name__ == "__main__":
    main()
