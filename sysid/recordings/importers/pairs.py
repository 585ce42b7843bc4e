"""Which columns of a table are the command and the position of which joint: `pairs`.

By the words of their names (`importers.columns`), or as options name them. Of several columns the
better ones are taken; where none is better the refusal prints the command line that takes each.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.csv_table import distinct
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers import refusals
from pupper_sysid.sysid.recordings.importers.columns import Column, column, columns_of
from pupper_sysid.sysid.recordings.importers.log import Table, bare_name
from pupper_sysid.sysid.recordings.importers.options import LogOptions

SOLE = "joint"
"""The joint of a log that names none."""
_MOST_CHOICES = 4  # that a message lists
_COMPARED = 8  # columns for one purpose
_OF_TURNS = {
    "ODrive": {"setpoint", "estimate"},
    "ODrive's API": {"input", "estimate"},
    "moteus's decoder": {"command_position", "q_current"},
    "moteus's telemetry": {"control_position", "q_current"},
    "moteus's registers": {"command_position", "position", "velocity", "torque"},
}
"""Programs that count turns and do not say so, and what their logs may be known by: columns, or
words of the command's and the position's."""
_DRIVES = {
    "ODrive": re.compile(r"odrv|axis\d\.(controller|encoder|motor|pos_vel_mapper)\.",
                         re.IGNORECASE),
    "moteus": re.compile(r"moteus|servo_stats|Register\.|(^|[_.])[qd]_current", re.IGNORECASE),
    "": re.compile(
        r"axis\d|(^|[_.])iq(_|$)|input_pos|vel_(estimate|setpoint)|estimate_counts|shadow_count|"
        r"count_in_cpr", re.IGNORECASE,
    ),
}  # fmt: skip
"""Names of columns by which the angles are turns without doubt; those under "" do not tell the
program, and only beside marks of `_OF_TURNS`."""
_ARRAY = re.compile(r"(data|values?)(_\d+)?", re.IGNORECASE)
_BRACKETED = re.compile(r"[(\[（]\s*([^\W\d]+)\s*[)\]）]\s*$")
_MOST_TURNS = 100.0  # beyond which no angle is read, whatever its unit
_COUNTS_OF_DRIVE = "counts:8192:0"
"""ODrive's default encoder; its firmware before 0.5 has counts where later ones have turns."""


@dataclass(frozen=True)
class Pair:
    """Columns of one joint's command and position."""

    command: Column
    position: Column

    def cost(self, used: Mapping[str, int]) -> tuple[int, ...]:
        """Order of pairs for one joint, the better ones first."""
        c, p = self.command, self.position
        units = {c.unit or "rad", p.unit or "rad"}
        return (
            c.rank[0] + p.rank[0], c.rank[1] + p.rank[1], int(len(units) > 1),
            c.rank[2] + p.rank[2], p.rank[3], -used[c.template] - used[p.template],
        )  # fmt: skip

    def as_sure(self, other: Pair) -> bool:
        """Whether words and marks of both pairs tell as much."""
        return all(
            ours.rank[:2] == theirs.rank[:2]
            for ours, theirs in ((self.command, other.command), (self.position, other.position))
        )


def pairs(path: Path | str, table: Table, options: LogOptions) -> tuple[dict[str, Pair], list[str]]:
    """Columns by joint, as the log names it, and what was assumed."""
    if options.command and options.position:
        chosen, notes = _stated(path, table, options), []
    else:
        chosen, notes = _by_words(path, table)
        chosen = {
            name: _of_drive(path, table, options, pair, notes) for name, pair in chosen.items()
        }
    if not options.joints:
        used = [c.name for pair in chosen.values() for c in (pair.command, pair.position)]
        table.check_joints(path, used)
    return chosen, notes


def _of_drive(
    path: Path | str, table: Table, options: LogOptions, pair: Pair, notes: list[str]
) -> Pair:
    """The pair in the unit of the drive that the log is of, if any; `notes` get a sentence."""
    sources = pair.command, pair.position
    given_away = {n.lower() for n in table.names} | pair.command.words | pair.position.words
    named = [p for p, names in _DRIVES.items() if any(map(names.search, table.names))]
    program = next((p for p, marks in _OF_TURNS.items() if marks <= given_away), "")
    drive, counts = table.drive
    program = program or next(iter(named), "") or drive
    counts = counts or "turns"
    counted = [source for source in sources if source.unit == "counts"]
    if not program or options.unit or any(s.unit not in ("", "counts") for s in sources):
        return pair
    if (counted and counts != "turns") or table.units:
        return pair  # beside it the log says its unit
    named = [*named, *([drive] if drive else [])]
    known = [table.columns[s.name] for s in sources if s.unit == "" and s.name in table.columns]
    largest = max((float(np.nanmax(np.abs(v), initial=0.0)) for v in known), default=0.0)
    if counted or (named and counts == "turns" and largest > _MOST_TURNS):
        units = [_COUNTS_OF_DRIVE if s in counted or largest > _MOST_TURNS else "turns"
                 for s in sources]  # fmt: skip
        templates = [s.template for s in sources]
        if not all("{joint}" in template for template in templates):
            templates = [s.name for s in sources]
        line = refusals.import_line(
            path, unit=",".join(dict.fromkeys(units)), command=templates[0], position=templates[1]
        )
        raise InputError(
            f"{path}: {refusals.listed(s.name for s in sources)} are of {program}, which counts "
            "turns, but these are an encoder's counts. Say how many a turn has; with "
            f"ODrive's default: {line}."
        )
    taken, other = (counts, "rad") if named else ("rad", counts)
    if not any(program in note for note in notes):
        whose = f"{pair.command.name} and {pair.position.name} are names of {program}"
        whose = f"the log says that its drive is {program}" if drive else whose
        notes.append(
            f"{whose}, which counts {counts}; the values were taken as {taken}. If they are "
            f"{other}, give `unit='{other}'`; lag and dead time are the same."
        )
    if not named:
        return pair
    return Pair(*(replace(c, unit=counts) for c in sources))


