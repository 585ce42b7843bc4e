"""Tables of known columns, turned into tidy rows: this project's, two of the Mini Pupper, others'.

* one Mini Pupper joint, tones one after another, times restarting with each: `time_s, phase,
  freq_hz, motor_idx, signal, command_rad, actual_rad`, angles relative to the standing pose (the
  SpotDMouse sweep script);
* Mini Pupper joints played back: `time_s, loop`, then `<joint>_command_rad, <joint>_position_rad`
  with the names of its joints;
* any other table with a time, commands and positions (`importers.tables`).

Pose, counts and bus of the Mini Pupper are taken for the first two only. They log the time of the
loop, not of the read; a read is assumed `READ_AFTER_SEND_S` after the command was sent, and the
metadata say so.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sysid.recordings.importers.log import MOST_TRIALS, Table
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.refusals import unknown_columns, unknown_numbers
from pupper_sysid.sysid.recordings.importers.tables import read_table, spread
from pupper_sysid.sysid.recordings.importers.times import PAUSE_S, READ_AFTER_SEND_S
from pupper_sysid.sysid.recordings.table import REQUIRED_COLUMNS, Parsed, require

SWEEP = ("time_s", "freq_hz", "motor_idx", "command_rad", "actual_rad")
PLAYBACK = ("time_s", "loop")


def convert(
    path: Path | str, parsed: Parsed, options: LogOptions | None = None
) -> tuple[pd.DataFrame, dict[str, Any], list[str]]:
    """Tidy table, metadata and warnings of a parsed file of any known layout."""
    options = options or LogOptions()
    columns = {*parsed.table.columns, *parsed.faults}
    if {"send_time_s", "read_time_s"} & columns and not options.command:
        require(path, parsed.table, REQUIRED_COLUMNS)
        options.refuse("recording of this project", ())
        return parsed.table, parsed.metadata, []
    if is_sweep(columns) and not options.command:
        require(path, parsed.table, SWEEP)
        options.refuse("Mini Pupper sweep", ())
        return _sweep(path, parsed)
    own = [j for j in JOINT_NAMES if {f"{j}_command_rad", f"{j}_position_rad"} & columns]
    if own and not options.command:
        require(path, parsed.table, PLAYBACK)
        options.refuse("Mini Pupper playback", ())
        return _playback(path, parsed)
    table = spread(path, _table(parsed), options)
    if not options.command:
        if parsed.numbered:
            raise InputError(f"{path}: {unknown_numbers(path, table)}")
        timed = bool(options.time or options.rate)
        if text := unknown_columns(path, table, timed):
            raise InputError(f"{path}: {text}")
    log = read_table(path, table, options)
    # what the log's own header says of its robot counts
    metadata = log.metadata | parsed.metadata
    metadata["bus"] = log.metadata["bus"] | (parsed.metadata.get("bus") or {})
    return log.table, metadata, log.warnings


def is_sweep(columns: set[str]) -> bool:
    """Whether these are columns of the Mini Pupper's sweep script."""
    return (
        "motor_idx" in columns
        and bool({"actual_rad", "freq_hz"} & columns)
        and (bool({"signal", "phase"} & columns))
    )


def _table(parsed: Parsed) -> Table:
    """Columns of a parsed file, those of text apart."""
    numbers, texts = {}, {}
    for name in parsed.table.columns:
        values = parsed.table[name]
        if not pd.api.types.is_numeric_dtype(values):
            texts[str(name)] = [str(v) for v in values.to_numpy(object)]  # 5 times as fast
            if name == "":
                texts["time"] = texts.pop("")
        else:
            numbers[str(name)] = values.to_numpy(float)
    return Table(numbers, texts, parsed.faults, numbered=parsed.numbered, rate=parsed.rate,
                 tick_s=parsed.tick_s, units=parsed.units)  # fmt: skip


