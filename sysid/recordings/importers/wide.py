"""Tables with any column names: two columns per joint, or one row per joint and time.

    time, knee_command, knee_position, ankle_command, ankle_position
    timestamp, action.pan, action.lift, observation.state.pan, observation.state.lift
    time_ms, joint, goal, present_position

CSV, parquet, NumPy's `.npz` and tables in memory come here as columns. A joint is whatever stands
beside a word for a command in one column and a word for a position in another; the pair of words
that names most joints is taken. An ending (`_rad`, `_deg`, `_counts`, `_ms` …) gives the unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.budget import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_CELLS, MOST_COLUMNS
from pupper_sysid.common.reading.names import distinct, one_each
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.shared.log import (
    MOST_JOINTS,
    Log,
    bare_name,
    joint_names,
    rows,
)
from pupper_sysid.sysid.recordings.importers.shared.options import LogOptions
from pupper_sysid.sysid.recordings.importers.shared.times import one_after_another, seconds, turns
from pupper_sysid.sysid.recordings.importers.shared.units import Unit, unit

LAYOUT = "table"

TIMES = ("time", "timestamp", "t", "stamp", "time_since_start", "elapsed", "seconds", "clock")
COMMANDS = (
    "command", "commands", "cmd", "commanded", "commanded_position", "position_command",
    "action", "actions", "goal", "goals", "goal_position", "goal_positions", "target", "targets",
    "target_position", "desired", "desired_position", "setpoint", "set_point", "reference", "ref",
    "q_des", "q_cmd", "q_target", "ctrl", "goal_pos", "target_pos", "command_pos", "cmd_pos",
    "desired_pos", "des_pos", "pos_goal", "pos_target", "pos_command", "pos_cmd", "pos_desired",
    "pos_des", "position_target", "position_goal", "position_desired", "q_ref", "q_d",
)  # fmt: skip
POSITIONS = (
    "position", "positions", "observation.state", "observation", "obs", "state", "actual",
    "actual_position", "measured", "measured_position", "present_position", "present", "reading",
    "feedback", "pos", "qpos", "q", "joint_pos", "joint_position", "joint_positions", "angle",
    "actual_pos", "measured_pos", "present_pos", "current_pos", "current_position", "meas_pos",
    "pos_actual", "pos_measured", "pos_present", "position_actual", "position_measured", "q_meas",
)  # fmt: skip
_TRIALS = ("trial", "episode_index", "episode", "loop", "run", "segment")
_TONES = ("frequency_hz", "freq_hz")
JOINT_COLUMNS = ("joint", "joint_name", "motor", "motor_name", "name")
"""Columns that may name the joint of a row, in lower case."""
_NUMBERED = ("motor_idx", "motor_id", "joint_idx", "joint_id", "servo_id", "id")
_KEPT = ("p_gain", "torque_enabled", "voltage_v", "temperature_c", "load")
_ENDING = r"(?:[_\s]?[(\[]?(?<![a-z])(rad|radians|deg|degrees|counts|ticks|raw)[)\]]?)?"
_SOLE = "joint"  # of a log that names none


@dataclass(frozen=True)
class Table:
    """Columns of a log.

    Attributes
    ----------
    columns : mapping of str to ndarray
        Of numbers, equally long; shape (rows,).
    texts : mapping of str to sequence of str
        Columns that hold text.
    faults : mapping of str to str
        Why a column is no numbers, as a sentence.
    widths : mapping of str to int
        Arrays with a column per joint, and how many; their columns are `<array>.<joint>`.
    joint_names : (str, int), optional
        What names those joints, and how many.
    """

    columns: Mapping[str, NDArray[np.float64]]
    texts: Mapping[str, Sequence[str]] = field(default_factory=dict)
    faults: Mapping[str, str] = field(default_factory=dict)
    widths: Mapping[str, int] = field(default_factory=dict)
    joint_names: tuple[str, int] | None = None

    @property
    def names(self) -> list[str]:
        """Names of all columns."""
        return list(dict.fromkeys([*self.columns, *self.texts, *self.faults]))

    def check_joints(self, path: Path | str, columns: Iterable[str]) -> None:
        """Refuse arrays, of which these are columns, with other numbers of joints than names.

        Raises
        ------
        InputError
            If arrays and names are not equally many.
        """
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

    Parameters
    ----------
    path : Path or str
        For messages.
    arrays : mapping of str to ndarray, shape (rows,) or (rows, joints)
    names : sequence of str
        Of the joints; arrays of another width get `joint_0`, `joint_1` and so on.
    named : str, optional
        What in the log holds these names; None if it does not name its joints.

    Raises
    ------
    InputError
        If a name stands twice.
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


def read_table(path: Path | str, table: Table, options: LogOptions, layout: str = LAYOUT) -> Log:
    """The rows of a table.

    Raises
    ------
    InputError
        If no time, or no joint with command and position, can be found; the message says what is
        missing.
    """
    refuse_more(path, len(table.names), MOST_COLUMNS, "columns", "Split it by joint.")
    refuse_more(path, sum(map(len, table.columns.values())), MOST_CELLS, "cells", "Split it.")
    pairs = _pairs(path, table, options)
    time_name = _time(path, table, options)
    time_s, warnings = seconds(time_name, _numbers(path, table, time_name))
    names = dict(zip(pairs, joint_names(path, [options.joints.get(j) or j for j in pairs]),
                     strict=True))  # fmt: skip
    if len(pairs) == 1 and _SOLE in pairs and (groups := _groups(path, table)):
        parts, more, metadata = _long(path, table, options, pairs[_SOLE], time_s, groups)
    else:
        whole = np.ones(len(time_s), bool)
        parts, more, metadata = [], [], _metadata(names.values())
        for theirs, ours in names.items():
            part, texts = _joint(path, table, options, pairs[theirs], time_s, whole, theirs, ours,
                                 metadata)  # fmt: skip
            parts.append(part)
            more = [*more, *(t for t in texts if t not in more)]
    metadata["imported_from"] = layout
    return Log(pd.concat(parts, ignore_index=True), metadata, [*warnings, *more])


# ------------------------------------------------------------------------------- which columns


@dataclass(frozen=True)
class _Pair:
    """Columns of one joint's command and position, and the units their names give."""

    command: str
    position: str
    command_unit: str = ""
    position_unit: str = ""


