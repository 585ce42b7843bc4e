"""Find a log's layout by its content, and read it: `read_folder`, `read_content`."""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace
from pathlib import Path
from textwrap import indent
from typing import Any

import pandas as pd

from pupper_sysid.common import border
from pupper_sysid.common.border import RECORDING, refuse_other_kind
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.dialect import decoded, without_numpy
from pupper_sysid.common.strict_yaml import load
from pupper_sysid.sysid.recordings.importers import (
    arrays,
    json_logs,
    lerobot,
    parquet,
    ros,
    sage,
)
from pupper_sysid.sysid.recordings.importers.columns import column, time_columns
from pupper_sysid.sysid.recordings.importers.log import Log, Table, joint_names, read_files
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.refusals import missing, unknown_folder, unknown_json
from pupper_sysid.sysid.recordings.layouts import convert
from pupper_sysid.sysid.recordings.table import parse

_ENDINGS = (".csv", ".tsv", ".json", ".jsonl", ".mcap", ".db3", ".npz", ".parquet", ".pt", ".mat")
_PACKED = (".gz", ".bz2", ".xz")
_TABLES = (".csv", ".tsv", ".txt", ".log", ".dat")
_STAMP = re.compile(rb"\[[^\[\]{}\"\n]*\][ \t:]*[A-Za-z(\[\d]")  # before a message: a line of text
_JSON = re.compile(rb"(?:#[^\n]*\n\s*)*(?:\{|\[[\s\[]*(?:[\"{\d\]-]|true|false|null|NaN|Inf))")
_YAML = re.compile(rb"(?:---\s*\n)?(?:- \w+:|\w+:[ \t]*\r?\n[ \t]+\w+:)")
_DOCUMENT = re.compile(r"^---[ \t]*\r?$", re.MULTILINE)
_CAN = re.compile(  # candump's, PEAK's, Vector's
    rb"^[ \t]*(?:\([\d. :-]+\)[ \t]+)?v?can\d+[ \t]+[0-9A-F]{3,8}(?:#|[ \t]+\[\d+\][ \t])"
    rb"(?![^\n]*::)|"
    rb"\A;\$FILEVERSION|^[ \t]*[\d.]+[ \t]+\d[ \t]+[0-9A-F]+x?[ \t]+[RT]x[ \t]+d[ \t]",
    re.MULTILINE | re.IGNORECASE,
)
_HEAD_OF_TABLE = 100_000  # bytes
_HEAD = 2000  # bytes in which a kind of text is looked for
_MARKUP = re.compile(rb"<[?!A-Za-z]")
_ROW = re.compile(rb"\[[-+\d.eE, \t\[\]()]+\][ \t]*\r?\n")  # numbers, a whole line


def is_log_folder(folder: Path) -> bool:
    """Whether a folder is one log, such as a dataset, rather than a folder of recordings."""
    return folder.is_dir() and (
        sage.is_sage(folder)
        or lerobot.is_lerobot(folder)
        or ros.is_bag(folder)
        or bool(_halves(folder))
    )


def _halves(folder: Path) -> list[Path]:
    """The two tables of a folder that has commands in one and states in the other, by their heads.

    Empty for other folders.
    """
    logs = [p for p in sorted(folder.iterdir()) if p.suffix in _TABLES and _may_be_log(p)]
    if len(logs) != 2 or {column(p.stem).kind for p in logs} != {"command", "position"}:
        return []
    times = {_time_by_head(p) for p in logs}
    return logs if len(times) == 1 and None not in times else []


