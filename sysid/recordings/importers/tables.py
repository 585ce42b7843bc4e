"""Rows of a recording from a table with any column names: `read_table`.

    time, knee_command, knee_position, ankle_command, ankle_position
    timestamp, action.pan, action.lift, observation.state.pan, observation.state.lift
    time_ms, leg, hip_goal, hip_present
    time, name, value

CSV, JSON, parquet, arrays and tables in memory come here as columns. `importers.pairs` says which
are the command and the position of which joint; a joint's rows may be named in columns, and a row
may hold one value.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_CELLS, MOST_COLUMNS, is_failure
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers import refusals, times
from pupper_sysid.sysid.recordings.importers.columns import (
    TIME_STEP,
    TIMER,
    Column,
    column,
    has_time,
    time_columns,
)
from pupper_sysid.sysid.recordings.importers.log import (
    MOST_JOINTS,
    Log,
    Table,
    held_commands,
    joint_names,
    rows,
)
from pupper_sysid.sysid.recordings.importers.options import MOVES_ALIKE, LogOptions, Unit, unit
from pupper_sysid.sysid.recordings.importers.pairs import SOLE, Pair, column_named, pairs

LAYOUT = "table"

_TRIALS = ("trial", "episode_index", "episode", "loop", "run", "segment")
_TONES = ("frequency_hz", "freq_hz", "frequency", "freq")
SERIES = ("name", "signal", "event", "type", "kind", "variable", "topic", "field", "series",
           "metric", "key", "channel", "_field", "_measurement", "op", "operation", "direction",
           "dir", "param", "parameter", "quantity", "label", "source", "item",
           "register", "what", "tag", "var", "msg_type")  # fmt: skip
_VALUES = ("value", "values", "val", "_value", "data")
GROUPS = ("leg", "limb", "arm", "side", "joint", "joint_name", "motor", "motor_name", "servo",
           "servo_name", "actuator", "name", "axis", "dof", "motor_idx", "motor_id", "motor_index",
           "joint_idx", "joint_id", "joint_index", "servo_id", "actuator_id", "dxl_id", "can_id",
           "node_id", "id")  # fmt: skip
LABELS = frozenset((*SERIES, *GROUPS, *_TRIALS))
"""Columns that may hold text, in lower case."""
_SUBSECONDS = ("nanosec", "nanosecs", "nsec", "nsecs", "usec", "usecs", "msec", "ms")
_MILLISECONDS = ("ms", "msec", "millis", "milliseconds", "millisecond")
_KEPT = ("p_gain", "torque_enabled", "voltage_v", "temperature_c", "load")
_SENT = frozenset(
    "command commands commanded cmd cmds goal target send sent tx action write written".split()
)
"""Words of a time at which a command was sent."""
_ACTIONS = frozenset(("action", "actions"))
_ACTS_ALIKE = 1.7  # factor by which a joint may move more or less than its action
_ACTION_SCALES = (0.1, 0.2, 0.25, 0.3, 0.5, 2.0, 3.0)
_MOST_GROUPS = 1000
_TOGETHER = 0.2  # share of the rows with a command or position that have both
_FEWEST_ROWS = 3  # of a joint in a table with a row per joint
_COUNTING = 0.3  # share of rows with another trial than the row before: it counts them
_SHORTEST_TONE = 20  # rows of one frequency; a chirp changes it sooner
_SIDE_BY_SIDE = 0.1  # share of the log by which sending and reading may come apart
_MOSTLY_BLANK, _ONE_STAMP = 0.3, 0.9  # shares of positions without a command, with its time
_LACKING = {
    "percent": ("percent of a range of motion that the log does not say. Give it, as of 3.5 rad",
                "percent:3.5"),
    "share": ("shares of a range that the log does not say. Give the rad that 1 is, as of ±90°",
              "scale:1.5708"),
    "length": ("lengths, and no angles. Give the rad of 1, as of mm of a wheel of 20 mm radius",
               "scale:0.05"),
    "steps": ("the log does not say how many steps make a turn. Give them, as of 3200",
              "counts:3200:0"),
}  # fmt: skip
"""Units that a name does not say whole, what to do, and an example."""
_LASTING = re.compile(r"loop|exec|cycle|proc|comput|infer|sleep|duration|latency", re.IGNORECASE)
_FLAG = re.compile(
    r"(.*?)[_. ]?(?:is|read|pos|rx)?[_. ]?"
    r"(?:(valid|ok|success|status|result)|invalid|timeout|timed_?out|lost|failed|"
    r"(?:comm|crc|read|rx)[_. ]?(?:error|result|err))",
    re.IGNORECASE,
)  # fmt: skip
_MOST_FAILED = 0.5  # of the rows: more are another meaning


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
        raise InputError(f"{path}: {refusals.unknown_numbers(path, table)}")
    return read_table(path, table, options, layout)


def read_table(path: Path | str, table: Table, options: LogOptions, layout: str = LAYOUT) -> Log:
    """The rows of a table."""
    refuse_more(path, len(table.names), MOST_COLUMNS, "columns", "Split it by joint.")
    refuse_more(path, sum(map(len, table.columns.values())), MOST_CELLS, "cells", "Split it.")
    table = spread(path, table, options)
    if table.rate and options.rate is None and not (options.time or has_time(table.moving)):
        options = replace(options, rate=table.rate)
    notes = list(table.notes)
    pair_of, texts = pairs(path, table, options)
    notes += texts
    table, texts = _without_failed(path, table, pair_of)
    notes += texts
    read_s, send_s, texts = _times(path, table, options)
    notes += texts
    groups = _groups(path, table)
    if any(times.scrambled(read_s[of_joint]) for of_joint in groups.values() or [slice(None)]):
        first = table.first(_TRIALS)
        trial = np.zeros(len(read_s)) if first is None else table.columns[first]
        order = np.lexsort((read_s, trial))
        read_s, send_s = read_s[order], None if send_s is None else send_s[order]
        table = table.taken(order)
        groups = _groups(path, table)
        notes.append("its rows, which were in no order of time or the newest first, were sorted.")
    if not (len(groups) > 1 or (groups and [*pair_of] == [SOLE])):
        groups = {"": np.ones(len(read_s), bool)}
    joints = {  # by the log's own name
        "_".join(w for w in (group, "" if name == SOLE and group else name) if w): (of_joint, pair)
        for (group, of_joint), (name, pair) in product(groups.items(), pair_of.items())
    }  # fmt: skip
    if options.joints and [*joints] == [SOLE] and len(options.joints) == 1:
        joints = {next(iter(options.joints)): joints[SOLE]}
    for joint in options.joints:
        if joint not in joints:
            raise InputError(
                f"{path}: `joints` names {printable(joint)}, which has no command and position; "
                f"{refusals.listed(joints)} have."
            )
    theirs = [*options.joints] or [*joints]
    names = joint_names(path, [options.joints.get(j) or j for j in theirs])
    _refuse_some_without_unit(path, options, {j: joints[j][1] for j in theirs})
    metadata: dict[str, Any] = {"imported_from": layout, "joints": names, "bus": {}}
    if options.readings:
        metadata["readings"] = options.readings
    parts = []
    for joint, name in zip(theirs, names, strict=True):
        part, texts = _joint(path, table, options, joints[joint][1], (read_s, send_s),
                             joints[joint][0], (joint, name), metadata)  # fmt: skip
        parts.append(part)
        notes += [text for text in texts if text not in notes]
    if options.unit is None and all(
        joints[j][1].command.words <= _ACTIONS and not joints[j][1].command.unit for j in theirs
    ):
        _refuse_raw_actions(path, options, parts)
    return Log(pd.concat(parts, ignore_index=True), metadata, [*map(printable, notes)])


def _refuse_some_without_unit(
    path: Path | str, options: LogOptions, pair_of: Mapping[str, Pair]
) -> None:
    """Refuse joints whose unit does not say how far they turn beside others that it would spoil."""
    lacking = {
        joint: next(c for c in (pair.command, pair.position) if c.unit in _LACKING)
        for joint, pair in pair_of.items()
        if {pair.command.unit, pair.position.unit} & {*_LACKING} and not options.unit_of(joint)
    }
    others = [joint for joint in pair_of if joint not in lacking]
    if lacking and others:
        joint, source = next(iter(lacking.items()))
        text, example = _LACKING[source.unit]
        raise InputError(
            f"{path}, column {printable(source.name)[:60]}: {text}, in a mapping file "
            f"(`units: {{{joint}: '{example}'}}`), or leave {joint} out: "
            f"{refusals.import_line(path, joints=','.join(others))}."
        )


def _refuse_raw_actions(
    path: Path | str, options: LogOptions, parts: Sequence[pd.DataFrame]
) -> None:
    """Refuse a policy's actions from which set-points are still to be made.

    A joint's set-point is its default angle and a share, the same for all, of its action.
    """
    factors = []
    for part in parts:
        ranges = [_spread(part[f"{kind}_rad"].to_numpy(float)) for kind in ("position", "command")]
        factors += [ranges[0] / ranges[1]] if min(ranges) > 0 else []
    factor = float(np.median(factors)) if factors else 1.0
    if not 1 / _ACTS_ALIKE < factor < _ACTS_ALIKE:
        usual = min(_ACTION_SCALES, key=lambda scale: abs(np.log(scale / factor)))
        raw, angles = (refusals.import_line(path, **(options.words | {"unit": text}))
                       for text in (f"scale:{usual:g},rad", "rad"))  # fmt: skip
        raise InputError(
            f"{path}: its joints move {factor:.2g} times as far as its actions, so these seem to "
            "be a policy's own, which a default angle and a scale turn into set-points. Log the "
            f"set-points, or give your action_scale in place of {usual:g}: {raw}; or, if they are "
            f"set-points: {angles}."
        )


def _spread(values: NDArray[np.float64]) -> float:
    """Range of all but the outermost values; 0 without any."""
    known = values[np.isfinite(values)]
    return float(np.ptp(np.quantile(known, (0.05, 0.95)))) if len(known) else 0.0


def is_flag(name: str) -> tuple[str, bool] | None:
    """Whose readings a column says to be good or failed, and whether 1 is good; None for others."""
    match = _FLAG.fullmatch(name[:100])
    return None if match is None else (column(match[1]).key, bool(match[2]))


def _without_failed(
    path: Path | str, table: Table, pair_of: Mapping[str, Pair]
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
        flagged = [pair for pair in pair_of.values() if flag[0] in ("", pair.position.key)]
        if not flagged or not failed.any() or failed.mean() > _MOST_FAILED:
            continue
        for position in {pair.position.name for pair in flagged}:
            columns[position] = np.where(failed, np.nan, table.numbers(path, position))
        notes.append(
            f"{int(failed.sum())} readings failed by the column {printable(name)[:40]}, and were "
            "left out."
        )
    return (replace(table, columns=columns) if notes else table), notes


# --------------------------------------------------------------------------------------- times


def _times(
    path: Path | str, table: Table, options: LogOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None, list[str]]:
    """Times of the rows, when their commands were sent where that is known, and notes."""
    if not (count := max(map(len, table.columns.values()), default=0)):
        raise InputError(f"{path} has no rows. Record it again.")
    if options.rate is not None:
        return np.arange(count) / options.rate, None, []  # of each joint's own rows: `_joint`
    names = table.moving if has_time(table.moving) else table.names
    names = [name for name in names if name in table.columns or name in table.texts]
    rising = [n for n in names if n in table.columns and (np.diff(table.known(n)) > 0).all()]
    steps = next((n for n in names if TIME_STEP.fullmatch(n) and n not in rising), None)
    lasting = [n for n in names if _LASTING.search(n) and n in table.columns and n not in rising]
    candidates = [n for n in time_columns(names) if n != steps and n not in lasting]
    candidates = candidates or [n for n in table.increasing if TIME_STEP.fullmatch(n)]
    if not candidates and table.tick_s is not None:
        candidates = [n for n in names if TIMER.search(n)]
    sent = [n for n in names if (c := column(n)).kind == "time" and c.words & _SENT]
    read = [n for n in names if (c := column(n)).kind == "time" and c.words
            and n not in (*sent, *lasting)]  # fmt: skip
    time, command_time, notes = options.time, options.command_time, []
    if time is not None and time not in table.names and time.count(",") == 1:
        seconds, below = (column_named(path, table, "time", n.strip()) for n in time.split(","))
        return _of_two(path, table, seconds, below)[0], None, []
    if time is not None:
        time = column_named(path, table, "time", time)
    elif not candidates and len(sent) == 1 and len(read) == 1:
        time, command_time = read[0], command_time or sent[0]
        notes.append(f"commands were taken as sent at {command_time}, positions as read at {time}.")
    elif candidates or read:
        time = (candidates or read)[0]
    elif steps is not None:
        total = np.cumsum(table.numbers(path, steps))
        found_clock = times.clock(steps.lower().removeprefix("d"), total)
        text = f"times are the sums of {steps}, the time between rows."
        return found_clock.seconds(total), None, [*found_clock.notes, text]
    else:
        lines = [refusals.import_line(path, time=name) for name in rising[:1]]
        lines.append(refusals.import_line(path, rate="50"))
        how_long = f"{lasting[0]} says how long something takes, not when; " if lasting else ""
        raise InputError(
            f"{path}: {how_long}no column is a time (time, timestamp, t …, also with _s, _ms, _us "
            f"or _ns); it has {refusals.listed(table.names)}. Name it, or give your rows a second "
            f"in place of 50: {'; or '.join(lines)}."
        )
    read_s, at, texts = _seconds(path, table, time)
    notes += texts
    if command_time is None:
        if options.time is None and sent and time not in sent:
            notes.append(
                f"commands may have been sent at {sent[0]}: if so, "
                f"{refusals.import_line(path, time=time, command_time=sent[0])}."
            )
        return read_s, None, notes
    command_time = column_named(path, table, "command_time", command_time)
    send_s, other, texts = _seconds(path, table, command_time)
    return read_s, send_s - (at - other), [*notes, *texts]


def _seconds(
    path: Path | str, table: Table, name: str
) -> tuple[NDArray[np.float64], float, list[str]]:
    """Times of a column in seconds, the time that counts as 0, and notes."""
    if name in table.texts:
        seconds = times.times_of_day(path, name, table.texts[name])
        below = table.first(_MILLISECONDS)
        if below is not None and not (seconds % 1).any():  # 12:30:01 and 250
            seconds = seconds + 1e-3 * (table.numbers(path, below) % 1000)
        return seconds, 0.0, []
    values = times.unwrapped(table.numbers(path, name))
    lower = {n.lower(): n for n in table.columns}
    match = re.fullmatch(r"(.*?)(?:secs?|seconds?)", name.lower())
    rest = [lower[n] for end in _SUBSECONDS if match and (n := match[1] + end) in lower]
    below = table.first(_MILLISECONDS)
    whole = below not in (None, name) and not (values % 1).any() and not np.diff(values).all()
    if below and whole and 0 <= table.known(below).min() <= table.known(below).max() < 1000:
        rest = rest or [below]
    if rest:
        return *_of_two(path, table, name, rest[0]), []
    clock = times.clock(name, values, table.tick_s)
    return clock.seconds(values), clock.zero * clock.scale, clock.notes


def _of_two(
    path: Path | str, table: Table, name: str, rest: str
) -> tuple[NDArray[np.float64], float]:
    """Times in seconds and what is below one in a column of its own, as stamps of ROS have them."""
    values, below = table.numbers(path, name), table.numbers(path, rest)
    zero = float(table.known(name).min())
    small = table.known(rest).max() < 1e6
    part = (
        1e-3
        if rest.lower() in _MILLISECONDS or rest.lower().endswith("ms")
        else 1e-6
        if small
        else 1e-9
    )
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
        value_columns = [
            n for n in table.columns if column(n).kind != "time" and n.lower() not in LABELS
        ]
        if len(value_columns) != 1:
            return table
        value = value_columns[0]
    for series in (by_case[n] for n in SERIES if n in by_case):
        codes, labels = pd.factorize(np.array(table.texts[series], object))
        if len(labels) > MOST_COLUMNS or refusals.missing([*map(str, labels)]):
            continue
        refuse_more(path, len(codes) * len(labels), MOST_CELLS, "cells", "Split it by joint.")
        values = table.numbers(path, value)
        columns = {n: v for n, v in table.columns.items() if n != value}
        columns |= {str(n): np.where(codes == k, values, np.nan) for k, n in enumerate(labels)}
        texts = {n: t for n, t in table.texts.items() if n != series}
        note = f"each row holds one value, named by {series}."
        return replace(table, columns=columns, texts=texts, notes=(*table.notes, note))
    return table


def _groups(path: Path | str, table: Table) -> dict[str, NDArray[np.bool_]]:
    """Rows by joint, where columns name or number it; by leg and joint where both do."""
    groups: dict[str, NDArray[np.bool_]] = {}
    texts = {n.lower(): n for n in table.texts}
    numbers = {n.lower(): n for n in table.columns}
    for name in GROUPS:
        if name in texts:
            codes, values = pd.factorize(np.array(table.texts[texts[name]], object))
            refuse_more(f"{path}, column {name}", len(values), MOST_JOINTS, "joints")
            by_label: dict[str, NDArray[np.bool_]] = {}
            for code, value in enumerate(values):
                if word := value.strip():
                    by_label[word] = by_label.get(word, False) | (codes == code)
        elif name in numbers and column(name).kind in ("", "unknown"):
            by_label = _numbered(path, table, numbers[name])
        else:
            continue
        if len(groups) > 1 and len(by_label) > 1:
            groups = {
                f"{group}_{label}": both
                for (group, a), (label, b) in product(groups.items(), by_label.items())
                if (both := a & b).any()
            }
            refuse_more(f"{path}, column {name}", len(groups), MOST_JOINTS, "joints")
        elif len(by_label) > len(groups):
            groups = by_label
    return groups


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
    pair: Pair,
    times_s: tuple[NDArray[np.float64], NDArray[np.float64] | None],
    of_joint: NDArray[np.bool_],
    names: tuple[str, str],
    metadata: dict[str, Any],
) -> tuple[pd.DataFrame, list[str]]:
    """Rows of one joint; its doubt and its columns go into the header."""
    of_joint, sent, held = _apart(path, table, times_s, pair, of_joint)
    stamp = times_s[0][of_joint]
    if options.rate is not None:
        stamp = np.arange(len(stamp)) / options.rate
    trial, tone, warnings = _trials(path, table, options, of_joint)
    if held is not None and sent is not None:
        warnings.append(
            "commands and positions stand in rows of their own: each row's time is that of what "
            "it holds, and a command was taken as in force until the next one."
        )
    number, shifted = times.one_after_another(stamp, trial)
    if trial is None and number.max(initial=0) > 0:
        warnings.append(
            f"its times start again or jump on by more than an hour ({number.max():g} ×): each run "
            "of rows was taken for a trial of the same joint."
        )
    if sent is not None:
        send, read, doubt = times.sent_at(sent, stamp) + (shifted - stamp), shifted, 0.0
    else:
        send, read, doubt, texts = times.turns(shifted, options)
        warnings += texts
    if options.rate is not None:
        doubt = max(doubt, times.doubt_of_a_turn(stamp)[0])
        warnings.append(
            f"its times are row numbers over {options.rate:g} Hz: lag and dead time scale with "
            "that rate, and are in doubt by half a turn."
        )
    metadata["bus"]["read_time_doubt_s"] = max(doubt, metadata["bus"].get("read_time_doubt_s", 0.0))
    apart = (read - send)[np.isfinite(read - send)]
    metadata["read_after_send_s"] = float(np.clip(np.median(apart), -1, 1)) if len(apart) else 0.0
    used = {"command": pair.command.name, "position": pair.position.name}
    metadata.setdefault("columns", {})[names[1]] = used
    commands = table.numbers(path, pair.command.name)[of_joint]
    positions = table.numbers(path, pair.position.name)[of_joint]
    stated, units = options.unit_of(*names), table.units
    stated_kinds: set[str] = set()
    if stated is None and not units:
        pair, texts = _one_unit(pair, commands if held is None else held, positions)
        warnings += texts
    columns: dict[str, Any] = {}
    for kind, source, values in (
        ("command", pair.command, commands if held is None else held),
        ("position", pair.position, positions),
    ):
        if stated is not None or source.unit not in ("", "rad"):
            stated_kinds.add(kind)
        if stated is not None:
            factor = stated[kind == "position"]
        else:
            factor = _of_name(path, source, positions, commands)
            if (
                factor is None
                and not source.unit
                and (word := units.get(source.name, units.get("")))
            ):
                factor = unit(word)
                stated_kinds.add(kind)
                warnings.append(f"{source.name} was taken as {word}, as the log says beside it.")
            factor = factor or Unit()
            if factor.counts:
                zero = "half of them 0 rad" if factor.zero else "0 rad at count 0"
                warnings.append(
                    f"columns in counts were taken as {round(2 * np.pi / factor.scale)} counts a "
                    f"turn, {zero}. If that is wrong, give `unit`, such as counts:1024."
                )
        columns[f"{kind}_rad"] = factor.radians(values)
        if kind == "position" and factor.counts:
            columns["position_count"] = values
    angles = columns.pop("command_rad"), columns.pop("position_rad")
    if len(stated_kinds) == 2:
        metadata["angle_unit"] = "stated"
    columns |= {
        name: table.numbers(path, name)[of_joint] for name in _KEPT if name in table.columns
    }
    part = rows(names[1], send, read, *angles, number, **columns)
    if tone is not None:
        part["frequency_hz"] = tone
        several = part.groupby("trial")["frequency_hz"].transform("nunique").to_numpy() > 1
        part.loc[several, "frequency_hz"] = np.nan  # a chirp is no tone
    return part, warnings


def _one_unit(
    pair: Pair, commands: NDArray[np.float64], positions: NDArray[np.float64]
) -> tuple[Pair, list[str]]:
    """The pair, one of which names a unit, with that for the other where both move as far by it."""
    units = pair.command.unit, pair.position.unit
    if bool(units[0]) == bool(units[1]) or set(units) & {"rad", *_LACKING}:
        return pair, []
    if "counts" in units and any((v[np.isfinite(v)] % 1 != 0).any() for v in (commands, positions)):
        return pair, []
    ranges = _spread(commands), _spread(positions)
    if not min(ranges) > 0 or not 1 / MOVES_ALIKE < ranges[0] / ranges[1] < MOVES_ALIKE:
        return pair, []
    word = units[0] or units[1]
    both = Pair(replace(pair.command, unit=word), replace(pair.position, unit=word))
    silent, named = (pair.position, pair.command) if units[0] else (pair.command, pair.position)
    return both, [
        f"{silent.name} names no unit, and was taken as {word} like {named.name}, since it moves "
        "as far. If that is wrong, give `unit`, such as deg,rad."
    ]


def _apart(
    path: Path | str,
    table: Table,
    times_s: tuple[NDArray[np.float64], NDArray[np.float64] | None],
    pair: Pair,
    of_joint: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Rows of a joint, when their commands were sent if known, and commands that were held.

    As PlotJuggler, long tables and outer joins write signals of several clocks, most rows may lack
    a command or a position: the rows are then those of positions. An empty cell of a command means
    that the last one stays in force.
    """
    stamp, send = times_s
    sent_s = stamp if send is None else send
    command, position = (table.numbers(path, c.name) for c in (pair.command, pair.position))
    sent = of_joint & np.isfinite(command) & np.isfinite(sent_s)
    read = of_joint & np.isfinite(position) & np.isfinite(stamp)
    if send is not None:
        both = of_joint & np.isfinite(stamp) & np.isfinite(send)
        late = (stamp - send)[both] if both.any() else np.zeros(1)
        apart = np.ptp(late) > _SIDE_BY_SIDE * (np.nanmax(stamp) - np.nanmin(stamp))
        if not apart:
            return of_joint, send[of_joint], None
    else:
        apart = (sent & read).sum() < _TOGETHER * min(sent.sum(), read.sum())
        if not (apart or (read & ~sent).sum() > _MOSTLY_BLANK * read.sum()):
            return of_joint, None, None
    rows_of = np.flatnonzero(read if apart else of_joint)
    order = np.flatnonzero(sent)[np.argsort(sent_s[sent], kind="stable")]
    in_force, held, kept = held_commands(sent_s[order], command[order], stamp[rows_of])
    if not kept.any():
        return of_joint, send, None
    chosen = np.zeros(len(of_joint), bool)
    chosen[rows_of[kept]] = True
    same = not apart or np.isin(stamp[chosen], stamp[sent]).mean() > _ONE_STAMP
    return chosen, None if send is None and same else in_force, held


