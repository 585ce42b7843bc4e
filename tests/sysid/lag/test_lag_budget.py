"""The lag, its budget and the poll lattice, on signals whose truth is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, readings
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
from pupper_sysid.sysid.lag.tone import (
    slope,
    tone_lags,
    tone_response,
    tone_weights,
    without_ripple,
)
from pupper_sysid.sysid.recordings.recording import Recording, Trial
from support import wide_servo
from support.refusals import assert_each_refused
from support.synthetic import LOOP_S, first_order_trial, held_trial, tone_trials


@cache
def budget(loss: float, seed: int) -> LagBudget:
    """Of tones of 1 to 4 Hz that are answered after 40 ms."""
    rng = np.random.default_rng(seed)
    return lag_budget("LF_hip", tone_trials(0.040, rng, loss=loss), rng)


def test_hold_aware_lag_is_unbiased_whatever_share_of_the_reads_is_lost():
    errors = [budget(loss, n).lag_s.value - 0.040 for loss, n in ((0.0, 0), (0.42, 0))]
    assert abs(np.mean(errors)) < 0.5e-3
    assert np.max(np.abs(errors)) < 1.5e-3


def test_tones_and_a_motion_of_several_lines_give_one_lag():
    rng = np.random.default_rng(0)

    def command(t):
        return 0.15 * np.sin(2 * np.pi * 1.5 * t) + 0.1 * np.sin(2 * np.pi * 4.0 * t)

    walk = held_trial(
        lambda t: command(t - 0.040 - LOOP_S / 2), command, rng, number=4, start_s=30.0,
        duration_s=8.0,
    )  # fmt: skip
    b = lag_budget("LF_hip", [*tone_trials(0.040, rng), walk], rng)
    assert [round(f.frequency_hz, 1) for f in b.by_frequency] == [1.0, 2.0, 3.0, 4.0, 1.5, 4.0]
    assert b.lag_s.value == pytest.approx(0.040, abs=1e-3)


def test_the_poll_is_found_and_the_parts_of_the_budget_are_those_of_the_theory():
    b = budget(0.42, 0)
    assert b.feedback.kind == "lattice" and b.feedback.z_score > 4
    assert b.feedback.poll_period_s == pytest.approx(0.02685, abs=1e-4)
    assert b.feedback.loss == pytest.approx(0.42, abs=3 * b.feedback.loss_sd)
    age_s = 0.02685 * (0.5 + 0.42 / 0.58)  # mean age of a held reading: T (1/2 + p / (1 - p))
    assert b.command_hold_s == pytest.approx(LOOP_S / 2, abs=2e-4)
    assert b.stale_lag_s == pytest.approx(age_s, abs=5e-3)
    assert b.raw_lag_s.value == pytest.approx(0.040 + LOOP_S / 2 + age_s, abs=5e-3)
    # fresh readings show the true gain where all rows show attenuation
    at_4_hz = b.by_frequency[3]
    assert at_4_hz.gain == pytest.approx(1.0, abs=0.03) and at_4_hz.raw_gain < 0.95


def test_tone_lags_follow_a_lag_that_grows_with_frequency_and_no_period_is_slipped():
    frequency = np.arange(1.0, 11.0)
    lags = 0.03 + 0.01 * frequency
    response = np.exp(-2j * np.pi * frequency * lags)
    np.testing.assert_allclose(tone_lags(response, frequency), lags, atol=1e-12)
    # two trials of one fast tone do not move the lag by a period
    frequency = np.array([3.0, 3.004, 3.009])
    response = np.exp(-2j * np.pi * frequency * 0.05 + 0.05j * np.array([1, -1, 1]))
    assert tone_lags(response, frequency) == pytest.approx([0.05] * 3, abs=5e-3)
    # the lag seen otherwise settles the period
    frequency = np.array([4.0, 6.0, 8.0])
    response = np.exp(-2j * np.pi * frequency * 0.62)
    assert tone_lags(response, frequency, near_s=0.6) == pytest.approx([0.62] * 3)
    assert tone_lags(response, frequency) == pytest.approx([0.12] * 3)


def test_no_lattice_is_claimed_where_readings_change_at_random():
    rng = np.random.default_rng(4)
    trials = []
    for trial in tone_trials(0.04, rng, period_s=0.0, quantum_rad=0.0057):
        position = trial.position_rad.copy()
        held = rng.random(len(position)) < 0.55  # any row may be stale, no clock behind it
        for k in np.flatnonzero(held):
            position[k] = position[k - 1] if k else position[k]
        trials.append(type(trial)(**{**vars(trial), "position_rad": position}))
    assert find_poll_lattice(trials, np.random.default_rng(0)).kind == "unresolved"


def test_when_readings_were_taken_is_part_of_the_interval():
    trials = tone_trials(
        0.04, np.random.default_rng(13), (1.0, 3.0), period_s=0.0, quantum_rad=0.001
    )
    doubted = [replace(t, read_time_doubt_s=0.0004) for t in trials]
    known, unknown = (lag_budget("LF_hip", t, np.random.default_rng(0)) for t in (trials, doubted))
    for a, b in ((known.lag_s, unknown.lag_s), (known.fresh_lag_s, unknown.fresh_lag_s)):
        assert (b.value, b.low, b.high) == (a.value, a.low - 0.0004, a.high + 0.0004)
    for a, b in zip(known.by_frequency, unknown.by_frequency, strict=True):
        assert b.lag_s.high - b.lag_s.low == pytest.approx(a.lag_s.high - a.lag_s.low + 0.0008)


def test_a_harmonic_that_the_rows_cannot_tell_from_the_tone_is_left_out():
    rng, time = np.random.default_rng(12), np.arange(0.0, 6.0, 1 / 30)
    for f in (10.0, 7.5, 5.0):  # 3, 4 and 6 rows a period
        command = 0.3 * np.sin(2 * np.pi * f * time + 0.4)
        position = 0.3 * np.sin(2 * np.pi * f * (time - 0.02) + 0.4)
        trial = Trial("LF_hip", 0, f, time, time, command, position, None, 0.0)
        tone = tone_response(trial, readings(trial, find_poll_lattice([trial], rng)), rng)
        assert tone is not None
        late = -np.angle(tone.fresh / tone.command_rows) / (2 * np.pi * f)
        assert late == pytest.approx(0.02, abs=1e-4)


def test_tones_that_the_servo_cannot_follow_are_in_neither_the_lag_nor_its_range():
    """A servo whose gain falls below a half at 5 Hz."""
    trials = []
    for trial in tone_trials(0.04, np.random.default_rng(5), (1.0, 3.0, 5.0), period_s=0.0):
        share = 0.3 if trial.frequency_hz == 5.0 else 1.0
        trials.append(replace(trial, position_rad=share * trial.position_rad))
    budget = lag_budget("LF_hip", trials, np.random.default_rng(5))
    assert len(budget.by_frequency) == 3 and "at 5 Hz" in " ".join(budget.warnings)
    assert budget.lag_range.startswith("mean over 1–3 Hz; ")


def test_a_joint_that_does_not_move_or_is_stuck_has_no_lag():
    still = held_trial(np.zeros_like, np.sin, np.random.default_rng(0))
    stuck = tone_trials(
        0.04, np.random.default_rng(13), (1.0, 3.0), gain=0.02, quantum_rad=0.0, noise_rad=0.003
    )
    cases = [([still], "too few to measure a lag"), (stuck, "moved by at most 2 % of its command")]
    assert_each_refused(cases, lambda t: lag_budget("LF_hip", t, np.random.default_rng(0)))


# ----- tones read live at one phase of the loop: the staircase's ripple, and long lags

TONES = (1.0, 2.0, 4.0, 6.0)
DEAD_S, CONSTANT_S = 0.015, 0.02


def swept(tones=TONES, dead_time_s=DEAD_S, time_constant_s=CONSTANT_S, loop_s=1 / 30):
    return [
        first_order_trial(
            lambda t, f=f: 0.2 * np.sin(2 * np.pi * f * t), dead_time_s, time_constant_s,
            loop_s=loop_s, duration_s=4.0, frequency_hz=f, number=n,
        )
        for n, f in enumerate(tones)
    ]  # fmt: skip


def tone_lag(frequency):
    """Dead time and atan(ω τ) / ω of a first-order servo."""
    omega = 2 * np.pi * frequency
    return DEAD_S + np.arctan(omega * CONSTANT_S) / omega


def test_ripple_is_taken_out_of_live_tones_and_what_is_left_is_in_the_interval():
    trials, rng = swept(), np.random.default_rng(0)
    lattice, read, tones = tones_of(trials, rng)
    with_ripple = slope(tones, "fresh_held")
    clean = slope(without_ripple(trials, read, tones, rng), "fresh_held")
    b = lag_budget("LF_hip", trials, rng, lattice)
    lag = tone_weights(tones) @ np.array([tone_lag(f.frequency_hz) for f in b.by_frequency])
    assert abs(with_ripple.value - lag) > 1.5e-3
    assert with_ripple.high - with_ripple.low < 1e-3
    assert clean.low < lag < clean.high
    for f in b.by_frequency:
        assert f.lag_s.low < tone_lag(f.frequency_hz) < f.lag_s.high


def test_a_servo_without_a_resonance_is_not_given_one_at_the_loops_rate():
    # one servo of the grid resonates with the ripple of this loop and fits best of the grid
    twin, path, sent, commands = wide_servo.draw_twin("dead_zone", "tones", 1, 301)
    rows = wide_servo.readings(twin, path)
    recording = Recording.from_arrays(
        rows.sent_s, {"knee": rows.command}, {"knee": rows.position}, read_time_s=rows.read_s,
        trial=rows.trial, frequency_hz=rows.frequency_hz, metadata={"readings": "live"},
    )  # fmt: skip
    b = lag_budget("knee", recording.trials("knee"), np.random.default_rng(0))
    truths = {t["trial"]: t for t in wide_servo.tone_truths(twin, path, sent, commands)}
    for f in b.by_frequency:
        truth = truths[f.trial]
        assert f.lag_s.low < truth["truth"] < f.lag_s.high
        assert abs(f.lag_s.value - truth["truth"]) < 3e-3
        assert f.gain == pytest.approx(truth["gain"], rel=0.1)


def test_lags_longer_than_the_lowest_tones_period_come_out_whole():
    for tones, lag_s in (((2.0, 3.0, 4.0), 0.7), ((2.0,), 0.6)):
        trials = swept(tones, dead_time_s=lag_s, time_constant_s=1e-4, loop_s=0.01)
        b = lag_budget("LF_hip", trials, np.random.default_rng(1))
        assert b.lag_s.value == pytest.approx(lag_s, abs=0.01)


def tones_of(trials, rng):
    """Lattice, readings and responses of tones."""
    lattice = find_poll_lattice(trials, rng)
    read = [readings(t, lattice) for t in trials]
    found = [tone_response(t, r, rng) for t, r in zip(trials, read, strict=True)]
    return lattice, read, [t for t in found if t is not None]
