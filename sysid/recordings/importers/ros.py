"""ROS 2 logs: MCAP files, and rosbag2 folders of MCAP or SQLite (`.db3`) files.

Positions are a topic of `sensor_msgs/JointState`; commands are topics of
`trajectory_msgs/JointTrajectory`, `std_msgs/Float64MultiArray`, or `JointState` with a name such as
`/joint_commands`. Each reading gets the command in force at its time; nothing is interpolated.

A message has up to two times: its header's, by the program that made it, and the log's, when the
recorder received it. The header's is used where there is one, for it is nearer to the servo.

A bag in SQLite holds no definitions of its messages, so `decode` reads the three types from their
bytes (CDR). No length in the bytes is believed beyond the bytes there are.
"""

from __future__ import annotations

import io
import re
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import resolved
from pupper_sysid.common.reading.content import allowed, refuse_more
from pupper_sysid.common.reading.csv_table import MOST_CELLS, distinct, one_each
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.log import (
    LARGEST_BYTES,
    MOST_JOINTS,
    Log,
    held_commands,
    joint_names,
    read_files,
    rows,
)
from pupper_sysid.sysid.recordings.importers.options import LogOptions, Unit

LAYOUT = "ROS 2 log"

_COMMANDS = re.compile(r"command|cmd|goal|target|desired|setpoint|reference", re.IGNORECASE)
_SAME_CLOCK_S = 10.0  # header and log differ by more: a header of another clock
_MANY_LOST = 0.1  # of the commands
_LOG_TIME_DOUBT_S, _HEADER_DOUBT_S = 0.003, 0.001


@dataclass
class _Topic:
    """Messages of one topic, in the order of the log."""

    kind: str
    log_ns: list[int] = field(default_factory=list)
    messages: list[Message] = field(default_factory=list)


def is_bag(folder: Path) -> bool:
    """Whether `folder` is a rosbag2 bag."""
    return (folder / "metadata.yaml").is_file() and bool(_files(folder))


def read_bag(folder: Path, options: LogOptions) -> Log:
    """A bag's joints as rows."""
    files = _files(folder)
    contents, digest = read_files(folder, files)
    raw: list[Raw] = []
    warnings: list[str] = []
    for path in files:
        raw += _messages(path, contents[path], warnings)
    log = _log(folder, raw, options)
    return replace(log, sha256=digest, warnings=[*warnings, *log.warnings])


def read_file(path: Path, data: bytes, options: LogOptions) -> Log:
    """The joints of an MCAP or a `.db3` file as rows."""
    warnings: list[str] = []
    log = _log(path, _messages(path, data, warnings), options)
    return replace(log, warnings=[*warnings, *log.warnings])


def _files(folder: Path) -> list[Path]:
    """A bag's files, in the order of their numbers."""
    return sorted(p for p in folder.iterdir() if p.suffix in (".mcap", ".db3") and p.is_file())


# ------------------------------------------------------------------------------------- topics


