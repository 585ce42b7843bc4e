"""The watchdog process: waits for beats of the driver, and parks the robot if they end.

Every message is answered with one byte. When the pipe closes without a message, or no beat comes
for a second, it kills what is left of the driver, opens the bus itself, stops the joints, takes
them back to the pose of the start, switches the torque off, and sets registers back
that the driver had changed.

Switching the torque off takes no lock: a program that waits for the driver's end, or a child that
inherited its descriptor, holds it. It is tried until every servo has confirmed, also if the line is
gone for a day. Only a line that cannot come back ends it: a pseudo-terminal, or a socket whose
folder was removed. Failures are written to the system's log and to `watchdog.log` of the runtime
folder (`hardware.lock`). `pupper-sysid park` uses the same `switch_off` and `restore`.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

# imported at the start, so that parking does not wait for imports
from pupper_sysid.common.errors import BusError, PupperError
from pupper_sysid.hardware.address import KINDS, BusAddress
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.lock import LOG, open_here, remove_note, robot_of
from pupper_sysid.hardware.loop import lasting_s
from pupper_sysid.hardware.safety.guard import ChangedRegisters, GuardedBus, open_bus
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.hardware.safety.watchdog import HANG_S, SWITCH_ON_S

PARK_WITHIN_S = 0.5
"""Longest way back, so that all is over within a second."""

_OPEN_WITHIN_S = 0.4
_CONNECT_WITHIN_S = 0.4
_TRIES = 5  # with one servo
_SOON_S = 10.0  # until then it is tried all the time, then once a second
_GONE_S = 10.0
_SAY_EVERY_S, _LONGEST_SILENCE_S = 60.0, 3600.0
_RESTORE_WITHIN_S = 10.0


@dataclass
class _Orders:
    """What is to be done when the driver has ended."""

    address: BusAddress
    joint_map: JointMap
    driver: int
    pose_rad: dict[str, float] = field(default_factory=dict)
    """Joints whose torque is on, and their pose at the start."""
    only_limp: bool = False
    """Leave the way back out."""
    registers: dict[str, dict[str, int]] = field(default_factory=dict)
    """Values to be set back, by joint and name."""
    patience_s: float = HANG_S
    done: bool = False
    """The driver needs no watchdog any more."""

    def take(self, line: bytes) -> None:
        """Take a message of the driver."""
        try:
            message: dict[str, Any] = json.loads(line)
        except ValueError:  # incomplete: the pipe was full
            message = {"limp": True}
        self.done |= "bye" in message
        self.patience_s = SWITCH_ON_S if "arm" in message else HANG_S
        if "arm" in message:
            self.pose_rad, self.only_limp = message["arm"], False
        if "disarm" in message:
            self.pose_rad = {}
        self.only_limp |= "limp" in message
        self.registers = message.get("registers", self.registers)


def main() -> None:
    """Wait for messages of the driver; park the robot if it is gone."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    orders = first_orders(json.loads(sys.stdin.buffer.readline()))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    with contextlib.suppress(Exception):  # of whatever kind: servos may be on
        _follow(orders, sys.stdin.fileno(), sys.stdout.fileno())
    if orders.done:
        return
    if orders.pose_rad:
        park(orders)
        remove_note(orders.address.where)
    restore(orders.address, orders.joint_map, orders.registers)


def first_orders(message: dict[str, Any]) -> _Orders:
    """Orders of the first message of `Watchdog`: address, joint map, and the driver's id."""
    return _Orders(*robot_of(message, "the joint map"), message["driver"])


def _follow(orders: _Orders, pipe: int, answers: int) -> None:
    """Take messages until the driver is gone, hangs, or needs no watchdog any more."""
    os.set_blocking(answers, False)
    received, last = b"", lasting_s()
    while not orders.done:
        ready, _, _ = select.select([pipe], [], [], 0.1)
        if not ready:
            if orders.pose_rad and lasting_s() - last > orders.patience_s:
                with contextlib.suppress(OSError):
                    os.kill(orders.driver, signal.SIGKILL)
                return
            continue
        data = os.read(pipe, 65_536)
        last = lasting_s()
        *lines, received = (received + data).split(b"\n")
        for line in lines:
            orders.take(line)
        with contextlib.suppress(OSError):  # the pipe has no reader, or the driver is gone
            os.write(answers, b"." * len(lines))
        if not data:
            return


def park(orders: _Orders) -> None:
    """Open the bus that the driver has left; park the robot, or only switch its torque off.

    All joints go back together if the bus can be opened soon, and all of them answer; after that
    they are only switched off, those that do not answer too.
    """
    joints, start = list(orders.pose_rad), time.monotonic()
    say_s, silence_s, present_s = start + _SOON_S, _SAY_EVERY_S, start
    while joints:
        now = time.monotonic()
        if is_there(orders.address):
            present_s = now
        elif now - present_s > _GONE_S and not can_come_back(orders.address):
            say(f"{orders.address.where} is gone for good; {may_be_on(joints)}")
            return
        if now > say_s:
            say(f"{orders.address.where}: {may_be_on(joints)} It is tried on.")
            say_s, silence_s = now + silence_s, min(2 * silence_s, _LONGEST_SILENCE_S)
        try:
            if orders.only_limp or now - start > _OPEN_WITHIN_S:
                joints = switch_off(orders.address, orders.joint_map, joints)
            else:
                joints = _go_home(orders)
        except Exception:  # of whatever kind, a lack of memory too: the torque may be on
            # the driver's lock is released with its last thread, which can take a moment
            time.sleep(0.02 if now - start < _SOON_S else 1.0)
            continue
        if joints and now - start > _SOON_S:
            time.sleep(1.0)


