"""The robot that walks stands, executes commands on time, reports its state, passes the guard."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from pupper_sysid.sim.robot.mini_pupper import default_pose
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.robot import WalkingBus, WalkingRobot, calibrated_robot
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.servo_servers import exact_spec
from support.tiny_training import CALIBRATION

POSE = np.array([DEFAULT_POSE[name] for name in JOINT_NAMES])
HIP, THIGH, CALF = 0, 1, 2
FORWARD, TURN = (0.15, 0.0, 0.0), (0.0, 0.0, 0.5)
PERIOD_S = 0.02


def make_robot(seed: int = 0, spec: RobotSpec | None = None) -> WalkingRobot:
    rng = np.random.default_rng(seed)
    return WalkingRobot(draw_robot(rng, spec), rng)


def make_bus(seed: int = 0, spec: RobotSpec | None = None) -> WalkingBus:
    rng = np.random.default_rng(seed)
    return WalkingBus(draw_robot(rng, spec), rng)


def trot(time_s: float, command: tuple[float, float, float]) -> np.ndarray:
    """Joint targets of the trot, begun at 0 s."""
    phase = 2 * np.pi * Trot().frequency_hz * time_s
    return Trot().joints(np.array([phase]), np.array([command]))[0]


def walk(
    bus: ServoBus,
    seconds: float,
    command: tuple[float, float, float] = FORWARD,
    look: Callable[[], None] = lambda: None,
) -> None:
    """Switch the torque on, stand for half a second, trot for `seconds`, at 50 Hz."""
    bus.read()
    bus.torque(True)
    start = bus.now()
    while (since := bus.now() - start) < seconds + 0.5:
        bus.write(default_pose() if since < 0.5 else trot(since - 0.5, command))
        bus.read()
        look()
        bus.sleep_until(start + PERIOD_S * (np.floor(since / PERIOD_S) + 1))


# ---- commands ----


def test_a_command_between_physics_steps_keeps_its_timing():
    # a step that neither the speed nor the torque limit swallows
    linear = RobotSpec(velocity_limit_rad_s=1e3, friction_per_inertia=0.0)
    on_a_step, between = make_robot(spec=linear), make_robot(spec=linear)
    on_a_step.command(HIP, 0.010, 0.03)
    between.command(HIP, 0.0104, 0.03)
    times = np.arange(0.03, 0.12, 0.003)
    earlier = np.array([on_a_step.angle(HIP, t) for t in times])
    later = np.array([between.angle(HIP, t + 0.0004) for t in times])
    assert np.ptp(earlier) > 0.025
    # taken on the next step it would be 0.6 ms late: 0.9 mrad at 1.5 rad/s
    np.testing.assert_allclose(later, earlier, atol=4e-4)


def test_a_limp_servo_ignores_goals_and_holds_where_it_is_when_switched_on_again():
    robot = make_robot()
    robot.torque(HIP, 0.1, False)
    robot.command(HIP, 0.2, 0.3)
    assert robot.angle(HIP, 1.0) == pytest.approx(0.0, abs=0.02)
    assert robot.load(HIP) == 0.0
    robot.torque(HIP, 1.0, True)
    held = robot.angle(HIP, 1.0)
    assert robot.angle(HIP, 2.0) == pytest.approx(held, abs=0.02)
    robot.command(HIP, 2.0, 0.3)
    assert robot.angle(HIP, 3.0) > 0.25


# ---- the IMU ----


def test_standing_the_imu_reads_one_g_up_with_the_noise_it_says_in_whole_counts():
    robot = make_robot()
    samples = [robot.imu(t) for t in np.arange(0.002, 8.0, 1 / 235)]
    force = np.array([s.acceleration_m_s2 for s in samples if s])
    rate = np.array([s.rate_rad_s for s in samples if s])
    np.testing.assert_allclose(force.mean(axis=0), [0, 0, 9.81], atol=0.02)
    # four standard errors of a standard deviation from 1880 numbers are 6.5 %
    np.testing.assert_allclose(force.std(axis=0), 0.002 * 9.80665, rtol=0.07)
    np.testing.assert_allclose(rate.std(axis=0), np.radians(0.15), rtol=0.08)
    counts = np.degrees(rate) * 16
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)


def test_a_robot_pushed_onto_its_back_says_so():
    robot = make_robot()
    robot.push(np.array([0.0, 1.5]))
    reads = [robot.imu(t) for t in np.arange(0.005, 1.0, 0.005)]
    assert robot.trunk(3.0).upright < -0.9
    last = robot.imu(3.0)
    assert last is not None and last.acceleration_m_s2[2] < -9.5
    # it rolls over its left side, and hits the ground harder than the chip can measure
    roll = np.array([s.rate_rad_s[0] for s in reads if s])
    assert roll.min() < -3 and abs(roll.min()) > roll.max()
    assert any(s.clipped for s in reads if s)


# ---- the bus ----


def test_readings_and_goals_are_joint_angles_a_calf_relative_to_its_thigh():
    bus = make_bus(spec=exact_spec())
    goal = default_pose()
    goal[THIGH] += 0.1
    bus.write(goal)
    bus.sleep_until(1.5)
    position = bus.read().position_rad
    np.testing.assert_allclose(position, goal, atol=0.04)
    # in servo coordinates the calf's servo has turned with the thigh: its joint has not
    assert bus.robot.angle(CALF, 1.5) - POSE[CALF] == pytest.approx(0.1, abs=0.04)
    assert bus.metadata["coordinates"] == "joint"


# ---- walking ----


def test_the_guard_lets_a_trotting_robot_walk():
    bus = make_bus()
    guard = GuardedBus(bus)
    force, upright = [], []

    def look():
        trunk = bus.robot.trunk(bus.now())
        upright.append(trunk.upright)
        # over all of a tick: commands come in steps, and each part of a tick has its own jerk
        force.extend(bus.robot.imu(bus.now() + s) for s in np.arange(0.002, 0.018, 1 / 235))

    walk(guard, 5.0, look=look)
    trunk = bus.robot.trunk(bus.now())
    # 0.15 m/s with some slip
    assert trunk.position_m[0] > 0.85 * 0.15 * 5.0
    assert min(upright) > 0.98
    mean = np.mean([s.acceleration_m_s2 for s in force if s], axis=0)
    # without flight or fall the mean specific force is g
    np.testing.assert_allclose(mean, [0.0, 0.0, 9.81], atol=0.5)
    guard.park()
    assert guard.report.missing == 0 and guard.report.unsent == 0


def test_an_emulated_robot_has_the_servos_and_the_polls_of_a_calibration():
    servos = servo_ranges(CALIBRATION)
    robot = calibrated_robot(servos, np.random.default_rng(0))
    at_1_ms = servos.in_steps_of(0.001)
    assert robot.joint_names == JOINT_NAMES
    for i, servo in enumerate(robot.servos):
        for name in servos.value:
            expected = (at_1_ms if name == "dead_time_s" else servos).value[name][i]
            assert getattr(servo.actuator, name) == pytest.approx(expected), name
    assert robot.spec.poll_period_s == pytest.approx(0.0268, abs=1e-4)
    assert robot.spec.loss == pytest.approx(np.median([f.loss for f in servos.feedback]))


def test_the_jitter_of_commands_is_a_part_of_the_dead_time():
    servos = replace(servo_ranges(CALIBRATION), command_jitter_s=0.004)
    late = calibrated_robot(servos, np.random.default_rng(0))
    steady = calibrated_robot(replace(servos, command_jitter_s=0.0), np.random.default_rng(0))
    for a, b in zip(late.servos, steady.servos, strict=True):
        assert a.actuator.dead_time_s == pytest.approx(b.actuator.dead_time_s - 0.004)
    assert late.spec.command_jitter_s == 0.004