def _pairs(path: Path | str, table: Table, options: LogOptions) -> dict[str, _Pair]:
    """Columns by joint, as the log names it."""
    if options.command and options.position:
        patterns = [(_template(options.command), _template(options.position))]
    else:
        patterns = list(product(_patterns(COMMANDS), _patterns(POSITIONS)))
    matched: dict[re.Pattern[str], dict[str, list[tuple[str, str]]]] = {}
    best: dict[str, _Pair] = {}
    chosen: tuple[re.Pattern[str], ...] = ()
    for pair in patterns:
        for pattern in pair:
            if pattern not in matched:
                matched[pattern] = _matches(pattern, table.names)
        commands, positions = (matched[pattern] for pattern in pair)
        both = {
            joint: _Pair(command[0], position[0], command[1], position[1])
            for joint, (command, *_) in commands.items()
            for position in positions.get(joint, [])[:1]
            if command[0] != position[0]
        }
        if len(both) > len(best):
            best, chosen = both, pair
    if not best:
        table.check_joints(path, _angles(table.names))
        raise InputError(_no_pair(path, table, options))
    for pattern in chosen:  # one column in two units is no second joint
        named = [(j, ending) for j in best for _, ending in matched[pattern][j]]
        distinct(path, [f"{j} ({ending})" if ending else j for j, ending in named], "joints")
    if not options.joints:
        table.check_joints(path, [c for own in best.values() for c in (own.command, own.position)])
    if options.joints and not (len(best) == 1 and _SOLE in best):
        lacking = [j for j in options.joints if j not in best]
        if lacking:
            raise InputError(
                f"{path}: `joints` names {printable(lacking[0])}, which has no command and "
                f"position; {', '.join(map(printable, best))[:300]} have."
            )
        best = {joint: best[joint] for joint in options.joints}
    return best


def _patterns(words: Sequence[str]) -> list[re.Pattern[str]]:
    """Patterns of column names in which a joint stands before, behind or beside no word."""
    found = []
    # the longest first: goal_position_knee is a knee's, not a position_knee's
    for word in sorted(words, key=len, reverse=True):
        text = re.escape(word)
        found += [
            rf"{text}{_ENDING}",
            rf"{text}(?P<joint>\d+){_ENDING}",
            rf"(?P<joint>.*\S)[_./:\s-]{text}{_ENDING}",
            rf"{text}[_./:\s\[-]\s*(?P<joint>[^\]]*?[^\]\s_])\]?{_ENDING}",
        ]
    return [re.compile(pattern, re.IGNORECASE) for pattern in found]


