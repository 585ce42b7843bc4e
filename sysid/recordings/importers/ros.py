"""ROS 2 logs: MCAP files, and rosbag2 folders of MCAP or SQLite (`.db3`) files.

Positions are a topic of `sensor_msgs/JointState`; commands are topics of
`trajectory_msgs/JointTrajectory`, `std_msgs/Float64MultiArray`, or `JointState` with a name such as
`/joint_commands`. Each reading gets the command in force at its time; nothing is interpolated.

A message has up to two times: its header's, by the program that made it, and the log's, when the
recorder received it. The header's is used where there is one, for it is nearer to the servo.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_CELLS, distinct, one_each
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.log import (
    MOST_JOINTS,
    Log,
    held_commands,
    joint_names,
    read_files,
    rows,
)
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.ros_files import (
    Raw,
    bounded,
    mcap_messages,
    sqlite_messages,
)
from pupper_sysid.sysid.recordings.importers.ros_messages import (
    JOINT_STATE,
    KINDS,
    MULTI_ARRAY,
    TRAJECTORY,
    Message,
    decode,
)

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
        if path.suffix == ".db3":
            raw += bounded(path, sqlite_messages(path))
        else:
            raw += bounded(path, mcap_messages(path, contents[path], warnings))
    log = _log(folder, raw, options)
    return replace(log, sha256=digest, warnings=[*warnings, *log.warnings])


def read_mcap(path: Path, data: bytes, options: LogOptions) -> Log:
    """An MCAP file's joints as rows."""
    warnings: list[str] = []
    log = _log(path, bounded(path, mcap_messages(path, data, warnings)), options)
    return replace(log, warnings=[*warnings, *log.warnings])


def read_sqlite(path: Path, options: LogOptions) -> Log:
    """A `.db3` file's joints as rows."""
    return _log(path, bounded(path, sqlite_messages(path)), options)


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
    found: dict[str, tuple[NDArray[np.float64], NDArray[np.float64], str]] = {}
    clocks = {f"{state_name}: {state_by}"}
    several = 0
    for name, topic in commanded.items():
        own = tuple(options.joints) or order
        if topic.kind == MULTI_ARRAY:
            lengths = {len(m.positions) for m in topic.messages}
            if lengths != {len(own)} and len(commanded) > 1:
                warnings.append(
                    f"{name} has {min(lengths)} values for {len(own)} joints and was left out."
                )
                continue
            warnings.append(
                f"{name} does not name its joints; they were taken in the order "
                f"{', '.join(map(printable, own))[:200]}. Give `joints` if it is another."
            )
        times, by = _times(topic, one_clock)
        clocks.add(f"{name}: {by}")
        several = max(several, max(m.points for m in topic.messages))
        place = f"{path}, topic {printable(name)[:80]}"
        for joint, values in _by_joint(place, topic, own).items():
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
    parts, lost = [], 0.0
    for theirs, name in zip(chosen, ours, strict=True):
        times, values, _ = found[theirs]
        held = np.isfinite(values)
        # a message may be of some joints only, as where they move one after the other
        named = np.array([theirs in message.names for message in state.messages])
        read_s, read = state_s[named], positions[theirs][named]
        send, command, kept = held_commands(times[held], values[held], read_s)
        inside = (times[held] >= read_s[0]) & (times[held] <= read_s[-1])
        lost = max(lost, 1 - np.sum(send != read_s[kept]) / max(int(inside.sum()), 1))
        given = options.unit_of(theirs, name)
        scale, zero = (given.scale, given.zero) if given else (1.0, 0.0)
        parts.append(
            rows(name, send, read_s[kept], (command - zero) * scale, (read[kept] - zero) * scale)
        )  # fmt: skip
    if lost > _MANY_LOST:
        warnings.append(
            f"{100 * lost:.0f} % of the commands were replaced before the next reading and have no "
            "row. Record the positions at least as often as the commands."
        )
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


def _topics(path: Path, raw: Sequence[Raw]) -> dict[str, _Topic]:
    """Decoded messages by topic."""
    found: dict[str, _Topic] = {}
    values = 0
    for topic, kind, log_ns, data in raw:
        if kind not in KINDS:
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
        refuse_more(path, values, MOST_CELLS, "positions", "Split it.", exact=False)
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


def _headers(topic: _Topic) -> NDArray[np.int64] | None:
    """Times of the headers [ns]; None where there are none, or they run backwards."""
    found = np.array([m.stamp_ns for m in topic.messages], np.int64)
    return found if found.any() and (np.diff(found) >= 0).all() else None


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
    found: dict[str, NDArray[np.float64]] = {}
    every = {joint for message in topic.messages for joint in message.names}
    refuse_more("A topic of the log", len(every), MOST_JOINTS, "joints")
    for own, count in {(m.names or tuple(names), len(m.positions)) for m in topic.messages}:
        distinct(place, own, "joints")
        one_each(
            place, {"a message": count, "its list of joints": len(own)}, "Name them with `joints`."
        )
    for k, message in enumerate(topic.messages):
        for joint, value in zip(message.names or names, message.positions, strict=True):
            if joint not in found:
                found[joint] = np.full(len(topic.messages), np.nan)
            found[joint][k] = value
    return found
