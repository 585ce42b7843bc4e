"""Content of regular files, within a limit; pipes, devices and folders are refused.

A name may stand for anything: a pipe nobody writes to blocks its reader for ever, a device never
ends, a file under /proc has no size. The file is therefore opened without waiting, and looked at
before and while it is read. `unpacked` undoes a compression, within the same limit.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import os
import stat
import zipfile
import zlib
from collections.abc import Iterable, Iterator
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


_XZ_MEMORY = 256 << 20  # of `xz -9`: 65 MB
_ZIP = b"PK\x03\x04"
_PACKED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\0": "xz"}
_FOREIGN = {b"\x28\xb5\x2f\xfd": "zstd", b"7z\xbc\xaf\x27\x1c": "7-Zip", b"Rar!": "RAR",
            b"\x04\x22\x4d\x18": "LZ4"}  # fmt: skip


def unpacked(path: Path | str, data: bytes, most_bytes: float) -> bytes:
    """Content of a file that is compressed by gzip, bzip2 or xz, or the one file in a zip archive.

    Other content comes back as it is, also archives of arrays (`.npz`, `.pt`).

    Parameters
    ----------
    path : Path or str
        For messages.
    data : bytes
        Content of the file: its first bytes tell the compression, not its name.
    most_bytes : float
        Content that is larger is refused; `budget.reading_up_to` raises it.

    Raises
    ------
    InputError
        If it is damaged, larger, packed twice, an archive of several files, or of a kind that is
        not read.
    """
    kind = next((k for mark, k in _PACKED.items() if data.startswith(mark)), None)
    foreign = next((k for mark, k in _FOREIGN.items() if data.startswith(mark)), None)
    if foreign is not None:
        raise InputError(f"{path} is packed by {foreign}, which is not read. Unpack it first.")
    try:
        if kind is not None:
            whole = _bounded(path, _pieces(kind, data), most_bytes)
        elif data.startswith(_ZIP):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                inside = [m for m in archive.infolist() if not m.is_dir()
                          and not m.filename.startswith("__MACOSX/")]  # fmt: skip
                if any(m.filename.endswith((".npy", "/data.pkl")) for m in inside):
                    return data
                if len(inside) != 1:
                    raise InputError(
                        f"{path} is an archive of {len(inside)} files. Unpack it, and give one of "
                        "them or the folder."
                    )
                kind = "zip"
                with archive.open(inside[0]) as file:
                    whole = _bounded(path, iter(lambda: file.read(_PIECE), b""), most_bytes)
        else:
            return data
    except (OSError, EOFError, ValueError, RuntimeError, NotImplementedError, zlib.error,
            lzma.LZMAError, zipfile.BadZipFile) as error:  # fmt: skip
        raise InputError(
            f"{path} is damaged: {kind or 'zip'} cannot unpack it. Fetch or save it again."
        ) from error
    again = [*_PACKED, *_FOREIGN, _ZIP]
    if whole[257:262] == b"ustar" or any(whole.startswith(mark) for mark in again):
        raise InputError(f"{path} holds an archive. Unpack it, and give one of its files.")
    return whole


def _pieces(kind: str, data: bytes) -> Iterator[bytes]:
    if kind == "xz":  # its header says how much memory unpacking takes
        unpacker = lzma.LZMADecompressor(memlimit=_XZ_MEMORY)
        yield unpacker.decompress(data, _PIECE)
        while not unpacker.eof:
            if unpacker.needs_input:
                raise EOFError
            yield unpacker.decompress(b"", _PIECE)
        return
    opened = {"gzip": gzip.open, "bzip2": bz2.open}[kind]
    with opened(io.BytesIO(data)) as file:
        while piece := file.read(_PIECE):
            yield piece


def _bounded(path: Path | str, pieces: Iterable[bytes], most_bytes: float) -> bytes:
    """All pieces of what is being unpacked."""
    whole, total = [], 0
    for piece in pieces:
        whole.append(piece)
        total += len(piece)
        refuse_more(f"{path}, unpacked,", total, most_bytes, "bytes", exact=False)
    return b"".join(whole)


def _unreadable(path: Path | str, error: Exception, remedy: str) -> InputError:
    said = getattr(error, "strerror", None) or error
    return InputError(f"{path} cannot be read: {said}. {remedy}".rstrip())


def _flag(name: str) -> int:
    """A flag of `os.open`, where the system has it."""
    return getattr(os, name, 0)
