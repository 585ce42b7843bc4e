"""Emulated servos behind the interface of a real bus, errors included.

    bus = EmulatedBus(draw_robot(rng), rng)

Commands are truncated to counts, as by the robot's own library. Readings are stale (polled in turn,
polls fail silently), noisy, quantised and biased (`servo_models.held_feedback`). A host sees no
more than on the real robot; `truth`, `truth_rows` and `write_truth` give the truth beside it.
The robot starts at its default pose with the torque on. Its clock starts at 0 and counts seconds
to the microsecond: virtual time, in which a sleep costs nothing and ends a little late, as on a
real host, or the host's own.
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from pupper_sysid.common.data_sheet import no_load_speed
from pupper_sysid.common.errors import BusError
from pupper_sysid.common.files import refuse_overwrite, write_text
from pupper_sysid.hardware.bus import BusSample, Sent, finite_angles
from pupper_sysid.hardware.loop import HostClock
from pupper_sysid.sim.emulator.bench import SUPPLY_V, FreeAirServos, PollSchedule, ServoPlant
from pupper_sysid.sim.emulator.robot import CENTRE_COUNT, RADIANS_PER_COUNT, EmulatedRobot


class VirtualClock:
    """Time that passes only in sleeps and exchanges with the bus.

    A sleep ends late by an exponential time of mean `overshoot_s`.
    """

    def __init__(self, overshoot_s: float, rng: np.random.Generator):
        self._now, self._overshoot, self._rng = 0.0, overshoot_s, rng

    def now(self) -> float:
        """Time [s], to the microsecond."""
        return round(self._now, 6)

    def sleep_until(self, time_s: float) -> None:
        """Jump to `time_s` and a little further."""
        if time_s > self._now:
            self._now = time_s + self._overshoot * self._rng.exponential()

    def spend(self, duration_s: float) -> None:
        """Let `duration_s` pass, give or take a fifth."""
        self._now += duration_s * self._rng.uniform(0.8, 1.2)


class RealClock(HostClock):
    """The host's own clock; exchanges take real time."""

    def spend(self, duration_s: float) -> None:
        """Sleep for `duration_s`."""
        time.sleep(duration_s)


NOMINAL_SPEED_LIMIT_RAD_S = 7.5
"""Speed limit of the Mini Pupper's servos [rad/s], and of others whose data sheet has none."""

TRUTH_COLUMNS = ("read_time_s", "joint", "true_position_rad", "reading_time_s")

_IN_USE_S = 5.0


