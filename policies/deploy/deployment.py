"""Run a policy on a robot: stand up, measure rest, walk, stop, sit down.

However a walk ends, the robot is parked, or limp after a fault, within a second, and the log's last
line gives the reason. The controller itself (`policies.deploy.controller`) is pure, and the guard
(`hardware.safety.guard`) is before every servo.

Velocity commands over time are constant, or from a script, within what a policy was trained for.
Beyond that a policy does not walk faster: at twice the training's speed the shipped ones stop or
walk backwards.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import BusError, InputError, PupperError, SafetyStop
from pupper_sysid.common.reading.csv_table import column_names, read_table
from pupper_sysid.hardware.bus import BusSample, Sent
from pupper_sysid.hardware.imu import Imu, ImuSample
from pupper_sysid.hardware.loop import (
    IMU,
    LOG,
    POLICY,
    VIEWS,
    Durations,
    FixedRateLoop,
    first_pose,
    glide,
)
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy.controller import Controller, Decision, Rest, Senses, at_rest
from pupper_sysid.policies.deploy.walk_log import WalkLog, start_header
from pupper_sysid.policies.network.policy_file import CommandRanges
from pupper_sysid.sim.walking.step import FALLEN_TILT, OBSERVATION_PARTS

Array = NDArray[np.float64]
Commands = Callable[[float], Array | None]
"""Forward and sideways speed [m/s] and turn rate [rad/s] by time since the first tick [s]; None to
stop."""

COLUMNS = ("seconds", "forward_m_s", "left_m_s", "turn_rad_s")
_LARGEST = 5.0


def constant(
    command: tuple[float, float, float],
    trained: CommandRanges | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Commands:
    """A constant command.

    It is clipped to the ranges of the training, where they are known; `say` is then called with a
    sentence.
    """
    value = checked_command(command)
    if trained is not None:
        value = trained.clipped(value[None], say)[0]
    return lambda elapsed_s: value


def checked_command(command: tuple[float, float, float]) -> Array:
    """The command as an array, shape (3,)."""
    value = np.array(command, float)
    if not np.isfinite(value).all() or np.abs(value).max() > _LARGEST:
        raise InputError(
            f"`command` is {' '.join(map(str, command))}; each must be within ±{_LARGEST:g} "
            "(m/s, m/s, rad/s)."
        )
    return value


def script(
    path: Path, trained: CommandRanges | None = None, say: Callable[[str], None] = lambda text: None
) -> Commands:
    """Commands of a CSV file with `COLUMNS`, one row after another, then a stop.

    `trained` and `say` as for `constant`.
    """
    text = read_text(path)
    if tuple(column_names(path, text)) != COLUMNS:
        raise InputError(f"{path}: it needs rows with the columns {','.join(COLUMNS)}.")
    table = read_table(path, text)
    if table.cut or not len(table):
        raise InputError(f"{path} has no rows, or its last one is cut short.")
    rows = np.stack([table.numbers[name] for name in COLUMNS], axis=-1)
    bad = np.flatnonzero(
        ~np.isfinite(rows).all(axis=1) | (np.abs(rows[:, 1:]) > _LARGEST).any(axis=1)
        | ~(rows[:, 0] > 0)
    )  # fmt: skip
    if len(bad):
        raise InputError(
            f"{path}, line {table.line[bad[0]]}: seconds must be positive and speeds within "
            f"±{_LARGEST:g}."
        )
    if trained is not None:
        rows[:, 1:] = trained.clipped(rows[:, 1:], say)
    ends = np.cumsum(rows[:, 0])

    def command(elapsed_s: float) -> Array | None:
        row = int(np.searchsorted(ends, elapsed_s, side="right"))
        return rows[row, 1:] if row < len(rows) else None

    return command


STAND_S = 3.0
SETTLE_S = 0.5
REST_SAMPLES = 50
IMU_SILENT_S = 0.2
STALL_S = 0.25
"""A longer pause of the loop ends the walk: the robot moved without control."""
_REST_PERIOD_S = 0.02
_GRAVITY = OBSERVATION_PARTS["projected_gravity"]


class Rows(Protocol):
    """Writer of the servos' rows, such as that of a recording."""

    def append(self, rows: list[dict[str, Any]]) -> None:
        """Write rows."""
        ...


