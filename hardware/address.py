"""Addresses of servo buses, as written after `--bus`.

`esp32` or `esp32:/path/to.socket` is the robot's own proxy; `feetech:/dev/ttyUSB0`, followed by
`@500000` where the baud rate is known, is a serial line of Feetech servos; `emulated` is no address
but a robot inside the program, which the commands make themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pupper_sysid.common.errors import InputError

EMULATED = "emulated"
"""The bus of the emulated robot."""
SOCKET = Path("/tmp/esp32-proxy.socket")
"""Socket of the robot's proxy."""


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
    """esp32 or feetech."""
    where: str
    """Socket or serial device."""
    baud: int | None = None
    """None: to be detected."""


def parse_address(text: str) -> BusAddress:
    """Address of a bus outside this program.

    Raises
    ------
    InputError
        If `text` is no address.

    Examples
    --------
    >>> parse_address("feetech:/dev/ttyUSB0@500000")
    BusAddress(kind='feetech', where='/dev/ttyUSB0', baud=500000)
    """
    if bus_name(text) == EMULATED:
        raise InputError(
            f"bus {text}: this needs a bus outside the program. Start `pupper-sysid emulate` in "
            "another terminal and use the bus that it names."
        )
    kind, _, where = text.partition(":")
    if kind == "esp32":
        return BusAddress(kind, where or str(SOCKET))
    if kind != "feetech" or not where:
        raise InputError(
            f"bus {text}: write emulated, esp32, esp32:SOCKET or feetech:DEVICE, such as "
            "feetech:/dev/ttyUSB0."
        )
    device, at, baud = where.partition("@")
    if at and not (baud.isascii() and baud.isdecimal() and len(baud) < 10 and int(baud) > 0):
        raise InputError(f"bus {text}: '{baud}' is no baud rate; write for example @500000.")
    return BusAddress(kind, device, int(baud) if at else None)
