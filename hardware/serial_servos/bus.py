"""A `ServoBus` of servos on a serial line, of any vendor.

    bus = FeetechBus("/dev/ttyUSB0", joint_map=load_joint_map("joints.yaml"))

Commands go to all servos in one frame. Readings come in one exchange where the series supports it,
or servo by servo. A servo that did not answer has no reading; one that stays silent is polled less
often, so that the others keep their rate.

Successive readings request different lengths in turn, so the length of a late reply shows that it
belongs to an earlier request. The shortest ones lack voltage and temperature, which keep their last
value.

`refuse_unfit` judges the registers (`serial_servos.settings`); the guard calls it before it
switches the torque on. A vendor's bus is a subclass that names its `Family`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.data_sheet import no_load_speed
from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.bus import BusSample, Sent, finite_angles
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.loop import HostClock
from pupper_sysid.hardware.serial_servos import scan, settings
from pupper_sysid.hardware.serial_servos.line import Reply, line_remarks
from pupper_sysid.hardware.serial_servos.scan import LineReport
from pupper_sysid.hardware.serial_servos.series import Family, Series
from pupper_sysid.hardware.serial_servos.settings import RegisterFault

SPEED_LIMIT_RAD_S = 7.5
"""Speed of a servo whose data sheet is not known, or states none [rad/s]."""

_FASTEST_RAD_S = 20.0  # no servo of this size turns faster
_SLACK_RAD = 0.05
_TORQUE_ON_TRIES, _TORQUE_OFF_TRIES = 10, 3
_GOAL_TRIES = 3
_SILENT_AFTER = 3
_SILENT_AT_ONCE = 3
_NO_DOUBT = (-np.inf, -1)
_DOUBTS = 10  # exchanges from which the uncertainty of reading times is estimated


@dataclass
class LineServo:
    """State of one servo."""

    id: int
    series: Series
    registers: dict[str, int] | None = None
    """All, as read when the bus was opened; None if they could not be read."""
    misses: int = 0
    last_s: float = -np.inf
    last_count: int = -1
    doubtful: tuple[float, int] = _NO_DOUBT
    """Time and count of a reading that the one before it does not explain."""
    voltage_v: float = np.nan
    temperature_c: float = np.nan


class SerialBus(HostClock):
    """Servos on a serial line.

    The rate is detected without a `baud`. `joint_map` is for raw counts; by default that of the
    Mini Pupper's layout, if the line has its twelve servos and no other. Of `joints` all must
    answer; by default the bus has those of the map that do. `exclusive` refuses a port that another
    program has open.
    """

    family: ClassVar[Family]
    name: str
    _turns = 1  # that a position may be away from the encoder's range

    def __init__(
        self,
        device: str,
        baud: int | None = None,
        joint_map: JointMap | None = None,
        joints: Sequence[str] | None = None,
        exclusive: bool = True,
    ):
        self.name = self.family.name
        self.error_bits = self.family.error_bits
        chosen = joint_map.select(joints) if joint_map and joints else joint_map
        ids = chosen.ids if chosen else scan.MINI_PUPPER_IDS
        self.line, models = scan.open_line(
            self.family, device, baud, ids, exclusive, patiently=chosen is not None
        )
        try:
            named = chosen.file.servo if chosen else None
            series = scan.known_series(self.family, self.line, models, named)
            if chosen is None:
                chosen = scan.default_map(self.family, self.line, series)
                chosen = chosen.select(joints) if joints else chosen
            else:
                scan.refuse_other_servos(
                    chosen, self.family, scan.one_series(series, device), device
                )
            self.joint_map = chosen.select(
                scan.answering_joints(self.family, chosen, series, joints is not None, self.line)
            )
            self._servos = [LineServo(i, series[i]) for i in self.joint_map.ids]
            super().__init__()
            first = self._servos[0].series.register(self.family.present)
            self._first, self._turn = first.address, 0
            self._goal_address = self._servos[0].series.register("goal_position").address
            self._doubts_s: list[float] = []
            self.joint_names = self.joint_map.joint_names
            self.limits = self.joint_map.position_limits()
            for servo in self._servos:
                self._remember(servo)
            if doubled := self.line.doubled(
                [servo.id for servo in self._servos], self._first, self.family.reading_bytes[0]
            ):
                raise BusError(" ".join(scan.two_of_one_id(self.line, servo) for servo in doubled))
            self._setups = {
                joint: settings.setup_of(servo.id, self.family, servo.series, servo.registers)
                for joint, servo in zip(self.joint_names, self._servos, strict=True)
            }
            self.metadata: dict[str, Any] = self._describe(device)
        except BaseException:
            self.line.close()
            raise

    @classmethod
    def open_address(
        cls,
        address: BusAddress,
        joint_map: JointMap | None,
        joints: Sequence[str] | None,
        exclusive: bool,
    ) -> SerialBus:
        """The bus at an address; see the class."""
        return cls(address.where, address.baud, joint_map, joints, exclusive)

    @classmethod
    def scan_address(cls, address: BusAddress, advance: Callable[[str], None]) -> LineReport:
        """Servos at an address; see `scan_line`."""
        return scan.scan_line(cls.family, address.where, address.baud, advance)

    @classmethod
    def limp_address(cls, address: BusAddress, ids: Sequence[int] | None) -> None:
        """Send torque-off to these servos (default: all) at all rates, before anything is known."""
        for rate in cls.family.rates if address.baud is None else (address.baud,):
            line = cls.family.open_line(address.where, rate, False)
            line.torque_off(ids)
            line.close()

    def refuse_unfit(self) -> None:
        """Refuse servos whose registers do not let them be driven by this map."""
        for joint, servo in zip(self.joint_names, self._servos, strict=True):
            if servo.registers is None:
                self._remember(servo)
            if servo.registers is None and self.line.answers_ping(servo.id):
                level = servo.series.name_of("response_level")
                raise BusError(
                    f"{joint}: it answers pings, but no read: its register {level} (address "
                    f"{servo.series.register(level).address}) is probably 0. Write "
                    f"{self.family.acknowledges} into it with {self.family.tool}."
                )
            if servo.registers is None:
                raise BusError(
                    f"{joint}: its registers could not be read, so it must not be driven. "
                    "Check the cable and the power, then try again."
                )
        if refused := [sentence for fault, sentence in self._faults() if fault.refused]:
            raise BusError(" ".join(refused) + " The torque was not switched on.")

    def remarks(self) -> list[str]:
        """Sentences about the line and all registers that are not as they should be."""
        return line_remarks(self.line) + [sentence for _, sentence in self._faults()]

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send commands to all servos in one frame."""
        command = finite_angles(position_rad, len(self._servos), self.line.device)
        counts = self.joint_map.clip_counts(self.joint_map.to_counts(command))
        values = {
            servo.id: servo.series.encode("goal_position", int(count))
            for servo, count in zip(self._servos, counts, strict=True)
        }
        return Sent(self.at(self.line.sync_write(self._goal_address, values)), command)

    def read(self) -> BusSample:
        """Read all servos once; NaN where there is no reading."""
        size = self.family.reading_bytes[self._turn % len(self.family.reading_bytes)]
        self._turn += 1
        joints = len(self._servos)
        count, answered = np.full(joints, -1), np.zeros(joints, bool)
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
            reported = decode("present_position", memory, self._first)
            if not self._plausible(servo, k, at, reported):
                continue
            time_s[k], count[k], answered[k] = at, reported, True
            status[k] = self._status(servo, reply)
            name, scale = self.family.load
            load[k] = scale * decode(name, memory, self._first)
            if self._holds(servo, "present_voltage", memory):
                raw = decode("present_voltage", memory, self._first)
                servo.voltage_v = self.family.volt_scale * raw
            if self._holds(servo, "present_temperature", memory):
                servo.temperature_c = float(decode("present_temperature", memory, self._first))
            volts[k], temperature[k] = servo.voltage_v, servo.temperature_c
        position = self.joint_map.to_angles(np.where(answered, count, np.nan))
        return BusSample(time_s, position, count, volts, temperature, load, status)

    def torque(self, on: bool) -> bool:
        """Hold the present pose, or switch the torque off; whether every servo confirms it."""
        tries = _TORQUE_ON_TRIES if on else _TORQUE_OFF_TRIES  # torque-off must not wait
        if not on:  # all at once, also those that hear but do not answer
            self.line.torque_off([s.id for s in self._servos])
        return all([any(self._torque(s, on) for _ in range(tries)) for s in self._servos])

    @property
    def lost_device(self) -> str | None:
        """Name of the serial device if it is no longer there."""
        return None if Path(self.line.device).exists() else self.line.device

    def has_lost_torque(self, joint: str) -> bool:
        """Whether a servo answers that its torque is off."""
        servo = self._servo(joint, "torque_enable")
        return settings.read_register(self.line, servo.id, servo.series, "torque_enable") == 0

    def goals(self) -> NDArray[np.float64]:
        """Goal_Position of each servo as an angle, shape (joints,); NaN where the read failed."""
        goals = [
            settings.read_register(self.line, s.id, s.series, "goal_position", _GOAL_TRIES)
            for s in self._servos
        ]
        return self.joint_map.to_angles(np.array([np.nan if x is None else x for x in goals]))

    def servo_setups(self) -> dict[str, dict[str, Any]]:
        """Model, firmware, gains and registers of each servo, as read when the bus was opened."""
        return {joint: dict(setup) for joint, setup in self._setups.items()}

    def protections_to_set(self) -> dict[str, dict[str, int]]:
        """By joint, registers whose protection was weaker than the factory's when opened."""
        weak = {
            joint: self.family.protections(servo.series, servo.registers)
            for joint, servo in zip(self.joint_names, self._servos, strict=True)
            if servo.registers is not None
        }
        return {joint: registers for joint, registers in weak.items() if registers}

    def register(self, joint: str, name: str) -> int:
        """Present value of a register; `BusError` if it cannot be read."""
        servo = self._servo(joint, name)
        value = settings.read_register(self.line, servo.id, servo.series, name)
        if value is None:
            raise BusError(f"{joint}: its register {name} could not be read. Check the cable.")
        return value

    def set_register(self, joint: str, name: str, value: int) -> None:
        """Set a register; `BusError` if it is not read back with this value."""
        servo = self._servo(joint, name)
        if not settings.write_register(self.line, servo.id, servo.series, name, value):
            raise BusError(
                f"{joint}: its register {name} did not take the value {value}. Check the cable, "
                "and that no other program uses the line."
            )

    def close(self) -> None:
        """Release the port; the servos keep their last command."""
        self.line.close()

    def _remember(self, servo: LineServo) -> None:
        """Read all registers of a servo."""
        memory = settings.memory_of(self.line, servo.id, self.family.memory_pieces)
        servo.registers = None if memory is None else settings.registers_of(servo.series, memory)

    def _faults(self) -> list[tuple[RegisterFault, str]]:
        """Faults of all servos' registers, each once with the joints that have it."""
        joints: dict[tuple[RegisterFault, str], list[str]] = {}
        for k, servo in enumerate(self._servos):
            if servo.registers is None:
                continue
            entry = self.joint_map.file.joints[self.joint_names[k]]
            faults = settings.register_faults(
                self.family, servo.series, servo.registers, entry.limits_counts
            )
            name, expected = servo.series.name_of("homing_offset"), entry.homing_offset
            value = servo.registers.get(name)
            if value == expected:  # the range of the map wraps with this offset
                faults = [f for f in faults if f.refused or f.register != "homing_offset"]
            if expected is not None and value is not None and value != expected:
                meaning = (
                    f"the joint map holds with {expected} only, and all angles are off by the rest"
                )
                cure = (
                    f"Write {expected} into {name} with {self.family.tool} or LeRobot, or measure "
                    "the map anew with `pupper-sysid calibrate-joints`"
                )
                faults.append(RegisterFault("homing_offset", value, meaning, cure))
            for fault in faults:
                joints.setdefault((fault, servo.series.name), []).append(self.joint_names[k])
        series = {servo.series.name: servo.series for servo in self._servos}
        return [
            (fault, fault.sentence(", ".join(names), series[name]))
            for (fault, name), names in joints.items()
        ]

    def _status(self, servo: LineServo, reply: Reply) -> int:
        """Error bits of a reply."""
        return reply.frame.code

    def _holds(self, servo: LineServo, name: str, memory: bytes) -> bool:
        """Whether a reading is long enough for a register."""
        register = servo.series.register(name)
        return register.address + register.size <= self._first + len(memory)

    def _servo(self, joint: str, register: str) -> LineServo:
        servo = self._servos[self.joint_names.index(joint)]
        if not servo.series.has(register):
            raise InputError(f"{joint}: a {servo.series.name} has no register {register}.")
        return servo

    def _torque(self, servo: LineServo, on: bool) -> bool:
        """One try with one servo."""
        series = servo.series
        if on:
            # else it would jump to an old Goal_Position
            present = settings.read_register(
                self.line, servo.id, series, "present_position", tries=1
            )
            if present is None:
                return False
            goal = series.encode("goal_position", int(np.clip(present, 0, series.counts - 1)))
            if not self.line.write(servo.id, self._goal_address, goal):
                return False
        address = series.register("torque_enable").address
        self.line.write(servo.id, address, bytes([int(on)]))
        # an acknowledgement could belong to an earlier request, a value that is read back cannot
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
        replies = self.line.sync_read(together, self._first, size) if together else {}
        for servo in polled:
            if not servo.series.has_sync_read:
                reply = self.line.read(servo.id, self._first, size)
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
        delays = [
            settings.return_delay_s(self.family, self._setups[joint])
            for joint, servo in zip(self.joint_names, self._servos, strict=True)
            if servo.id in replies and servo.series.has_sync_read
        ]
        took = sum(turns) + sum(reply.waited_s for reply in replies.values())
        longer = max(took - self.line.sync_read_s(delays, size), 0.0) if delays else 0.0
        return 0.5 * (float(np.median(turns)) + longer)

    def _plausible(self, servo: LineServo, index: int, at: float, count: int) -> bool:
        """Whether the servo can be there: 1 garbled frame in 256 has a correct checksum."""
        # valid too: outside the encoder's range by a homing offset, or by full turns
        turns = self._turns * servo.series.counts
        if not -turns <= count < turns + servo.series.counts:
            return False
        per_rad = float(self.joint_map.counts_per_rad()[index])

        def near(since_s: float, from_count: int) -> bool:  # any is, if the last one is old
            farthest = _SLACK_RAD + _FASTEST_RAD_S * (at - since_s)
            return abs(count - from_count) <= per_rad * farthest

        doubtful_s, doubtful_count = servo.doubtful
        # a second reading that agrees is accepted: the earlier one was wrong
        if near(servo.last_s, servo.last_count) or (
            np.isfinite(doubtful_s) and near(doubtful_s, doubtful_count)
        ):
            servo.last_s, servo.last_count, servo.doubtful = at, count, _NO_DOUBT
            return True
        servo.doubtful = at, count
        return False

    def _choose_reading(self) -> str:
        """Request with which the servos are read, for the header."""
        together = all(servo.series.has_sync_read for servo in self._servos)
        return "sync read" if together else "read"

    def _describe(self, device: str) -> dict[str, Any]:
        bands = (
            settings.supply_band(self.family, servo.series, servo.registers or {})
            for servo in self._servos
        )
        supply = [limits_v for limits_v in bands if limits_v]
        speeds = [  # by their data sheets, at their supply voltage
            no_load_speed(setup["model"], setup.get("supply_voltage_v")) or SPEED_LIMIT_RAD_S
            for setup in self._setups.values()
        ]
        known: dict[str, Any] = {
            "kind": self.family.name,
            "readings": "live",
            "read_by": self._choose_reading(),
            "device": device,
            "baud": self.line.baud,
            "echo": self.line.echoes,
            "latency_s": round(self.line.latency_s, 6),
            "speed_limit_rad_s": min(speeds, default=SPEED_LIMIT_RAD_S),
            "poll_rate_hz": 0.0,
            "real_time": True,
        }
        if supply:
            known["voltage_band_v"] = [max(v[0] for v in supply), min(v[1] for v in supply)]
        return known | self.joint_map.metadata()
