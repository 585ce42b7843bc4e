"""A control loop at a fixed rate that does not drift, with statistics of its timing.

    loop = FixedRateLoop(bus, period_s=0.02)
    for elapsed_s in loop.ticks(duration_s=5.0):
        ...

Tick `k` is due `k` periods after the start; a tick that cannot start in time is left out and
counted. `real_time_priority` asks the system to run this process first.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from pupper_sysid.common.durations import Durations
from pupper_sysid.common.errors import InputError, SafetyStop

MOST_MISSES_IN_A_ROW = 10
"""So many missed deadlines in a row mean that the robot is out of control."""


class Timed(Protocol):
    """A clock that a loop can wait for."""

    def now(self) -> float:
        """Time [s]."""
        ...

    def sleep_until(self, time_s: float) -> None:
        """Return when `now()` has reached `time_s`."""
        ...


@dataclass
class FixedRateLoop:
    """Ticks at a fixed rate.

    Attributes
    ----------
    timed : Timed
    period_s : float
    most_misses : int
        Missed deadlines in a row after which the loop stops.
    ticks_done : int
    missed_deadlines : int
        Ticks left out because the one before took too long.
    periods, jitter : Durations
        Time from one tick to the next, and its distance from `period_s`.
    """

    timed: Timed
    period_s: float
    most_misses: int = MOST_MISSES_IN_A_ROW
    ticks_done: int = 0
    missed_deadlines: int = 0
    periods: Durations = field(default_factory=Durations)
    jitter: Durations = field(default_factory=Durations)

    def __post_init__(self):
        if not (np.isfinite(self.period_s) and self.period_s > 0):
            raise InputError(f"loop_period_s is {self.period_s}; it must be a positive number.")

    def ticks(self, duration_s: float) -> Iterator[float]:
        """Seconds since the first tick, at every tick for `duration_s`.

        Raises
        ------
        SafetyStop
            If the loop has missed `most_misses` deadlines in a row.
        """
        timed, start, tick, late = self.timed, self.timed.now(), 0, 0
        before = None
        while tick * self.period_s < duration_s:
            timed.sleep_until(start + tick * self.period_s)
            began = timed.now()
            if before is not None:
                self.periods.add(began - before)
                self.jitter.add(abs(began - before - self.period_s))
            before = began
            yield began - start
            self.ticks_done += 1
            due = int((timed.now() - start) / self.period_s)
            missed = max(due - tick - 1, 0)
            self.missed_deadlines += missed
            late = late + missed if missed else 0
            if late >= self.most_misses:
                raise SafetyStop(
                    f"the loop missed {late} deadlines of {1e3 * self.period_s:.1f} ms in a row: "
                    "this host is too slow or too busy. Stop other programs, or use a lower rate."
                )
            tick = max(tick + 1, due)

    def summary(self) -> dict[str, float]:
        """Statistics for the recording's footer."""
        found = {
            "period_s": self.period_s,
            "ticks": self.ticks_done,
            "missed_deadlines": self.missed_deadlines,
        }
        if self.periods.count:
            found |= {
                "mean_period_s": round(self.periods.mean_s, 7),
                "sd_period_s": round(self.periods.sd_s, 7),
                "longest_period_s": round(self.periods.largest_s, 7),
                "jitter_p99_s": round(self.jitter.quantile(0.99), 7),
            }
        return found


@contextmanager
def real_time_priority() -> Iterator[str]:
    """Real-time scheduling of this process during the block; yields the result in words.

    Child processes are scheduled normally: a busy one would starve the whole machine.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield "normal priority: this system has no real-time scheduling"
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(10))
    except OSError:
        yield "normal priority: real-time scheduling is not allowed to this user"
        return
    try:
        yield "real-time priority (SCHED_FIFO)"
    finally:
        with suppress(OSError):  # an ordinary user may not take the flag back, which does no harm
            os.sched_setscheduler(0, *before)
