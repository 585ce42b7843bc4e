"""Execute a plan on a servo bus and record commands and readings.

`record` moves the robot to the start pose, runs the trials at a fixed rate, and returns to the
start pose after each. Every command passes the safety guard, and the recording holds the command
that the guard sent. Rows are written at every tick, so that an interrupted recording can be read up
to there and continued (`sysid.sweep.resume`). At the end the robot is always parked, changed gains
are set back, and the bus is closed.

Trials of a bench (`sysid.sweep.bench`) may set the P gain and switch the torque off on the way;
afterwards it is on again only once the joints have come to rest.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError, InputError, SafetyStop
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_ROWS
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus, header_entries
from pupper_sysid.hardware.loop import LOG, VIEWS, FixedRateLoop, first_pose, glide
from pupper_sysid.hardware.safety.guard import GuardedBus, guarded
from pupper_sysid.sysid.recordings.files import RecordingWriter
from pupper_sysid.sysid.recordings.importers.log import MOST_TRIALS
from pupper_sysid.sysid.sweep.excitation import LOOP_PERIOD_S, Plan, TrialPlan
from pupper_sysid.sysid.sweep.resume import Resume

REST_S = 0.5  # rest at the start pose before every trial [s], not recorded: servo and bus settle

REST_SPREAD_RAD, REST_FOR_S, REST_WITHIN_S = 0.02, 0.6, 20.0
"""After a drop: joints whose readings vary by less than this, for so long, are at rest; the longest
wait for that [s]."""

RETURN_S = 0.4  # shortest duration of the return to the start pose after a trial [s]

P_REGISTER = "p"

_CHECK_LINE = "Check the cable; cut the servos' power if they still hold."

Progress = Callable[[float, float, str], None]
"""Called with seconds done, seconds in all, and the name of the present work."""

Observe = Callable[[int, Sent, BusSample, int], None]
"""Called with each tick of a trial: its number, what was sent (angles NaN while limp), reading, and
the deadlines missed so far. Times are the bus's."""


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
    observe: Observe | None = None,
) -> Path:
    """Execute `plan` on `bus` and write the recording to `path`, whose footer says it is complete.

    The bus is wrapped in a guard if it is not yet, and always closed at the end. `metadata` has
    more keys for the recording's header. `resume` continues the unfinished recording at `path`.
    `observe` must not wait.

    Raises
    ------
    InputError
        If the plan names a joint that is not on the bus, the recording would be too long to be
        read, or the file exists.
    BusError
        If the bus gives no position reading; `SafetyStop` if the guard ended the recording, or the
        loop missed too many deadlines: torque is off then.
    KeyboardInterrupt
        On Ctrl-C, after the robot was parked; the file has no footer then.
    """
    guard = guarded(bus)
    try:
        session = _Session(guard, plan, loop_period_s, resume, progress, observe)
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
        observe: Observe | None,
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
        rows = sum(len(t.joints) * t.duration_s for t in plan.trials) / period_s
        refuse_more("The recording, by its plan,", rows, MOST_ROWS, "rows", "Make it shorter.")
        refuse_more("The recording, by its plan,", len(plan.trials), MOST_TRIALS, "trials")
        self._bus, self._plan, self._resume = bus, plan, resume
        self._progress: Progress = progress or (lambda done, total, what: None)
        self._observe: Observe = observe or (lambda number, sent, reading, missed: None)
        # a joint without a start pose in the plan stays where it is
        self._start = np.array([plan.start_pose_rad.get(j, np.nan) for j in bus.joint_names])
        self._sent = self._start.copy()
        self._total_s = plan.duration_s
        self._shift_s = 0.0
        self._gains: dict[str, float] = {}
        self._on_a_bench = any(
            np.isfinite(t.p_gain) or np.isfinite(t.release_s) for t in plan.trials
        )

    def run(self, path: Path, metadata: dict[str, Any], force: bool) -> Path:
        """Record all trials, from opening the file to parking the robot."""
        bus, resume = self._bus, self._resume
        present = first_pose(bus, self._loop.period_s)
        self._start = np.where(np.isfinite(self._start), self._start, present)
        self._sent = present
        moving = {joint for trial in self._plan.trials for joint in trial.joints}
        for k, joint in enumerate(bus.joint_names):  # where a load cannot be hanging
            away = abs(present[k] - self._start[k])
            if joint in moving and away > self._plan.nearest_start_rad:
                raise InputError(
                    f"{joint} was found {away:.2f} rad from where its load hangs "
                    f"({self._start[k]:.2f} rad). Let it hang freely; if it does, give the reading "
                    "there as hanging=…rad of the load, or measure the joint map's zero."
                )
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
                    for joint in trial.joints if np.isfinite(trial.p_gain) else ():
                        if self._gains.get(joint) != trial.p_gain:
                            bus.set_register(joint, P_REGISTER, int(trial.p_gain))
                            self._gains[joint] = trial.p_gain
                    until = bus.now() + REST_S
                    for _ in self._between.ticks(REST_S):
                        self._command(self._start)
                    bus.sleep_until(until)
                    rows += self._trial(number, trial, writer, done)
                    done += trial.duration_s
                    if np.isfinite(trial.release_s):
                        self._catch(done)
                    self._move_to_start()
            except SafetyStop:
                bus.limp()  # for the loop's own stop, too, which the guard does not see
                raise
            finally:
                bus.park()  # before the disk, which may be slow
            writer.close(
                {"rows": rows, "loop": self._loop.summary()} | bus.report.footer(self._shift_s)
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
        rows, on = 0, True
        for elapsed in self._loop.ticks(trial.duration_s):
            goal = self._start.copy()
            # at the present time, not the planned one: a late tick keeps the phase of the tone
            goal[index] = trial.command(elapsed, self._start[index])
            held = elapsed < trial.release_s
            if held:
                sent = bus.write(goal)
                self._sent, sent_s = sent.position_rad, sent.time_s
            else:  # a command would switch the torque on again
                sent_s = bus.now()
                if on and not bus.torque(False):
                    raise BusError(f"{what}: the torque could not be switched off. {_CHECK_LINE}")
            on = held
            sample = bus.read()
            made: list[dict[str, Any]] = []
            for joint, i in zip(trial.joints, index, strict=True):
                row = {
                    "send_time_s": sent_s + self._shift_s,
                    "read_time_s": float(sample.time_s[i]) + self._shift_s,
                    "trial": number, "joint": joint, "frequency_hz": trial.frequency_hz,
                    "command_rad": float(self._sent[i]),
                    "position_rad": float(sample.position_rad[i]),
                    "position_count": int(sample.position_count[i]),
                }  # fmt: skip
                for name in ("voltage_v", "temperature_c", "load"):
                    values = getattr(sample, name)
                    if values is not None:
                        row[name] = float(values[i])
                if self._on_a_bench:
                    row |= {"p_gain": trial.p_gain, "torque_enabled": float(on)}
                made.append(row)
            with self._loop.spent.on(LOG):
                writer.append(made)
            shown = self._sent if on else np.full(len(goal), np.nan)
            with self._loop.spent.on(VIEWS):
                self._observe(number, Sent(sent_s, shown), sample, self._loop.missed_deadlines)
                self._progress(done + min(elapsed, trial.duration_s), self._total_s, what)
            rows += len(index)
        return rows

    def _catch(self, done: float) -> None:
        """Wait until the limp joints are at rest; then hold them where they are."""
        bus, recent = self._bus, []
        self._progress(done, self._total_s, "waiting for rest")
        for _ in self._between.ticks(REST_WITHIN_S):
            sample = bus.read()
            if np.isfinite(sample.position_rad).all():
                recent.append((bus.now(), sample.position_rad))
            recent = [(t, q) for t, q in recent if t >= bus.now() - REST_FOR_S]
            whole = recent and bus.now() - recent[0][0] > 0.8 * REST_FOR_S and len(recent) > 5
            if whole and np.ptp([q for _, q in recent], axis=0).max() < REST_SPREAD_RAD:
                bus.torque(True)
                self._sent = bus.sent
                return
        raise SafetyStop(
            f"a load still swings {REST_WITHIN_S:.0f} s after it was dropped, so the torque stays "
            "off. Check that the arm is fixed to the servo's horn."
        )

    def _move_to_start(self) -> None:
        """Move from the last command to the start pose on a raised cosine."""
        glide(self._between, self._command, self._sent.copy(), self._start, RETURN_S)

    def _command(self, goal: NDArray[np.float64]) -> None:
        """Command and read without recording; the guard monitors the readings."""
        self._sent = self._bus.write(goal).position_rad
        self._bus.read()