def _trials(
    path: Path | str, table: Table, options: LogOptions, of_joint: NDArray[np.bool_]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None, list[str]]:
    """Number of each row's trial, its frequency, and notes; None where there is none.

    A change of the frequency begins a trial, unless it changes so often that it is a chirp's.
    """
    notes: list[str] = []
    trial = None
    name = table.first(_TRIALS)
    if options.trial:
        name = column_named(path, table, "trial", options.trial)
    if name is not None and options.trial is None and name in table.columns:
        runs = np.count_nonzero(np.diff(table.numbers(path, name)[of_joint]))
        name = None if runs > _COUNTING * of_joint.sum() else name
    if name is not None and name in table.texts:
        codes, labels = pd.factorize(np.array(table.texts[name], object))
        trial = codes[of_joint].astype(float)
        listed = ", ".join(f"{k}: {printable(str(v))[:30]}" for k, v in enumerate(labels[:12]))
        notes.append(f"trials are the runs of rows with one {name} ({listed}).")
    elif name is not None:
        trial = table.numbers(path, name)[of_joint]
    tone_name = table.first(_TONES)
    if tone_name is None:
        return trial, None, notes
    tone = table.numbers(path, tone_name)[of_joint]
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
            f"{refusals.import_line(path, unit=example)}."
        )
    if source.unit == "counts":
        known = positions[np.isfinite(positions)]
        if (known % 1 != 0).any() and source.name.lower().endswith("raw"):  # an angle
            return None
        if (commands < 0).any() and (commands[np.isfinite(commands)] % 1 == 0).all():
            return unit("counts:4096:0")
        fine = len(known) > 0 and float(np.median(known)) > 4096 and known.max() < 16384
        return unit(f"counts:{16384 if fine else 4096}")
    return unit(source.unit)
