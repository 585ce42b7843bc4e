"""Live readings are dated at their read, polled ones to their poll; doubt is given in numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    find_poll_lattice,
    fresh_rows,
    readings,
)
from pupper_sysid.sysid.feedback.poll_search import Phase, log_likelihood, most_hits
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


def test_live_trials_beside_polled_ones_are_dated_at_their_reads():
    rng = np.random.default_rng(4)
    polled = tone_trials(0.04, rng)
    live = replace(
        tone_trials(0.04, rng, frequencies=(2.0,), period_s=0.0)[0], number=9, readings="live"
    )
    found = find_poll_lattice([*polled, live], rng)
    # a lattice leaves no doubt and means polled
    assert (found.kind, found.readings, found.time_doubt_s) == ("lattice", "polled", 0.0)
    assert 9 not in {p.trial for p in found.phases}
    np.testing.assert_array_equal(readings(live, found).time_s, live.read_time_s)


# ----------------------------------------------------- times of readings on a known lattice

ROWS = np.arange(100)
READ = 0.02 * ROWS + 0.001
MIDDLE = READ - 0.01
"""Between the read before and this one."""


def times(*phases: Phase) -> np.ndarray:
    """Times of readings that change in every row, on these stretches of a lattice."""
    trial = Trial("LF_hip", 0, 1.0, READ - 0.001, READ, 0.01 * ROWS, 0.01 * ROWS, None, 0.0)
    found = readings(trial, PollLattice(kind="lattice", fresh_fraction=1.0, phases=phases))
    assert found.rows[-3:].tolist() == [97, 98, 99]
    full = np.full(len(ROWS), np.nan)
    full[found.rows] = found.time_s
    return full[1:]  # the first row has no read before it


def test_readings_within_a_stretch_are_dated_to_its_instants_and_others_to_the_middle():
    # instants at 0.009 + 0.02 n: 2 ms before the middle
    dated = times(Phase(0, 0.5, 1.0, 0.02, 0.009, 1e-4))
    inside = (READ >= 0.5) & (READ <= 1.0)
    np.testing.assert_allclose(dated, np.where(inside, MIDDLE - 0.002, MIDDLE)[1:], atol=1e-12)


def test_a_reading_without_an_instant_between_two_reads_is_dated_to_the_middle():
    # instants at 0.013, 0.113, 0.213 …: in the rows 1, 6, 11 …, 2 ms after the middle
    dated = times(Phase(0, 0.0, 2.0, 0.1, 0.013, 1e-4))
    polled = ROWS % 5 == 1
    np.testing.assert_allclose(dated, np.where(polled, MIDDLE + 0.002, MIDDLE)[1:], atol=1e-12)


def test_phases_of_another_trial_date_nothing():
    np.testing.assert_allclose(times(Phase(1, 0.0, 2.0, 0.02, 0.009, 1e-4)), MIDDLE[1:])


def test_the_mean_age_is_half_a_poll_and_one_more_for_each_that_is_lost_on_the_way():
    # of polls that fail with 0.5, one is lost before a good one on average
    lattice = PollLattice(kind="lattice", poll_period_s=0.02, loss=0.5, fresh_fraction=0.5)
    assert lattice.mean_age_s == pytest.approx(0.03)


# ----------------------------------------------------- the compiled search


def intervals(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Reads every 19 ms of a bus polled every 26.8 ms, some a little late."""
    end = 0.019 * np.arange(1, 120) + rng.normal(0, 1e-4, 119)
    return end - 0.019, end


def test_hits_are_counted_over_all_phases():
    begin, end = intervals(np.random.default_rng(0))
    periods = np.array([0.0201, 0.0268, 0.0533])
    first = np.floor((begin / periods[:, None] % 1.0) * 64).astype(int)
    span = np.round((end - begin) / periods[:, None] * 64).astype(int)
    phase = np.arange(64)
    inside = (phase[:, None, None] - first) % 64 < np.minimum(span, 64)
    found = most_hits(begin, end, periods, 64)
    np.testing.assert_array_equal(found, inside.sum(axis=2).max(axis=0))


def test_likelihood_is_that_of_intervals_with_blurred_edges():
    rng = np.random.default_rng(1)
    begin, end = intervals(rng)
    periods, phases = np.array([0.0265, 0.0268]), np.linspace(-0.5, 0.5, 16, endpoint=False)
    blur, inside, outside = 0.0025, 0.97, rng.uniform(0.01, 0.03, len(begin))
    away = (0.5 * (begin + end) / periods[:, None])[:, None] - phases[:, None] + 0.5
    distance = np.abs(away % 1.0 - 0.5) * periods[:, None, None]
    share = np.clip((0.5 * (end - begin) - distance) / blur + 0.5, 0.0, 1.0)
    np.testing.assert_allclose(
        log_likelihood(begin, end, periods, phases, blur, inside, outside),
        np.log(inside * share + outside).sum(axis=2), rtol=1e-12,
    )  # fmt: skip
