"""The sentences on a log of no known layout: every layout, and what is missing for it."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import column, columns_of, time_columns
from pupper_sysid.sysid.recordings.importers.tables import (
    Table,
    import_line,
    is_timed,
    known,
    lines_by_value,
    missing,
    rate_note,
    unit_of,
)

OURS = (
    "send_time_s", "read_time_s", "trial", "joint", "frequency_hz", "command_rad", "position_rad",
)  # fmt: skip
SWEEP = ("time_s", "freq_hz", "motor_idx", "signal", "command_rad", "actual_rad")
PLAYBACK = ("time_s", "loop", "LF_hip_command_rad", "LF_hip_position_rad")
_CURRENT = re.compile(r"cur(r|rent)?(?![A-Za-z])", re.IGNORECASE)
_IMU = {"gx", "gy", "gz", "ax", "ay", "az"}

FILES = (
    "SAGE folder (control.csv, state_motor.csv, joint_list.txt)",
    "LeRobot dataset (folder with meta/info.json and data/**/*.parquet)",
    "rosbag2 folder or MCAP file (JointState, and commands as JointTrajectory, Float64MultiArray "
    "or JointState)",
    "BAM or K-Scale JSON (entries[].timestamp, position, goal_position)",
    "ktune JSON (data[].time_since_start, position, commanded_position)",
    "NumPy .npz or parquet with the columns of a table",
)
"""Layouts other than tables of text."""


def unknown_columns(path: Path | str, table: Table, timed: bool = False) -> str:
    """Why a table has no known layout; empty where it may have one.

    Tabular layouts that share columns with it are listed with those that it lacks. `timed` tables
    have their times from elsewhere.
    """
    names = table.names
    own = set(names)
    lacks_pair = missing(names)
    timed = timed or is_timed(table)
    if lacks_pair == "" and timed:
        return ""
    if {n.lower() for n in own} >= _IMU and lacks_pair.startswith("no column"):
        return (
            "it holds an IMU's readings (gx … az), and no commands and positions of joints, so "
            "nothing of a servo can be measured with it. Give a log of commands and positions."
        )
    lacks = [lacks_pair] if lacks_pair else []
    lacks += [] if timed else ["no column is a time (time, timestamp, t …)"]
    parts = [
        f"any table: {' and '.join(lacks)}",
        *(
            f"{layout}: {', '.join(c for c in columns if c not in own)} missing"
            for layout, columns in (
                ("recording of this project", OURS),
                ("Mini Pupper sweep", SWEEP),
                ("Mini Pupper playback", PLAYBACK),
            )
            if own & {*columns}
        ),
    ]
    lines = _examples(path, table, timed)
    rest = "" if lines else f" Other layouts: {'; '.join(FILES)}."
    return (
        f"its columns ({_listed(names)}) belong to no known layout. {'; '.join(parts)}. "
        f"{_hint(names)}Name the columns{lines} with `pupper-sysid import` --time (or --rate, the "
        f"rows a second), --command and --position.{rest}"
    )


def _examples(path: Path | str, table: Table, timed: bool) -> str:
    """Command lines that take columns whose names say nothing for what is missing."""
    names = table.names
    columns = columns_of(names)
    times = time_columns(names)[:1]
    times = times or [n for n in table.increasing if column(n).kind != "position"][:1]
    if not times and (len(columns) > 2 or timed):  # of another event
        still = [n for n in table.columns if np.ptp(known(table, n)) == 0]
        other = [c for c in columns if c.kind in ("time", "unknown") and c.name not in still]
        times = [c.name for c in other][:1]
    when = {"time": times[0]} if times else {"rate": f"{table.rate or 50:g}"}
    numbered = Counter(re.sub(r"\d+", "{joint}", c.name, count=1) for c in columns)
    by_kind = {}
    for kind in ("command", "position"):
        sure = [c for c in columns if c.kind == kind]
        if kind == "command" and not sure:  # qd beside q may be the desired angle
            sure = [c for c in columns if c.name[-1:] == "d" and c.name[:-1] in names]
        if kind == "position" and not sure:  # beside a command a bare `current` may be a place
            sure = [c for c in columns if not c.kind and _CURRENT.search(c.name)]
        chosen = [c.template for c in sure]
        for others in ("unknown", "time"):
            chosen = chosen or [
                every if numbered[every := re.sub(r"\d+", "{joint}", c.name, count=1)] > 1 else
                c.template
                for c in columns if c.kind == others and c.name not in times
            ]  # fmt: skip
        by_kind[kind] = chosen
    lines = [
        import_line(path, **when, **unit_of(table, (c, p)), command=c, position=p)
        for c, p in product(by_kind["command"], by_kind["position"])
        if c != p
    ]
    lines = lines or lines_by_value(path, table)
    listed = "; or ".join(list(dict.fromkeys(lines))[:3])
    return f" ({listed}{rate_note(when, table)})" if lines else ""


def unknown_json(keys: Iterable[str]) -> str:
    """Why JSON has no known layout."""
    own = set(map(str, keys))
    return (
        f"it is JSON of no known layout; it has {_listed(sorted(own)) or 'no keys'}. BAM or "
        f"K-Scale: {_lack(own, ('entries',))}; ktune: {_lack(own, ('config', 'data'))}. Other "
        f"layouts: {'; '.join(FILES)}; a table as CSV."
    )


def unknown_folder(names: Iterable[str]) -> str:
    """Why a folder has no known layout."""
    own = set(names)
    sage = ("control.csv", "state_motor.csv", "joint_list.txt")
    return (
        f"it is a folder without a log: it has {_listed(sorted(own)[:20]) or 'nothing'}. SAGE: "
        f"{_lack(own, sage)}; LeRobot: {_lack(own, ('meta', 'data'))}; rosbag2: "
        f"{_lack(own, ('metadata.yaml',))}. Give a log's file or folder."
    )


def _lack(own: set[str], wanted: Sequence[str]) -> str:
    lacking = [name for name in wanted if name not in own]
    return f"{', '.join(lacking)} missing" if lacking else "not as expected inside"


def _hint(names: Sequence[str]) -> str:
    """A column that may be a misspelt one of this project."""
    for name in names:
        near = difflib.get_close_matches(name, [n for n in OURS if n not in names], 1, 0.8)
        if near:
            return f"Was '{printable(name)[:40]}' meant as {near[0]}? Rename it. "
    return ""


def _listed(names: Sequence[str]) -> str:
    return printable(", ".join(map(str, names)))[:300]
