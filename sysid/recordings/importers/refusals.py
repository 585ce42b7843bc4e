"""Why a log is not read, and the `import` lines with which it is.

A line takes columns by their names where these say enough, else those whose values go together as a
command and its position do.
"""

from __future__ import annotations

import difflib
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations, permutations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.reading.dialect import is_clock
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import (
    COMMAND,
    TIMER,
    WORDS,
    Column,
    column,
    columns_of,
    has_time,
    time_columns,
)
from pupper_sysid.sysid.recordings.importers.log import Table
from pupper_sysid.sysid.recordings.importers.options import LARGEST_RAD, likely_of_pair

LAYOUTS = {
    "recording of this project": (
        "send_time_s", "read_time_s", "trial", "joint", "frequency_hz", "command_rad",
        "position_rad",
    ),
    "Mini Pupper sweep": (
        "time_s", "freq_hz", "motor_idx", "signal", "command_rad", "actual_rad",
    ),
    "Mini Pupper playback": ("time_s", "loop", "LF_hip_command_rad", "LF_hip_position_rad"),
}  # fmt: skip
"""Tables of text with names of their own."""
FILES = (
    "SAGE folder (control.csv, state_motor.csv, joint_list.txt); LeRobot dataset (folder with "
    "meta/info.json and data/**/*.parquet); rosbag2 folder or MCAP file (JointState, and commands "
    "as JointTrajectory, Float64MultiArray or JointState); BAM or K-Scale JSON "
    "(entries[].timestamp, position, goal_position); ktune JSON (data[].time_since_start, "
    "position, commanded_position); NumPy .npz or parquet with the columns of a table"
)
"""Layouts other than tables of text."""
_IMU = {"gx", "gy", "gz", "ax", "ay", "az"}
_CURRENT = re.compile(r"cur(r|rent)?(?![A-Za-z])", re.IGNORECASE)
_WIDEST_ANGLE = 1e6  # of a joint, in any unit
_COMPARED, _ALIKE = 12, 0.7  # columns; concordance of a command and its position
_ORDERED = 100_000  # rows
_NO_PLACE = re.compile(
    r"delta|diff|incr|err(?:or)?(?![a-z])|"
    r"vel|speed|rpm|torque|effort|volt|temp|power|pwm|duty|(?:rad|deg|°)[_/ ]?s(?![a-z])|dps|"
    r"(?<![a-z])nm(?![a-z])|\[[NAV]\]",
    re.IGNORECASE,
)
_PULSES = re.compile(
    r"pwm|pulse|duty|(^|[_ (\[])(us|µs)\b", re.IGNORECASE
)  # what a hobby servo is commanded by
PULSES_US, _OF_PULSES = (400.0, 2700.0), "counts:4000:1500"  # 2,000 µs for half a turn
_QUANTITIES = {  # words of a command that is no place, and what to do
    "changes of the goal: add them up (numpy.cumsum) to a column of goals": re.compile(
        r"delta|diff|incr|relative|(?<![a-z])rel(?![a-z])", re.IGNORECASE
    ),
    "a speed, so that this is no log of a position servo": re.compile(
        r"vel|speed|rpm|omega|dq|qd|(?:rad|deg|°)[_/ ]?s(?![a-z])|dps", re.IGNORECASE
    ),
    "a torque or current, so that this is no log of a position servo": re.compile(
        r"torque|effort|current|(?<![a-z])(?:nm|iq|tau)(?![a-z])", re.IGNORECASE
    ),
}
_ERROR = re.compile(r"(.*[_. ])?(err|error|deviation)([_. ].*)?", re.IGNORECASE)
_IS_RATE = 0.95  # correlation of a column with another one summed up


def import_line(path: Path | str, **options: str) -> str:
    """The command that imports a log with these options; what takes a table in memory with them."""
    if not isinstance(path, Path):
        return f"`options={ {k: float(v) if k == 'rate' else v for k, v in options.items()} }`"
    words = [f"pupper-sysid import {shlex.quote(str(path))}"]
    for name, value in (options | {"out": "rec.csv"}).items():
        words.append(f"--{name.replace('_', '-')} {shlex.quote(printable(value)) if value else ''}")
    return f"`{' '.join(map(str.rstrip, words))}`"


def listed(names: Iterable[str]) -> str:
    """Names for a message."""
    return printable(", ".join(map(str, names)))[:300]


