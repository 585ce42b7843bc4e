"""Ticks of a running loop as the channels of a recording, part by part.

They are those that `sysid.view.channels` finds in the recording of the same loop, of all joints of
the bus.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.bus import BusSample, Sent
from pupper_sysid.sysid.view.channels import READ, Channel

Array = NDArray[np.float64]

_HEAD = 5  # stretch, send time, direction of gravity
_ROWS = ("command_rad", "read_time_s", "position_rad", *READ)
_SAME_RAD = 1e-6  # recordings have as many digits; angles behind a linkage are converted
_LEVEL = np.full(3, np.nan)


def packed(stretch: int, sent: Sent, reading: BusSample, gravity: Array = _LEVEL) -> Array:
    """One tick as a row of numbers.

    Parameters
    ----------
    stretch : int
        Another number wherever readings before this one were not seen: only within a stretch can a
        repeated value be stale.
    sent : Sent
        NaN where no command is known.
    reading : BusSample
    gravity : ndarray, shape (3,), optional
        Its direction in the trunk's frame; NaN where it was not measured.

    Returns
    -------
    ndarray, shape (5 + 6 * joints,)
    """
    nothing = np.full(len(reading.position_rad), np.nan)
    optional = (getattr(reading, name) for name in READ)
    rows = [sent.position_rad, reading.time_s, reading.position_rad]
    rows += [nothing if values is None else values for values in optional]
    return np.concatenate([[stretch, sent.time_s], gravity, *rows], dtype=float)


class TickChannels:
    """Channels of ticks that come in parts.

    Parameters
    ----------
    joints : sequence of str
    live : bool
        Whether every reading is the servo's present position, and so fresh.
    """

    def __init__(self, joints: Sequence[str], live: bool):
        self._joints, self._live = tuple(joints), live
        self._stretch = np.nan
        self._last, self._fresh_s, self._held = np.full((3, len(joints)), np.nan)

    def take(self, rows: Array) -> list[Channel]:
        """Channels of the next ticks; those without a value are left out.

        Parameters
        ----------
        rows : ndarray, shape (n, 5 + 6 * joints)
            As of `packed`.
        """
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

        Parameters
        ----------
        rows : ndarray, shape (n, 5 + 6 * joints)
            As of `packed`.

        Returns
        -------
        time_s : ndarray, shape (n,)
            Latest read of each tick [s].
        position_rad : ndarray, shape (n, joints)
        gravity : ndarray, shape (n, 3)
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
