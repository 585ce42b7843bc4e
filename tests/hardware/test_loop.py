"""The loop keeps its rate, says when it does not, and gives up when it cannot."""

import os

import numpy as np
import pytest

from pupper_sysid.hardware.loop import FixedRateLoop, real_time_priority
from support.refusals import assert_each_refused
from support.virtual_time import VirtualTime


def test_ticks_come_at_multiples_of_the_period_whatever_the_work_takes():
    clock, starts = VirtualTime(), []
    loop = FixedRateLoop(clock, 0.02)
    for elapsed in loop.ticks(1.0):
        starts.append(elapsed)
        clock.time += 0.013
    np.testing.assert_allclose(starts, 0.02 * np.arange(50), atol=1e-12)
    assert loop.summary()["missed_deadlines"] == 0
    assert loop.summary()["jitter_p99_s"] == pytest.approx(0.0, abs=1e-9)


def test_slow_ticks_are_counted_the_schedule_does_not_drift_and_none_in_a_row_end_it():
    clock, starts = VirtualTime(), []
    loop = FixedRateLoop(clock, 0.02)
    for tick, elapsed in enumerate(loop.ticks(10.0)):
        starts.append(elapsed)
        clock.time += 0.05 if tick % 3 == 0 else 0.001
    # tick 3 runs from 80 to 130 ms: it takes the places of two others, the next starts late,
    # and the one after that is back on the grid
    assert loop.missed_deadlines == len(starts[::3]) > 50
    np.testing.assert_allclose(starts[3:6], [0.08, 0.13, 0.14])


def test_a_period_that_is_none_is_refused():
    assert_each_refused(
        [(period, "loop_period_s") for period in (0.0, -1.0, float("nan"), float("inf"))],
        lambda period: FixedRateLoop(VirtualTime(), period),
    )


def test_asking_for_priority_says_what_came_of_it_and_gives_it_back(monkeypatch):
    asked = []
    monkeypatch.setattr("os.sched_setscheduler", lambda pid, policy, _: asked.append(policy))
    before = os.sched_getscheduler(0)
    with real_time_priority() as said:
        assert said.startswith("real-time") and asked[0] & os.SCHED_FIFO
    assert asked[1:] == [before]

    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr("os.sched_setscheduler", refuse)
    with real_time_priority() as said:
        assert "not allowed" in said
