"""Tracking errors: at every step, over a stride, and after a fall."""

from __future__ import annotations

import numpy as np
import pytest

from pupper_sysid.policies.walks.tracking import (
    counted,
    pooled_errors,
    stride_errors,
    tracking_errors,
)

STEP_S, STEPS = 0.02, 500
TIME = STEP_S * np.arange(STEPS)
UP, NONE = np.ones((STEPS, 1), bool), np.zeros(1, bool)


def of_sway(frequency_hz: float, size: float, offset: float = 0.0) -> np.ndarray:
    return np.repeat((offset + size * np.sin(2 * np.pi * frequency_hz * TIME))[:, None, None], 3, 2)


def test_over_a_stride_a_sway_of_its_frequency_averages_to_nothing_and_an_offset_stays():
    """The mean size of a sine is 2/π of its amplitude; its mean over a period is 0."""
    sway = of_sway(2.5, 0.3)  # a period of 20 steps
    command, stride = np.zeros(3), np.array([0.4])
    instant = tracking_errors(sway, command, UP, NONE)
    np.testing.assert_allclose(instant, 2 / np.pi * 0.3, rtol=0.01)
    over = stride_errors(sway, command, UP, NONE, stride, STEP_S)
    np.testing.assert_allclose(over, 0.0, atol=1e-12)
    over = stride_errors(of_sway(2.5, 0.3, -0.1), command, UP, NONE, stride, STEP_S)
    np.testing.assert_allclose(over, 0.1, rtol=1e-9)
    # of a slow error, all stays: sin(x)/x with x = π · 0.4 s · 0.05 Hz
    slow = stride_errors(of_sway(0.05, 0.3), command, UP, NONE, stride, STEP_S)
    exact = tracking_errors(of_sway(0.05, 0.3), command, UP, NONE) * np.sinc(0.4 * 0.05)
    np.testing.assert_allclose(slow, exact, rtol=0.05)


def test_robots_that_take_no_strides_are_averaged_over_a_usual_one_and_none_over_too_long_a_one():
    sway = of_sway(2.0, 0.3)
    for stride, used in ((np.inf, 0.3), (np.nan, 0.3), (7.0, 1.0), (0.01, 0.2)):
        found, same = (
            stride_errors(sway, np.zeros(3), UP, NONE, np.array([s]), STEP_S)
            for s in (stride, used)
        )
        np.testing.assert_array_equal(found, same)


def test_each_robot_has_its_own_stride():
    sways = np.concatenate([of_sway(2.5, 0.3), of_sway(2.0, 0.3)], axis=1)
    up, fell = np.ones((STEPS, 2), bool), np.zeros(2, bool)
    own = stride_errors(sways, np.zeros(3), up, fell, np.array([0.4, 0.5]), STEP_S)
    np.testing.assert_allclose(own, 0.0, atol=1e-12)
    swapped = stride_errors(sways, np.zeros(3), up, fell, np.array([0.5, 0.4]), STEP_S)
    assert (swapped > 0.02).all()


def test_a_robot_that_fell_stands_and_one_that_left_the_ground_is_not_counted_any_more():
    velocity = np.full((STEPS, 3, 3), 0.2)
    command = np.array([0.2, 0.1, -0.4])
    alive = np.ones((STEPS, 3), bool)
    alive[100:, 1:] = False
    velocity[100:, 1:] = 77.0  # of another episode
    fell = np.array([False, True, False])
    up, down = np.array([0.0, 0.1, 0.6]), np.abs(command)
    found = tracking_errors(velocity, command, alive, fell)
    np.testing.assert_allclose(found[[0, 2]], [up, up], atol=1e-12)
    np.testing.assert_allclose(found[1], (100 * up + 400 * down) / 500)
    over = stride_errors(velocity, command, alive, fell, np.full(3, 0.4), STEP_S)
    np.testing.assert_allclose(over[[0, 2]], [up, up], atol=1e-12)
    np.testing.assert_allclose(over[1], found[1], rtol=0.05)
    shown, counts = counted(velocity, alive, fell)
    assert not shown[100:, 1:].any() and counts.sum(axis=0).tolist() == [500, 500, 100]


def test_falling_early_is_never_better_than_standing_and_never_better_than_walking_on():
    rng = np.random.default_rng(0)
    command = np.array([0.15, 0.0, 0.0])
    velocity = command + 0.02 * rng.standard_normal((STEPS, 1, 3))
    errors = []
    for last in (500, 400, 250, 100, 1):
        alive = (np.arange(STEPS) < last)[:, None]
        errors.append(tracking_errors(velocity, command, alive, np.array([last < STEPS]))[0, 0])
    assert errors == sorted(errors) and errors[-1] == pytest.approx(0.15, rel=0.01)


def test_pooled_errors_count_what_was_not_simulated_after_the_last_fall():
    velocity, alive = np.full((100, 2, 3), 0.1), np.ones((100, 2), bool)
    alive[50:, 0] = alive[-1:, 1] = False
    command = np.array([0.3, 0.1, 0.0])
    found = pooled_errors(velocity, command, alive, np.ones(2, bool), 500)
    walked = 50 + 99
    expected = (walked * np.abs(0.1 - command) + (1000 - walked) * command) / 1000
    np.testing.assert_allclose(list(found.values()), expected)
