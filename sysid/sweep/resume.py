"""Recordings that continue an interrupted one, and playback of recorded commands.

A trial is finished if its rows reach its end; the first unfinished one is recorded again from its
start. The recording's clock continues with wall time, from the last change of the file.

A playback is a plan from a CSV of joint angles over time. The file has a column `time_s` and, for
each joint that moves, `<joint>_command_rad` or `<joint>`, absolute angles in radians; other columns
are ignored. A command is held until the next row, as a policy holds its own. A column `loop` (as in
a recorded playback) makes each of its values a trial.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pupper_sysid.common.border import read_text, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import read_table
from pupper_sysid.sysid.recordings.files import as_text, read_bytes
from pupper_sysid.sysid.recordings.table import TITLE, header, parse
from pupper_sysid.sysid.sweep.excitation import LEAD_IN_S, MOST_LOOPS, Plan, TrialPlan

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
    registers: dict[str, int] = {}
    """Of emulated servos, where they differ from the factory's."""
    until: Series | None = None
    """Absent unless the sweep goes on until an interval is narrow."""


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


def header_of(path: Path) -> dict[str, Any]:
    """Header of an unfinished recording, from which its plan can be made again."""
    text = as_text(path, read_bytes(path))
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
    validated(Request, request, f"{path}, header's sweep", remedy="record it again")
    return metadata


def footer(path: Path) -> dict[str, Any]:
    """Footer of a completed recording; empty if it was not completed."""
    return header(path, as_text(path, read_bytes(path))).get("completed", {})


def resume_point(path: Path, plan: Plan, period_s: float) -> Resume:
    """Where `plan`, partly recorded at `path`, continues."""
    written_at = path.stat().st_mtime
    text = as_text(path, read_bytes(path))
    planned = header(path, text).get("excitation") or {}
    present = json.loads(json.dumps(dict(plan.description)))
    if {**planned, "warnings": []} != {**present, "warnings": []}:  # their wording may change
        raise InputError(
            f"{path} was recorded with another plan than its header gives today: the played file, "
            "the joint map or the limits have changed since. Record it again."
        )
    whole = text[: text.rfind("\n") + 1]
    if sum(bool(line.strip()) and line[0] != "#" for line in whole.splitlines()) < 2:
        return Resume(0, 0, 0.0, written_at)
    columns = parse(path, whole).columns
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
    # those of a Mini Pupper in its order, whatever the order of the columns
    order = [j for j in JOINT_NAMES if j in columns] + [j for j in columns if j not in JOINT_NAMES]
    moving = list(dict.fromkeys(order if joints is None else joints))
    missing = [j for j in moving if j not in columns]
    if "time_s" not in table.columns or not moving or missing or not len(table):
        wanted = f"{(missing or ['LF_hip'])[0]}{_ENDING}"
        raise InputError(
            f"{path} is not a file of commands: it needs rows with columns time_s and {wanted}; "
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
