"""Measures of a gait, on signals whose answers are known."""

import json
from dataclasses import astuple

import numpy as np
import pytest
from scipy.signal import lfilter

from pupper_sysid.common.joints import LEGS
from pupper_sysid.policies.analysis.gait import (
    amplitude,
    correlation,
    describe,
    diagonal_coordination,
    fast_share,
    frequency,
    intervals,
    jitter,
    null_r2,
    phases,
    sine_fit_r2,
    sine_frequency,
)
from pupper_sysid.policies.walks.rollouts import Rollout
from pupper_sysid.sim.robot.mini_pupper import default_pose, foot_position
from pupper_sysid.sim.robot.trot import Trot
from support.refusals import assert_each_refused

STEP_S = 0.02
TROT = Trot(frequency_hz=3.25)
BEHIND = np.array([0.0, 0.5, 0.5, 0.0])


def trot(seconds: float, hz: float = 3.25, start: float = 0.0):
    """Joint targets (steps, 12) and contacts (steps, 4) of a trot at 0.15 m/s."""
    own = Trot(frequency_hz=hz)
    time = STEP_S * np.arange(round(seconds / STEP_S), dtype=np.float64)
    phase = np.asarray(2 * np.pi * hz * time + start, np.float64)
    joints = own.joints(phase, np.tile([0.15, 0.0, 0.0], (len(phase), 1)))
    feet = [foot_position(leg, *joints[:, 3 * i : 3 * i + 3].T)[:, 2] for i, leg in enumerate(LEGS)]
    height = np.stack(feet, axis=1)
    return joints, height < height.min(axis=0) + 1e-9


