"""Messages of ROS 2 logs from their containers: MCAP files and rosbag2's SQLite databases."""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.budget import allowed, refuse_more
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.ros_messages import KINDS, plain_type
from pupper_sysid.sysid.recordings.importers.shared.log import LARGEST_BYTES

MAGIC = b"\x89MCAP"
SQLITE = b"SQLite format 3\0"

Raw = tuple[str, str, int, bytes]
"""Topic, type, log time [ns] and content of a message."""

_MOST_MESSAGES = 3_000_000


def bounded(path: Path, messages: Iterator[Raw]) -> list[Raw]:
    """All messages.

    Raises
    ------
    InputError
        If there are too many.
    """
    found: list[Raw] = []
    for message in messages:
        found.append(message)
        refuse_more(path, len(found), _MOST_MESSAGES, "messages", "Split it.", exact=False)
    return found


def mcap_messages(path: Path, data: bytes, warnings: list[str]) -> Iterator[Raw]:
    """Yield the messages of an MCAP file; one that is cut off gives what there is.

    Parameters
    ----------
    path : Path
        For messages to the user.
    data : bytes
    warnings : list of str
        Gets a sentence if the file is cut off.

    Raises
    ------
    InputError
        If the library is not installed, or the file is damaged or too large.
    """
    try:
        from mcap.exceptions import EndOfFile, McapError
        from mcap.records import Channel, Chunk, Schema
        from mcap.records import Message as Record
        from mcap.stream_reader import StreamReader, breakup_chunk
    except ImportError:
        raise InputError(
            f"{path} is an MCAP file; reading it needs mcap. Install pupper-sysid[logs]."
        ) from None
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    left = int(allowed(LARGEST_BYTES))
    try:
        stream = StreamReader(io.BytesIO(data), emit_chunks=True, record_size_limit=left)
        for record in stream.records:
            inside: Sequence[Any] = [record]
            if isinstance(record, Chunk):
                record.data = _unpacked(path, record.compression, record.data, left)
                record.compression = ""
                left -= len(record.data)
                inside = breakup_chunk(record)
            for one in inside:
                if isinstance(one, Schema):
                    schemas[one.id] = plain_type(one.name)
                elif isinstance(one, Channel):
                    channels[one.id] = one.topic, schemas.get(one.schema_id, "")
                elif isinstance(one, Record) and one.channel_id in channels:
                    topic, kind = channels[one.channel_id]
                    yield topic, kind, one.log_time, one.data if kind in KINDS else b""
    except (EndOfFile, struct.error):  # the library unpacks what is left of a record
        warnings.append("it was cut short, or is damaged, and is used up to there.")
    except (McapError, ValueError, RuntimeError, EOFError, OverflowError) as error:
        said = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(
            f"{path} is a damaged MCAP file: {printable(said)}. Try `mcap recover`."
        ) from error


def _unpacked(path: Path, compression: str, data: bytes, most: int) -> bytes:
    """A chunk's content, at most `most` bytes of it."""
    if compression == "zstd":
        import zstandard

        try:
            found = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data)).read(most + 1)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
    elif compression == "lz4":
        import lz4.frame

        found = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most + 1)
    else:
        found = data
    if len(found) > most:
        refuse_more(f"{path}, unpacked,", allowed(LARGEST_BYTES) + 1, LARGEST_BYTES, "bytes",
                    "Keep the topics of joints only (`mcap filter`).", exact=False)  # fmt: skip
    return found


def sqlite_messages(path: Path) -> Iterator[Raw]:
    """Yield the messages of the known types in a bag's database, opened for reading only.

    Raises
    ------
    InputError
        If it is no such database.
    """
    address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    try:
        with sqlite3.connect(address, uri=True) as database:
            topics = {
                int(n): (str(name), plain_type(str(kind)))
                for n, name, kind in database.execute("SELECT id, name, type FROM topics")
            }
            wanted = [n for n, (_, kind) in topics.items() if kind in KINDS]
            marks = ",".join("?" * len(wanted[:500]))
            for n, time_ns, data in database.execute(
                f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})",
                wanted[:500],
            ):
                topic, kind = topics[n]
                yield topic, kind, int(time_ns), bytes(data)
    except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} is no readable rosbag2 database: {printable(str(error))[:120]}. Convert it "
            "with `ros2 bag convert` to MCAP."
        ) from error
