"""Switch a robot's torque off from outside, whoever drives it and whatever holds its lock."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Sequence

from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.connect import open_bus
from pupper_sysid.hardware.feetech.line import FeetechLine
from pupper_sysid.hardware.feetech.opening import AUTO_BAUDS
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.lock import LOG, open_here

_CONNECT_WITHIN_S = 0.4


def switch_off(
    address: BusAddress, joint_map: JointMap | None = None, joints: Sequence[str] | None = None
) -> list[str]:
    """Switch the torque off once, without a lock.

    Feetech servos get it in one frame before anything is known of the line, so that those that hear
    but do not answer go limp, too.

    Parameters
    ----------
    address : BusAddress
    joint_map : JointMap, optional
        By default the preset that fits the servos.
    joints : sequence of str, optional
        On a Feetech line only these; by default all of the map.

    Returns
    -------
    list of str
        Joints whose servos did not confirm it.

    Raises
    ------
    BusError
        If the bus cannot be opened, or no servo answers.
    """
    chosen = joint_map.per_servo() if joint_map else None
    if address.kind == "feetech":
        # all presets of this layout share the ids
        known = chosen or load_joint_map("sts3215").per_servo()
        known = known.select(joints) if joints else known
        chosen = known if chosen else None
        for rate in AUTO_BAUDS if address.baud is None else (address.baud,):
            line = FeetechLine(address.where, rate, exclusive=False)
            line.torque_off(known.ids)
            line.close()
    bus = open_bus(address, chosen, exclusive=False)
    try:
        limp = bus.torque(False)
    finally:
        bus.close()
    wanted = joints or (chosen.joint_names if chosen else bus.joint_names)
    return [name for name in wanted if not limp or name not in bus.joint_names]


def is_there(address: BusAddress) -> bool:
    """Whether the line exists; a proxy's socket must have somebody behind it."""
    if address.kind != "esp32":
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
