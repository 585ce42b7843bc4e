"""What importers share: the `Log` that each returns, the `Table` that most make first, and names.

Each reader of tables (text, JSON, parquet, arrays) makes a `Table`, columns by name, and
`importers.tables` makes rows of it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common import border
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import distinct, one_each
from pupper_sysid.common.strict_yaml import printable

LARGEST_BYTES = 500e6
"""Largest log that is read, of all its files."""
MOST_TRIALS = 50_000
"""Of all joints together."""
MOST_JOINTS = 200

_LEAST, _LARGEST = 1e-100, 1e100  # whose squares are numbers, too
_ENDINGS = re.compile(r"[._/](pos|position)$", re.IGNORECASE)


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
    notes: Sequence[str] = ()
    """What was assumed, in sentences."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Entries of the log's header."""
    rate: float | None = None
    """Rows a second that the log states beside its columns."""
    tick_s: float | None = None
    """Of its times, as the log states beside its columns."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Units of angles that the log states beside its columns; of the name "" those of all."""

    drive: tuple[str, str] = ("", "")
    """What the log says beside its columns that its drive is, and the unit which that counts."""

    @cached_property
    def names(self) -> list[str]:
        """Names of all columns."""
        return list(dict.fromkeys([*self.columns, *self.texts, *self.faults]))

    def numbers(self, path: Path | str, name: str) -> NDArray[np.float64]:
        """Finite or missing numbers of a column."""
        printed = printable(name)[:60]
        if name not in self.columns:
            fault = f"{path}, column {printed}: its values are not numbers."
            raise InputError(self.faults.get(name, fault))
        values = np.asarray(self.columns[name], float)
        if (np.abs(values) > _LARGEST).any():
            raise InputError(f"{path}, column {printed}: a value is infinite, or beyond 1e100.")
        return values

    def known(self, name: str) -> NDArray[np.float64]:
        """The numbers of a column that are not missing; two zeros if it has none."""
        values = self.columns.get(name, np.zeros(0))
        values = np.where(np.abs(values) < _LEAST, 0.0, values)[np.abs(values) <= _LARGEST]
        return values if len(values) else np.zeros(2)

    @cached_property
    def moving(self) -> list[str]:
        """Columns whose numbers are not all the same, and those of text."""
        return [n for n in self.names if n not in self.columns or np.ptp(self.known(n)) > 0]

    def first(self, names: Sequence[str]) -> str | None:
        """The first of these names, in any case, that a column of numbers has."""
        return next((self._lower[n] for n in names if n in self._lower), None)

    @cached_property
    def _lower(self) -> dict[str, str]:
        return {n.lower(): n for n in self.columns}

    @cached_property
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

    `arrays` of shape (rows,) or (rows, joints). `names`: of the joints; arrays of another width get
    `joint_0`, `joint_1` and so on. `named`: what in the log holds these names, if anything does.
    """
    distinct(path if named is None else f"{path}, {named}", names, "joints")
    lengths = [len(values) for values in arrays.values()]
    rows = max(set(lengths), key=lengths.count, default=0)
    columns, faults, widths = {}, {}, {}
    for key, values in arrays.items():
        parts = {key: values}
        if values.ndim == 2:
            width = min(values.shape[1], 10_000)
            labels = names if len(names) == width else [f"joint_{k}" for k in range(width)]
            parts = {f"{key}.{labels[k]}": values[:, k] for k in range(width)}
            widths[key] = width
        if len(values) == rows:
            columns |= parts
        else:
            text = f"{path}: {key} has {len(values)} rows where others have {rows}. Mend the log."
            faults |= dict.fromkeys(parts, text)
    distinct(path, [*columns, *faults])
    return Table(columns, {}, faults, widths, None if named is None else (named, len(names)))


@dataclass(frozen=True)
class Log:
    """A log of another project as the rows of a recording."""

    table: pd.DataFrame
    """Columns `sysid.recordings.table.REQUIRED_COLUMNS` and some of `OPTIONAL_COLUMNS`."""
    metadata: dict[str, Any]
    """Header entries; `imported_from` names the layout."""
    warnings: list[str] = field(default_factory=list)
    """What the log does not say, and what was assumed instead."""
    sha256: str = ""
    """Of the bytes it was read from."""


def rows(
    joint: str,
    send_time_s: ArrayLike,
    read_time_s: ArrayLike,
    command_rad: ArrayLike,
    position_rad: ArrayLike,
    trial: ArrayLike = 0,
    **optional: ArrayLike,
) -> pd.DataFrame:
    """Rows of one joint; `optional` are columns such as `p_gain`."""
    columns = {"send_time_s": send_time_s, "read_time_s": read_time_s, "trial": trial,
               "joint": joint, "frequency_hz": np.nan, "command_rad": command_rad,
               "position_rad": position_rad}  # fmt: skip
    return pd.DataFrame(columns | optional)


def joint_names(path: Path | str, wanted: Sequence[str]) -> list[str]:
    """Joints' names as this project can use them: letters, digits and `_`.

    >>> joint_names("log", ["shoulder pan.pos", "2nd/wrist"])
    ['shoulder_pan', 'joint_2nd_wrist']
    """
    refuse_more(path, len(wanted), MOST_JOINTS, "joints", "Name those to read with `joints`.")
    cleaned = []
    for name in wanted:
        text = re.sub(r"[^A-Za-z0-9]+", "_", bare_name(str(name))).strip("_")
        cleaned.append((text if text[:1].isalpha() else f"joint_{text}".rstrip("_"))[:64])
    distinct(path, cleaned, "joints")
    return cleaned


def bare_name(name: str) -> str:
    """A joint's name without the word position behind it: `gripper.pos` is `gripper`."""
    return _ENDINGS.sub("", name.strip()) or name


