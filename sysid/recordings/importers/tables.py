"""Tables with any column names: columns per joint, a row per joint and time, or a row per value.

    time, knee_command, knee_position, ankle_command, ankle_position
    timestamp, action.pan, action.lift, observation.state.pan, observation.state.lift
    time_ms, leg, hip_goal, hip_present
    time, name, value

CSV, parquet, arrays and tables in memory come here as columns. `importers.columns` says what each
column is by its name; options name the columns instead.
"""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import (
    MOST_CELLS,
    MOST_COLUMNS,
    distinct,
    is_failure,
    one_each,
)
from pupper_sysid.common.reading.dialect import is_clock
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import (
    Column,
    column,
    columns_of,
    time_columns,
)
from pupper_sysid.sysid.recordings.importers.log import (
    MOST_JOINTS,
    Log,
    bare_name,
    held_commands,
    joint_names,
    rows,
)
from pupper_sysid.sysid.recordings.importers.options import (
    LARGEST_RAD,
    LogOptions,
    Unit,
    likely_of_pair,
    unit,
)
from pupper_sysid.sysid.recordings.importers.times import (
    clock,
    doubt_of_a_turn,
    one_after_another,
    scrambled,
    sent_at,
    times_of_day,
    turns,
    unwrapped,
)

LAYOUT = "table"

_TRIALS = ("trial", "episode_index", "episode", "loop", "run", "segment")
_TONES = ("frequency_hz", "freq_hz", "frequency", "freq")
SERIES = ("name", "signal", "event", "type", "kind", "variable", "topic", "field", "series",
           "metric", "key", "channel", "_field", "_measurement", "op", "operation", "direction",
           "dir", "param", "parameter", "quantity", "label", "source", "item",
           "register")  # fmt: skip
_VALUES = ("value", "values", "val", "_value", "data")
GROUPS = ("leg", "limb", "arm", "side", "joint", "joint_name", "motor", "motor_name", "servo",
           "servo_name", "actuator", "name", "axis", "dof", "motor_idx", "motor_id", "motor_index",
           "joint_idx", "joint_id", "joint_index", "servo_id", "actuator_id", "dxl_id", "can_id",
           "node_id", "id")  # fmt: skip
LABELS = frozenset((*SERIES, *GROUPS, *_TRIALS))
"""Columns that may hold text, in lower case."""
_SUBSECONDS = ("nanosec", "nanosecs", "nsec", "nsecs", "usec", "usecs", "msec", "ms")
_KEPT = ("p_gain", "torque_enabled", "voltage_v", "temperature_c", "load")
_SOLE = "joint"  # of a log that names none
_MOST_GROUPS = 1000
_TOGETHER = 0.2  # share of the rows with a command or position that have both
_FEWEST_ROWS = 3  # of a joint in a table with a row per joint
_COUNTING = 0.3  # share of rows with another trial than the row before: it counts them
_SHORTEST_TONE = 20  # rows of one frequency; a chirp changes it sooner
_MOST_CHOICES = 4  # that a message lists
_COMPARED = 8  # columns for one purpose
_COMPARED_BY_VALUE, _ALIKE = 12, 0.7  # columns; concordance of a command and its position
_MOSTLY_BLANK, _ONE_STAMP = 0.3, 0.9  # shares of positions without a command, with its time
_TIMER = re.compile(r"ticks?|timer|cycles?|counter", re.IGNORECASE)
_TIME_STEP = re.compile(r"(d_?t|delta_?t(ime)?|time_?(step|delta))([_ (\[].*)?", re.IGNORECASE)
_WIDEST_ANGLE = 1e6  # of a joint, in any unit
_ORDERED = 100_000  # rows
_OF_TURNS = {
    "ODrive": ({"setpoint", "estimate"}, "pos_setpoint and pos_estimate"),
    "ODrive's API": ({"input", "estimate"}, "input_pos and pos_estimate"),
    "moteus": ({"servo_stats.position"}, "servo_stats.position"),
    "moteus's decoder": ({"command_position", "q_current"}, "command_position and q_current"),
    "moteus's registers": ({"Register.POSITION"}, "Register.POSITION"),
    "moteus's telemetry": ({"control_position", "q_current"}, "control_position and q_current"),
}
"""Programs that count turns and do not say so, and what gives their logs away."""
_DRIVES = re.compile(r"axis\d|odrv|moteus|servo_stats|Register\.|q_current|(^|[_.])iq(_|$)|"
                     r"input_pos|vel_(estimate|setpoint)", re.IGNORECASE)  # fmt: skip
"""Names that only those programs have: with one of them the angles are turns without doubt."""


_LACKING = {
    "percent": ("percent of a range of motion that the log does not say. Give it, as of 3.5 rad",
                "percent:3.5"),
    "steps": ("the log does not say how many steps make a turn. Give them, as of 3200",
              "counts:3200:0"),
}  # fmt: skip
"""Units that a name does not say whole, what to do, and an example."""


_FLAG = re.compile(
    r"(.*?)[_. ]?(?:is|read|pos|rx)?[_. ]?"
    r"(?:(valid|ok|success|status|result)|invalid|timeout|timed_?out|lost|failed|"
    r"(?:comm|crc|read|rx)[_. ]?(?:error|result|err))",
    re.IGNORECASE,
)  # fmt: skip
_MOST_FAILED = 0.5  # of the rows: more are another meaning


