"""Carry out a plan on a servo bus and write down what was sent and what was read, as it happens.

`record` moves the robot to the start pose, runs the trials at a fixed rate, and returns to the
start pose after each. Rows reach the file tick by tick, so that a recording that is interrupted,
or killed, is a recording up to there. Whatever happens, the bus is closed at the end, and the
torque switched off first if the bus still answers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.errors import BusError, InputError
from hardware.bus import BusSample, ServoBus
from sysid.excitation import Plan, TrialPlan, raised_cosine
from sysid.recording import RecordingWriter

LOOP_PERIOD_S = 0.019
"""Default time between commands [s]: the rate of the recordings this project starts from."""

REST_S = 0.5
"""Rest at the start pose before every trial [s], not recorded: servo and bus forget the last."""

RETURN_S = 0.4
"""Shortest way back to the start pose after a trial [s]."""

GENTLE_RAD_S = 1.0
"""Highest speed of the moves between trials."""

_FIRST_READING_S = 2.0

Progress = Callable[[float, float, str], None]
"""Called with seconds done, seconds in all, and what is going on."""


@dataclass
class LoopStatistics:
    """How well the loop kept its rate.

    Attributes
    ----------
    period_s : float
        The rate that was asked for.
    ticks : int
        Commands sent.
    missed_deadlines : int
        Ticks left out because the one before took too long.
    intervals_s : list of float
        Time from each command to the next within a trial.
    """

    period_s: float
    ticks: int = 0
    missed_deadlines: int = 0
    intervals_s: list[float] = field(default_factory=list)

    def summary(self) -> dict[str, float]:
        """Numbers for the recording's footer."""
        measured = {}
        if self.intervals_s:
            measured = {
                "mean_period_s": round(float(np.mean(self.intervals_s)), 7),
                "sd_period_s": round(float(np.std(self.intervals_s)), 7),
                "longest_period_s": round(float(np.max(self.intervals_s)), 7),
            }
        counts = {"ticks": self.ticks, "missed_deadlines": self.missed_deadlines}
        return {"period_s": self.period_s} | counts | measured


