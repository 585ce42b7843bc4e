"""The emulated robot has the errors of its specification, by their size, and is repeatable."""

import time
from dataclasses import replace
from threading import Thread
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.servo_models.delayed_pd import DelayedPD
from pupper_sysid.sim.emulator.bench import FreeAirServo, PollSchedule, ServoBench
from pupper_sysid.sim.emulator.bus import TRUTH_COLUMNS, EmulatedBus
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from support.servo_parameters import MEASURED

POSE = np.array([DEFAULT_POSE[name] for name in JOINT_NAMES])
PERFECT = RobotSpec(
    poll_period_s=0.0, loss=0.0, quantum_rad=0.0, reading_noise_rad=0.0, offset_sd_rad=0.0,
    sleep_overshoot_s=0.0,
)  # fmt: skip


def make_bus(spec: RobotSpec, seed: int = 1) -> EmulatedBus:
    rng = np.random.default_rng(seed)
    return EmulatedBus(draw_robot(rng, spec), rng)


def swing(bus: EmulatedBus, seconds: float, amplitude: float = 0.3, hertz: float = 2.3):
    """All joints on a sine; returns (send time, goal, sample) per tick of 19 ms."""
    start, ticks = bus.now(), []
    for k in range(int(seconds / 0.019)):
        bus.sleep_until(start + k * 0.019)
        goal = POSE + amplitude * np.sin(2 * np.pi * hertz * (bus.now() - start))
        ticks.append((bus.write(goal).time_s, goal, bus.read()))
    return ticks


def table_of(bus: EmulatedBus) -> pd.DataFrame:
    return pd.DataFrame(bus.truth_rows(), columns=list(TRUTH_COLUMNS))


def test_a_servo_moves_as_delayed_pd_and_commands_between_physics_steps_keep_their_timing():
    step = 0.001
    steps = np.arange(1500)
    commands = 0.785 + np.where(steps % 19 == 0, 0.3 * np.sin(2 * np.pi * 3 * steps * step), np.nan)
    commands = pd.Series(commands).ffill().to_numpy()
    model = DelayedPD(MEASURED, step)
    model.reset(np.array(0.785))
    expected = model.rollout(commands)
    servo = FreeAirServo(MEASURED, 0.785, step)
    got = []
    for k in steps:
        servo.command(k * step, commands[k])
        got.append(servo.position_at((k + 1) * step))
    np.testing.assert_allclose(got, expected, atol=1e-9)
    servo = FreeAirServo(MEASURED, 0.0, step)
    servo.command(0.0104, 0.3)
    later = DelayedPD(replace(MEASURED, dead_time_s=0.0254), step)
    later.reset(np.array(0.0))
    expected = later.rollout(np.where(np.arange(300) >= 10, 0.3, 0.0))
    got = [servo.position_at((k + 1) * step) for k in range(300)]
    # at rest MuJoCo's friction creeps by microradians, which the emulator leaves out
    np.testing.assert_allclose(got[:100], expected[:100], atol=1e-9)
    np.testing.assert_allclose(got, expected, atol=1e-5)
    # between two steps it lies on the line
    servo.command(0.5, 0.0)
    first, inside, last = (servo.position_at(t) for t in (0.55, 0.55025, 0.551))
    assert first > inside == pytest.approx(0.75 * first + 0.25 * last, abs=1e-12)


def test_readings_are_the_position_at_the_poll_rounded_to_counts_with_the_offset():
    bus = make_bus(RobotSpec(reading_noise_rad=0.0, poll_drift=0.0))
    ticks = swing(bus, 3.0)
    truth = table_of(bus)
    for i, truth_of in enumerate(bus.robot.servos):
        rows = truth[truth["joint"] == truth_of.joint].reset_index()
        twin, quantum = FreeAirServo(truth_of.actuator, POSE[i]), truth_of.feedback.quantum_rad
        # the goal after truncation of its count: the next whole count in the count's direction
        whole = np.ceil if truth_of.command_rounding == "up" else np.floor
        reading = np.array([sample.position_rad[i] for _, _, sample in ticks])
        sent = iter(ticks)
        pending = next(sent)
        for k, at in enumerate(rows["reading_time_s"]):
            while pending is not None and pending[0] < at:
                count = whole((pending[1][i] - truth_of.zero_rad) / quantum - 1e-12)
                twin.command(pending[0], truth_of.zero_rad + count * quantum)
                pending = next(sent, None)
            error = reading[k] - truth_of.feedback.offset_rad - twin.position_at(at)
            assert abs(error) <= 0.5 * quantum + 1e-6


def test_age_and_loss_of_the_readings_are_those_of_held_feedback():
    loss, duration = 0.42, 120.0
    spec = RobotSpec(loss=loss, friction_per_inertia=0.0)
    bus = make_bus(spec)
    swing(bus, 5.0)
    start = bus.now()
    for k in range(int(duration / 0.019)):
        bus.sleep_until(start + k * 0.019)
        bus.read()
    log = [(t, measured) for t, _, measured in bus._log if t > start]
    age = np.array([t - measured for t, measured in log])
    assert age.min() > 0
    expected = bus.robot.servos[0].feedback.mean_age_s
    assert age.mean() == pytest.approx(expected, rel=0.02)
    polls = duration / spec.poll_period_s
    # a read every 19 ms sees every success of a poll every 26.85 ms
    seen = np.array([len(np.unique([m[i] for _, m in log])) for i in range(12)])
    sd = np.sqrt(12 * polls * loss * (1 - loss))
    drift = 12 * polls * spec.poll_drift
    assert abs(seen.sum() - 12 * polls * (1 - loss)) < 4 * sd + drift + 12


