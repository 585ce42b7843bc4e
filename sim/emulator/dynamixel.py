"""Emulated Dynamixel servos: protocol 2.0 byte by byte, with status errors, alerts and watchdog.

What does not depend on the vendor is in `sim.emulator.serial_line`. A servo answers a frame with a
wrong CRC, an unknown instruction, or a value that it refuses with the error number of the manual,
and sets the alert bit while `hardware_error_status` is not 0. Its bus watchdog stops it if no
request comes for as long as the register says.
"""

from __future__ import annotations

from typing import Any, ClassVar

from pupper_sysid.hardware import dynamixel as table
from pupper_sysid.hardware.dynamixel import BROADCAST_ID, FAMILY, Frame, FrameReader
from pupper_sysid.sim.emulator.pendulum import DYNAMIXEL_GAINS
from pupper_sysid.sim.emulator.serial_line import LineEmulator, Pieces

_COMMON = {
    "firmware": 46, "return_delay_time": 250, "drive_mode": 0, "operating_mode": 3,
    "secondary_id": 255, "moving_threshold": 10, "pwm_limit": 885, "max_position_limit": 4095,
    "min_position_limit": 0, "shutdown": 52, "status_return_level": 2, "goal_pwm": 885,
}  # fmt: skip
_SMALL = {
    "temperature_limit": 70, "max_voltage_limit": 70, "min_voltage_limit": 35,
    "current_limit": 1750, "velocity_limit": 445,
}  # fmt: skip
_LARGE = {
    "temperature_limit": 80, "max_voltage_limit": 160, "min_voltage_limit": 95,
    "current_limit": 1193, "velocity_limit": 200,
}  # fmt: skip
_XL430 = {"min_voltage_limit": 60, "max_voltage_limit": 140, "temperature_limit": 72}


def _factory(name: str) -> dict[str, int]:
    registers = _COMMON | (_SMALL if name.startswith(("XL330", "XC330-M")) else _LARGE)
    p, i, d = DYNAMIXEL_GAINS.get(name, (800, 0, 0))
    gains = {"position_p_gain": p, "position_i_gain": i, "position_d_gain": d}
    return registers | (_XL430 if name == "XL430-W250" else {}) | gains


_CHOICES = {
    "operating_mode": {0, 1, 3, 4, 5, 16}, "status_return_level": {0, 1, 2},
    "torque_enable": {0, 1}, "baud_rate": set(range(len(table.BAUD_RATES))),
}  # fmt: skip
_READ_ONLY = {
    "model_number", "firmware", "moving", "hardware_error_status", "present_pwm",
    "present_current", "present_velocity", "present_position", "present_input_voltage",
    "present_temperature", "registered_instruction",
}  # fmt: skip


_WRITES = (table.SYNC_WRITE, table.BULK_WRITE)
_FAST = (table.FAST_SYNC_READ, table.FAST_BULK_READ)
_BULK = (table.BULK_READ, table.BULK_WRITE, table.FAST_BULK_READ)
_SEVERAL = {table.SYNC_READ, *_WRITES, *_FAST, *_BULK}


def _parts(frame: Frame) -> list[tuple[int, int, int, bytes]]:
    """Id, address, size and data of each servo in a request to several."""
    params, requests = frame.data, []
    writes, bulk = frame.code in _WRITES, frame.code in _BULK
    head = 4 if bulk else 0  # address and size stand behind each id, or once before them
    at, common = (0, b"") if bulk else (4, params[:4])
    while at + head < len(params):
        where = common or params[at + 1 : at + 5]
        address, size = (int.from_bytes(where[k : k + 2], "little") for k in (0, 2))
        end = at + 1 + head + size * writes
        if end <= len(params):
            requests.append((params[at], address, size, params[at + 1 + head : end]))
        at = end
    return requests


