"""Notes of robots whose torque is on, for the case that driver and watchdog both die.

A driver writes one, into the runtime folder (`hardware.lock`), before it switches the torque on; it
names the bus, the joints, the driver and its watchdog. The process that switches the torque off
removes it. `pupper-sysid park` switches off the robots of notes whose processes do not run.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pupper_sysid.common.errors import PupperError
from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.joint_map import JointMap, joint_map_from
from pupper_sysid.hardware.lock import open_here, runtime_folder

_END = ".on"
_MOST_BYTES = 100_000
_NOT_RUNNING = "ZXxTt"  # of proc(5): zombie, dead, stopped


@dataclass(frozen=True)
class Note:
    """A robot whose torque was switched on."""

    address: BusAddress
    joint_map: JointMap
    joints: tuple[str, ...]
    driver: int
    """Process id."""
    processes: tuple[tuple[int, int], ...]
    """Ids of driver and watchdog, and when each was started [clock ticks since the system was]."""
    registers: dict[str, dict[str, int]]
    """Original values of the registers that the driver changed, by joint."""

    @property
    def robot(self) -> str:
        """Device or socket, whatever link leads to it."""
        return os.path.realpath(self.address.where)

    def in_control(self) -> bool:
        """Whether the driver or the watchdog runs."""
        return any(_runs(number, start) for number, start in self.processes)

    def remove(self) -> None:
        """Take the note away, unless another driver has replaced it."""
        if any(note.processes == self.processes for note in notes()):
            remove_note(self.address.where)


def write_note(orders: dict[str, Any], joints: Sequence[str], watchdog: int) -> None:
    """Note that the torque of these joints is on.

    `orders` are the first message to the watchdog, and the registers to be set back; `watchdog` is
    its process id.
    """
    processes = [[number, _state(number)[1]] for number in (orders["driver"], watchdog)]
    text = json.dumps(orders | {"joints": list(joints), "processes": processes}).encode()
    with contextlib.suppress(PupperError, OSError):  # may be impossible; not needed
        descriptor = open_here(_name(orders["where"]), os.O_WRONLY | os.O_TRUNC)
        try:
            os.write(descriptor, text)
        finally:
            os.close(descriptor)


def remove_note(where: str) -> None:
    """Note that the torque of the robot at this device or socket is off."""
    with contextlib.suppress(PupperError, OSError):
        os.unlink(runtime_folder() / _name(where))


def notes() -> list[Note]:
    """All notes that can be read."""
    readable = []
    for path in sorted(runtime_folder().glob(f"*{_END}")):
        # incomplete, of another version, or removed meanwhile
        with contextlib.suppress(
            PupperError, OSError, ValueError, KeyError, TypeError, AttributeError
        ):
            readable.append(_read(path.name))
    return readable


def _read(name: str) -> Note:
    descriptor = open_here(name, os.O_RDONLY)
    try:
        orders = json.loads(os.read(descriptor, _MOST_BYTES))
    finally:
        os.close(descriptor)
    registers = orders.get("registers", {})
    return Note(
        *robot_of(orders, name),
        tuple(orders["joints"]),
        int(orders["driver"]),
        tuple((int(number), int(start)) for number, start in orders["processes"]),
        {j: {n: int(v) for n, v in values.items()} for j, values in registers.items()},
    )


def robot_of(orders: dict[str, Any], name: str) -> tuple[BusAddress, JointMap]:
    """Address and joint map of the first message to a watchdog."""
    joint_map = joint_map_from(orders["map"], name)
    address = BusAddress(orders["kind"], orders["where"], orders["baud"])
    return address, joint_map if orders["coordinates"] == "joint" else joint_map.per_servo()


def _name(where: str) -> str:
    """By the name under which it was opened: a link to an unplugged device leads nowhere."""
    return hashlib.sha256(os.fsencode(os.path.abspath(where))).hexdigest()[:16] + _END


def _runs(number: int, start: int) -> bool:
    """Whether a process runs that was started then: ids are used again."""
    state, started = _state(number)
    return started == start and state not in _NOT_RUNNING


def _state(number: int) -> tuple[str, int]:
    """State and start time of a process; ("X", -1) if there is none."""
    try:
        # the name in parentheses may have spaces and parentheses itself
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "X", -1
    return fields[0], int(fields[19])
