"""Lag of recordings without tones: the staircase, its impulse response and the time shift."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.lag.lag_budget import command_hold, lag_budget, shift_draws
from pupper_sysid.sysid.lag.step_response import (
    _SIZES,
    HeldCommand,
    ImpulseResponse,
    Stretch,
    _evidence,
    past_tones,
)
from pupper_sysid.sysid.recordings.recording import Trial
from support.refusals import assert_each_refused
from support.synthetic import first_order_trial, held_trial, random_levels


def rows(time, command):
    time, command = np.array(time), np.array(command)
    return Trial("LF_hip", 0, np.nan, time, time, command, command, None, 0.0)


def minimum_jerk(rng, count=60):
    """Moves of random length to random places."""
    lasts, places = rng.uniform(0.3, 1.2, count), 0.3 * rng.uniform(-1, 1, count + 1)
    start = np.concatenate([[0.0], np.cumsum(lasts)])

    def command(t):
        move = np.clip(np.searchsorted(start, t, side="right") - 1, 0, count - 1)
        x = np.clip((t - start[move]) / lasts[move], 0, 1)
        return places[move] + np.diff(places)[move] * x**3 * (10 - 15 * x + 6 * x * x)

    return command


def test_means_of_the_staircase_are_exact_and_its_hold_weighs_loops_by_their_motion():
    held = HeldCommand.of(rows([0.0, 1.0, 3.0], [2.0, 4.0, 0.0]))
    # of the last second before 1.5: half at 2, half at 4; of the one before: half before the start
    means = held.means(np.array([1.5]), np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(means, [[3.0, 1.0]])
    np.testing.assert_allclose(held.levels(0.0, 3.01, 1.0)[1], [2.0, 4.0, 4.0])
    assert command_hold([rows([0.0, 0.02, 0.04], [0.0, 1.0, 3.0])]) == pytest.approx(0.01)
    # all the motion is in the long loop
    assert command_hold([rows([0.0, 0.02, 0.06], [1.0, 1.0, 3.0])]) == pytest.approx(0.02)


def test_means_of_a_tone_are_those_of_its_integral():
    mean = past_tones(np.array([0.8]), np.array([0.1, 0.3]), np.array([1.5]), np.array([0.5 + 0j]))
    time = np.linspace(0.5, 0.7, 20001)
    expected = np.mean(0.5 * np.cos(2 * np.pi * 1.5 * time))
    np.testing.assert_allclose(mean, [[expected]], rtol=1e-4)


def test_likelihoods_are_those_of_the_eigenvalues():
    rng = np.random.default_rng(0)
    root, moment = rng.standard_normal((12, 40)), rng.standard_normal(12)
    gram = root @ root.T
    fitted, complexity = _evidence(gram.copy(), moment.copy(), _SIZES)
    value, vector = np.linalg.eigh(gram)
    grown = 1 + _SIZES[:, None] * value
    np.testing.assert_allclose(complexity, np.log(grown).sum(axis=1), rtol=1e-9)
    expected = np.sum((vector.T @ moment) ** 2 * _SIZES[:, None] / grown, axis=1)
    np.testing.assert_allclose(fitted, expected, rtol=1e-9)


def test_a_jump_between_two_readings_leaves_the_lag_open_to_a_loop():
    rng = np.random.default_rng(0)
    trial = first_order_trial(random_levels(rng, 0.2), 0.013, 1e-5)
    b = lag_budget("LF_hip", [trial], rng)
    assert b.lag_s.low < 0.013 < b.lag_s.high
    # read 0.5 ms after each command: the jump of 13 ms is as well one of 1 or of 33
    assert 0.6 / 30 < b.lag_s.high - b.lag_s.low < 1.5 / 30


def true_lag(trial, dead_time_s, time_constant_s):
    """The definition: the shift at which command and motion correlate best, in steps of 1 ms."""
    time = np.arange(0.0, trial.send_time_s[-1], 1e-3)
    row = np.searchsorted(trial.send_time_s, time + 1e-9, side="right") - 1
    held = trial.command_rad[row] - trial.command_rad[0]
    keep, late = np.exp(-1e-3 / time_constant_s), round(1e3 * dead_time_s)
    motion = lfilter([1 - keep], [1, -keep], np.concatenate([np.zeros(late), held[:-late]]))
    first = 500
    score = [np.corrcoef(motion[first:], held[first - k : -k])[0, 1] for k in range(1, 200)]
    return 1e-3 * (1 + int(np.argmax(score)))


def test_a_slow_servo_without_tones_has_an_interval_that_holds():
    for loop_s, widest_s, seed in ((1 / 30, 0.02, 0), (1 / 80, 0.012, 1)):
        rng = np.random.default_rng(seed)
        command = (random_levels(rng, 0.25), minimum_jerk(rng))[seed]
        trial = first_order_trial(command, 0.02, 0.05, loop_s=loop_s)
        lag = lag_budget("LF_hip", [trial], rng).lag_s
        assert lag.low - 0.001 <= true_lag(trial, 0.02, 0.05) <= lag.high + 0.001
        assert 1e-4 < lag.high - lag.low < widest_s


def test_slow_motion_of_coarse_counts_behind_a_poll_is_not_taken_for_a_leading_joint():
    rng = np.random.default_rng(3)
    command = minimum_jerk(rng)
    trial = held_trial(
        lambda t: command(np.maximum(t - 0.0695, 0.0)), command, rng, duration_s=30.0, loss=0.0,
        period_s=0.03, quantum_rad=0.012,
    )  # fmt: skip
    b = lag_budget("LF_hip", [trial], rng)
    # the motion follows the command's line: half a loop of 19 ms is the hold
    assert b.lag_s.low < 0.060 < b.lag_s.high
    assert b.lag_s.high - b.lag_s.low < 0.03


def test_parts_without_tones_add_up_live_readings_add_nothing_and_dynamics_below_zero_are_said():
    rng = np.random.default_rng(1)
    trial = first_order_trial(minimum_jerk(rng), 0.02, 0.05, loop_s=0.01)
    b = lag_budget("LF_hip", [trial], rng)
    assert b.feedback.readings == "live"
    assert b.stale_lag_s == pytest.approx(0.0, abs=1e-9)
    assert b.command_hold_s == pytest.approx(0.005, abs=1e-6)
    assert b.raw_lag_s.value == pytest.approx(b.lag_s.value + b.command_hold_s + b.stale_lag_s)
    fits = b.with_dead_time(Interval(0.02, 0.018, 0.022), 0.0)
    assert fits.warnings == b.warnings
    late = b.lag_s.value + 0.01
    apart = b.with_dead_time(Interval(late, b.lag_s.high + 0.001, late + 0.01), 0.0)
    assert "is longer than the lag" in apart.warnings[-1] and "wrong" in apart.warnings[-1]
    near = b.with_dead_time(Interval(late, b.lag_s.low, late + 0.01), 0.0)
    assert "within their intervals" in near.warnings[-1]


def test_motion_that_is_no_answer_to_its_command_is_refused():
    rng = np.random.default_rng(2)
    trial = first_order_trial(random_levels(rng, 0.2), 0.02, 0.03)
    noise = replace(trial, position_rad=rng.standard_normal(len(trial.position_rad)))
    still = replace(trial, command_rad=np.zeros_like(trial.command_rad), initial_command_rad=0.0)
    lattice = find_poll_lattice([trial], rng)
    cases = [
        ((noise, lattice), "% of the motion"), ((still, None), "its command does not move"),
        ((replace(trial, position_rad=-trial.position_rad), None), "moves against its command"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda case: lag_budget("LF_hip", [case[0]], rng, case[1]))


def test_a_lag_beyond_the_search_range_is_said_to_be_at_its_end():
    rng = np.random.default_rng(4)
    trial = first_order_trial(random_levels(rng, 0.8), 1.25, 0.03, loop_s=0.02, duration_s=40.0)
    b = lag_budget("LF_hip", [trial], rng)
    assert any("end of its search range" in w for w in b.warnings)


def overshooting(k):
    """A jump taken back, at other times in each draw: every bin's median is another response."""
    masses = np.zeros(120)
    masses[5 + k % 3], masses[8 + k % 3] = 1.6, -0.6
    return masses


