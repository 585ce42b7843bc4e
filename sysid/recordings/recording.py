"""Recording: what was sent, what was read, and when, as one CSV file that opens in a spreadsheet.

The file starts with comment lines: `# pupper-sysid recording`, then one `# key: JSON` per line
(schema version, bus, excitation, start pose, seed, versions). Then comes one row per control tick
and joint. Rows are flushed as they are written, so a recording cut short by a power failure is a
recording up to there. A completed one ends with `# completed: {...}`.

`load` reads this form and the layouts of `sysid.recordings.layouts`, validates everything, and
refuses in one sentence what cannot be used. Time stamps are kept as they are, never resampled.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import SyncedText, versions
from pupper_sysid.common.joints import in_order

SCHEMA_VERSION = 1
TITLE = "# pupper-sysid recording"
REQUIRED_COLUMNS = (
    "send_time_s", "read_time_s", "trial", "joint", "frequency_hz", "command_rad", "position_rad",
)  # fmt: skip
OPTIONAL_COLUMNS = ("position_count", "voltage_v", "temperature_c", "load")
FOLDER = Path("recordings")

_ADVICE = "; what is there can be continued with `pupper-sysid sweep --resume`"


@dataclass(frozen=True)
class Truncation:
    """How a bus cuts commands to counts; the defaults leave them as they are.

    Attributes
    ----------
    quantum_rad : float
        Size of one count.
    rounding : {"up", "down", "nearest"}, optional
        Where making the count whole moves the angle.
    zero_rad : float, optional
        An angle that is a whole count; by default the rest position.
    """

    quantum_rad: float = 0.0
    rounding: str | None = None
    zero_rad: float | None = None


@dataclass(frozen=True)
class Trial:
    """One joint over one stretch of time; arrays are over its rows, in time order.

    Attributes
    ----------
    joint : str
    number : int
    frequency_hz : float
        Of the commanded tone; NaN if it is none.
    send_time_s, read_time_s : ndarray
        When the command was sent and the position read, on the host's clock [s].
    command_rad, position_rad : ndarray
        Absolute angles [rad]; a missing reading is NaN.
    position_count : ndarray of int, or None
        Raw counts where the bus has them, -1 where missing.
    initial_command_rad : float
        Command in force before the first row.
    direct : bool
        Whether the servo itself answered each read, so that no reading can be an old one.
    truncation : Truncation
        How the bus cut the commands.
    read_time_doubt_s : float
        By how much all readings may have been taken earlier or later than `read_time_s`.
    """

    joint: str
    number: int
    frequency_hz: float
    send_time_s: NDArray[np.float64]
    read_time_s: NDArray[np.float64]
    command_rad: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    position_count: NDArray[np.int64] | None
    initial_command_rad: float
    direct: bool = False
    truncation: Truncation = Truncation()
    read_time_doubt_s: float = 0.0


@dataclass(frozen=True)
class Recording:
    """A validated recording.

    Attributes
    ----------
    table : pandas.DataFrame
        Columns `REQUIRED_COLUMNS` and those of `OPTIONAL_COLUMNS` the bus had.
    metadata : dict
        The file's header (and footer, under `completed`).
    name : str
        Of the file, without folder and ending.
    path : Path or None
    sha256 : str
        Of the file as it was read.
    warnings : tuple of str
        What was repaired or is missing, in sentences.
    """

    table: pd.DataFrame
    metadata: dict[str, Any]
    name: str
    path: Path | None
    sha256: str
    warnings: tuple[str, ...] = ()

    @property
    def joints(self) -> list[str]:
        """Recorded joints, in the order of `common.joints.in_order`."""
        return in_order(self._trials)

    def trials(self, joint: str) -> list[Trial]:
        """Trials of `joint` in time order."""
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
        direct = bus.get("kind") == "feetech"
        quantum = bus.get("command_quantum_rad") or 0.0
        found: dict[str, list[Trial]] = {}
        for _, rows in self.table.groupby(["joint", "trial"], sort=True):
            columns = {c: rows[c].to_numpy() for c in rows.columns}
            joint, number = str(columns["joint"][0]), columns["trial"][0]
            count = columns.get("position_count")
            found.setdefault(joint, []).append(
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
                    direct,
                    Truncation(
                        float(
                            (quantum.get(joint) or 0.0) if isinstance(quantum, dict) else quantum
                        ),
                        (bus.get("command_rounding") or {}).get(joint),
                        (bus.get("count_zero_rad") or {}).get(joint),
                    ),
                    bus.get("read_time_doubt_s") or 0.0,
                )
            )
        return found


def load(path: Path) -> Recording:
    """Read and validate the recording at `path`, in any known layout.

    Raises
    ------
    InputError
        If it is no recording, or cannot be used; the sentence says where and what to do.
    """
    from pupper_sysid.sysid.recordings.layouts import convert
    from pupper_sysid.sysid.recordings.table import check, parse

    path = Path(path)
    if path.name.endswith(".truth.csv"):
        raise InputError(
            f"{path} is the truth that belongs to {path.name.removesuffix('.truth.csv')}.csv, "
            "not a recording; give that one."
        )
    data = read_bytes(path)
    parsed = parse(path, as_text(path, data))
    table, metadata, warnings = convert(path, parsed)
    table, more = check(path, table)
    digest = hashlib.sha256(data).hexdigest()
    found = [*parsed.warnings, *warnings, *more]
    return Recording(table, metadata, path.stem, path, digest, tuple(found))


def newest_recording(folder: Path = FOLDER) -> Path:
    """The newest recording in `folder`.

    Raises
    ------
    InputError
        If there is none; the sentence says how to make one.
    """
    found = [p for p in folder.glob("*.csv") if not p.name.endswith(".truth.csv")]
    if not found:
        raise InputError(
            f"No recording was named and there is none in {folder}/. "
            "Make one with `pupper-sysid sweep --freqs 1-10`, or name a file."
        )
    return max(found, key=lambda p: p.stat().st_mtime)


def read_bytes(path: Path) -> bytes:
    """What is in the file, if it can be a recording at all."""
    largest = 500e6
    try:
        if path.stat().st_size > largest:
            raise InputError(f"{path} has more than {largest / 1e6:.0f} MB; split it by joint.")
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path} does not exist. Check the name, or run a sweep first.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    if not data.strip():
        raise InputError(f"{path} is empty: the recording never started. Record it again.")
    return data


def as_text(path: Path, data: bytes) -> str:
    """The file's text, without a byte order mark."""
    try:
        if b"\0" in data:
            raise ValueError
        return data.decode("utf-8-sig")
    except ValueError:
        raise InputError(f"{path} is not a text file; a recording is CSV.") from None