@dataclass(frozen=True)
class Table:
    """Columns of a log."""

    columns: Mapping[str, NDArray[np.float64]]
    """Of numbers, equally long; shape (rows,)."""
    texts: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Columns that hold text."""
    faults: Mapping[str, str] = field(default_factory=dict)
    """Why a column is no numbers, as a sentence."""
    widths: Mapping[str, int] = field(default_factory=dict)
    """Arrays with a column per joint, and how many; their columns are `<array>.<joint>`."""
    joint_names: tuple[str, int] | None = None
    """What names those joints, and how many."""
    numbered: str = ""
    """Why the columns have no names but their numbers, as a clause; empty if they have."""
    notes: tuple[str, ...] = ()
    """What was assumed, in sentences."""
    rate: float | None = None
    """Rows a second that the log states beside its columns."""
    tick_s: float | None = None
    """Of its times, as the log states beside its columns."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Units of angles that the log states beside its columns; of the name "" those of all."""

    @cached_property
    def names(self) -> list[str]:
        """Names of all columns."""
        return list(dict.fromkeys([*self.columns, *self.texts, *self.faults]))

    def numbers(self, path: Path | str, name: str) -> NDArray[np.float64]:
        """Finite or missing numbers of a column."""
        shown = printable(name)[:60]
        if name not in self.columns:
            fault = f"{path}, column {shown}: its values are not numbers."
            raise InputError(self.faults.get(name, fault))
        values = np.asarray(self.columns[name], float)
        if np.isinf(values).any():
            raise InputError(f"{path}, column {shown}: a value is infinite.")
        return values

    def first(self, names: Sequence[str]) -> str | None:
        """The first of these names, in any case, that a column of numbers has."""
        return next((self._lower[n] for n in names if n in self._lower), None)

    def stated_unit(self, name: str) -> str:
        """The unit that the log states for a column beside it; empty for none."""
        return self.units.get(name, self.units.get("", ""))

    @cached_property
    def _lower(self) -> dict[str, str]:
        return {n.lower(): n for n in self.columns}

    @property
    def increasing(self) -> list[str]:
        """Columns whose numbers never decrease, and are not all the same, nor count named rows."""
        steps = {n: np.diff(v[np.isfinite(v)]) for n, v in self.columns.items()}
        return [n for n, s in steps.items() if (s >= 0).all() and (s > 0).any()
                and (self.numbered or not (s == 1).all())]  # fmt: skip

    def taken(self, order: NDArray[np.int64]) -> Table:
        """The table with its rows in another order."""
        columns = {name: np.asarray(values)[order] for name, values in self.columns.items()}
        texts = {name: [cells[k] for k in order] for name, cells in self.texts.items()}
        return replace(self, columns=columns, texts=texts)

    def check_joints(self, path: Path | str, columns: Iterable[str]) -> None:
        """Refuse arrays, of which these are columns, with other numbers of joints than names."""
        used = {key: n for key, n in self.widths.items()
                if any(column.startswith(f"{key}.") for column in columns)}  # fmt: skip
        if used:
            counts = used | dict([self.joint_names] if self.joint_names else [])
            one_each(path, counts, "Mend the log, or name the joints to read with `joints`.")


def expanded(
    path: Path | str,
    arrays: Mapping[str, NDArray[np.float64]],
    names: Sequence[str],
    named: str | None = None,
) -> Table:
    """Table of arrays of which some have a number per joint: `action` becomes `action.<name>`.

    `path`: for messages. `arrays` of shape (rows,) or (rows. `names`: of the joints; arrays of
    another width get `joint_0`, `joint_1` and so on. `named`: what in the log holds these names;
    None if it does not name its joints.
    """
    distinct(path if named is None else f"{path}, {named}", names, "joints")
    lengths = [len(values) for values in arrays.values()]
    rows = max(set(lengths), key=lengths.count, default=0)
    columns, faults, widths = {}, {}, {}
    for key, values in arrays.items():
        parts = {key: values}
        if values.ndim == 2:
            width = min(values.shape[1], 10_000)
            own = names if len(names) == width else [f"joint_{k}" for k in range(width)]
            parts = {f"{key}.{own[k]}": values[:, k] for k in range(width)}
            widths[key] = width
        if len(values) == rows:
            columns |= parts
        else:
            text = f"{path}: {key} has {len(values)} rows where others have {rows}. Mend the log."
            faults |= dict.fromkeys(parts, text)
    distinct(path, [*columns, *faults])
    return Table(columns, {}, faults, widths, None if named is None else (named, len(names)))


def read_numbered(
    path: Path | str, values: NDArray[np.float64], options: LogOptions, layout: str
) -> Log:
    """The columns of one array, shape (rows, columns), by their numbers."""
    refuse_more(path, values.shape[1], MOST_COLUMNS, "columns", "Split it by joint.")
    table = Table(
        {str(k): column.astype(float) for k, column in enumerate(values.T)},
        numbered="its columns have no names",
    )
    if not options.command:
        raise InputError(f"{path}: {unknown_numbers(path, table)}")
    return read_table(path, table, options, layout)


