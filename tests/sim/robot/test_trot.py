"""The open-loop trot: diagonal pairs, speed as commanded, a phase that can be read back."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.joints import LEGS
from pupper_sysid.sim.robot.mini_pupper import default_pose, foot_position, limits
from pupper_sysid.sim.robot.trot import Trot
from support.refusals import assert_each_refused

TROT = Trot(
    frequency_hz=2.5, lift_m=0.020, duty=0.6, crouch_m=0.0, spread_m=0.0, even_swing=0.0, gain=1.0,
    back_gain=1.0, side_gain=1.0, turn_gain=1.0, turn_dead_band_rad_s=0.0,
)  # fmt: skip
STEP_S = 0.02
COMMANDS = ((0.2, 0.0, 0.0), (-0.2, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.5), (0.15, -0.05, 0.3))
"""Forward, backward, sideways, turning, all at once."""


def feet(joints: np.ndarray) -> np.ndarray:
    """Foot positions in the trunk's frame [m], shape (n, 4, 3)."""
    return np.stack(
        [foot_position(leg, *joints[:, 3 * i : 3 * i + 3].T) for i, leg in enumerate(LEGS)], axis=1
    )


def phase_read(phase: np.ndarray, command: np.ndarray, wrong_rad: float = 0.0) -> np.ndarray:
    """Phase read off the trot's targets of now and one control step before, slightly wrong."""
    rng = np.random.default_rng(0)
    before = phase - 2 * np.pi * TROT.frequency_hz * STEP_S
    now, earlier = (
        joints + rng.uniform(-wrong_rad, wrong_rad, joints.shape)
        for joints in (TROT.joints(phase, command), TROT.joints(before, command))
    )
    return TROT.phase_of(now, earlier, STEP_S, command)


def along(command, count: int) -> np.ndarray:
    return np.tile(np.array(command, float), (count, 1))


NEUTRAL = feet(default_pose()[None])[0]


def test_gains_of_their_own_lengthen_the_strokes_backward_and_sideways_alone():
    phase = np.linspace(0, 2 * np.pi, 50)
    own = replace(TROT, back_gain=1.5, side_gain=0.5)

    def strokes(trot, command):
        path = feet(trot.joints(phase, along(command, 50)))
        return np.ptp(path, axis=0)[:, :2]

    for command, factors in (
        ((0.1, 0.0, 0.0), (1.0, 1.0)), ((-0.1, 0.0, 0.0), (1.5, 1.0)),
        ((0.0, 0.06, 0.0), (1.0, 0.5)), ((-0.1, -0.06, 0.0), (1.5, 0.5)),
        ((0.0, 0.0, 0.4), (1.0, 1.0)),
    ):  # fmt: skip
        expected = strokes(TROT, command) * factors
        np.testing.assert_allclose(strokes(own, command), expected, atol=1e-9)


def test_the_phase_is_read_back_from_the_joints():
    for command in COMMANDS:
        phase = np.linspace(-np.pi, np.pi, 41)[:-1] + 0.01
        found = phase_read(phase, along(command, 40))
        # half a step of its grid, at touch-down and lift-off, where the path has corners
        np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * phase), atol=0.035)


def test_each_foot_is_down_for_its_duty_and_lifted_by_the_lift_in_the_rest():
    phase = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    up = (feet(TROT.joints(phase, along((0.2, 0.0, 0.0), 400))) - NEUTRAL)[..., 2]
    assert up.min() == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(up.max(axis=0), 0.020, atol=1e-5)
    np.testing.assert_allclose((up < 1e-9).mean(axis=0), TROT.duty, atol=0.01)


def test_over_a_stance_the_ground_passes_under_the_trunk_as_commanded():
    # LF stands from phase 0 for its duty; a foot on the ground moves against the trunk, evenly
    phase = np.linspace(0.0, 2 * np.pi * TROT.duty, 7)
    x, y = NEUTRAL[0, :2]
    for vx, vy, turn in COMMANDS:
        path = feet(TROT.joints(phase, along((vx, vy, turn), 7)))[:, 0, :2]
        speed = -np.diff(path, axis=0) * TROT.frequency_hz * 6 / TROT.duty
        under = np.tile([vx - turn * y, vy + turn * x], (6, 1))
        np.testing.assert_allclose(speed, under, atol=1e-6)


