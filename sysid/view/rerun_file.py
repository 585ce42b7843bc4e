"""A recording as a Rerun file: each channel over time, and the robot in three dimensions.

Channels are scalars under `joints/<joint>/<channel>` on the timeline `time`. The robot is what the
caller gives as `Body`: shapes that do not change, and where each body is over time.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.view.channels import channels, guard_events

Array = NDArray[np.float64]

_NO_TIMES: Array = np.empty(0)


@dataclass(frozen=True)
class Body:
    """A rigid body over time.

    Attributes
    ----------
    name : str
    vertices : ndarray, shape (v, 3)
        Of its surface, in its own frame [m].
    triangles : ndarray of int, shape (t, 3)
        Indices of vertices.
    position : ndarray, shape (n, 3)
        In the world [m].
    quaternion : ndarray, shape (n, 4)
        Attitude as x, y, z, w.
    """

    name: str
    vertices: Array
    triangles: NDArray[np.int64]
    position: Array
    quaternion: Array


def write_rerun(
    recording: Recording,
    path: Path,
    time_s: Array = _NO_TIMES,
    bodies: Sequence[Body] = (),
    force: bool = False,
) -> None:
    """Write a recording as a Rerun file.

    Parameters
    ----------
    recording : Recording
    path : Path
    time_s : ndarray, shape (n,), optional
        Times of the bodies' poses [s].
    bodies : sequence of Body
        The robot; none leaves it out.
    force : bool
        Replace an existing file.

    Raises
    ------
    InputError
        If the library is not installed, the file exists or cannot be written, or trials overlap in
        time.
    """
    refuse_overwrite(path, force)
    try:
        import rerun as rr
    except ImportError:
        raise InputError(
            "Writing a Rerun file needs rerun-sdk: pip install 'pupper-sysid[live]'."
        ) from None
    found = channels(recording)
    stream = rr.RecordingStream("pupper-sysid", recording_id=recording.sha256)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        os.close(handle)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error
    try:
        stream.save(temporary)
        for channel in found:
            rr.send_columns(
                f"joints/{channel.joint}/{channel.name}",
                indexes=[rr.TimeColumn("time", duration=_nanoseconds(channel.time_s))],
                columns=rr.Scalars.columns(scalars=channel.values), recording=stream,
            )  # fmt: skip
        last_s = max(channel.time_s[-1] for channel in found)
        events = guard_events(recording, last_s)
        if events:
            times = np.array([at for at, _ in events])
            texts = [text for _, text in events]
            rr.send_columns(
                "guard", indexes=[rr.TimeColumn("time", duration=_nanoseconds(times))],
                columns=rr.TextLog.columns(text=texts, level=["WARN"] * len(texts)),
                recording=stream,
            )  # fmt: skip
        for body in bodies:
            place = f"robot/{body.name}"
            shape = rr.Mesh3D(vertex_positions=body.vertices, triangle_indices=body.triangles)
            stream.log(place, shape, static=True)
            rr.send_columns(
                place, indexes=[rr.TimeColumn("time", duration=_nanoseconds(time_s))],
                columns=rr.Transform3D.columns(
                    translation=body.position, quaternion=body.quaternion
                ), recording=stream,
            )  # fmt: skip
        stream.flush()
        stream.disconnect()
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(temporary)


def _nanoseconds(time_s: Array) -> NDArray[np.timedelta64]:
    return np.rint(time_s * 1e9).astype("timedelta64[ns]")