def read_table(path: Path | str, table: Table, options: LogOptions, layout: str = LAYOUT) -> Log:
    """The rows of a table."""
    refuse_more(path, len(table.names), MOST_COLUMNS, "columns", "Split it by joint.")
    refuse_more(path, sum(map(len, table.columns.values())), MOST_CELLS, "cells", "Split it.")
    table = spread(path, table, options)
    timed = [n for n in table.names if n not in table.columns or np.ptp(known(table, n)) > 0]
    if table.rate is not None and options.rate is None and not (options.time or has_time(timed)):
        options = replace(options, rate=table.rate)
    notes = list(table.notes)
    pairs, texts = _pairs(path, table, options)
    notes += texts
    table, texts = _without_failed(path, table, pairs)
    notes += texts
    read_s, send_s, texts = _times(path, table, options)
    notes += texts
    groups = _groups(path, table)
    if any(scrambled(read_s[own]) for own in groups.values() or [slice(None)]):
        first = table.first(_TRIALS)
        trial = np.zeros(len(read_s)) if first is None else table.columns[first]
        order = np.lexsort((read_s, trial))
        read_s, send_s = read_s[order], None if send_s is None else send_s[order]
        table = table.taken(order)
        groups = _groups(path, table)
        notes.append("its rows, which were in no order of time or the newest first, were sorted.")
    if not (len(groups) > 1 or (groups and [*pairs] == [_SOLE])):
        groups = {"": np.ones(len(read_s), bool)}
    wanted = {  # by the log's own name
        "_".join(w for w in (group, "" if name == _SOLE and group else name) if w): (own, pair)
        for (group, own), (name, pair) in product(groups.items(), pairs.items())
    }  # fmt: skip
    if options.joints and [*wanted] == [_SOLE] and len(options.joints) == 1:
        wanted = {next(iter(options.joints)): wanted[_SOLE]}
    if options.joints:
        lacking = [j for j in options.joints if j not in wanted]
        if lacking:
            raise InputError(
                f"{path}: `joints` names {printable(lacking[0])}, which has no command and "
                f"position; {', '.join(map(printable, wanted))[:300]} have."
            )
        wanted = {joint: wanted[joint] for joint in options.joints}
    names = joint_names(path, [options.joints.get(j) or j for j in wanted])
    metadata: dict[str, Any] = {"imported_from": layout, "joints": names, "bus": {}}
    if options.readings:
        metadata["readings"] = options.readings
    parts = []
    for (theirs, (own, pair)), name in zip(wanted.items(), names, strict=True):
        part, texts = _joint(path, table, options, pair, (read_s, send_s), own, (theirs, name),
                             metadata)  # fmt: skip
        parts.append(part)
        notes += [text for text in texts if text not in notes]
    return Log(pd.concat(parts, ignore_index=True), metadata, notes)


def is_flag(name: str) -> tuple[str, bool] | None:
    """Whose readings a column says to be good or failed, and whether 1 is good; None for others."""
    found = _FLAG.fullmatch(name[:100])
    return None if found is None else (column(found[1]).key, bool(found[2]))


def _without_failed(
    path: Path | str, table: Table, pairs: Mapping[str, _Pair]
) -> tuple[Table, list[str]]:
    """The table without the positions of rows that a column says to have failed, and notes."""
    columns, notes = dict(table.columns), []
    for name in table.names:
        if (flag := is_flag(name)) is None:
            continue
        if name in table.texts:
            words = [word.strip().lower() for word in table.texts[name]]
            good = "true" if flag[1] else "false"
            failed = np.array([(w in ("true", "false") and w != good) or is_failure(w)
                               for w in words])  # fmt: skip
        elif name in table.columns and not name.lower().endswith("status"):
            values = table.columns[name]
            two = flag[1] and not name.lower().endswith("result")
            failed = (values == 0) if two else (values != 0) & np.isfinite(values)
            if (values % 1 != 0).any() or (two and np.unique(values).size > 2):
                continue
        else:
            continue
        own = [pair for pair in pairs.values() if flag[0] in ("", pair.position.key)]
        if not own or not failed.any() or failed.mean() > _MOST_FAILED:
            continue
        for position in {pair.position.name for pair in own}:
            columns[position] = np.where(failed, np.nan, table.numbers(path, position))
        notes.append(
            f"{int(failed.sum())} readings failed by the column {printable(name)[:40]}, and were "
            "left out."
        )
    return (replace(table, columns=columns) if notes else table), notes


# ------------------------------------------------------------------------------- which columns


@dataclass(frozen=True)
class _Pair:
    """Columns of one joint's command and position."""

    command: Column
    position: Column


def _pairs(
    path: Path | str, table: Table, options: LogOptions
) -> tuple[dict[str, _Pair], list[str]]:
    """Columns by joint, as the log names it, and what was assumed."""
    if options.command and options.position:
        pairs, notes = _stated_pairs(path, table, options), []
    else:
        pairs, notes = _pairs_by_words(path, table, options)
    if not options.joints:
        used = [c.name for pair in pairs.values() for c in (pair.command, pair.position)]
        table.check_joints(path, used)
    return pairs, notes


def _pairs_by_words(
    path: Path | str, table: Table, options: LogOptions
) -> tuple[dict[str, _Pair], list[str]]:
    every = columns_of(name for name in table.names if name not in table.texts)
    by_key: dict[str, dict[str, list[Column]]] = {"command": {}, "position": {}}
    for c in every:
        if c.kind in by_key:
            by_key[c.kind].setdefault(c.key, []).append(c)
    commands, positions = by_key.values()
    if not commands.keys() & positions.keys():
        return _lone_pair(
            path, table, *([c for each in own.values() for c in each] for own in by_key.values())
        )
    used = Counter(c.template for c in every)
    pairs: dict[str, _Pair] = {}
    names: list[str] = []
    notes: list[str] = []
    marked = {
        program: (marks - {*table.names}, shown) for program, (marks, shown) in _OF_TURNS.items()
    }
    of_drive = any(map(_DRIVES.search, table.names))
    for key in (key for key in commands if key in positions):
        ranked = [
            sorted(own[key], key=lambda c: (c.rank, -used[c.template]))[:_COMPARED]
            for own in (commands, positions)
        ]
        best = sorted((_Pair(c, p) for c, p in product(*ranked)), key=lambda q: _cost(q, used))
        pair = _decided(path, table, best, used)
        if (
            sum(
                other.command.rank[:2] == pair.command.rank[:2]
                and other.position.rank[:2] == pair.position.rank[:2]
                for other in best
            )
            > 1
        ):
            notes.append(
                f"of several columns {pair.command.name} was taken for the command and "
                f"{pair.position.name} for the position. To take others, name them with "
                "`command` and `position`."
            )
        pairs[key] = pair
        names.append(_joint_name(pair))
        words = pair.command.words | pair.position.words
        for program, (marks, shown) in marked.items():
            unnamed = not pair.command.unit + pair.position.unit and not options.unit
            if unnamed and marks <= words:
                taken, other = ("turns", "rad") if of_drive else ("rad", "turns")
                notes.append(
                    f"{shown} are names of {program}, which counts turns; the values were taken as "
                    f"{taken}. If they are {other}, give `unit='{other}'`; lag and dead time are "
                    "the same."
                )
                if of_drive:
                    pairs[key] = _Pair(*(replace(c, unit="turns") for c in
                                         (pair.command, pair.position)))  # fmt: skip
    distinct(path, names, "joints")
    kinds = dict(zip((note[:12] for note in reversed(notes)), reversed(notes), strict=True))
    return dict(zip(names, pairs.values(), strict=True)), [*kinds.values()][::-1]