class EmulatedBus:
    """A `hardware.bus.ServoBus` of emulated servos.

    In `real_time` it uses the host's clock instead of virtual time. What moves is the `plant`, by
    default the robot's servos in free air. With `keep_log` the truth of every read is remembered,
    for `truth_rows`; not for runs of days.
    """

    name = "emulated"

    def __init__(
        self,
        robot: EmulatedRobot,
        rng: np.random.Generator,
        real_time: bool = False,
        plant: ServoPlant | None = None,
        keep_log: bool = True,
    ):
        self.robot, self._keep_log = robot, keep_log
        self.joint_names = robot.joint_names
        spec = robot.spec
        polls, self._noise, clock, self._latency = rng.spawn(4)
        self._arrival_s = 0.0
        self._clock = RealClock() if real_time else VirtualClock(spec.sleep_overshoot_s, clock)
        self._plant = plant or FreeAirServos(robot)
        self._schedule = None
        if spec.poll_period_s > 0:
            phase = np.array([servo.poll_phase_s for servo in robot.servos])
            self._schedule = PollSchedule(
                spec.poll_period_s, phase, spec.loss, spec.poll_jitter_s, spec.poll_drift, polls
            )
        self._polls = polls
        self._sign = np.array([float(servo.count_sign) for servo in robot.servos])
        self._zero = np.array([servo.zero_rad for servo in robot.servos])
        self._offset = np.array([servo.feedback.offset_rad for servo in robot.servos])
        self._quantum = spec.quantum_rad
        # the same travel in radians whatever the size of a count
        self._centre = (
            round(CENTRE_COUNT * RADIANS_PER_COUNT / spec.quantum_rad) if spec.quantum_rad else 0
        )
        joints = len(self.joint_names)
        self._reading = np.full(joints, np.nan)
        self._count = np.full(joints, -1)
        self._measured_s = np.full(joints, -np.inf)
        pose = robot.joint_map.rest_pose()
        self._goal = pose.copy()
        self._changes: list[list[float]] = [[] for _ in self.joint_names]
        self._log: list[tuple[float, NDArray[np.float64], NDArray[np.float64]]] = []
        self._closed = False
        self.limits = robot.joint_map.per_servo().position_limits()
        speed = no_load_speed(robot.joint_map.file.servo or "", SUPPLY_V)
        self.metadata: dict[str, Any] = {
            "kind": "emulated",
            "readings": "polled" if spec.poll_period_s > 0 or spec.loss > 0 else "live",
            "coordinates": "servo",
            "linkage": robot.joint_map.file.linkage,
            "command_quantum_rad": {s.joint: spec.quantum_rad for s in robot.servos},
            "command_rounding": {s.joint: s.command_rounding for s in robot.servos},
            "count_zero_rad": {s.joint: s.zero_rad for s in robot.servos},
            "joint_map": robot.joint_map.file.name,
            "rest_pose_rad": dict(zip(self.joint_names, map(float, pose), strict=True)),
            "speed_limit_rad_s": speed or NOMINAL_SPEED_LIMIT_RAD_S,
            "real_time": real_time,
        }

    def now(self) -> float:
        """Time of the bus's clock [s], from 0 at construction."""
        return self._clock.now()

    def sleep_until(self, time_s: float) -> None:
        """Return when `now()` has reached `time_s`; in virtual time this costs nothing."""
        self._clock.sleep_until(time_s)

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send commands [rad], shape (12,)."""
        self._refuse_closed()
        commanded = finite_angles(position_rad, len(self.joint_names), self.name)
        sent, (goal, _) = self._clock.now(), self._quantised(commanded, rounding=np.trunc)
        jitter = self.robot.spec.command_jitter_s
        late = jitter * self._latency.exponential() if jitter else 0.0
        self._arrival_s = max(self._arrival_s, sent + late)  # commands keep their order
        for i in np.flatnonzero(goal != self._goal).tolist():
            self._plant.command(i, self._arrival_s, goal[i])
            if self._keep_log:
                self._changes[i].append(sent)
        self._goal = goal
        self._clock.spend(self.robot.spec.write_duration_s)
        return Sent(sent, commanded)

    def read(self) -> BusSample:
        """Read all joints once: the values of the last successful poll of each."""
        self._refuse_closed()
        before = self._clock.now()
        self._clock.spend(self.robot.spec.read_duration_s)
        time_s = round((before + self._clock.now()) / 2, 6)
        if self._schedule is not None:
            measured = self._schedule.advance(time_s)
        else:
            succeeded = self._polls.random(len(self.joint_names)) >= self.robot.spec.loss
            measured = np.where(succeeded, time_s, self._measured_s)
        fresh = np.flatnonzero(measured > self._measured_s)
        noise = self.robot.spec.reading_noise_rad * self._noise.standard_normal(len(fresh))
        position = np.array([self._plant.angle(i, measured[i]) for i in fresh.tolist()])
        reported = position + noise + self._offset[fresh]
        self._reading[fresh], self._count[fresh] = self._quantised(reported, fresh)
        self._measured_s = measured
        if self._keep_log:
            true = np.array([self._plant.angle(i, time_s) for i in range(len(self.joint_names))])
            self._log.append((time_s, true, measured))
        at = np.full(len(self.joint_names), time_s)
        return BusSample(at, self._reading.copy(), self._count.copy())

    def torque(self, on: bool) -> bool:
        """Hold the present pose, or switch the torque off."""
        self._refuse_closed()
        now = self._clock.now()
        for i in range(len(self.joint_names)):
            self._plant.torque(i, now, on)
        # the next write must reach the servos even if it repeats the last one
        self._goal = np.full(len(self.joint_names), np.nan)
        return True

    def servo_setups(self) -> dict[str, dict[str, Any]]:
        """By joint, what a recording's header says of its servo; empty where nothing is known."""
        plant: Any = self._plant
        setups = self.robot.joint_map.servo_setups()
        return setups | getattr(plant, "servo_setups", lambda joints: {})(self.joint_names)

    def register(self, joint: str, name: str) -> int:
        """Present value of a register, by the name that its family has for it."""
        return self._registers().register(self.joint_names.index(joint), name)

    def set_register(self, joint: str, name: str, value: int) -> None:
        """Set a register."""
        at = max(self._clock.now(), self._arrival_s)
        self._registers().set_register(self.joint_names.index(joint), at, name, value)

    def close(self) -> None:
        """Release the bus; the truth can still be read."""
        self._closed = True

    def truth(self) -> dict[str, Any]:
        """True parameters of every servo, as plain numbers."""
        return self.robot.truth()

    def truth_rows(self) -> Iterator[tuple[float, str, float, float]]:
        """Rows of `TRUTH_COLUMNS`: each read, each joint in use.

        `reading_time_s` is when the delivered value was measured. A joint is in use within 5 s of
        a change of its command.
        """
        times = np.array([time_s for time_s, _, _ in self._log])
        used = np.stack([_near(times, np.array(changes)) for changes in self._changes], axis=-1)
        for (time_s, true, measured), row in zip(self._log, used, strict=True):
            for i in np.flatnonzero(row):
                yield time_s, self.joint_names[i], float(true[i]), float(measured[i])

    def write_truth(self, stem: Path, force: bool = False) -> tuple[Path, Path]:
        """Write `<stem>.truth.yaml` and `<stem>.truth.csv`; returns their paths."""
        numbers, rows = (stem.with_name(f"{stem.name}.truth.{end}") for end in ("yaml", "csv"))
        for path in (numbers, rows):
            refuse_overwrite(path, force)
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(TRUTH_COLUMNS)
        for time_s, joint, true, measured in self.truth_rows():
            table.writerow((f"{time_s:.6f}", joint, f"{true:.7f}", f"{measured:.6f}"))
        write_text(numbers, yaml.safe_dump(self.truth(), sort_keys=False), force)
        write_text(rows, text.getvalue(), force)
        return numbers, rows

    def _quantised(
        self,
        position: NDArray[np.float64],
        joints: NDArray[np.intp] | slice = slice(None),
        rounding: Callable = np.round,
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Angles of whole counts within the servos' travel, and the counts; -1 without a step."""
        if self._quantum == 0:
            return position, np.full(len(position), -1)
        sign, zero = self._sign[joints], self._zero[joints]
        count = rounding(self._centre + sign * (position - zero) / self._quantum)
        count = np.clip(count, 0, 2 * self._centre - 1)
        return zero + sign * (count - self._centre) * self._quantum, count.astype(int)

    def _registers(self) -> Any:
        """The plant, if its servos have registers."""
        self._refuse_closed()
        if not hasattr(self._plant, "set_register"):
            raise BusError(
                "emulated bus: the servos of this robot have no registers. Give a load, such as "
                "pendulum:0.1kg@0.10m, for a bench whose servo has them."
            )
        return self._plant

    def _refuse_closed(self) -> None:
        if self._closed:
            raise BusError("emulated bus: it is closed.")


def _near(times: NDArray[np.float64], events: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each time is within `_IN_USE_S` of an event (sorted)."""
    first = np.searchsorted(events, times - _IN_USE_S)
    return np.searchsorted(events, times + _IN_USE_S) > first
