"""A control loop at a fixed rate that does not drift, its clock, and gentle motions between poses.

    loop = FixedRateLoop(bus, period_s=0.02)
    for elapsed_s in loop.ticks(duration_s=5.0):
        ...

Tick `k` is due `k` periods after the start; a tick that cannot start in time is left out and
counted. `TimeSpent` accounts for the time of each tick, so that a loop that must stop names what
made it late. `real_time_priority` asks the system to run this process first.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError, InputError, SafetyStop
from pupper_sysid.hardware.bus import ServoBus


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
        while (remaining_s := time_s - self.now()) > 0:
            time.sleep(remaining_s)


_SHORTEST_S, _LONGEST_S, _STEP = 1e-7, 1e3, 0.01
_BINS = math.ceil(math.log(_LONGEST_S / _SHORTEST_S) / _STEP)


class Durations:
    """Count, mean, standard deviation, largest and quantiles of durations [s].

    Mean and deviation are exact (Welford), quantiles within 1 %: they come from a histogram with
    logarithmic bins from 0.1 µs to 1000 s.
    """

    def __init__(self):
        self.count, self.mean_s, self.largest_s = 0, 0.0, 0.0
        self._squares = 0.0
        self._bins = np.zeros(_BINS, np.int64)

    def add(self, seconds: float) -> None:
        """Add one duration [s], ≥ 0."""
        self.count += 1
        away = seconds - self.mean_s
        self.mean_s += away / self.count
        self._squares += away * (seconds - self.mean_s)
        self.largest_s = max(self.largest_s, seconds)
        place = math.log(max(seconds, _SHORTEST_S) / _SHORTEST_S) / _STEP
        self._bins[min(int(place), _BINS - 1)] += 1

    @property
    def sd_s(self) -> float:
        """Standard deviation [s]; 0 for a single duration."""
        return math.sqrt(self._squares / max(self.count, 1))

    def quantile(self, share: float) -> float:
        """Duration [s] that `share` of them stay below; NaN without any."""
        if not self.count:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), share * self.count))
        return min(_SHORTEST_S * math.exp(_STEP * (place + 0.5)), self.largest_s)


MOST_MISSES_IN_A_ROW = 10
"""So many missed deadlines in a row mean that the robot is out of control."""


BUS, IMU, POLICY, LOG, VIEWS, GUARD = "bus", "imu", "policy", "log", "views", "guard"
"""What the time of a tick is spent on; the rest is the host's."""

_HOST = ""
_BUSY = "this host is too slow or too busy. Stop other programs, or use a lower rate."
_LATE = {
    BUS: (
        "waiting for the bus",
        "the bus answers late. Check its cable, its baud rate and power, and that no other program "
        "uses it; or use a lower rate.",
    ),
    IMU: (
        "waiting for the IMU",
        "the IMU answers late. Check its cable, and that no other program uses it; or use a lower "
        "rate.",
    ),
    POLICY: (
        "the policy",
        "the policy takes too long on this host. Use a smaller network, stop other programs, or "
        "use a lower rate.",
    ),
    LOG: (
        "writing the log",
        "the disk takes the log too slowly. Write to another disk, or stop the programs that "
        "write to this one.",
    ),
    VIEWS: (
        "views and checks of the tick",
        "what is shown takes too long. Leave the live views out, or stop other programs.",
    ),
    GUARD: ("the guard", _BUSY),
    _HOST: ("the rest of the loop", _BUSY),
}
"""What a late loop was busy with, and the cause with its cure."""
_WORTH_NAMING = 0.05  # share of the time from which a part is named beside the largest


class TimeSpent:
    """Time of a loop's ticks, by what it was spent on, in `total_s`.

    Time within an inner block counts for that one only.

    Examples
    --------
    >>> clock = iter([0.0, 1.0, 4.0, 5.0])
    >>> spent = TimeSpent(lambda: next(clock))
    >>> with spent.on(GUARD), spent.on(BUS):
    ...     pass
    >>> spent.total_s
    {'bus': 3.0, 'guard': 2.0}
    """

    def __init__(self, now: Callable[[], float]):
        self._now, self._inner_s = now, 0.0
        self.total_s: dict[str, float] = {}

    @contextmanager
    def on(self, what: str) -> Iterator[None]:
        """Count the block's time for `what`."""
        begun, outer_s = self._now(), self._inner_s
        self._inner_s = 0.0
        try:
            yield
        finally:
            took = self._now() - begun
            self.total_s[what] = self.total_s.get(what, 0.0) + took - self._inner_s
            self._inner_s = outer_s + took