def _joint_name(pair: _Pair) -> str:
    """What to call the joint of a pair: as both columns have it, else without further words."""
    both = sorted((pair.command.joint, pair.position.joint), key=len)
    return bare_name(both[0] if both[0] else pair.command.key) or _SOLE


def _cost(pair: _Pair, used: Mapping[str, int]) -> tuple[int, ...]:
    """Order of pairs for one joint, the better ones first."""
    c, p = pair.command, pair.position
    units = {c.unit or "rad", p.unit or "rad"}
    return (
        c.rank[0] + p.rank[0], c.rank[1] + p.rank[1], int(len(units) > 1), c.rank[2] + p.rank[2],
        p.rank[3], -used[c.template] - used[p.template],
    )  # fmt: skip


def _decided(
    path: Path | str, table: Table, pairs: Sequence[_Pair], used: Mapping[str, int]
) -> _Pair:
    """The best of the pairs of a joint; refused where another is as good and holds other values."""
    best = pairs[0]
    alike = [pair for pair in pairs if _cost(pair, used) == _cost(best, used)]
    for kind in ("command", "position"):
        own = getattr(best, kind)
        twice = {getattr(pair, kind).name for pair in pairs
                 if _cost(pair, used)[:4] == _cost(best, used)[:4]
                 and getattr(pair, kind).words == own.words}  # fmt: skip
        distinct(path, [bare_name(own.joint or _SOLE)] * len(twice), "joints")
        columns = list({getattr(pair, kind).name: getattr(pair, kind) for pair in alike})
        values = [table.columns.get(name) for name in columns]
        first = values[0]
        if any(v is None or first is None or not np.array_equal(v, first, equal_nan=True)
               for v in values[1:]):  # fmt: skip
            why = f"{len(columns)} columns may be the {kind} of {own.joint or 'the joint'}"
            _refuse_choices(path, why, alike)
    return best


def _lone_pair(
    path: Path | str, table: Table, commands: Sequence[Column], positions: Sequence[Column]
) -> tuple[dict[str, _Pair], list[str]]:
    """The pair of a table in which no joint has both by name: the only command and position."""
    first = [
        [c for c in columns if c.rank[:3] == min(columns, key=lambda c: c.rank).rank[:3]]
        for columns in (commands, positions)
        if columns
    ]
    if len(first) == 2:
        pairs = [_Pair(c, p) for c, p in product(*first)]
        if len(pairs) == 1:
            (pair,) = pairs
            name = pair.command.joint or pair.position.joint or _SOLE
            return {bare_name(name): pair}, [
                f"{pair.command.name} and {pair.position.name} were taken for the command and the "
                "position of one joint."
            ]
        table.check_joints(path, [c.name for own in first for c in own])
        if len(first[0]) == len(first[1]):
            pairs = [_Pair(*(_joined(own) for own in first))]
        _refuse_choices(path, "no joint has both a command and a position by its name", pairs)
    table.check_joints(path, [c.name for c in (*commands, *positions)])
    listed = lines_by_value(path, table)
    note = rate_note(listed[0], table) if listed else ""
    lines = f" Say which is which: {'; or '.join(listed)}{note}." if listed else ""
    raise InputError(f"{path}: {missing(table.names)}; it has {_listed(table.names)}.{lines}")


def _joined(columns: Sequence[Column]) -> Column:
    """Several columns as one for a command line."""
    names = ",".join(c.name for c in columns)
    return replace(columns[0], name=names, template=names)


def _refuse_choices(path: Path | str, why: str, pairs: Sequence[_Pair]) -> None:
    """Refuse to choose, with the command line that takes each pair."""
    lines = [
        import_line(path, command=pair.command.template, position=pair.position.template)
        for pair in pairs
    ]
    lines = list(dict.fromkeys(lines))  # templates are of several joints
    more = "" if len(lines) <= _MOST_CHOICES else f" (and {len(lines) - _MOST_CHOICES} more)"
    raise InputError(f"{path}: {why}. Take one: {'; or '.join(lines[:_MOST_CHOICES])}{more}.")


def import_line(path: Path | str, **options: str) -> str:
    """The command that imports a log with these options."""
    words = [f"pupper-sysid import {shlex.quote(str(path))}"]
    for name, value in (options | {"out": "rec.csv"}).items():
        words.append(f"--{name.replace('_', '-')} {shlex.quote(printable(value)) if value else ''}")
    return f"`{' '.join(map(str.rstrip, words))}`"


