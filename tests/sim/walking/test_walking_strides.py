"""Strides: times of swings and stances, mean velocities, and the clock that follows the feet."""

from dataclasses import replace

import numpy as np

from pupper_sysid.sim.robot.body import mini_pupper
from pupper_sysid.sim.walking.rewards.strides import Strides
from pupper_sysid.sim.walking.rewards.weights import Rewards
from pupper_sysid.sim.walking.step import empty_facts

SPAN = 0.02
WHOLE = slice(None)
REWARDS = replace(Rewards(), clock_hz=3.6, clock_pull_hz=0.5, clock_height=0.012)


def steps_of(rates: np.ndarray, seconds: float, start: float = 0.0) -> tuple[Strides, np.ndarray]:
    """Feet that step as a trot at these rates; the strides, and `in_time` of the last 2 s."""
    strides, n = Strides(mini_pupper(), len(rates), SPAN, REWARDS), len(rates)
    none = np.zeros((n, 12))
    seen = []
    for k in range(round(seconds / SPAN)):
        x = np.sin(2 * np.pi * (rates * k * SPAN + start))
        first, second = 0.012 * np.maximum(x, 0), 0.012 * np.maximum(-x, 0)
        height = np.column_stack([first, second, second, first])
        facts = empty_facts(mini_pupper(), np.zeros((n, 3)), none, none, none)
        touch = np.where(height > 0, 0.0, 1.0)
        strides.advance(WHOLE, touch, (np.zeros((n, 4, 2)), height), np.zeros((n, 3)), facts)
        seen.append(facts["clock"][:, 2].copy())
    return strides, np.array(seen[-100:])


def test_the_clock_falls_into_step_with_a_trot_of_its_rate():
    for start in (0.0, 0.2, 0.4, 0.7):
        _, in_time = steps_of(np.array([3.6, 3.4, 3.8]), 8.0, start)
        assert (in_time.mean(axis=0) > [0.95, 0.7, 0.7]).all()


def test_feet_of_other_rates_are_not_in_time():
    _, in_time = steps_of(np.array([0.0, 1.8, 2.5, 4.7, 6.0, 8.0]), 20.0)
    assert (in_time.mean(axis=0) < 0.45).all()


def test_a_mirrored_trot_keeps_the_mirrored_clock():
    plain, _ = steps_of(np.array([3.6]), 8.0)
    image, _ = steps_of(np.array([3.6]), 8.0, 0.5)
    np.testing.assert_allclose(plain.clock(WHOLE) * [-1, -1, 1], image.clock(WHOLE), atol=0.05)


def test_swings_and_stances_are_counted_and_begin_anew_with_an_episode():
    strides, _ = steps_of(np.array([2.5, 2.5]), 1.0)
    assert strides.air_s.max() <= 0.2 and strides.stance_s.max() <= 0.22
    assert ((strides.air_s > 0) != (strides.stance_s > 0)).all()
    velocity = np.array([[0.1, 0.2, 0.3]])
    strides.reset(np.array([1]), np.zeros((1, 4, 2)), velocity)
    assert not strides.air_s[1].any() and strides.air_s[0].any()
    assert strides.phase[1] == strides.in_time[1] == 0.0
    np.testing.assert_array_equal(strides.velocity[1:], velocity)
