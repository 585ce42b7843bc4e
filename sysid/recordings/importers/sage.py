"""SAGE folders (isaac-sim2real/sage): a robot's motion as `control.csv` and `state_motor.csv`.

`control.csv` has `type, timestamp, positions`, `state_motor.csv` besides `velocities, torques`:
times in µs, a list with a number per joint in each cell, joints named by the lines of
`joint_list.txt`, angles in rad.

The collector of the SO-101 arm stamps a whole turn with one time. It then writes six goals one by
one, and reads position, speed and current joint after joint, so joint k is read some 2 ms after
joint k−1. Where both files have the same stamps and an SO-101's joints, that order is restored.
It also writes the servos' gains before each motion, which are not in the log.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_CELLS, column_names, read_table
from pupper_sysid.common.reading.dialect import decoded
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.log import (
    Log,
    held_commands,
    joint_names,
    read_files,
    rows,
)
from pupper_sysid.sysid.recordings.importers.options import scale_by_step
from pupper_sysid.sysid.recordings.importers.times import doubt_of_a_turn

LAYOUT = "SAGE folder"

_CONTROL, _STATE, _JOINTS = "control.csv", "state_motor.csv", "joint_list.txt"
_SO101 = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
_SETUP = {"model": "STS3215", "p_gain": 16, "i_gain": 0, "d_gain": 32}  # its collector writes these
_TRANSACTION_S = 0.00075  # a write or read of one servo over USB: 24 of them fit into a turn
_DOUBT_S = 0.0015  # of the time between a joint's write and its read
_JAW = "Jaw"  # logged as a share of its range


def is_sage(folder: Path) -> bool:
    """Whether `folder` holds such a log."""
    return (folder / _CONTROL).is_file() and (folder / _STATE).is_file()


def read_sage(folder: Path) -> Log:
    """The folder's motion as rows, one trial."""
    paths = [folder / name for name in (_CONTROL, _STATE, _JOINTS)]
    contents, digest = read_files(folder, paths)
    lines = decoded(paths[2], contents[paths[2]]).splitlines()
    names = joint_names(paths[2], [line for line in lines if line.strip()])
    if not names:
        raise InputError(f"{paths[2]} names no joint. Write one per line.")
    sent, commands = _table(paths[0], contents[paths[0]], len(names))
    stamped, positions = _table(paths[1], contents[paths[1]], len(names))
    metadata: dict[str, Any] = {"imported_from": LAYOUT, "joints": names, "readings": "live"}
    warnings: list[str] = []
    same = len(sent) == len(stamped) and bool(np.all(sent == stamped))
    if same and tuple(names) == _SO101:
        # all goals are written, then each joint's position, speed and current are read
        middle, each = 0.5 * _TRANSACTION_S, _TRANSACTION_S
        turns = [
            (sent + k * each + middle, sent + (len(names) + 3 * k) * each + middle)
            for k in range(len(names))
        ]
        metadata["bus"] = {"read_time_doubt_s": _DOUBT_S}
        metadata["servos"] = {name: dict(_SETUP) for name in names}
    elif same:
        turns = [(sent, sent)] * len(names)
        doubt, text = doubt_of_a_turn(sent)
        metadata["bus"] = {"read_time_doubt_s": doubt}
        warnings.append(text)
    else:
        sent, commands, kept = held_commands(sent, commands, stamped)
        stamped, positions = stamped[kept], positions[kept]
        turns = [(sent, stamped)] * len(names)
    parts = []
    for k, name in enumerate(names):
        scale = 1.0
        if name == _JAW:
            scale, text = scale_by_step(positions[:, k], nominal=np.pi / 2)
            metadata["assumed_units"] = {name: text}
            warnings.append(
                f"{name} is logged as a share of its range, 0 … 1, not in rad: {text}. Lag and "
                "dead time do not depend on it."
            )
        send, read = turns[k]
        parts.append(rows(name, send, read, scale * commands[:, k], scale * positions[:, k]))
    return Log(pd.concat(parts, ignore_index=True), metadata, warnings, digest)


def _table(path: Path, data: bytes, joints: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times [s] and positions, shape (rows, joints), of one of the two tables."""
    text = decoded(path, data)
    refuse_more(path, text.count("\n") * joints, MOST_CELLS, "values", "Split the log.")
    names = column_names(path, text)
    lacking = [c for c in ("timestamp", "positions") if c not in names]
    if lacking:
        raise InputError(
            f"{path}: column {', '.join(lacking)} is missing; it has "
            f"{printable(', '.join(names)[:200])}. A SAGE table needs timestamp and positions."
        )
    parsed = read_table(path, text, [name for name in names if name != "timestamp"])
    if not len(parsed):
        raise InputError(f"{path} has column names but no rows. Record it again.")
    times, values = parsed.numbers["timestamp"], []
    for line, time, cell in zip(parsed.line, times, parsed.texts["positions"], strict=True):
        try:
            angles = np.array(json.loads(cell), float)
            if angles.shape != (joints,) or not np.isfinite([time, *angles]).all():
                raise ValueError
        except (ValueError, TypeError, RecursionError, OverflowError):
            raise InputError(
                f"{path}, line {line}: {printable(cell[:40])} at {time:g} where a time and a list "
                f"of {joints} numbers, one per joint of {_JOINTS}, belong. Mend or remove the line."
            ) from None
        values.append(angles)
    return 1e-6 * times, np.array(values)