@dataclass(frozen=True)
class Tick:
    """One tick of a walk, for watchers."""

    elapsed_s: float
    senses: Senses
    decision: Decision
    sent: Array
    """Targets that passed the guard [rad]; shape (12,)."""
    reading: BusSample
    missed_deadlines: int = 0
    """So far."""
    sent_s: float = float("nan")
    """When they were sent, on the bus's clock [s]; NaN if that failed."""


@dataclass
class Outcome:
    """Outcome of a walk."""

    seconds: float = 0.0
    """Duration of the walk."""
    steps: Durations = field(default_factory=Durations)
    """Computing time of the controller per tick, on the host's clock."""
    deadline_misses: int = 0
    fell: bool = False
    stop_reason: str = "time is up"
    guard: dict[str, int] = field(default_factory=dict)
    loop: dict[str, float] = field(default_factory=dict)
    clipped_imu_samples: int = 0
    missing_imu_samples: int = 0


def deploy(
    bus: GuardedBus,
    imu: Imu,
    controller: Controller,
    commands: Commands,
    seconds: float,
    log: Path,
    header: dict[str, Any],
    rows: Rows | None = None,
    watchers: Sequence[Callable[[Tick], None]] = (),
    force: bool = False,
) -> Outcome:
    """Walk for `seconds`, or until `commands` ends or a fault occurs.

    The bus, in joint coordinates, is parked at the end; closing it is the caller's. `log` is the
    CSV file to write (`policies.deploy.walk_log`), `header` more keys for its header; `rows` takes
    the servos' rows of each tick, as of a recording, and each watcher each tick.

    A walk that a fault ended has an outcome, too: `stop_reason` names the fault. It is an error if
    the robot's position cannot be read, torque not be enabled, or the log not be written, or if the
    robot moves when it should stand still.
    """
    outcome = Outcome()
    position = first_pose(bus, controller.period_s)
    try:
        bus.torque(True)
        standing = FixedRateLoop(bus, _REST_PERIOD_S)
        glide(standing, lambda pose: _send(bus, pose), position, controller.default, STAND_S)
        rest = _rest(bus, imu, standing, controller.default)
        start = first_pose(bus, controller.period_s)
        about = header | start_header(start, rest)
        writer = WalkLog(log, about, force, controller.joints)
        try:
            controller.reset(start, rest)
            _walk(bus, imu, controller, commands, seconds, writer, rows, watchers, outcome)
            glide(standing, lambda pose: _send(bus, pose), bus.sent, controller.default, SETTLE_S)
        except (SafetyStop, BusError) as fault:
            outcome.stop_reason = str(fault)
            # first: a faulty bus is slow, and the watchdog may end the process
            writer.close(outcome.stop_reason)
            bus.limp()
        except KeyboardInterrupt:
            outcome.stop_reason = "Ctrl-C"
        except PupperError as fault:
            outcome.stop_reason = str(fault)
            raise
        finally:
            try:
                bus.park()
            finally:
                writer.close(outcome.stop_reason)
    finally:
        bus.park()
        outcome.guard = bus.report.summary()
    return outcome


