"""Times of readings on a known lattice, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, readings
from pupper_sysid.sysid.feedback.poll_search import Phase
from pupper_sysid.sysid.recordings.recording import Trial

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
