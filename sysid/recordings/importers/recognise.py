"""Find a log's layout by its content, and read it: `read_log`."""

from __future__ import annotations

import hashlib
from pathlib import Path

from pupper_sysid.common import border
from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.importers.bam import is_bam, read_bam
from pupper_sysid.sysid.recordings.importers.log import Log, text_of
from pupper_sysid.sysid.recordings.importers.sage import is_sage, read_sage

_JSON = (b"{", b"[")


def is_log_folder(folder: Path) -> bool:
    """Whether a folder is one log, such as a dataset, rather than a folder of recordings."""
    return folder.is_dir() and is_sage(folder)


def read_folder(folder: Path) -> Log:
    """The log in a folder.

    Raises
    ------
    InputError
        If it holds none.
    """
    if is_sage(folder):
        return read_sage(folder)
    raise InputError(f"{folder} is a folder without a log of a known layout.")


def read_content(path: Path, data: bytes) -> Log | None:
    """The log in a file's content; None if it is CSV text.

    Raises
    ------
    InputError
        If the layout is unknown or its rows cannot be used.
    """
    start = data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith(_JSON):
        found = border.parse_json(text_of(path, data), str(path), "Give the log as it was written.")
        if is_bam(found):
            log = read_bam(path, found)
        else:
            raise InputError(f"{path} is JSON of no known layout.")
        return Log(log.table, log.metadata, log.warnings, hashlib.sha256(data).hexdigest())
    return None
