"""Recording: commands sent, positions read, and their times, as a tidy table with metadata.

Time stamps are kept as they are, never resampled. `sysid.recordings.files.load` reads a recording
from a file; `Recording.from_arrays` and `Recording.from_frame` take it from memory.

The calf's servo of a parallel linkage turns the calf and the thigh. In joint coordinates
(`hardware.joint_map`) a calf's angle is relative to its thigh, but its servo holds thigh + calf,
and a servo model is one of the servo. `in_servo_coordinates` adds command and reading of the thigh,
which the bus had subtracted, so that commands and readings of a calf are its servo's, with the
thigh at its neutral. It does so where the header says `coordinates: joint` and the joint map has
the linkage; recordings of this project's commands are in servo coordinates.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import versions, write_text
from pupper_sysid.common.joints import DEFAULT_POSE, in_order
from pupper_sysid.common.reading.csv_table import distinct
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.hardware.joint_map import PRESETS, load_joint_map
from pupper_sysid.sysid.recordings.check import check
from pupper_sysid.sysid.recordings.importers.columns import has_time
from pupper_sysid.sysid.recordings.importers.log import Table
from pupper_sysid.sysid.recordings.importers.options import LogOptions, as_options
from pupper_sysid.sysid.recordings.importers.times import READ_AFTER_SEND_S, doubt_of_a_turn
from pupper_sysid.sysid.recordings.layouts import convert
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad, ServoSetup
from pupper_sysid.sysid.recordings.table import (
    OPTIONAL_COLUMNS,
    REQUIRED_COLUMNS,
    SCHEMA_VERSION,
    TEXT_COLUMNS,
    TITLE,
    check_metadata,
    comment,
    comments,
)


@dataclass(frozen=True)
class Truncation:
    """How a bus cuts commands to counts; the defaults leave them as they are."""

    quantum_rad: float = 0.0
    """Size of one count."""
    rounding: str | None = None
    """Where making the count whole moves the angle."""
    zero_rad: float | None = None
    """An angle that is a whole count; by default the rest position."""


_DRIFT_PARTS, _LEAST_OF_A_PART = 12, 10
_LEAST_DRIFT_S = 1e-3  # below it matters less than a count of most servos
_DRIFT_OVER_SCATTER = 10.0
"""Total drift over the scatter of the parts about the line: of twelve that lie about a level, or go
up once, it is below 5."""


@dataclass(frozen=True)
class Trial:
    """One joint over one stretch of time; arrays are over its rows, in time order."""

    joint: str
    number: int
    frequency_hz: float
    """Of the commanded tone; NaN if it is none."""
    send_time_s: NDArray[np.float64]
    read_time_s: NDArray[np.float64]
    """`send_time_s` and `read_time_s`: when the command was sent and the position read, on the
    host's clock [s]."""
    command_rad: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    """`command_rad` and `position_rad`: absolute angles [rad]; a missing reading is NaN."""
    position_count: NDArray[np.int64] | None
    """Raw counts where the bus has them, -1 where missing."""
    initial_command_rad: float
    """Command in force before the first row."""
    readings: Literal["live", "polled"] | None = None
    """Whether each read returned the present position or that of the bus's last poll; None where
    the recording's header does not say."""
    truncation: Truncation = Truncation()
    """How the bus cut the commands."""
    read_time_doubt_s: float = 0.0
    """By how much all readings may have been taken earlier or later than `read_time_s`."""
    clock_drift: float = 0.0
    """By how much the clock of the readings ran faster than that of the commands, a share of the
    time; `read_time_s` is by the commands' clock, whatever it is."""
    falls_behind_s: float = 0.0
    """By how much later behind their commands readings come at the recording's end than at its
    beginning, where that may be clocks that drift apart or two loops of slightly other rates."""
    p_gain: float = float("nan")
    """P gain of the servo's position loop, the register's value; NaN where it is unknown."""
    torque_enabled: NDArray[np.bool_] | None = None
    """Whether the servo's torque was on at each row; None where it always was."""
    voltage_v: NDArray[np.float64] | None = None
    """Supply voltage at each row [V]; NaN where missing."""
    servo: ServoSetup = field(default_factory=ServoSetup)
    """What the header says of the servo."""
    load: PendulumLoad | None = None
    """What the joint carried; None where the header does not say."""
    unit_stated: bool = False
    """Whether the unit of the angles was stated, so that they may be of several turns."""
    source: str = ""
    """Name of its recording, where several are pooled."""

    def powered(self) -> Trial:
        """Its longest stretch of rows with the torque on; all of it where it always was."""
        on = self.torque_enabled
        if on is None or on.all():
            return self
        edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
        first, stop = max(edges.reshape(-1, 2).tolist(), key=np.diff, default=(0, 0))
        return self.rows(first, stop)

    def rows(self, first: int, stop: int) -> Trial:
        """The trial from row `first` to the one before `stop`."""
        before = self.initial_command_rad if first == 0 else float(self.command_rad[first - 1])
        return replace(self.at(slice(first, stop)), initial_command_rad=before)

    def at(self, rows: slice | NDArray[np.int64]) -> Trial:
        """These rows of the trial."""
        columns = {
            name: value[rows]
            for name in (
                "send_time_s", "read_time_s", "command_rad", "position_rad", "position_count",
                "torque_enabled", "voltage_v",
            )
            if (value := getattr(self, name)) is not None
        }  # fmt: skip
        return replace(self, **columns)


