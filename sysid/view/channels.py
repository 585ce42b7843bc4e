"""A recording as channels over time: what both viewers show, joint by joint.

Commands stand at their send time, everything that was read at its read time; nothing is resampled
and nothing interpolated. `reading_age_s` is 0 where a reading is fresh; where it is stale it is the
time since the last fresh one was read, and NaN before the first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import in_order
from pupper_sysid.sysid.feedback.rows import fresh_rows
from pupper_sysid.sysid.recordings.recording import Recording

Array = NDArray[np.float64]

READ = ("voltage_v", "temperature_c", "load")
"""Channels that some buses have."""

_GUARD = {"clipped": "held at the limits", "slowed": "delayed by the speed limit", "unsent": "lost"}


@dataclass(frozen=True)
class Channel:
    """One quantity of one joint.

    Attributes
    ----------
    joint, name : str
    time_s : ndarray, shape (n,)
        Not decreasing [s].
    values : ndarray, shape (n,)
    """

    joint: str
    name: str
    time_s: Array
    values: Array


def channels(recording: Recording) -> list[Channel]:
    """All channels of a recording, joint by joint.

    Raises
    ------
    InputError
        If trials of a joint overlap in time: a viewer has one time axis.
    """
    found = []
    for joint in in_order(list(recording.table["joint"].unique())):
        rows = recording.table.loc[recording.table["joint"] == joint]
        rows = rows.iloc[np.lexsort([rows["send_time_s"], rows["trial"]])]
        sent, read = (rows[c].to_numpy(float) for c in ("send_time_s", "read_time_s"))
        if (np.diff(sent) < 0).any() or (np.diff(read) < 0).any():
            raise InputError(
                f"{recording.name}, {joint}: its trials overlap in time, and a viewer has one time "
                "axis. View a recording whose times go on from trial to trial."
            )
        found.append(Channel(joint, "command_rad", sent, rows["command_rad"].to_numpy(float)))
        found.append(Channel(joint, "position_rad", read, rows["position_rad"].to_numpy(float)))
        found.append(Channel(joint, "reading_age_s", read, _ages(recording, joint)))
        for name in READ:
            values = rows[name].to_numpy(float) if name in rows else np.array([])
            if np.isfinite(values).any():
                found.append(Channel(joint, name, read, values))
    return found


def guard_events(recording: Recording, last_s: float) -> list[tuple[float, str]]:
    """Times [s] of commands that the guard changed, and what it did; a recording's footer has them.

    The numbers of all of them, which may be more, are given at `last_s`.
    """
    footer = recording.metadata.get("completed") or {}
    counts, events = footer.get("guard") or {}, footer.get("guard_events") or []
    found = []
    for event in events if isinstance(events, list) else []:
        time_s, kind = event if isinstance(event, list) and len(event) == 2 else (None, None)
        if isinstance(time_s, int | float) and np.isfinite(time_s) and kind in _GUARD:
            found.append((float(time_s), guard_text(kind)))
    return found + [(last_s, text) for text in guard_counts(counts)]


def guard_text(kind: str) -> str:
    """Sentence on one command that the guard changed: `clipped`, `slowed` or `unsent`."""
    return f"Guard: a command {_GUARD[kind]}."


def guard_counts(counts: Mapping[str, int]) -> list[str]:
    """Sentences on all commands that the guard changed, by kind."""
    return [f"Guard: {counts[k]} commands {text}." for k, text in _GUARD.items() if counts.get(k)]


def poses(recording: Recording, rate_hz: float) -> tuple[Array, dict[str, Array]]:
    """Latest reading of each joint, held, at most `rate_hz` times a second.

    Parameters
    ----------
    recording : Recording
    rate_hz : float

    Returns
    -------
    time_s : ndarray, shape (n,)
        Times of readings [s].
    position_rad : dict of joint to ndarray, shape (n,)
        Servo angles; before the first reading of a joint its start pose.
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