def _stated_pairs(path: Path | str, table: Table, options: LogOptions) -> dict[str, _Pair]:
    """Columns that the options name."""
    assert options.command and options.position
    matched = []
    for option, text in (("command", options.command), ("position", options.position)):
        listed = [part.strip() for part in text.split(",")]
        if "{joint}" not in text and text not in table.names:
            found = {str(k): _column_named(path, table, option, name)
                     for k, name in enumerate(listed)}  # fmt: skip
        else:
            before, stated, after = text.partition("{joint}")
            middle = "(?P<joint>.+)" if stated else ""
            pattern = re.compile(f"{re.escape(before)}{middle}{re.escape(after)}")
            fits = [m for name in table.names if (m := pattern.fullmatch(name[:200]))]
            found = {bare_name(m.groupdict().get("joint") or "0"): m[0] for m in fits}
            distinct(path, [bare_name(m.groupdict().get("joint") or "0") for m in fits], "joints")
        if not found:
            raise InputError(
                f"{path}: `{option}` is {printable(text)}, which fits no column; it has "
                f"{_listed(table.names)}."
            )
        matched.append(found)
    commands, positions = matched
    both = [joint for joint in commands if joint in positions]
    if not both or ("{joint}" not in options.command and len(commands) != len(positions)):
        raise InputError(
            f"{path}: no joint has both a column of `command` and one of `position`; it has "
            f"{_listed(table.names)}."
        )
    names = both
    if "{joint}" not in options.command:
        stated_joints = [*options.joints] if len(options.joints) == len(both) else []
        names = stated_joints or ([_SOLE] if len(both) == 1 else [f"joint_{k}" for k in both])
    return {
        name: _Pair(column(commands[joint]), column(positions[joint]))
        for name, joint in zip(names, both, strict=True)
    }


def _column_named(path: Path | str, table: Table, option: str, name: str) -> str:
    """The column of this name, or of this number from 0."""
    if name in table.names:
        return name
    if name.isascii() and name.isdigit() and int(name[:9]) < len(table.names):
        return table.names[int(name)]
    hint = "" if option in ("time", "command_time", "trial") else (
        " ({joint} stands for a joint's name)"
    )  # fmt: skip
    raise InputError(
        f"{path}: `{option}` is {printable(name)[:60]}, but there is no such column{hint}; it has "
        f"{_listed(table.names)}."
    )


def unknown_numbers(path: Path | str, table: Table) -> str:
    """Why a table whose columns have no names cannot be read, and how it can."""
    shown = []
    for name, values in list(table.columns.items())[:12]:
        known = values[np.isfinite(values)]
        if len(known):
            up = ", increasing" if name in table.increasing else ""
            shown.append(f"{name} ({known.min():.4g} … {known.max():.4g}{up})")
    text = f"{table.numbered}. By their numbers, from 0, they are {'; '.join(shown)}. "
    if lines := lines_by_value(path, table):
        note = rate_note(lines[0], table)
        return f"{text}Say which is which: {', '.join(lines)}, or others{note}."
    return f"{text}A log has a column of commands and one of positions, which these are not."


def lines_by_value(path: Path | str, table: Table) -> list[str]:
    """Commands that import the columns that go together as a command and its position do."""
    clocks = [n for n, cells in table.texts.items() if is_clock(cells[0])]
    rising = table.increasing
    named = sorted(time_columns(table.names)[:2], key=lambda n: n not in (*rising, *clocks))
    times = [*named[:1], *rising, *clocks]
    time = times[0] if times else ""
    others: list[str] = []  # that move, each once
    for name, values in table.columns.items():
        known = values[np.isfinite(values)]
        same = (np.array_equal(values, table.columns[o], equal_nan=True) for o in others)
        if name == time or not len(known) or np.ptp(known) == 0 or any(same):
            continue
        if np.ptp(known) < _WIDEST_ANGLE:
            others.append(name)
        elif (known % 1 == 0).all() and known.min() >= 0 and known.max() < 1e9 and "," not in time:
            time = f"{time},{name}"  # nanoseconds
    if len(others) < 2:
        return []
    pairs = _alike(table, others) or [_likeness(table, others[:2])[1]]
    first, second = pairs[0]
    every = (",".join(names) for names in zip(*sorted(pairs), strict=True))
    choices = dict.fromkeys([tuple(every), (first, second), (second, first), (first, others[-1])])
    rate = 50 if table.rate is None else table.rate
    how = {"time": time} if time else {"rate": f"{rate:g}"}
    how |= unit_of(table, pairs[0])
    return [import_line(path, **how, command=c, position=p) for c, p in choices if c != p]


def unit_of(table: Table, names: Iterable[str]) -> dict[str, str]:
    """The option for a command and a position whose values, in radians, are no angles of a joint.

    `names` may hold `{joint}`.
    """
    pair = []
    for name in names:
        pattern = re.escape(name).replace(re.escape("{joint}"), ".+")
        own = next((n for n in table.columns if re.fullmatch(pattern, n)), name.split(",")[0])
        if column(own).unit:
            return {}
        pair.append(known(table, own))
    largest = max(float(np.abs(values).max()) for values in pair)
    return {"unit": likely_of_pair(*pair)[0]} if largest > LARGEST_RAD else {}


def rate_note(line: str | Mapping[str, str], table: Table) -> str:
    """What to put in place of a rate that a command line takes for example."""
    example = "rate" in line and table.rate is None
    return ", with your rows a second in place of 50: the lag scales with them" if example else ""


def _alike(table: Table, names: Sequence[str]) -> list[list[str]]:
    """Pairs of columns that go together, as a joint's command and position do, the best first."""
    pairs = combinations(names[:_COMPARED_BY_VALUE], 2)
    ranked = sorted((_likeness(table, pair) for pair in pairs), reverse=True)
    found: list[list[str]] = []
    for likeness, pair in ranked:
        if likeness > _ALIKE and not {*pair} & {name for other in found for name in other}:
            found.append(pair)
    return found


