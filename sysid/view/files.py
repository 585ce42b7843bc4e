"""A recording as a file for Rerun, or as MCAP for Foxglove and rosbag2: each channel over time.

For Rerun channels are scalars under `joints/<joint>/<channel>` on the timeline `time`. The robot is
what the caller gives as `Body`: shapes that do not change, and where each body is over time.

In MCAP `/joint_states` and `/joint_commands` are `sensor_msgs/JointState`, so that `pupper-sysid
import` reads the file back; every other channel is a topic of `std_msgs/Float64` of its own
(`/LF_hip/reading_age_s`), and sentences on the guard are `rcl_interfaces/Log` on `/rosout`.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, replacing, write_bytes
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.view.channels import Channel, channels, guard_events

Array = NDArray[np.float64]

_NO_TIMES: Array = np.empty(0)


@dataclass(frozen=True)
class Body:
    """A rigid body over time."""

    name: str
    vertices: Array
    """Of its surface, in its own frame [m], shape (v, 3)."""
    triangles: NDArray[np.int64]
    """Indices of vertices, shape (t, 3)."""
    position: Array
    """In the world [m], shape (n, 3)."""
    quaternion: Array
    """Attitude as x, y, z, w, shape (n, 4)."""


def write_rerun(
    recording: Recording,
    path: Path,
    time_s: Array = _NO_TIMES,
    bodies: Sequence[Body] = (),
    force: bool = False,
) -> None:
    """Write a recording as a Rerun file, with the robot's `bodies` at times `time_s` [s]."""
    refuse_overwrite(path, force)
    stream = RerunStream(recording.sha256)
    found = channels(recording)
    with replacing(path, force) as temporary:
        stream.save(temporary)
        last_s = max(channel.time_s[-1] for channel in found)
        stream.add(found, guard_events(recording, last_s))
        stream.show(bodies)
        stream.move(time_s, bodies)
        stream.close()


class RerunStream:
    """Channels and a robot for Rerun, in a file or in a viewer.

    `name` is another one for every recording: a viewer joins those of one name.
    """

    def __init__(self, name: str):
        try:
            import rerun
        except ImportError:
            raise InputError(
                "Writing for Rerun needs rerun-sdk: pip install 'pupper-sysid[live]'."
            ) from None
        self._rr = rerun
        self._stream = rerun.RecordingStream("pupper-sysid", recording_id=name)

    def save(self, path: Path) -> None:
        """Send everything to a file, which is replaced."""
        self._stream.save(path)

    def connect(self, url: str) -> None:
        """Send everything to a viewer, such as `rerun+http://127.0.0.1:9876/proxy`."""
        try:
            self._stream.connect_grpc(url)
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{url} is no address of a Rerun viewer: {error}.") from error

    def add(self, found: Sequence[Channel], events: Sequence[tuple[float, str]] = ()) -> None:
        """Write what follows: channels, and sentences with their times [s]."""
        rr = self._rr
        for channel in found:
            self._send(
                f"joints/{channel.joint}/{channel.name}", channel.time_s,
                rr.Scalars.columns(scalars=channel.values),
            )  # fmt: skip
        if events:
            texts = [text for _, text in events]
            columns = rr.TextLog.columns(text=texts, level=["WARN"] * len(texts))
            self._send("guard", np.array([at for at, _ in events]), columns)

    def show(self, bodies: Sequence[Body]) -> None:
        """Write the shapes of bodies."""
        for body in bodies:
            shape = self._rr.Mesh3D(vertex_positions=body.vertices, triangle_indices=body.triangles)
            self._stream.log(f"robot/{body.name}", shape, static=True)

    def move(self, time_s: Array, bodies: Sequence[Body]) -> None:
        """Write where bodies were at times [s], shape (n,)."""
        for body in bodies:
            columns = self._rr.Transform3D.columns(
                translation=body.position, quaternion=body.quaternion
            )
            self._send(f"robot/{body.name}", time_s, columns)

    def close(self, within_s: float | None = None) -> None:
        """Send the rest and end; a viewer is waited for by at most `within_s` [s]."""
        try:
            self._stream.flush(**({} if within_s is None else {"timeout_sec": within_s}))
        except (RuntimeError, ValueError) as error:
            raise InputError(f"Rerun did not take everything: {error}.") from error
        finally:
            self._stream.disconnect()

    def _send(self, place: str, time_s: Array, columns: Any) -> None:
        index = self._rr.TimeColumn(
            "time", duration=np.rint(time_s * 1e9).astype("timedelta64[ns]")
        )
        self._rr.send_columns(place, indexes=[index], columns=columns, recording=self._stream)


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

_Message = tuple[int, str, str, dict[str, Any]]  # time [ns], topic, type and content


def write_mcap(recording: Recording, path: Path, force: bool = False) -> None:
    """Write a recording as MCAP."""
    refuse_overwrite(path, force)
    file = io.BytesIO()
    stream = McapStream(file)
    found = channels(recording)
    stream.add(found, guard_events(recording, max(channel.time_s[-1] for channel in found)))
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
