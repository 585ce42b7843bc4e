"""A recording as MCAP in ROS 2's messages, for Foxglove and rosbag2.

`/joint_states` and `/joint_commands` are `sensor_msgs/JointState`, so that `pupper-sysid import`
reads the file back; every other channel is a topic of `std_msgs/Float64` of its own
(`/LF_hip/reading_age_s`), and sentences on the guard are `rcl_interfaces/Log` on `/rosout`.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, write_bytes
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.view.channels import Channel, channels, guard_events

_RULE = "=" * 80
_TIME = f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_STATE = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    f"float64[] effort\n{_RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"
    f"string frame_id\n{_TIME}"
)
_DEFINITIONS = {
    "sensor_msgs/msg/JointState": _STATE,
    "std_msgs/msg/Float64": "float64 data\n",
    "rcl_interfaces/msg/Log": "builtin_interfaces/Time stamp\nuint8 level\nstring name\n"
    f"string msg\nstring file\nstring function\nuint32 line\n{_TIME}",
}
_TOPICS = {"command_rad": "/joint_commands", "position_rad": "/joint_states"}
_WARN = 30  # level of rcl_interfaces/Log

_Message = tuple[int, str, str, dict[str, Any]]
"""Time [ns], topic, type and content."""


def write_mcap(recording: Recording, path: Path, force: bool = False) -> None:
    """Write a recording as MCAP."""
    refuse_overwrite(path, force)
    file = io.BytesIO()
    stream = McapStream(file)
    found = channels(recording)
    events = guard_events(recording, max(channel.time_s[-1] for channel in found))
    stream.add(found, events)
    stream.close()
    write_bytes(path, file.getvalue(), force)


class McapStream:
    """MCAP in ROS 2's messages that grows by channels."""

    def __init__(self, file: IO[bytes]):
        try:
            from mcap_ros2.writer import Writer
        except ImportError:
            raise InputError(
                "Writing MCAP needs mcap-ros2-support: pip install 'pupper-sysid[live]'."
            ) from None
        self._writer = Writer(file)
        self._schemas = {k: self._writer.register_msgdef(k, t) for k, t in _DEFINITIONS.items()}
        self._shift_ns: int | None = None

    def add(self, found: Sequence[Channel], events: Sequence[tuple[float, str]] = ()) -> None:
        """Write what follows: channels, and sentences with their times [s]."""
        messages = sorted(_messages(found, events), key=lambda m: m[0])
        if messages and self._shift_ns is None:
            self._shift_ns = -min(0, messages[0][0])  # a time stamp of MCAP has no sign
        for time_ns, topic, kind, content in messages:
            time_ns = max(time_ns + (self._shift_ns or 0), 0)
            stamp = {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}
            if kind.endswith("JointState"):
                content = content | {"header": {"stamp": stamp, "frame_id": ""}}
            elif kind.endswith("Log"):
                content = content | {"stamp": stamp}
            self._writer.write_message(topic, self._schemas[kind], content, time_ns, time_ns)

    def close(self) -> None:
        """Write the end of the file: it is whole only then."""
        self._writer.finish()


def _messages(found: Sequence[Channel], events: Sequence[tuple[float, str]]) -> Iterator[_Message]:
    joined: dict[tuple[int, str], dict[str, float]] = {}
    for channel in found:
        times_ns = np.rint(channel.time_s * 1e9).astype(np.int64).tolist()
        for time_ns, value in zip(times_ns, channel.values.tolist(), strict=True):
            if topic := _TOPICS.get(channel.name):
                joined.setdefault((time_ns, topic), {})[channel.joint] = value
            else:
                topic = f"/{channel.joint}/{channel.name}"
                yield time_ns, topic, "std_msgs/msg/Float64", {"data": value}
    for (time_ns, topic), values in joined.items():
        state = {"name": [*values], "position": [*values.values()], "velocity": [], "effort": []}
        yield time_ns, topic, "sensor_msgs/msg/JointState", state
    for time_s, text in events:
        yield (
            round(time_s * 1e9), "/rosout", "rcl_interfaces/msg/Log",
            {"level": _WARN, "name": "guard", "msg": text, "file": "", "function": "", "line": 0},
        )  # fmt: skip
