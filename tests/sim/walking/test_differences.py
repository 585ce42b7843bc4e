"""What differs between robots and their model: each setting does what it names, and no more."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pupper_sysid.sim.walking.config import Commands, Curriculum, Observation, Walking
from pupper_sysid.sim.walking.draws import TYPICAL, Differences, Twins, at_rest, generator
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.senses import HeldReadings, Imu
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from pupper_sysid.sim.walking.step import OBSERVATION_PARTS as PARTS
from support.refusals import assert_each_refused
from support.walks import STILL

MEASURED = "data/samples/calibrated.yaml"
SPAN = 0.02


def make(actuator: str = "ideal", count: int = 40, **differences) -> PupperEnv:
    task = Walking(
        randomisation=STILL, observation=Observation(noise=False),
        differences=Differences(**differences),
    )  # fmt: skip
    return PupperEnv(task, servo_ranges(actuator), count, seed=3, threads=1)


def stand(env: PupperEnv, steps: int) -> np.ndarray:
    """The last observation of robots that stand in their default pose."""
    for _ in range(steps):
        found = env.step(np.zeros((env.environments, 12))).observation
    return found


def test_a_wrong_zero_is_in_commands_and_readings_alike():
    env = make(joint_zero_rad=0.05)
    seen = stand(env, 30)
    zero = env.robots.bodies.zero_rad
    assert np.abs(zero).max() <= 0.05 and zero.std() > 0.02  # of a uniform draw: 0.029
    wrong = env.robots.to_servo(env.robots.joints) - env.robots.to_servo(env.default)
    # stiff servos of 20 N·m/rad give way by milliradians under the robot's weight
    np.testing.assert_allclose(wrong, zero, atol=0.01)
    np.testing.assert_allclose(seen[:, PARTS["joint_position_relative"]], 0.0, atol=0.01)


def imu(**settings) -> Imu:
    return Imu(Differences(**settings), 3, SPAN)


def ramp(time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """A rate that grows by 1 rad/s², level."""
    return np.full((3, 3), time_s), np.tile([0.0, 0.0, -1.0], (3, 1))


def test_a_late_imu_reports_what_was_so_much_earlier():
    for latency_s in (0.0, 0.005, 0.02, 0.033):
        own, rng = imu(imu_latency_s=(latency_s, latency_s)), np.random.default_rng(0)
        own.reset(np.arange(3), *ramp(0.0), rng)
        for k in range(1, 9):
            own.advance(slice(0, 3), *ramp(k * SPAN))
            rate, gravity = own.read(slice(None), *ramp(k * SPAN))
            np.testing.assert_allclose(rate, max(k * SPAN - latency_s, 0.0), atol=1e-12)
            np.testing.assert_allclose(gravity, ramp(0.0)[1])


def test_samples_of_a_slow_imu_are_a_period_apart():
    own, rng = imu(imu_period_s=(0.03, 0.03)), np.random.default_rng(1)
    own.reset(np.arange(3), *ramp(0.0), rng)
    sampled = []
    for k in range(1, 40):
        own.advance(slice(0, 3), *ramp(k * SPAN))
        rate = own.read(slice(None), *ramp(k * SPAN))[0][:, 0]
        sampled.append(rate.copy())
        assert ((rate > k * SPAN - 0.03 - 1e-9) & (rate <= k * SPAN + 1e-9)).all()
    steps = np.diff(np.array(sampled[3:]), axis=0)
    whole = np.round(steps / 0.03)
    np.testing.assert_allclose(steps, 0.03 * whole, atol=1e-9)
    assert set(whole.ravel()) == {0.0, 1.0}  # 20 ms per step: every third step has no new sample


def test_an_imu_mounted_askew_sees_tilted_gravity_and_biased_rates():
    own = imu(imu_mounting_rad=0.05, gyro_bias_rad_s=0.03)
    own.reset(np.arange(3), *ramp(0.0), np.random.default_rng(2))
    rate, gravity = own.read(slice(None), *ramp(0.0))
    np.testing.assert_array_equal(rate, own.bias_rad_s)
    assert (own.bias_rad_s != 0).all() and np.abs(own.bias_rad_s).max() <= 0.03
    # a pitch of +θ of the IMU brings its x axis down: gravity has a part along it
    expected = np.stack([-own.mounting_rad[:, 1] * -1.0, own.mounting_rad[:, 0] * -1.0], axis=1)
    np.testing.assert_allclose(gravity[:, :2], expected, atol=2e-4)  # θ³/6 and cos θ
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 1.0)


def test_a_low_battery_takes_stiffness_torque_and_speed_together():
    env = make(MEASURED, battery=(0.5, 0.5))
    servos = env.servos
    for name in ("stiffness", "effort_limit", "velocity_limit"):
        assert (env.robots.drawn[name] <= 0.5 * servos.high[name] * 1.0001).all()
        assert (env.robots.drawn[name] >= 0.5 * servos.low[name] * 0.9999).all()
    for name in ("friction_loss", "damping", "armature"):
        assert (env.robots.drawn[name] >= servos.low[name] * 0.9999).all()


def test_servos_of_one_type_differ_between_joints_by_the_spread_and_not_where_as_calibrated():
    env = make(servo_spread=0.1, as_calibrated=0.5, count=200, actuator="ideal")
    value = env.servos.value["stiffness"]
    share = env.robots.drawn["stiffness"] / value - 1.0
    differ = ~env.robots.bodies.as_calibrated
    np.testing.assert_array_equal(share[~differ], 0.0)
    assert np.abs(share[differ]).max() <= 0.1 + 1e-12
    assert share[differ].std() == pytest.approx(0.1 / np.sqrt(3), rel=0.1)
    # each joint by itself
    assert np.abs(np.corrcoef(share[differ].T) - np.eye(12)).max() < 0.5


def test_one_leg_of_a_share_of_robots_is_weak():
    env = make("paper", 400, weak_leg_share=0.5, weak_leg=(0.3, 0.3))
    share = env.robots.drawn["effort_limit"] / env.servos.value["effort_limit"]
    legs = share.reshape(400, 4, 3)
    weak = np.isclose(legs, 0.3).all(axis=2)
    assert set(weak.sum(axis=1)) == {0, 1}
    assert 0.375 < weak.any(axis=1).mean() < 0.625  # five standard deviations
    np.testing.assert_allclose(legs[~weak], 1.0)
    assert weak.any(axis=0).all()


def test_the_centre_of_mass_moves_in_the_physics():
    env = make(centre_of_mass_m=(0.01, 0.0, 0.02))
    trunk = env.robots.model.body("trunk").id
    at = env.robots.field("body_ipos")[:, trunk] - env.robots.model.body_ipos[trunk]
    np.testing.assert_allclose(at, env.robots.bodies.centre_m, atol=1e-12)
    assert (at[:, 1] == 0).all() and np.abs(at[:, 0]).max() <= 0.01 and at[:, 2].std() > 0.008


def test_a_share_of_robots_is_as_calibrated():
    env = make(
        "paper", 200, as_calibrated=0.5, joint_zero_rad=0.05, centre_of_mass_m=(0.01, 0.01, 0.01),
        command_jitter=(1.5, 2.0), poll_period=(1.5, 2.0), battery=(0.7, 0.8), missed_ticks=1.0,
        weak_leg_share=1.0, weak_leg=(0.3, 0.3), without_effort=1.0,
    )  # fmt: skip
    bodies, same = env.robots.bodies, env.robots.bodies.as_calibrated
    assert 0.32 < same.mean() < 0.68  # five standard deviations
    stiffness = env.robots.drawn["stiffness"] / env.servos.value["stiffness"]
    for robots, differ in ((same, False), (~same, True)):
        assert (bodies.zero_rad[robots] != 0).all() == differ
        assert (bodies.centre_m[robots] != 0).all() == differ
        for factor in (bodies.jitter, bodies.poll, bodies.effort):
            assert (factor[robots] != 1).all() == differ
        assert (stiffness[robots] < 0.9).any(axis=1).all() == differ
    assert (stiffness[same] == 1).all()
    env = make(as_calibrated=0.5, missed_ticks=1.0)
    env.step(np.full((40, 12), 0.3))
    np.testing.assert_array_equal(env.action[:, 0] != 0, env.robots.bodies.as_calibrated)


def test_a_robot_of_longer_rounds_is_read_more_rarely():
    feedback = servo_ranges(MEASURED).feedback
    ages = []
    for factor in (1.0, 2.0):
        readings = HeldReadings(
            feedback, 200, 0.002, np.random.default_rng(0), shortest_period=min(factor, 1.0)
        )
        readings.reset(np.arange(200), np.zeros((200, 12)), np.full(200, factor))
        seen = []
        for _ in range(60):
            readings.advance(
                np.zeros((200, 12)), np.zeros((200, 10, 12)), np.zeros((200, 10, 12)),
                readings.chances(10),
            )  # fmt: skip
            seen.append(readings.age_s.mean())
        ages.append(np.mean(seen[20:]))
    # the age of a poll that never fails is half a period; losses add whole ones
    assert ages[1] == pytest.approx(2 * ages[0], rel=0.05)


def test_commands_within_the_dead_band_mean_stand():
    given = np.array([[0.01, 0.0, 0.04], [0.01, 0.011, 0.0], [0.01, 0.0, 0.06], [0.1, 0.0, 0.0]])
    commands = Commands(dead_band=(0.0145, 0.05))
    expected = given.copy()
    expected[0] = 0.0
    np.testing.assert_array_equal(at_rest(commands, given), expected)
    env = make()
    env.set_command(np.array([0.01, 0.0, 0.0]))
    assert (env.command == 0).all()


def test_the_critic_sees_what_was_drawn():
    env = make(MEASURED, **{f.name: getattr(TYPICAL, f.name) for f in fields(Differences)})
    seen = env.observe()[1]
    bodies, imu = env.robots.bodies, env._senses.imu
    sight = {tuple(np.round(column, 5)) for column in seen.T}
    for truth in (
        20 * bodies.zero_rad, 100 * bodies.centre_m, 20 * imu.mounting_rad, 20 * imu.bias_rad_s,
        50 * imu.latency_s[:, None], 50 * imu.period_s[:, None], bodies.poll[:, None],
        bodies.jitter[:, None], bodies.effort[:, None],
    ):  # fmt: skip
        for column in truth.T:
            assert column.std() > 0
            assert tuple(np.round(column.astype(np.float32), 5)) in sight


def test_ranges_that_cannot_be_drawn_from_are_refused():
    wrong = ({"missed_ticks": 1.5}, {"battery": (1.2, 0.8)}, {"joint_zero_rad": -0.1})
    assert_each_refused(
        [(settings, "differences") for settings in wrong], lambda settings: Differences(**settings)
    )


# ----- twins: one robot under several conditions


def test_twins_have_the_same_numbers_and_others_have_their_own():
    rng = generator(3, Twins(np.array([0, 1, 2, 0, 1]), 3))
    plain = np.random.default_rng(3)
    for draw in (
        lambda r, n: r.uniform(-1.0, np.arange(1.0, 5.0), (n, 4)), lambda r, n: r.random(n),
        lambda r, n: r.integers(0, 9, n), lambda r, n: r.exponential(5.0, n),
        lambda r, n: r.standard_normal((n, 1)),
    ):  # fmt: skip
        np.testing.assert_array_equal(draw(rng, 5), draw(plain, 3)[[0, 1, 2, 0, 1]])
        draw(rng, 2)  # of some robots only: leaves the others' numbers alone


def test_twins_walk_alike_until_their_conditions_differ():
    """The third robot equals the first but for 40 ms of dead time."""
    servos = servo_ranges("data/samples/calibrated.yaml")
    task = Walking(curriculum=Curriculum())
    task = replace(task, randomisation=replace(task.randomisation, push_m_s=0.0))
    alike, later = (
        PupperEnv(task, servos, 3, 0, 1, None, extra, Twins(np.array([0, 1, 0]), 2))
        for extra in (0.0, np.array([0.0, 0.0, 0.04]))
    )
    late_s = later.robots.drawn["dead_time_s"]
    np.testing.assert_allclose(late_s[2], late_s[0] + 0.04)
    assert (late_s[1] != late_s[0]).all()
    for env in (alike, later):
        env.set_command(np.zeros(3))
    wave = 0.3 * np.sin(np.arange(40)[:, None] * 0.4 + np.arange(12))
    for action in wave:
        same, late = (env.step(np.repeat(action[None], 3, axis=0)) for env in (alike, later))
    np.testing.assert_array_equal(same.observation[2], same.observation[0])
    np.testing.assert_array_equal(late.observation[:2], same.observation[:2])
    assert not np.allclose(same.observation[1], same.observation[0])
    assert not np.allclose(late.observation[2], late.observation[0])
