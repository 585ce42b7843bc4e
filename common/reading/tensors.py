"""Limits of files with weights, before a library builds anything from them."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.budget import refuse_more

LARGEST_HEADER = 1_000_000
LARGEST_CHECKPOINT = 2e9


def refuse_large_header(path: Path | str, data: bytes) -> None:
    """Refuse a safetensors file whose list of tensors is longer than a network's.

    Parameters
    ----------
    path : Path or str
        For the message.
    data : bytes
        Content of the file.

    Raises
    ------
    InputError
    """
    length = struct.unpack_from("<Q", data)[0] if len(data) >= 8 else 0
    if length > len(data):  # no such file, as its library will say
        return
    refuse_more(f"{path}, its list of tensors,", length, LARGEST_HEADER, "bytes")


def refuse_bomb(path: Path | str, data: bytes, remedy: str) -> None:
    """Refuse a torch file that is no zip archive, or unpacks to more than a checkpoint has.

    Parameters
    ----------
    path : Path or str
        For the message.
    data : bytes
        Content of the file.
    remedy : str
        What to do, as a sentence.

    Raises
    ------
    InputError
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            inside = archive.infolist()
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise InputError(f"{path} is damaged and cannot be read. {remedy}") from error
    if any(member.compress_type != zipfile.ZIP_STORED for member in inside):
        raise InputError(f"{path} is compressed, which torch's files are not. {remedy}")
    refuse_more(path, sum(m.file_size for m in inside), LARGEST_CHECKPOINT, "bytes", remedy)
