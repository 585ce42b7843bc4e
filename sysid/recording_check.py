"""Whether the numbers of a recording can be what they say: refuse, repair, or say so.

`check` takes the tidy table of any layout. What makes every use wrong (angles in degrees, a clock
that runs backwards) is refused; what costs a few rows is repaired and said in a warning. Whether a
servo behaved is not judged here but by `sysid.doctor`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from common.errors import InputError
from common.joints import JOINT_NAMES
from sysid.recording_table import refuse_degrees, refuse_fractions, unknown_joint

_LEAST_ROWS = 20  # of a joint
_LEAST_TRIAL_ROWS = 3  # below them a trial has no rate and no shape
_SLOWEST_LOOP_S = 1.0
_LONGEST_TRIAL_S = 86_400.0


def check(path: Path, table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Refuse or repair a tidy table; returns it with a fresh index, and what was repaired.

    Parameters
    ----------
    path : Path
        For the sentences.
    table : DataFrame
        `REQUIRED_COLUMNS` and any of `OPTIONAL_COLUMNS`, indexed by line of the file.

    Raises
    ------
    InputError
        If a joint is unknown, times run backwards or in another unit, angles cannot be radians, or
        too little is left.
    """
    lines = table.index.to_numpy()
    for line, name in zip(lines, table["joint"], strict=True):
        if name not in JOINT_NAMES:
            raise InputError(f"{path}, line {line}, column joint: {unknown_joint(str(name))}")
    for column in ("trial", "position_count"):
        if column in table.columns:
            refuse_fractions(path, column, lines, table[column].to_numpy())
    for column in ("command_rad", "position_rad"):
        refuse_degrees(path, column, lines, table[column].to_numpy())
    table, warnings = _with_time_and_command(path, table)
    warnings += _missing_positions(path, table)
    again = table.duplicated(["joint", "trial", "send_time_s"]).to_numpy()
    if again.any():
        warnings.append(f"{again.sum()} rows with a repeated time stamp were left out.")
        table = table.loc[~again]
    for _, rows in table.groupby(["joint", "trial"], sort=False):
        _refuse_tones(path, rows)
        _refuse_clock(path, rows)
    table, more = _without_scraps(path, table)
    return table.reset_index(drop=True), warnings + more


def _with_time_and_command(path: Path, table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    needed = ["send_time_s", "read_time_s", "trial", "command_rad"]
    lost = np.isnan(table[needed].to_numpy(float))
    bad = lost.any(axis=1)
    if bad.all():
        worst = needed[int(lost.sum(axis=0).argmax())]
        raise InputError(
            f"{path}, column {worst}: no row has all of {', '.join(needed)}. Record it again."
        )
    if not bad.any():
        return table, []
    return table.loc[~bad], [f"{bad.sum()} rows without time, trial or command were left out."]


def _missing_positions(path: Path, table: pd.DataFrame) -> list[str]:
    missing, joint = np.isnan(table["position_rad"].to_numpy(float)), table["joint"].to_numpy()
    if missing.all():
        raise InputError(
            f"{path}, column position_rad: no row has a position, so the bus never answered. "
            "Check power and wiring, then record again."
        )
    if not missing.any():
        return []
    silent = [j for j in JOINT_NAMES if (joint == j).any() and missing[joint == j].all()]
    return [f"{100 * missing.mean():.1f} % of the positions are missing."] + [
        f"{j} has no position at all." for j in silent
    ]


def _which(rows: pd.DataFrame) -> str:
    return f"trial {rows['trial'].iloc[0]:g} of {rows['joint'].iloc[0]}"


def _refuse_tones(path: Path, rows: pd.DataFrame) -> None:
    frequency = rows["frequency_hz"].to_numpy(float)
    if (wrong := np.flatnonzero(frequency <= 0)).size:
        raise InputError(
            f"{path}, line {rows.index[wrong[0]]}, column frequency_hz: a tone's frequency is "
            "positive. Leave the cell empty where there is no tone."
        )
    if (wrong := np.flatnonzero(np.nan_to_num(frequency) != np.nan_to_num(frequency[0]))).size:
        raise InputError(
            f"{path}, line {rows.index[wrong[0]]}, column frequency_hz: it changes within "
            f"{_which(rows)}. Give each tone its own trial number."
        )


def _refuse_clock(path: Path, rows: pd.DataFrame) -> None:
    for column in ("send_time_s", "read_time_s"):
        times = rows[column].to_numpy(float)
        gaps = np.diff(times)
        back = np.flatnonzero(gaps < 0)
        if len(back):
            raise InputError(
                f"{path}, line {rows.index[back[0] + 1]}, column {column}: time runs backwards in "
                f"{_which(rows)}, after {times[back[0]]:.4f} s. Sort the rows, or give each pass "
                "its own trial number."
            )
        if len(times) >= _LEAST_TRIAL_ROWS and not gaps.any():
            raise InputError(
                f"{path}, column {column}: the clock stands still in {_which(rows)}. Write down "
                "when each row happened."
            )
        if len(gaps) and (np.median(gaps) > _SLOWEST_LOOP_S or gaps.sum() > _LONGEST_TRIAL_S):
            raise InputError(
                f"{path}, column {column}: rows of {_which(rows)} are {np.median(gaps):.4g} s "
                f"apart and span {gaps.sum():.4g} s, which looks like milliseconds or a wrong time "
                "stamp. Times must be seconds."
            )


def _without_scraps(path: Path, table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    # a sweep killed when it had just begun its next joint is good for the joints before
    said: list[str] = []
    keep = np.ones(len(table), bool)
    joint, trial = table["joint"].to_numpy(), table["trial"].to_numpy()
    for _, rows in table.groupby(["joint", "trial"], sort=False):
        if len(rows) < _LEAST_ROWS:
            out = len(rows) < _LEAST_TRIAL_ROWS
            plural = "" if len(rows) == 1 else "s"
            tail = " and was left out" if out else ""
            said.append(f"{_which(rows)} has only {len(rows)} row{plural}{tail}.")
            if out:
                keep &= (joint != rows["joint"].iloc[0]) | (trial != rows["trial"].iloc[0])
    for name in JOINT_NAMES:
        count = int((keep & (joint == name)).sum())
        if 0 < count < _LEAST_ROWS:
            said.append(f"{name} has only {count} rows and was left out.")
            keep &= joint != name
    if not keep.any():
        raise InputError(
            f"{path} has {len(table)} usable rows; a joint needs at least {_LEAST_ROWS}, in trials "
            f"of at least {_LEAST_TRIAL_ROWS}, to say anything. Record for longer."
        )
    return table.loc[keep], said