def numbers(
    path: Path | str, entries: Sequence[Any], key: str, where: str, missing: bool = False
) -> NDArray[np.float64]:
    """Numbers `entries[k][key]`; with `missing`, an absent or empty one is NaN."""
    values = np.full(len(entries), np.nan)
    for k, entry in enumerate(entries):
        value = entry.get(key) if isinstance(entry, Mapping) else None
        if value is None and missing:
            continue
        values[k] = number(path, value, f"{where}[{k}].{key}")
    return values


def number(path: Path | str, value: Any, place: str) -> float:
    """`value` as a float."""
    if isinstance(value, int | float):
        try:
            parsed = float(value)
        except OverflowError:
            parsed = float("inf")
        if abs(parsed) != float("inf"):
            return parsed
    printed = "missing" if value is None else f"{printable(str(value))[:40]}, not a finite number"
    raise InputError(f"{path}, {place} is {printed}. Mend the log, or leave the row out.")


def read_files(root: Path, files: Iterable[Path]) -> tuple[dict[Path, bytes], str]:
    """Content of a log's files within the budget of bytes, and the SHA-256 of names and content."""
    contents: dict[Path, bytes] = {}
    total, digest = 0, hashlib.sha256()
    remedy = "Give a part of the log, or split it by joint or by episode."
    for path in sorted(files):
        contents[path] = border.read_bytes(path, LARGEST_BYTES, remedy)
        total += len(contents[path])
        refuse_more(root, total, LARGEST_BYTES, "bytes", remedy, exact=False)
        digest.update(f"{path.relative_to(root).as_posix()}\0{len(contents[path])}\0".encode())
        digest.update(contents[path])
    return contents, digest.hexdigest()


def held_commands(
    sent_s: NDArray[np.float64], commands: NDArray[np.float64], read_s: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """The command in force at each reading (zero-order hold); nothing is interpolated.

    `sent_s`, shape (n,), not decreasing: when `commands`, shape (n,) or (n, joints), were sent.
    `read_s`, shape (m,): when positions were read. Returns when the command of each row was sent
    (where it had been sent for an earlier reading already, the time of this reading, since it
    stays in force), the commands, and which readings have a command before them, shape (m,).

    >>> sent, command = np.array([0.0, 1.0]), np.array([5.0, 6.0])
    >>> held_commands(sent, command, np.array([-1.0, 0.5, 0.75, 1.5]))
    (array([0.  , 0.75, 1.  ]), array([5., 5., 6.]), array([False,  True,  True,  True]))
    """
    last = np.searchsorted(sent_s, read_s, side="right") - 1
    kept = last >= 0
    last, read = last[kept], read_s[kept]
    again = np.concatenate([[False], np.diff(last) == 0])
    return np.where(again, read, sent_s[last]), commands[last], kept
