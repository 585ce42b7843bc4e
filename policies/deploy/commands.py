"""Velocity commands over time: constant, or from a script."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError

Commands = Callable[[float], NDArray[np.float64] | None]
"""Forward and sideways speed [m/s] and turn rate [rad/s] by time since the first tick [s]; None to
stop."""

COLUMNS = ("seconds", "forward_m_s", "left_m_s", "turn_rad_s")
_LARGEST = 2.0


def constant(command: tuple[float, float, float]) -> Commands:
    """A constant command.

    Raises
    ------
    InputError
        If it is out of range.
    """
    value = np.array(command, float)
    if not np.isfinite(value).all() or np.abs(value).max() > _LARGEST:
        raise InputError(
            f"`command` is {' '.join(map(str, command))}; each must be within ±{_LARGEST:g} "
            "(m/s, m/s, rad/s)."
        )
    return lambda elapsed_s: value


def script(path: Path) -> Commands:
    """Commands of a CSV file with `COLUMNS`, one row after another, then a stop.

    Raises
    ------
    InputError
        If the file cannot be read, or a row is no command.
    """
    try:
        table = pd.read_csv(path, comment="#")
    except (OSError, ValueError) as error:  # pandas' own errors are ValueErrors
        raise InputError(f"{path} is no readable CSV file of commands: {error}.") from error
    if tuple(table.columns) != COLUMNS or not len(table):
        raise InputError(f"{path}: it needs rows with the columns {','.join(COLUMNS)}.")
    rows = table.apply(pd.to_numeric, errors="coerce").to_numpy(float)
    bad = np.flatnonzero(
        ~np.isfinite(rows).all(axis=1) | (np.abs(rows[:, 1:]) > _LARGEST).any(axis=1)
        | ~(rows[:, 0] > 0)
    )  # fmt: skip
    if len(bad):
        raise InputError(
            f"{path}, row {bad[0] + 1}: seconds must be positive and speeds within ±{_LARGEST:g}."
        )
    ends = np.cumsum(rows[:, 0])

    def command(elapsed_s: float) -> NDArray[np.float64] | None:
        row = int(np.searchsorted(ends, elapsed_s, side="right"))
        return rows[row, 1:] if row < len(rows) else None

    return command
