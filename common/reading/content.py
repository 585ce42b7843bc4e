"""Content of regular files, within a limit; pipes, devices and folders are refused.

A name may stand for anything: a pipe without a writer blocks its reader for ever, a device never
ends, a file under /proc has no size. The file is therefore opened without waiting, and looked at
before and while it is read. `unpacked` undoes a compression, within the same limit.

Every reader has limits: bytes, rows, columns, cells, nesting. They are far above what the files of
their kind have, so that a damaged or hostile file is refused in a moment instead of filling the
memory. `reading_up_to` raises all of them by a factor for a block of code, the option
`--read-limit` of every program for a command::

    with reading_up_to(4):
        recording = load("a_day.csv")
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import math
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path

from pupper_sysid.common.errors import InputError

MOST_TIMES = 1000.0

_times: ContextVar[float] = ContextVar("read_limit", default=1.0)


@contextmanager
def reading_up_to(times: float) -> Iterator[None]:
    """Within the block, read files up to `times` (1 to 1000) the usual limits."""
    if not 1 <= times <= MOST_TIMES:
        raise InputError(
            f"`read_limit` is {times:g}; it must be a number from 1 (the usual limits) to "
            f"{MOST_TIMES:g} (times as much)."
        )
    before = _times.set(times)
    try:
        yield
    finally:
        _times.reset(before)


def read_limit() -> float:
    """By which factor the limits of reading are raised now."""
    return _times.get()


def allowed(most: float) -> float:
    """The limit `most`, raised as it is now."""
    return most * _times.get()


def refuse_more(
    name: Path | str, count: float, most: float, unit: str, remedy: str = "", exact: bool = True
) -> None:
    """Refuse what is beyond a limit: `count` of a `unit` such as "rows", where `most` are allowed.

    `name`: the file, and the place in it where that helps. `most`: before it is raised. `remedy`:
    what to do, as a sentence. `exact`: whether `count` is all, rather than what was counted until
    the limit was passed.
    """
    bound = allowed(most)
    if count <= bound:
        return
    times, most_text = 10 * read_limit(), _amount(bound, unit)
    amount = f"more than {most_text}"
    if exact:
        times = max(math.ceil(count / most), 2)
        amount = f"{_amount(count, unit)}; at most {most_text} are read"
    raise InputError(
        f"{name} has {amount}. {f'{remedy} ' if remedy else ''}If it is meant to be so large, "
        f"raise the limits of reading with `read_limit={min(times, MOST_TIMES):.0f}`."
    )


def _amount(amount: float, unit: str) -> str:
    if unit != "bytes" or amount < 1e6:
        return f"{amount:,.0f} {unit}"
    return f"{amount / 1e6:,.0f} MB" if amount >= 10e6 else f"{amount / 1e6:.1f} MB"


_PIECE = 1 << 20


def open_regular(path: Path | str, remedy: str = "") -> BufferedReader:
    """Open a regular file for reading.

    `remedy`: what to do, as a sentence; by default, to check the file's name.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # opening a device may already do something
            raise InputError(f"{path} is not a file. {remedy or 'Give the name of a file.'}")
        flags = (getattr(os, f"O_{name}", 0) for name in ("NONBLOCK", "CLOEXEC", "BINARY"))
        descriptor = os.open(path, os.O_RDONLY | sum(flags))
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):  # it was exchanged in between
            os.close(descriptor)
            raise InputError(f"{path} is not a file. {remedy or 'Give the name of a file.'}")
        return os.fdopen(descriptor, "rb")
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist. {remedy or 'Check the name.'}") from error
    except (OSError, ValueError) as error:  # a name with a null character is a ValueError
        raise _unreadable(path, error, remedy) from error


def content(path: Path | str, most_bytes: float, remedy: str = "") -> bytes:
    """Content of a regular file of at most `most_bytes`; `remedy`: what to do, as a sentence."""
    try:
        with open_regular(path, remedy) as file:
            size = os.fstat(file.fileno()).st_size
            refuse_more(path, size, most_bytes, "bytes", remedy)
            pieces, total = [], 0
            while piece := file.read(max(size - total + 1, _PIECE)):
                pieces.append(piece)
                total += len(piece)  # the file grows, or has no size
                refuse_more(path, total, most_bytes, "bytes", remedy, exact=False)
            if piece is None:
                raise InputError(f"{path} cannot be read: nothing comes. {remedy}".rstrip())
            return pieces[0] if len(pieces) == 1 else b"".join(pieces)
    except OSError as error:
        raise _unreadable(path, error, remedy) from error


