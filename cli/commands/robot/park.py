"""`park`: switch a robot's torque off, once, or whenever its driver and watchdog are gone."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import chosen_map
from pupper_sysid.common.errors import BusError, InputError, PupperError
from pupper_sysid.hardware.address import BusAddress, parse_address
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.safety.limp import can_come_back, is_there, may_be_on, switch_off
from pupper_sysid.hardware.safety.notes import Note, notes
from pupper_sysid.hardware.safety.watchdog import HANG_S
from pupper_sysid.hardware.safety.watchdog_process import restore

_AGAIN_S, _LOOK_S = 0.1, 0.2
_OTHERS_WAIT_S = 1.0


@dataclass(frozen=True)
class Park:
    """Switch the torque of all servos off; nothing else is sent, and the legs go limp at once.

    It needs no lock. Without --bus: every robot that a driver of this user has left on, and whose
    driver and watchdog have both ended or are stopped. With --supervise it waits for such robots.
    Example: pupper-sysid park --bus esp32
    """

    bus: str | None = None
    """esp32 (on the robot), feetech:DEVICE or dynamixel:DEVICE; by default every robot that was
    left on."""
    joint_map: str | None = None
    """Joint map: a file or a preset; by default joints.yaml if it is here, else every servo of a
    serial line is switched off."""
    seconds: float = 10.0
    """Try for so long until every servo has confirmed."""
    supervise: bool = False
    """Go on until Ctrl-C: switch off every robot that is left on, from now on."""

    def run(self) -> None:
        """Switch off, or wait for robots that are to be."""
        terminal.need_positive("--seconds", self.seconds)
        if self.bus is not None:
            if self.supervise:
                raise InputError("--supervise finds the robots itself; leave --bus out.")
            self._named(parse_address(self.bus))
            return
        if self.joint_map:
            raise InputError("--joint-map is of one robot: add its --bus.")
        if not os.path.exists("/proc/self/stat"):
            raise InputError("`park` without --bus needs Linux, whose /proc says what runs.")
        if self.supervise:
            self._supervise()
            return
        left = [note for note in notes() if not note.in_control()]
        if not all([_take(note, self.seconds) for note in left]):
            raise BusError("Not every robot that was left on could be switched off.")
        if not left:
            terminal.err.print("No driver that is gone left a robot on; --bus names another.")

    def _named(self, address: BusAddress) -> None:
        left = _until_limp(address, chosen_map(self.joint_map), None, self.seconds)
        if left:
            raise BusError(f"{address.where}: {may_be_on(left)}")
        terminal.err.print("Every servo confirmed that its torque is off.")
        for note in notes():
            if note.robot != os.path.realpath(address.where):
                continue
            if note.in_control():
                raise BusError(
                    f"process {note.driver} drives this robot and may switch the torque on again. "
                    f"Stop it: `kill {note.driver}`."
                )
            restore(note.address, note.joint_map, note.registers)
            note.remove()

    def _supervise(self) -> None:
        terminal.err.print("Watching over the robots of this user.")
        since_s: dict[tuple[tuple[int, int], ...], float] = {}
        tried: set[tuple[tuple[int, int], ...]] = set()
        while True:
            left = {note.processes: note for note in notes() if not note.in_control()}
            now = time.monotonic()
            since_s = {one: since_s.get(one, now) for one in left}
            for one, note in left.items():
                # a driver that was stopped for less goes on, and would switch on again
                if now - since_s[one] > HANG_S:
                    _take(note, min(self.seconds, _OTHERS_WAIT_S), say=one not in tried)
                    tried.add(one)
            time.sleep(_LOOK_S)


def _take(note: Note, seconds: float, say: bool = True) -> bool:
    """Switch a robot off that was left on; whether that is settled."""
    where, on = note.address.where, list(note.joints)
    try:
        on = _until_limp(note.address, note.joint_map, note.joints, seconds)
        told = may_be_on(on) if on else "its driver was gone; its torque was switched off."
        settled = not on
    except PupperError as error:
        told, settled = str(error), False
    if not settled and not is_there(note.address) and not can_come_back(note.address):
        told, settled = f"gone for good; {may_be_on(note.joints)}", True
    if settled or say:
        terminal.err.print(f"{where}: {told}")
    if not on:
        restore(note.address, note.joint_map, note.registers)
    if settled:  # last: what is interrupted here is said again, not lost
        note.remove()
    return settled


def _until_limp(
    address: BusAddress, joint_map: JointMap | None, joints: tuple[str, ...] | None, seconds: float
) -> list[str]:
    """Try for some seconds; joints that did not confirm.

    An error of the bus is raised if nothing was reached and the joints are not known.
    """
    until, left = time.monotonic() + seconds, list(joints or ())
    while True:
        failed: PupperError | None = None
        try:
            left = switch_off(address, joint_map, left or None)
            if not left:
                return []
        except PupperError as error:
            failed = error
        if time.monotonic() > until:
            if failed and not left:
                raise failed
            return left
        time.sleep(_AGAIN_S)
