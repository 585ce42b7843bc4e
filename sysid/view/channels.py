"""A recording as channels over time: what both viewers show, joint by joint.

Commands stand at their send time, everything that was read at its read time; nothing is resampled
and nothing interpolated. `reading_age_s` is 0 where a reading is fresh; where it is stale it is the
time since the last fresh one was read, and NaN before the first.

The ticks of a running loop become the same channels, part by part, for all joints of the bus.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
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
        found = []
        for k, joint in enumerate(self._joints):
            read = values["read_time_s"][:, k]
            parts = {"position_rad": values["position_rad"][:, k], "reading_age_s": age[:, k]}
            made = [(name, read, own, np.isfinite(read)) for name, own in parts.items()]
            command = values["command_rad"][:, k]
            made.insert(0, ("command_rad", sent, command, np.isfinite(sent) & np.isfinite(command)))
            for name in READ:
                own = values[name][:, k]
                made.append((name, read, own, np.isfinite(read) & np.isfinite(own)))
            found += [Channel(joint, n, t[here], v[here]) for n, t, v, here in made if here.any()]
        return found

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