def test_crouch_spread_gain_and_an_even_swing_shape_the_path():
    phase, command = np.linspace(0, 2 * np.pi, 30), along((0.15, 0.05, 0.0), 30)
    lower = replace(TROT, crouch_m=0.01, spread_m=0.007)
    moved = feet(lower.joints(phase, command)) - feet(TROT.joints(phase, command))
    np.testing.assert_allclose(moved[..., 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(moved[..., 1] * [1, -1, 1, -1], 0.007, atol=1e-9)
    np.testing.assert_allclose(moved[..., 2], 0.01, atol=1e-9)
    one, more = (
        feet(replace(TROT, gain=g).joints(phase[:1], command[:1]))[0, 0] - NEUTRAL[0]
        for g in (1, 1.5)
    )
    np.testing.assert_allclose(more[:2], 1.5 * one[:2], rtol=1e-6)
    # an even swing brings a foot back at constant speed
    swing, ahead = np.linspace(2 * np.pi * TROT.duty, 2 * np.pi, 9), along((0.2, 0.0, 0.0), 9)
    x, half = (
        feet(trot.joints(swing, ahead))[:, 0, 0] for trot in (replace(TROT, even_swing=1.0), TROT)
    )
    np.testing.assert_allclose(np.diff(x), np.ptp(x) / 8, atol=1e-9)
    assert half[[0, -1]] == pytest.approx(x[[0, -1]])
    assert np.diff(half).max() > 1.4 * np.diff(half).mean()


def test_a_duty_that_cannot_be_is_refused():
    refused = [(duty, "trot.duty") for duty in (0.0, 1.0, 1.2, -0.1)]
    assert_each_refused(refused, lambda duty: Trot(duty=duty))


def test_a_turn_gets_the_dead_band_on_top_unless_feet_step_sideways():
    def stroke(command: tuple[float, float, float]) -> float:
        plain, banded = (
            feet(replace(TROT, turn_dead_band_rad_s=band).joints(np.zeros(1), along(command, 1)))
            for band in (0.0, 0.13)
        )
        return float(np.ptp((banded - NEUTRAL)[0, :, 1]) / np.ptp((plain - NEUTRAL)[0, :, 1]))

    assert stroke((0.0, 0.0, 0.4)) == pytest.approx(1 + 0.13 / 0.4, rel=1e-3)
    assert stroke((0.15, 0.0, -0.2)) == pytest.approx(1 + 0.13 / 0.2, rel=1e-2)
    assert stroke((0.0, 0.08, 0.4)) == pytest.approx(1.0)


def test_a_command_of_zero_stands_in_the_default_pose_at_any_phase():
    phase = np.linspace(0, 2 * np.pi, 9)
    joints = TROT.joints(phase, along((0.0, 0.0, 0.0), 9))
    np.testing.assert_array_equal(joints, np.tile(default_pose(), (9, 1)))


def test_the_trot_stays_within_the_joint_limits_up_to_the_robots_rated_speed_but_for_its_highest():
    """Calves reach their end before the top of a swing; four fifths of the lift are left."""
    phase, calf = np.linspace(0, 2 * np.pi, 100), np.arange(12) % 3 == 2
    low, high = limits()
    # 0.15 m/s: facts/paper.md 1.4; at 0.2 m/s the thigh reaches its front stop
    for command in ((0.15, 0.0, 0.0), (-0.15, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.5)):
        joints = Trot().joints(phase, along(command, 100))
        assert (joints >= low - 0.1 * calf).all() and (joints <= high).all(), command
        up = (feet(np.clip(joints, low, high)) - NEUTRAL)[..., 2].max(axis=0) - Trot().crouch_m
        assert (up > 0.8 * Trot().lift_m).all(), command
