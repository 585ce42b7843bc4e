"""Joint map and guarded bus of the commands that use a bus."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.numbers import whole
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.connect import open_guarded
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.safety.monitor import GuardLimits

JOINTS_FILE = Path("joints.yaml")


def chosen_map(text: str | None) -> JointMap | None:
    """The joint map `text` (a file or a preset), else `joints.yaml` if it is in this folder."""
    if text is None and JOINTS_FILE.exists():
        terminal.err.print(f"Taking the joint map {JOINTS_FILE}.", soft_wrap=True)
        return load_joint_map(JOINTS_FILE)
    return None if text is None else load_joint_map(text)


def connect(
    bus: str,
    joint_map: str | None,
    joints: Sequence[str] | None = None,
    limits: GuardLimits | None = None,
) -> GuardedBus:
    """The bus at an address, guarded and in servo coordinates."""
    address = parse_address(bus)
    chosen = chosen_map(joint_map)
    return open_guarded(address, chosen.per_servo() if chosen else None, joints, limits)


def parse_registers(text: str) -> dict[str, int]:
    """Registers of emulated servos that `text` sets: p=16,goal_speed=400.

    Raises
    ------
    InputError
        If it names one that does not act on the motion, or a value that it cannot have.
    """
    from pupper_sysid.sim.emulator.servos.pendulum import REGISTERS

    found = {}
    for part in filter(None, text.split(",")):
        name, _, value = (piece.strip() for piece in part.partition("="))
        number = whole(value) if value.isascii() and value.isdecimal() else -1
        if name not in REGISTERS or not 0 <= number <= 65_535:
            raise InputError(
                f"--registers: '{part}' sets no register that acts here; write p=16, and of these: "
                f"{', '.join(REGISTERS)}."
            )
        found[name] = number
    return found