class RecordingWriter:
    """Writes a recording row by row; what has been appended survives the death of the process.

    Parameters
    ----------
    path : Path
    metadata : dict
        Header entries; each value must be JSON.
    force : bool
        Replace an existing file.

    Examples
    --------
    >>> with RecordingWriter(path, {"seed": 1}) as writer:  # doctest: +SKIP
    ...     writer.append({"send_time_s": 0.0, ...})
    ...     writer.close({"rows": 1})
    """

    def __init__(self, path: Path, metadata: dict[str, Any], force: bool = False):
        self._file = SyncedText(path, force, advice=_ADVICE)
        self._columns: tuple[str, ...] = ()
        created = time.strftime("%Y-%m-%dT%H:%M:%S+00:00", time.gmtime())
        header = {"schema_version": SCHEMA_VERSION, "created": created, "versions": versions()}
        lines = [
            f"# {k}: {json.dumps(v, ensure_ascii=False)}" for k, v in (header | metadata).items()
        ]
        self._file.write([TITLE, *lines])

    @classmethod
    def resumed(cls, path: Path, trial: int) -> RecordingWriter:
        """Go on writing an unfinished recording, from its trial `trial` on.

        Rows of that trial that stand there already are kept and cancelled by a comment line; a
        torn last line, which is no row, makes room.

        Raises
        ------
        InputError
            If the file cannot be read or written.
        """
        text = as_text(path, read_bytes(path))
        whole = text[: text.rfind("\n") + 1]
        lines = [line for line in whole.splitlines() if line.strip() and line[0] != "#"]
        made = cls.__new__(cls)
        made._columns = tuple(lines[0].split(",")) if lines else ()
        made._file = SyncedText(path, append_at=len(whole.encode()), advice=_ADVICE)
        at = time.strftime("%Y-%m-%dT%H:%M:%S+00:00", time.gmtime())
        made._file.write([f"# resumed: {json.dumps({'trial': trial, 'at': at})}"])
        return made

    def append(self, rows: Sequence[dict[str, Any]] | dict[str, Any]) -> None:
        """Write rows, each a dict of columns; the first decides which optional ones there are."""
        rows = [rows] if isinstance(rows, dict) else rows
        lines = []
        if rows and not self._columns:
            optional = [c for c in OPTIONAL_COLUMNS if c in rows[0]]
            self._columns = (*REQUIRED_COLUMNS, *optional)
            lines.append(",".join(self._columns))
        self._file.write(
            [*lines, *(",".join(_cell(c, row[c]) for c in self._columns) for row in rows)]
        )

    def close(self, completed: dict[str, Any] | None = None) -> None:
        """Close the file; `completed` becomes its footer. May be called twice."""
        footer = f"# completed: {json.dumps(completed, ensure_ascii=False)}"
        self._file.close([] if completed is None else [footer])

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_DECIMALS = {"send_time_s": 6, "read_time_s": 6, "command_rad": 7, "position_rad": 7}


def _cell(column: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if value is None or not np.isfinite(value):
        return ""
    return f"{value:.{_DECIMALS[column]}f}" if column in _DECIMALS else f"{value:.7g}"
