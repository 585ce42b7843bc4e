"""Joint map and guarded bus of the commands that use a bus."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES, select_joints
from pupper_sysid.common.reading.dialect import whole_number
from pupper_sysid.hardware.address import EMULATED, KINDS, bus_name, parse_address
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus, open_bus, open_guarded
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.hardware.serial_servos.series import Series

JOINTS_FILE = Path("joints.yaml")
_LARGEST_REGISTER = 1 << 20  # of a Dynamixel in its extended position mode
_REGISTER = re.compile(r"\s*(?:([0-9]+):)?(\S+?)\s*=\s*(-?[0-9]+)\s*")


def chosen_map(text: str | None) -> JointMap | None:
    """The joint map `text` (a file or a preset), else `joints.yaml` if it is in this folder."""
    if text is None and JOINTS_FILE.exists():
        terminal.err.print(f"Taking the joint map {JOINTS_FILE}.")
        return load_joint_map(JOINTS_FILE)
    return None if text is None else load_joint_map(text)


def joints_on(bus: str, joint_map: JointMap | None, text: str) -> list[str]:
    """Joints of a bus that `text` names, as `select_joints` reads it."""
    try:
        return select_joints(text, joint_map.joint_names if joint_map else JOINT_NAMES)
    except InputError:
        if joint_map is None and bus_name(bus) != EMULATED:
            address = parse_address(bus)
            if KINDS[address.kind].is_serial:
                open_bus(address).close()
        raise


def connect(
    bus: str,
    joint_map: str | None,
    joints: Sequence[str] | None = None,
    limits: GuardLimits | None = None,
) -> GuardedBus:
    """The bus at an address, guarded and in servo coordinates."""
    address = parse_address(bus)
    chosen = chosen_map(joint_map)
    guard = open_guarded(address, chosen.per_servo() if chosen else None, joints, limits)
    say_remarks(guard.bus)
    return guard


def say_remarks(bus: ServoBus) -> None:
    """Print a bus's remarks on its line and on the registers of its servos."""
    if remarks := getattr(bus, "remarks", None):
        terminal.warn(*remarks())


def parse_registers(text: str) -> dict[str, int]:
    """Registers of emulated servos that `text` sets: p=16,goal_speed=400."""
    from pupper_sysid.sim.emulator.pendulum import FEETECH_REGISTERS

    return _registers(text, FEETECH_REGISTERS, "p=16")[None]


def parse_servo_registers(text: str, series: Series) -> dict[int | None, dict[str, int]]:
    """Registers of emulated servos by id, of all servos under None: p=16,5:mode=1."""
    chosen = _registers(text, sorted([*series.registers, *series.aliases]), "p=16 or 5:mode=1")
    for registers in chosen.values():
        for name, value in registers.items():
            try:
                series.encode(name, value)
            except OverflowError:
                raise InputError(f"--registers: {value} does not fit into {name}.") from None
    return chosen


def _registers(text: str, known: Iterable[str], example: str) -> dict[int | None, dict[str, int]]:
    by_id: dict[int | None, dict[str, int]] = {None: {}}
    of_one_servo = ":" in example
    least = -_LARGEST_REGISTER if of_one_servo else 0
    for part in filter(None, text.split(",")):
        match = _REGISTER.fullmatch(part)
        servo, name, value = match.groups() if match else (None, "", "0")
        in_range = least <= whole_number(value) <= _LARGEST_REGISTER
        if name not in known or not in_range or (servo and not of_one_servo):
            raise InputError(
                f"--registers: '{part}' sets no register that acts here; write {example}, and of "
                f"these: {', '.join(known)}."
            )
        servo_id = whole_number(servo) if servo else None
        by_id.setdefault(servo_id, {})[name] = whole_number(value)
    return by_id