def record(
    bus: ServoBus,
    plan: Plan,
    path: Path,
    *,
    loop_period_s: float = LOOP_PERIOD_S,
    metadata: dict[str, Any] | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Carry out `plan` on `bus` and write the recording to `path`.

    Parameters
    ----------
    bus : ServoBus
        Closed when this returns, whatever happened.
    plan : Plan
    path : Path
        CSV file to write.
    loop_period_s : float
        Time between commands [s].
    metadata : dict, optional
        More keys for the recording's header, such as the seed.
    force : bool
        Replace an existing file.
    progress : callable, optional
        See `Progress`.

    Returns
    -------
    Path
        The file. Its footer is there only if the plan was carried out to its end.

    Raises
    ------
    InputError
        If the plan names a joint the bus has not, or the file exists.
    BusError
        If the bus gives no reading of where the robot is.
    KeyboardInterrupt
        On Ctrl-C, after the robot has returned to its start pose; the file has no footer then.
    """
    try:
        return _Session(bus, plan, loop_period_s, progress).run(path, metadata or {}, force)
    finally:
        bus.close()


class _Session:
    """One recording in progress."""

    def __init__(self, bus: ServoBus, plan: Plan, period_s: float, progress: Progress | None):
        if not (np.isfinite(period_s) and period_s > 0):
            raise InputError(f"loop_period_s is {period_s}; it must be a positive number.")
        unknown = sorted({j for t in plan.trials for j in t.joints} - set(bus.joint_names))
        if unknown or not plan.trials:
            wrong = f"joint {unknown[0]} is not on the bus" if unknown else "it has no trials"
            raise InputError(
                f"the plan cannot be carried out: {wrong}. "
                f"The bus {bus.name} has {', '.join(bus.joint_names)}."
            )
        self._bus, self._plan, self._period = bus, plan, period_s
        self._progress: Progress = progress or (lambda done, total, what: None)
        # a joint that the plan does not place stays where it is found
        self._start = np.array([plan.start_pose_rad.get(j, np.nan) for j in bus.joint_names])
        self._sent = self._start.copy()
        self._total_s = plan.duration_s
        self._loop = LoopStatistics(period_s)

    def run(self, path: Path, metadata: dict[str, Any], force: bool) -> Path:
        """Everything between opening the file and switching the torque off."""
        bus = self._bus
        present = self._first_pose()
        self._start = np.where(np.isfinite(self._start), self._start, present)
        self._sent = present
        rows = 0
        with RecordingWriter(path, self._header(metadata), force) as writer:
            try:
                bus.torque(True)
                self._progress(0.0, self._total_s, "moving to the start pose")
                self._move_to_start()
                done = 0.0
                for number, trial in enumerate(self._plan.trials):
                    self._hold(REST_S)
                    rows += self._trial(number, trial, writer, done)
                    done += trial.duration_s
                    self._move_to_start()
                writer.close({"rows": rows, "loop": self._loop.summary()})
            except KeyboardInterrupt:
                self._move_to_start()
                raise
            finally:
                bus.torque(False)
        return path

    def _header(self, metadata: dict[str, Any]) -> dict[str, Any]:
        moving = {joint for trial in self._plan.trials for joint in trial.joints}
        return {
            "bus": {"name": self._bus.name} | dict(self._bus.metadata),
            "excitation": dict(self._plan.description),
            "joints": [j for j in self._bus.joint_names if j in moving],
            "start_pose_rad": dict(
                zip(self._bus.joint_names, map(float, self._start), strict=True)
            ),
            "loop": {"period_s": self._period},
        } | metadata

    def _first_pose(self) -> NDArray[np.float64]:
        """Where the robot is; waits a little for the first polls."""
        bus, until = self._bus, self._bus.now() + _FIRST_READING_S
        while True:
            pose = bus.read().position_rad
            if np.isfinite(pose).all():
                return pose.copy()
            if bus.now() >= until:
                silent = [n for n, x in zip(bus.joint_names, pose, strict=True) if np.isnan(x)]
                raise BusError(
                    f"the bus {bus.name} gives no position of {', '.join(silent)}. Check that the "
                    "robot is on and its servos connected, then record again."
                )
            bus.sleep_until(bus.now() + self._period)

    def _trial(self, number: int, trial: TrialPlan, writer: RecordingWriter, done: float) -> int:
        """One trial, recorded; returns its number of rows."""
        bus = self._bus
        index = [bus.joint_names.index(joint) for joint in trial.joints]
        what = f"{', '.join(trial.joints[:3])}{' …' if len(trial.joints) > 3 else ''}"
        if np.isfinite(trial.frequency_hz):
            what += f" at {trial.frequency_hz:g} Hz"
        start, tick, rows, last = bus.now(), 0, 0, None
        while tick * self._period < trial.duration_s:
            bus.sleep_until(start + tick * self._period)
            elapsed = bus.now() - start
            goal = self._start.copy()
            # of the time it is, not of the time it should be: a late tick keeps the tone's phase
            goal[index] = trial.command(elapsed, self._start[index])
            sent_s = bus.write(goal)
            self._sent = goal
            sample = bus.read()
            writer.append(_rows(number, trial, index, sent_s, goal, sample))
            rows += len(index)
            if last is not None:
                self._loop.intervals_s.append(sent_s - last)
            last = sent_s
            self._loop.ticks += 1
            self._progress(done + min(elapsed, trial.duration_s), self._total_s, what)
            due = int((bus.now() - start) / self._period)
            self._loop.missed_deadlines += max(due - tick - 1, 0)
            tick = max(tick + 1, due)
        return rows

    def _move_to_start(self) -> None:
        """From the last command to the start pose on a raised cosine, gently."""
        origin, way = self._sent.copy(), self._start - self._sent
        farthest = float(np.max(np.abs(way)))
        if farthest == 0:
            return
        # the fastest point of a raised cosine is pi/2 times its mean speed
        duration = max(RETURN_S, 0.5 * np.pi * farthest / GENTLE_RAD_S)
        start = self._bus.now()
        share = 0.0
        while share < 1.0:
            self._bus.sleep_until(self._bus.now() + self._period)
            share = min((self._bus.now() - start) / duration, 1.0)
            self._sent = origin + raised_cosine(np.array(share)) * way
            self._bus.write(self._sent)

    def _hold(self, duration_s: float) -> None:
        """Rest at the start pose."""
        self._sent = self._start.copy()
        self._bus.write(self._sent)
        self._bus.sleep_until(self._bus.now() + duration_s)


def _rows(
    number: int,
    trial: TrialPlan,
    index: list[int],
    sent_s: float,
    goal: NDArray[np.float64],
    sample: BusSample,
) -> list[dict[str, Any]]:
    """One row per moving joint."""
    rows = []
    for joint, i in zip(trial.joints, index, strict=True):
        row: dict[str, Any] = {
            "send_time_s": sent_s,
            "read_time_s": sample.time_s,
            "trial": number,
            "joint": joint,
            "frequency_hz": trial.frequency_hz,
            "command_rad": float(goal[i]),
            "position_rad": float(sample.position_rad[i]),
            "position_count": int(sample.position_count[i]),
        }
        for name in ("voltage_v", "temperature_c", "load"):
            values = getattr(sample, name)
            if values is not None:
                row[name] = float(values[i])
        rows.append(row)
    return rows
