"""Kinds of servo buses, and their addresses as written after `--bus`.

`esp32` or `esp32:/path/to.socket` is the robot's own proxy; `feetech:/dev/ttyUSB0` or
`dynamixel:/dev/ttyUSB0`, followed by `@500000` where the baud rate is known, is a serial line of
servos; `emulated` is no address but a robot inside the program, which the commands make themselves.

A new bus is its module and one entry of `KINDS`; what opens, scans and switches off takes it from
there.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from pupper_sysid.common.errors import InputError

EMULATED = "emulated"
"""The bus of the emulated robot."""
SOCKET = Path("/tmp/esp32-proxy.socket")
"""Socket of the robot's proxy."""


@dataclass(frozen=True)
class BusKind:
    """One kind of bus."""

    name: str
    """As in `--bus NAME:PLACE`."""
    servos: str
    """What it connects, in words."""
    module: str
    """Module of its class, below the package."""
    class_name: str
    """Of a `ServoBus` with `joint_map`, `open_address` and `limp_address`; `scan_address` where the
    place is a serial device."""
    default: str | None = None
    """Place where none is written; None for a serial device, which must be."""

    @property
    def is_serial(self) -> bool:
        """Whether the place is a serial device."""
        return self.default is None

    def bus_class(self) -> Any:
        """Class of the bus; imported only now, with its vendor's library."""
        package = __name__.partition(".")[0]
        return getattr(import_module(f"{package}.{self.module}"), self.class_name)


KINDS = {
    kind.name: kind
    for kind in (
        BusKind("esp32", "Mini Pupper 2", "hardware.esp32", "Esp32Bus", str(SOCKET)),
        BusKind("feetech", "Feetech STS and SCS", "hardware.feetech", "FeetechBus"),
        BusKind("dynamixel", "Dynamixel X and MX", "hardware.dynamixel", "DynamixelBus"),
    )
}
"""All buses outside this program, by name."""


def bus_name(text: str) -> str:
    """`text` with the older word `sim` replaced by `emulated`.

    Examples
    --------
    >>> bus_name("sim"), bus_name("esp32")
    ('emulated', 'esp32')
    """
    return EMULATED if text == "sim" else text


@dataclass(frozen=True)
class BusAddress:
    """Address of a bus."""

    kind: str
    """One of `KINDS`."""
    where: str
    """Socket or serial device."""
    baud: int | None = None
    """None: to be detected."""


def parse_address(text: str) -> BusAddress:
    """Address of a bus outside this program.

    Examples
    --------
    >>> parse_address("feetech:/dev/ttyUSB0@500000")
    BusAddress(kind='feetech', where='/dev/ttyUSB0', baud=500000)
    >>> parse_address("feetech:ttyACM0").where
    '/dev/ttyACM0'
    """
    if bus_name(text) == EMULATED:
        raise InputError(
            f"bus {text}: this needs a bus outside the program. Start `pupper-sysid emulate` in "
            "another terminal and use the bus that it names."
        )
    name, _, where = text.partition(":")
    kind = KINDS.get(name)
    serial = [k for k in KINDS.values() if k.is_serial]
    if kind is None and text.startswith(("/dev/", "tty", "COM")):
        forms = " or ".join(f"{k.name}:{text} ({k.servos})" for k in serial)
        raise InputError(
            f"bus {text}: that is a port; say which servos are on it, {forms}. `pupper-sysid scan` "
            "tries them all."
        )
    if kind is None or (kind.is_serial and not where):
        forms = " or ".join(f"{k.name}:DEVICE" for k in serial)
        raise InputError(
            f"bus {text}: write emulated, esp32, esp32:SOCKET, {forms}, such as "
            "feetech:/dev/ttyUSB0 or feetech:/dev/ttyACM0. `pupper-sysid scan` lists the ports, "
            "and what answers there."
        )
    if not kind.is_serial:
        return BusAddress(name, where or str(kind.default))
    device, at, baud = where.partition("@")
    if at and not (baud.isascii() and baud.isdecimal() and len(baud) < 10 and int(baud) > 0):
        raise InputError(f"bus {text}: '{baud}' is no baud rate; write for example @500000.")
    if device.startswith("tty") and not Path(device).exists():
        device = f"/dev/{device}"
    return BusAddress(name, device, int(baud) if at else None)
