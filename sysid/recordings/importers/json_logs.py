"""Logs in JSON: BAM's and K-Scale's, ktune's, and any other with columns or records.

BAM and K-Scale, one servo, mostly with a pendulum:

    {"mass": 0.49, "length": 0.1, "arm_mass": 0, "kp": 100, "vin": 7.4, "motor": "xl330",
     "trajectory": "sin_sin", "entries": [{"timestamp": 0.0035, "position": 0.0,
     "goal_position": 0.0, "torque_enable": true, "input_volts": 7.3, …}, …]}

Angles in rad, 0 hangs, times in s. A turn of BAM's loop writes the goal, sleeps 1 ms and reads;
`timestamp` is the middle of the read. The XL330 is read register by register, the position first,
so its position is older than the stamp; other servos are read in one block.

ktune, one actuator's chirp or step, angles in degrees:

    {"config": {"actuator_id": 41, "kp": 150.0, "kd": 8.0, …},
     "data": [{"time_since_start": 0.0006, "position": 0.05, "commanded_position": 0.0, …}, …]}

Each row has one time stamp, and the log does not say when in a turn the command was sent and the
position read: lag and dead time are in doubt by half a turn.

Others are tables: lists by name, a list of records, or a record a line (JSON Lines); `{"cmd":
{"knee": 0.1}}` is a column `cmd.knee`, and a list of numbers has a column each. `{"cmd": [[t, v],
…], "pos": [[t, v], …]}` has times of its own for each.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_CELLS, MOST_COLUMNS
from pupper_sysid.common.reading.dialect import decimal, unit_behind, with_unit
from pupper_sysid.sysid.recordings.importers.columns import column, has_time
from pupper_sysid.sysid.recordings.importers.log import (
    MOST_JOINTS,
    Log,
    expanded,
    joint_names,
    number,
    numbers,
    rows,
)
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.refusals import missing
from pupper_sysid.sysid.recordings.importers.tables import (
    GROUPS,
    SERIES,
    read_numbered,
    read_table,
)
from pupper_sysid.sysid.recordings.importers.times import (
    doubt_of_a_turn,
    drive_in,
    stated_rate,
    units_in,
)

BAM, KTUNE = "BAM JSON", "ktune JSON"

_SLEEP_S = 0.00106  # sleep(0.001) as Linux keeps it
_REGISTERS = {"xl330": 5}  # reads of one register each, the position first
_FAR, _LONGEST_NUMBER = 1e9, 40
_FEW_REMARKS = 4000  # characters
_LONGER = 10  # times as many values over time as joints
_WORDS_OF_LISTS = set(
    "joints servos motors actuators data points samples records rows entries log logs values "
    "series trajectory trace messages".split()
)
_NUMBERS = ("mass", "length", "kp", "vin")


def read_known(path: Path, data: Any, options: LogOptions) -> Log | None:
    """The log in BAM's, K-Scale's or ktune's JSON; None for another."""
    for layout, key, names, read in (
        (BAM, "entries", {"timestamp", "goal_position"}, _read_bam),
        (KTUNE, "data", {"time_since_start", "commanded_position"}, _read_ktune),
    ):
        entries = data.get(key) if isinstance(data, dict) else None
        if not isinstance(entries, list):
            continue
        if not entries or (isinstance(entries[0], Mapping) and names & {*entries[0]}):
            options.refuse(layout)
            if not entries:
                raise InputError(
                    f"{path}: {key} is empty, so nothing was recorded. Record it again."
                )
            return read(path, data)
    return None


def _read_bam(path: Path, data: dict[str, Any]) -> Log:
    """The log as rows; mass, length, gain and voltage go into the header."""
    entries = data["entries"]
    stamp = numbers(path, entries, "timestamp", "entries")
    position = numbers(path, entries, "position", "entries", missing=True)
    command = numbers(path, entries, "goal_position", "entries")
    torque = numbers(path, entries, "torque_enable", "entries", missing=True)
    voltage = numbers(path, entries, "input_volts", "entries", missing=True)
    motor = str(data.get("motor") or "servo")
    known = {k: number(path, data[k], k) for k in _NUMBERS if data.get(k) is not None}
    (joint,) = joint_names(path, [motor])
    reads = next((n for m, n in _REGISTERS.items() if motor.lower().startswith(m)), 1)
    on = torque != 0  # a log without the entry had its torque on
    loop = float(np.median(np.diff(stamp)[on[1:]])) if on[1:].any() else 0.0
    each = max(loop - _SLEEP_S, 0.0) / (reads + 1)  # a write and the reads take about as long
    started = stamp - reads * each / 2
    columns = {
        "torque_enabled": None if on.all() else on.astype(float),
        "voltage_v": voltage if np.isfinite(voltage).any() else None,
        "p_gain": known.get("kp"),
    }
    optional: dict[str, Any] = {name: v for name, v in columns.items() if v is not None}
    servo = {"model": motor} | ({"p_gain": known["kp"]} if "kp" in known else {})
    if known.get("vin", 0) > 0:
        servo["supply_voltage_v"] = known["vin"]
    metadata: dict[str, Any] = {
        "imported_from": BAM,
        "joints": [joint],
        "readings": "live",
        "bus": {"read_time_doubt_s": each if reads > 1 else max(loop - _SLEEP_S, 0.0) / 2},
        "servos": {joint: servo},
    }
    if "mass" in known and "length" in known:
        arm = number(path, data["arm_mass"], "arm_mass") if data.get("arm_mass") else 0.0
        metadata["loads"] = {
            joint: {"mass_kg": known["mass"], "length_m": known["length"], "arm_mass_kg": arm}
        }
    if isinstance(data.get("trajectory"), str):
        metadata["trajectory"] = data["trajectory"][:80]
    table = rows(
        joint, started - _SLEEP_S - each / 2, started + each / 2, command, position, **optional
    )
    return Log(table, metadata)