def _likeness(table: Table, pair: Sequence[str]) -> tuple[float, list[str]]:
    """How alike two columns are, and the pair, first the one that the other follows.

    Lin's coefficient of concordance at the best lag: 1 for equal columns; an offset counts, another
    scale, too.
    """
    known = [table.columns.get(name, np.full(1, np.nan)) for name in pair]
    if not all(np.isfinite(v).all() for v in known):
        return 0.0, [*pair]
    first, second = (np.asarray(v[:_ORDERED]) - np.mean(v[:_ORDERED]) for v in known)
    product_at = np.fft.irfft(np.fft.rfft(second, 2 * len(second)).conj()
                              * np.fft.rfft(first, 2 * len(first)))  # fmt: skip
    best = int(np.argmax(np.abs(product_at)))
    apart = len(first) * float(np.mean(known[0][:_ORDERED]) - np.mean(known[1][:_ORDERED])) ** 2
    total = float(first @ first + second @ second) + apart
    likeness = 2 * float(np.abs(product_at[best])) / max(total, 1e-300)
    return likeness, [*pair][::-1] if 0 < best < len(first) else [*pair]


def known(table: Table, name: str) -> NDArray[np.float64]:
    """The numbers of a column; two zeros if it has none."""
    values = table.columns.get(name, np.zeros(0))
    known = values[np.isfinite(values)]
    return known if len(known) else np.zeros(2)


def is_timed(table: Table) -> bool:
    """Whether a table has times, or states its rate."""
    timer = table.tick_s is not None and any(map(_TIMER.search, table.names))
    return table.rate is not None or timer or has_time(table.names)


def has_time(names: Sequence[str]) -> bool:
    """Whether one of these columns is a time."""
    return any(column(n).kind == "time" or _TIME_STEP.fullmatch(n) for n in names) or bool(
        time_columns(names)
    )


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


def _listed(names: Sequence[str]) -> str:
    return printable(", ".join(map(str, names)))[:300]


# --------------------------------------------------------------------------------------- times


def _times(
    path: Path | str, table: Table, options: LogOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None, list[str]]:
    """Times of the rows, when their commands were sent where that is known, and notes."""
    count = max(map(len, table.columns.values()), default=0)
    if options.rate is not None:
        return np.arange(count) / options.rate, None, []  # of each joint's own rows: `_joint`
    names = [name for name in table.names if name in table.columns or name in table.texts]
    moving = [n for n in names if n in table.texts or np.ptp(known(table, n)) > 0]
    names = moving if has_time(moving) else names
    steps = next((n for n in names if _TIME_STEP.fullmatch(n)), None)
    found = [n for n in time_columns(names) if n != steps]
    if not found and table.tick_s is not None:
        found = [n for n in names if _TIMER.search(n)]
    sent = [n for n in names if (c := column(n)).kind == "time" and c.words & _SENT]
    read = [n for n in names if (c := column(n)).kind == "time" and c.words and n not in sent]
    time, command_time, notes = options.time, options.command_time, []
    if time is not None and time not in table.names and time.count(",") == 1:
        whole, below = (_column_named(path, table, "time", n.strip()) for n in time.split(","))
        return _of_two(path, table, whole, below)[0], None, []
    if time is not None:
        time = _column_named(path, table, "time", time)
    elif not found and len(sent) == 1 and len(read) == 1:
        time, command_time = read[0], command_time or sent[0]
        notes.append(f"commands were taken as sent at {command_time}, positions as read at {time}.")
    elif found or read:
        time = (found or read)[0]
    elif steps is not None:
        total = np.cumsum(table.numbers(path, steps))
        found_clock = clock(steps.lower().removeprefix("d"), total)
        text = f"times are the sums of {steps}, the time between rows."
        return found_clock.seconds(total), None, [*found_clock.notes, text]
    else:
        raise InputError(
            f"{path}: no column is a time (time, timestamp, t …, also with _s, _ms, _us or _ns); "
            f"it has {_listed(table.names)}. Name it with `time`, or give the rows a second with "
            "`rate`."
        )
    read_s, at, texts = _seconds(path, table, time)
    notes += texts
    if command_time is None:
        if options.time is None and sent and time not in sent:
            notes.append(
                f"commands may have been sent at {sent[0]}: if so, "
                f"{import_line(path, time=time, command_time=sent[0])}."
            )
        return read_s, None, notes
    command_time = _column_named(path, table, "command_time", command_time)
    send_s, other, texts = _seconds(path, table, command_time)
    gap = at - other
    return read_s, send_s - gap, [*notes, *texts]


_SENT = frozenset(
    "command commands commanded cmd cmds goal target send sent tx action write written".split()
)


def _seconds(
    path: Path | str, table: Table, name: str
) -> tuple[NDArray[np.float64], float, list[str]]:
    """Times of a column in seconds, the time that counts as 0, and notes."""
    if name in table.texts:
        seconds = times_of_day(path, name, table.texts[name])
        below = table.first(("ms", "msec", "millis", "milliseconds", "millisecond"))
        if below is not None and not (seconds % 1).any():  # 12:30:01 and 250
            seconds = seconds + 1e-3 * (table.numbers(path, below) % 1000)
        return seconds, 0.0, []
    values = unwrapped(table.numbers(path, name))
    lower = {n.lower(): n for n in table.columns}
    whole = re.fullmatch(r"(.*?)(?:secs?|seconds?)", name.lower())
    rest = [lower[n] for end in _SUBSECONDS if whole and (n := whole[1] + end) in lower]
    if rest:
        return *_of_two(path, table, name, rest[0]), []
    found = clock(name, values, table.tick_s)
    return found.seconds(values), found.zero * found.scale, found.notes


def _of_two(
    path: Path | str, table: Table, name: str, rest: str
) -> tuple[NDArray[np.float64], float]:
    """Times in seconds and what is below one in a column of its own, as stamps of ROS have them."""
    values, below = table.numbers(path, name), table.numbers(path, rest)
    zero = float(np.nanmin(values))
    part = 1e-3 if rest.lower().endswith("ms") else 1e-6 if np.nanmax(below) < 1e6 else 1e-9
    return values - zero + part * below, zero


