"""A `ServoBus` of Feetech servos on a serial line.

    bus = FeetechBus("/dev/ttyUSB0", joints=["LF_thigh"])

Commands go to all servos in one frame. Readings come in one exchange where the series supports it
(STS), or servo by servo (SCS). A servo that did not answer has no reading; one that stays silent is
polled less often, so that the others keep their rate.

Successive readings request 6, 7, … 11 bytes in turn, so the length of a late reply shows that it
belongs to an earlier request. The shortest ones lack voltage and temperature, which keep their last
value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.data_sheet import no_load_speed, supply_range
from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.bus import BusSample, Sent, finite_angles
from pupper_sysid.hardware.clock import HostClock
from pupper_sysid.hardware.feetech.line import FRAME_BYTES, Reply
from pupper_sysid.hardware.feetech.opening import (
    answering_joints,
    fitting_map,
    known_series,
    open_line,
)
from pupper_sysid.hardware.feetech.protection import PROTECTIONS, protections_to_set
from pupper_sysid.hardware.feetech.registers import STS3215, Series
from pupper_sysid.hardware.feetech.settings import (
    VOLT_SCALE,
    memory_of,
    read_register,
    return_delay_s,
    setup_of,
    write_register,
)
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map

LOAD_SCALE = 1e-3

SPEED_LIMIT_RAD_S = 7.5
"""Speed of a servo whose data sheet is not known, or states none [rad/s]."""

_FIRST, _SHORTEST, _LENGTHS = 56, 6, 6  # position, speed, load; voltage; temperature; …
_FASTEST_RAD_S = 20.0  # no servo of this size turns faster
_SLACK_RAD = 0.05
_TORQUE_ON_TRIES, _TORQUE_OFF_TRIES = 10, 3
_GOAL_TRIES = 3
_SILENT_AFTER = 3
_SILENT_AT_ONCE = 3
_DOUBTS = 10  # exchanges from which the uncertainty of reading times is estimated


@dataclass
class _Servo:
    """State of one servo."""

    id: int
    series: Series
    misses: int = 0
    last_s: float = -np.inf
    last_count: int = -1
    doubtful_s: float = -np.inf
    doubtful_count: int = -1
    voltage_v: float = np.nan
    temperature_c: float = np.nan


class FeetechBus(HostClock):
    """Servos on a serial line.

    Parameters
    ----------
    device : str
        Serial port.
    baud : int, optional
        Detected if not given.
    joint_map : JointMap, optional
        For raw counts; by default the preset that fits the servos found.
    joints : sequence of str, optional
        Only these, and all of them; by default those of the map that answer.
    exclusive : bool
        Whether to refuse a port that another program has open.

    Raises
    ------
    BusError
        If the port cannot be opened or a servo of `joints` does not answer.
    InputError
        If the map does not fit the servos.
    """

    name = "feetech"

    def __init__(
        self,
        device: str,
        baud: int | None = None,
        joint_map: JointMap | None = None,
        joints: Sequence[str] | None = None,
        exclusive: bool = True,
    ):
        # all presets of this layout share the ids
        wanted = joint_map or load_joint_map("sts3215").per_servo()
        wanted = wanted.select(joints) if joints else wanted
        self.line, found = open_line(device, baud, wanted.ids, exclusive)
        try:
            series = known_series(found, device)
            names = answering_joints(wanted, series, joints is not None, self.line)
            self.joint_map = fitting_map(joint_map, series, device).select(names)
            self._servos = [_Servo(i, series[i]) for i in self.joint_map.ids]
            super().__init__()
            self._turn = 0
            self._doubts_s: list[float] = []
            self.joint_names = self.joint_map.joint_names
            self.limits = self.joint_map.position_limits()
            self._setups, self._unprotected = {}, {}
            for joint, servo in zip(self.joint_names, self._servos, strict=True):
                memory = memory_of(self.line, servo.id)
                self._setups[joint] = setup_of(servo.id, servo.series, memory)
                self._unprotected[joint] = _protections(servo.series, memory)
            self.metadata: dict[str, Any] = self._describe(device)
        except BaseException:
            self.line.close()
            raise

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send commands to all servos in one frame."""
        command = finite_angles(position_rad, len(self._servos), self.line.device)
        counts = self.joint_map.clip_counts(self.joint_map.to_counts(command))
        values = {
            servo.id: servo.series.encode("goal_position", int(count))
            for servo, count in zip(self._servos, counts, strict=True)
        }
        # the register has the same address in both series
        address = STS3215.registers["goal_position"].address
        return Sent(self.at(self.line.sync_write(address, values)), command)

    def read(self) -> BusSample:
        """Read all servos once; NaN where there is no reading."""
        size = _SHORTEST + self._turn % _LENGTHS
        self._turn += 1
        joints = len(self._servos)
        count = np.full(joints, -1)
        volts, temperature, load = (np.full(joints, np.nan) for _ in range(3))
        status = np.full(joints, 0)
        replies = self._poll(size)
        time_s = np.full(joints, self.now())
        if replies and len(self._doubts_s) < _DOUBTS:
            self._doubts_s.append(self._doubt_s(replies, size))
            self.metadata["read_time_doubt_s"] = float(np.median(self._doubts_s))
        for k, servo in enumerate(self._servos):
            reply = replies.get(servo.id)
            servo.misses = 0 if reply else servo.misses + 1
            if reply is None:
                continue
            at = self.at(0.5 * (reply.before_s + reply.after_s))
            memory, decode = reply.frame.data, servo.series.decode
            reported = decode("present_position", memory, _FIRST)
            if not self._plausible(servo, k, at, reported):
                continue
            time_s[k], count[k], status[k] = at, reported, reply.frame.code
            load[k] = LOAD_SCALE * decode("present_load", memory, _FIRST)
            if len(memory) > 6:
                servo.voltage_v = VOLT_SCALE * decode("present_voltage", memory, _FIRST)
            if len(memory) > 7:
                servo.temperature_c = float(decode("present_temperature", memory, _FIRST))
            volts[k], temperature[k] = servo.voltage_v, servo.temperature_c
        position = self.joint_map.to_angles(np.where(count < 0, np.nan, count))
        return BusSample(time_s, position, count, volts, temperature, load, status)

    def torque(self, on: bool) -> bool:
        """Hold the present pose, or switch the torque off; whether every servo confirms it."""
        tries = _TORQUE_ON_TRIES if on else _TORQUE_OFF_TRIES  # torque-off must not wait
        if not on:  # all at once, also those that hear but do not answer
            self.line.torque_off([s.id for s in self._servos])
        return all([any(self._torque(s, on) for _ in range(tries)) for s in self._servos])

    def goals(self) -> NDArray[np.float64]:
        """Goal_Position of each servo as an angle, shape (joints,); NaN where the read failed."""
        counts = np.full(len(self._servos), np.nan)
        for k, servo in enumerate(self._servos):
            goal = servo.series.registers["goal_position"]
            for _ in range(_GOAL_TRIES):
                reply = self.line.read(servo.id, goal.address, goal.size)
                if reply:
                    data = reply.frame.data
                    counts[k] = servo.series.decode("goal_position", data, goal.address)
                    break
        return self.joint_map.to_angles(counts)

    def servo_setups(self) -> dict[str, dict[str, Any]]:
        """Model, firmware, gains and registers of each servo, as found when the bus was opened."""
        return {joint: dict(setup) for joint, setup in self._setups.items()}

    def protections_to_set(self) -> dict[str, dict[str, int]]:
        """By joint, registers whose protection was weaker than the factory's when opened."""
        return {joint: own for joint, own in self._unprotected.items() if own}

    def register(self, joint: str, name: str) -> int:
        """Present value of a register; see `hardware.bus.RegisterBus`."""
        servo = self._servo(joint, name)
        value = read_register(self.line, servo.id, servo.series, name)
        if value is None:
            raise BusError(f"{joint}: its register {name} could not be read. Check the cable.")
        return value

    def set_register(self, joint: str, name: str, value: int) -> None:
        """Set a register and read it back; see `hardware.bus.RegisterBus`."""
        servo = self._servo(joint, name)
        if not write_register(self.line, servo.id, servo.series, name, value):
            raise BusError(
                f"{joint}: its register {name} did not take the value {value}. Check the cable, "
                "and that no other program uses the line."
            )

    def close(self) -> None:
        """Release the port; the servos keep their last command."""
        self.line.close()

    def _servo(self, joint: str, register: str) -> _Servo:
        servo = self._servos[self.joint_names.index(joint)]
        if register not in servo.series.registers:
            raise InputError(f"{joint}: a {servo.series.name} has no register {register}.")
        return servo

    def _torque(self, servo: _Servo, on: bool) -> bool:
        """One try with one servo."""
        series, registers = servo.series, servo.series.registers
        if on:
            # else it would jump to an old Goal_Position
            here = self.line.read(servo.id, _FIRST, 2)
            if here is None:
                return False
            present = series.decode("present_position", here.frame.data, _FIRST)
            goal = series.encode("goal_position", int(np.clip(present, 0, series.counts - 1)))
            if not self.line.write(servo.id, registers["goal_position"].address, goal):
                return False
        address = registers["torque_enable"].address
        self.line.write(servo.id, address, bytes([int(on)]))
        # an acknowledgement could be a late one, a value that is read back cannot
        now = self.line.read(servo.id, address, 1)
        return now is not None and now.frame.data == bytes([int(on)])

    def _poll(self, size: int) -> dict[int, Reply]:
        """Replies of the servos that are polled this time."""
        # one reply of a silent servo shows that the line is back: then all are polled again
        silent = [s for s in self._servos if s.misses >= _SILENT_AFTER]
        turn = self._turn % max(len(silent), 1)
        retried = [*silent[turn:], *silent[:turn]][:_SILENT_AT_ONCE]
        polled = [s for s in self._servos if s.misses < _SILENT_AFTER or s in retried]
        together = [s.id for s in polled if s.series.has_sync_read]
        replies = self.line.sync_read(together, _FIRST, size) if together else {}
        for servo in polled:
            if not servo.series.has_sync_read:
                reply = self.line.read(servo.id, _FIRST, size)
                if reply:
                    replies[servo.id] = reply
        if any(s.id in replies for s in retried):
            for servo in silent:
                servo.misses = 0
        return replies

    def _doubt_s(self, replies: dict[int, Reply], size: int) -> float:
        """Largest error of the reading times [s].

        Half a servo's turn, because the moment of its measurement within it is unknown, and half of
        the time by which an exchange with several servos exceeded what the line needs.
        """
        turns = [reply.after_s - reply.before_s for reply in replies.values()]
        needed = 0.0
        for joint, servo in zip(self.joint_names, self._servos, strict=True):
            if servo.id in replies and servo.series.has_sync_read:
                wait_s = return_delay_s(self._setups[joint])
                needed += wait_s + 10.0 / self.line.baud * (size + FRAME_BYTES)
        longer = max(sum(turns) - needed, 0.0) if needed else 0.0
        return 0.5 * (float(np.median(turns)) + longer)

    def _plausible(self, servo: _Servo, index: int, at: float, count: int) -> bool:
        """Whether the servo can be there: 1 garbled frame in 256 has a correct checksum."""
        if not 0 <= count < servo.series.counts:
            return False
        per_rad = float(self.joint_map.counts_per_rad()[index])

        def reachable(since_s: float, from_count: int) -> bool:
            farthest = _SLACK_RAD + _FASTEST_RAD_S * (at - since_s)
            return abs(count - from_count) <= per_rad * farthest

        good = not np.isfinite(servo.last_s) or reachable(servo.last_s, servo.last_count)
        if not good:
            # a second reading that agrees is accepted: the earlier one was wrong
            good = bool(np.isfinite(servo.doubtful_s)) and reachable(
                servo.doubtful_s, servo.doubtful_count
            )
            servo.doubtful_s, servo.doubtful_count = at, count
        if good:
            servo.last_s, servo.last_count = at, count
            servo.doubtful_s = -np.inf
        return good

    def _speeds_rad_s(self) -> list[float]:
        """Speed of each servo by its data sheet, at its supply voltage."""
        return [
            no_load_speed(setup["model"], setup.get("supply_voltage_v")) or SPEED_LIMIT_RAD_S
            for setup in self._setups.values()
        ]

    def _describe(self, device: str) -> dict[str, Any]:
        bands = (supply_band(s["model"], s.get("registers", {})) for s in self._setups.values())
        supply = [band for band in bands if band]
        known: dict[str, Any] = {
            "kind": "feetech",
            "readings": "live",
            "device": device,
            "baud": self.line.baud,
            "echo": self.line.echoes,
            "speed_limit_rad_s": min(self._speeds_rad_s(), default=SPEED_LIMIT_RAD_S),
            "poll_rate_hz": 0.0,
            "real_time": True,
        }
        if supply:
            known["voltage_band_v"] = [max(v[0] for v in supply), min(v[1] for v in supply)]
        return known | self.joint_map.metadata()


def supply_band(model: str, registers: Mapping[str, int]) -> tuple[float, float] | None:
    """Range of a servo's supply [V]: that of its registers, within its data sheet's.

    None if neither is known. Registers whose range is empty are not used.
    """
    low = VOLT_SCALE * registers.get("min_voltage", 0)
    high = VOLT_SCALE * registers.get("max_voltage", 0)
    sheet = supply_range(model)
    if sheet is None:
        return (low, high) if low < high else None
    inside = max(low, sheet[0]), min(high, sheet[1])
    return inside if inside[0] < inside[1] else sheet


def _protections(series: Series, memory: bytes | None) -> dict[str, int]:
    """Protections to set of a servo with this memory; none if it could not be read."""
    if memory is None:
        return {}
    known = [name for name in PROTECTIONS if name in series.registers]
    return protections_to_set(series, {name: series.decode(name, memory) for name in known})
