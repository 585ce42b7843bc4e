"""A recording as channels over time, joint by joint, as a file for Rerun or as MCAP.

Commands stand at their send time, everything that was read at its read time; nothing is resampled
and nothing interpolated. `reading_age_s` is 0 where a reading is fresh; where it is stale it is the
time since the last fresh one was read, and NaN before the first.

The ticks of a running loop become the same channels, part by part, for all joints of the bus.

For Rerun channels are scalars under `joints/<joint>/<channel>` on the timeline `time`. The robot is
what the caller gives as `Body`: shapes that do not change, and where each body is over time.

In MCAP `/joint_states` and `/joint_commands` are `sensor_msgs/JointState`, so that `pupper-sysid
import` reads the file back; every other channel is a topic of `std_msgs/Float64` of its own
(`/LF_hip/reading_age_s`), and sentences on the guard are `rcl_interfaces/Log` on `/rosout`.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, replacing, write_bytes
from pupper_sysid.common.joints import in_order
from pupper_sysid.hardware.bus import BusSample, Sent
from pupper_sysid.sysid.feedback.staleness import fresh_rows
from pupper_sysid.sysid.recordings.recording import Recording

Array = NDArray[np.float64]

READ = ("voltage_v", "temperature_c", "load")  # channels that some buses have

_GUARD = {"clipped": "held at the limits", "slowed": "delayed by the speed limit", "unsent": "lost"}


@dataclass(frozen=True)
class Channel:
    """One quantity of one joint."""

    joint: str
    name: str
    time_s: Array
    """Not decreasing [s], shape (n,)."""
    values: Array
    """Shape (n,)."""


def channels(recording: Recording) -> list[Channel]:
    """All channels of a recording, joint by joint."""
    series = []
    for joint in in_order(list(recording.table["joint"].unique())):
        rows = recording.table.loc[recording.table["joint"] == joint]
        rows = rows.iloc[np.lexsort([rows["send_time_s"], rows["trial"]])]
        sent, read = (rows[c].to_numpy(float) for c in ("send_time_s", "read_time_s"))
        if (np.diff(sent) < 0).any() or (np.diff(read) < 0).any():
            raise InputError(
                f"{recording.name}, {joint}: its trials overlap in time, and a viewer has one time "
                "axis. View a recording whose times go on from trial to trial."
            )
        series.append(Channel(joint, "command_rad", sent, rows["command_rad"].to_numpy(float)))
        series.append(Channel(joint, "position_rad", read, rows["position_rad"].to_numpy(float)))
        series.append(Channel(joint, "reading_age_s", read, _ages(recording, joint)))
        for name in READ:
            values = rows[name].to_numpy(float) if name in rows else np.array([])
            if np.isfinite(values).any():
                series.append(Channel(joint, name, read, values))
    return series


def guard_events(recording: Recording, last_s: float) -> list[tuple[float, str]]:
    """Times [s] of commands that the guard changed, and what it did; a recording's footer has them.

    The numbers of all of them, which may be more, are given at `last_s`.
    """
    footer = recording.metadata.get("completed") or {}
    counts, events = footer.get("guard") or {}, footer.get("guard_events") or []
    changed = []
    for event in events if isinstance(events, list) else []:
        time_s, kind = event if isinstance(event, list) and len(event) == 2 else (None, None)
        if isinstance(time_s, int | float) and np.isfinite(time_s) and kind in _GUARD:
            changed.append((float(time_s), guard_text(kind)))
    return changed + [(last_s, text) for text in guard_counts(counts)]


def guard_text(kind: str) -> str:
    """Sentence on one command that the guard changed: `clipped`, `slowed` or `unsent`."""
    return f"Guard: a command {_GUARD[kind]}."


def guard_counts(counts: Mapping[str, int]) -> list[str]:
    """Sentences on all commands that the guard changed, by kind."""
    return [f"Guard: {counts[k]} commands {text}." for k, text in _GUARD.items() if counts.get(k)]


def poses(recording: Recording, rate_hz: float) -> tuple[Array, dict[str, Array]]:
    """Times of readings [s], at most `rate_hz` a second, and the latest readings [rad].

    They are by joint; before its first reading its start pose.
    """
    every = np.unique(recording.table["read_time_s"].to_numpy(float))
    time_s = every[np.unique(np.floor((every - every[0]) * rate_hz), return_index=True)[1]]
    held = {}
    for joint in recording.joints:
        trials = recording.trials(joint)
        read = np.concatenate([t.read_time_s for t in trials])
        position = np.concatenate([t.position_rad for t in trials])
        here = np.isfinite(position)
        read, position = read[here], position[here]
        last = np.searchsorted(read, time_s, side="right")
        held[joint] = np.concatenate([[trials[0].initial_command_rad], position])[last]
    return time_s, held


def _ages(recording: Recording, joint: str) -> Array:
    """Time since the last fresh reading at every row of a joint."""
    parts = []
    for trial in recording.trials(joint):
        at = np.full(len(trial.read_time_s), -1)
        fresh = fresh_rows(trial)
        at[fresh] = fresh
        at = np.maximum.accumulate(at)
        age = trial.read_time_s - trial.read_time_s[at]
        age[(at < 0) | ~np.isfinite(trial.position_rad)] = np.nan
        parts.append(age)
    return np.concatenate(parts)


_HEAD = 5  # stretch, send time, direction of gravity
_ROWS = ("command_rad", "read_time_s", "position_rad", *READ)
_SAME_RAD = 1e-6  # recordings have as many digits; angles behind a linkage are converted
_LEVEL = np.full(3, np.nan)


def packed(stretch: int, sent: Sent, reading: BusSample, gravity: Array = _LEVEL) -> Array:
    """One tick as a row of numbers, shape (5 + 6 * joints,).

    `stretch` is another number wherever readings before this one were not seen: only within a
    stretch can a repeated value be stale. What was sent is NaN where no command is known;
    `gravity`, shape (3,), is its direction in the trunk's frame, NaN where it was not measured.
    """
    nothing = np.full(len(reading.position_rad), np.nan)
    optional = (getattr(reading, name) for name in READ)
    rows = [sent.position_rad, reading.time_s, reading.position_rad]
    rows += [nothing if values is None else values for values in optional]
    return np.concatenate([[stretch, sent.time_s], gravity, *rows], dtype=float)


class TickChannels:
    """Channels of ticks that come in parts, as rows of `packed`.

    `live` says whether every reading is the servo's present position, and so fresh.
    """

    def __init__(self, joints: Sequence[str], live: bool):
        self._joints, self._live = tuple(joints), live
        self._stretch = np.nan
        self._last, self._fresh_s, self._held = np.full((3, len(joints)), np.nan)

    def take(self, rows: Array) -> list[Channel]:
        """Channels of the next ticks; those without a value are left out."""
        values = self._values(rows)
        age = self._ages(rows[:, 0], values["read_time_s"], values["position_rad"])
        sent = rows[:, 1]
        series = []
        for k, joint in enumerate(self._joints):
            read = values["read_time_s"][:, k]
            parts = {"position_rad": values["position_rad"][:, k], "reading_age_s": age[:, k]}
            columns = [(name, read, value, np.isfinite(read)) for name, value in parts.items()]
            command = values["command_rad"][:, k]
            columns.insert(
                0, ("command_rad", sent, command, np.isfinite(sent) & np.isfinite(command))
            )
            for name in READ:
                value = values[name][:, k]
                columns.append((name, read, value, np.isfinite(read) & np.isfinite(value)))
            series += [
                Channel(joint, n, t[here], v[here]) for n, t, v, here in columns if here.any()
            ]
        return series

    def poses(self, rows: Array) -> tuple[Array, Array, Array]:
        """Latest reading of each joint at each tick, held; NaN before the first.

        Returns the latest read of each tick [s], shape (n,), positions [rad], shape (n, joints),
        and gravity, shape (n, 3).
        """
        values = self._values(rows)
        position = np.concatenate([self._held[None], values["position_rad"]])
        at = np.where(np.isfinite(position), np.arange(len(position))[:, None], 0)
        held = np.take_along_axis(position, np.maximum.accumulate(at), axis=0)[1:]
        self._held = held[-1]
        return values["read_time_s"].max(axis=1), held, rows[:, 2:_HEAD]

    def _values(self, rows: Array) -> dict[str, Array]:
        values = rows[:, _HEAD:].reshape(len(rows), len(_ROWS), -1).transpose(1, 0, 2)
        return dict(zip(_ROWS, values, strict=True))

    def _ages(self, stretches: Array, read_s: Array, position: Array) -> Array:
        """Time since the last fresh reading; 0 where it is fresh, NaN before the first."""
        ages = np.full(position.shape, np.nan)
        for k, (stretch, now, here) in enumerate(zip(stretches, read_s, position, strict=True)):
            if stretch != self._stretch:
                self._stretch = stretch
                self._last, self._fresh_s = np.full((2, len(self._joints)), np.nan)
            known = np.isfinite(here)
            fresh = known & (self._live | (np.abs(here - self._last) > _SAME_RAD))  # NaN is not
            self._fresh_s = np.where(fresh, now, self._fresh_s)
            self._last = np.where(known, here, self._last)
            ages[k] = np.where(known, now - self._fresh_s, np.nan)
        return ages


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
    series = channels(recording)
    with replacing(path, force) as temporary:
        stream.save(temporary)
        last_s = max(channel.time_s[-1] for channel in series)
        stream.add(series, guard_events(recording, last_s))
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

    def add(self, series: Sequence[Channel], events: Sequence[tuple[float, str]] = ()) -> None:
        """Write what follows: channels, and sentences with their times [s]."""
        rr = self._rr
        for channel in series:
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
    series = channels(recording)
    stream.add(series, guard_events(recording, max(channel.time_s[-1] for channel in series)))
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

    def add(self, series: Sequence[Channel], events: Sequence[tuple[float, str]] = ()) -> None:
        """Write what follows: channels, and sentences with their times [s]."""
        messages = sorted(_messages(series, events), key=lambda m: m[0])
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


def _messages(series: Sequence[Channel], events: Sequence[tuple[float, str]]) -> Iterator[_Message]:
    joined: dict[tuple[int, str], dict[str, float]] = {}
    for channel in series:
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
