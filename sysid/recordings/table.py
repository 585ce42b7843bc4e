"""Validation of recordings: CSV text to a table of numbers, or an error that names the place."""

from __future__ import annotations

import csv
import difflib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from pupper_sysid.common.border import parse_json, refuse_other_version, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import strange_joint
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.shared.log import MOST_CELLS
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad, ServoSetup

SCHEMA_VERSION = 1
TITLE = "# pupper-sysid recording"
REQUIRED_COLUMNS = (
    "send_time_s", "read_time_s", "trial", "joint", "frequency_hz", "command_rad", "position_rad",
)  # fmt: skip
OPTIONAL_COLUMNS = (
    "position_count", "voltage_v", "temperature_c", "load", "p_gain", "torque_enabled",
)  # fmt: skip

_LEAST_ROWS = 20
_MANY_REPEATED = 0.1  # of the rows
_SHORTEST_TRIAL = 3  # rows; a rate of the command takes as many
_LARGEST_RAD = 2 * np.pi + 0.5  # no joint of a legged robot turns further
_FINEST_RAD, _COARSEST_RAD = 1e-7, 0.2  # of a count
_FARTHEST_ZERO_RAD = 100.0  # angle of count 0: a servo of several turns
_LARGEST_COUNT = 2**31
TEXT_COLUMNS = ("joint", "signal")


def _a_count(quantum_rad: float) -> float:
    if 0 < quantum_rad < _FINEST_RAD:
        raise ValueError(f"no encoder is as fine as {quantum_rad:g} rad; 0 stands for none")
    return quantum_rad


_Angle = Annotated[float, Field(ge=-_LARGEST_RAD, le=_LARGEST_RAD)]
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
    start_pose_rad: dict[str, _Angle] = {}
    read_after_send_s: Annotated[float, Field(ge=-1, le=1)] | None = None
    servos: dict[str, ServoSetup] = {}
    loads: dict[str, PendulumLoad] = {}


@dataclass(frozen=True)
class Parsed:
    """Header and table of a file of yet unknown layout.

    Attributes
    ----------
    metadata : dict
    table : pandas.DataFrame
        Numbers, but for the columns of text; empty cells are NaN.
    warnings : list of str
    faults : dict of str to str
        Columns of other projects' logs that hold text, and the sentence on the first such cell.
    """

    metadata: dict[str, Any]
    table: pd.DataFrame
    warnings: list[str] = field(default_factory=list)
    faults: dict[str, str] = field(default_factory=dict)


def parse(path: Path, text: str) -> Parsed:
    """Cells of a CSV file with a comment header, as numbers.

    Raises
    ------
    InputError
        For ragged rows, text where a number belongs, a broken or newer header.
    """
    lines = text.splitlines()
    metadata = header(path, lines)
    warnings: list[str] = []
    rows = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not rows:
        raise InputError(f"{path} has no rows: the recording never started. Record it again.")
    columns = [c.strip() for c in next(csv.reader([rows[0][1]]))]
    if len(columns) == 1 and ";" in columns[0]:
        raise InputError(
            f"{path}, line {rows[0][0]}: cells are separated by semicolons. Save it with commas "
            "between cells and points in numbers."
        )
    if len(set(columns)) != len(columns):
        raise InputError(f"{path}, line {rows[0][0]}: a column name stands twice. Rename one.")
    ours = "send_time_s" in columns
    strict = ours or "motor_idx" in columns
    if not ours and len(columns) * len(rows) > MOST_CELLS:
        raise InputError(f"{path} has more than {MOST_CELLS:,} cells. Split it by joint.")
    body = rows[1:]
    cancelled = _cancelled(lines, columns, body) if ours else []
    for trial, first, last in cancelled:
        warnings.append(
            f"trial {trial} was interrupted and recorded again; the second one is used."
        )
        body = [(n, line) for n, line in body if not first <= n <= last]
    # line by line: a stray quote must not swallow the lines behind it
    cells = [_cells(path, n, line) for n, line in body]
    numbers = [n for n, _ in body]
    # killed in the middle of a line: the last one has no end, or too few cells
    cut = bool(cells) and (len(cells[-1]) < len(columns) or (ours and not text.endswith("\n")))
    if cut:
        cells, numbers = cells[:-1], numbers[:-1]
        warnings.append("its last line was cut short and has been left out.")
    for n, row in zip(numbers, cells, strict=True):
        if len(row) != len(columns):
            raise InputError(
                f"{path}, line {n}: {len(row)} cells where the header names {len(columns)} "
                "columns; command and position must have the same number of values. Mend or "
                "remove the line."
            )
    if lines[0].startswith(TITLE) and "completed" not in metadata:
        warnings.append("it was not recorded to its end; what is there is used.")
    if not cells:
        raise InputError(f"{path} has column names but no rows. Record it again.")
    data: dict[str, Any] = {}
    faults: dict[str, str] = {}
    for k, name in enumerate(columns):
        own = [row[k] for row in cells]
        try:
            data[name] = _column(path, name, own, numbers)
        except InputError as error:
            if strict:
                raise
            data[name], faults[name] = own, str(error)
    return Parsed(metadata, pd.DataFrame(data), warnings, faults)