def _read_ktune(path: Path, data: dict[str, Any]) -> Log:
    """The log as rows of the joint `actuator_<id>`."""
    entries, config = data["data"], data.get("config")
    config = config if isinstance(config, dict) else {}
    stamp = numbers(path, entries, "time_since_start", "data")
    command = np.deg2rad(numbers(path, entries, "commanded_position", "data"))
    position = np.deg2rad(numbers(path, entries, "position", "data", missing=True))
    (joint,) = joint_names(path, [f"actuator_{config.get('actuator_id', 0)}"])
    gains = {
        name: number(path, config[key], f"config.{key}")
        for name, key in (("p_gain", "kp"), ("d_gain", "kd"))
        if config.get(key) is not None
    }
    doubt, text = doubt_of_a_turn(stamp)
    metadata = {
        "imported_from": KTUNE,
        "joints": [joint],
        "bus": {"read_time_doubt_s": doubt},
        "servos": {joint: gains},
    }
    gain = {"p_gain": gains["p_gain"]} if "p_gain" in gains else {}
    return Log(rows(joint, stamp, stamp, command, position, **gain), metadata, [text])


def read_json_table(path: Path, data: Any, options: LogOptions) -> Log | None:
    """The log in other JSON as a table; None if it has no columns of a command and a position."""
    lists: dict[str, list[Any]] = {}
    data = _of_pairs(_of_points(_of_frame(data)))
    records = _records(data)
    head: Any = data
    while records and len(records) > 2 and not any({*records[0]} & {*r} for r in records[1:4]):
        head = {**(head if isinstance(head, Mapping) else {}), **records[0]}  # of JSON Lines
        records = records[1:]
    if records is None and not isinstance(data, Mapping):
        values = _numbers(data)
        if values is None or values.ndim != 2:
            return None
        return read_numbered(path, values, options, "JSON table")
    for k, record in enumerate([data] if records is None else records):
        series = next((k for k in record if k.lower() in SERIES), "") if records else ""
        of = record[series] if isinstance(record.get(series), str) else ""
        pending = [("", record)]
        while pending:
            prefix, inside = pending.pop()
            for name, value in inside.items():
                full = f"{prefix}.{name}".strip(".")[:200]
                if of and not prefix and column(name).kind != "time":
                    full = f"{of}.{full}"[:200]  # a message of one topic
                if records is not None and isinstance(value, list):
                    value = _by_name(value)
                if isinstance(value, Mapping):
                    pending.append((full, value))
                elif records is None:
                    lists[full] = value if isinstance(value, list) else []
                else:
                    if full not in lists:
                        cells = (len(lists) + 1) * len(records)
                        refuse_more(path, len(lists) + 1, MOST_COLUMNS, "columns", exact=False)
                        refuse_more(path, cells, MOST_CELLS, "cells", "Split it.", exact=False)
                        lists[full] = [None] * len(records)
                    lists[full][k] = value
    for name, values in [*lists.items()]:  # "0.3 deg"
        texts_only = [v for v in values if v is not None]
        if all(isinstance(v, str) for v in texts_only) and (word := unit_behind(texts_only)):
            lists[with_unit(name, word)] = [v and v.removesuffix(word).strip() for v in values]
            del lists[name]
    columns = {name: _numbers(values) for name, values in lists.items() if len(values) > 1}
    arrays = {name: values for name, values in columns.items() if values is not None}
    others = {n: v for n, v in lists.items() if v and n not in arrays}
    texts = {n: list(map(str, v)) for n, v in others.items()
             if has_time([n]) or (n in GROUPS and all(isinstance(t, str) for t in v))}  # fmt: skip
    levels = [head, *head.values()] if isinstance(head, Mapping) else []
    beside = [pair for level in levels if isinstance(level, Mapping) for pair in level.items()]
    scalars = {k: float(v) for k, v in beside if isinstance(v, int | float) and abs(v) < _FAR}
    remarks = "\n".join(f"{k}: {v}" for k, v in beside if isinstance(v, str))
    table = expanded(path, arrays, list(options.joints))
    remarks = remarks[:_FEW_REMARKS]
    units, drive = units_in(remarks, table.names), drive_in(remarks)
    table = replace(table, texts=texts, rate=stated_rate(scalars), units=units, drive=drive)
    if not arrays or (missing(table.names) and not options.command):
        return None
    return read_table(path, table, options, "JSON table")


