"""Messages of ROS 2 logs from their containers: MCAP files and rosbag2's SQLite databases."""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import resolved
from pupper_sysid.common.reading.content import allowed, refuse_more
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.log import LARGEST_BYTES
from pupper_sysid.sysid.recordings.importers.ros_messages import KINDS, plain_type

MAGIC = b"\x89MCAP"
SQLITE = b"SQLite format 3\0"

Raw = tuple[str, str, int, bytes]
"""Topic, type, log time [ns] and content of a message."""

_MOST_MESSAGES = 1_000_000
_MOST_TOPICS = 10_000
_MOST_STEPS = 1e9  # of SQLite's machine; a message takes some twenty
_STEPS = 100_000  # between two looks at them


def bounded(path: Path, messages: Iterator[Raw]) -> list[Raw]:
    """All messages."""
    found: list[Raw] = []
    total = 0
    for message in messages:
        found.append(message)
        total += len(message[3])
        # a database may say of one place that it is the content of many messages
        refuse_more(path, total, LARGEST_BYTES, "bytes", "Split it.", exact=False)
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
    """Yield the messages of the known types in a bag's database, opened for reading only."""
    address = f"{resolved(path).as_uri()}?mode=ro&immutable=1"
    steps = 0.0

    def enough() -> bool:
        nonlocal steps
        steps += _STEPS
        return steps > allowed(_MOST_STEPS)

    try:
        with closing(sqlite3.connect(address, uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            database.set_progress_handler(enough, _STEPS)
            _refuse_computed(database)
            topics = {
                int(n): (str(name)[:1000], plain_type(str(kind)[:1000]))
                for n, name, kind in database.execute(
                    f"SELECT id, name, type FROM topics LIMIT {_MOST_TOPICS}"
                )
            }
            wanted = [n for n, (_, kind) in topics.items() if kind in KINDS]
            marks = ",".join("?" * len(wanted[:500]))
            for n, time_ns, data in database.execute(
                f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})",
                wanted[:500],
            ):
                topic, kind = topics[n]
                if type(time_ns) is not int or not isinstance(data, bytes):
                    raise ValueError("a message is no bytes with a time")
                yield topic, kind, time_ns, data
    except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} is no readable rosbag2 database: {printable(str(error))[:120]}. Convert it "
            "with `ros2 bag convert` to MCAP."
        ) from error


def _refuse_computed(database: sqlite3.Connection) -> None:
    """Refuse tables that are views or programs: those may compute without end."""
    for name in ("topics", "messages"):
        found = database.execute(
            "SELECT type, sql FROM sqlite_master WHERE name = ? COLLATE NOCASE", (name,)
        ).fetchall()
        hidden = database.execute(f"SELECT 1 FROM pragma_table_xinfo('{name}') WHERE hidden != 0")
        tables = [kind == "table" and not str(sql).upper().startswith("CREATE VIRTUAL")
                  for kind, sql in found]  # fmt: skip
        if tables != [True] or hidden.fetchone():
            raise ValueError(f"{name} is no plain table")