_XZ_MEMORY = 256 << 20  # of `xz -9`: 65 MB
_ZIP = b"PK\x03\x04"
_LOGS = (".csv", ".tsv", ".json", ".jsonl", ".parquet", ".mcap", ".log", ".dat")
_PACKED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\0": "xz"}
_FOREIGN = {b"\x28\xb5\x2f\xfd": "zstd", b"7z\xbc\xaf\x27\x1c": "7-Zip", b"Rar!": "RAR",
            b"\x04\x22\x4d\x18": "LZ4"}  # fmt: skip


def unpacked(path: Path | str, data: bytes, most_bytes: float) -> bytes:
    """Content of a file that is compressed by gzip, bzip2 or xz, or the one file in a zip archive.

    Other content comes back as it is, also archives of arrays (`.npz`, `.pt`). The first bytes tell
    the compression, not the name. Content of more than `most_bytes` is refused.
    """
    kind = next((k for mark, k in _PACKED.items() if data.startswith(mark)), None)
    foreign = next((k for mark, k in _FOREIGN.items() if data.startswith(mark)), None)
    if foreign is not None:
        raise InputError(f"{path} is packed by {foreign}, which is not read. Unpack it first.")
    try:
        if kind is not None:
            content = _bounded(path, _pieces(kind, data), most_bytes)
        elif data.startswith(_ZIP):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                inside = [m for m in archive.infolist() if not m.is_dir()
                          and not m.filename.startswith("__MACOSX/")]  # fmt: skip
                if any(m.filename.endswith((".npy", "/data.pkl")) for m in inside):
                    return data
                if any(m.filename.startswith("xl/") for m in inside):
                    raise InputError(f"{path} is a spreadsheet, which is not read: save it as CSV.")
                if len(inside) != 1:  # beside notes and pictures
                    inside = [m for m in inside if m.filename.lower().endswith(_LOGS)] or inside
                if len(inside) != 1:
                    raise InputError(
                        f"{path} is an archive of {len(inside)} files. Unpack it, and give one of "
                        "them or the folder."
                    )
                kind = "zip"
                with archive.open(inside[0]) as file:
                    content = _bounded(path, iter(lambda: file.read(_PIECE), b""), most_bytes)
        else:
            return data
    except (OSError, EOFError, ValueError, RuntimeError, NotImplementedError, zlib.error,
            lzma.LZMAError, zipfile.BadZipFile) as error:  # fmt: skip
        raise InputError(
            f"{path} is damaged: {kind or 'zip'} cannot unpack it. Fetch or save it again."
        ) from error
    again = [*_PACKED, *_FOREIGN, _ZIP]
    if content[257:262] == b"ustar" or any(content.startswith(mark) for mark in again):
        raise InputError(f"{path} holds an archive. Unpack it, and give one of its files.")
    return content


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
    unpacked_pieces, total = [], 0
    for piece in pieces:
        unpacked_pieces.append(piece)
        total += len(piece)
        refuse_more(f"{path}, unpacked,", total, most_bytes, "bytes", exact=False)
    return b"".join(unpacked_pieces)


def _unreadable(path: Path | str, error: Exception, remedy: str) -> InputError:
    reason = getattr(error, "strerror", None) or error
    return InputError(f"{path} cannot be read: {reason}. {remedy}".rstrip())


LARGEST_HEADER = 1_000_000
LARGEST_CHECKPOINT = 2e9


def refuse_large_header(path: Path | str, data: bytes) -> None:
    """Refuse a safetensors file whose list of tensors is longer than a network's."""
    length = struct.unpack_from("<Q", data)[0] if len(data) >= 8 else 0
    if length > len(data):  # no such file, as its library will say
        return
    refuse_more(f"{path}, its list of tensors,", length, LARGEST_HEADER, "bytes")


def refuse_bomb(path: Path | str, data: bytes, remedy: str) -> None:
    """Refuse a torch file that is no zip archive, or unpacks to more than a checkpoint has."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            inside = archive.infolist()
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise InputError(f"{path} is damaged and cannot be read. {remedy}") from error
    if any(member.compress_type != zipfile.ZIP_STORED for member in inside):
        raise InputError(f"{path} is compressed, which torch's files are not. {remedy}")
    refuse_more(path, sum(m.file_size for m in inside), LARGEST_CHECKPOINT, "bytes", remedy)
