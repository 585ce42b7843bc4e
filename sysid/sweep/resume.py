"""Continuation of an interrupted recording: its next trial, and the time on its clock.

A trial is finished if its rows reach its end; the first unfinished one is recorded again from its
start. The recording's clock continues with wall time, from the last change of the file.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from pupper_sysid.common.border import validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.files import as_text, read_bytes
from pupper_sysid.sysid.recordings.table import TITLE, header, parse
from pupper_sysid.sysid.sweep.excitation import Plan

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
    """Where an unfinished recording continues.

    Attributes
    ----------
    next_trial : int
        Number of the first trial to record.
    rows : int
        Rows of the finished trials.
    last_time_s : float
        Of the file's last row, on the recording's clock.
    written_at : float
        `time.time()` of that row.
    """

    next_trial: int
    rows: int
    last_time_s: float
    written_at: float

    def now_s(self) -> float:
        """The present time on the recording's clock [s]."""
        pause_s = time.time() - self.written_at
        return self.last_time_s + min(max(pause_s, _LEAST_PAUSE_S), _LONGEST_PAUSE_S)


def header_of(path: Path) -> dict[str, Any]:
    """Header of an unfinished recording, from which its plan can be made again.

    Raises
    ------
    InputError
        If it is not a recording of this project, was completed (and nothing follows it), or does
        not hold its plan.
    """
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
    """Where `plan`, partly recorded at `path`, continues.

    Raises
    ------
    InputError
        If the recording cannot be read, or was made with another plan.
    """
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
    table = parse(path, whole).table
    last = float(np.nanmax(table[["send_time_s", "read_time_s"]].to_numpy()))
    rows = 0
    for number, trial in enumerate(plan.trials):
        times = table["send_time_s"].to_numpy()[table["trial"].to_numpy() == number]
        if (
            not len(times)
            or np.nanmax(times) - np.nanmin(times) < trial.duration_s - 2.5 * period_s
        ):
            return Resume(number, rows, last, written_at)
        rows += len(times)
    return Resume(len(plan.trials), rows, last, written_at)