def _template(text: str) -> re.Pattern[str]:
    """The pattern of a column named by the user, `{joint}` for the joint."""
    before, found, after = text.partition("{joint}")
    middle = "(?P<joint>.+)" if found else ""
    return re.compile(f"{re.escape(before)}{middle}{re.escape(after)}")


def _angles(names: Sequence[str]) -> list[str]:
    """Columns that are a joint's command or position, whichever joint's."""
    patterns = _patterns((*COMMANDS, *POSITIONS))
    return [name for name in names if any(p.fullmatch(name) for p in patterns)]


def _matches(pattern: re.Pattern[str], names: Sequence[str]) -> dict[str, list[tuple[str, str]]]:
    """Columns and their units by joint, of the names that fit a pattern as a whole."""
    found: dict[str, list[tuple[str, str]]] = {}
    for name in names:
        match = pattern.fullmatch(name[:200])
        if match:
            groups = match.groupdict()
            others = [g for g in match.groups() if g and g != groups.get("joint")]
            joint = bare_name(groups.get("joint") or _SOLE)
            unit_word = others[-1].lower() if others else ""
            found.setdefault(joint, []).append((name, unit_word))
    return found


def _time(path: Path | str, table: Table, options: LogOptions) -> str:
    if options.time:
        if options.time not in table.names:
            raise InputError(
                f"{path}: `time` is {options.time}, but there is no such column; it has "
                f"{_listed(table.names)}."
            )
        return options.time
    found = _time_column(table.names)
    if found is None:
        raise InputError(
            f"{path}: no column is a time (one of {', '.join(TIMES)}, also with _s, _ms, _us or "
            f"_ns); it has {_listed(table.names)}. Name it with `time`, or add it."
        )
    return found


def has_time(names: Sequence[str]) -> bool:
    """Whether one of these columns is a time."""
    return _time_column(names) is not None


def _time_column(names: Sequence[str]) -> str | None:
    plain = {n.lower(): n for n in reversed(names)}
    bare = {
        re.sub(r"[_\s]?[(\[]?(?<![a-z])(s|sec|ms|us|µs|ns)[)\]]?$", "", n.lower()): n
        for n in reversed(names)
    }
    return next((known[word] for word in TIMES for known in (plain, bare) if word in known), None)


def _no_pair(path: Path | str, table: Table, options: LogOptions) -> str:
    """Why no joint has both a command and a position."""
    has = f"it has {_listed(table.names)}"
    if options.command and options.position:
        for name, text in (("command", options.command), ("position", options.position)):
            if not _matches(_template(text), table.names):
                hint = "" if "{joint}" in text else " ({joint} stands for a joint's name)"
                return f"{path}: `{name}` is {printable(text)}, which fits no column{hint}; {has}."
        return f"{path}: no joint has both a column of `command` and one of `position`; {has}."
    return f"{path}: {missing(table.names)}; {has}."


def missing(names: Sequence[str]) -> str:
    """What a table lacks to be a servo's log; empty if a joint has a command and a position."""
    commands, positions = (
        {(joint, column) for p in _patterns(words) for joint, own in
         _matches(p, names).items() for column, _ in own}
        for words in (COMMANDS, POSITIONS)
    )  # fmt: skip
    if any(j == k and a != b for j, a in commands for k, b in positions):
        return ""
    if not commands and not positions:
        return "no column is a command or a position"
    if not commands:
        return "no column is a command (knee_command, action.knee, goal …)"
    if not positions:
        return "no column is a position (knee_position, observation.state.knee, present …)"
    return "no joint has both a command and a position"


def _listed(names: Sequence[str]) -> str:
    return printable(", ".join(map(str, names)))[:300]


# ---------------------------------------------------------------------------------------- rows


def _metadata(joints: Any) -> dict[str, Any]:
    return {"joints": list(joints), "bus": {}}


def _numbers(path: Path | str, table: Table, name: str) -> NDArray[np.float64]:
    if name in table.columns:
        values = np.asarray(table.columns[name], float)
        if np.isinf(values).any():
            raise InputError(f"{path}, column {name}: a value is infinite.")
        return values
    raise InputError(table.faults.get(name, f"{path}, column {name}: its values are not numbers."))


def _first(table: Table, names: Sequence[str]) -> str | None:
    own = {n.lower(): n for n in table.columns}
    return next((own[n] for n in names if n in own), None)