def missing(names: Sequence[str]) -> str:
    """What a table lacks to be a servo's log; empty if a joint may have command and position."""
    kinds = {c.kind for c in columns_of(names)}
    if {"command", "position"} <= kinds:
        return ""
    if "command" in kinds:
        return "no column is a position (knee_position, observation.state.knee, present …)"
    if "position" in kinds:
        return "no column is a command (knee_command, action.knee, goal …)"
    return "no column is a command or a position"


def unknown_numbers(path: Path | str, table: Table) -> str:
    """Why a table whose columns have no names cannot be read, and how it can."""
    ranges = []
    for name, values in list(table.columns.items())[:12]:
        if np.isfinite(values).any():
            up = ", increasing" if name in table.increasing else ""
            ranges.append(f"{name} ({np.nanmin(values):.4g} … {np.nanmax(values):.4g}{up})")
    text = f"{table.numbered}. By their numbers, from 0, they are {'; '.join(ranges)}. "
    if lines := lines_by_value(path, table):
        note = rate_note(lines[0], table)
        return f"{text}Say which is which: {', '.join(lines)}, or others{note}."
    return f"{text}A log has a column of commands and one of positions, which these are not."


def unknown_columns(path: Path | str, table: Table, timed: bool = False) -> str:
    """Why a table has no known layout; empty where it may have one.

    Layouts that share columns with it are listed with those that it lacks. `timed` tables have
    their times from elsewhere.
    """
    names = table.names
    lacks = [text] if (text := missing(names)) else []
    timer = table.tick_s is not None and any(map(TIMER.search, names))
    timed = timed or table.rate is not None or timer or has_time(names)
    if not lacks and timed:
        return ""
    if {n.lower() for n in names} >= _IMU and text.startswith("no column"):
        return (
            "it holds an IMU's readings (gx … az), and no commands and positions of joints, so "
            "nothing of a servo can be measured with it. Give a log of commands and positions."
        )
    lacks += [] if timed else ["no column is a time (time, timestamp, t …)"]
    parts = [f"any table: {' and '.join(lacks)}"]
    for layout, columns in LAYOUTS.items():
        if {*names} & {*columns}:
            parts.append(f"{layout}: {', '.join(c for c in columns if c not in names)} missing")
    lines = _lines_by_name(path, table, timed)
    cure = (
        f": {lines}."
        if lines
        else (
            " with `pupper-sysid import` --time (or --rate, the rows a second), --command and "
            f"--position. Other layouts: {FILES}."
        )
    )
    ours = [n for n in LAYOUTS["recording of this project"] if n not in names]
    near = ((n, hit) for n in names for hit in difflib.get_close_matches(n, ours, 1, 0.8))
    hint = next((f"Was '{printable(n)[:40]}' meant as {hit}? Rename it. " for n, hit in near), "")
    if (duty := next(filter(_PULSES.search, names), None)) and not lines:
        hint = (
            f"{printable(duty)[:40]} drives the motor and says not where it is to go: a log of a "
            "position servo needs its goals. "
        )
    if lacks and (text := _other_quantity(columns_of(names))):
        return f"of its columns ({listed(names)}) {lacks[0]}: {text}"
    return (
        f"its columns ({listed(names)}) belong to no known layout. {'; '.join(parts)}. "
        f"{hint}Name the columns{cure}"
    )


def _other_quantity(columns: Sequence[Column]) -> str:
    """What a column is that stands where a command or a position is lacking; empty for none."""
    goal = next((printable(c.name)[:40] for c in columns if c.kind == "command"), "")
    others = [c for c in columns if not c.kind]
    commands = [c for c in others if any(WORDS[word] == COMMAND for word in c.words)]
    for c, (meaning, pattern) in product(commands, _QUANTITIES.items()):
        if not goal and pattern.search(c.name):
            return f"{printable(c.name)[:40]} is {meaning}."
    for c in others:
        if goal and _ERROR.fullmatch(c.name):
            error = printable(c.name)[:40]
            return f"{error} says how far it is from its goal. Add a column {goal} - {error}."
    return ""


