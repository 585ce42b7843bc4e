"""Open the bus at an address, alone or behind the guard and the watchdog."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.esp32.bus import Esp32Bus
from pupper_sysid.hardware.feetech.bus import FeetechBus
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.hardware.safety.watchdog import Watchdog


def open_bus(
    address: BusAddress,
    joint_map: JointMap | None = None,
    joints: Sequence[str] | None = None,
    exclusive: bool = True,
) -> Esp32Bus | FeetechBus:
    """The bus itself, unguarded; see `FeetechBus` and `Esp32Bus` for parameters and errors."""
    if address.kind == "esp32":
        return Esp32Bus(Path(address.where), joint_map, exclusive)
    return FeetechBus(address.where, address.baud, joint_map, joints, exclusive)


def open_guarded(
    address: BusAddress,
    joint_map: JointMap | None = None,
    joints: Sequence[str] | None = None,
    limits: GuardLimits | None = None,
) -> GuardedBus:
    """The bus behind its guard, with a watchdog that parks the robot if this process dies."""
    bus = open_bus(address, joint_map, joints)
    try:
        # rate and map as found: nothing is to be detected when it is urgent
        watchdog = Watchdog(replace(address, baud=bus.metadata.get("baud")), bus.joint_map)
    except BaseException:
        bus.close()
        raise
    return GuardedBus(bus, limits, watchdog)
