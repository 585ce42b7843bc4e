"""Registers of servos that are changed for a while, and set back to what was found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.safety.watchdog import Watchdog

_TRIES, _PAUSE_S = 3, 0.02


class ChangedRegisters:
    """Registers of a bus's servos that differ from what was found.

    Parameters
    ----------
    bus : ServoBus
    watchdog : Watchdog, optional
        Sets them back if this process dies.
    found : mapping of joint to mapping of str to int, optional
        Values before the change, by another driver.
    """

    def __init__(
        self,
        bus: ServoBus,
        watchdog: Watchdog | None = None,
        found: Mapping[str, Mapping[str, int]] | None = None,
    ):
        self._bus: Any = bus
        self._watchdog = watchdog
        self.found = {joint: dict(own) for joint, own in (found or {}).items()}
        """Values to be set back, by joint and register."""

    def set(self, joint: str, name: str, value: int) -> None:
        """Set a register; the first time, keep what was found.

        Raises
        ------
        BusError
            If the bus has no registers, or the register does not take the value.
        """
        if not hasattr(self._bus, "set_register"):
            raise BusError(
                f"{self._bus.name}: registers of its servos cannot be set over this bus. Leave the "
                "gains out, or connect the servos to a serial adapter (feetech:DEVICE)."
            )
        own = self.found.setdefault(joint, {})
        if name not in own:
            own[name] = self._bus.register(joint, name)
            self._tell()
        self._bus.set_register(joint, name, value)

    def restore(self) -> bool:
        """Set all back; whether every one is confirmed. What is not stays in `found`."""
        if not self.found:
            return True
        for joint, own in self.found.items():
            for name, value in list(own.items()):
                if self._set_back(joint, name, value):
                    del own[name]
        self.found = {joint: own for joint, own in self.found.items() if own}
        self._tell()
        return not self.found

    def _set_back(self, joint: str, name: str, value: int) -> bool:
        for _ in range(_TRIES):
            try:
                self._bus.set_register(joint, name, value)
                return True
            except BusError:
                self._bus.sleep_until(self._bus.now() + _PAUSE_S)
        return False

    def _tell(self) -> None:
        if self._watchdog:
            self._watchdog.restore(self.found)
