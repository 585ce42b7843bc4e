"""Live readings are dated at their read, polled ones to their poll; doubt is given in numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, fresh_rows, readings
from pupper_sysid.sysid.recordings.recording import Trial
from support.synthetic import LOOP_S, tone_trials


def test_a_servo_that_sticks_is_not_mistaken_for_a_bus_that_holds():
    rng = np.random.default_rng(0)
    t = 0.02 * np.arange(300)
    move = 0.0015 * np.round(0.1 * np.sin(2 * np.pi * t) / 0.0015)
    # half of the rows repeat the one before
    last = np.maximum.accumulate(np.where(rng.random(300) < 0.5, np.arange(300), 0))
    stuck = move[last]
    stuck[40] = np.nan

    def trial(readings: Literal["live"] | None) -> Trial:
        return Trial("LF_hip", 0, 1.0, t, t + 0.001, move, stuck, None, 0.0, readings)

    assert len(fresh_rows(trial(None))) < 200
    asked = trial("live")
    lattice, rows = (
        find_poll_lattice([asked], np.random.default_rng(0)),
        np.delete(np.arange(300), 40),
    )
    assert lattice.kind == "every read" and fresh_rows(asked).tolist() == rows.tolist()
    # each at the time it was read, not somewhere between two reads
    assert np.allclose(readings(asked, lattice).time_s, asked.read_time_s[rows])


def test_a_header_that_says_polled_outweighs_motion_that_looks_live():
    rng = np.random.default_rng(1)
    trials = tone_trials(0.04, rng, period_s=0.0)
    asked = [replace(t, readings="polled") for t in trials]
    assert find_poll_lattice(trials, rng).readings == "live"
    found = find_poll_lattice(asked, rng)
    # the poll must be faster than the loop of 19 ms: dated to the middle between two reads
    assert (found.kind, found.readings) == ("unresolved", "polled")
    assert found.time_doubt_s == pytest.approx(LOOP_S / 2)


def test_readings_that_cannot_be_told_are_in_doubt_by_half_a_loop():
    rng = np.random.default_rng(2)
    # a second of a slow tone: too few steps for either
    trials = tone_trials(0.04, rng, frequencies=(0.5,), duration_s=1.0, period_s=0.0)
    found = find_poll_lattice(trials, rng)
    assert (found.kind, found.readings) == ("unresolved", "cannot tell")
    assert found.time_doubt_s == pytest.approx(LOOP_S / 2)


def test_a_lattice_leaves_no_doubt_and_means_polled():
    rng = np.random.default_rng(3)
    found = find_poll_lattice(tone_trials(0.04, rng), rng)
    assert (found.kind, found.readings, found.time_doubt_s) == ("lattice", "polled", 0.0)


def test_live_trials_beside_polled_ones_are_dated_at_their_reads():
    rng = np.random.default_rng(4)
    polled = tone_trials(0.04, rng)
    live = replace(
        tone_trials(0.04, rng, frequencies=(2.0,), period_s=0.0)[0], number=9, readings="live"
    )
    found = find_poll_lattice([*polled, live], rng)
    assert found.kind == "lattice" and 9 not in {p.trial for p in found.phases}
    np.testing.assert_array_equal(readings(live, found).time_s, live.read_time_s)
