"""Readings of many robots are as stale, quantised and biased as the measured feedback."""

import numpy as np
import pytest

from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sim.walking.senses import HeldReadings

H, SUBSTEPS = 0.002, 10
SPAN = H * SUBSTEPS
MEASURED = HeldFeedback(poll_period_s=0.0268, loss=0.42)
JITTER_S = 0.0008 * np.sqrt(3)  # half width of a uniform jitter of 0.8 ms standard deviation


def advance(readings: HeldReadings, position: np.ndarray, load: np.ndarray) -> None:
    """Positions and loads at the start and after each physics step."""
    chances = readings.chances(position.shape[1] - 1)
    readings.advance(position[:, 0], position[:, 1:].copy(), load[:, 1:].copy(), chances)


class Bus:
    """`HeldReadings` whose robots move at one constant speed, so that a reading gives its time."""

    def __init__(self, feedback: HeldFeedback, environments=200, servos=12, speed=1.0, seed=0):
        self.readings = HeldReadings(
            (feedback,) * servos, environments, H, np.random.default_rng(seed)
        )
        self.shape, self.speed, self.time = (environments, servos), speed, 0.0
        self.readings.reset(np.arange(environments), np.zeros(self.shape))

    def step(self) -> None:
        times = self.time + H * np.arange(SUBSTEPS + 1)
        robots, servos = self.shape
        position = np.tile((self.speed * times)[None, :, None], (robots, 1, servos))
        advance(self.readings, position, 10 * position)
        self.time = times[-1]


def settled(feedback: HeldFeedback, **options) -> Bus:
    """After so long that no reading is of the start."""
    bus = Bus(feedback, **options)
    for _ in range(60):
        bus.step()
    return bus


def test_the_mean_age_is_the_feedbacks():
    for period, loss in ((0.006, 0.0), (0.0268, 0.0), (0.0268, 0.42), (0.006, 0.7)):
        feedback = HeldFeedback(poll_period_s=period, loss=loss)
        bus = settled(feedback)
        ages = []
        for _ in range(60):
            bus.step()
            ages.append(bus.readings.age_s.mean())
        # an age is uniform over a round, plus a geometric number of missed rounds
        spread = period * np.sqrt(1 / 12 + loss / (1 - loss) ** 2)
        # and is another one after a successful poll or two
        independent = bus.shape[0] * bus.shape[1] * 60 * SPAN / (3 * (period / (1 - loss) + SPAN))
        error = 4 * spread / np.sqrt(independent)
        assert error < 0.05 * feedback.mean_age_s + 1e-4, "too few readings"
        assert np.mean(ages) == pytest.approx(feedback.mean_age_s, abs=error), (period, loss)


def test_a_reading_is_the_position_at_the_instant_of_its_poll_and_servos_come_in_turn():
    bus = settled(MEASURED, speed=3.0)
    age = bus.readings.age_s
    assert age.min() >= 0
    assert age.max() > 5 * MEASURED.poll_period_s
    np.testing.assert_allclose(bus.time * 3.0 - bus.readings.position, 3.0 * age, atol=1e-9)
    # a twelfth of a round apart
    bus = settled(HeldFeedback(poll_period_s=0.0268), environments=300)
    polled = np.exp(2j * np.pi * np.diff(bus.time - bus.readings.age_s, axis=1) / 0.0268)
    round_ = np.angle(polled) / (2 * np.pi)
    assert round_.mean() == pytest.approx(1 / 12, abs=0.005)
    assert np.abs(round_ - 1 / 12).max() < (2 * JITTER_S + 12e-5) / 0.0268


def test_readings_are_whole_counts_of_the_offset_position():
    feedback = HeldFeedback(quantum_rad=0.01, offset_rad=0.003)
    readings = HeldReadings((feedback,), 1, H, np.random.default_rng(0))
    readings.reset(np.array([0]), np.array([[0.0]]))
    for position, expected in ((0.0, 0.0), (0.0019, 0.0), (0.0021, 0.01), (-0.0081, -0.01)):
        advance(readings, np.full((1, 2, 1), position), np.zeros((1, 2, 1)))
        assert readings.position[0, 0] == pytest.approx(expected, abs=1e-12)
    readings.reset(np.array([0]), np.array([[0.052]]))
    assert readings.position[0, 0] == pytest.approx(0.06)  # 0.055 rounds to the even count


def test_resetting_some_robots_leaves_the_others_alone():
    bus = settled(MEASURED, environments=4)
    before = {k: v.copy() for k, v in bus.readings.state.items()}
    bus.readings.reset(np.array([1, 3]), np.full((2, 12), -7.0))
    np.testing.assert_array_equal(bus.readings.position[[1, 3]], -7.0)
    assert not bus.readings.load[[1, 3]].any()
    for name, value in bus.readings.state.items():
        np.testing.assert_array_equal(value[[0, 2]], before[name][[0, 2]])


def test_a_linked_servo_reads_the_sum_of_its_joint_and_the_one_before():
    feedback, rng = HeldFeedback(poll_period_s=0.006), np.random.default_rng(0)
    for each in (feedback, HeldFeedback()):
        servos = HeldReadings((each,) * 3, 20, H, np.random.default_rng(0))
        joints = HeldReadings((each,) * 3, 20, H, np.random.default_rng(0), linked=(2,))
        for readings in (servos, joints):
            readings.reset(np.arange(20), np.zeros((20, 3)))
        for _ in range(5):
            joint = rng.standard_normal((20, SUBSTEPS + 1, 3))
            servo = joint.copy()
            servo[..., 2] += joint[..., 1]
            advance(servos, servo, servo)
            advance(joints, joint, servo)
        np.testing.assert_allclose(joints.position, servos.position, atol=1e-12)