def _log(path: Path, raw: Sequence[Raw], options: LogOptions) -> Log:
    """Rows of all joints that have both a position and a command."""
    options.refuse(LAYOUT, ("command", "position", "joints", "unit", "units"))
    topics = _topics(path, raw)
    state_name = options.position or _state(path, topics)
    state = _named(path, topics, state_name, "position")
    names = [options.command] if options.command else _commands(topics, state_name)
    warnings: list[str] = []
    commanded = {name: _named(path, topics, name, "command") for name in names}
    one_clock = all(_headers(topic) is not None for topic in (state, *commanded.values()))
    state_s, state_by = _times(state, one_clock)
    start = state_s[0]
    state_s = (state_s - start) * 1e-9
    positions = _by_joint(f"{path}, topic {printable(state_name)[:80]}", state, ())
    order = tuple(dict.fromkeys(joint for m in state.messages for joint in m.names))
    commanded_of: dict[str, tuple[NDArray[np.float64], NDArray[np.float64], str]] = {}
    clocks = {f"{state_name}: {state_by}"}
    several = 0
    for name, topic in commanded.items():
        joint_order = tuple(options.joints) or order
        if topic.kind == MULTI_ARRAY:
            lengths = {len(m.positions) for m in topic.messages}
            if lengths != {len(joint_order)} and len(commanded) > 1:
                warnings.append(
                    f"{name} has {min(lengths)} values for {len(joint_order)} joints and was left "
                    "out."
                )
                continue
            warnings.append(
                f"{name} does not name its joints; they were taken in the order "
                f"{', '.join(map(printable, joint_order))[:200]}. Give `joints` if it is another."
            )
        times, by = _times(topic, one_clock)
        clocks.add(f"{name}: {by}")
        several = max(several, max(m.points for m in topic.messages))
        place = f"{path}, topic {printable(name)[:80]}"
        for joint, values in _by_joint(place, topic, joint_order).items():
            if joint in positions and joint not in commanded_of:
                commanded_of[joint] = (times - start) * 1e-9, values, by
    if not commanded_of:
        raise InputError(
            f"{path}: no joint of {printable(state_name)} has a command. {_needs(topics)}"
        )
    if several > 1:
        warnings.append(
            "its trajectories have several points, between which the controller interpolates; the "
            "first point of each was taken as the command. Record the topic that the servo gets."
        )
    chosen = [j for j in order if j in commanded_of and (not options.joints or j in options.joints)]
    if not chosen:
        raise InputError(
            f"{path}: `joints` names none of {', '.join(map(printable, commanded_of))[:200]}."
        )
    ours = joint_names(path, [options.joints.get(j) or j for j in chosen])
    parts, lost = [], 0.0
    for theirs, name in zip(chosen, ours, strict=True):
        times, values, _ = commanded_of[theirs]
        held = np.isfinite(values)
        # a message may be of some joints only, as where they move one after the other
        named = np.array([theirs in message.names for message in state.messages])
        read_s, read = state_s[named], positions[theirs][named]
        send, command, kept = held_commands(times[held], values[held], read_s)
        inside = (times[held] >= read_s[0]) & (times[held] <= read_s[-1])
        lost = max(lost, 1 - np.sum(send != read_s[kept]) / max(int(inside.sum()), 1))
        of_command, of_position = options.unit_of(theirs, name) or (Unit(), Unit())
        angles = of_command.radians(command), of_position.radians(read[kept])
        parts.append(rows(name, send, read_s[kept], *angles))
    if lost > _MANY_LOST:
        warnings.append(
            f"{100 * lost:.0f} % of the commands were replaced before the next reading and have no "
            "row. Record the positions at least as often as the commands."
        )
    by_log = any(by == "log" for _, _, by in commanded_of.values()) or state_by == "log"
    doubt = _LOG_TIME_DOUBT_S if by_log else _HEADER_DOUBT_S
    if by_log:
        warnings.append(
            "times are of the header where a message has one, else of the log, when the recorder "
            f"received it ({'; '.join(sorted(map(printable, clocks)))}): lag and dead time are in "
            f"doubt by {1e3 * doubt:.0f} ms, more if the machine was busy."
        )
    metadata = {
        "imported_from": LAYOUT,
        "joints": ours,
        "times": sorted(clocks),
        "bus": {"read_time_doubt_s": doubt},
    }
    return Log(pd.concat(parts, ignore_index=True), metadata, warnings)


def _topics(path: Path, raw: Sequence[Raw]) -> dict[str, _Topic]:
    """Decoded messages by topic."""
    topics: dict[str, _Topic] = {}
    values = 0
    for name, kind, log_ns, data in raw:
        if kind not in KINDS:
            continue
        try:
            if not 0 <= log_ns < 2**63:
                raise ValueError("its time in the log is no time")
            message = decode(kind, data)
        except ValueError as error:
            raise InputError(
                f"{path}, topic {printable(name)[:80]}: {error}; it is no {kind} in CDR. Record "
                "it again."
            ) from error
        values += len(message.positions)
        refuse_more(path, values, MOST_CELLS, "positions", "Split it.", exact=False)
        topic_of = topics.setdefault(name, _Topic(kind))
        if message.positions:
            topic_of.log_ns.append(log_ns)
            topic_of.messages.append(message)
    topics = {name: topic for name, topic in topics.items() if topic.messages}
    for topic in topics.values():
        order = np.argsort(topic.log_ns, kind="stable")
        topic.log_ns = [topic.log_ns[k] for k in order]
        topic.messages = [topic.messages[k] for k in order]
    if not topics:
        kinds = ", ".join(sorted({k for _, k, _, _ in raw})[:8]) or "nothing"
        raise InputError(
            f"{path} has no messages of joints; it has {printable(kinds)}. {_needs({})}"
        )
    return topics