def weak_at_standstill(_):
    """As a walk tells it, which knows the gain at its frequencies only: it may come out below 0."""
    masses = np.zeros(120)
    masses[8], masses[20:] = 1.0, -0.013
    return masses


def two_tones(t):
    return 0.2 * np.sin(2 * np.pi * 2.0 * t) + 0.1 * np.sin(2 * np.pi * 4.0 * t)


@pytest.mark.parametrize(
    ("masses", "command", "gain", "lag_s"),
    [
        # 1.6 · 65 - 0.6 · 95 ms in the middle of the three
        (overshooting, minimum_jerk(np.random.default_rng(7)), 1.0, 0.047),
        (weak_at_standstill, two_tones, -0.3, 0.085),
    ],
)
def test_the_lag_of_draws_of_the_response_is_the_one_that_they_share(masses, command, gain, lag_s):
    trial = first_order_trial(command, 0.02, 0.05, loop_s=0.02)
    stretch = Stretch(HeldCommand.of(trial), trial.read_time_s, trial.position_rad, 8)
    draws = np.array([masses(k) for k in range(30)])
    response = ImpulseResponse(0.01 * np.arange(121), draws, np.ones((30, 8)), (stretch,), 1.0)
    assert response.gain == pytest.approx(gain)
    assert np.median(shift_draws(response, np.random.default_rng(7))) == pytest.approx(
        lag_s, abs=0.01
    )
