"""Switch a robot's torque off from outside, whichever program drives it or holds its lock."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Sequence
from typing import Any

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.address import KINDS, BusAddress
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.lock import LOG, open_here
from pupper_sysid.hardware.safety.guard import open_bus

_CONNECT_WITHIN_S = 0.4
_TRIES = 5


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