@dataclass(frozen=True)
class Recording:
    """A validated recording.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns `table.REQUIRED_COLUMNS`, and those of `table.OPTIONAL_COLUMNS` the bus had.
    metadata : dict
        The file's header (and footer, under `completed`).
    name : str
        Of the file, without folder and ending.
    path : Path or None
        Of the file, if there is one.
    sha256 : str
        Of the file as it was read, or of the table if there was no file.
    warnings : tuple of str
        What was repaired or is missing, in sentences.

    Examples
    --------
    >>> time_s = 0.02 * np.arange(100)
    >>> command = {"LF_hip": 0.3 * np.sin(2 * np.pi * time_s)}
    >>> position = {"LF_hip": 0.3 * np.sin(2 * np.pi * (time_s - 0.05))}
    >>> recording = Recording.from_arrays(time_s, command, position, frequency_hz=1.0)
    >>> recording.joints, round(recording.loop_period_s, 6)
    (['LF_hip'], 0.02)
    """

    table: pd.DataFrame
    metadata: dict[str, Any]
    name: str
    path: Path | None
    sha256: str
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        trials = [trial for several in self._trials.values() for trial in several]
        moved_s = sum(float(np.ptp(t.send_time_s)) for t in trials)
        warned = f", {len(self.warnings)} warnings" if self.warnings else ""
        return (
            f"Recording {self.name}: {', '.join(self.joints)}; {len(trials)} trials, "
            f"{len(self.table)} rows, {moved_s:.0f} s{warned}"
        )

    @classmethod
    def from_arrays(
        cls,
        send_time_s: ArrayLike,
        command_rad: Mapping[str, ArrayLike],
        position_rad: Mapping[str, ArrayLike],
        *,
        read_time_s: ArrayLike | None = None,
        trial: ArrayLike = 0,
        frequency_hz: ArrayLike = float("nan"),
        metadata: Mapping[str, Any] | None = None,
        name: str = "arrays",
    ) -> Recording:
        """A recording from arrays over time, validated like a file.

        Parameters
        ----------
        send_time_s : array_like, shape (n,)
            When each command was sent [s], increasing within a trial.
        command_rad, position_rad : mapping of joint to array_like, shape (n,)
            Absolute angles [rad]; a missing reading is NaN.
        read_time_s : array_like, shape (n,), optional
            When the positions were read [s]; by default `READ_AFTER_SEND_S` after each command,
            in doubt by half a turn unless `metadata` has `read_after_send_s`.
        trial : int or array_like of int, shape (n,)
            Number of the trial each row belongs to. Nothing is computed across trials.
        frequency_hz : float or array_like, shape (n,)
            Of the commanded tone, one per trial; NaN where the command is not a tone.
        metadata : mapping, optional
            Header entries, such as `bus` and `start_pose_rad`.
        name : str
            For messages, tables and figures.

        Raises
        ------
        InputError
            If lengths differ, a joint is unknown, or the rows would be refused in a file.

        See Also
        --------
        from_frame : The same from a table.
        """
        for key, by_joint in (("command_rad", command_rad), ("position_rad", position_rad)):
            if not isinstance(by_joint, Mapping):
                raise InputError(
                    f"{name}: {key} is a {type(by_joint).__name__}; give a dictionary of arrays by "
                    'joint, such as {"knee": angles}.'
                )
        distinct(name, map(str, command_rad), "joints")
        if set(command_rad) != set(position_rad) or not command_rad:
            commanded, read = (
                ", ".join(map(str, arrays)) for arrays in (command_rad, position_rad)
            )
            raise InputError(
                f"{name}: command_rad has joints {commanded}, position_rad has {read}; they must "
                "be the same, at least one."
            )
        time_s = _numbers(name, "send_time_s", send_time_s)
        shared: dict[str, Any] = {"trial": trial, "frequency_hz": frequency_hz}
        shared |= {} if read_time_s is None else {"read_time_s": read_time_s}
        parts = []
        for joint, command in command_rad.items():
            place = f"{name}, {printable(str(joint))[:60]}"
            arrays = shared | {"command_rad": command, "position_rad": position_rad[joint]}
            columns: dict[str, Any] = {"send_time_s": time_s, "joint": str(joint)}
            for key, values in arrays.items():
                columns[key] = _numbers(place, key, values)
                free = key in ("trial", "frequency_hz") and columns[key].ndim == 0
                if not free and columns[key].shape != time_s.shape:
                    raise InputError(
                        f"{place}: {key} has shape {columns[key].shape}, send_time_s "
                        f"{time_s.shape}; they must have the same number of values."
                    )
            parts.append(pd.DataFrame(columns, index=range(len(time_s))))
        return cls.from_frame(pd.concat(parts, ignore_index=True), metadata=metadata, name=name)

    @classmethod
    def from_frame(
        cls,
        table: pd.DataFrame,
        *,
        metadata: Mapping[str, Any] | None = None,
        name: str = "frame",
        options: LogOptions | Mapping[str, Any] | None = None,
    ) -> Recording:
        """A recording from a table, validated like a file.

        `table`: columns of a recording file or of another layout that `load` reads; an index that
        is no count of the rows, such as one of times, is a column, too. Of the former,
        `read_time_s`, `trial` and `frequency_hz` may be absent: reads then follow
        `READ_AFTER_SEND_S` after the command, in doubt by half a turn (unless `metadata` has
        `read_after_send_s`), all rows are one trial, and no tone is assumed. `metadata`: header
        entries, such as `bus` and `start_pose_rad`. `name`: for messages, tables and figures.
        `options`: columns, units and joint names of a table of other columns. Raises InputError if
        a column is missing or is not numeric, times run backwards, angles cannot be radians, or too
        few rows are left.
        """
        if not isinstance(table, pd.DataFrame):
            raise InputError(
                f"{name}: the table is a {type(table).__name__}. Make it a pandas.DataFrame, or "
                "use Recording.from_arrays."
            )
        if metadata is not None and not isinstance(metadata, Mapping):
            raise InputError(f"{name}: metadata is a {type(metadata).__name__}, not a dictionary.")
        stated: dict[str, Any] = {"imported_from": "a table in memory"} | dict(metadata or {})
        check_metadata(name, stated)
        table = _flat(table)
        distinct(name, map(str, table.columns))
        columns = {str(column): table[column] for column in table}
        timed = "read_time_s" in columns
        after = stated.get("read_after_send_s")
        if "send_time_s" in columns:
            rest = {"trial": 0, "frequency_hz": np.nan}
            columns = {c: pd.Series(v, table.index) for c, v in rest.items()} | columns
        faults, texts, numbers = {}, {}, {}
        strict = "send_time_s" in columns or "motor_idx" in columns
        for column, cells in columns.items():
            try:
                if column in TEXT_COLUMNS and not pd.api.types.is_numeric_dtype(cells):
                    raise ValueError
                if np.iscomplexobj(cells.to_numpy()):  # whose imaginary part would be lost
                    raise TypeError
                values = cells.astype(float).to_numpy(float)
            except (TypeError, ValueError):
                if column not in TEXT_COLUMNS:
                    faults[column] = f"{name}, column {column}: its values are not numbers."
                    if strict:
                        raise InputError(faults[column]) from None
                texts[column] = [str(v) for v in cells.to_numpy(object)]
                continue
            if column in ("send_time_s", "read_time_s") and np.isnan(values).any():
                row = int(np.flatnonzero(np.isnan(values))[0])
                raise InputError(
                    f"{name}, column {column}: row {row} has no time (NaN). Leave rows without a "
                    "time out."
                )
            numbers[column] = values
        if "send_time_s" in numbers and not timed:
            apart = READ_AFTER_SEND_S if after is None else after
            numbers["read_time_s"] = numbers["send_time_s"] + apart
        log = convert(name, Table(numbers, texts, faults, metadata=stated), as_options(options))
        tidy, known, warnings = log.table, log.metadata, log.warnings
        if "send_time_s" in columns and not timed and after is None:
            stated["read_after_send_s"] = READ_AFTER_SEND_S
            first = tidy["joint"] == tidy["joint"].iloc[0] if len(tidy) else slice(0)
            doubt, text = doubt_of_a_turn(tidy.loc[first, "send_time_s"].to_numpy(float))
            stated["bus"] = {"read_time_doubt_s": doubt} | dict(stated.get("bus") or {})
            warnings = [
                *warnings,
                text.split(" If you know")[0]
                + " If you know, pass `read_time_s`, or `read_after_send_s` in `metadata`.",
            ]
            known = known | stated
        others = tidy.columns.difference(REQUIRED_COLUMNS, sort=False)
        tidy = tidy.reindex(columns=[*REQUIRED_COLUMNS, *others])
        tidy, more = check(name, tidy, stated | known)
        digest = hashlib.sha256(tidy.to_csv(index=False).encode()).hexdigest()
        return cls(tidy, stated | known, name, None, digest, (*warnings, *more))

    def to_frame(self) -> pd.DataFrame:
        """A copy of `table`."""
        return self.table.copy()

    def to_csv(self) -> str:
        """The recording as text of a recording file."""
        columns = [c for c in (*REQUIRED_COLUMNS, *OPTIONAL_COLUMNS) if c in self.table]
        header = {"schema_version": SCHEMA_VERSION, "versions": versions()} | self.metadata
        completed = header.pop("completed", None)
        if completed is None and "imported_from" in header:
            # other layouts have no footer; without one the file would pass for a cut recording
            completed = {"rows": len(self.table)}
        header["exported_from"] = {"name": self.name, "sha256": self.sha256}
        if self.warnings:
            header["warnings_when_exported"] = list(self.warnings)
        text = comments(TITLE.removeprefix("# "), header)
        table = self.table.astype({"trial": int})
        text += table.to_csv(columns=columns, index=False, lineterminator="\n")
        return text + (f"{comment('completed', completed)}\n" if completed is not None else "")

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write a recording file, which `load` reads back.

        `force`: replace an existing file. Raises InputError if the file exists and `force` is not
        given, or if it cannot be written.
        """
        write_text(Path(path), self.to_csv(), force)

    @property
    def joints(self) -> list[str]:
        """Recorded joints, in the order of `common.joints.in_order`."""
        return in_order(self._trials)

    def trials(self, joint: str) -> list[Trial]:
        """Trials of `joint` in time order; a calf on a linkage in servo coordinates."""
        return list(self._trials.get(joint, []))

    @property
    def loop_period_s(self) -> float:
        """Median time between commands within trials [s]."""
        gaps = [np.diff(t.send_time_s) for trials in self._trials.values() for t in trials]
        return float(np.median(np.concatenate(gaps)))

    @cached_property
    def _trials(self) -> dict[str, list[Trial]]:
        rest = self.metadata.get("start_pose_rad") or {}
        bus = self.metadata.get("bus") or {}
        servos = {j: ServoSetup(**s) for j, s in (self.metadata.get("servos") or {}).items()}
        loads = {j: PendulumLoad(**s) for j, s in (self.metadata.get("loads") or {}).items()}
        quantum = bus.get("command_quantum_rad") or 0.0
        trials: dict[str, list[Trial]] = {}
        for _, rows in self.table.groupby(["joint", "trial"], sort=True):
            columns = {c: rows[c].to_numpy() for c in rows.columns}
            joint, number = str(columns["joint"][0]), columns["trial"][0]
            count = columns.get("position_count")
            servo = servos.get(joint, ServoSetup())
            gain = columns.get("p_gain", [np.nan])[0]
            torque = columns.get("torque_enabled")
            trials.setdefault(joint, []).append(
                Trial(
                    joint,
                    int(number),
                    float(columns["frequency_hz"][0]),
                    columns["send_time_s"],
                    columns["read_time_s"],
                    columns["command_rad"],
                    columns["position_rad"],
                    None if count is None else np.nan_to_num(count, nan=-1).astype(np.int64),
                    float(rest.get(joint, columns["command_rad"][0])),
                    self.metadata.get("readings"),
                    Truncation(
                        float(
                            (quantum.get(joint) or 0.0) if isinstance(quantum, dict) else quantum
                        ),
                        (bus.get("command_rounding") or {}).get(joint),
                        (bus.get("count_zero_rad") or {}).get(joint),
                    ),
                    bus.get("read_time_doubt_s") or 0.0,
                    0.0,
                    0.0,
                    float(gain if np.isfinite(gain) or servo.p_gain is None else servo.p_gain),
                    None if torque is None else torque != 0,
                    columns.get("voltage_v"),
                    servo,
                    loads.get(joint),
                    self.metadata.get("angle_unit") == "stated",
                )
            )
        return in_servo_coordinates(on_one_clock(trials), bus)


def on_one_clock(trials: Mapping[str, list[Trial]]) -> dict[str, list[Trial]]:
    """Trials by joint, their readings dated by the commands' clock where two clocks drift apart.

    The time from a command to its reading is that of a transaction, which does not grow steadily:
    a line through its medians over parts of the recording is a drift where they lie on it. The
    clocks agree at the end of the recording at which readings follow commands within a turn of
    the loop, to about a turn. Where they do so at both ends, commands and readings may as well be
    of two loops at slightly different rates: nothing is changed, but the growth is in doubt.
    """
    every = [t for of_joint in trials.values() for t in of_joint]
    time = np.concatenate([np.empty(0), *(t.send_time_s for t in every)])
    apart = np.concatenate([np.empty(0), *(t.read_time_s - t.send_time_s for t in every)])
    known = np.isfinite(time) & np.isfinite(apart)
    time, apart = time[known], apart[known]
    if len(time) < _DRIFT_PARTS * _LEAST_OF_A_PART:
        return dict(trials)
    order = np.argsort(time, kind="stable")
    parts = [
        np.median(x, axis=1)
        for x in np.array_split(np.stack([time, apart])[:, order], _DRIFT_PARTS, axis=1)
    ]
    middle, median = np.transpose(parts)
    span = float(middle[-1] - middle[0])
    if not span > 0:
        return dict(trials)
    slope, level = np.polyfit(middle - middle[0], median, 1)
    scatter = float(np.std(median - level - slope * (middle - middle[0]), ddof=2))
    total = float(slope * span)
    if not _LEAST_DRIFT_S < abs(total) or not _DRIFT_OVER_SCATTER * scatter < abs(total):
        return dict(trials)
    turn = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in every])))
    ends = {float(time.min()): level, float(time.max()): level + total}
    agreed = [when for when, after in ends.items() if -turn / 2 <= after <= turn]
    doubt = abs(total) if len(agreed) == 2 else turn if agreed else turn + abs(total) / 2
    reference = float(np.mean(agreed or list(ends)))

    def redated(trial: Trial) -> Trial:
        doubtful = replace(trial, read_time_doubt_s=trial.read_time_doubt_s + doubt)
        if len(agreed) == 2:
            return replace(doubtful, falls_behind_s=total)
        late = slope * (trial.send_time_s - reference)
        return replace(doubtful, read_time_s=trial.read_time_s - late, clock_drift=float(slope))

    return {joint: [redated(t) for t in of_joint] for joint, of_joint in trials.items()}


def _flat(table: pd.DataFrame) -> pd.DataFrame:
    """The table with names of one level; an index that does not count the rows is a column.

    A column of lists, such as actions, becomes one per joint.
    """
    index = table.index
    if isinstance(table.columns, pd.MultiIndex):
        levels = (".".join(map(str, filter(None, names))) for names in table.columns)
        table = table.set_axis([*levels], axis=1)
    for name in table.columns[[kind.kind == "O" for kind in table.dtypes]]:
        cells = table[name].tolist() if table.columns.tolist().count(name) == 1 else []
        if {*map(type, cells)} <= {list, tuple, np.ndarray} and len({*map(len, cells)}) == 1:
            each = [f"{name}.joint_{k}" for k in range(len(cells[0]))]
            parts = pd.DataFrame(np.array(cells), index, each)
            table = pd.concat([table.drop(columns=name), parts], axis=1)
    counts = index.nlevels == 1 and pd.api.types.is_integer_dtype(index) and index.name is None
    timed = not isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex) and index.nlevels == 1
    if counts or index.name in table or (timed and has_time([*map(str, table.columns)])):
        return table
    return table.reset_index(names=None if index.nlevels > 1 or index.name else "time")


def _numbers(place: str, key: str, values: Any) -> NDArray[np.float64]:
    """The values as numbers, times of NumPy or pandas as seconds; refused where they are none."""
    detached = values.detach().cpu().double() if hasattr(values, "detach") else values
    try:
        array = np.ma.asarray(detached)
        if array.dtype.kind in "mM":
            return array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64) / 1e9
        if array.dtype.kind == "c":
            raise TypeError
        return np.ma.filled(array.astype(float), np.nan)
    except (TypeError, ValueError):
        kind = type(values).__name__
        raise InputError(
            f"{place}, column {key}: its values are not numbers but a {kind} of others. Give an "
            "array with a number per row."
        ) from None


def in_servo_coordinates(
    trials: Mapping[str, list[Trial]], bus: Mapping[str, Any]
) -> dict[str, list[Trial]]:
    """Trials by joint, each calf on a linkage as its servo moves it.

    `bus`: entry of the recording's header: `coordinates`, and `linkage` or the name of a joint map.
    Returns a calf that was recorded without its thigh stays as it is: a thigh that does not move
    changes its offset only. Rows without one of the thigh at the same time are left out.
    """
    if bus.get("coordinates") != "joint":
        return dict(trials)
    preset = load_joint_map(bus["joint_map"]).file if bus.get("joint_map") in PRESETS else None
    linkage = bus.get("linkage", preset.linkage if preset else "none")
    if linkage == "none":
        return dict(trials)
    turned = dict(trials)
    for joint, joint_trials in trials.items():
        thigh = joint.replace("calf", "thigh")
        if joint.endswith("_calf") and thigh in trials:
            known = preset.joints[thigh].neutral_rad if preset else DEFAULT_POSE.get(thigh, 0.0)
            partners = {trial.number: trial for trial in trials[thigh]}
            turned[joint] = [
                _joined(t, partners[t.number], known) if t.number in partners else t
                for t in joint_trials
            ]
    return turned


def _joined(calf: Trial, thigh: Trial, neutral: float) -> Trial:
    """The calf's trial in servo coordinates."""
    _, of_calf, of_thigh = np.intersect1d(calf.send_time_s, thigh.send_time_s, return_indices=True)
    rows, beside = calf.at(of_calf), thigh.at(of_thigh)
    return replace(
        rows,
        command_rad=rows.command_rad + beside.command_rad - neutral,
        position_rad=rows.position_rad + beside.position_rad - neutral,
        initial_command_rad=calf.initial_command_rad + thigh.initial_command_rad - neutral,
    )
