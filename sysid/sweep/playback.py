"""Playback of recorded commands: a plan from a CSV of joint angles over time.

The file has a column `time_s` and, for each joint that moves, `<joint>_command_rad` or `<joint>`,
absolute angles in radians; other columns are ignored. A command is held until the next row, as a
policy holds its own. A column `loop` (as in a recorded playback) makes each of its values a trial.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import read_table
from pupper_sysid.sysid.sweep.excitation import LEAD_IN_S, MOST_LOOPS, Plan, TrialPlan

_ENDING = "_command_rad"
_LARGEST_RAD = 2 * np.pi
_LARGEST_BYTES = 100e6


def playback(path: Path, joints: Sequence[str] | None = None) -> Plan:
    """Plan that repeats the commands in `path`; each joint starts at its first command.

    Parameters
    ----------
    path : Path
    joints : sequence of str, optional
        Joints to move; by default all that the file commands.

    Raises
    ------
    InputError
        If the file cannot be read, lacks a column, or has values that are not angles or times.
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