def _by_words(path: Path | str, table: Table) -> tuple[dict[str, Pair], list[str]]:
    every = columns_of(name for name in table.names if name not in table.texts)
    commands, positions = ([c for c in every if c.kind == k] for k in ("command", "position"))
    placed = {c.key for c in positions}
    keys = [key for key in dict.fromkeys(c.key for c in commands) if key in placed]
    if not keys and min(len(commands), len(positions)) > 1:
        commands, positions = _without_common(commands), _without_common(positions)
        placed = {c.key for c in positions}
        keys = [key for key in dict.fromkeys(c.key for c in commands) if key in placed]
        every = [*commands, *positions]
    if not keys:
        return _lone(path, table, commands, positions)
    used = Counter(c.template for c in every)
    chosen: list[Pair] = []
    notes: dict[str, str] = {}  # one of a kind
    for key in keys:
        ranked = [
            sorted(
                (c for c in candidates if c.key == key), key=lambda c: (c.rank, -used[c.template])
            )
            for candidates in (commands, positions)
        ]
        choices = product(*(candidates[:_COMPARED] for candidates in ranked))
        best = sorted((Pair(*pair) for pair in choices), key=lambda pair: pair.cost(used))
        pair = _decided(path, table, best, used)
        if sum(map(pair.as_sure, best)) > 1:
            notes.setdefault(
                "choice",
                f"of several columns {pair.command.name} was taken for the command and "
                f"{pair.position.name} for the position. To take others, name them with "
                "`command` and `position`.",
            )
        chosen.append(pair)
    # a joint is called as both columns have it, else without further words
    joints = [min(pair.command.joint, pair.position.joint, key=len) for pair in chosen]
    names = [bare_name(j or p.command.key) or SOLE for j, p in zip(joints, chosen, strict=True)]
    distinct(path, names, "joints")
    bracketed = _BRACKETED.search(chosen[0].command.name)
    if len(names) == 1 and names[0] in ("d", bracketed and bracketed[1]):
        both = f"{chosen[0].command.name} and {chosen[0].position.name}"  # ref_d; Ziel (graadid)
        notes["joint"] = (
            f"{both} were taken for radians of a joint {names[0]}; if that is a unit, give it: for "
            "degrees give `unit='deg'`."
        )
    return dict(zip(names, chosen, strict=True)), [*notes.values()]


def _without_common(columns: Sequence[Column]) -> list[Column]:
    """Columns whose keys lack the words that all of them have, such as a register's address."""
    common = set.intersection(*({*c.key.split("_")} for c in columns))
    keys = ("_".join(w for w in c.key.split("_") if w not in common) for c in columns)
    return [replace(c, key=key, joint=key) for c, key in zip(columns, keys, strict=True)]


def _decided(path: Path | str, table: Table, best: Sequence[Pair], used: Mapping[str, int]) -> Pair:
    """The first of the best pairs of a joint; refused where another is as good, of other values."""
    first = best[0]
    alike = [pair for pair in best if pair.cost(used) == first.cost(used)]
    for kind in ("command", "position"):
        chosen = getattr(first, kind)
        twice = {getattr(pair, kind).name for pair in best
                 if pair.cost(used)[:4] == first.cost(used)[:4]
                 and getattr(pair, kind).words == chosen.words}  # fmt: skip
        if chosen.joint:
            distinct(path, [bare_name(chosen.joint)] * len(twice), "joints")
        elif len(twice) > 1:
            why = f"{len(twice)} columns may be the {kind} of {chosen.joint or 'the joint'}"
            _refuse_choices(path, why, [p for p in best if getattr(p, kind).name in twice])
        values = [table.columns.get(n) for n in dict.fromkeys(getattr(p, kind).name for p in alike)]
        if any(v is None or values[0] is None or not np.array_equal(v, values[0], equal_nan=True)
               for v in values[1:]):  # fmt: skip
            why = f"{len(values)} columns may be the {kind} of {chosen.joint or 'the joint'}"
            _refuse_choices(path, why, alike)
    return first


