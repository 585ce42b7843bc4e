"""A `ServoBus` of Feetech servos on a serial line: angles in, angles out, honest about gaps.

    bus = FeetechBus("/dev/ttyUSB0", joints=["LF_thigh"])

Goals go out to all servos in one frame. Readings come back in one exchange where the series can
(STS), or one servo after the other (SCS). A servo that did not answer has no reading; one that
keeps silent is asked less often, so that the others keep their rate.

The length of the question is its number: successive readings ask for 6, 7, … 11 bytes in turn, so
that an answer that comes too late is seen to belong to an earlier question. Voltage and temperature
are not in the shortest ones and stand as they were last read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.bus import BusSample, Sent
from pupper_sysid.hardware.clock import HostClock
from pupper_sysid.hardware.feetech.line import FRAME_BYTES, FeetechLine, Reply, known_models
from pupper_sysid.hardware.feetech.registers import RETURN_DELAY_UNIT_S, SCS0009, STS3215, Series
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map

AUTO_BAUDS = (1_000_000, 500_000, 115_200, 250_000, 57_600, 38_400)
"""Tried in this order where the user names no baud rate."""

SETTINGS = (
    "firmware_major", "firmware_minor", "return_delay", "p", "d", "i", "min_start_force",
    "dead_zone_cw", "dead_zone_ccw", "max_torque", "max_temperature", "max_voltage",
    "min_voltage", "min_angle", "max_angle", "acceleration", "goal_time", "goal_speed",
)  # fmt: skip
"""Registers that shape how a servo moves; a recording keeps them."""

LOAD_SCALE = 1e-3
VOLT_SCALE = 0.1

SPEED_LIMIT_RAD_S = 7.5
"""What a user would know of the servo before measuring it [rad/s]."""

_FIRST, _SHORTEST, _LENGTHS = 56, 6, 6  # position, speed, load; voltage; temperature; …
_FASTEST_RAD_S = 20.0  # no servo of this size turns faster, so a reading that did is not one
_SLACK_RAD = 0.05
_TORQUE_ON_TRIES, _TORQUE_OFF_TRIES = 10, 3
_GOAL_TRIES = 3
_SILENT_AFTER = 3
_SILENT_AT_ONCE = 3
_CHUNK = 16
_DOUBTS = 10  # exchanges that say how well readings are dated


@dataclass
class _Servo:
    """What the bus remembers of one servo."""

    id: int
    series: Series
    misses: int = 0
    last_s: float = -np.inf
    last_count: int = -1
    doubtful_s: float = -np.inf
    doubtful_count: int = -1
    voltage_v: float = np.nan
    temperature_c: float = np.nan


class FeetechBus:
    """Servos on a serial line.

    Parameters
    ----------
    device : str
        Serial port.
    baud : int, optional
        Found by asking if not given.
    joint_map : JointMap, optional
        Of raw counts; by default the preset that fits the servos found.
    joints : sequence of str, optional
        Only these, and all of them; by default those of the map that answer.

    Raises
    ------
    BusError
        If the port cannot be opened or an asked servo does not answer.
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
    ):
        # all presets of this layout share the ids
        wanted = joint_map or load_joint_map("sts3215").per_servo()
        wanted = wanted.select(joints) if joints else wanted
        self.line, found = open_line(device, baud, wanted.ids)
        try:
            series = _known(found, device)
            names = _answering(wanted, series, joints is not None, self.line)
            self._map = _fitting(joint_map, series, device).select(names)
            self._servos = [_Servo(i, series[i]) for i in self._map.ids]
            self._clock = HostClock()
            self._turn = 0
            self._doubts_s: list[float] = []
            self.joint_names = self._map.joint_names
            self.limits = self._map.position_limits()
            self.metadata: dict[str, Any] = self._describe(device)
        except BaseException:
            self.line.close()
            raise

    def now(self) -> float:
        """Time of the host's clock [s], from 0 at construction."""
        return self._clock.now()

    def sleep_until(self, time_s: float) -> None:
        """Sleep until `now()` has reached `time_s`."""
        self._clock.sleep_until(time_s)

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send goals to all servos in one frame."""
        goal = np.asarray(position_rad, float)
        if goal.shape != (len(self._servos),) or not np.isfinite(goal).all():
            raise BusError(
                f"{self.line.device}: goals must be {len(self._servos)} finite angles, got {goal}."
            )
        return Sent(self._send_goals(self._map.clip_counts(self._map.to_counts(goal))), goal)

    def read(self) -> BusSample:
        """Read all servos once; NaN where none came."""
        size = _SHORTEST + self._turn % _LENGTHS
        self._turn += 1
        joints = len(self._servos)
        time_s = np.full(joints, self.now())
        count = np.full(joints, -1)
        volts, temperature, load = (np.full(joints, np.nan) for _ in range(3))
        status = np.full(joints, 0)
        replies = self._ask(size)
        time_s[:] = self.now()
        if replies and len(self._doubts_s) < _DOUBTS:
            self._doubts_s.append(self._doubt_s(replies, size))
            self.metadata["read_time_doubt_s"] = float(np.median(self._doubts_s))
        for k, servo in enumerate(self._servos):
            reply = replies.get(servo.id)
            servo.misses = 0 if reply else servo.misses + 1
            if reply is None:
                continue
            at = self._clock.at(0.5 * (reply.before_s + reply.after_s))
            memory = reply.frame.data
            reported = servo.series.decode("position", memory, _FIRST)
            if not self._believable(servo, k, at, reported):
                continue
            time_s[k], count[k], status[k] = at, reported, reply.frame.code
            load[k] = LOAD_SCALE * servo.series.decode("load", memory, _FIRST)
            if len(memory) > 6:
                servo.voltage_v = VOLT_SCALE * servo.series.decode("voltage", memory, _FIRST)
            if len(memory) > 7:
                servo.temperature_c = float(servo.series.decode("temperature", memory, _FIRST))
            volts[k], temperature[k] = servo.voltage_v, servo.temperature_c
        position = self._map.to_angles(np.where(count < 0, np.nan, count))
        return BusSample(time_s, position, count, volts, temperature, load, status)

    def torque(self, on: bool) -> bool:
        """Hold the present pose, or let all servos go limp; every servo is asked whether it is."""
        tries = _TORQUE_ON_TRIES if on else _TORQUE_OFF_TRIES  # going limp must not wait
        return all([any(self._torque(s, on) for _ in range(tries)) for s in self._servos])

    def goals(self) -> NDArray[np.float64]:
        """The goals that stand in the servos, as angles; NaN where none was read."""
        counts = np.full(len(self._servos), np.nan)
        for k, servo in enumerate(self._servos):
            goal = servo.series.registers["goal"]
            for _ in range(_GOAL_TRIES):
                reply = self.line.read(servo.id, goal.address, goal.size)
                if reply:
                    counts[k] = servo.series.decode("goal", reply.frame.data, goal.address)
                    break
        return self._map.to_angles(counts)

    def close(self) -> None:
        """Release the port; the servos keep what they were told."""
        self.line.close()

    def _torque(self, servo: _Servo, on: bool) -> bool:
        """One try with one servo."""
        registers = servo.series.registers
        if on:
            # or it would jump to whatever goal it was left with
            here = self.line.read(servo.id, _FIRST, 2)
            if here is None:
                return False
            present = servo.series.decode("position", here.frame.data, _FIRST)
            present = int(np.clip(present, 0, servo.series.counts - 1))
            goal = servo.series.encode("goal", present)
            if not self.line.write(servo.id, registers["goal"].address, goal):
                return False
        address = registers["torque_enable"].address
        self.line.write(servo.id, address, bytes([int(on)]))
        # an acknowledgement could be a late one, a value that was read cannot
        now = self.line.read(servo.id, address, 1)
        return now is not None and now.frame.data == bytes([int(on)])

    def _send_goals(self, counts: NDArray[np.int64]) -> float:
        values = {
            servo.id: servo.series.encode("goal", int(count))
            for servo, count in zip(self._servos, counts, strict=True)
        }
        # the goal stands at the same address in both series
        return self._clock.at(self.line.sync_write(STS3215.registers["goal"].address, values))

    def _ask(self, size: int) -> dict[int, Reply]:
        """Answers of those who are asked this time."""
        # one good answer says that the line is back, and then all are asked again
        silent = [s for s in self._servos if s.misses >= _SILENT_AFTER]
        turn = self._turn % max(len(silent), 1)
        chance = [*silent[turn:], *silent[:turn]][:_SILENT_AT_ONCE]
        asked = [s for s in self._servos if s.misses < _SILENT_AFTER or s in chance]
        together = [s.id for s in asked if s.series.has_sync_read]
        replies: dict[int, Reply] = {}
        if together:
            replies |= self.line.sync_read(together, _FIRST, size)
        for servo in asked:
            if not servo.series.has_sync_read:
                reply = self.line.read(servo.id, _FIRST, size)
                if reply:
                    replies[servo.id] = reply
        if any(s.id in replies for s in chance):
            for servo in silent:
                servo.misses = 0
        return replies

    def _doubt_s(self, replies: dict[int, Reply], size: int) -> float:
        """By how much readings may have been taken earlier or later than they are stamped [s].

        Half a servo's turn, at an unknown moment of which it looks, and half of what an exchange
        with several took longer than the line needs: nobody knows where between them.
        """
        turns = [reply.after_s - reply.before_s for reply in replies.values()]
        needed = 0.0
        for joint, servo in zip(self.joint_names, self._servos, strict=True):
            if servo.id in replies and servo.series.has_sync_read:
                wait_s = RETURN_DELAY_UNIT_S * self.metadata["servos"][joint].get("return_delay", 0)
                needed += wait_s + 10.0 / self.line.baud * (size + FRAME_BYTES)
        longer = max(sum(turns) - needed, 0.0) if needed else 0.0
        return 0.5 * (float(np.median(turns)) + longer)

    def _believable(self, servo: _Servo, index: int, at: float, count: int) -> bool:
        """Whether the servo can be there; a checksum of 8 bits lets one garbled frame in 256 by."""
        per_rad = float(self._map.counts_per_rad()[index])
        if not 0 <= count < servo.series.counts:
            return False

        def reachable(since_s: float, from_count: int) -> bool:
            return abs(count - from_count) <= per_rad * (
                _SLACK_RAD + _FASTEST_RAD_S * (at - since_s)
            )

        good = not np.isfinite(servo.last_s) or reachable(servo.last_s, servo.last_count)
        if not good:
            # twice the same story is believed: then the earlier reading was the wrong one
            good = bool(np.isfinite(servo.doubtful_s)) and reachable(
                servo.doubtful_s, servo.doubtful_count
            )
            servo.doubtful_s, servo.doubtful_count = at, count
        if good:
            servo.last_s, servo.last_count = at, count
            servo.doubtful_s = -np.inf
            servo.doubtful_count = -(10**9)
        return good

    def _describe(self, device: str) -> dict[str, Any]:
        servos = {}
        for joint, servo in zip(self.joint_names, self._servos, strict=True):
            memory = memory_of(self.line, servo.id)
            servos[joint] = {"id": servo.id, "model": servo.series.name} | {
                name: servo.series.decode(name, memory)
                for name in SETTINGS
                if memory is not None and name in servo.series.registers
            }
        band = [
            (s["min_voltage"] * VOLT_SCALE, s["max_voltage"] * VOLT_SCALE)
            for s in servos.values()
            if s.get("max_voltage")
        ]
        known = {}
        if band:
            known["voltage_band_v"] = [max(b[0] for b in band), min(b[1] for b in band)]
        return (
            {
                "kind": "feetech",
                "device": device,
                "baud": self.line.baud,
                "echo": self.line.echoes,
                "servos": servos,
                "speed_limit_rad_s": SPEED_LIMIT_RAD_S,
                "poll_rate_hz": 0.0,
                "real_time": True,
            }
            | known
            | self._map.metadata()
        )


def open_line(
    device: str, baud: int | None, ids: Sequence[int]
) -> tuple[FeetechLine, dict[int, int | Series]]:
    """An open line and those of `ids` that answer; the first baud rate at which anyone does.

    Raises
    ------
    BusError
        If the port cannot be opened, or nobody answers at any rate.
    """
    for rate in (baud,) if baud else AUTO_BAUDS:
        line = FeetechLine(device, rate)
        line.detect_echo()
        found = line.find(ids)
        if found:
            return line, found
        line.close()
    rates = str(baud) if baud else ", ".join(map(str, AUTO_BAUDS))
    raise BusError(
        f"{device}: no servo answers at {rates} baud (asked for ids {_span(ids)}). Check that the "
        "servos have power, the data line is connected, and their ids, with "
        f"`pupper-sysid scan --bus feetech:{device}`."
    )


def memory_of(line: FeetechLine, servo: int) -> bytes | None:
    """Registers 0 to 66 of a servo, read in pieces; None if they did not come."""
    memory = b""
    while len(memory) <= 66:
        size = min(_CHUNK, 67 - len(memory))
        reply = line.read(servo, len(memory), size) or line.read(servo, len(memory), size)
        if reply is None:
            return None
        memory += reply.frame.data
    return memory


def _known(found: dict[int, int | Series], device: str) -> dict[int, Series]:
    """Series of the servos found; refused if one is of a series nobody knows the registers of."""
    for servo, model in found.items():
        if not isinstance(model, Series):
            raise BusError(
                f"{device}: servo {servo} says model number {model}, which is not known; known are "
                f"{known_models()}. Registers differ between series, so it is left alone."
            )
    return {i: s for i, s in found.items() if isinstance(s, Series)}


def _answering(
    wanted: JointMap, series: dict[int, Series], all_of_them: bool, line: FeetechLine
) -> list[str]:
    """Joints of `wanted` whose servos answer; refused if none does, or not `all_of_them`."""
    servos = dict(zip(wanted.joint_names, wanted.ids, strict=True))
    answering = [j for j, i in servos.items() if i in series]
    silent = [f"{j} (id {i})" for j, i in servos.items() if i not in series]
    if (silent and all_of_them) or not answering:
        raise BusError(
            f"{line.device}: {', '.join(silent)} does not answer at {line.baud} baud. Check power "
            "and wiring, name the --joints that are there, and see who is with "
            f"`pupper-sysid scan --bus feetech:{line.device}`."
        )
    return answering


def _fitting(joint_map: JointMap | None, series: dict[int, Series], device: str) -> JointMap:
    """The user's map, or the preset for the servos found; refused if it does not fit them."""
    names = {s.name for s in series.values()}
    if len(names) != 1:
        raise BusError(
            f"{device}: servos of different series ({', '.join(sorted(names))}) share the line, "
            "and their counts differ. Use one series per line."
        )
    one = next(iter(series.values()))
    if joint_map is None:
        preset = {SCS0009.name: "mini_pupper_2_direct", STS3215.name: "sts3215"}[one.name]
        return load_joint_map(preset).per_servo()
    if joint_map.frame != "raw":
        raise InputError(
            f"the joint map {joint_map.file.name} holds counts as the robot's proxy speaks them, "
            "and a direct bus speaks raw ones. Make a map with "
            f"`pupper-sysid calibrate-joints --bus feetech:{device}`."
        )
    if joint_map.file.counts != one.counts:
        raise InputError(
            f"the joint map {joint_map.file.name} is for servos of {joint_map.file.counts} "
            f"counts; these {one.name} have {one.counts}. Choose another map."
        )
    return joint_map


def _span(ids: Sequence[int]) -> str:
    ids = sorted(ids)
    if ids == list(range(ids[0], ids[-1] + 1)) and len(ids) > 2:
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids))
