"""Clocks of emulated buses: virtual time, or the host's own.

Both start at 0 and count seconds to the microsecond. In virtual time a sleep costs nothing and ends
a little late, as on a real host; in real time it really sleeps.
"""

from __future__ import annotations

import time

import numpy as np

from pupper_sysid.hardware.loop import HostClock


class VirtualClock:
    """Time that passes only in sleeps and exchanges with the bus.

    Parameters
    ----------
    overshoot_s : float
        Mean of the exponential time by which a sleep ends late [s].
    rng : numpy.random.Generator
    """

    def __init__(self, overshoot_s: float, rng: np.random.Generator):
        self._now, self._overshoot, self._rng = 0.0, overshoot_s, rng

    def now(self) -> float:
        """Time [s], to the microsecond."""
        return round(self._now, 6)

    def sleep_until(self, time_s: float) -> None:
        """Jump to `time_s` and a little further."""
        if time_s > self._now:
            self._now = time_s + self._overshoot * self._rng.exponential()

    def spend(self, duration_s: float) -> None:
        """Let `duration_s` pass, give or take a fifth."""
        self._now += duration_s * self._rng.uniform(0.8, 1.2)


class RealClock(HostClock):
    """The host's own clock; exchanges take real time."""

    def spend(self, duration_s: float) -> None:
        """Sleep for `duration_s`."""
        time.sleep(duration_s)
