"""Layouts of other people's logs, recognised by their columns and turned into tidy rows.

* one joint, tones one after another, times restarting with each: `time_s, freq_hz, motor_idx,
  command_rad, actual_rad`, angles relative to the standing pose (the SpotDMouse sweep script);
* twelve joints played back: `time_s, loop`, then `<joint>_command_rad, <joint>_position_rad`.

Angles come out absolute. Both say when the loop turned, not when the position was
read; reading is taken to follow sending by `READ_AFTER_SEND_S`, and the metadata say so.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from common.errors import InputError
from common.joints import DEFAULT_POSE, JOINT_NAMES
from sysid.recording_table import (
    OPTIONAL_COLUMNS,
    REQUIRED_COLUMNS,
    Parsed,
    numbers,
    refuse_degrees,
    refuse_fractions,
    require,
    unknown_joint,
)

READ_AFTER_SEND_S = 0.0005
PAUSE_S = 0.5
"""Return to the start pose between tones of the sweep script, not in its file."""

COMMAND_QUANTUM_RAD = math.pi / 550

# Direction of the count with the angle, per leg: facts of the Mini Pupper 2's servo mounting.
_COUNT_FALLS = {
    "hip": {"LF": True, "RF": True, "LB": False, "RB": False},
    "thigh": {"LF": True, "RF": False, "LB": True, "RB": False},
    "calf": {"LF": True, "RF": False, "LB": True, "RB": False},
}

# Angle of the count in the middle, absolute: the standing pose in whole degrees.
_ZERO_RAD = {"hip": 0.0, "thigh": math.pi / 4, "calf": -math.pi / 2}

_SWEEP = ("time_s", "freq_hz", "motor_idx", "command_rad", "actual_rad")
_PLAYBACK = ("time_s", "loop")
_COMMAND, _POSITION = "_command_rad", "_position_rad"
_NOT_NEEDED = ("phase", "amp_rad", "signal", "global_step", "csv_step")


def convert(path: Path, parsed: Parsed) -> tuple[pd.DataFrame, dict[str, Any], list[str]]:
    """Tidy table, metadata and warnings of a parsed file of any known layout.

    The table is indexed by the line of the file.

    Raises
    ------
    InputError
        If the columns belong to no known layout, or a cell is no number.
    """
    columns = set(parsed.columns)
    if not columns & {"send_time_s", "read_time_s"}:
        if any(c.endswith((_COMMAND, _POSITION)) for c in columns):
            return _playback(path, parsed)
        if len(columns & set(_SWEEP)) > len(columns & set(REQUIRED_COLUMNS)):
            return _sweep(path, parsed)
    require(path, columns := list(parsed.columns), REQUIRED_COLUMNS)
    wanted = [c for c in (*REQUIRED_COLUMNS, *OPTIONAL_COLUMNS) if c in columns]
    table = numbers(path, parsed, [c for c in wanted if c != "joint"])
    table["joint"] = parsed.columns["joint"]
    return table.reindex(columns=wanted), parsed.metadata, []


def rounding(joint: str) -> str:
    """Where `int()` of the count moves the angle of `joint`: "up" if counts fall as angles rise."""
    leg, kind = joint.split("_")
    return "up" if _COUNT_FALLS[kind][leg] else "down"


def _sweep(path: Path, parsed: Parsed) -> tuple[pd.DataFrame, dict[str, Any], list[str]]:
    require(path, parsed.columns, _SWEEP, _NOT_NEEDED)
    table = numbers(path, parsed, _SWEEP)
    warnings: list[str] = []
    placed = ~np.isnan(table[["time_s", "freq_hz", "motor_idx"]].to_numpy()).any(axis=1)
    if not placed.any():
        raise InputError(f"{path}: no row has all of time_s, freq_hz, motor_idx. Record it again.")
    if not placed.all():
        warnings.append(f"{(~placed).sum()} rows without time, tone or joint were left out.")
        table = table.loc[placed]
    lines, motor = table.index.to_numpy(), table["motor_idx"].to_numpy()
    refuse_fractions(path, "motor_idx", lines, motor)
    for column in ("command_rad", "actual_rad"):
        refuse_degrees(path, column, lines, table[column].to_numpy())
    wrong = np.flatnonzero((motor < 0) | (motor >= len(JOINT_NAMES)))
    if len(wrong):
        raise InputError(
            f"{path}, line {lines[wrong[0]]}, column motor_idx: {motor[wrong[0]]:g} is no joint; "
            f"they are numbered 0 ({JOINT_NAMES[0]}) to {len(JOINT_NAMES) - 1} "
            f"({JOINT_NAMES[-1]}). Mend the cell."
        )
    names = np.array(JOINT_NAMES)[motor.astype(int)]
    time, trial = _in_one_time(table)
    pose = np.array([DEFAULT_POSE[name] for name in names])
    tidy = pd.DataFrame(
        {
            "send_time_s": time,
            "read_time_s": time + READ_AFTER_SEND_S,
            "trial": trial,
            "joint": names,
            "frequency_hz": table["freq_hz"].to_numpy(),
            "command_rad": table["command_rad"].to_numpy() + pose,
            "position_rad": table["actual_rad"].to_numpy() + pose,
        },
        index=table.index,
    )
    joints = [j for j in JOINT_NAMES if j in names]
    metadata = _metadata("single-joint sweep", joints)
    metadata["start_pose_rad"] = {j: DEFAULT_POSE[j] for j in joints}
    return tidy, metadata, warnings


def _in_one_time(table: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Times that rise over the whole file, and the number of the trial each row is of."""
    time = table["time_s"].to_numpy()
    step = np.diff(time)
    pace = np.median(step[step > 0]) if (step > 0).any() else 0.0
    changed = (np.diff(table[["freq_hz", "motor_idx"]].to_numpy(), axis=0) != 0).any(axis=1)
    # a tone repeated begins where tones begin; any other way back is a clock that went wrong
    restarted = changed | ((step < 0) & (time[1:] < time[0] + pace))
    trial = np.concatenate([[0], np.cumsum(restarted)])
    shifted, last = time.copy(), -PAUSE_S
    for n in range(trial[-1] + 1):
        rows = trial == n
        if n:
            shifted[rows] += last + PAUSE_S - time[rows].min()
        last = shifted[rows].max()
    return shifted, trial


