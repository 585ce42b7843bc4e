"""Emulated Feetech servos: the protocol's frames and instructions, and the servos' own protection.

What does not depend on the vendor is in `sim.emulator.serial_line`.
"""

from __future__ import annotations

from typing import ClassVar

from pupper_sysid.hardware import feetech as table
from pupper_sysid.hardware.feetech import FAMILY, Frame, FrameReader
from pupper_sysid.sim.emulator.serial_line import LineEmulator, Pieces

_OVERLOAD = 32  # of `hardware.serial_servos.series.ERROR_BITS`

_SCS0009 = {
    "firmware_major": 0, "firmware_minor": 16, "return_delay": 0, "response_level": 1,
    "min_angle": 20, "max_angle": 1003, "max_temperature": 80, "max_voltage": 84,
    "min_voltage": 40, "max_torque": 1000, "p": 15, "d": 15, "i": 0, "min_start_force": 24,
    "dead_zone_cw": 1, "dead_zone_ccw": 1, "unload_condition": 37, "big_endian": 1,
}  # fmt: skip
_STS3215 = {
    "firmware_major": 3, "firmware_minor": 9, "return_delay": 250, "response_level": 1,
    "min_angle": 0, "max_angle": 4095, "max_temperature": 70, "max_voltage": 80,
    "min_voltage": 40, "max_torque": 1000, "p": 32, "d": 32, "i": 0, "min_start_force": 16,
    "dead_zone_cw": 1, "dead_zone_ccw": 1, "torque_limit": 1000, "mode": 0, "phase": 12,
    "unload_condition": 44, "protective_torque": 20, "protection_time": 200,
    "overload_torque": 80,
}  # fmt: skip
_HLS = {name: value for name, value in _STS3215.items() if table.HLS3625.has(name)} | {
    "firmware_minor": 46, "d": 40, "unload_condition": 13, "goal_current": 500, "goal_speed": 100,
    "protection_current": 500,
}  # fmt: skip


class FeetechEmulator(LineEmulator):
    """A line of Feetech servos; parameters are those of `LineEmulator`."""

    family = FAMILY
    reader = FrameReader
    memory_bytes = 80
    rates = table.BAUD_RATES
    factory: ClassVar = {
        series.name: _SCS0009
        if series.big_endian
        else _HLS
        if series.has("goal_current")
        else _STS3215
        for series in FAMILY.series.values()
    } | {"HD-1910": _HLS | {"mode": 4}}

    def _status(self, servo_id: int, error: int, data: bytes) -> bytes:
        return Frame(servo_id, error, data).encode()

    def _write_request(self, servo_id: int, address: int, data: bytes) -> bytes:
        return Frame(servo_id, table.WRITE, bytes([address]) + data).encode()

    def _execute(self, frame: Frame, byte_s: float) -> Pieces:
        at, params, to_all = self._free_at, frame.data, frame.id == table.BROADCAST_ID
        pieces: Pieces = []
        if frame.code == table.SYNC_WRITE and len(params) > 2:
            address, size = params[0], params[1]
            for k in range(2, len(params) - size, size + 1):
                if self._hears(params[k]):
                    self._store(params[k], address, params[k + 1 : k + 1 + size], at)
            return []
        if frame.code == table.SYNC_READ and len(params) > 2 and self.series.has_sync_read:
            for servo_id in filter(self._hears, params[2:]):
                pieces += self._answer(servo_id, params[0], params[1], byte_s)
            return pieces
        for servo_id in filter(self._hears, [*self.servos] if to_all else [frame.id]):
            reply = self._instruct(servo_id, frame, at, byte_s)
            pieces += [] if to_all else reply
        return pieces

    def _instruct(self, servo_id: int, frame: Frame, at: float, byte_s: float) -> Pieces:
        """Execute an instruction of one servo; its reply, before it takes another id."""
        code, params, state = frame.code, frame.data, self.servos[servo_id].state
        if code == table.READ and len(params) == 2:
            return self._answer(servo_id, params[0], params[1], byte_s)
        if code == table.WRITE and len(params) > 1:
            self._store(servo_id, params[0], params[1:], at)
        elif code == table.REG_WRITE and len(params) > 1:
            state["registered"] = params
        elif code == table.ACTION:
            registered = state.pop("registered", b"\0")
            self._store(servo_id, registered[0], registered[1:], at)
        elif code != table.PING:
            return []
        answers = code == table.PING or self._get(servo_id, "response_level")
        return self._answer(servo_id, 0, 0, byte_s) if answers else []

    def _go(self, servo_id: int, k: int, at: float) -> None:
        # a goal switches the torque on
        self._set(servo_id, "torque_enable", 1)
        self.bench.torque(k, at, True)
        super()._go(servo_id, k, at)

    def _protect(self, servo_id: int, at: float) -> None:
        """The servo's own overload protection, as its registers have it."""
        if not self.series.has("overload_torque"):
            return
        servo, k = self.servos[servo_id], self.bench.index_of_id[servo_id]
        loaded = abs(self._get(servo_id, "present_load")) > 10 * self._get(
            servo_id, "overload_torque"
        )
        servo.loaded_since = min(servo.loaded_since, at) if loaded else float("inf")
        lasted_s = at - servo.loaded_since
        enabled = self._get(servo_id, "unload_condition") & _OVERLOAD
        if enabled and lasted_s >= 0.01 * self._get(servo_id, "protection_time"):
            servo.overloaded = True
            if "torque_limit" in self._acting:
                limit = 10 * self._get(servo_id, "protective_torque")
                self.bench.set_register(k, at, "torque_limit", limit)
