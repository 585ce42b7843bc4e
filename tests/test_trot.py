"""The open-loop trot: diagonal pairs, speed as commanded, a phase that can be read back."""

from __future__ import annotations

import numpy as np
import pytest

from common.joints import LEGS
from sim.mini_pupper import default_pose, foot_position, limits
from sim.trot import Trot

TROT = Trot(frequency_hz=2.5, lift_m=0.020, gain=1.0)
COMMANDS = {
    "forward": (0.2, 0.0, 0.0),
    "backward": (-0.2, 0.0, 0.0),
    "sideways": (0.0, 0.1, 0.0),
    "turning": (0.0, 0.0, 0.5),
    "all at once": (0.15, -0.05, 0.3),
}


def feet(joints: np.ndarray) -> np.ndarray:
    """Foot positions in the trunk's frame [m], shape (n, 4, 3)."""
    return np.stack(
        [foot_position(leg, *joints[:, 3 * i : 3 * i + 3].T) for i, leg in enumerate(LEGS)], axis=1
    )


def along(command, count: int) -> np.ndarray:
    return np.tile(np.array(command, float), (count, 1))


NEUTRAL = feet(default_pose()[None])[0]


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS.keys())
def test_the_phase_is_read_back_from_the_joints(command):
    phase = np.linspace(-np.pi, np.pi, 41)[:-1] + 0.01
    found = TROT.phase_of(TROT.joints(phase, along(command, 40)), along(command, 40))
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * phase), atol=1e-6)


def test_a_step_of_phase_is_read_as_a_step_of_phase_from_slightly_wrong_joints():
    phase = np.linspace(0, 2 * np.pi, 20)
    joints = TROT.joints(phase, along((0.2, 0, 0), 20))
    wrong = joints + np.random.default_rng(0).uniform(-0.01, 0.01, joints.shape)
    found = TROT.phase_of(wrong, along((0.2, 0, 0), 20))
    # 0.01 rad at a leg of 75 mm is 0.75 mm, of a circle of 20 mm: 0.04 rad per foot at most
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * phase), atol=0.06)


def test_diagonal_feet_move_together_and_the_two_pairs_half_a_cycle_apart():
    phase = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    away = feet(TROT.joints(phase, along((0.2, 0.0, 0.0), 24))) - NEUTRAL
    lf, rf, lb, rb = np.moveaxis(away, 1, 0)
    np.testing.assert_allclose(lf, rb, atol=1e-9)
    np.testing.assert_allclose(rf, lb, atol=1e-9)
    np.testing.assert_allclose(np.roll(lf, 12, axis=0), rf, atol=1e-9)


def test_each_foot_is_down_for_half_the_cycle_and_lifted_by_the_lift_in_the_other():
    phase = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    up = (feet(TROT.joints(phase, along((0.2, 0.0, 0.0), 400))) - NEUTRAL)[..., 2]
    assert up.min() == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(up.max(axis=0), 0.020, atol=1e-6)
    np.testing.assert_allclose((up < 1e-9).mean(axis=0), 0.5, atol=0.01)


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS.keys())
def test_over_a_stance_the_ground_passes_under_the_trunk_as_commanded(command):
    # LF stands from phase 0 to π, half a period; a foot on the ground moves against the trunk
    touch_down, lift_off = feet(TROT.joints(np.array([0.0, np.pi]), along(command, 2)))[:, 0, :2]
    speed = (touch_down - lift_off) * 2 * TROT.frequency_hz
    vx, vy, turn = command
    x, y = NEUTRAL[0, :2]
    np.testing.assert_allclose(speed, [vx - turn * y, vy + turn * x], atol=1e-6)


def test_a_command_of_02_is_a_stroke_of_20_mm_either_way():
    away = feet(TROT.joints(np.array([0.0, np.pi]), along((0.2, 0.0, 0.0), 2)))[:, 0] - NEUTRAL[0]
    # A = v / (4 f)
    np.testing.assert_allclose(away[:, 0], [0.020, -0.020], atol=1e-6)


def test_gain_lengthens_the_stroke_in_proportion():
    command, phase = along((0.1, 0.0, 0.0), 1), np.zeros(1)
    one, more = (feet(Trot(gain=g).joints(phase, command))[0, 0] - NEUTRAL[0] for g in (1, 1.5))
    assert more[0] == pytest.approx(1.5 * one[0], rel=1e-6)


def test_a_command_of_zero_stands_in_the_default_pose_at_any_phase():
    phase = np.linspace(0, 2 * np.pi, 9)
    joints = TROT.joints(phase, along((0.0, 0.0, 0.0), 9))
    np.testing.assert_array_equal(joints, np.tile(default_pose(), (9, 1)))


def test_each_robot_follows_its_own_phase_and_command():
    commands = np.array([[0.2, 0, 0], [0, 0, 0], [0.0, 0.1, 0.2]])
    phase = np.array([0.3, 1.0, 4.0])
    together = TROT.joints(phase, commands)
    for i in range(3):
        np.testing.assert_array_equal(
            together[i], TROT.joints(phase[i : i + 1], commands[i : i + 1])[0]
        )


def test_the_trot_stays_within_the_joint_limits_up_to_the_robots_rated_speed():
    phase = np.linspace(0, 2 * np.pi, 100)
    low, high = limits()
    # 0.15 m/s: facts/paper.md 1.4; at 0.2 m/s the thigh reaches its front stop
    for command in ((0.15, 0.0, 0.0), (-0.15, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.5)):
        joints = TROT.joints(phase, along(command, 100))
        assert (joints >= low).all() and (joints <= high).all(), command
