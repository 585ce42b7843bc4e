"""The independent simulator moves as theory says, whatever the length of its step."""

import numpy as np
import pytest

from support.wide_servo import KINDS, Path, Servo, draw_twin, simulate

HARD = {"dead_time_s": 0.0, "friction": 0.0, "effort": 1e9}


def stepped(servo: Servo, size_rad: float, stop_s: float) -> tuple[np.ndarray, Path]:
    """Motion after a step of the command, and its times since that [s]."""
    rng = np.random.default_rng(0)
    path = simulate(servo, np.array([0.0, 0.1]), np.array([0.0, size_rad]), stop_s, rng)
    return np.maximum(path.time_s - 0.1, 0.0), path


def left_alone(servo: Servo, stop_s: float) -> Path:
    """Motion under a command of zero."""
    return simulate(servo, np.array([0.0]), np.array([0.0]), stop_s, np.random.default_rng(0))


def test_a_step_is_that_of_a_critically_damped_oscillator():
    time, path = stepped(Servo(stiffness=2500, damping=100, **HARD), 0.5, 0.6)
    exact = 0.5 * (1 - (1 + 50 * time) * np.exp(-50 * time))
    np.testing.assert_allclose(path.angle, exact, atol=1e-3)


def test_effort_friction_dead_time_and_back_emf_are_those_of_newton():
    time, path = stepped(Servo(dead_time_s=0.0203, effort=200, friction=50, damping=0), 9.0, 0.2)
    exact = 0.5 * (200 - 50) * np.maximum(time - 0.0203, 0) ** 2
    np.testing.assert_allclose(path.angle, exact, atol=2e-3)
    motor = Servo(stiffness=1e6, effort=100, back_emf=20, damping=0, friction=0, dead_time_s=0)
    time, path = stepped(motor, 100.0, 0.5)
    np.testing.assert_allclose(path.angle, 5 * (time - (1 - np.exp(-20 * time)) / 20), atol=2e-3)


@pytest.mark.parametrize(
    ("speed", "duration"), [(np.inf, 2 * np.sqrt(0.5 / 40)), (2.0, 0.5 / 2 + 2 / 40)]
)
def test_a_profile_ends_when_its_acceleration_and_speed_allow(speed, duration):
    time, path = stepped(Servo(acceleration_limit=40, speed_limit=speed, **HARD), 0.5, 1.0)
    assert time[np.argmax(path.set_point > 0.5 - 1e-5)] == pytest.approx(duration, abs=2e-3)


def test_set_points_slew_and_follow_a_low_pass():
    time, path = stepped(Servo(speed_limit=5, **HARD), 0.5, 1.0)
    np.testing.assert_allclose(path.set_point, np.clip(5 * time, 0, 0.5), atol=1e-3)
    time, path = stepped(Servo(low_pass_s=0.05, stiffness=1e5, damping=600, **HARD), 0.3, 0.8)
    np.testing.assert_allclose(path.set_point, 0.3 * (1 - np.exp(-time / 0.05)), atol=1e-3)


def test_a_load_swings_hangs_sticks_and_is_lifted_by_an_integral_term():
    swing = left_alone(
        Servo(stiffness=1e-9, damping=0, gravity=30, gravity_phase=0.01, friction=0), 5.0
    )
    exact = -0.01 + 0.01 * np.cos(np.sqrt(30) * (swing.time_s + 1.5))
    np.testing.assert_allclose(swing.angle, exact, atol=3e-5)
    still = Servo(stiffness=100, friction=20, gravity=15, gravity_phase=np.pi / 2)
    assert np.abs(left_alone(still, 2.0).angle).max() < 1e-12
    droop = Servo(stiffness=1000, damping=60, friction=0, gravity=50, gravity_phase=np.pi / 2)
    end = left_alone(droop, 3.0).angle[-1]
    assert 1000 * end + 50 * np.cos(end) == pytest.approx(0.0, abs=1e-2)
    lifted = left_alone(droop._replace(integral=5e3, integral_clamp=200), 8.0)
    assert lifted.angle[-1] == pytest.approx(0.0, abs=1e-4)


def test_two_masses_that_a_stiff_spring_joins_move_as_one():
    one = Servo(stiffness=2500, damping=60, **HARD)
    two = one._replace(motor_share=0.6, link_stiffness=0.4 * 800.0**2, link_damping=100)
    paths = [stepped(servo, 0.3, 0.8)[1].angle for servo in (one, two)]
    np.testing.assert_allclose(*paths, atol=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_step_four_times_as_long_moves_a_servo_alike(kind):
    twin, _, sent, commands = draw_twin(kind, "tones", 0, 3)
    plain, rng = twin.servo._replace(dead_time_jitter_s=0.0), np.random.default_rng(0)
    stop = twin.stretches[0].duration_s  # later, play and profiles amplify any difference
    rough, fine = (simulate(plain, sent, commands, stop, rng, step) for step in (2e-4, 5e-5))
    difference = rough.angle - np.interp(rough.time_s, fine.time_s, fine.angle)
    assert difference.std() < max(0.005 * fine.angle.std(), twin.servo.play)