def red_noise(memory: float, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """AR(1) noise of variance 1."""
    steps, channels = shape
    pushes = rng.standard_normal((steps + 200, channels))
    return lfilter([1.0], [1.0, -memory], pushes, axis=0)[200:] * np.sqrt(1 - memory**2)


def tones(hz: float, seconds: float, noise: np.ndarray, rng: np.random.Generator, wander=0.0):
    """Sines of variance 1 with a weak second harmonic, each with its own phase, in noise.

    Their common phase walks at random, `wander` rad per √s.
    """
    time = STEP_S * np.arange(round(seconds / STEP_S))
    walk = wander * np.sqrt(STEP_S) * np.cumsum(rng.standard_normal(len(time)))
    angle = (2 * np.pi * hz * time + walk)[:, None] + rng.uniform(0, 2 * np.pi, noise.shape[1])
    return np.sqrt(2) * np.sin(angle) + 0.3 * np.sin(2 * angle) + noise


# ------------------------------------------------------------------------------ frequency


def test_the_frequency_of_a_trot_is_found_within_a_hundredth_of_a_hertz():
    for hz, seconds in ((0.9, 5.0), (3.25, 12.34), (7.03, 5.0), (7.03, 12.34)):
        joints, _ = trot(seconds, hz, start=1.0)
        found = frequency(joints, STEP_S)
        assert found.value == pytest.approx(hz, abs=0.01)
        assert found.low <= found.value <= found.high
        assert sine_frequency(joints, STEP_S) == pytest.approx(hz, abs=0.01)


def test_the_interval_of_the_frequency_holds_the_truth_nine_times_in_ten():
    """In noise as strong as the rhythm; 100 draws know a coverage of 90 % to ±3 %."""
    trials = 100
    # in very red noise errors of neighbouring strides cancel: rather too wide than too narrow
    for seconds, memory, channels, most in ((5.0, 0.5, 12, 0.97), (8.0, 0.95, 4, 0.99)):
        rng, held = np.random.default_rng(1), 0
        for _ in range(trials):
            hz = rng.uniform(2.0, 6.0)
            noise = red_noise(memory, (round(seconds / STEP_S), channels), rng)
            found = frequency(tones(hz, seconds, noise, rng), STEP_S)
            held += found.low <= hz <= found.high
        assert 0.80 <= held / trials <= most


def test_signals_that_are_short_still_or_of_other_shapes_are_refused():
    joints, _ = trot(5.0)
    frequency(joints, STEP_S)
    # 5 s are 166.7 steps of 0.03 s, and 7 s less 2 s are 166
    sine_frequency(joints[:166], 0.03)
    short = rollout([3.2, 3.3], fell_at={0: 6.0, 1: 3.0})
    cases = [
        (lambda: frequency(joints[1:], STEP_S), "4.98 s is too short"),
        (lambda: frequency(np.full((300, 12), 0.1), STEP_S), "Nothing moves"),
        (lambda: correlation(joints, joints[1:]), "cannot be compared"),
        (lambda: correlation(np.ones((50, 12)), joints[:50]), "Nothing moves"),
        (
            lambda: describe(short, np.random.default_rng(0)),
            "for 7 s: the longest was up for 6.0 s",
        ),
    ]
    assert_each_refused(cases, lambda measure: measure())


# ------------------------------------------------------------------------------ R²


def test_the_r2_of_a_sine_in_noise_is_its_share_of_the_variance():
    rng = np.random.default_rng(3)
    time = STEP_S * np.arange(20_000)
    amplitudes, noise = np.array([2.0, 1.0, 0.5, 0.0]), 0.8
    clean = amplitudes * np.sin(2 * np.pi * 3.0 * time[:, None] + np.arange(4))
    found = sine_fit_r2(clean + noise * rng.standard_normal(clean.shape), STEP_S, 3.0)
    power = amplitudes**2 / 2
    np.testing.assert_allclose(found, power / (power + noise**2), atol=0.02)
    np.testing.assert_allclose(sine_fit_r2(clean, STEP_S, 3.0), [1, 1, 1, 0], atol=1e-6)


def test_noise_is_as_regular_as_its_null_and_a_trot_is_more():
    """Of 20 noises, the rank among their own surrogates is even: mean 1/2 ± 0.065 (one sigma)."""
    rng = np.random.default_rng(4)
    ranks = []
    for _ in range(20):
        noise = red_noise(0.9, (300, 4), rng)
        own = sine_fit_r2(noise, STEP_S, sine_frequency(noise, STEP_S)).mean()
        ranks.append((null_r2(noise, STEP_S, rng, draws=25).mean(axis=1) < own).mean())
    assert np.mean(ranks) == pytest.approx(0.5, abs=0.17)
    joints, _ = trot(6.0)
    own = sine_fit_r2(joints, STEP_S, 3.25).mean()
    assert own > null_r2(joints, STEP_S, rng, draws=40).mean(axis=1).max()


# ------------------------------------------------------------------------------ feet


def test_a_trot_has_its_duty_its_phases_and_diagonal_feet_together():
    _, contact = trot(20.0, start=0.7)
    np.testing.assert_allclose(contact.mean(axis=0), TROT.duty, atol=0.01)
    np.testing.assert_allclose(phases(contact, STEP_S, 3.25), BEHIND, atol=0.01)
    assert diagonal_coordination(contact) == pytest.approx(1.0)
    contact[:, 2] = True  # a foot that never lifts has no phase
    lifted = np.isfinite(phases(contact, STEP_S, 3.25))
    np.testing.assert_array_equal(lifted, [True, True, False, True])
    assert np.isnan(diagonal_coordination(contact))


def test_feet_that_take_turns_count_against_and_stances_are_where_the_foot_changes():
    rng = np.random.default_rng(7)
    beat = np.arange(1000) % 10 < 5
    # LF with LB, RF with RB: a pace
    assert diagonal_coordination(np.stack([beat, ~beat, beat, ~beat], axis=1)) == -1.0
    for stands in (0.5, 0.9):
        found = diagonal_coordination(rng.random((20_000, 4)) < stands)
        assert found == pytest.approx(0.0, abs=0.02)
    down = np.array([0, 1, 1, 1, 0, 0, 1], bool)
    np.testing.assert_allclose(intervals(down, 0.02), [[0.02, 0.06], [0.12, 0.02]])
    np.testing.assert_allclose(intervals(~down, 0.02), [[0.0, 0.02], [0.08, 0.04]])
    assert intervals(np.zeros(5, bool), 0.02).shape == (0, 2)


# ------------------------------------------------------------------------------ actions


def test_jitter_amplitude_and_fast_share_are_those_of_the_formulas():
    time = STEP_S * np.arange(5000)[:, None]
    signal = 0.3 * np.sin(2 * np.pi * 3.0 * time)
    expected = 2 * np.sqrt(2) * 0.3 * np.sin(np.pi * 3.0 * STEP_S) ** 2
    assert jitter(signal) == pytest.approx(expected, rel=1e-3)
    half_range, deviation = amplitude(signal)
    assert half_range[0] == pytest.approx(0.3 * np.sin(0.45 * np.pi), rel=1e-2)
    assert deviation[0] == pytest.approx(0.3 / np.sqrt(2), rel=1e-3)
    # what is above the second harmonic is fast
    parts = [
        a * np.sin(2 * np.pi * f * time[:1000]) for a, f in ((1.0, 3.0), (0.5, 6.0), (0.5, 15.0))
    ]
    found = fast_share(np.sum(parts, axis=0), STEP_S, 3.0)
    assert found == pytest.approx(0.25 / 1.5, abs=1e-3)
    assert np.isnan(fast_share(np.zeros((100, 2)), STEP_S, 3.0))


def test_the_correlation_of_a_gait_is_that_of_its_phase_and_none_where_a_joint_stopped():
    joints, _ = trot(6.0)
    # harmonics take some
    expected = np.cos(2 * np.pi * 3.25 * 4 * STEP_S)
    assert correlation(joints[4:], joints[:-4]) == pytest.approx(expected, abs=0.25)
    assert correlation(joints, -joints) == pytest.approx(-1.0)
    stopped = joints.copy()
    stopped[:, :3] = 0.1
    # two of eight: straight ahead, hips stand still in the trot itself
    assert correlation(joints, stopped) == pytest.approx(0.75)


# ------------------------------------------------------------------------------ report


def rollout(rates: list[float], seconds: float = 12.0, fell_at: dict[int, float] | None = None):
    """Robots that trot at `rates`, some of which fall."""
    found = [trot(seconds, hz, start=i) for i, hz in enumerate(rates)]
    joints = np.stack([j for j, _ in found], axis=1)
    steps, n, _ = joints.shape
    alive = np.ones((steps, n), bool)
    for i, at in (fell_at or {}).items():
        fell = round(at / STEP_S)
        alive[fell:, i] = False
        joints[fell - 5 :, i] = 7.0  # must not be looked at
    action = ((joints - default_pose()) / 0.5).astype(np.float32)
    empty = np.zeros((steps, n, 3))
    return Rollout(
        STEP_S, (0.15, 0.0, 0.0), 0.5, np.zeros((steps, n, 60), np.float32), action,
        np.zeros((steps, n, 8), np.float32), joints, np.stack([c for _, c in found], axis=1),
        empty, empty, alive, ~alive[-1],
    )  # fmt: skip


def test_a_report_is_the_mean_over_robots_with_the_spread_between_them():
    rates = [3.2, 3.25, 3.3]
    found = describe(rollout(rates), np.random.default_rng(0))
    assert (found.robots, found.left_out, found.rhythmic) == (3, 0, 1.0)
    # Student's t with 2 degrees of freedom: 2.920; deviation 0.05, three robots
    half = 2.920 * 0.05 / np.sqrt(3)
    expected = [3.25, 3.25 - half, 3.25 + half]
    np.testing.assert_allclose(astuple(found.frequency_hz), expected, atol=0.005)
    np.testing.assert_allclose([p.value for p in found.phase], BEHIND, atol=0.02)
    np.testing.assert_allclose([d.value for d in found.duty], TROT.duty, atol=0.01)
    assert found.diagonal.value == pytest.approx(1.0)
    assert found.null_r2 < found.action_r2.value
    assert found.action_r2.value == pytest.approx(found.joint_r2.value, abs=1e-4)
    by_joint = np.mean([r.value for r in found.action_r2_by_joint])
    assert found.action_r2.value == pytest.approx(by_joint)
    # actions are in radians: what the joints of this rollout do
    actions, joints = (
        [astuple(one) for one in many]
        for many in (found.half_range_rad, found.joint_half_range_rad)
    )
    np.testing.assert_allclose(actions, joints, atol=1e-5)
    json.dumps(found.to_dict(), allow_nan=False)


def test_robots_count_up_to_half_a_second_before_they_fall():
    many = rollout([3.2, 3.3, 3.25], fell_at={1: 8.0, 2: 5.0})
    found = describe(many, np.random.default_rng(0))
    assert (found.robots, found.left_out) == (2, 1)
    assert found.frequency_hz.value == pytest.approx(3.25, abs=0.01)
    assert max(r.value for r in found.half_range_rad) < 1.0


def test_one_robot_has_only_its_own_interval_and_robots_that_stand_have_no_rhythm():
    found = describe(rollout([3.25]), np.random.default_rng(0))
    assert found.frequency_hz.low < found.frequency_hz.value < found.frequency_hz.high
    assert np.isnan(found.jitter_rad.low) and found.jitter_rad.value > 0
    still = rollout([3.25, 3.25])
    still.action[:] = 0.1
    still.contact[:] = True
    found = describe(still, np.random.default_rng(0))
    assert np.isnan(found.frequency_hz.value) and np.isnan(found.phase[0].value)
    assert found.rhythmic == 0.0 and found.action_r2.value == 0.0 and found.jitter_rad.value == 0.0
    assert found.duty[0].value == 1.0