def test_polls_lie_on_their_lattice_within_jitter_and_drift():
    rng = np.random.default_rng(5)
    still = PollSchedule(0.02685, np.array([0.004]), 0.0, 0.0, 0.0, rng)
    instants = np.unique([still.advance(t)[0] for t in np.arange(0.05, 10.0, 0.01)])
    np.testing.assert_allclose(np.diff(instants), 0.02685, atol=1e-9)
    shift = (instants - 0.004) / 0.02685
    np.testing.assert_allclose(shift, np.round(shift), atol=1e-6)
    jittery = PollSchedule(0.02685, np.array([0.0]), 0.0, 0.0008, 0.0, rng)
    instants = np.unique([jittery.advance(t)[0] for t in np.arange(0.05, 60.0, 0.01)])
    residual = instants - 0.02685 * np.round(instants / 0.02685)
    # four standard errors of a standard deviation from 2232 instants are 6 %
    assert residual.std() == pytest.approx(0.0008, rel=0.06)
    drifting = PollSchedule(0.02685, np.array([0.0]), 0.0, 0.0, 0.002, rng)
    instants = np.unique([drifting.advance(t)[0] for t in np.arange(0.05, 300.0, 0.02)])
    periods = np.diff(instants)
    assert 0.001 < periods.std() / 0.02685 < 0.003
    assert np.corrcoef(periods[1:], periods[:-1])[0, 1] > 0.95, "it must wander, not jitter"


def test_the_mean_servo_is_the_published_one():
    rng = np.random.default_rng(11)
    servos = [s.actuator for _ in range(40) for s in draw_robot(rng).servos]
    per_inertia = [s.per_inertia() for s in servos]
    for name, mean in (("stiffness", 12_700), ("damping", 103), ("friction_loss", 207)):
        logs = np.log([float(np.asarray(getattr(s, name))) for s in per_inertia])
        # 480 servos: the mean's standard error is 0.5 %, the spread's 3 %
        assert logs.mean() == pytest.approx(np.log(mean), abs=0.02)
        assert logs.std() == pytest.approx(0.10, rel=0.15)
    delays = np.array([float(np.asarray(s.dead_time_s)) for s in servos])
    assert delays.mean() == pytest.approx(0.025, abs=0.0003)
    assert delays.std() == pytest.approx(0.0015, rel=0.15)
    assert {s.effort_limit for s in servos} == {0.35}


def test_a_dead_time_too_short_for_the_emulator_is_refused():
    with pytest.raises(InputError, match="dead_time_s"):
        FreeAirServo(replace(MEASURED, dead_time_s=0.0015), 0.0)


def test_a_limp_robot_ignores_goals_and_holds_its_pose_when_switched_on_again():
    bus = make_bus(PERFECT)
    bus.torque(False)
    bus.write(POSE + 0.3)
    bus.sleep_until(1.0)
    np.testing.assert_allclose(bus.read().position_rad, POSE, atol=1e-9)
    bus.torque(True)
    bus.sleep_until(2.0)
    np.testing.assert_allclose(bus.read().position_rad, POSE, atol=1e-9)
    bus.write(POSE + 0.3)
    bus.sleep_until(3.0)
    assert (bus.read().position_rad > POSE + 0.25).all()


def test_truth_files_say_every_parameter_and_every_read(tmp_path):
    bus = make_bus(RobotSpec())
    ticks = swing(bus, 1.0)
    numbers, rows = bus.write_truth(tmp_path / "sweep")
    assert (numbers.name, rows.name) == ("sweep.truth.yaml", "sweep.truth.csv")
    truth = yaml.safe_load(numbers.read_text())
    hip = truth["joints"]["LF_hip"]
    assert hip["actuator"]["dead_time_s"] == bus.robot.servos[0].actuator.dead_time_s
    assert hip["feedback"]["loss"] == 0.42 and "phase_s" in hip["feedback"]
    table = pd.read_csv(rows)
    assert tuple(table.columns) == TRUTH_COLUMNS
    assert len(table) == 12 * len(ticks)
    assert (table["reading_time_s"] <= table["read_time_s"]).all()
    assert table["read_time_s"].unique().tolist() == [sample.time_s[0] for _, _, sample in ticks]
    with pytest.raises(FileExistsRefusal):
        bus.write_truth(tmp_path / "sweep")
    bus.write_truth(tmp_path / "sweep", force=True)


def test_a_bench_is_simulated_by_one_thread_at_a_time():
    """A simulation that two threads step at once breaks, and starts anew at zero."""
    inside, most = [0], []

    def alone(*_) -> float:
        inside[0] += 1
        most.append(inside[0])
        time.sleep(0.001)
        inside[0] -= 1
        return 0.0

    plant: Any = SimpleNamespace(angle=alone, command=alone)
    robot = draw_robot(np.random.default_rng(0), RobotSpec())
    bench = ServoBench(
        robot, load_joint_map("mini_pupper_2"), np.random.default_rng(0), plant=plant
    )
    looks = [Thread(target=lambda: [bench.angle(0, 0.0) for _ in range(20)]) for _ in range(2)]
    for thread in looks:
        thread.start()
    for _ in range(20):
        bench.command(0, 0.0, 2048)
    for thread in looks:
        thread.join()
    assert len(most) == 60 and max(most) == 1
