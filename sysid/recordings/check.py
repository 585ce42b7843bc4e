"""Validation of tidy rows: what is no servo's recording is refused, small faults are mended."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import strange_joint
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import column as column_named
from pupper_sysid.sysid.recordings.importers.log import MOST_TRIALS
from pupper_sysid.sysid.recordings.importers.options import (
    LARGEST_RAD,
    LogOptions,
    likely_of_pair,
    unit,
)
from pupper_sysid.sysid.recordings.importers.refusals import PULSES_US, import_line
from pupper_sysid.sysid.recordings.table import LARGEST_COUNT

_LEAST_ROWS = 20
_FARTHEST_RAD = 200 * np.pi  # of angles whose unit was stated
_IDENTITY = ["joint", "trial", "send_time_s", "read_time_s", "command_rad", "position_rad"]
_MANY_REPEATED = 0.1  # of the rows
_SHORTEST_TRIAL = 3  # rows; a rate of the command takes as many
_LATEST_S = 1e11
_FASTEST_HZ = 20_000.0  # loop of a servo
_SMALL_RAD = 0.1
_MANY_ROWS = 5  # that lie apart from the others
_FEW_TRIALS = 10  # that are named one by one


def check(
    path: Path | str,
    table: pd.DataFrame,
    metadata: Mapping[str, Any],
    options: LogOptions | None = None,
) -> tuple[pd.DataFrame, list[str]]:
    """Refuse or repair a tidy table.

    `path`: name of the source, for messages. `metadata`: header entries: angles whose unit was
    stated may be of several turns. `options`: what was stated of the log. Returns the table and one
    sentence per repair. Raises InputError if a joint is unknown, times run backwards, angles cannot
    be radians, or too little is left.
    """
    warnings: list[str] = []
    options = options or LogOptions()
    if strange := strange_joint(table["joint"].unique().tolist(), "columns" in metadata):
        called = printable(strange[0])[:60]
        raise InputError(f"{path}, column joint: '{called}' is no joint; {strange[1]}")
    needed = ["send_time_s", "read_time_s", "trial", "command_rad"]
    lost = np.isnan(table[needed].to_numpy(float)).any(axis=1)
    if lost.any():
        warnings.append(f"{int(lost.sum())} rows without time, trial or command were left out.")
        table = table.loc[~lost]
    _refuse_odd_numbers(path, table)
    if not len(table):
        raise InputError(f"{path} has no rows with a time and a command. Record it again.")
    position = table["position_rad"].to_numpy(float)
    missing = float(np.mean(np.isnan(position)))
    if missing == 1.0:
        raise InputError(
            f"{path}, column position_rad: no row has a position, so the bus never answered. "
            "Check power and wiring, then record again."
        )
    if missing > 0:
        warnings.append(f"{100 * missing:.1f} % of the positions are missing.")
    for column in ("command_rad", "position_rad"):
        _refuse_degrees(path, column, table, metadata, options)
    first = table.loc[table["joint"] == table["joint"].iloc[0], "send_time_s"]
    same = table.duplicated(_IDENTITY).to_numpy()
    if same.any():
        warnings.append(
            f"{int(same.sum())} rows ({100 * same.mean():.0f} %) repeat another one, time stamp "
            "included; each was counted once."
        )
        table = table.loc[~same]
    again = table.duplicated(["joint", "trial", "send_time_s"])
    if again.mean() > _MANY_REPEATED:
        ticks = np.unique(first)
        rate = len(first) / max(float(np.ptp(ticks) + np.diff(ticks).min(initial=1.0)), 1e-9)
        words = {"rate": f"{rate:.3g}"} | {k: v for k, v in options.words.items() if k != "time"}
        line = import_line(path, **words) if rate < _FASTEST_HZ and isinstance(path, Path) else ""
        raise InputError(
            f"{path}, column send_time_s: {100 * again.mean():.0f} % of the rows repeat a time "
            "stamp of their trial: a clock too coarse, or two logs in one. Record with a clock of "
            "1 ms or finer, and give each pass its own trial number"
            + (f"; or take the rows as evenly spaced: {line}." if line else ".")
        )
    if again.any():
        warnings.append(f"{int(again.sum())} rows with a repeated time stamp were left out.")
        table = table.loc[~again]
    trial_of = table.groupby(["joint", "trial"], sort=False).ngroup().to_numpy()
    rows = np.bincount(trial_of)
    refuse_more(path, len(rows), MOST_TRIALS, "trials", "Split it by joint or by trial.")
    first = table.iloc[np.unique(trial_of, return_index=True)[1]]  # a row of each trial
    _refuse_disorder(path, table, trial_of)
    warnings += _short(first, rows)
    usable = rows[trial_of] >= _SHORTEST_TRIAL
    if usable.sum() < _LEAST_ROWS:
        raise InputError(
            f"{path} has {len(table)} usable rows; at least {_LEAST_ROWS} are needed. "
            "Record for longer."
        )
    return table.loc[usable].reset_index(drop=True), warnings


def _refuse_odd_numbers(path: Path | str, table: pd.DataFrame) -> None:
    """Refuse times, trials and counts that are none."""
    for column in ("send_time_s", "read_time_s"):
        latest = np.abs(table[column].to_numpy(float)).max(initial=0.0)
        if latest > _LATEST_S:
            raise InputError(
                f"{path}, column {column}: times reach {latest:.4g} s, three thousand years. "
                "Write them in seconds."
            )
    trial = table["trial"].to_numpy(float)
    if (np.abs(trial) >= LARGEST_COUNT).any() or (trial % 1 != 0).any():
        raise InputError(f"{path}, column trial: trials are counted by whole numbers.")
    count = table["position_count"].to_numpy(float) if "position_count" in table else np.zeros(0)
    if np.any(np.abs(count) >= LARGEST_COUNT):
        raise InputError(f"{path}, column position_count: a value is larger than any encoder's.")


def _refuse_degrees(
    path: Path | str,
    column: str,
    table: pd.DataFrame,
    metadata: Mapping[str, Any],
    options: LogOptions,
) -> None:
    """Refuse angles beyond a turn, or beyond a hundred where their unit was stated."""
    values = np.nan_to_num(np.abs(table[column].to_numpy(float)))
    farthest = int(np.argmax(values))
    largest = float(values[farthest])
    stated = "angle_unit" in metadata
    if largest <= (_FARTHEST_RAD if stated else LARGEST_RAD):
        return
    known = table[column].to_numpy(float)
    known = known[np.isfinite(known)]
    if column == "position_rad" and _in_two_places(known):
        return
    joint = str(table["joint"].iloc[farthest])
    names = metadata.get("columns") or {}
    kind = "position" if column == "position_rad" else "command"
    of_joint = names.get(joint) if isinstance(names, dict) else None
    of_joint = of_joint if isinstance(of_joint, Mapping) else {}
    source = of_joint.get(kind)
    place = f"{printable(str(source))[:60]} (the {kind} of {joint})" if source else column
    by_name = [column_named(str(of_joint.get(k, ""))).unit for k in ("command", "position")]
    pulses = kind == "command" and PULSES_US[0] < np.nanmin(known) <= largest < PULSES_US[1]
    if pulses and (stated or any(by_name)):
        raise InputError(
            f"{path}, column {place}: values of {np.nanmin(known):.4g} to {largest:.4g} beside "
            "angles look like pulse widths in µs. Write them as angles, about (µs - 1500) * "
            "0.0016 rad, and give that column."
        )
    for turn in (2**16, 2**32):
        apart = (known < turn / 4) | (known > 0.75 * turn)
        if 0.75 * turn < largest < turn and apart.all() and not (known % 1).any():
            raise InputError(
                f"{path}, column {place}: values are near 0 and near {turn:,}, which looks like "
                f"negative numbers read without their sign. Take {turn:,} off those above "
                f"{turn // 2 - 1:,} in the log, and say what the rest counts."
            )
    if stated:
        raise InputError(
            f"{path}, column {place}: values reach {largest:.4g} rad, more than a hundred turns. "
            "Say the unit (such as deg, turns or counts:8192:0), or take the start's angle off."
        )
    of_row = table["joint"].to_numpy()
    others = [j for j in map(str, table["joint"].unique())
              if _SMALL_RAD < values[of_row == j].max() <= LARGEST_RAD]  # fmt: skip
    angles = table.loc[table["joint"] == joint, ["command_rad", "position_rad"]].to_numpy(float)
    units = likely_of_pair(*(values[np.isfinite(values)] for values in angles.T))
    if units == ["deg"] and str(source).endswith(".pos") and largest <= 100:
        units.append("percent:3.5")  # LeRobot's, of a range that it does not log
    units = list(dict.fromkeys(_with_named(text, by_name) for text in units))
    word, _, of_position = units[0].partition(",")
    beside = ""
    if of_position:
        word, other = (word, of_position) if kind == "command" else (of_position, word)
        beside = f" beside {_words(other)}"
    factor = unit(word)
    text = (
        f"{path}, column {place}: values reach {largest:.4g}, more than a turn, which looks like "
        f"{_words(word)}{beside}. Angles must be radians: "
        f"{f'take {factor.zero:g} off and ' if factor.zero else ''}"
        f"multiply {_words(word).partition(' ')[0]} by {factor.scale:.6g}"
    )
    if not isinstance(path, Path):  # arrays in memory
        raise InputError(f"{text}.")
    lines = "; or ".join(import_line(path, **(options.words | {"unit": u})) for u in units)
    raise InputError(
        f"{text}, or convert the log with {lines} (or turns, counts:4096, scale:…; rad if the "
        "joint turns so far)."
        + (
            f" If {', '.join(others)[:200]} are in radians as they are, give `units: {{{joint}: "
            f"'{units[0]}'}}` in a mapping file instead."
            if others
            else ""
        )
    )


def _with_named(units: str, by_name: list[str]) -> str:
    """The units of an option, with those that the names of columns say in their place."""
    command, _, position = units.partition(",")
    texts = (command, position or command)
    pair = [text if named in ("", "rad") else named
            for named, text in zip(by_name, texts, strict=True)]  # fmt: skip
    return ",".join(dict.fromkeys(pair)) if any(by_name) else units


def _words(unit: str) -> str:
    name, _, turn = unit.partition(":")
    if name != "counts":
        words = {"deg": "degrees", "rad": "radians", "scale": "values in parts of a degree"}
        return words.get(name, name)
    counts, _, zero = turn.partition(":")
    return f"counts of an encoder with {counts} a turn" + (", 0 rad at count 0" if zero else "")


def _in_two_places(values: NDArray[np.float64]) -> bool:
    """Whether angles lie in two places that each could be a joint's: a number that overflows.

    `doctor` says which number, and how to read it.
    """
    ordered = np.sort(values)
    at = int(np.argmax(np.diff(ordered))) + 1 if len(ordered) > 1 else 0
    parts = ordered[:at], ordered[at:]
    return (
        min(map(len, parts)) >= _MANY_ROWS and max(float(np.ptp(p)) for p in parts) < LARGEST_RAD
        and min(float(np.abs(p).max()) for p in parts) < LARGEST_RAD
    )  # fmt: skip


def _refuse_disorder(path: Path | str, table: pd.DataFrame, trial_of: NDArray[np.int64]) -> None:
    """Refuse trials whose time runs backwards, or that have several frequencies."""
    order = np.argsort(trial_of, kind="stable")
    same = np.diff(trial_of[order]) == 0
    for column in ("send_time_s", "read_time_s"):
        time = table[column].to_numpy(float)[order]
        back = np.flatnonzero((np.diff(time) < 0) & same)
        if len(back):
            joint, trial = table[["joint", "trial"]].iloc[order[back[0]]]
            raise InputError(
                f"{path}, column {column}: time runs backwards in trial {trial:g} of {joint}, "
                f"after {time[back[0]]:.4f} s. Sort the rows, or give each pass its own trial "
                "number."
            )
    tones = table["frequency_hz"].groupby(trial_of).nunique().to_numpy()
    if (tones > 1).any():
        rows = table.loc[trial_of == np.argmax(tones > 1)]
        joint, trial = rows[["joint", "trial"]].iloc[0]
        frequencies = rows["frequency_hz"].dropna().unique()
        raise InputError(
            f"{path}, column frequency_hz: trial {trial:g} of {joint} has {frequencies[0]:g} and "
            f"{frequencies[1]:g} Hz. Give each frequency its own trial number."
        )


def _short(first: pd.DataFrame, rows: NDArray[np.int64]) -> list[str]:
    """Sentences on trials with few rows; `first` has a row of each trial, `rows` their numbers."""
    notes: list[str] = []
    useless = rows < _SHORTEST_TRIAL
    for few, each, every in (
        (useless, "is too short to use and was left out", "are too short to use and were left out"),
        (
            ~useless & (rows < _LEAST_ROWS),
            "has only {} rows",
            f"have fewer than {_LEAST_ROWS} rows",
        ),
    ):
        trials = zip(first.loc[few, "joint"], first.loc[few, "trial"], rows[few], strict=True)
        single = [f"trial {trial:g} of {joint} {each.format(n)}." for joint, trial, n in trials]
        notes += single if len(single) <= _FEW_TRIALS else [f"{len(single)} trials {every}."]
    return notes
