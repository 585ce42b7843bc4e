"""ROS 2 logs: MCAP files, and rosbag2 folders of MCAP or SQLite (`.db3`) files.

Positions are a topic of `sensor_msgs/JointState`; commands are topics of
`trajectory_msgs/JointTrajectory`, `std_msgs/Float64MultiArray`, or `JointState` with a name such as
`/joint_commands`. Each reading gets the command in force at its time; nothing is interpolated.

A message has up to two times: its header's, by the program that made it, and the log's, when the
recorder received it. The header's is used where there is one, for it is nearer to the servo.
"""

from __future__ import annotations

import io
import re
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.ros_messages import (
    JOINT_STATE,
    MULTI_ARRAY,
    TRAJECTORY,
    Message,
    decode,
    plain_type,
)
from pupper_sysid.sysid.recordings.importers.shared.held import held_commands
from pupper_sysid.sysid.recordings.importers.shared.log import (
    LARGEST_BYTES,
    MOST_CELLS,
    Log,
    joint_names,
    read_files,
    rows,
)
from pupper_sysid.sysid.recordings.importers.shared.options import LogOptions

LAYOUT = "ROS 2 log"
MAGIC = b"\x89MCAP"
SQLITE = b"SQLite format 3\0"

_KINDS = (JOINT_STATE, TRAJECTORY, MULTI_ARRAY)
_COMMANDS = re.compile(r"command|cmd|goal|target|desired|setpoint|reference", re.IGNORECASE)
_MOST_MESSAGES = 3_000_000
_SAME_CLOCK_S = 10.0  # header and log differ by more: a header of another clock
_LOG_TIME_DOUBT_S, _HEADER_DOUBT_S = 0.003, 0.001

_Raw = tuple[str, str, int, bytes]  # topic, type, log time [ns], content


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
    """A bag's joints as rows.

    Raises
    ------
    InputError
        If a file cannot be read, or positions or commands are missing.
    """
    files = _files(folder)
    contents, digest = read_files(folder, files)
    raw: list[_Raw] = []
    warnings: list[str] = []
    for path in files:
        if path.suffix == ".db3":
            raw += _bounded(path, _sqlite(path))
        else:
            raw += _bounded(path, _mcap(path, contents[path], warnings))
    log = _log(folder, raw, options)
    return replace(log, sha256=digest, warnings=[*warnings, *log.warnings])


def read_mcap(path: Path, data: bytes, options: LogOptions) -> Log:
    """An MCAP file's joints as rows.

    Raises
    ------
    InputError
        If it cannot be read, or positions or commands are missing.
    """
    warnings: list[str] = []
    log = _log(path, _bounded(path, _mcap(path, data, warnings)), options)
    return replace(log, warnings=[*warnings, *log.warnings])


def read_sqlite(path: Path, options: LogOptions) -> Log:
    """A `.db3` file's joints as rows.

    Raises
    ------
    InputError
        If it cannot be read, or positions or commands are missing.
    """
    return _log(path, _bounded(path, _sqlite(path)), options)


# --------------------------------------------------------------------------------- containers


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix in (".mcap", ".db3") and p.is_file())


def _bounded(path: Path, messages: Iterator[_Raw]) -> list[_Raw]:
    found: list[_Raw] = []
    for message in messages:
        found.append(message)
        if len(found) > _MOST_MESSAGES:
            raise InputError(f"{path} has more than {_MOST_MESSAGES:,} messages. Split it.")
    return found


def _mcap(path: Path, data: bytes, warnings: list[str]) -> Iterator[_Raw]:
    """Messages of the known types in an MCAP file; one that is cut off gives what there is."""
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
    left = LARGEST_BYTES
    try:
        stream = StreamReader(
            io.BytesIO(data), emit_chunks=True, record_size_limit=int(LARGEST_BYTES)
        )
        for record in stream.records:
            inside: Sequence[Any] = [record]
            if isinstance(record, Chunk):
                record.data = _unpacked(path, record.compression, record.data, int(left))
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
                    yield topic, kind, one.log_time, one.data
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
        raise InputError(f"{path} unpacks to more than {LARGEST_BYTES / 1e6:.0f} MB. Split it.")
    return found


def _sqlite(path: Path) -> Iterator[_Raw]:
    """Messages of the known types in a bag's database, opened for reading only."""
    address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    try:
        with sqlite3.connect(address, uri=True) as database:
            topics = {
                int(n): (str(name), plain_type(str(kind)))
                for n, name, kind in database.execute("SELECT id, name, type FROM topics")
            }
            wanted = [n for n, (_, kind) in topics.items() if kind in _KINDS]
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


# ------------------------------------------------------------------------------------- topics