def _go_home(orders: _Orders) -> list[str]:
    """Park all joints in the pose of the start; returns those that did not confirm torque off."""
    joints = list(orders.pose_rad)
    guard = GuardedBus(
        open_bus(orders.address, orders.joint_map, joints), GuardLimits(park_within_s=PARK_WITHIN_S)
    )
    try:
        guard.take_over()
        guard.park(np.array([orders.pose_rad[name] for name in guard.joint_names]))
    except PupperError:
        guard.limp()
    finally:
        limp = guard.torque(False)
        guard.close()
    return [] if limp else joints


def restore(
    address: BusAddress, joint_map: JointMap, registers: Mapping[str, Mapping[str, int]]
) -> None:
    """Set registers back to these values, by joint; tries for some seconds. The torque is off."""
    start = time.monotonic()
    while registers and time.monotonic() - start < _RESTORE_WITHIN_S:
        try:
            bus = open_bus(address, joint_map.per_servo(), list(registers), exclusive=False)
        except PupperError:
            time.sleep(0.02)
            continue
        changed = ChangedRegisters(bus, originals=registers)
        changed.restore()
        registers = changed.originals
        bus.close()


# ----- torque off, whichever program drives the robot or holds its lock


def switch_off(
    address: BusAddress, joint_map: JointMap | None = None, joints: Sequence[str] | None = None
) -> list[str]:
    """Switch the torque off once, without a lock; joints whose servos did not confirm it.

    Servos of a serial line get it in one frame before anything is known of the line, so that those
    that hear but do not answer go limp, too. Without a joint map every servo of the line is
    switched off, whatever it moves, and those that did not confirm are named `id 5` and so on.
    `BusError` if the bus cannot be opened, or no servo answers.
    """
    kind = KINDS[address.kind].bus_class()
    chosen = joint_map.per_servo() if joint_map else None
    chosen = chosen.select(joints) if chosen and joints else chosen
    kind.limp_address(address, chosen.ids if chosen else None)
    if chosen is None and KINDS[address.kind].is_serial:
        return _all_off(address)
    bus = open_bus(address, chosen, exclusive=False)
    try:
        limp = bus.torque(False)
    finally:
        bus.close()
    names = joints or (chosen.joint_names if chosen else bus.joint_names)
    return [name for name in names if not limp or name not in bus.joint_names]


def _all_off(address: BusAddress) -> list[str]:
    """Switch off every servo that answers, one by one; ids that did not confirm, in words."""
    family = KINDS[address.kind].bus_class().family
    for rate in family.rates if address.baud is None else (address.baud,):
        line = family.open_line(address.where, rate, False)
        try:
            line.detect_echo()
            models = line.find(list(line.roll_call(range(family.highest_id + 1))))
            on = [servo for servo in models if not _is_off(line, servo, family, models[servo])]
        finally:
            line.close()
        if models:
            return [f"id {servo}" for servo in on]
    raise BusError(
        f"{address.where}: no servo answers, so nothing confirms that the torque is off. Check the "
        "cable and the power."
    )


def _is_off(line: Any, servo: int, family: Any, model: int) -> bool:
    """Switch one servo off; whether it confirms that."""
    series = family.series.get(model) or next(iter(family.series.values()))
    address = series.register("torque_enable").address
    for _ in range(_TRIES):
        line.write(servo, address, b"\0")
        now = line.read(servo, address, 1)
        if now is not None and now.frame.data == b"\0":
            return True
    return False


def is_there(address: BusAddress) -> bool:
    """Whether the line exists; a proxy's socket must have somebody behind it."""
    if KINDS[address.kind].is_serial:
        return os.path.exists(address.where)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as line:
        line.settimeout(_CONNECT_WITHIN_S)
        try:
            line.connect(address.where)
        except (FileNotFoundError, ConnectionRefusedError):
            return False
        except OSError:
            return True
    return True


def can_come_back(address: BusAddress) -> bool:
    """Whether a line that is gone may be plugged in or served again, with the same servos."""
    terminal = os.path.realpath(address.where).startswith("/dev/pts/")
    return os.path.isdir(os.path.dirname(address.where) or ".") and not terminal


def may_be_on(joints: Sequence[str]) -> str:
    """Sentence about joints that did not confirm that they are limp."""
    return (
        f"the torque of {', '.join(joints)} could not be switched off and may be on: switch the "
        "robot's power off."
    )


def say(text: str) -> None:
    """Write into the system's log and `watchdog.log`: the driver's terminal may be gone."""
    with contextlib.suppress(Exception):
        import syslog

        syslog.openlog("pupper-sysid")
        syslog.syslog(syslog.LOG_ALERT, text)
    with contextlib.suppress(Exception):
        descriptor = open_here(LOG, os.O_WRONLY | os.O_APPEND)
        os.write(descriptor, f"{time.strftime('%Y-%m-%dT%H:%M:%S%z')} {text}\n".encode())
        os.close(descriptor)


if __name__ == "__main__":
    main()