def _playback(path: Path, parsed: Parsed) -> tuple[pd.DataFrame, dict[str, Any], list[str]]:
    found = [c for c in parsed.columns if c.endswith((_COMMAND, _POSITION))]
    for name in found:
        joint = name.removesuffix(_COMMAND).removesuffix(_POSITION)
        if joint not in JOINT_NAMES:
            raise InputError(f"{path}, column {name}: {unknown_joint(joint)}")
    joints = [j for j in JOINT_NAMES if {j + _COMMAND, j + _POSITION} & set(found)]
    needed = [*_PLAYBACK, *(j + what for j in joints for what in (_COMMAND, _POSITION))]
    require(path, parsed.columns, needed, (*found, *_NOT_NEEDED))
    table = numbers(path, parsed, needed)
    lines = table.index.to_numpy()
    refuse_fractions(path, "loop", lines, table["loop"].to_numpy())
    for column in needed[len(_PLAYBACK) :]:
        refuse_degrees(path, column, lines, table[column].to_numpy())
    parts = [
        pd.DataFrame(
            {
                "send_time_s": table["time_s"],
                "read_time_s": table["time_s"] + READ_AFTER_SEND_S,
                "trial": table["loop"],
                "joint": joint,
                "frequency_hz": np.nan,
                "command_rad": table[joint + _COMMAND],
                "position_rad": table[joint + _POSITION],
            }
        )
        for joint in joints
    ]
    return pd.concat(parts), _metadata("12-joint playback", joints), []


def _metadata(layout: str, joints: list[str]) -> dict[str, Any]:
    return {
        "imported_from": layout,
        "read_after_send_s": READ_AFTER_SEND_S,
        "joints": joints,
        "bus": {
            "kind": "esp32 proxy",
            "command_quantum_rad": COMMAND_QUANTUM_RAD,
            "command_rounding": {j: rounding(j) for j in joints},
        },
    }