def _lone(
    path: Path | str, table: Table, commands: Sequence[Column], positions: Sequence[Column]
) -> tuple[dict[str, Pair], list[str]]:
    """The pair of a table in which no joint has both by name: the only command and position."""
    table_of = [c.name for c in (*commands, *positions)]
    if not commands or not positions:
        table.check_joints(path, table_of)
        lines = refusals.lines_by_value(path, table)
        note = refusals.rate_note(lines[0], table) if lines else ""
        which = f" Say which is which: {'; or '.join(lines)}{note}." if lines else ""
        if not (why := refusals.missing(table.names)):  # a column of text has the name
            raise InputError(next(iter(table.faults.values()), f"{path} has no numbers."))
        raise InputError(f"{path}: {why}; it has {refusals.listed(table.names)}.{which}")
    first = [
        [c for c in candidates if c.rank[:3] == min(c.rank for c in candidates)[:3]]
        for candidates in (commands, positions)
    ]
    choices = [Pair(*pair) for pair in product(*first)]
    if len(choices) > 1:
        table.check_joints(path, [c.name for candidates in first for c in candidates])
        if len(first[0]) == len(first[1]):  # one line for all
            joined = [",".join(c.name for c in candidates) for candidates in first]
            both = (
                replace(candidates[0], name=names, template=names)
                for candidates, names in zip(first, joined, strict=True)
            )
            choices = [Pair(*both)]
        _refuse_choices(path, "no joint has both a command and a position by its name", choices)
    (pair,) = choices
    word = pair.command.joint or pair.position.joint or SOLE
    if _ARRAY.fullmatch(word):  # /commands/data[0] beside /joint_states/knee/position
        word = pair.position.joint or word
    name = bare_name(word)
    return {name: pair}, [
        f"{pair.command.name} and {pair.position.name} were taken for the command and the position "
        "of one joint."
    ]


def _refuse_choices(path: Path | str, why: str, choices: Sequence[Pair]) -> None:
    """Refuse to choose, with the command line that takes each pair."""
    lines = list(dict.fromkeys(  # templates are of several joints
        refusals.import_line(path, command=pair.command.template, position=pair.position.template)
        for pair in choices
    ))  # fmt: skip
    more = "" if len(lines) <= _MOST_CHOICES else f" (and {len(lines) - _MOST_CHOICES} more)"
    raise InputError(f"{path}: {why}. Take one: {'; or '.join(lines[:_MOST_CHOICES])}{more}.")


def _stated(path: Path | str, table: Table, options: LogOptions) -> dict[str, Pair]:
    """Columns that the options name."""
    matched = []
    for option in ("command", "position"):
        text = str(getattr(options, option))
        if "{joint}" not in text and text not in table.names:
            stated = {str(k): column_named(path, table, option, name.strip())
                     for k, name in enumerate(text.split(","))}  # fmt: skip
        else:
            before, stated, after = text.partition("{joint}")
            middle = "(?P<joint>.+)" if stated else ""
            pattern = re.compile(f"{re.escape(before)}{middle}{re.escape(after)}")
            fits = [m for name in table.names if (m := pattern.fullmatch(name[:200]))]
            joints = [bare_name(m.groupdict().get("joint") or "0") for m in fits]
            distinct(path, joints, "joints")
            stated = dict(zip(joints, (m[0] for m in fits), strict=True))
        if not stated:
            raise InputError(
                f"{path}: `{option}` is {printable(text)}, which fits no column; it has "
                f"{refusals.listed(table.names)}."
            )
        matched.append(stated)
    commands, positions = matched
    named = "{joint}" in str(options.command)
    names = both = [joint for joint in commands if joint in positions]
    if not both or (not named and len(commands) != len(positions)):
        raise InputError(
            f"{path}: no joint has both a column of `command` and one of `position`; it has "
            f"{refusals.listed(table.names)}."
        )
    if not named:
        names = [SOLE] if len(both) == 1 else [f"joint_{k}" for k in both]
        names = [*options.joints] if len(options.joints) == len(both) else names
    return {
        name: Pair(column(commands[joint]), column(positions[joint]))
        for name, joint in zip(names, both, strict=True)
    }


def column_named(path: Path | str, table: Table, option: str, name: str) -> str:
    """The column of this name, or of this number from 0."""
    if name in table.names:
        return name
    if name.isascii() and name.isdigit() and int(name[:9]) < len(table.names):
        return table.names[int(name)]
    hint = " ({joint} stands for a joint's name)" if option in ("command", "position") else ""
    raise InputError(
        f"{path}: `{option}` is {printable(name)[:60]}, but there is no such column{hint}; it has "
        f"{refusals.listed(table.names)}."
    )
