"""Recording files as tables of numbers and a header, or an error that names the place."""

from __future__ import annotations

import difflib
import json
import re
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from pupper_sysid.common.border import parse_json, refuse_other_version, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.csv_table import (
    CsvTable,
    column_names,
    comments_of,
    numbers_of,
    one_line_end,
    read_table,
)
from pupper_sysid.common.reading.dialect import plain
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import column, has_time, time_columns
from pupper_sysid.sysid.recordings.importers.log import Table
from pupper_sysid.sysid.recordings.importers.options import LARGEST_RAD, LogOptions
from pupper_sysid.sysid.recordings.importers.tables import LABELS, is_flag
from pupper_sysid.sysid.recordings.importers.times import drive_in, rate_in, tick_in, units_in
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad, ServoSetup

SCHEMA_VERSION = 1
TITLE = "# pupper-sysid recording"
REQUIRED_COLUMNS = (
    "send_time_s", "read_time_s", "trial", "joint", "frequency_hz", "command_rad", "position_rad",
)  # fmt: skip
OPTIONAL_COLUMNS = (
    "position_count", "voltage_v", "temperature_c", "load", "p_gain", "torque_enabled",
)  # fmt: skip

LARGEST_COUNT = 2**31
"""Largest number of a trial, and largest count of an encoder."""
_FINEST_RAD, _COARSEST_RAD = 1e-7, 0.2  # of a count
_FARTHEST_ZERO_RAD = 100.0  # angle of count 0: a servo of several turns
_HEAD = 4000  # characters in which a log may state its rate
_FEW_BROKEN = 100  # lines
TEXT_COLUMNS = ("joint", "signal")


def _a_count(quantum_rad: float) -> float:
    if 0 < quantum_rad < _FINEST_RAD:
        raise ValueError(f"no encoder is as fine as {quantum_rad:g} rad; 0 stands for none")
    return quantum_rad


_Angle = Annotated[float, Field(ge=-LARGEST_RAD, le=LARGEST_RAD)]
_Zero = Annotated[float, Field(ge=-_FARTHEST_ZERO_RAD, le=_FARTHEST_ZERO_RAD)]
_Quantum = Annotated[float, Field(ge=0, le=_COARSEST_RAD), AfterValidator(_a_count)]


class Bus(BaseModel):
    """Entries of the header's `bus` that computations use; other keys are kept."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)

    kind: str | None = None
    command_quantum_rad: _Quantum | dict[str, _Quantum | None] | None = None
    command_rounding: dict[str, Literal["up", "down", "nearest"] | None] | None = None
    count_zero_rad: dict[str, _Zero | None] | None = None
    speed_limit_rad_s: Annotated[float, Field(ge=0.01, le=1000)] | None = None
    read_time_doubt_s: Annotated[float, Field(ge=0, le=1)] | None = None


class Header(BaseModel):
    """Known entries of a recording's header; other keys are kept."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)

    schema_version: int = 1
    bus: Bus = Bus()
    joints: list[str] = []
    readings: Literal["live", "polled"] | None = None
    angle_unit: Literal["stated"] | None = None
    columns: dict[str, dict[str, str]] = {}
    start_pose_rad: dict[str, _Angle] = {}
    read_after_send_s: Annotated[float, Field(ge=-1, le=1)] | None = None
    servos: dict[str, ServoSetup] = {}
    loads: dict[str, PendulumLoad] = {}


