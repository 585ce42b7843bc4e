"""Velocity commands over time: constant, or from a script, within what a policy was trained for.

Beyond that a policy does not walk faster: at twice the training's speed the shipped ones stop or
walk backwards.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.csv_table import column_names, read_table
from pupper_sysid.policies.network.policy_file import CommandRanges

Commands = Callable[[float], NDArray[np.float64] | None]
"""Forward and sideways speed [m/s] and turn rate [rad/s] by time since the first tick [s]; None to
stop."""

COLUMNS = ("seconds", "forward_m_s", "left_m_s", "turn_rad_s")
_LARGEST = 5.0


def constant(
    command: tuple[float, float, float],
    trained: CommandRanges | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Commands:
    """A constant command.

    It is clipped to the ranges of the training, where they are known; `say` is then called with a
    sentence.
    """
    value = checked_command(command)
    if trained is not None:
        value = trained.clipped(value[None], say)[0]
    return lambda elapsed_s: value


def checked_command(command: tuple[float, float, float]) -> NDArray[np.float64]:
    """The command as an array, shape (3,)."""
    value = np.array(command, float)
    if not np.isfinite(value).all() or np.abs(value).max() > _LARGEST:
        raise InputError(
            f"`command` is {' '.join(map(str, command))}; each must be within ±{_LARGEST:g} "
            "(m/s, m/s, rad/s)."
        )
    return value


def script(
    path: Path, trained: CommandRanges | None = None, say: Callable[[str], None] = lambda text: None
) -> Commands:
    """Commands of a CSV file with `COLUMNS`, one row after another, then a stop.

    `trained` and `say` as for `constant`.
    """
    text = read_text(path)
    if tuple(column_names(path, text)) != COLUMNS:
        raise InputError(f"{path}: it needs rows with the columns {','.join(COLUMNS)}.")
    table = read_table(path, text)
    if table.cut or not len(table):
        raise InputError(f"{path} has no rows, or its last one is cut short.")
    rows = np.stack([table.numbers[name] for name in COLUMNS], axis=-1)
    bad = np.flatnonzero(
        ~np.isfinite(rows).all(axis=1) | (np.abs(rows[:, 1:]) > _LARGEST).any(axis=1)
        | ~(rows[:, 0] > 0)
    )  # fmt: skip
    if len(bad):
        raise InputError(
            f"{path}, line {table.line[bad[0]]}: seconds must be positive and speeds within "
            f"±{_LARGEST:g}."
        )
    if trained is not None:
        rows[:, 1:] = trained.clipped(rows[:, 1:], say)
    ends = np.cumsum(rows[:, 0])

    def command(elapsed_s: float) -> NDArray[np.float64] | None:
        row = int(np.searchsorted(ends, elapsed_s, side="right"))
        return rows[row, 1:] if row < len(rows) else None

    return command