def _log(path: Path, raw: Sequence[_Raw], options: LogOptions) -> Log:
    """Rows of all joints that have both a position and a command."""
    options.refuse(LAYOUT, ("command", "position", "joints", "unit", "units"))
    topics = _topics(path, raw)
    state_name = options.position or _state(path, topics)
    state = _named(path, topics, state_name, "position")
    warnings: list[str] = []
    state_s, state_by = _times(state)
    start = state_s[0]
    state_s = (state_s - start) * 1e-9
    positions = _by_joint(state, ())
    order = state.messages[0].names
    names = [options.command] if options.command else _commands(topics, state_name)
    found: dict[str, tuple[NDArray[np.float64], NDArray[np.float64], str]] = {}
    clocks = {f"{state_name}: {state_by}"}
    several = 0
    for name in names:
        topic = _named(path, topics, name, "command")
        own = tuple(options.joints) or order
        if topic.kind == MULTI_ARRAY and len(own) == len(topic.messages[0].positions):
            warnings.append(
                f"{name} does not name its joints; they were taken in the order "
                f"{', '.join(map(printable, own))[:200]}. Give `joints` if it is another."
            )
        times, by = _times(topic)
        clocks.add(f"{name}: {by}")
        several = max(several, max(m.points for m in topic.messages))
        for joint, values in _by_joint(topic, own).items():
            if joint in positions and joint not in found:
                found[joint] = (times - start) * 1e-9, values, by
    if not found:
        raise InputError(
            f"{path}: no joint of {printable(state_name)} has a command. {_needs(topics)}"
        )
    if several > 1:
        warnings.append(
            "its trajectories have several points, between which the controller interpolates; the "
            "first point of each was taken as the command. Record the topic that the servo gets."
        )
    chosen = [j for j in order if j in found and (not options.joints or j in options.joints)]
    if not chosen:
        raise InputError(
            f"{path}: `joints` names none of {', '.join(map(printable, found))[:200]}."
        )
    ours = joint_names(path, [options.joints.get(j) or j for j in chosen])
    parts = []
    for theirs, name in zip(chosen, ours, strict=True):
        times, values, _ = found[theirs]
        held = np.isfinite(values)
        send, command, kept = held_commands(times[held], values[held], state_s)
        given = options.unit_of(theirs, name)
        scale, zero = (given.scale, given.zero) if given else (1.0, 0.0)
        parts.append(
            rows(name, send, state_s[kept], (command - zero) * scale,
                 (positions[theirs][kept] - zero) * scale)
        )  # fmt: skip
    by_log = any(by == "log" for _, _, by in found.values()) or state_by == "log"
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


def _topics(path: Path, raw: Sequence[_Raw]) -> dict[str, _Topic]:
    """Decoded messages by topic."""
    found: dict[str, _Topic] = {}
    values = 0
    for topic, kind, log_ns, data in raw:
        if kind not in _KINDS:
            continue
        try:
            if not 0 <= log_ns < 2**63:
                raise ValueError("its time in the log is no time")
            message = decode(kind, data)
        except ValueError as error:
            raise InputError(
                f"{path}, topic {printable(topic)[:80]}: {error}; it is no {kind} in CDR. Record "
                "it again."
            ) from error
        values += len(message.positions)
        if values > MOST_CELLS:
            raise InputError(f"{path} has more than {MOST_CELLS:,} positions. Split it.")
        own = found.setdefault(topic, _Topic(kind))
        if message.positions:
            own.log_ns.append(log_ns)
            own.messages.append(message)
    found = {name: _in_order(topic) for name, topic in found.items() if topic.messages}
    if not found:
        kinds = ", ".join(sorted({k for _, k, _, _ in raw})[:8]) or "nothing"
        raise InputError(
            f"{path} has no messages of joints; it has {printable(kinds)}. {_needs({})}"
        )
    return found


def _in_order(topic: _Topic) -> _Topic:
    order = np.argsort(topic.log_ns, kind="stable")
    return _Topic(topic.kind, [topic.log_ns[k] for k in order], [topic.messages[k] for k in order])


def _state(path: Path, topics: Mapping[str, _Topic]) -> str:
    """The topic of positions: the one with most messages."""
    states = [n for n, t in topics.items() if t.kind == JOINT_STATE and not _COMMANDS.search(n)]
    if not states:
        raise InputError(f"{path}: no topic has positions. {_needs(topics)}")
    return max(states, key=lambda n: len(topics[n].messages))


def _commands(topics: Mapping[str, _Topic], state: str) -> list[str]:
    """Topics of commands, those with most messages first."""
    found = [
        name
        for name, topic in topics.items()
        if name != state and (topic.kind != JOINT_STATE or _COMMANDS.search(name))
    ]
    return sorted(found, key=lambda n: -len(topics[n].messages))


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


def _times(topic: _Topic) -> tuple[NDArray[np.int64], str]:
    """Times [ns] and whose they are, the header's or the log's."""
    log = np.array(topic.log_ns, np.int64)
    header = np.array([m.stamp_ns for m in topic.messages], np.int64)
    usable = (header > 0).all() and (np.diff(header) >= 0).all()
    if usable and abs(float(np.median(header - log))) < 1e9 * _SAME_CLOCK_S:
        return header, "header"
    return log, "log"


def _by_joint(topic: _Topic, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Positions over the messages by joint; `names` where the messages have none."""
    found: dict[str, NDArray[np.float64]] = {}
    for k, message in enumerate(topic.messages):
        for joint, value in zip(message.names or names, message.positions, strict=False):
            if joint not in found:
                found[joint] = np.full(len(topic.messages), np.nan)
            found[joint][k] = value
    return found
