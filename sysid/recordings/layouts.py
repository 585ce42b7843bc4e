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

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sysid.recordings.importers.log import MOST_TRIALS, Log, Table, rows
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.refusals import unknown_columns, unknown_numbers
from pupper_sysid.sysid.recordings.importers.tables import read_table, spread
from pupper_sysid.sysid.recordings.importers.times import PAUSE_S, READ_AFTER_SEND_S
from pupper_sysid.sysid.recordings.table import REQUIRED_COLUMNS, require

SWEEP = ("time_s", "freq_hz", "motor_idx", "command_rad", "actual_rad")
PLAYBACK = ("time_s", "loop")


def convert(path: Path | str, table: Table, options: LogOptions | None = None) -> Log:
    """Rows of a table of any known layout."""
    options = options or LogOptions()
    names = {*table.names}
    times = [n for n in ("read_time_s", "send_time_s") if n in names]
    foreign = not {"joint", "command_rad", "position_rad"} & names
    if times and foreign and not (options.time or options.command_time):
        # this project's names of times, and the columns of another
        both = len(times) == 2
        options = replace(options, time=times[0], command_time=times[1] if both else None)
    elif times and not options.command:
        require(path, table, REQUIRED_COLUMNS)
        options.refuse("recording of this project", ())
        columns = {n: table.numbers(path, n) for n in table.columns} | {**table.texts}
        tidy = pd.DataFrame({n: columns[n] for n in dict.fromkeys((*REQUIRED_COLUMNS, *columns))})
        return Log(tidy, {**table.metadata}, [*table.notes])
    sweep = {"signal", "phase"} & names and {"actual_rad", "freq_hz"} & names
    if "motor_idx" in names and sweep and not options.command:
        require(path, table, SWEEP)
        options.refuse("Mini Pupper sweep", ())
        return _sweep(path, table)
    joints = [j for j in JOINT_NAMES if {f"{j}_command_rad", f"{j}_position_rad"} & names]
    if joints and not options.command:
        require(path, table, PLAYBACK)
        options.refuse("Mini Pupper playback", ())
        return _playback(path, table, joints)
    table = spread(path, table, options)
    if not options.command:
        if table.numbered:
            raise InputError(f"{path}: {unknown_numbers(path, table)}")
        timed = bool(options.time or options.rate)
        if text := unknown_columns(path, table, timed):
            raise InputError(f"{path}: {text}")
    log = read_table(path, table, options)
    # what the log's own header says of its robot counts
    metadata = log.metadata | {**table.metadata}
    metadata["bus"] = log.metadata["bus"] | (table.metadata.get("bus") or {})
    return replace(log, metadata=metadata)


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


def _sweep(path: Path | str, table: Table) -> Log:
    index, time, frequency_hz, commands, positions = (
        table.numbers(path, name)
        for name in ("motor_idx", "time_s", "freq_hz", "command_rad", "actual_rad")
    )
    if not np.isin(index, np.arange(len(JOINT_NAMES))).all():
        raise InputError(f"{path}, column motor_idx: joints are numbered 0 to 11.")
    names = np.array(JOINT_NAMES)[index.astype(int)]
    # a new tone or another joint starts a trial, and the clock again
    changed = (np.diff(frequency_hz) != 0) | (np.diff(index) != 0)
    starts = np.concatenate([[0], 1 + np.flatnonzero(changed | (np.diff(time) < -0.5))])
    refuse_more(path, len(starts), MOST_TRIALS, "trials", "Split it by joint or by trial.")
    trial, shift, last = np.zeros(len(time)), np.zeros(len(time)), 0.0
    for n, (start, stop) in enumerate(pairwise([*starts, len(time)])):
        trial_time = time[start:stop]
        if not np.isfinite(trial_time).any():  # `check` leaves rows without a time out
            continue
        trial[start:stop] = n
        shift[start:stop] = last - np.nanmin(trial_time) if n else 0.0
        last = float(np.nanmax(trial_time) + shift[start]) + PAUSE_S
    sent = time + shift
    pose = np.array([DEFAULT_POSE[name] for name in names])
    joints = [j for j in JOINT_NAMES if j in names]
    tidy = rows("", sent, sent + READ_AFTER_SEND_S, commands + pose, positions + pose, trial)
    tidy["joint"], tidy["frequency_hz"] = names, frequency_hz
    metadata = _metadata("single-joint sweep", joints, {j: DEFAULT_POSE[j] for j in joints})
    return Log(tidy, metadata, [*table.notes])


def _playback(path: Path | str, table: Table, joints: list[str]) -> Log:
    time, loop = table.numbers(path, "time_s"), table.numbers(path, "loop")
    parts = []
    for joint in joints:
        columns = (f"{joint}_command_rad", f"{joint}_position_rad")
        require(path, table, columns)
        command, position = (table.numbers(path, name) for name in columns)
        parts.append(rows(joint, time, time + READ_AFTER_SEND_S, command, position, loop))
    metadata = _metadata("12-joint playback", joints, None)
    return Log(pd.concat(parts, ignore_index=True), metadata, [*table.notes])