def parse(path: Path, text: str, options: LogOptions | None = None) -> Table:
    """Cells of a table of text (`common.reading.dialect`) with a comment header, as numbers.

    Raises InputError for ragged rows, text where a number belongs, a broken or newer header, or
    more than is read (`common.reading.content`).
    """
    options = options or LogOptions()
    text = one_line_end(text)
    opened = plain(text)
    columns = opened.columns
    if columns is None:
        columns = column_names(path, opened.text)
    if not columns:
        header(path, text)
        raise InputError(f"{path} has no rows: the recording never started. Record it again.")
    ours = "send_time_s" in columns
    strict = ours or "motor_idx" in columns
    texts = [c for c in columns if c in TEXT_COLUMNS or (not ours and _may_be_text(c, options))]
    if columns[0] == "" and not has_time(columns):
        texts.append("")  # a frame's index, which is its time unless it counts rows
    # killed in the middle of a line: of ours the last one has no end
    csv_table = read_table(
        path, opened.text, texts, strict, whole_lines=ours, columns=opened.columns
    )
    entries = _entries(path, text, csv_table.comments)
    metadata = _metadata(path, text, entries)
    warnings: list[str] = list(opened.notes)
    keep = np.ones(len(csv_table), bool)
    for trial, rows in _cancelled(path, csv_table, entries) if ours else []:
        warnings.append(
            f"trial {trial} was interrupted and recorded again; the second one is used."
        )
        keep[rows] = False
    if csv_table.cut:
        warnings.append("its last line was cut short and has been left out.")
    if not ours:
        _refuse_other_names(path, opened.text, columns, csv_table.broken)
    if csv_table.broken:
        warnings.append(
            f"{len(csv_table.broken)} lines that are no rows of the table were left out, the first "
            f"of them line {min(csv_table.broken)}."
        )
    if text.startswith(TITLE) and "completed" not in metadata:
        warnings.append("it was not recorded to its end; what is there is used.")
    if not len(csv_table):
        raise InputError(f"{path} has column names but no rows. Record it again.")
    numbers, texts = dict(csv_table.numbers), dict(csv_table.texts)
    for name in [name for name in texts if name not in TEXT_COLUMNS]:
        with suppress(InputError):  # where a column of joints numbers them
            numbers[name] = numbers_of(path, name, texts[name], csv_table.line)
            del texts[name]
    if "" in texts:
        texts["time"] = texts.pop("")
    elif "" in numbers and not has_time(columns) and not (np.diff(numbers[""]) == 1).all():
        numbers["time"], columns = numbers.pop(""), ["time", *columns[1:]]
    head = text[:_HEAD]
    table = Table(
        {name: numbers[name] for name in columns if name in numbers}, texts, csv_table.faults,
        numbered=opened.numbered, notes=warnings, metadata=metadata,
        rate=rate_in(head.split("\n")), tick_s=tick_in(head), units=units_in(head, columns),
        drive=drive_in(head),
    )  # fmt: skip
    return table if keep.all() else table.taken(np.flatnonzero(keep))


def _refuse_other_names(path: Path, text: str, columns: list[str], broken: list[int]) -> None:
    """Refuse a file whose columns are named again, and differently, in a line between the rows."""
    lines = text.split("\n")
    for n in broken[:_FEW_BROKEN]:
        cells = [cell.strip(" \"'") for cell in lines[n - 1].split(",")]
        both = list(zip(map(column, columns), map(column, cells), strict=False))
        telling = sum(new.kind in ("time", "command", "position") for _, new in both)
        if (
            len(cells) == len(columns)
            and telling > 1
            and any(
                (old.kind, old.key, old.unit) != (new.kind, new.key, new.unit) for old, new in both
            )
        ):
            raise InputError(
                f"{path}, line {n}: the columns are named again, and differently "
                f"({printable(', '.join(cells))[:80]}). Split the file there."
            )


def _may_be_text(name: str, options: LogOptions) -> bool:
    """Whether a column of another project's log may hold names, labels or times of day."""
    chosen = (options.trial, options.time, options.command_time)
    return (
        name in chosen or name.lower() in LABELS or bool(time_columns([name]))
        or is_flag(name) is not None
    )  # fmt: skip


