"""Altered observations, and what a walking policy makes of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from policies import perturbations
from policies.perturbations import JOINTS
from policies.robustness import _rate, ablation, delay_curve
from sim.walking_env import OBSERVATION_PARTS as PARTS

ROOT = Path(__file__).resolve().parents[1]
STEPS, ROBOTS = 60, 3


def counting() -> np.ndarray:
    """Every number of step k is k."""
    seen = np.repeat(np.arange(STEPS, dtype=np.float32), ROBOTS * 60)
    return seen.reshape(STEPS, ROBOTS, 60)


def test_the_parts_of_the_observation_are_where_the_paper_says():
    assert JOINTS == slice(12, 48) and PARTS["last_action"] == slice(48, 60)


def test_a_delay_shows_what_was_and_leaves_the_rest_alone():
    seen = perturbations.applied(perturbations.delayed(JOINTS, 8), counting())
    expected = np.maximum(np.arange(STEPS) - 8, 0)
    np.testing.assert_array_equal(seen[:, 0, 12], expected)
    np.testing.assert_array_equal(seen[:, 1, 47], expected)
    np.testing.assert_array_equal(seen[:, 0, 11], np.arange(STEPS))
    np.testing.assert_array_equal(seen[:, 0, 48], np.arange(STEPS))


def test_a_jittered_delay_never_goes_back_in_time_and_keeps_its_bounds():
    rng = np.random.default_rng(0)
    seen = perturbations.applied(perturbations.jittered(JOINTS, 4, rng), counting())[:, :, 12]
    lag = np.arange(STEPS)[:, None] - seen
    assert (np.diff(seen, axis=0) >= 0).all()
    assert lag.min() >= 0 and lag.max() <= 8
    assert len(np.unique(lag[10:])) > 3 and (lag[:, 0] != lag[:, 1]).any()


def test_held_values_are_refreshed_on_a_lattice():
    seen = perturbations.applied(perturbations.held(JOINTS, 5), counting())[:, 0, 20]
    np.testing.assert_array_equal(seen, 5 * (np.arange(STEPS) // 5))


def test_noise_has_the_size_that_was_asked_for_per_number():
    sigma = np.linspace(0.1, 2.0, 36)
    change = perturbations.noisy(JOINTS, sigma, np.random.default_rng(0))
    added = perturbations.applied(change, np.zeros((4000, 1, 60), np.float32))
    np.testing.assert_allclose(added[:, 0, JOINTS].std(axis=0), sigma, rtol=0.06)
    assert not added[..., :12].any() and not added[..., 48:].any()


def test_zeros_are_zeros():
    seen = perturbations.applied(perturbations.zeroed(JOINTS), counting())
    assert not seen[..., JOINTS].any() and seen[5, 0, 0] == 5


def test_a_delay_curve_has_its_three_modes_and_begins_with_the_plain_walk(walker):
    rows = delay_curve(*walker, extra_ms=(0, 80))
    assert [(r["extra_delay_ms"], r["mode"]) for r in rows] == [
        (ms, mode) for ms in (0, 80) for mode in ("replay", "fixed", "jittered")
    ]
    plain = {r["mode"]: r for r in rows if r["extra_delay_ms"] == 0}
    # shown what it saw, a policy does what it did
    assert plain["replay"]["frequency_hz"] == pytest.approx(
        plain["fixed"]["frequency_hz"], rel=0.02
    )
    assert plain["fixed"]["survival"] == plain["jittered"]["survival"] == 1.0
    assert plain["fixed"]["frequency_hz"] == pytest.approx(3.25, abs=0.15)


def test_an_ablation_hurts_more_the_more_is_taken(walker):
    policy, trial = walker
    rows = [r for r in ablation(policy, trial, channels=("last_action",))]
    noise = [r["correlation"] for r in rows if r["kind"] == "noise"]
    assert noise[0] > 0.9 and noise[-1] < noise[0] - 0.2
    assert {r["kind"] for r in rows} == {"noise", "zero", "hold"}


def test_joints_that_stand_apart_but_do_not_move_have_no_frequency():
    still = np.tile(np.linspace(-1.0, 1.0, 12), (400, 1))
    assert np.isnan(_rate(still, 0.02))
    swing = still + 0.1 * np.sin(2 * np.pi * 3.0 * 0.02 * np.arange(400))[:, None]
    assert _rate(swing, 0.02) == pytest.approx(3.0, abs=0.01)
