"""Open the bus at an address, alone or behind the guard and the watchdog."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from pupper_sysid.hardware.address import KINDS, BusAddress
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.hardware.safety.watchdog import Watchdog


def open_bus(
    address: BusAddress,
    joint_map: JointMap | None = None,
    joints: Sequence[str] | None = None,
    exclusive: bool = True,
) -> Any:
    """The bus itself, unguarded; see its class for parameters and errors."""
    cls = KINDS[address.kind].bus_class()
    return cls.open_address(address, joint_map, joints, exclusive)


def open_guarded(
    address: BusAddress,
    joint_map: JointMap | None = None,
    joints: Sequence[str] | None = None,
    limits: GuardLimits | None = None,
) -> GuardedBus:
    """The bus behind its guard, with a watchdog that parks the robot if this process dies."""
    bus = open_bus(address, joint_map, joints)
    try:
        if hasattr(bus, "refuse_unfit"):
            bus.refuse_unfit()
        # rate and map as found: nothing is to be detected when it is urgent
        watchdog = Watchdog(replace(address, baud=bus.metadata.get("baud")), bus.joint_map)
    except BaseException:
        bus.close()
        raise
    return GuardedBus(bus, limits, watchdog)
