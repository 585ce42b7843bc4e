"""The clock of a bus of real servos."""

from __future__ import annotations

import time


class HostClock:
    """The host's monotonic clock, from 0 at construction, to the microsecond."""

    def __init__(self):
        self._start = time.monotonic()

    def now(self) -> float:
        """Time [s], from 0 at construction."""
        return self.at(time.monotonic())

    def at(self, monotonic_s: float) -> float:
        """Time of this clock at a time of `time.monotonic()` [s]; NaN for NaN."""
        return round(monotonic_s - self._start, 6)

    def sleep_until(self, time_s: float) -> None:
        """Sleep until `now()` has reached `time_s`."""
        while (left := time_s - self.now()) > 0:
            time.sleep(left)