def _groups(path: Path | str, table: Table) -> dict[str, NDArray[np.bool_]]:
    """Rows by joint, where a column names or numbers it."""
    texts = {n.lower(): n for n in table.texts}
    for name in JOINT_COLUMNS:
        if name in texts:
            codes, found = pd.factorize(np.array(table.texts[texts[name]], object))
            refuse_more(f"{path}, column {name}", len(found), MOST_JOINTS, "joints")
            joints: dict[str, NDArray[np.bool_]] = {}
            for code, value in enumerate(found):
                if own := value.strip():
                    joints[own] = joints.get(own, False) | (codes == code)
            return joints
    name = _first(table, _NUMBERED)
    if name is None:
        return {}
    numbers = _numbers(path, table, name)
    known = np.unique(numbers[np.isfinite(numbers)])
    if len(known) > 1000:
        return {}
    refuse_more(f"{path}, column {name}", len(known), MOST_JOINTS, "joints")
    return {f"motor_{v:g}": numbers == v for v in known}


def _long(
    path: Path | str,
    table: Table,
    options: LogOptions,
    pair: _Pair,
    time_s: NDArray[np.float64],
    groups: Mapping[str, NDArray[np.bool_]],
) -> tuple[list[pd.DataFrame], list[str], dict[str, Any]]:
    """Rows of a table with a row per joint and time."""
    chosen = {j: own for j, own in groups.items() if not options.joints or j in options.joints}
    if not chosen:
        raise InputError(
            f"{path}: `joints` names none of its joints {', '.join(map(printable, groups))[:200]}."
        )
    ours = joint_names(path, [options.joints.get(j) or j for j in chosen])
    metadata, parts, warnings = _metadata(ours), [], []
    for (theirs, own), name in zip(chosen.items(), ours, strict=True):
        part, texts = _joint(path, table, options, pair, time_s, own, theirs, name, metadata)
        parts.append(part)
        warnings = [*warnings, *(t for t in texts if t not in warnings)]
    return parts, warnings, metadata


def _joint(
    path: Path | str,
    table: Table,
    options: LogOptions,
    pair: _Pair,
    time_s: NDArray[np.float64],
    own: NDArray[np.bool_],
    theirs: str,
    ours: str,
    metadata: dict[str, Any],
) -> tuple[pd.DataFrame, list[str]]:
    """Rows of one joint; its doubt goes into the header."""
    trial_name = options.trial or _first(table, _TRIALS)
    trial = None if trial_name is None else _numbers(path, table, trial_name)[own]
    number, stamp = one_after_another(time_s[own], trial)
    send, read, doubt, warnings = turns(stamp, options)
    metadata["bus"]["read_time_doubt_s"] = max(doubt, metadata["bus"].get("read_time_doubt_s", 0.0))
    metadata["read_after_send_s"] = float(read[0] - send[0]) if len(send) else 0.0
    given = options.unit_of(theirs, ours)
    columns: dict[str, Any] = {}
    for key, name, ending in (
        ("command_rad", pair.command, pair.command_unit),
        ("position_rad", pair.position, pair.position_unit),
    ):
        values = _numbers(path, table, name)[own]
        factor = given or _of_ending(ending) or Unit()
        columns[key] = (values - factor.zero) * factor.scale
        if factor.counts and given is None:
            warnings.append(
                f"columns in counts were taken as {round(2 * factor.zero)} counts a turn, half of "
                "them 0 rad. If that is wrong, give `unit`, such as counts:1024."
            )
        if key == "position_rad" and factor.counts:
            columns["position_count"] = values
    for name in _KEPT:
        if name in table.columns:
            columns[name] = _numbers(path, table, name)[own]
    part = rows(
        ours, send, read, columns.pop("command_rad"), columns.pop("position_rad"), number, **columns
    )
    tone = _first(table, _TONES)
    if tone is not None:
        part["frequency_hz"] = _numbers(path, table, tone)[own]
        several = part.groupby("trial")["frequency_hz"].transform("nunique").to_numpy() > 1
        part.loc[several, "frequency_hz"] = np.nan  # a chirp is no tone
    return part, warnings


def _of_ending(ending: str) -> Unit | None:
    """The unit that a column's ending names."""
    if ending in ("deg", "degrees"):
        return unit("deg")
    if ending in ("counts", "ticks", "raw"):
        return unit("counts:4096")
    return None