class DynamixelEmulator(LineEmulator):
    """A line of Dynamixel servos; parameters are those of `LineEmulator`."""

    family = FAMILY
    reader = FrameReader
    memory_bytes = table.MEMORY_BYTES
    rates = table.BAUD_RATES
    factory: ClassVar = {name: _factory(name) for name in table.MODELS.values()}

    def _status(self, servo_id: int, error: int, data: bytes) -> bytes:
        return Frame(servo_id, error, data, is_status=True).encode()

    def _write_request(self, servo_id: int, address: int, data: bytes) -> bytes:
        return Frame(servo_id, table.WRITE, address.to_bytes(2, "little") + data).encode()

    def receive(self, data: bytes, now: float, baud: int | None = None) -> Pieces:
        """See `LineEmulator.receive`; the pause since the last frame is counted first."""
        for servo_id in self.servos:
            self._watch(servo_id, max(now, self._free_at))
        pieces = super().receive(data, now, baud)
        for servo_id in self._reader.crc_errors:
            if self._hears(servo_id):
                pieces += self._answer(servo_id, 0, 0, self._byte_s(baud), table.CRC)
        self._reader.crc_errors.clear()
        return pieces

    def _execute(self, frame: Frame, byte_s: float) -> Pieces:
        at, to_all = self._free_at, frame.id == BROADCAST_ID
        heard = [i for i in (sorted(self.servos) if to_all else [frame.id]) if self._hears(i)]
        for servo_id in heard:
            self.servos[servo_id].heard_s = at
        if frame.code in _SEVERAL:
            return self._to_several(frame, byte_s)
        pieces: Pieces = []
        for servo_id in heard:
            reply = self._instruct(servo_id, frame, at, byte_s)
            pieces += [] if to_all and frame.code != table.PING else reply
        return pieces

    def _to_several(self, frame: Frame, byte_s: float) -> Pieces:
        """Sync and bulk instructions."""
        pieces: Pieces = []
        requests = _parts(frame) if frame.id == BROADCAST_ID else []
        if frame.code in _FAST:
            return self._fast(requests, byte_s)
        for servo_id, address, size, data in requests:
            if not self._hears(servo_id):
                continue
            if frame.code in _WRITES:
                self._try_store(servo_id, address, data, self._free_at)
            elif self._level(servo_id):
                error = 0 if address + size <= self.memory_bytes else table.ACCESS
                pieces += self._answer(servo_id, address, 0 if error else size, byte_s, error)
        return pieces

    def _fast(self, requests: list[tuple[int, int, int, bytes]], byte_s: float) -> Pieces:
        """One frame from all servos: each adds its block when as many bytes as its turn needs are
        on the line, so one that stays silent silences those behind it.
        """
        line, pieces = table.fast_head([size for _, _, size, _ in requests]), []

        def block(servo_id: int, error: int, data: bytes) -> bytes:
            body = bytes([error, servo_id]) + data
            head = b"" if pieces else line
            return head + body + table.crc16(body, table.crc16(line)).to_bytes(2, "little")

        for servo_id, address, size, _ in requests:
            if (
                not self._hears(servo_id)
                or not self._level(servo_id)
                or not table.has_fast_sync_read(self.series, self._get(servo_id, "firmware"))
                or address + size > self.memory_bytes
            ):
                break
            added = self._answer(servo_id, address, size, byte_s, encode=block, waits=not pieces)
            sent = b"".join(piece for _, piece in added)
            expected = size + table.FAST_BLOCK_BYTES + (0 if pieces else len(line))
            line = line + sent if pieces else sent
            pieces += added
            if len(sent) != expected:
                break
        return pieces

    def _instruct(self, servo_id: int, frame: Frame, at: float, byte_s: float) -> Pieces:
        """Execute an instruction of one servo; its reply."""
        code, params, level = frame.code, frame.data, self._level(servo_id)
        servo = self.servos[servo_id]
        if code == table.PING:
            model = self._get(servo_id, "model_number").to_bytes(2, "little")
            return self._reply(servo_id, model + bytes([self._get(servo_id, "firmware")]), byte_s)
        if code == table.READ:
            if len(params) != 4:
                return self._answer(servo_id, 0, 0, byte_s, table.DATA_LENGTH) if level else []
            address, size = (int.from_bytes(params[k : k + 2], "little") for k in (0, 2))
            error = 0 if 0 < size and address + size <= self.memory_bytes else table.ACCESS
            pieces = self._answer(servo_id, address, 0 if error else size, byte_s, error)
            return pieces if level else []
        error = table.INSTRUCTION
        if code in (table.WRITE, table.REG_WRITE) and len(params) > 2:
            address = int.from_bytes(params[:2], "little")
            if code == table.WRITE:
                error = self._try_store(servo_id, address, params[2:], at)
            else:
                servo.state["registered"] = (address, params[2:])
                self._set(servo_id, "registered_instruction", 1)
                error = 0
        elif code in (table.WRITE, table.REG_WRITE):
            error = table.DATA_LENGTH
        elif code == table.ACTION:
            address, data = servo.state.pop("registered", (0, None))
            self._set(servo_id, "registered_instruction", 0)
            failed = data is None
            error = table.RESULT_FAIL if failed else self._try_store(servo_id, address, data, at)
        elif code == table.CLEAR:  # clears the count of turns; these servos have one turn
            error = table.RESULT_FAIL if self._get(servo_id, "torque_enable") else 0
        elif code in (table.REBOOT, table.FACTORY_RESET):
            self.restart(servo_id, at, keeps_eeprom=code == table.REBOOT)
            error = 0
        return self._answer(servo_id, 0, 0, byte_s, error) if level >= 2 else []

    def _reply(self, servo_id: int, data: bytes, byte_s: float) -> Pieces:
        """A reply whose data are not in the memory: those of a ping."""
        servo = self.servos[servo_id]
        memory = bytes(servo.memory[: len(data)])
        servo.memory[: len(data)] = data
        pieces = self._answer(servo_id, 0, len(data), byte_s)
        servo.memory[: len(data)] = memory
        return pieces

    def _level(self, servo_id: int) -> int:
        return self._get(servo_id, "status_return_level")

    def _try_store(self, servo_id: int, address: int, data: bytes, at: float) -> int:
        """Store if the servo takes it; number of the error."""
        if at < self._brown_out_until:
            return 0
        if address + len(data) > self.memory_bytes:
            return table.ACCESS
        if address < self.series.eeprom_end and self._get(servo_id, "torque_enable"):
            return table.ACCESS
        memory = bytearray(self.servos[servo_id].memory)
        memory[address : address + len(data)] = data
        for name, register in self.series.registers.items():
            if not address <= register.address < address + len(data):
                continue
            value = self.series.decode(name, bytes(memory))
            if error := self._refused(servo_id, name, value):
                return error
        self._store(servo_id, address, data, at)
        return 0

    def _refused(self, servo_id: int, name: str, value: int) -> int:
        """Error number of a value that the servo does not take in a register, else 0."""
        if name in _READ_ONLY:
            return table.ACCESS
        if name in _CHOICES and value not in _CHOICES[name]:
            return table.DATA_LIMIT
        if name == "bus_watchdog" and value > 127:
            return table.DATA_RANGE
        if name == "torque_enable" and value and self._get(servo_id, "hardware_error_status"):
            return table.RESULT_FAIL
        if name == "goal_position":
            if self.servos[servo_id].stopped:
                return table.DATA_RANGE
            low, high = self._get(servo_id, "min_angle"), self._get(servo_id, "max_angle")
            extended = self._get(servo_id, "operating_mode") in self.family.turns_freely
            if not extended and not low <= value <= high:
                return table.DATA_LIMIT
        return 0

    def _store(self, servo_id: int, address: int, data: bytes, at: float) -> None:
        super()._store(servo_id, address, data, at)
        where = self.series.register("bus_watchdog").address
        if address <= where < address + len(data):
            self.servos[servo_id].stopped = False
            self.servos[servo_id].heard_s = at

    def _watch(self, servo_id: int, now: float) -> None:
        """Stop a servo whose bus watchdog has run out."""
        servo = self.servos[servo_id]
        units = self._get(servo_id, "bus_watchdog")
        ends = servo.heard_s + units * table.WATCHDOG_UNIT_S
        on = self._get(servo_id, "torque_enable")
        if 0 < units < table.TRIGGERED and on and now > ends and not servo.stopped:
            servo.stopped = True
            self._set(servo_id, "bus_watchdog", table.TRIGGERED)
            k = self.bench.index_of_id[servo_id]
            self.bench.command(k, ends, self.bench.count(k, ends))

    def _error_byte(self, servo_id: int, bits: int) -> int:
        known = bits & sum(table.HARDWARE_ERRORS)
        status = self._get(servo_id, "hardware_error_status") | known
        if known:
            self._set(servo_id, "hardware_error_status", status)
        if status & self._get(servo_id, "shutdown") and self._get(servo_id, "torque_enable"):
            self._set(servo_id, "torque_enable", 0)
            self.bench.torque(self.bench.index_of_id[servo_id], self._free_at, False)
        return table.ALERT if status else 0

    def _protect(self, servo_id: int, at: float) -> None:
        """Shutdown by overload, if its register selects it."""
        servo: Any = self.servos[servo_id]
        loaded = abs(self._get(servo_id, "present_pwm")) > 0.95 * table.FULL_PWM
        servo.loaded_since = min(servo.loaded_since, at) if loaded else float("inf")
        if self._get(servo_id, "shutdown") & 32 and at - servo.loaded_since > 2.0:
            servo.overloaded = True
            self._set(servo_id, "torque_enable", 0)
            self.bench.torque(self.bench.index_of_id[servo_id], at, False)
