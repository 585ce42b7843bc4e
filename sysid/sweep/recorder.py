"""Execute a plan on a servo bus and record commands and readings.

`record` moves the robot to the start pose, runs the trials at a fixed rate, and returns to the
start pose after each. Every command passes the safety guard, and the recording holds the command
that the guard sent. Rows are written at every tick, so that an interrupted recording can be read up
to there and continued (`sysid.sweep.resume`). The robot is always parked and the bus closed at the
end.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError, SafetyStop
from pupper_sysid.hardware.bus import BusSample, ServoBus, header_entries
from pupper_sysid.hardware.loop import FixedRateLoop
from pupper_sysid.hardware.moves import first_pose, glide
from pupper_sysid.hardware.safety.guard import GuardedBus, guarded
from pupper_sysid.sysid.recordings.files import RecordingWriter
from pupper_sysid.sysid.sweep.excitation import LOOP_PERIOD_S, Plan, TrialPlan
from pupper_sysid.sysid.sweep.resume import Resume

REST_S = 0.5
"""Rest at the start pose before every trial [s], not recorded: servo and bus settle."""

RETURN_S = 0.4
"""Shortest duration of the return to the start pose after a trial [s]."""

Progress = Callable[[float, float, str], None]
"""Called with seconds done, seconds in all, and the name of the present work."""


def record(
    bus: ServoBus,
    plan: Plan,
    path: Path,
    *,
    loop_period_s: float = LOOP_PERIOD_S,
    metadata: dict[str, Any] | None = None,
    force: bool = False,
    resume: Resume | None = None,
    progress: Progress | None = None,
) -> Path:
    """Execute `plan` on `bus` and write the recording to `path`.

    Parameters
    ----------
    bus : ServoBus
        Wrapped in a guard if it is not yet. Always closed at the end.
    plan : Plan
    path : Path
        CSV file to write.
    loop_period_s : float
        Time between commands [s].
    metadata : dict, optional
        More keys for the recording's header, such as the seed.
    force : bool
        Replace an existing file.
    resume : Resume, optional
        Continue the unfinished recording at `path` instead.
    progress : callable, optional
        See `Progress`.

    Returns
    -------
    Path
        The file. It has a footer only if the plan was completed.

    Raises
    ------
    InputError
        If the plan names a joint that is not on the bus, or the file exists.
    BusError
        If the bus gives no position reading; `SafetyStop` if the guard ended the recording, or the
        loop missed too many deadlines: torque is off then.
    KeyboardInterrupt
        On Ctrl-C, after the robot was parked; the file has no footer then.
    """
    guard = guarded(bus)
    try:
        session = _Session(guard, plan, loop_period_s, resume, progress)
        return session.run(path, metadata or {}, force)
    finally:
        guard.close()


class _Session:
    """One recording in progress."""

    def __init__(
        self,
        bus: GuardedBus,
        plan: Plan,
        period_s: float,
        resume: Resume | None,
        progress: Progress | None,
    ):
        self._loop = FixedRateLoop(bus, period_s)
        # moves between the trials keep the rate, too, but are not recorded
        self._between = FixedRateLoop(bus, period_s)
        unknown = sorted({j for t in plan.trials for j in t.joints} - set(bus.joint_names))
        if unknown or not plan.trials:
            wrong = f"joint {unknown[0]} is not on the bus" if unknown else "it has no trials"
            raise InputError(
                f"the plan cannot be executed: {wrong}. "
                f"The bus {bus.name} has {', '.join(bus.joint_names)}."
            )
        self._bus, self._plan, self._resume = bus, plan, resume
        self._progress: Progress = progress or (lambda done, total, what: None)
        # a joint without a start pose in the plan stays where it is
        self._start = np.array([plan.start_pose_rad.get(j, np.nan) for j in bus.joint_names])
        self._sent = self._start.copy()
        self._total_s = plan.duration_s
        self._shift_s = 0.0

    def run(self, path: Path, metadata: dict[str, Any], force: bool) -> Path:
        """Record all trials, from opening the file to parking the robot."""
        bus, resume = self._bus, self._resume
        present = first_pose(bus, self._loop.period_s)
        self._start = np.where(np.isfinite(self._start), self._start, present)
        self._sent = present
        first, rows = 0, 0
        if resume is None:
            writer = RecordingWriter(path, self._header(metadata), force)
        else:
            first, rows = resume.next_trial, resume.rows
            self._shift_s = resume.now_s() - bus.now()
            writer = RecordingWriter.resumed(path, first)
        with writer:
            try:
                bus.torque(True)
                self._progress(0.0, self._total_s, "moving to the start pose")
                self._move_to_start()
                done = sum(trial.duration_s for trial in self._plan.trials[:first])
                for number, trial in enumerate(self._plan.trials[first:], first):
                    self._hold(REST_S)
                    rows += self._trial(number, trial, writer, done)
                    done += trial.duration_s
                    self._move_to_start()
            except SafetyStop:
                bus.limp()  # for the loop's own stop, too, which the guard does not see
                raise
            finally:
                bus.park()  # before the disk, which may be slow
            writer.close(
                {"rows": rows, "loop": self._loop.summary(), "guard": bus.report.summary()}
            )
        return path

    def _header(self, metadata: dict[str, Any]) -> dict[str, Any]:
        moving = {joint for trial in self._plan.trials for joint in trial.joints}
        return (
            header_entries(self._bus)
            | {
                "excitation": dict(self._plan.description),
                "joints": [j for j in self._bus.joint_names if j in moving],
                "start_pose_rad": dict(
                    zip(self._bus.joint_names, map(float, self._start), strict=True)
                ),
                "loop": {"period_s": self._loop.period_s},
            }
            | metadata
        )

    def _trial(self, number: int, trial: TrialPlan, writer: RecordingWriter, done: float) -> int:
        """One trial, recorded; returns its number of rows."""
        bus = self._bus
        index = [bus.joint_names.index(joint) for joint in trial.joints]
        what = f"{', '.join(trial.joints[:3])}{' …' if len(trial.joints) > 3 else ''}"
        if np.isfinite(trial.frequency_hz):
            what += f" at {trial.frequency_hz:g} Hz"
        rows = 0
        for elapsed in self._loop.ticks(trial.duration_s):
            goal = self._start.copy()
            # at the present time, not the planned one: a late tick keeps the phase of the tone
            goal[index] = trial.command(elapsed, self._start[index])
            sent = bus.write(goal)
            self._sent = sent.position_rad
            sample = bus.read()
            writer.append(
                _rows(number, trial, index, sent.time_s, self._sent, sample, self._shift_s)
            )
            rows += len(index)
            self._progress(done + min(elapsed, trial.duration_s), self._total_s, what)
        return rows

    def _move_to_start(self) -> None:
        """Move from the last command to the start pose on a raised cosine."""
        glide(self._between, self._command, self._sent.copy(), self._start, RETURN_S)

    def _hold(self, duration_s: float) -> None:
        """Rest at the start pose."""
        until = self._bus.now() + duration_s
        for _ in self._between.ticks(duration_s):
            self._command(self._start)
        self._bus.sleep_until(until)

    def _command(self, goal: NDArray[np.float64]) -> None:
        """Command and read without recording; the guard monitors the readings."""
        self._sent = self._bus.write(goal).position_rad
        self._bus.read()


def _rows(
    number: int,
    trial: TrialPlan,
    index: list[int],
    sent_s: float,
    goal: NDArray[np.float64],
    sample: BusSample,
    shift_s: float,
) -> list[dict[str, Any]]:
    """One row per moving joint."""
    rows = []
    for joint, i in zip(trial.joints, index, strict=True):
        row: dict[str, Any] = {
            "send_time_s": sent_s + shift_s,
            "read_time_s": float(sample.time_s[i]) + shift_s,
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
