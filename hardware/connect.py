"""From what a user writes after `--bus` to a bus that is guarded and watched over.

`esp32` or `esp32:/path/to.socket` is the robot's own proxy; `feetech:/dev/ttyUSB0`, with
`@500000` behind it where the baud rate is known, is a serial line of Feetech servos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.esp32.bus import SOCKET, Esp32Bus
from pupper_sysid.hardware.feetech.bus import FeetechBus
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.safety.watchdog import Watchdog


@dataclass(frozen=True)
class BusAddress:
    """Where a bus is.

    Attributes
    ----------
    kind : {"esp32", "feetech"}
    where : str
        Socket or serial device.
    baud : int or None
        None: to be found by asking.
    """

    kind: str
    where: str
    baud: int | None = None

    def __str__(self) -> str:
        return f"{self.kind}:{self.where}" + (f"@{self.baud}" if self.baud else "")


def parse_address(text: str) -> BusAddress:
    """What a user wrote after `--bus`.

    Raises
    ------
    InputError
        If it names no bus.

    Examples
    --------
    >>> parse_address("feetech:/dev/ttyUSB0@500000")
    BusAddress(kind='feetech', where='/dev/ttyUSB0', baud=500000)
    """
    kind, _, where = text.partition(":")
    if kind == "esp32":
        return BusAddress(kind, where or str(SOCKET))
    if kind != "feetech" or not where:
        raise InputError(
            f"--bus {text}: write emulated, esp32, esp32:SOCKET or feetech:DEVICE, such as "
            "feetech:/dev/ttyUSB0."
        )
    device, at, baud = where.partition("@")
    if at and not baud.isdecimal():
        raise InputError(f"--bus {text}: '{baud}' is no baud rate; write for example @500000.")
    return BusAddress(kind, device, int(baud) if at else None)


def open_bus(
    address: BusAddress, joint_map: JointMap | None = None, joints: Sequence[str] | None = None
) -> ServoBus:
    """The bus itself, unguarded; see `FeetechBus` and `Esp32Bus` for parameters and errors."""
    if address.kind == "esp32":
        return Esp32Bus(Path(address.where), joint_map)
    return FeetechBus(address.where, address.baud, joint_map, joints)


def open_guarded(
    address: BusAddress, joint_map: JointMap | None = None, joints: Sequence[str] | None = None
) -> GuardedBus:
    """The bus behind its guard, with a watchdog that parks the robot if this process dies."""
    bus = open_bus(address, joint_map, joints)
    try:
        watchdog = Watchdog(address, joint_map)
    except BaseException:
        bus.close()
        raise
    return GuardedBus(bus, watchdog=watchdog)
