"""A loaded servo moves as its numbers and registers say; each claim is one formula."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.sim.emulator.pendulum import (
    PendulumServo,
    PendulumServoParameters,
)

COUNT = 2 * np.pi / 4096
EXACT = PendulumServoParameters(
    torque_nm=1.8, duty_per_rad=0.2, back_emf_nm_s_rad=0.3, friction_nm=0.0,
    armature_kg_m2=0.01, dead_time_s=0.012,
)  # fmt: skip
LOADED = replace(EXACT, mass_kg=0.2, length_m=0.1)


def moved(servo: PendulumServo, start: float, stop: float, step: float = 0.001) -> np.ndarray:
    return np.array([servo.position_at(t) for t in np.arange(start, stop, step)])


def test_nothing_moves_before_the_dead_time_has_passed_and_then_at_once():
    servo = PendulumServo(EXACT, 0.0)
    servo.command(0.1004, 0.5)
    before, after = servo.position_at(0.1124), servo.position_at(0.1224)
    # within the step in which the command arrives the duty is at most full
    assert before == pytest.approx(0.0, abs=1.8 / 0.01 * 0.001**2)
    # half of the duty's 100 ms⁻²: tau / J * t² / 2 with full duty, less a few per cent of back-EMF
    assert after == pytest.approx(0.5 * 1.8 / 0.01 * 0.01**2, rel=0.2)


def test_gravity_pulls_the_held_mass_down_by_its_torque_over_the_stiffness():
    servo = PendulumServo(LOADED, 0.0)
    servo.set_register(0.0, "p", 16)
    servo.command(0.0, 1.0)
    held = servo.position_at(4.0)
    sag = 0.2 * 9.81 * 0.1 * np.sin(held) / (1.8 * 0.2 * 16)
    assert 1.0 - held == pytest.approx(sag, rel=1e-3)


def test_a_limp_frictionless_pendulum_swings_at_its_own_frequency():
    servo = PendulumServo(replace(LOADED, hanging_rad=0.3), 0.4)
    servo.torque(0.0, False)
    way = moved(servo, 0.0, 6.0) - 0.3
    crossings = np.flatnonzero(np.diff(np.sign(way)) != 0)
    period = 2 * np.mean(np.diff(crossings)) * 0.001
    inertia = 0.01 + 0.2 * 0.1**2
    assert period == pytest.approx(2 * np.pi * np.sqrt(inertia / (0.2 * 9.81 * 0.1)), rel=2e-3)
    assert servo.load == 0.0


def test_coulomb_friction_holds_what_it_can():
    weight = 0.2 * 9.81 * 0.1
    for friction, stays in ((1.05, True), (0.8, False)):
        own = replace(LOADED, friction_nm=friction * weight * np.sin(0.5))
        servo = PendulumServo(own, 0.5)
        servo.torque(0.0, False)
        assert (abs(servo.position_at(1.0) - 0.5) < 1e-3) == stays


def test_goal_speed_and_acceleration_make_the_servo_a_ramp():
    servo = PendulumServo(EXACT, 0.0, {"goal_speed": 500, "acceleration": 20})
    servo.command(0.0, 1.5)
    way = moved(servo, 0.0, 3.5)
    assert (way[1500] - way[1000]) / 0.5 == pytest.approx(500 * COUNT, rel=0.02)
    assert way[-1] == pytest.approx(1.5, abs=2e-3)
    # distance d at speed v and acceleration a takes d / v + v / a, plus the servo's own lag
    ramp = 1.5 / (500 * COUNT) + 500 / 2000
    arrived = 0.001 * np.argmax(way > 1.49)
    assert ramp < arrived + 0.15 and arrived < ramp + 0.3


@pytest.mark.parametrize(
    ("registers", "friction_nm", "duty"), [({}, 0.06, 1.0), ({"torque_limit": 250}, 0.0, 0.25)]
)
def test_the_free_speed_is_the_torque_of_the_largest_duty_over_back_emf(
    registers, friction_nm, duty
):
    servo = PendulumServo(replace(EXACT, friction_nm=friction_nm), 0.0, registers)
    servo.command(0.0, 30.0)
    way = moved(servo, 1.5, 1.6)
    assert servo.load == pytest.approx(duty)
    assert (way[50] - way[0]) / 0.05 == pytest.approx((1.8 * duty - friction_nm) / 0.3, rel=5e-3)


def test_inside_the_dead_zone_there_is_no_duty_and_outside_at_least_the_minimum_force():
    own = replace(EXACT, count_rad=COUNT, friction_nm=0.02)
    servo = PendulumServo(
        own, 0.0, {"dead_zone_cw": 3, "dead_zone_ccw": 3, "min_start_force": 200, "d": 0}
    )
    servo.command(0.0, 3 * COUNT)
    assert servo.position_at(0.5) == pytest.approx(0.0, abs=1e-6) and servo.load == 0.0
    servo.command(0.5, 4 * COUNT)
    servo.position_at(0.5125)
    # 4 counts would be 0.2 * 32 * 4 * COUNT = 0.039 of full duty
    assert servo.load == pytest.approx(0.2)


def test_gears_with_play_let_the_output_move_by_the_play():
    own = replace(LOADED, backlash_rad=0.04, friction_nm=0.5, output_friction_nm=0.0)
    servo = PendulumServo(own, 0.3)
    servo.torque(0.0, False)  # the motor's friction holds it; the load lies on the lower tooth
    rest = servo.position_at(0.5)
    servo._still = 0
    servo._data.qvel[1] = 1.8  # a push lifts the load off the tooth, and it falls back
    way = moved(servo, 0.5, 2.0)
    assert 0.03 < way.max() - rest < 0.045
    assert way[-1] == pytest.approx(rest, abs=2e-3)
