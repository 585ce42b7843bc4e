"""The host's own clock, by which a bus of real servos lives."""

from __future__ import annotations

import time


class HostClock:
    """The host's monotonic clock, from 0 at construction, to the microsecond."""

    def __init__(self):
        self._start = time.monotonic()

    def now(self) -> float:
        """Time [s]."""
        return self.at(time.monotonic())

    def at(self, monotonic_s: float) -> float:
        """This clock's time of a reading of `time.monotonic()` [s]; NaN of NaN."""
        return round(monotonic_s - self._start, 6)

    def sleep_until(self, time_s: float) -> None:
        """Sleep until `time_s`."""
        while (left := time_s - self.now()) > 0:
            time.sleep(left)