# ---------------------------------------------------------------------------------------- rows


def spread(path: Path | str, table: Table, options: LogOptions) -> Table:
    """A table with one value a row and its name (`time, name, value`) as columns by name.

    A row has its value in the column of its name. Other tables come back as they are.
    """
    if options.command:
        return table
    by_case = {n.lower(): n for n in table.texts}
    value = table.first(_VALUES)
    if value is None:
        own = [n for n in table.columns if column(n).kind != "time" and n.lower() not in LABELS]
        if len(own) != 1:
            return table
        value = own[0]
    for series in (by_case[n] for n in SERIES if n in by_case):
        codes, found = pd.factorize(np.array(table.texts[series], object))
        if len(found) > MOST_COLUMNS or missing([*map(str, found)]):
            continue
        refuse_more(path, len(codes) * len(found), MOST_CELLS, "cells", "Split it by joint.")
        values = table.numbers(path, value)
        columns = {n: v for n, v in table.columns.items() if n != value}
        columns |= {str(n): np.where(codes == k, values, np.nan) for k, n in enumerate(found)}
        texts = {n: t for n, t in table.texts.items() if n != series}
        note = f"each row holds one value, named by {series}."
        return replace(table, columns=columns, texts=texts, notes=(*table.notes, note))
    return table


def _groups(path: Path | str, table: Table) -> dict[str, NDArray[np.bool_]]:
    """Rows by joint, where columns name or number it; by leg and joint where both do."""
    found: dict[str, NDArray[np.bool_]] = {}
    texts = {n.lower(): n for n in table.texts}
    numbers = {n.lower(): n for n in table.columns}
    for name in GROUPS:
        if name in texts:
            codes, values = pd.factorize(np.array(table.texts[texts[name]], object))
            refuse_more(f"{path}, column {name}", len(values), MOST_JOINTS, "joints")
            own: dict[str, NDArray[np.bool_]] = {}
            for code, value in enumerate(values):
                if word := value.strip():
                    own[word] = own.get(word, False) | (codes == code)
        elif name in numbers and column(name).kind in ("", "unknown"):
            own = _numbered(path, table, numbers[name])
        else:
            continue
        if len(found) > 1 and len(own) > 1:
            found = {f"{one}_{other}": both for (one, a), (other, b) in
                     product(found.items(), own.items()) if (both := a & b).any()}  # fmt: skip
            refuse_more(f"{path}, column {name}", len(found), MOST_JOINTS, "joints")
        elif len(own) > len(found):
            found = own
    return found


def _numbered(path: Path | str, table: Table, name: str) -> dict[str, NDArray[np.bool_]]:
    """Rows by the whole numbers of a column that has few of them."""
    numbers = table.numbers(path, name)
    known, counts = np.unique(numbers[np.isfinite(numbers)], return_counts=True)
    if len(known) > _MOST_GROUPS or (known % 1 != 0).any() or (counts < _FEWEST_ROWS).any():
        return {}
    refuse_more(f"{path}, column {name}", len(known), MOST_JOINTS, "joints")
    word = re.sub(r"[_\s]?(idx|id|index|name)$", "", name.lower()) or "motor"
    return {f"{word}_{v:g}": numbers == v for v in known}


def _joint(
    path: Path | str,
    table: Table,
    options: LogOptions,
    pair: _Pair,
    times_s: tuple[NDArray[np.float64], NDArray[np.float64] | None],
    own: NDArray[np.bool_],
    names: tuple[str, str],
    metadata: dict[str, Any],
) -> tuple[pd.DataFrame, list[str]]:
    """Rows of one joint; its doubt goes into the header."""
    own, held = _apart(path, table, times_s, pair, own)
    stamp, sent = times_s[0][own], None if times_s[1] is None else times_s[1][own]
    if held is not None and held[0] is not None:
        sent = held[0]
    if options.rate is not None:
        stamp = np.arange(len(stamp)) / options.rate
    trial, tone, warnings = _trials(path, table, options, own)
    if held is not None and held[0] is not None:
        warnings.append(
            "commands and positions stand in rows of their own: each row's time is that of what "
            "it holds, and a command was taken as in force until the next one."
        )
    number, shifted = one_after_another(stamp, trial)
    if trial is None and number.max(initial=0) > 0:
        warnings.append(
            f"its times start again ({number.max():g} ×): each run of rows was taken for a trial "
            "of the same joint."
        )
    if sent is not None:
        send, read, doubt = sent_at(sent, stamp) + (shifted - stamp), shifted, 0.0
    else:
        send, read, doubt, texts = turns(shifted, options)
        warnings += texts
    if options.rate is not None:
        doubt = max(doubt, doubt_of_a_turn(stamp)[0])
        warnings.append(
            f"its times are row numbers over {options.rate:g} Hz: lag and dead time scale with "
            "that rate, and are in doubt by half a turn."
        )
    metadata["bus"]["read_time_doubt_s"] = max(doubt, metadata["bus"].get("read_time_doubt_s", 0.0))
    apart = read - send
    metadata["read_after_send_s"] = float(np.clip(np.nanmedian(apart), -1, 1)) if len(send) else 0.0
    used = {"command": pair.command.name, "position": pair.position.name}
    metadata.setdefault("columns", {})[names[1]] = used
    stated = options.unit_of(*names)
    columns: dict[str, Any] = {}
    measured = table.numbers(path, pair.position.name)[own]
    for key, source in (("command_rad", pair.command), ("position_rad", pair.position)):
        values = table.numbers(path, source.name)[own]
        if held is not None and key == "command_rad":
            values = held[1]
        factor = stated[key == "position_rad"] if stated else None
        if stated is None:
            factor = _of_name(path, source, measured, table.numbers(path, pair.command.name)[own])
        if factor is None and not source.unit and (word := table.stated_unit(source.name)):
            factor = unit(word)
            metadata["angle_unit"] = "stated"
            warnings.append(f"{source.name} was taken as {word}, as the log says beside it.")
        factor = factor or Unit()
        columns[key] = factor.radians(values)
        if factor.counts and stated is None:
            turn = round(2 * np.pi / factor.scale)
            zero = "half of them 0 rad" if factor.zero else "0 rad at count 0"
            warnings.append(
                f"columns in counts were taken as {turn} counts a turn, {zero}. If that is wrong, "
                "give `unit`, such as counts:1024."
            )
        if key == "position_rad" and factor.counts:
            columns["position_count"] = values
        if stated or source.unit not in ("", "rad"):
            metadata["angle_unit"] = "stated"
    for name in _KEPT:
        if name in table.columns:
            columns[name] = table.numbers(path, name)[own]
    part = rows(
        names[1], send, read, columns.pop("command_rad"), columns.pop("position_rad"), number,
        **columns,
    )  # fmt: skip
    if tone is not None:
        part["frequency_hz"] = tone
        several = part.groupby("trial")["frequency_hz"].transform("nunique").to_numpy() > 1
        part.loc[several, "frequency_hz"] = np.nan  # a chirp is no tone
    return part, warnings


