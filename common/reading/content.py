"""Content of regular files, within a limit; pipes, devices and folders are refused.

A name may stand for anything: a pipe nobody writes to blocks its reader for ever, a device never
ends, a file under /proc has no size. The file is therefore opened without waiting, and looked at
before and while it is read.
"""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.budget import refuse_more

_PIECE = 1 << 20


def open_regular(path: Path | str, remedy: str = "") -> BufferedReader:
    """Open a regular file for reading.

    Parameters
    ----------
    path : Path or str
    remedy : str
        What to do, as a sentence; by default, to check the file's name.

    Raises
    ------
    InputError
        If there is none, or it cannot be opened.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # opening a device may already do something
            raise InputError(f"{path} is not a file. {remedy or 'Give the name of a file.'}")
        descriptor = os.open(path, os.O_RDONLY | _flag("O_NONBLOCK") | _flag("O_CLOEXEC")
                             | _flag("O_BINARY"))  # fmt: skip
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):  # it was exchanged in between
            os.close(descriptor)
            raise InputError(f"{path} is not a file. {remedy or 'Give the name of a file.'}")
        return os.fdopen(descriptor, "rb")
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist. {remedy or 'Check the name.'}") from error
    except (OSError, ValueError) as error:  # a name with a null character is a ValueError
        raise _unreadable(path, error, remedy) from error


def content(path: Path | str, most_bytes: float, remedy: str = "") -> bytes:
    """Content of a regular file of limited size.

    Parameters
    ----------
    path : Path or str
    most_bytes : float
        Larger files are refused without being read; `budget.reading_up_to` raises it.
    remedy : str
        What to do, as a sentence.

    Raises
    ------
    InputError
        If the file is missing, no regular file, larger, or cannot be read.
    """
    try:
        with open_regular(path, remedy) as file:
            size = os.fstat(file.fileno()).st_size
            refuse_more(path, size, most_bytes, "bytes", remedy)
            pieces, total = [], 0
            while piece := file.read(max(size - total + 1, _PIECE)):
                pieces.append(piece)
                total += len(piece)  # one that grows, or has no size
                refuse_more(path, total, most_bytes, "bytes", remedy, exact=False)
            if piece is None:
                raise InputError(f"{path} cannot be read: nothing comes. {remedy}".rstrip())
            return pieces[0] if len(pieces) == 1 else b"".join(pieces)
    except OSError as error:
        raise _unreadable(path, error, remedy) from error


def _unreadable(path: Path | str, error: Exception, remedy: str) -> InputError:
    said = getattr(error, "strerror", None) or error
    return InputError(f"{path} cannot be read: {said}. {remedy}".rstrip())


def _flag(name: str) -> int:
    """A flag of `os.open`, where the system has it."""
    return getattr(os, name, 0)
