"""The clock of a bus of real servos, and one for what goes on while the machine is suspended."""

from __future__ import annotations

import time


def lasting_s() -> float:
    """Seconds that also pass while the machine is suspended, as `time.monotonic()`'s do not."""
    if hasattr(time, "CLOCK_BOOTTIME"):  # Linux
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


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