def _metadata(layout: str, joints: list[str], pose: dict[str, float] | None) -> dict[str, Any]:
    servos = load_joint_map("mini_pupper_2").per_servo().select(joints)
    # int() of the count: the angle goes up where counts fall as angles rise
    moved = ["up" if sign < 0 else "down" for sign in servos.sign()]
    metadata: dict[str, Any] = {
        "imported_from": layout,
        "read_after_send_s": READ_AFTER_SEND_S,
        "joints": joints,
        "bus": {
            "kind": "esp32 proxy",
            # both scripts add a joint's deviation to its own servo, a calf's to the absolute one
            "coordinates": "servo",
            "command_quantum_rad": dict(zip(joints, 1 / servos.counts_per_rad(), strict=True)),
            "command_rounding": dict(zip(joints, moved, strict=True)),
            "count_zero_rad": dict(zip(joints, servos.zero_rad(), strict=True)),
        },
    }
    if pose is not None:
        metadata["start_pose_rad"] = pose
    return metadata


def _sweep(path: Path | str, parsed: Parsed) -> tuple[pd.DataFrame, dict[str, Any], list[str]]:
    table = parsed.table
    index = table["motor_idx"].to_numpy()
    if not np.isin(index, np.arange(len(JOINT_NAMES))).all():
        raise InputError(f"{path}, column motor_idx: joints are numbered 0 to 11.")
    names = np.array(JOINT_NAMES)[index.astype(int)]
    time = table["time_s"].to_numpy()
    # a new tone or another joint starts a trial, and the clock again
    changed = (np.diff(table["freq_hz"].to_numpy()) != 0) | (np.diff(index) != 0)
    restarted = changed | (np.diff(time) < -0.5)
    starts = np.concatenate([[0], 1 + np.flatnonzero(restarted)])
    refuse_more(path, len(starts), MOST_TRIALS, "trials", "Split it by joint or by trial.")
    trial, shift, last = np.zeros(len(time)), np.zeros(len(time)), 0.0
    for n, (start, stop) in enumerate(pairwise([*starts, len(time)])):
        own = time[start:stop]
        if not np.isfinite(own).any():  # `check` leaves rows without a time out
            continue
        trial[start:stop] = n
        shift[start:stop] = last - np.nanmin(own) if n else 0.0
        last = float(np.nanmax(own) + shift[start]) + PAUSE_S
    pose = np.array([DEFAULT_POSE[name] for name in names])
    tidy = pd.DataFrame(
        {
            "send_time_s": time + shift,
            "read_time_s": time + shift + READ_AFTER_SEND_S,
            "trial": trial,
            "joint": names,
            "frequency_hz": table["freq_hz"].to_numpy(),
            "command_rad": table["command_rad"].to_numpy() + pose,
            "position_rad": table["actual_rad"].to_numpy() + pose,
        }
    )
    joints = [j for j in JOINT_NAMES if j in names]
    metadata = _metadata("single-joint sweep", joints, {j: DEFAULT_POSE[j] for j in joints})
    return tidy, metadata, []


def _playback(path: Path | str, parsed: Parsed) -> tuple[pd.DataFrame, dict[str, Any], list[str]]:
    table = parsed.table
    joints = [
        j for j in JOINT_NAMES if {f"{j}_command_rad", f"{j}_position_rad"} & {*table.columns}
    ]
    parts = []
    for joint in joints:
        require(path, table, (f"{joint}_command_rad", f"{joint}_position_rad"))
        parts.append(
            pd.DataFrame(
                {
                    "send_time_s": table["time_s"],
                    "read_time_s": table["time_s"] + READ_AFTER_SEND_S,
                    "trial": table["loop"],
                    "joint": joint,
                    "frequency_hz": np.nan,
                    "command_rad": table[f"{joint}_command_rad"],
                    "position_rad": table[f"{joint}_position_rad"],
                }
            )
        )
    return pd.concat(parts, ignore_index=True), _metadata("12-joint playback", joints, None), []
