"""Recording files: reading, and writing row by row.

A file starts with comment lines: `# pupper-sysid recording`, then one `# key: JSON` per line
(schema version, bus, excitation, start pose, seed, versions). Then comes one row per control tick
and joint. Rows are flushed as they are written, so an interrupted recording can be read up to its
last row. A completed one ends with `# completed: {...}`.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from pupper_sysid.common import border
from pupper_sysid.common.border import RECORDING, refuse_other_kind
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import SyncedText, versions
from pupper_sysid.common.reading.content import unpacked
from pupper_sysid.common.reading.dialect import decoded
from pupper_sysid.sysid.recordings.check import check
from pupper_sysid.sysid.recordings.importers.log import LARGEST_BYTES
from pupper_sysid.sysid.recordings.importers.options import LogOptions, as_options
from pupper_sysid.sysid.recordings.importers.recognise import read_content, read_folder
from pupper_sysid.sysid.recordings.layouts import convert
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.recordings.table import (
    OPTIONAL_COLUMNS,
    REQUIRED_COLUMNS,
    SCHEMA_VERSION,
    TITLE,
    check_metadata,
    comment,
    parse,
)

FOLDER = Path("recordings")

_ADVICE = "; what is there can be continued with `resume`"


def load(path: Path | str, options: LogOptions | Mapping[str, Any] | None = None) -> Recording:
    """Read and validate a recording in any known layout.

    Parameters
    ----------
    path : Path or str
        CSV file of this project, or a file or folder of another one's log
        (`sysid.recordings.importers`): the layout is found by content.
    options : LogOptions or dict, optional
        Columns, units and joint names of a log that does not say them, by the keys of a mapping
        file: `{"unit": "deg", "rate": 100.0}`.

    Returns
    -------
    Recording
        Validated, with its repairs in `warnings`.

    Raises
    ------
    InputError
        If it is not a recording or cannot be used; the message names the line and column.
    """
    if not isinstance(path, str | PurePath):
        kind = type(path).__name__
        raise InputError(
            f"load takes the path of one log, not a {kind}. Several: [load(p) for p in paths]; a "
            "table or arrays in memory: Recording.from_frame, Recording.from_arrays."
        )
    path, options = Path(path), as_options(options)
    refuse_other_kind(path, RECORDING)
    if path.name.endswith(".truth.csv"):
        raise InputError(
            f"{path} holds the true values of {path.name.removesuffix('.truth.csv')}.csv, "
            "not a recording; load that file instead."
        )
    if path.is_dir():
        log = read_folder(path, options)
    else:
        data = read_bytes(path)
        content = unpacked(path, data, LARGEST_BYTES)
        log = read_content(path, content, options) or replace(
            convert(path, parse(path, decoded(path, content), options), options),
            sha256=hashlib.sha256(data).hexdigest(),
        )
    check_metadata(path, log.metadata)
    table, more = check(path, log.table, log.metadata, options)
    warnings = (*log.warnings, *more)
    return Recording(table, log.metadata, plain_stem(path), path, log.sha256, warnings)


def plain_stem(path: Path) -> str:
    """Name of a log without its ending, and without that of its compression."""
    packed = path.suffix.lower() in (".gz", ".bz2", ".xz", ".zip")
    return Path(path.stem).stem if packed else path.stem


def newest_recording(folder: Path = FOLDER) -> Path:
    """The newest recording in `folder`."""
    recordings = [p for p in folder.glob("*.csv") if not p.name.endswith(".truth.csv")]
    if not recordings:
        raise InputError(
            f"No recording was named and there is none in {folder}/. "
            "Make one with `pupper-sysid sweep`, or name a file."
        )
    return max(recordings, key=lambda p: p.stat().st_mtime)


def read_bytes(path: Path) -> bytes:
    """Content of a recording file; an unreadable, empty or huge file is refused."""
    if not path.exists():
        raise InputError(f"{path} does not exist. Check the name, or run a sweep first.")
    data = border.read_bytes(path, LARGEST_BYTES)
    if not data.strip():
        raise InputError(f"{path} is empty: the recording never started. Record it again.")
    return data


class RecordingWriter:
    """Writer of a recording, row by row; appended rows survive the end of the process.

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
        header = {"schema_version": SCHEMA_VERSION, "created": _now(), "versions": versions()}
        self._file.write([TITLE, *(comment(k, v) for k, v in (header | metadata).items())])

    @classmethod
    def resumed(cls, path: Path, trial: int) -> RecordingWriter:
        """Writer that continues an unfinished recording.

        `trial`: first trial to write. Its rows that are in the file stay and are cancelled by a
        comment line; an incomplete last line is removed.
        """
        text = decoded(path, read_bytes(path))
        complete = text[: text.rfind("\n") + 1]
        lines = [line for line in complete.splitlines() if line.strip() and line[0] != "#"]
        writer = cls.__new__(cls)
        writer._columns = tuple(lines[0].split(",")) if lines else ()
        writer._file = SyncedText(path, append_at=len(complete.encode()), advice=_ADVICE)
        writer._file.write([comment("resumed", {"trial": trial, "at": _now()})])
        return writer

    def append(self, rows: Sequence[dict[str, Any]] | dict[str, Any]) -> None:
        """Write rows, each a dict of columns; the first row sets which optional columns exist."""
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
        """Close the file, with `completed` as its footer. May be called twice."""
        self._file.close([] if completed is None else [comment("completed", completed)])

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S+00:00", time.gmtime())


_DECIMALS = {"send_time_s": 6, "read_time_s": 6, "command_rad": 7, "position_rad": 7}


def _cell(column: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if value is None or not np.isfinite(value):
        return ""
    return f"{value:.{_DECIMALS[column]}f}" if column in _DECIMALS else f"{value:.7g}"
