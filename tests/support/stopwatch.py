"""Time that a program takes on its own account, however busy the machine is."""

import os
import time
from collections.abc import Callable
from pathlib import Path


class Stopwatch:
    """Seconds since its start, but for those in which others had the processor.

    Linux counts for each thread how long it was ready to run and did not (`schedstat`). These
    times of this process and of the named ones are taken off; elsewhere nothing is.

    Parameters
    ----------
    *processes : int
        Whose work is timed, besides this one.
    """

    def __init__(self, *processes: int):
        self._processes = (os.getpid(), *processes)
        self._delays: dict[Path, int] = {}
        self._began, self._start = time.monotonic(), self._now()

    def seconds(self) -> float:
        """Time [s]; called while the processes live, for what they waited is lost with them."""
        return self._now() - self._start

    def waited_s(self) -> float:
        """Part of the time since the start that `seconds` leaves out [s]."""
        return time.monotonic() - self._began - self.seconds()

    def _now(self) -> float:
        for process in self._processes:
            for thread in Path(f"/proc/{process}/task").glob("*/schedstat"):
                try:
                    self._delays[thread] = int(thread.read_text().split()[1])
                except (OSError, IndexError):  # it has just ended
                    continue
        return time.monotonic() - 1e-9 * sum(self._delays.values())


def wait_until(true: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether it became true in time; the limit is for machines that do other work."""
    until = time.monotonic() + seconds
    while not true():
        if time.monotonic() > until:
            return False
        time.sleep(0.005)
    return True