def _of_frame(data: Any) -> Any:
    """The columns of rows below a list of names, or by numbers, as pandas has them; else `data`."""
    if not isinstance(data, Mapping):
        return data
    names = data.get("columns")
    for each in data.values():
        if isinstance(names, list) and isinstance(each, list) and each and all(
            isinstance(row, list) and len(row) == len(names) for row in each
        ):  # fmt: skip
            return {str(n): list(v) for n, v in zip(names, zip(*each, strict=True), strict=True)}
    if data and all(isinstance(v, Mapping) for v in data.values()):
        if all("0" in v and "1" in v for v in data.values()):
            return {n: list(v.values()) for n, v in data.items()}
        if "0" in data and "1" in data:  # rows by their numbers
            return list(data.values())
    for name, value in data.items():  # a record per joint, whose values are lists over time
        if isinstance(value, list) and all(isinstance(each, Mapping) for each in value):
            longest = (len(v) for each in value for v in each.values() if isinstance(v, list))
            if len(value) <= MOST_JOINTS and max(longest, default=0) > _LONGER * len(value):
                return {**data, **_by_name(value), name: None}
    return data


def _of_points(data: Any) -> Any:
    """Lists of points, wherever they stand below the names of joints, as one list of points.

    A point is a record with a command and a position. The joint is the last name above the list
    that is no word for a list. Other data as they are.
    """
    of_joint: dict[str, list[Any]] = {}
    pending = [("", data)] if isinstance(data, Mapping) else []
    while pending:
        joint, inside = pending.pop(0)
        for key, value in inside.items():
            name = joint if key.lower() in _WORDS_OF_LISTS else str(key)
            records = isinstance(value, list) and all(isinstance(v, Mapping) for v in value)
            if records and value and not missing([*map(str, value[0])]):
                of_joint[name] = [*of_joint.get(name, []), *value]
            elif records and 0 < len(value) <= MOST_JOINTS:  # a record per joint, with its list
                pending += [*_by_name(value).items()]
            elif isinstance(value, Mapping):
                pending.append((name, value))
    if not of_joint or (len(of_joint) == 1 and _records(data) is not None):
        return data
    named = all("joint" not in point for points in of_joint.values() for point in points)
    return [point | ({"joint": joint} if joint and named else {})
            for joint, points in of_joint.items() for point in points]  # fmt: skip


def _of_pairs(data: Any) -> Any:
    """Lists of `[time, value, …]`, by the names above them, as a list of records; others as is."""
    of_name: dict[str, list[Any]] = {}
    pending = [("", data)] if isinstance(data, Mapping) else []
    while pending:
        prefix, inside = pending.pop(0)
        for key, value in inside.items():
            name = f"{prefix}.{key}".strip(".")
            if isinstance(value, Mapping):
                pending.append((name, value))
            elif isinstance(value, list) and has_time([str(key)]):
                return data
            elif (rows := _numbers(value)) is not None and rows.ndim == 2 and rows.shape[1] > 1:
                if len(rows) > 1 and (np.diff(rows[:, 0]) > 0).all():
                    of_name[name] = value
    if missing([*of_name]):
        return data
    return [{"time": row[0], "signal": name, "value": row[1] if len(row) == 2 else row[1:]}
            for name, each in of_name.items() for row in each]  # fmt: skip


def _by_name(value: list[Any]) -> Any:
    """A list with a record per joint by the joints' names; another as it is."""
    if not value or not all(isinstance(each, Mapping) for each in value):
        return value
    key = next((k for k in ("name", "joint", "id", "motor_id", "index") if k in value[0]), "")
    return {str(each.get(key, n)): {k: v for k, v in each.items() if k != key}
            for n, each in enumerate(value)}  # fmt: skip


def _records(data: Any) -> list[Any] | None:
    """The list of records in JSON: the whole, or the longest one by name; None if there is none."""
    lists = [data] if isinstance(data, list) else []
    if isinstance(data, Mapping):
        lists = [value for value in data.values() if isinstance(value, list)]
    tables = [v for v in lists if v and all(isinstance(row, Mapping) for row in v)]
    return max(tables, key=len, default=None)


def _numbers(values: Any) -> NDArray[np.float64] | None:
    """Numbers, or equally long lists of them; None where they are others. A null is missing."""
    first = next((v for v in values if v is not None), None) if isinstance(values, list) else None
    if isinstance(first, str) and len(first) < _LONGEST_NUMBER:
        with suppress(ValueError, AttributeError):
            return np.array([decimal(v) if v else np.nan for v in values])
    if first is None:
        return None
    inside = values
    if isinstance(first, list):
        values = [[None] * len(first) if v is None else v for v in values]
        if not all(isinstance(v, list) for v in values):
            return None
        inside = [v for row in values for v in row]
    if not all(isinstance(v, int | float | None) for v in inside):
        return None
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):  # lists of several lengths
        return None
    return array if array.ndim in (1, 2) else None