def _state(path: Path, topics: Mapping[str, _Topic]) -> str:
    """The topic of positions: the one with most messages."""
    states = [n for n, t in topics.items() if t.kind == JOINT_STATE and not _COMMANDS.search(n)]
    if not states:
        raise InputError(f"{path}: no topic has positions. {_needs(topics)}")
    return max(states, key=lambda n: len(topics[n].messages))


def _commands(topics: Mapping[str, _Topic], state: str) -> list[str]:
    """Topics of commands, those with most messages first."""
    commands = [
        name
        for name, topic in topics.items()
        if name != state and (topic.kind != JOINT_STATE or _COMMANDS.search(name))
    ]
    return sorted(commands, key=lambda n: -len(topics[n].messages))


def _named(path: Path, topics: Mapping[str, _Topic], name: str, option: str) -> _Topic:
    if name not in topics:
        raise InputError(f"{path}: `{option}` is {name}, not one of its topics. {_needs(topics)}")
    return topics[name]


def _needs(topics: Mapping[str, _Topic]) -> str:
    has = ", ".join(f"{printable(n)[:60]} ({t.kind})" for n, t in list(topics.items())[:8])
    return (
        f"{f'It has {has}. ' if has else ''}A servo's log needs positions ({JOINT_STATE}) and "
        f"commands ({TRAJECTORY}, {MULTI_ARRAY}, or {JOINT_STATE} on a topic of commands); name "
        "the topics with `position` and `command`."
    )


def _headers(topic: _Topic) -> NDArray[np.int64] | None:
    """Times of the headers [ns]; None where there are none, or they run backwards."""
    stamps = np.array([m.stamp_ns for m in topic.messages], np.int64)
    return stamps if stamps.any() and (np.diff(stamps) >= 0).all() else None


def _times(topic: _Topic, one_clock: bool) -> tuple[NDArray[np.int64], str]:
    """Times [ns] and whose they are, the header's or the log's.

    Headers are believed where all topics have them (`one_clock`, which may be a simulation's), or
    where theirs is the log's clock.
    """
    log, header = np.array(topic.log_ns, np.int64), _headers(topic)
    if header is None:
        return log, "log"
    same = abs(float(np.median(header - log))) < 1e9 * _SAME_CLOCK_S
    return (header, "header") if one_clock or same else (log, "log")


def _by_joint(place: str, topic: _Topic, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Positions over the messages by joint; `names` where the messages have none."""
    by_joint: dict[str, NDArray[np.float64]] = {}
    every = {joint for message in topic.messages for joint in message.names}
    refuse_more("A topic of the log", len(every), MOST_JOINTS, "joints")
    for joints, count in {(m.names or tuple(names), len(m.positions)) for m in topic.messages}:
        distinct(place, joints, "joints")
        one_each(
            place,
            {"a message": count, "its list of joints": len(joints)},
            "Name them with `joints`.",
        )
    for k, message in enumerate(topic.messages):
        for joint, value in zip(message.names or names, message.positions, strict=True):
            if joint not in by_joint:
                by_joint[joint] = np.full(len(topic.messages), np.nan)
            by_joint[joint][k] = value
    return by_joint


MAGIC = b"\x89MCAP"
SQLITE = b"SQLite format 3\0"

Raw = tuple[str, str, int, bytes]
"""Topic, type, log time [ns] and content of a message."""

_MOST_MESSAGES = 1_000_000
_MOST_TOPICS = 10_000
_MOST_STEPS = 1e9  # of SQLite's machine; a message takes some twenty
_STEPS = 100_000  # between two looks at them


def _messages(path: Path, data: bytes, warnings: list[str]) -> list[Raw]:
    """All messages of a file; `warnings` gets a sentence if it is cut off."""
    of_sqlite = data.startswith(SQLITE) or path.suffix == ".db3"
    messages: list[Raw] = []
    total = 0
    for message in sqlite_messages(path) if of_sqlite else mcap_messages(path, data, warnings):
        messages.append(message)
        total += len(message[3])
        # a database may say of one place that it is the content of many messages
        refuse_more(path, total, LARGEST_BYTES, "bytes", "Split it.", exact=False)
        refuse_more(path, len(messages), _MOST_MESSAGES, "messages", "Split it.", exact=False)
    return messages


def mcap_messages(path: Path, data: bytes, warnings: list[str]) -> Iterator[Raw]:
    """Yield the messages of an MCAP file; one that is cut off gives what there is.

    `path`: for messages to the user. `warnings`: gets a sentence if the file is cut off.
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
    budget = int(allowed(LARGEST_BYTES))
    try:
        stream = StreamReader(io.BytesIO(data), emit_chunks=True, record_size_limit=budget)
        for record in stream.records:
            inside: Sequence[Any] = [record]
            if isinstance(record, Chunk):
                record.data = _unpacked(path, record.compression, record.data, budget)
                record.compression = ""
                budget -= len(record.data)
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
            unpacked = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data)).read(most + 1)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
    elif compression == "lz4":
        import lz4.frame

        unpacked = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most + 1)
    else:
        unpacked = data
    if len(unpacked) > most:
        refuse_more(f"{path}, unpacked,", allowed(LARGEST_BYTES) + 1, LARGEST_BYTES, "bytes",
                    "Keep the topics of joints only (`mcap filter`).", exact=False)  # fmt: skip
    return unpacked


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
            topic_ids = [n for n, (_, kind) in topics.items() if kind in KINDS]
            marks = ",".join("?" * len(topic_ids[:500]))
            for n, time_ns, data in database.execute(
                f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})",
                topic_ids[:500],
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
        computed = database.execute(
            "SELECT type, sql FROM sqlite_master WHERE name = ? COLLATE NOCASE", (name,)
        ).fetchall()
        hidden = database.execute(f"SELECT 1 FROM pragma_table_xinfo('{name}') WHERE hidden != 0")
        tables = [kind == "table" and not str(sql).upper().startswith("CREATE VIRTUAL")
                  for kind, sql in computed]  # fmt: skip
        if tables != [True] or hidden.fetchone():
            raise ValueError(f"{name} is no plain table")


