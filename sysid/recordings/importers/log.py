"""What importers share: the `Log` that each returns, names, numbers, budgets, held commands."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common import border
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import distinct
from pupper_sysid.common.strict_yaml import printable

LARGEST_BYTES = 500e6
"""Largest log that is read, of all its files."""
MOST_TRIALS = 50_000
"""Of all joints together."""
MOST_JOINTS = 200

_ENDINGS = re.compile(r"[._/](pos|position)$", re.IGNORECASE)


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
    columns = {
        "send_time_s": send_time_s,
        "read_time_s": read_time_s,
        "trial": trial,
        "joint": joint,
        "frequency_hz": np.nan,
        "command_rad": command_rad,
        "position_rad": position_rad,
    }
    return pd.DataFrame(columns | optional)


def joint_names(path: Path | str, given: Sequence[str]) -> list[str]:
    """Joints' names as this project can use them: letters, digits and `_`.

    Examples
    --------
    >>> joint_names("log", ["shoulder pan.pos", "2nd/wrist"])
    ['shoulder_pan', 'joint_2nd_wrist']
    """
    refuse_more(path, len(given), MOST_JOINTS, "joints", "Name those to read with `joints`.")
    found = []
    for name in given:
        text = re.sub(r"[^A-Za-z0-9]+", "_", bare_name(str(name))).strip("_")
        found.append((text if text[:1].isalpha() else f"joint_{text}".rstrip("_"))[:64])
    distinct(path, found, "joints")
    return found


def bare_name(name: str) -> str:
    """A joint's name without the word position behind it: `gripper.pos` is `gripper`."""
    return _ENDINGS.sub("", name.strip()) or name


def numbers(
    path: Path | str, entries: Sequence[Any], key: str, where: str, missing: bool = False
) -> NDArray[np.float64]:
    """Numbers `entries[k][key]`; with `missing`, an absent or empty one is NaN."""
    found = np.full(len(entries), np.nan)
    for k, entry in enumerate(entries):
        value = entry.get(key) if isinstance(entry, Mapping) else None
        if value is None and missing:
            continue
        found[k] = number(path, value, f"{where}[{k}].{key}")
    return found


def number(path: Path | str, value: Any, place: str) -> float:
    """`value` as a float."""
    if isinstance(value, int | float):
        try:
            found = float(value)
        except OverflowError:
            found = float("inf")
        if abs(found) != float("inf"):
            return found
    shown = "missing" if value is None else f"{printable(str(value))[:40]}, not a finite number"
    raise InputError(f"{path}, {place} is {shown}. Mend the log, or leave the row out.")


def read_files(root: Path, files: Iterable[Path]) -> tuple[dict[Path, bytes], str]:
    """Content of a log's files within the budget of bytes, and the SHA-256 of names and content."""
    found: dict[Path, bytes] = {}
    total, digest = 0, hashlib.sha256()
    remedy = "Give a part of the log, or split it by joint or by episode."
    for path in sorted(files):
        found[path] = border.read_bytes(path, LARGEST_BYTES, remedy)
        total += len(found[path])
        refuse_more(root, total, LARGEST_BYTES, "bytes", remedy, exact=False)
        digest.update(f"{path.relative_to(root).as_posix()}\0{len(found[path])}\0".encode())
        digest.update(found[path])
    return found, digest.hexdigest()


def held_commands(
    sent_s: NDArray[np.float64], commands: NDArray[np.float64], read_s: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """The command in force at each reading (zero-order hold); nothing is interpolated.

    Parameters
    ----------
    sent_s : ndarray, shape (n,)
        When commands were sent, not decreasing.
    commands : ndarray, shape (n,) or (n, joints)
    read_s : ndarray, shape (m,)
        When positions were read.

    Returns
    -------
    send_time_s : ndarray, shape (k,)
        When the command of each row was sent; where it had been sent for an earlier reading
        already, the time of this reading, since the same command stays in force.
    commands : ndarray, shape (k,) or (k, joints)
    kept : ndarray of bool, shape (m,)
        Readings with a command before them.

    Examples
    --------
    >>> sent, command = np.array([0.0, 1.0]), np.array([5.0, 6.0])
    >>> held_commands(sent, command, np.array([-1.0, 0.5, 0.75, 1.5]))
    (array([0.  , 0.75, 1.  ]), array([5., 5., 6.]), array([False,  True,  True,  True]))
    """
    last = np.searchsorted(sent_s, read_s, side="right") - 1
    kept = last >= 0
    last, read = last[kept], read_s[kept]
    again = np.concatenate([[False], np.diff(last) == 0])
    return np.where(again, read, sent_s[last]), commands[last], kept