def _walk(
    bus: GuardedBus,
    imu: Imu,
    controller: Controller,
    commands: Commands,
    seconds: float,
    writer: WalkLog,
    rows: Rows | None,
    watchers: Sequence[Callable[[Tick], None]],
    outcome: Outcome,
) -> None:
    period = controller.period_s
    loop = FixedRateLoop(bus, period, most_misses=max(round(STALL_S / period) - 1, 1))
    spent = loop.spent
    # existing objects are not searched by the garbage collector in the middle of a step
    gc.collect()
    gc.freeze()
    imu_s = bus.now()
    load_nm = np.zeros(len(controller.joints))
    try:
        for elapsed in loop.ticks(seconds):
            command = commands(elapsed)
            if command is None:
                outcome.stop_reason = "end of commands"
                return
            reading = bus.read()
            with spent.on(IMU):
                sample = _sample(imu)
            if sample is not None:
                imu_s = bus.now()
                outcome.clipped_imu_samples += sample.clipped
            elif bus.now() - imu_s > IMU_SILENT_S:
                raise SafetyStop(
                    f"the IMU has not answered for {bus.now() - imu_s:.2f} s: the direction of "
                    "gravity is unknown. Check its cable."
                )
            else:
                outcome.missing_imu_samples += 1
            if reading.load is not None:
                load_nm = np.nan_to_num(reading.load) * controller.stall_torque_nm
            rate = force = np.full(3, np.nan)
            if sample is not None:
                rate, force = sample.rate_rad_s, sample.acceleration_m_s2
            senses = Senses(elapsed, command, reading.position_rad, load_nm, rate, force)
            begun = time.perf_counter()
            with spent.on(POLICY):
                decision = controller.step(senses)
            outcome.steps.add(time.perf_counter() - begun)
            sent = bus.write(decision.target)
            with spent.on(LOG):
                writer.append(senses, decision, sent.position_rad)
                if rows:
                    rows.append(_rows(controller, sent, reading))
            with spent.on(VIEWS):
                for watch in watchers:
                    watch(
                        Tick(elapsed, senses, decision, sent.position_rad, reading,
                             loop.missed_deadlines, sent.time_s)
                    )  # fmt: skip
            outcome.seconds = elapsed
            if not decision.observation[_GRAVITY][2] <= -FALLEN_TILT:  # NaN counts as fallen
                outcome.fell = True
                raise SafetyStop(f"the robot fell after {elapsed:.2f} s.")
    finally:
        gc.unfreeze()
        outcome.loop = loop.summary()
        outcome.deadline_misses = loop.missed_deadlines


def _rest(bus: GuardedBus, imu: Imu, loop: FixedRateLoop, pose: Array) -> Rest:
    """Bias and gravity while the robot stands."""
    rates, forces = [], []
    for _ in loop.ticks(SETTLE_S):
        _send(bus, pose)
    for _ in loop.ticks(REST_SAMPLES * _REST_PERIOD_S):
        _send(bus, pose)
        with loop.spent.on(IMU):
            sample = _sample(imu)
        if sample is not None:
            rates.append(sample.rate_rad_s)
            forces.append(sample.acceleration_m_s2)
    if len(rates) < REST_SAMPLES // 2:
        raise BusError(
            f"the IMU answered {len(rates)} times of {REST_SAMPLES}. Check its cable, and that "
            "nothing else talks to it."
        )
    return at_rest(np.array(rates), np.array(forces))


def _send(bus: GuardedBus, pose: Array) -> None:
    """Send a target and read, so that the guard can monitor its effect."""
    bus.write(pose)
    bus.read()


def _sample(imu: Imu) -> ImuSample | None:
    """Reading of the IMU; None also for one that holds a number that is none."""
    sample = imu.imu()
    if sample is None:
        return None
    numbers = np.concatenate([sample.rate_rad_s, sample.acceleration_m_s2])
    return sample if np.isfinite(numbers).all() else None


def _rows(controller: Controller, sent: Sent, reading: BusSample) -> list[dict[str, Any]]:
    """One row per joint, as in a recording, in servo coordinates."""
    command = controller.to_servo(sent.position_rad)
    position = controller.to_servo(reading.position_rad)
    names = ("voltage_v", "temperature_c", "load")
    optional = {n: values for n in names if (values := getattr(reading, n)) is not None}
    return [
        {
            "send_time_s": sent.time_s, "read_time_s": float(reading.time_s[i]), "trial": 0,
            "joint": joint, "frequency_hz": float("nan"), "command_rad": float(command[i]),
            "position_rad": float(position[i]),
            "position_count": int(reading.position_count[i]),
        }
        | {name: float(values[i]) for name, values in optional.items()}
        for i, joint in enumerate(controller.joints)
    ]  # fmt: skip