@dataclass
class FixedRateLoop:
    """Ticks at a fixed rate."""

    timed: ServoBus
    """Its clock is used, and its `spent`, a `TimeSpent`, if it has one, as a `GuardedBus` has."""
    period_s: float
    most_misses: int = MOST_MISSES_IN_A_ROW
    """Missed deadlines in a row after which the loop stops."""
    ticks_done: int = 0
    missed_deadlines: int = 0
    """Ticks left out because the one before took too long."""
    periods: Durations = field(default_factory=Durations)
    jitter: Durations = field(default_factory=Durations)
    """`periods` and `jitter`: time from one tick to the next, and its distance from `period_s`."""

    def __post_init__(self):
        if not (np.isfinite(self.period_s) and self.period_s > 0):
            raise InputError(f"loop_period_s is {self.period_s}; it must be a positive number.")
        self.spent: TimeSpent = getattr(self.timed, "spent", None) or TimeSpent(self.timed.now)

    def ticks(self, duration_s: float) -> Iterator[float]:
        """Seconds since the first tick, at every tick for `duration_s`."""
        timed, start, tick, late = self.timed, self.timed.now(), 0, 0
        before, in_time_s, spent_s = None, start, {}
        while tick * self.period_s < duration_s:
            timed.sleep_until(start + tick * self.period_s)
            began = timed.now()
            if before is not None:
                self.periods.add(began - before)
                self.jitter.add(abs(began - before - self.period_s))
            before = began
            if not late:
                in_time_s, spent_s = began, dict(self.spent.total_s)
            yield began - start
            self.ticks_done += 1
            due = int((timed.now() - start) / self.period_s)
            missed = max(due - tick - 1, 0)
            self.missed_deadlines += missed
            late = late + missed if missed else 0
            if late >= self.most_misses:
                raise SafetyStop(
                    f"the loop missed {late} deadlines of {1e3 * self.period_s:.1f} ms in a row: "
                    + self._culprit(timed.now() - in_time_s, spent_s)
                )
            tick = max(tick + 1, due)

    def _culprit(self, late_s: float, before_s: dict[str, float]) -> str:
        """What took most of the last `late_s`, with the cure; `before_s` was spent before them."""
        spent_s = {k: v - before_s.get(k, 0.0) for k, v in self.spent.total_s.items()}
        spent_s[_HOST] = late_s - sum(spent_s.values())
        largest = max(spent_s, key=lambda k: spent_s[k])
        shares = [
            f"{1e3 * spent_s[k]:.0f} ms {_LATE[k][0]}"
            for k in sorted(spent_s, key=lambda k: -spent_s[k])
            if k == largest or spent_s[k] > _WORTH_NAMING * late_s
        ]
        return f"{_LATE[largest][1][:-1]} ({1e3 * late_s:.0f} ms went by: {', '.join(shares)})."

    def summary(self) -> dict[str, float]:
        """Statistics for the recording's footer."""
        counts = {
            "period_s": self.period_s, "ticks": self.ticks_done,
            "missed_deadlines": self.missed_deadlines,
        }  # fmt: skip
        if not self.periods.count:
            return counts
        return counts | {
            "mean_period_s": round(self.periods.mean_s, 7),
            "sd_period_s": round(self.periods.sd_s, 7),
            "longest_period_s": round(self.periods.largest_s, 7),
            "jitter_p99_s": round(self.jitter.quantile(0.99), 7),
        }


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


GENTLE_RAD_S = 1.0
"""Highest speed of a joint in a gentle motion."""

_FIRST_READING_S = 2.0


def raised_cosine(share: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Ramp from 0 to 1 over `share` 0 to 1 of a motion's time, at rest at both ends."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(share, 0.0, 1.0))


def minimum_jerk(share: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Quintic ramp from 0 to 1 over `share` 0 to 1: at rest, unaccelerated, at both ends.

    Examples
    --------
    >>> minimum_jerk(np.array([0.0, 0.5, 2.0])).tolist()
    [0.0, 0.5, 1.0]
    """
    s = np.clip(share, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def first_pose(bus: ServoBus, period_s: float) -> NDArray[np.float64]:
    """Pose of the robot, shape (joints,) [rad]; waits up to 2 s for the first readings."""
    until = bus.now() + _FIRST_READING_S
    pose = np.full(len(bus.joint_names), np.nan)
    while True:
        reading = bus.read().position_rad
        pose = np.where(np.isfinite(reading), reading, pose)
        if np.isfinite(pose).all():
            return pose
        if bus.now() >= until:
            silent = [n for n, x in zip(bus.joint_names, pose, strict=True) if np.isnan(x)]
            raise BusError(
                f"the bus {bus.name} gives no position of {', '.join(silent)}. Check that the "
                "robot is on and its servos connected, then try again."
            )
        bus.sleep_until(bus.now() + period_s)


def glide(
    loop: FixedRateLoop,
    send: Callable[[NDArray[np.float64]], object],
    origin: NDArray[np.float64],
    goal: NDArray[np.float64],
    least_s: float,
) -> None:
    """Move from `origin` to `goal` [rad], shape (joints,), on a raised cosine.

    `send` takes the pose of each tick. It takes `least_s`, or longer where `GENTLE_RAD_S`
    requires it.
    """
    way = goal - origin
    farthest = float(np.max(np.abs(way)))
    if farthest == 0:
        return
    # the fastest point of a raised cosine is π/2 times its mean speed
    duration = max(least_s, 0.5 * np.pi * farthest / GENTLE_RAD_S)
    for elapsed in loop.ticks(duration):
        send(origin + raised_cosine(elapsed / duration) * way)
    send(goal)
