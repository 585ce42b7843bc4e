"""The border of `sysid.recording`: text becomes a table of numbers, or a sentence about why not.

`parse` splits a file into header and cells, `numbers` turns the cells of the columns that a layout
needs into numbers; what the numbers mean is judged in `sysid.recording_check`. Tables are indexed
by the line of the file, so that every sentence can name one.
"""

from __future__ import annotations

import csv
import difflib
import json
import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from common.errors import InputError
from common.joints import JOINT_NAMES

SCHEMA_VERSION = 1
TITLE = "# pupper-sysid recording"
REQUIRED_COLUMNS = (
    "send_time_s", "read_time_s", "trial", "joint", "frequency_hz", "command_rad", "position_rad",
)  # fmt: skip
OPTIONAL_COLUMNS = ("position_count", "voltage_v", "temperature_c", "load")

LARGEST_RAD = 2 * math.pi + 0.5
"""No joint of a legged robot turns further."""

_LARGEST_COUNT = 2**31


class BusHeader(BaseModel):
    """What is known of the bus in a recording's header; other keys are kept as they are."""

    model_config = ConfigDict(extra="allow", strict=True)

    command_quantum_rad: FiniteFloat | None = Field(default=None, ge=0)
    command_rounding: dict[str, Literal["up", "down"]] | None = None


class Header(BaseModel):
    """What is known of a recording's header; other keys are kept as they are."""

    model_config = ConfigDict(extra="allow", strict=True)

    schema_version: int = Field(default=SCHEMA_VERSION, ge=1)
    bus: BusHeader = BusHeader()
    joints: list[str] = []
    start_pose_rad: dict[str, FiniteFloat] = {}
    read_after_send_s: FiniteFloat | None = None
    seed: int | None = None


@dataclass(frozen=True)
class Parsed:
    """A file's header, column names and cells, before anyone knows which layout it is.

    Attributes
    ----------
    metadata : dict
    columns : dict of str to list of str
        Cells of each column.
    lines : list of int
        Line of the file that each row stands on.
    warnings : list of str
    """

    metadata: dict[str, Any]
    columns: dict[str, list[str]]
    lines: list[int]
    warnings: list[str]


def parse(path: Path, text: str) -> Parsed:
    """Cells of a CSV file with a comment header.

    Raises
    ------
    InputError
        For ragged rows, no rows, doubled column names, a broken or newer header.
    """
    # str.splitlines would also split at form feeds and the like, inside cells
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    metadata = _header(path, lines)
    warnings: list[str] = []
    rows = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not rows:
        raise InputError(f"{path} has no rows: the recording never started. Record it again.")
    columns = [c.strip() for c in _cells(path, *rows[0])]
    if len(columns) == 1 and (other := set(columns[0]) & set(";\t")):
        raise InputError(
            f"{path}, line {rows[0][0]}: columns are separated by {sorted(other)[0]!r}, not by "
            "commas. Save it with commas between cells and points in numbers."
        )
    if len(set(columns)) != len(columns):
        raise InputError(f"{path}, line {rows[0][0]}: a column name stands twice. Rename one.")
    ours = "send_time_s" in columns
    cells = [_cells(path, n, line) for n, line in rows[1:]]
    numbers = [n for n, _ in rows[1:]]
    # killed in the middle of a row: it has too few cells, or no end of line
    last = next(n for n in range(len(lines), 0, -1) if lines[n - 1].strip())
    unended = ours and last == len(lines)
    if cells and numbers[-1] == last and (len(cells[-1]) < len(columns) or unended):
        cells, numbers = cells[:-1], numbers[:-1]
        warnings.append("its last line was cut short and has been left out.")
    for n, row in zip(numbers, cells, strict=True):
        if len(row) != len(columns):
            raise InputError(
                f"{path}, line {n}: {len(row)} cells where the header names {len(columns)} "
                "columns; command and position must have the same number of values. Mend or "
                "remove the line."
            )
    if ours and "completed" not in metadata:
        warnings.append("it was not recorded to its end; what is there is used.")
    if not cells:
        raise InputError(f"{path} has column names but no rows. Record it again.")
    data = {name: [row[k].strip() for row in cells] for k, name in enumerate(columns)}
    return Parsed(metadata, data, numbers, warnings)