JOINT_STATE = "sensor_msgs/JointState"
TRAJECTORY = "trajectory_msgs/JointTrajectory"
MULTI_ARRAY = "std_msgs/Float64MultiArray"
KINDS = (JOINT_STATE, TRAJECTORY, MULTI_ARRAY)


@dataclass(frozen=True)
class Message:
    """Positions of joints at a time."""

    stamp_ns: int
    """Of the header; 0 where there is none."""
    names: tuple[str, ...]
    """Empty where the message has none."""
    positions: tuple[float, ...]
    points: int = 1
    """How many points a trajectory has; its first one is in `positions`."""


def plain_type(name: str) -> str:
    """`sensor_msgs/JointState` of `sensor_msgs/msg/JointState`."""
    return name.replace("/msg/", "/")


def decode(kind: str, data: bytes) -> Message:
    """A message of type `kind`, one of `KINDS`.

    Raises ValueError if the bytes are too short, or no such message.
    """
    cdr = _Cdr(data)
    if kind == MULTI_ARRAY:
        for _ in range(cdr.length()):  # its dimensions
            cdr.text()
            cdr.values("I", 2)
        cdr.values("I")
        return Message(0, (), cdr.values("d", cdr.length()))
    seconds, rest = cdr.values("i") + cdr.values("I")
    stamp = int(seconds) * 10**9 + int(rest)
    cdr.text()  # its frame
    names = tuple(cdr.text() for _ in range(cdr.length()))
    points = 1 if kind == JOINT_STATE else cdr.length()
    return Message(stamp, names, cdr.values("d", cdr.length()) if points else (), points)


class _Cdr:
    """Values one after another, aligned to their size (OMG CDR, with its four bytes of header)."""

    def __init__(self, data: bytes):
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise ValueError("no CDR header")
        self._data, self._at = memoryview(data)[4:], 0
        self._order = "<" if data[1] == 1 else ">"

    def values(self, code: str, count: int = 1) -> tuple[float, ...]:
        """`count` numbers of the type that `struct` calls `code`."""
        if count == 0:
            return ()
        size = struct.calcsize(f"={code}")
        start = -(-self._at // size) * size
        self._at = start + size * count
        if self._at > len(self._data):
            raise ValueError("message is cut short")
        return struct.unpack(f"{self._order}{count}{code}", self._data[start : self._at])

    def length(self) -> int:
        """Length of the sequence that follows."""
        count = int(self.values("I")[0])
        if count > len(self._data) - self._at:
            raise ValueError("a length in the message is larger than the message")
        return count

    def text(self) -> str:
        """Text that ends with a zero byte."""
        count = self.length()
        start, self._at = self._at, self._at + count
        return bytes(self._data[start : self._at]).rstrip(b"\0").decode("utf-8", "replace")