def _time_by_head(path: Path) -> str | None:
    """The time of a table that has no pair of command and position, by its first rows."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_OF_TABLE)
        whole = len(head) < _HEAD_OF_TABLE
        table = parse(path, decoded(path, head if whole else head[: head.rfind(b"\n") + 1]))
    except (InputError, OSError):
        return None
    return _time_of(table) if missing(table.names) else None


def _time_of(table: Table) -> str | None:
    return next((n for n in time_columns(table.names) if n in table.increasing), None)


def _joined(folder: Path, logs: list[Path]) -> tuple[Table, str]:
    """Both tables as one, with the rows of each, and their digest."""
    contents, digest = read_files(folder, logs)
    tables = {path.stem: parse(path, decoded(path, contents[path])) for path in logs}
    times = {stem: _time_of(table) for stem, table in tables.items()}
    time = times[logs[0].stem]
    if time is None or {*times.values()} != {time}:
        listed = ", ".join(f"{name}: {time or 'none'}" for name, time in times.items())
        raise InputError(
            f"{folder}: the times of its two tables must be one column that increases ({listed})."
        )
    parts, units = [], {}
    for stem, table in tables.items():
        named = {n: n if n == time else f"{stem}.{n}" for n in table.columns}
        parts.append(pd.DataFrame(table.columns).rename(columns=named))
        for name in named:
            if unit := table.units.get(name, table.units.get("", "")):
                units[named[name]] = unit
    whole = pd.concat(parts, ignore_index=True).sort_values(time, kind="stable")
    first = tables[logs[0].stem]
    return Table(
        {str(n): whole[n].to_numpy(float) for n in whole}, units=units, tick_s=first.tick_s,
        drive=max(table.drive for table in tables.values()),
        notes=[note for table in tables.values() for note in table.notes],
    ), digest  # fmt: skip


def logs_in(path: Path) -> list[Path]:
    """The logs that a path stands for: itself, or those in a folder that is none."""
    if not path.is_dir() or is_log_folder(path):
        return [path]
    refuse_other_kind(path, RECORDING)
    logs = [p for p in sorted(path.iterdir()) if is_log_folder(p) or _may_be_log(p)]
    if not logs:
        raise InputError(f"{path}: {unknown_folder(p.name for p in path.iterdir())}")
    return logs


def is_fleet(path: Path) -> bool:
    """Whether a path is a folder of this project's recordings, each of a robot of its own.

    A folder that is another project's log, or holds some, is one robot.
    """
    if not path.is_dir() or is_log_folder(path):
        return False
    return not any(
        is_log_folder(p) or (_may_be_log(p) and p.suffix != ".csv") for p in path.iterdir()
    )


def _may_be_log(path: Path) -> bool:
    name = Path(path.stem) if path.suffix in _PACKED else path
    return path.is_file() and name.suffix in _ENDINGS and not name.name.endswith(".truth.csv")


def read_folder(folder: Path, options: LogOptions) -> Log:
    """The log in a folder."""
    if sage.is_sage(folder):
        options.refuse(sage.LAYOUT)
        return chosen(folder, sage.read_sage(folder), options)
    if lerobot.is_lerobot(folder):
        options.refuse(lerobot.LAYOUT, ("joints", "unit", "units", "rate", "readings"))
        return chosen(folder, lerobot.read_lerobot(folder, options), options)
    if ros.is_bag(folder):
        return ros.read_bag(folder, options)
    if halves := _halves(folder):
        table, digest = _joined(folder, halves)
        return replace(convert(folder, table, options), sha256=digest)
    inside = [p.name for p in logs_in(folder)]
    raise InputError(
        f"{folder} holds {len(inside)} logs ({', '.join(inside[:3])} …). Give one of them; "
        "commands such as `doctor` and `calibrate` take the folder, functions a list."
    )


def read_content(path: Path, data: bytes, options: LogOptions) -> Log | None:
    """The log in a file's content; None if it is CSV text."""
    digest = hashlib.sha256(data).hexdigest()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = decoded(path, data).encode()
    for marks, read in (
        ((ros.MAGIC, ros.SQLITE), ros.read_file),
        ((arrays.ZIP, arrays.NPY, arrays.MAT), arrays.read_arrays),
        ((parquet.MAGIC,), parquet.read_parquet),
    ):
        if data.startswith(marks):
            return replace(read(path, data, options), sha256=digest)
    start = data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")
    if _MARKUP.match(start):
        raise InputError(f"{path} is XML or HTML, such as a robot's model or a page, not a log.")
    if _CAN.search(data[:_HEAD]):
        raise InputError(
            f"{path} holds raw frames of a CAN bus, whose bytes mean what the motor's manual says. "
            "Decode them (python-can, cantools) into columns of time, command and position."
        )
    if _YAML.match(start) or path.suffix.lower() in (".yaml", ".yml"):
        documents = _documents(path, decoded(path, data))
        log = json_logs.read_json_table(path, documents, options) if documents else None
        if log is not None:
            return replace(log, sha256=digest)
        raise InputError(
            f"{path} is YAML, which is not read: write rows as CSV, or record messages with "
            "`ros2 bag record`."
        )
    if not _JSON.match(start) or _STAMP.match(start) or _ROW.match(data):
        return None
    content = border.parse_json(_whole_json(decoded(path, data)), str(path), "Give it as written.")
    known = json_logs.read_known(path, content, options)
    if known is not None:
        return chosen(path, replace(known, sha256=digest), options)
    log = json_logs.read_json_table(path, content, options)
    if log is None:
        raise InputError(f"{path}: {unknown_json(content if isinstance(content, dict) else [])}")
    return replace(log, sha256=digest)


def _documents(path: Path, text: str) -> list[Any] | None:
    """YAML documents one behind the other, as `ros2 topic echo` prints messages, or one list."""
    parts = [part.strip("\n") for part in _DOCUMENT.split(text) if part.strip()]
    if len(parts) > 1:
        text = "\n".join(f"-{indent(part, '  ')[1:]}" for part in parts)
    elif not text.lstrip().startswith("- "):
        return None
    rows = load(text, str(path))[0]
    return rows if isinstance(rows, list) else None


def _whole_json(text: str) -> str:
    """JSON Lines as one list, in Python's quotes, too; other JSON as it is."""
    if text.lstrip()[:2] == "{'":
        text = without_numpy(text).replace("'", '"').replace(": None", ": null")
    lines = text.strip().split("\n")
    bare = [line.strip() for line in lines[:20] if line.strip() and line[:1] != "#"][:2]
    if len(lines) > 1 and all(line[:1] + line[-1:] == "{}" for line in bare):
        full = [line for line in lines if line.strip() and line[:1] != "#"]
        complete = [line for line in full if line.strip()[:1] + line.strip()[-1:] == "{}"]
        few = len(full) - len(complete) <= max(0.01 * len(full), 1)  # one or the last may be cut
        return f"[{','.join(complete if few else full)}]"
    return text


def chosen(path: Path, log: Log, options: LogOptions) -> Log:
    """Only the joints that the options name, called as they say."""
    if not options.joints:
        return log
    recorded = log.metadata["joints"]
    wanted = joint_names(path, list(options.joints))
    lacking = [j for j in wanted if j not in recorded]
    if lacking:
        raise InputError(f"{path}: `joints` names {lacking[0]}; it has {', '.join(recorded)}.")
    names = dict(zip(wanted, joint_names(path, list(options.joints.values())), strict=True))
    table = log.table.loc[log.table["joint"].isin(wanted)].copy()
    table["joint"] = [names[joint] for joint in table["joint"]]
    metadata: dict[str, Any] = log.metadata | {"joints": list(names.values())}
    for key in ("servos", "loads", "assumed_units"):
        if key in metadata:
            metadata[key] = {names[j]: v for j, v in metadata[key].items() if j in names}
    return replace(log, table=table, metadata=metadata)
