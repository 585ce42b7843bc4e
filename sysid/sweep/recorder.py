"""Execute a plan on a servo bus and record commands and readings; continue what was interrupted.

`record` moves the robot to the start pose, runs the trials at a fixed rate, and returns to the
start pose after each. Every command passes the safety guard, and the recording holds the command
that the guard sent. At the end the robot is always parked, changed gains are set back, and the bus
is closed. Trials of a bench (`sysid.sweep.bench`) may set the P gain and switch the torque off on
the way; afterwards it is on again only once the joints have come to rest.

Rows are written at every tick, so that an interrupted recording can be read up to there and
continued. A trial is finished if its rows reach its end; the first unfinished one is recorded again
from its start. The recording's clock continues with wall time, from the last change of the file.

A playback is a plan from a CSV of joint angles over time. The file has a column `time_s` and, for
each joint that moves, `<joint>_command_rad` or `<joint>`, absolute angles in radians; other columns
are ignored. A command is held until the next row, as a policy holds its own. A column `loop` (as in
a recorded playback) makes each of its values a trial.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pupper_sysid.common.border import read_text, validated
from pupper_sysid.common.errors import BusError, InputError, SafetyStop
from pupper_sysid.common.files import sha256
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES, in_order
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_ROWS, read_table
from pupper_sysid.common.reading.dialect import decoded
from pupper_sysid.hardware.address import EMULATED
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus, header_entries
from pupper_sysid.hardware.loop import LOG, VIEWS, FixedRateLoop, first_pose, glide
from pupper_sysid.hardware.safety.guard import GuardedBus, guarded
from pupper_sysid.sysid.recordings.files import RecordingWriter, read_bytes
from pupper_sysid.sysid.recordings.importers.log import MOST_TRIALS
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad
from pupper_sysid.sysid.recordings.table import TITLE, header, parse
from pupper_sysid.sysid.sweep.bench import parse_load
from pupper_sysid.sysid.sweep.excitation import (
    LEAD_IN_S,
    LOOP_PERIOD_S,
    MOST_LOOPS,
    Plan,
    TrialPlan,
)

_LEAST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 86_400.0  # beyond it the computer's clock was set in between


class Series(BaseModel):
    """Place of a recording among those of a sweep that goes on until an interval is narrow."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    goal: str
    most_seconds: float = Field(gt=0)
    first: str
    """File name of the first recording."""
    joints: list[str]
    """Joints of the first recording."""
    number: int = Field(ge=1, le=1000)


class Request(BaseModel):
    """Options of a sweep, as the command writes them into the header."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    bus: str
    joint_map: str | None
    real_time: bool
    seed: int
    loop_period_s: float = Field(gt=0)
    kind: str
    joints: list[str]
    frequencies_hz: list[float]
    amplitude_rad: float | None
    duration_s: float | None
    playback: str | None
    loops: int = Field(1, ge=1, le=1000)
    """Of a playback; absent in recordings of older versions."""
    plan: str | None = None
    """Plan file that is executed."""
    load: str | None = None
    """Of a bench: a pendulum, or `none`; absent in sweeps of robots."""
    gains: list[int] = []
    """P gains of a bench."""
    until: Series | None = None
    """Absent unless the sweep goes on until an interval is narrow."""
    registers: dict[str, int] = {}
    """Of emulated servos, where they differ from the factory's."""

    @property
    def pendulum(self) -> PendulumLoad | None:
        """The load of a bench, if it has one."""
        return parse_load(self.load) if self.load else None

    @property
    def in_virtual_time(self) -> bool:
        """Whether time passes only for the emulated robot, so that nothing is late."""
        return self.bus == EMULATED and not self.real_time


@dataclass(frozen=True)
class Resume:
    """Where an unfinished recording continues."""

    next_trial: int
    """Number of the first trial to record."""
    rows: int
    """Rows of the finished trials."""
    last_time_s: float
    """Of the file's last row, on the recording's clock."""
    written_at: float
    """`time.time()` of that row."""

    def now_s(self) -> float:
        """The present time on the recording's clock [s]."""
        pause_s = time.time() - self.written_at
        return self.last_time_s + min(max(pause_s, _LEAST_PAUSE_S), _LONGEST_PAUSE_S)


def request_of(path: Path) -> tuple[Request, bool]:
    """Request of a recording to continue, and whether it is a completed round of several."""
    text = decoded(path, read_bytes(path))
    if not text.startswith(TITLE):
        raise InputError(f"{path} is not a recording of pupper-sysid; only those can be continued.")
    metadata = header(path, text)
    request = metadata.get("sweep")
    follows = isinstance(request, dict) and bool(request.get("until"))
    if "completed" in metadata and not follows:
        raise InputError(f"{path} was recorded to its end; there is nothing to continue.")
    if request is None:
        raise InputError(
            f"{path} does not hold its plan (an older version wrote it). Record it again."
        )
    remedy = "record it again"
    request = validated(Request, request, f"{path}, header's sweep", remedy=remedy)
    return request, "completed" in metadata


def footer(path: Path) -> dict[str, Any]:
    """Footer of a completed recording; empty if it was not completed."""
    return header(path, decoded(path, read_bytes(path))).get("completed", {})