def _lines_by_name(path: Path | str, table: Table, timed: bool) -> str:
    """Command lines that take columns whose names say nothing for what is missing."""
    columns = columns_of(table.names)
    times = time_columns(table.names)[:1]
    times = times or [n for n in table.increasing if column(n).kind != "position"][:1]
    still = [n for n in table.columns if np.ptp(table.known(n)) == 0]
    counted = [n for n in table.columns if (np.diff(table.known(n)) == 1).all()]
    if not times and (len(columns) > 2 or timed):  # of another event
        times = [c.name for c in columns if c.kind in ("time", "unknown")
                 and c.name not in (*still, *counted)]  # fmt: skip
    when = {"time": times[0]} if times else {"rate": f"{table.rate or 50:g}"}
    of_number = {c.name: re.sub(r"\d+", "{joint}", c.name, count=1) for c in columns}
    several = {each for each, n in Counter(of_number.values()).items() if n > 1}
    by_kind, rates = [], _rates(table)
    for kind in ("command", "position"):
        sure = [c for c in columns if c.kind == kind and c.name not in still]
        if kind == "command" and not sure:  # qd beside q may be the desired angle
            sure = [c for c in columns if c.name[-1:] == "d" and c.name[:-1] in table.names]
        if kind == "command" and not sure:
            sure = [c for c in columns if _are_pulses(table, c.name)]
        if kind == "position" and not sure:  # beside a command a bare `current` may be a place
            sure = [c for c in columns if not c.kind and _CURRENT.search(c.name)]
        chosen = [(c.template, c.name) for c in sure]
        for others in ("unknown", "time"):
            chosen = chosen or [
                (of_number[c.name] if of_number[c.name] in several else c.template, c.name)
                for c in columns
                if c.kind == others and c.name not in times[:1] and c.name not in rates
            ]  # fmt: skip
        by_kind.append(chosen[:_COMPARED])
    lines = []
    for (command, *name), (position, *other) in product(*by_kind):
        if ("{joint}" in command) != ("{joint}" in position):  # of one of them a lone word
            command, position = name[0], other[0]
        if command != position:
            unit = _unit_of(table, (command, position))
            lines.append(import_line(path, **when, **unit, command=command, position=position))
    text = "; or ".join(list(dict.fromkeys(lines or lines_by_value(path, table)))[:3])
    guess = ", where the counts of a turn are a guess by the values" if "counts:" in text else ""
    return f"{text}{guess}{rate_note(when, table)}" if text else ""


def lines_by_value(path: Path | str, table: Table) -> list[str]:
    """Commands that import the columns that go together as a command and its position do."""
    clocks = [n for n, cells in table.texts.items() if is_clock(cells[0])]
    rising = table.increasing
    named = sorted(time_columns(table.names)[:2], key=lambda n: n not in (*rising, *clocks))
    time = next(iter([*named[:1], *rising, *clocks]), "")
    others: list[str] = []  # that move, each once
    rates = _rates(table)
    for name, values in table.columns.items():
        known = table.known(name)
        same = (np.array_equal(values, table.columns[o], equal_nan=True) for o in others)
        other = _NO_PLACE.search(re.split(r"[./](?!s\b)", name)[-1]) and not _are_pulses(
            table, name
        )
        if name == time or name in rates or other or np.ptp(known) == 0 or any(same):
            continue
        if np.ptp(known) < _WIDEST_ANGLE:
            others.append(name)
        elif (known % 1 == 0).all() and known.min() >= 0 and known.max() < 1e9 and "," not in time:
            time = f"{time},{name}"  # nanoseconds
    if len(others) < 2:
        return []
    ranked = sorted(
        (_likeness(table, p) for p in combinations(others[:_COMPARED], 2)), reverse=True
    )
    pairs: list[list[str]] = []
    for likeness, pair in ranked:
        if likeness > _ALIKE and not {*pair} & {name for other in pairs for name in other}:
            pairs.append(pair)
    pairs = pairs or [_likeness(table, others[:2])[1]]
    first, second = pairs[0]
    every = (",".join(names) for names in zip(*sorted(pairs), strict=True))
    choices = dict.fromkeys([tuple(every), (first, second), (second, first), (first, others[-1])])
    rate = 50 if table.rate is None else table.rate
    how = {"time": time} if time else {"rate": f"{rate:g}"}
    how |= _unit_of(table, pairs[0])
    return [import_line(path, **how, command=c, position=p) for c, p in choices if c != p]


def _rates(table: Table) -> set[str]:
    """Columns that another one is the sum of: speeds beside an angle, whatever they are called.

    None where that leaves no pair: a sine a quarter of a turn late is such a sum, too.
    """
    moving = {
        name: values[:_ORDERED] for name, values in table.columns.items()
        if name not in table.increasing and np.isfinite(values).all()
        and 0 < np.ptp(values) < _WIDEST_ANGLE
    }  # fmt: skip
    names = [*moving][:_COMPARED]

    def level(values: NDArray[np.float64]) -> NDArray[np.float64]:
        row = np.arange(len(values))
        return values - np.polyval(np.polyfit(row, values, 1), row)

    def correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
        return float(one @ other) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-300)

    summed = {name: level(np.cumsum(moving[name])) for name in names}
    bare = {name: level(moving[name]) for name in names}
    rates = {a for a, b in permutations(names, 2) if correlation(summed[a], bare[b]) > _IS_RATE}
    return rates if len(names) - len(rates) >= 2 else set()


