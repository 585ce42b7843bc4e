"""Tones read live at one phase of the loop: the staircase's ripple, and long lags."""

import numpy as np
import pytest

from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, readings
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.lag.tone import (
    slope,
    tone_lags,
    tone_response,
    tone_weights,
    without_ripple,
)
from support.synthetic import first_order_trial, tone_trials

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
    lattice = find_poll_lattice(trials, rng)
    read = [readings(t, lattice) for t in trials]
    found = [tone_response(t, r, rng) for t, r in zip(trials, read, strict=True)]
    tones = [t for t in found if t is not None]
    with_ripple = slope(tones, "fresh_held")
    clean = slope(without_ripple(trials, read, tones, rng), "fresh_held")
    b = lag_budget("LF_hip", trials, rng, lattice)
    lag = tone_weights(tones) @ np.array([tone_lag(f.frequency_hz) for f in b.by_frequency])
    assert abs(with_ripple.value - lag) > 1.5e-3
    assert with_ripple.high - with_ripple.low < 1e-3
    assert clean.low < lag < clean.high
    for f in b.by_frequency:
        assert f.lag_s.low < tone_lag(f.frequency_hz) < f.lag_s.high


def test_ripple_of_a_fast_loop_is_next_to_nothing():
    trials, rng = swept(loop_s=1 / 200), np.random.default_rng(0)
    b = lag_budget("LF_hip", trials, rng)
    for f in b.by_frequency:
        assert f.lag_s.value == pytest.approx(tone_lag(f.frequency_hz), abs=2e-4)


def test_lags_longer_than_the_lowest_tones_period_come_out_whole():
    for tones, lag_s in (((2.0, 3.0, 4.0), 0.7), ((2.0,), 0.6)):
        trials = swept(tones, dead_time_s=lag_s, time_constant_s=1e-4, loop_s=0.01)
        b = lag_budget("LF_hip", trials, np.random.default_rng(1))
        assert b.lag_s.value == pytest.approx(lag_s, abs=0.01)


def test_the_lag_seen_otherwise_settles_the_period_of_fast_tones():
    frequency = np.array([4.0, 6.0, 8.0])
    response = np.exp(-2j * np.pi * frequency * 0.62)
    assert tone_lags(response, frequency, near_s=0.6) == pytest.approx([0.62] * 3)
    assert tone_lags(response, frequency) == pytest.approx([0.12] * 3)


def test_polled_tones_have_no_ripple_to_take_out():
    rng = np.random.default_rng(2)
    trials = tone_trials(0.040, rng, (1.0, 4.0))
    lattice = find_poll_lattice(trials, rng)
    read = [readings(t, lattice) for t in trials]
    found = [tone_response(t, r, rng) for t, r in zip(trials, read, strict=True)]
    tones = [t for t in found if t is not None]
    b = lag_budget("LF_hip", trials, np.random.default_rng(0), lattice)
    assert lattice.kind == "lattice"
    assert b.lag_s.value == pytest.approx(slope(tones, "fresh_held").value, abs=1e-9)