def resume_point(path: Path, plan: Plan, period_s: float) -> Resume:
    """Where `plan`, partly recorded at `path`, continues."""
    written_at = path.stat().st_mtime
    text = decoded(path, read_bytes(path))
    planned = header(path, text).get("excitation") or {}
    present = json.loads(json.dumps(dict(plan.description)))
    if {**planned, "warnings": []} != {**present, "warnings": []}:  # their wording may change
        raise InputError(
            f"{path} was recorded with another plan than its header gives today: the played file, "
            "the joint map or the limits have changed since. Record it again."
        )
    complete = text[: text.rfind("\n") + 1]
    if sum(bool(line.strip()) and line[0] != "#" for line in complete.splitlines()) < 2:
        return Resume(0, 0, 0.0, written_at)
    columns = parse(path, complete).columns
    last = float(np.nanmax([columns["send_time_s"], columns["read_time_s"]]))
    rows = 0
    for number, trial in enumerate(plan.trials):
        times = columns["send_time_s"][columns["trial"] == number]
        if (
            not len(times)
            or np.nanmax(times) - np.nanmin(times) < trial.duration_s - 2.5 * period_s
        ):
            return Resume(number, rows, last, written_at)
        rows += len(times)
    return Resume(len(plan.trials), rows, last, written_at)


_ENDING = "_command_rad"
_LARGEST_RAD = 2 * np.pi
_LARGEST_BYTES = 100e6


def playback(path: Path, joints: Sequence[str] | None = None) -> Plan:
    """Plan that repeats the commands in `path`, of all joints that it commands or of some.

    Each joint starts at its first command.
    """
    table = read_table(path, read_text(path, _LARGEST_BYTES), strict=False)
    named = [str(c).removesuffix(_ENDING) for c in table.columns if str(c).endswith(_ENDING)]
    known = JOINT_NAMES if joints is None else joints
    columns: dict[str, str] = {}
    for joint in dict.fromkeys((*known, *named)):
        for name in (f"{joint}{_ENDING}", joint):
            if name in table.columns and joint not in columns:
                columns[joint] = name
    moving = in_order(columns) if joints is None else list(dict.fromkeys(joints))
    missing = [j for j in moving if j not in columns]
    if "time_s" not in table.columns or not moving or missing or not len(table):
        example = f"{(missing or ['LF_hip'])[0]}{_ENDING}"
        raise InputError(
            f"{path} is not a file of commands: it needs rows with columns time_s and {example}; "
            f"it has {len(table)} rows of {', '.join(map(str, table.columns[:8]))}."
        )
    if table.cut:
        raise InputError(f"{path}: its last line is cut short. Copy it again, or remove the line.")
    used = [n for n in ("time_s", *(columns[j] for j in moving), "loop") if n in table.columns]
    fault = next((table.faults[name] for name in used if name in table.faults), None)
    if fault:
        raise InputError(fault)
    numbers = np.stack([table.numbers[name] for name in used], axis=-1)
    bad = np.argwhere(np.isnan(numbers))
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{path}, line {table.line[row]}, column {used[column]} is empty; every command and "
            "time must be a number."
        )
    numbers, loops = numbers[:, : len(moving) + 1], numbers[:, len(moving) + 1 :]
    largest = float(np.abs(numbers[:, 1:]).max())
    if largest > _LARGEST_RAD:
        raise InputError(
            f"{path}: a command of {largest:g} is beyond a full turn; angles must be in radians."
        )
    loops = loops[:, 0] if loops.size else np.zeros(len(table))
    first = numbers[0, 1:]
    trials = []
    starts = np.flatnonzero(np.concatenate([[True], np.diff(loops) != 0]))
    refuse_more(path, len(starts), MOST_LOOPS, "loops")
    if len(np.unique(loops)) < len(starts):
        raise InputError(f"{path}, column loop: the rows of a loop must follow one another.")
    for start, stop in pairwise([*starts, len(numbers)]):
        part = numbers[start:stop]
        time, command = part[:, 0] - part[0, 0], part[:, 1:]
        if len(time) < 2 or not (np.diff(time) > 0).all():
            raise InputError(f"{path}: time_s must increase from row to row within a loop.")
        # the last command is held as long as the others were
        duration = LEAD_IN_S + float(time[-1] + np.median(np.diff(time)))
        trials.append(
            TrialPlan(tuple(moving), float("nan"), duration, _held(time, command - first))
        )
    rest = DEFAULT_POSE if set(moving) <= set(DEFAULT_POSE) else {}
    pose = dict(rest) | {j: float(x) for j, x in zip(moving, first, strict=True)}
    description = {"kind": "playback", "file": path.name, "sha256": sha256(path)}
    return Plan(tuple(trials), pose, description | {"lead_in_s": LEAD_IN_S})


def _held(time: NDArray[np.float64], value: NDArray[np.float64]):
    """Zero-order hold of rows, after the lead-in at rest."""

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        t = np.asarray(t, float) - LEAD_IN_S
        index = np.searchsorted(time, t + 1e-9, side="right") - 1
        return np.where((index < 0)[:, None], 0.0, value[np.maximum(index, 0)])

    return offset


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
        self, bus: GuardedBus, plan: Plan, period_s: float, resume: Resume | None,
        progress: Progress | None, observe: Observe | None,
    ):  # fmt: skip
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
            excitation = {
                "excitation": dict(self._plan.description),
                "joints": [j for j in bus.joint_names if j in moving],
                "start_pose_rad": dict(zip(bus.joint_names, map(float, self._start), strict=True)),
                "loop": {"period_s": self._loop.period_s},
            }
            about = header_entries(bus) | excitation | metadata
            writer = RecordingWriter(path, about, force)
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
            rows_written: list[dict[str, Any]] = []
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
                rows_written.append(row)
            with self._loop.spent.on(LOG):
                writer.append(rows_written)
            in_force = self._sent if on else np.full(len(goal), np.nan)
            with self._loop.spent.on(VIEWS):
                self._observe(number, Sent(sent_s, in_force), sample, self._loop.missed_deadlines)
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
            observed = recent and bus.now() - recent[0][0] > 0.8 * REST_FOR_S and len(recent) > 5
            if observed and np.ptp([q for _, q in recent], axis=0).max() < REST_SPREAD_RAD:
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