def check(path: Path | str, table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Refuse or repair a tidy table.

    Parameters
    ----------
    path : Path or str
        Name of the source, for messages.
    table : pandas.DataFrame

    Returns
    -------
    table : pandas.DataFrame
    warnings : list of str
        One sentence per repair.

    Raises
    ------
    InputError
        If a joint is unknown, times run backwards, angles cannot be radians, or too little is left.
    """
    warnings: list[str] = []
    if strange := strange_joint(table["joint"].to_list()):
        raise InputError(f"{path}, column joint: '{strange[0]}' is no joint; {strange[1]}")
    needed = ["send_time_s", "read_time_s", "trial", "command_rad"]
    lost = np.isnan(table[needed].to_numpy(float)).any(axis=1)
    if lost.any():
        warnings.append(f"{int(lost.sum())} rows without time, trial or command were left out.")
        table = table.loc[~lost]
    numbers = table["trial"].to_numpy(float)
    if (np.abs(numbers) >= _LARGEST_COUNT).any() or (numbers % 1 != 0).any():
        raise InputError(f"{path}, column trial: trials are counted by whole numbers.")
    counts = np.abs(table["position_count"].to_numpy(float)) if "position_count" in table else []
    if np.any(np.asarray(counts) >= _LARGEST_COUNT):
        raise InputError(f"{path}, column position_count: a value is larger than any encoder's.")
    position = table["position_rad"].to_numpy(float)
    missing = float(np.mean(np.isnan(position))) if len(position) else 1.0
    if missing == 1.0:
        raise InputError(
            f"{path}, column position_rad: no row has a position, so the bus never answered. "
            "Check power and wiring, then record again."
        )
    if missing > 0:
        warnings.append(f"{100 * missing:.1f} % of the positions are missing.")
    for column in ("command_rad", "position_rad"):
        _refuse_degrees(path, column, table[column].to_numpy())
    again = table.duplicated(["joint", "trial", "send_time_s"])
    if again.mean() > _MANY_REPEATED:
        raise InputError(
            f"{path}, column send_time_s: {100 * again.mean():.0f} % of the rows repeat a time "
            "stamp of their trial: a clock too coarse, or two logs in one. Record with a clock of "
            "1 ms or finer, and give each pass its own trial number."
        )
    if again.any():
        warnings.append(f"{int(again.sum())} rows with a repeated time stamp were left out.")
        table = table.loc[~again]
    short: list[tuple[str, float]] = []
    for _, rows in table.groupby(["joint", "trial"], sort=False):
        joint, trial = rows["joint"].iloc[0], rows["trial"].iloc[0]
        for column in ("send_time_s", "read_time_s"):
            back = np.flatnonzero(np.diff(rows[column].to_numpy()) < 0)
            if len(back):
                raise InputError(
                    f"{path}, column {column}: time runs backwards in trial {trial:g} of {joint}, "
                    f"after {rows[column].iloc[back[0]]:.4f} s. Sort the rows, or give each pass "
                    "its own trial number."
                )
        tones = rows["frequency_hz"].dropna().unique()
        if len(tones) > 1:
            raise InputError(
                f"{path}, column frequency_hz: trial {trial:g} of {joint} has {tones[0]:g} and "
                f"{tones[1]:g} Hz. Give each frequency its own trial number."
            )
        if len(rows) < _SHORTEST_TRIAL:
            short.append((joint, trial))
            warnings.append(f"trial {trial:g} of {joint} is too short to use and was left out.")
        elif len(rows) < _LEAST_ROWS:
            warnings.append(f"trial {trial:g} of {joint} has only {len(rows)} rows.")
    usable = ~pd.MultiIndex.from_arrays([table["joint"], table["trial"]]).isin(short)
    if usable.sum() < _LEAST_ROWS:
        raise InputError(
            f"{path} has {len(table)} usable rows; at least {_LEAST_ROWS} are needed. "
            "Record for longer."
        )
    return table.loc[usable].reset_index(drop=True), warnings


def require(path: Path | str, table: pd.DataFrame, columns: tuple[str, ...]) -> None:
    """Refuse a table that lacks columns; the message names them and similar names."""
    lacking = [c for c in columns if c not in table.columns]
    if not lacking:
        return
    spare = [str(c) for c in table.columns if c not in columns]
    near = difflib.get_close_matches(lacking[0], spare, n=1, cutoff=0.5)
    hint = f" Was '{near[0]}' meant? Rename it." if near else ""
    raise InputError(
        f"{path}: column {', '.join(lacking)} is missing; it has "
        f"{', '.join(map(str, table.columns))}.{hint} A recording needs {', '.join(columns)}."
    )


def header(path: Path, lines: list[str]) -> dict[str, Any]:
    """Validated entries of a file's comment lines.

    Raises
    ------
    InputError
        If a value is not JSON or not of its type, or a newer version wrote the file.
    """
    metadata: dict[str, Any] = {}
    for n, line in enumerate(lines, 1):
        if not line.startswith("# ") or ": " not in line:
            continue
        key, _, value = line[2:].partition(": ")
        name = f"{path}, line {n}: the value of '{key}'"
        try:
            metadata[key.strip()] = parse_json(value, name, "Mend or remove the line.")
        except InputError:
            if lines[0].startswith(TITLE) and n < len(lines):
                raise
    check_metadata(path, metadata)
    return metadata


def check_metadata(path: Path | str, metadata: dict[str, Any]) -> None:
    """Refuse header entries of the wrong type, or of a newer version."""
    refuse_other_version(path, metadata.get("schema_version", SCHEMA_VERSION), SCHEMA_VERSION)
    validated(Header, metadata, f"{path}, header", remedy="leave it out")


def comments(title: str, entries: dict[str, Any]) -> str:
    """Comment lines that open a table: a title, then `# key: JSON value` of each entry."""
    return "\n".join([f"# {title}", *(comment(k, v) for k, v in entries.items()), ""])


def comment(key: str, value: Any) -> str:
    """One comment line; NumPy values become plain ones, other objects text."""

    def plain(found: Any) -> Any:
        return found.tolist() if hasattr(found, "tolist") else str(found)

    text = json.dumps(value, ensure_ascii=False, default=plain)
    # what else ends a line for `splitlines`, and JSON leaves as it is
    return f"# {key}: " + re.sub("[\x85\u2028\u2029]", lambda m: f"\\u{ord(m[0]):04x}", text)


def _cells(path: Path, number: int, line: str) -> list[str]:
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error:
        raise InputError(
            f"{path}, line {number}: a quotation mark is not closed. Mend or remove the line."
        ) from None


def _cancelled(
    lines: list[str], columns: list[str], rows: list[tuple[int, str]]
) -> list[tuple[int, int, int]]:
    """Trial, first and last line of rows that a later line `# resumed` cancels."""
    found = []
    at = columns.index("trial") if "trial" in columns else -1
    for n, line in enumerate(lines, 1):
        if at < 0 or not line.startswith("# resumed: "):
            continue
        try:
            trial = int(json.loads(line.partition(": ")[2])["trial"])
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
        void = [
            k for k, row in rows
            if k < n and len(cells := row.split(",")) > at and cells[at] == str(trial)
        ]  # fmt: skip
        if void:
            found.append((trial, void[0], void[-1]))
    return found


def _column(path: Path, name: str, cells: list[str], numbers: list[int]) -> Any:
    if name in TEXT_COLUMNS:
        return [c.strip() for c in cells]
    values, shown = np.full(len(cells), np.nan), printable(name)[:60]
    for k, cell in enumerate(cells):
        text = cell.strip()
        if text == "":
            continue
        try:
            values[k] = float(text)
        except ValueError:
            raise InputError(
                f"{path}, line {numbers[k]}, column {shown}: '{printable(text[:40])}' is not a "
                "number. Mend the cell, or leave it empty if there was no reading."
            ) from None
        if np.isinf(values[k]):
            raise InputError(f"{path}, line {numbers[k]}, column {shown}: the value is infinite.")
    return values


def _refuse_degrees(path: Path | str, column: str, values: np.ndarray) -> None:
    largest = float(np.nanmax(np.abs(values)))
    if largest > _LARGEST_RAD:
        raise InputError(
            f"{path}, column {column}: values reach {largest:.4g}, more than a turn, which looks "
            "like degrees or counts. Angles must be radians: multiply degrees by 0.0174533, or "
            "convert the log with `pupper-sysid import --unit deg` (counts:4096, …)."
        )