def require(
    path: Path, columns: Iterable[str], needed: Collection[str], others: Collection[str] = ()
) -> None:
    """Raise a sentence that names the `needed` columns not in `columns`, and what was meant.

    `others` are columns with a meaning of their own, never proposed.
    """
    columns = list(columns)
    lacking = [c for c in needed if c not in columns]
    if not lacking:
        return
    spare = [c for c in columns if c not in needed and c not in others]
    near = difflib.get_close_matches(lacking[0], spare, n=1, cutoff=0.5)
    hint = f" Was '{near[0]}' meant? Rename it." if near else ""
    lack = f"column {lacking[0]} is" if len(lacking) == 1 else f"columns {', '.join(lacking)} are"
    raise InputError(
        f"{path}: {lack} missing; it has {', '.join(columns)}.{hint} "
        f"A recording of this kind needs {', '.join(needed)}."
    )


def numbers(path: Path, parsed: Parsed, names: Iterable[str]) -> pd.DataFrame:
    """The named columns as numbers, indexed by line; empty cells are NaN.

    Raises
    ------
    InputError
        If a cell is no number, or infinite; the sentence names the line.
    """
    table = {name: _numbers(path, name, parsed.columns[name], parsed.lines) for name in names}
    return pd.DataFrame(table, index=parsed.lines)


def unknown_joint(name: str) -> str:
    """Sentence about a name that is no joint's, with the nearest that is."""
    near = difflib.get_close_matches(name, JOINT_NAMES, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(JOINT_NAMES)}."
    return f"{name[:40]!r} is no joint; {hint}"


def refuse_fractions(path: Path, column: str, lines: NDArray, values: NDArray) -> None:
    """Raise unless all `values` are whole numbers of a size that can be counted, or NaN."""
    wrong = np.flatnonzero((values % 1 != 0) | (np.abs(values) > _LARGEST_COUNT))
    wrong = wrong[np.isfinite(values[wrong])]
    if len(wrong):
        raise InputError(
            f"{path}, line {lines[wrong[0]]}, column {column}: {values[wrong[0]]:g} is not a whole "
            "number that counts something. Mend the cell."
        )


def refuse_degrees(path: Path, column: str, lines: NDArray, values: NDArray) -> None:
    """Raise if an angle is larger than any joint's in radians."""
    wrong = np.flatnonzero(np.abs(values) > LARGEST_RAD)
    if len(wrong):
        raise InputError(
            f"{path}, line {lines[wrong[0]]}, column {column}: values reach "
            f"{np.nanmax(np.abs(values)):.4g}, more than a turn, which looks like degrees or "
            "counts. Angles must be radians: multiply degrees by 0.0174533."
        )


def _cells(path: Path, number: int, line: str) -> list[str]:
    # line by line, because an unbalanced quote would swallow the rest of the file
    try:
        return next(csv.reader([line]))
    except csv.Error as error:
        raise InputError(f"{path}, line {number}: {error}. Mend or remove the line.") from None


def _header(path: Path, lines: list[str]) -> dict[str, Any]:
    metadata: dict[str, Any] = {}
    for n, line in enumerate(lines, 1):
        if not line.startswith("# ") or ": " not in line:
            continue
        key, _, value = line[2:].partition(": ")
        try:
            metadata[key.strip()] = json.loads(value)
        except (ValueError, RecursionError):
            if lines[0].startswith(TITLE) and n < len(lines):
                raise InputError(
                    f"{path}, line {n}: the value of '{key}' is not JSON. Mend or remove the line."
                ) from None
    try:
        header = Header.model_validate(metadata)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(
            f"{path}, header, {where}: {first['msg']}. Mend or remove that entry."
        ) from None
    if header.schema_version > SCHEMA_VERSION:
        raise InputError(
            f"{path} has schema_version {header.schema_version}, written by a newer pupper-sysid; "
            f"this one reads up to {SCHEMA_VERSION}. Upgrade."
        )
    for joint, angle in header.start_pose_rad.items():
        if abs(angle) > LARGEST_RAD:
            raise InputError(
                f"{path}, header, start_pose_rad.{joint}: {angle:.4g} is more than a turn, which "
                "looks like degrees. Angles must be radians: multiply degrees by 0.0174533."
            )
    return metadata


def _numbers(path: Path, name: str, cells: list[str], lines: list[int]) -> np.ndarray:
    values = np.full(len(cells), np.nan)
    for k, text in enumerate(cells):
        if text == "":
            continue
        try:
            # float() would also take 1_000 and the digits of other scripts
            values[k] = float(text) if text.isascii() and "_" not in text else float("no")
        except ValueError:
            raise InputError(
                f"{path}, line {lines[k]}, column {name}: {text[:40]!r} is not a number. "
                "Mend the cell, or leave it empty if there was no reading."
            ) from None
        if np.isinf(values[k]):
            raise InputError(
                f"{path}, line {lines[k]}, column {name}: the value is infinite. "
                "Mend the cell, or leave it empty if there was no reading."
            )
    return values
