"""A poll whose phase jumps within a trial: found, placed, and its readings dated again."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, readings, redate
from pupper_sysid.sysid.feedback.poll_search import Stretch
from pupper_sysid.sysid.feedback.slips import NATS, evidence, find_segments
from pupper_sysid.sysid.recordings.recording import Trial

PERIOD, LOOP, LAG, SECONDS = 0.02685, 0.019, 0.05, 3.0


def motion(frequency, start):
    """Position of a joint that follows its tone after a constant lag."""
    return lambda t: 0.3 * np.sin(2 * np.pi * frequency * np.maximum(t - start - LAG, 0.0))


def tone(number, frequency, rng, jumps=()):
    """A trial behind a bus that loses 42 % of its polls; jumps: (time, by how much) [s]."""
    start = 4.0 * number
    polls = np.arange(-1.0, SECONDS, PERIOD) + rng.uniform(0, PERIOD)
    for at, jump in jumps:
        polls = np.where(polls > at, polls + jump, polls)
    polls = polls[(rng.random(len(polls)) > 0.42) | (polls < -0.5)] + start
    send = start + np.arange(0, SECONDS, LOOP)
    read = send + 0.0005
    measured = polls[np.searchsorted(polls, read, "right") - 1]
    shown = 0.0057 * np.round(motion(frequency, start)(measured) / 0.0057)
    command = 0.3 * np.sin(2 * np.pi * frequency * (send - start))
    return Trial("LF_hip", number, frequency, send, read, command, shown, None, 0.0), measured


def sweep(seed, jumps=()):
    """Tones of 1 to 4 Hz, the jumps in the third; also each row's true time and the motions."""
    rng = np.random.default_rng(seed)
    made = [tone(n, f, rng, jumps if n == 2 else ()) for n, f in enumerate((1.0, 2.0, 3.0, 4.0))]
    trials = [t for t, _ in made]
    motions = [motion(t.frequency_hz, t.send_time_s[0]) for t in trials]
    return trials, [m for _, m in made], motions


def date_error(trial, true, lattice):
    """RMS error of the dates of a trial's fresh rows [s]."""
    found = readings(trial, lattice)
    return float(np.sqrt(np.mean((found.time_s - true[found.rows]) ** 2)))


def test_half_a_period_is_found_from_the_times_of_changes_alone():
    trials, true, _ = sweep(0, [(1.4, PERIOD / 2)])
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    (slip,) = lattice.slips
    assert slip.trial == 2 and slip.time_s == pytest.approx(1.4, abs=0.2)
    assert abs(slip.jump_s) == pytest.approx(PERIOD / 2, abs=0.004) and slip.nats > NATS
    assert date_error(trials[2], true[2], lattice) < 0.004


def test_a_quarter_period_is_found_with_the_motion_and_readings_are_dated_again():
    trials, true, motions = sweep(5, [(1.0, PERIOD / 4)])
    alone = find_poll_lattice(trials, np.random.default_rng(0))
    again = redate(trials, alone, motions)
    (slip,) = again.slips
    assert slip.trial == 2 and slip.time_s == pytest.approx(1.0, abs=0.1)
    assert slip.jump_s == pytest.approx(PERIOD / 4, abs=0.0035)
    assert date_error(trials[2], true[2], again) < 0.0015
    # beside it nothing changed
    assert again.poll_period_s == pytest.approx(PERIOD, abs=1e-4)


def test_a_slip_back_and_forth_is_two():
    trials, true, motions = sweep(7, [(0.9, PERIOD / 2), (2.0, PERIOD / 2)])
    again = redate(trials, find_poll_lattice(trials, np.random.default_rng(0)), motions)
    assert [s.trial for s in again.slips] == [2, 2]
    assert [s.time_s for s in again.slips] == pytest.approx([0.9, 2.0], abs=0.1)
    assert date_error(trials[2], true[2], again) < 0.002


def test_a_steady_poll_has_no_slip_and_live_feedback_is_left_as_it_is():
    trials, _, motions = sweep(20)
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    assert lattice.slips == () and redate(trials, lattice, motions).slips == ()
    live = find_poll_lattice(
        [replace(t, readings="live") for t in trials], np.random.default_rng(0)
    )
    assert redate(trials, live, motions) is live


def test_a_model_that_moves_too_early_does_not_move_the_dates():
    trials, true, _ = sweep(30)
    early = [motion(t.frequency_hz, t.send_time_s[0] - 0.002) for t in trials]
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    again = redate(trials, lattice, early)
    for trial, own in zip(trials, true, strict=True):
        found = readings(trial, again)
        assert abs(np.mean(found.time_s - own[found.rows])) < 0.0008


def jumped_polls(jump):
    """A poll each 60 ms for 3 s, with a jump at 1.5 s."""
    polls = 0.0613 * np.arange(49) + 0.004
    return np.where(polls > 1.5, polls + jump, polls)


def stretch(jump=0.0):
    """Changed rows of these polls read each 20 ms, without loss."""
    end = 0.02 * np.ceil(jumped_polls(jump) / 0.02)
    keep = np.concatenate([[True], np.diff(end) > 0])
    end = end[keep]
    none = np.zeros(0)
    return Stretch(0, 0.0, 3.0, end - 0.02, end, none, none, np.ones(len(end), bool))


def test_residuals_that_a_slip_has_widened_do_not_hide_it():
    # 5 mrad of noise; readings dated by one lattice leave three to five times that
    polls = jumped_polls(0.011)

    def track(time):
        return 0.3 * np.sin(4 * np.pi * time)

    value = track(polls) + 0.005 * np.random.default_rng(0).standard_normal(len(polls))
    steady = track(jumped_polls(0.0)) + value - track(polls)
    for scale in (0.016, 0.025):
        found = find_segments(stretch(0.011), value, 0.0613, 0.0025, np.nan, track, scale)
        assert [s.start_s for s in found[1:]] == pytest.approx([1.5], abs=0.1)
        assert len(find_segments(stretch(), steady, 0.0613, 0.0025, np.nan, track, scale)) == 1


def test_segments_meet_at_the_jump_and_one_lattice_of_the_true_period_suffices_without():
    steady, jumped = stretch(), stretch(0.03)
    (only,) = find_segments(steady, np.zeros(len(steady.end)), 0.0613, 0.0025, np.nan)
    assert (only.start_s, only.stop_s, only.nats) == (0.0, 3.0, 0.0)
    first, second = find_segments(jumped, np.zeros(len(jumped.end)), 0.0613, 0.0025, np.nan)
    assert first.stop_s == second.start_s == pytest.approx(1.5, abs=0.1)
    assert second.nats > NATS
    # each second poll of half the period would have to fail every time
    assert evidence(steady, 0.0613, 0.0025, 0.02) > evidence(steady, 0.03065, 0.0025, 0.5) + 20