def _unit_of(table: Table, names: Iterable[str]) -> dict[str, str]:
    """The option for a command and a position whose values, in radians, are no angles of a joint.

    `names` may hold `{joint}`.
    """
    pair, named, pulses = [], [], False
    for name in names:
        pattern = re.escape(name).replace(re.escape("{joint}"), ".+")
        column_name = next(
            (n for n in table.columns if re.fullmatch(pattern, n)), name.split(",")[0]
        )
        pulses = pulses or _PULSES.search(column_name) is not None
        named.append(column(column_name).unit)
        pair.append(table.known(column_name))
    if all(named) and not pulses:
        return {}
    largest = max(float(np.abs(values).max()) for values in pair)
    if _are_pulse_widths(pair[0]) and pulses:
        of_position = named[1] or likely_of_pair(pair[1], pair[1])[0].partition(",")[0]
        return {"unit": f"{_OF_PULSES},{of_position}"}
    if not largest > LARGEST_RAD:
        return {}
    named = ["" if name == "counts" else name for name in named]
    command, _, position = likely_of_pair(pair[0], pair[1], named)[0].partition(",")
    units = [named[0] or command, named[1] or position or command]
    return {"unit": ",".join(dict.fromkeys(units))}


def _are_pulses(table: Table, name: str) -> bool:
    """Whether a column holds pulse widths, which command a hobby servo; a duty cycle does not."""
    return (
        not column(name).kind
        and _PULSES.search(name) is not None
        and _are_pulse_widths(table.known(name))
    )


def _are_pulse_widths(values: NDArray[np.float64]) -> bool:
    return bool(PULSES_US[0] < values.min() <= values.max() < PULSES_US[1])


def rate_note(line: str | Mapping[str, str], table: Table) -> str:
    """What to put in place of a rate that a command line takes for example."""
    example = "rate" in line and table.rate is None
    return ", with your rows a second in place of 50: the lag scales with them" if example else ""


def _likeness(table: Table, pair: Sequence[str]) -> tuple[float, list[str]]:
    """How alike two columns are, and the pair, first the one that the other follows.

    Lin's coefficient of concordance at the best lag: 1 for equal columns; an offset counts, another
    scale, too.
    """
    if any(len(table.known(name)) < len(table.columns[name]) for name in pair):
        return 0.0, [*pair]
    values = [table.known(name)[:_ORDERED] for name in pair]
    first, second = (v - np.mean(v) for v in values)
    product_at = np.fft.irfft(np.fft.rfft(second, 2 * len(second)).conj()
                              * np.fft.rfft(first, 2 * len(first)))  # fmt: skip
    best = int(np.argmax(np.abs(product_at)))
    apart = len(first) * float(np.mean(values[0]) - np.mean(values[1])) ** 2
    total = float(first @ first + second @ second) + apart
    likeness = 2 * float(np.abs(product_at[best])) / max(total, 1e-300)
    return likeness, [*pair][::-1] if 0 < best < len(first) else [*pair]


def unknown_json(keys: Iterable[str]) -> str:
    """Why JSON has no known layout."""
    present = set(map(str, keys))
    return (
        f"it is JSON of no known layout; it has {listed(sorted(present)) or 'no keys'}. BAM or "
        f"K-Scale: {_lack(present, 'entries')}; ktune: {_lack(present, 'config', 'data')}. Other "
        f"layouts: {FILES}; a table as CSV."
    )


def unknown_folder(names: Iterable[str]) -> str:
    """Why a folder has no known layout."""
    present = set(names)
    if not present:
        return "it is an empty folder. Give a log's file or folder."
    return (
        f"it is a folder without a log: it has {listed(sorted(present)[:20])}. SAGE: "
        f"{_lack(present, 'control.csv', 'state_motor.csv', 'joint_list.txt')}; LeRobot: "
        f"{_lack(present, 'meta', 'data')}; rosbag2: {_lack(present, 'metadata.yaml')}. Give a "
        "log's file or folder."
    )


def _lack(present: set[str], *wanted: str) -> str:
    lacking = [name for name in wanted if name not in present]
    return f"{', '.join(lacking)} missing" if lacking else "not as expected inside"