def require(path: Path | str, table: Table, columns: tuple[str, ...]) -> None:
    """Refuse a table that lacks columns; the message names them and similar names."""
    names = [n for n in table.names if n not in table.faults]
    lacking = [c for c in columns if c not in names]
    if not lacking:
        return
    spare = [n for n in names if n not in columns]
    near = difflib.get_close_matches(lacking[0], spare, n=1, cutoff=0.5)
    hint = f" Was '{printable(near[0])}' meant? Rename it." if near else ""
    present = printable(", ".join(names))
    raise InputError(
        f"{path}: column {', '.join(lacking)} is missing; it has {present}.{hint} "
        f"A recording needs {', '.join(columns)}."
    )


def header(path: Path, text: str) -> dict[str, Any]:
    """Validated entries of a file's comment lines."""
    return _metadata(path, text, _entries(path, text, comments_of(path, text)))


def _entries(path: Path, text: str, lines: list[tuple[int, str]]) -> list[tuple[int, str, Any]]:
    """Line, name and value of the entries in comment lines."""
    entries = []
    # the last line of a file may be cut short
    last = lines[-1][0] if lines and text.endswith(lines[-1][1]) else None
    for n, line in lines:
        if not line.startswith("# ") or ": " not in line:
            continue
        key, _, value = line[2:].partition(": ")
        name = f"{path}, line {n}: the value of '{printable(key)[:60]}'"
        try:
            entries.append((n, key.strip(), parse_json(value, name, "Mend or remove the line.")))
        except InputError:
            if text.startswith(TITLE) and n != last:
                raise
    return entries


def _metadata(path: Path, text: str, entries: list[tuple[int, str, Any]]) -> dict[str, Any]:
    metadata = {key: value for _, key, value in entries}
    if text.startswith(TITLE):
        check_metadata(path, metadata)
        return metadata
    known: dict[str, Any] = {}  # others use the same words for other things
    for key, value in metadata.items():
        with suppress(InputError):
            check_metadata(path, {key: value})
            known[key] = value
    return known


def check_metadata(path: Path | str, metadata: dict[str, Any]) -> None:
    """Refuse header entries of the wrong type, or of a newer version."""
    refuse_other_version(path, metadata.get("schema_version", SCHEMA_VERSION), SCHEMA_VERSION)
    validated(Header, metadata, f"{path}, header", remedy="leave it out")


def comments(title: str, entries: dict[str, Any]) -> str:
    """Comment lines that open a table: a title, then `# key: JSON value` of each entry."""
    return "\n".join([f"# {title}", *(comment(k, v) for k, v in entries.items()), ""])


def comment(key: str, value: Any) -> str:
    """One comment line; NumPy values become plain ones, other objects text."""

    def plain(value: Any) -> Any:
        return value.tolist() if hasattr(value, "tolist") else str(value)

    text = json.dumps(value, ensure_ascii=False, default=plain)
    # what else ends a line for `splitlines`, and JSON leaves as it is
    return f"# {key}: " + re.sub("[\x85\u2028\u2029]", lambda m: f"\\u{ord(m[0]):04x}", text)


def _cancelled(
    path: Path, csv_table: CsvTable, entries: list[tuple[int, str, Any]]
) -> list[tuple[int, slice]]:
    """Trials, and their rows, that a later line `# resumed` cancels."""
    resumed: dict[int, int] = {}
    for n, key, value in entries:
        if key != "resumed":
            continue
        trial = value.get("trial") if isinstance(value, dict) else None
        if type(trial) is not int or abs(trial) >= LARGEST_COUNT:
            raise InputError(
                f"{path}, line {n}: resumed names no trial by a whole number. Mend or remove the "
                "line."
            )
        resumed[trial] = n
    if not resumed or "trial" not in csv_table.numbers:
        return []
    order = np.argsort(csv_table.numbers["trial"], kind="stable")  # rows of a trial in their order
    trials = csv_table.numbers["trial"][order]
    cancelled = []
    for trial, n in resumed.items():
        rows = order[np.searchsorted(trials, trial) : np.searchsorted(trials, trial, "right")]
        rows = rows[csv_table.line[rows] < n]
        if len(rows):
            cancelled.append((trial, slice(rows[0], rows[-1] + 1)))
    return cancelled