def _apart(
    path: Path | str,
    table: Table,
    times_s: tuple[NDArray[np.float64], NDArray[np.float64] | None],
    pair: _Pair,
    own: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], tuple[NDArray[np.float64] | None, NDArray[np.float64]] | None]:
    """Rows of a joint's positions, and its commands at them, where most rows lack one of both.

    As PlotJuggler, long tables and outer joins write signals of several clocks. An empty cell of a
    command means that the last one stays in force.
    """
    command, position = (table.numbers(path, c.name) for c in (pair.command, pair.position))
    sent, read = own & np.isfinite(command), own & np.isfinite(position)
    apart = (sent & read).sum() < _TOGETHER * min(sent.sum(), read.sum())
    if times_s[1] is not None or not (apart or (read & ~sent).sum() > _MOSTLY_BLANK * read.sum()):
        return own, None
    rows_of = np.flatnonzero(read if apart else own)
    order = np.flatnonzero(sent)[np.argsort(times_s[0][sent], kind="stable")]
    send, held, kept = held_commands(times_s[0][order], command[order], times_s[0][rows_of])
    chosen = np.zeros(len(own), bool)
    chosen[rows_of[kept]] = True
    if not kept.any():
        return own, None
    one_stamp = not apart or np.isin(times_s[0][chosen], times_s[0][sent]).mean() > _ONE_STAMP
    return chosen, (None if one_stamp else send, held)


def _trials(
    path: Path | str, table: Table, options: LogOptions, own: NDArray[np.bool_]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None, list[str]]:
    """Number of each row's trial, its frequency, and notes; None where there is none.

    A change of the frequency begins a trial, unless it changes so often that it is a chirp's.
    """
    notes: list[str] = []
    trial = None
    name = table.first(_TRIALS)
    if options.trial:
        name = _column_named(path, table, "trial", options.trial)
    if name is not None and options.trial is None and name in table.columns:
        runs = np.count_nonzero(np.diff(table.numbers(path, name)[own]))
        name = None if runs > _COUNTING * own.sum() else name
    if name is not None and name in table.texts:
        codes, labels = pd.factorize(np.array(table.texts[name], object))
        trial = codes[own].astype(float)
        listed = ", ".join(f"{k}: {printable(str(v))[:30]}" for k, v in enumerate(labels[:12]))
        notes.append(f"trials are the runs of rows with one {name} ({listed}).")
    elif name is not None:
        trial = table.numbers(path, name)[own]
    tone_name = table.first(_TONES)
    if tone_name is None:
        return trial, None, notes
    tone = table.numbers(path, tone_name)[own]
    with np.errstate(invalid="ignore"):
        change = np.diff(np.nan_to_num(tone)) != 0
    edges = np.concatenate([[0], 1 + np.flatnonzero(change), [len(tone)]])
    if change.any() and np.median(np.diff(edges)) >= _SHORTEST_TONE:
        runs = np.concatenate([[0], np.cumsum(change)])
        if trial is None:
            notes.append(f"a change of {tone_name} begins a trial.")
            trial = runs.astype(float)
        else:
            new = np.concatenate([[False], change | (np.diff(trial) != 0)])
            trial = np.cumsum(new).astype(float)
    return trial, tone, notes


def _of_name(
    path: Path | str,
    source: Column,
    positions: NDArray[np.float64],
    commands: NDArray[np.float64],
) -> Unit | None:
    """The unit that a column's name ends in; counts are of a usual turn that holds `positions`.

    Commands below 0 are counted from 0 rad; a position below 0 may be a failed reading.
    """
    if source.unit in ("", "rad"):
        return None
    if source.unit in _LACKING:
        text, example = _LACKING[source.unit]
        raise InputError(
            f"{path}, column {printable(source.name)[:60]}: {text}: "
            f"{import_line(path, unit=example)}."
        )
    if source.unit == "counts":
        known = positions[np.isfinite(positions)]
        if (known % 1 != 0).any():  # a raw angle
            return None
        if (commands < 0).any() and (commands[np.isfinite(commands)] % 1 == 0).all():
            return unit("counts:4096:0")
        fine = len(known) > 0 and float(np.median(known)) > 4096 and known.max() < 16384
        return unit(f"counts:{16384 if fine else 4096}")
    return unit(source.unit)
