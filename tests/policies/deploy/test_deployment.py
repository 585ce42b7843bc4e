"""A policy on the emulated robot: it walks, everything is logged, every fault ends it safely."""

import os
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.cli.programs.pupper_deploy import Driver
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import SyncedText
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy.assembly import WalkScore, assemble, reassemble
from pupper_sysid.policies.deploy.controller import Controller, Rest, Senses
from pupper_sysid.policies.deploy.deployment import IMU_SILENT_S, Outcome, constant, deploy, script
from pupper_sysid.policies.deploy.stacks import STACKS, ServoModelObserver, Stack, suited
from pupper_sysid.policies.deploy.walk_log import read_walk, replay
from pupper_sysid.policies.network.policy_file import CommandRanges, Policy
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.robot.mini_pupper import limits
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.robot import WalkingBus
from pupper_sysid.sim.walking.step import OBSERVATION_PARTS
from support.refusals import assert_each_refused
from support.saved_servo_models import linear_filter
from support.tiny_training import CALIBRATION

JOINTS = load_joint_map("mini_pupper_2")
FORWARD = constant((0.15, 0.0, 0.0))


@pytest.fixture(scope="module")
def policy(policies) -> Policy:
    """The robot stands and twitches."""
    return policies["lstm"]


@pytest.fixture(scope="module")
def logged(policy, tmp_path_factory) -> str:
    """Log of half a second of it."""
    folder = tmp_path_factory.mktemp("logged")
    run(policy, folder, 0.5)
    return (folder / "walk.csv").read_text()


class Trotting(Policy):
    """Acts like the open-loop trot, by a clock."""

    def reset(self, action: np.ndarray) -> None:
        self.tick = 0

    def act(self, observation: np.ndarray) -> np.ndarray:
        trot, pose = Trot(), np.array(list(self.contract.default_pose_rad.values()))
        self.tick += 1
        phase = np.full(1, 2 * np.pi * trot.frequency_hz * self.tick * 0.02)
        target = trot.joints(phase, observation[:, 9:12].astype(float))
        return ((target - pose) / self.contract.action_scale_rad).astype(np.float32)


def robot(seed: int = 0) -> WalkingBus:
    rng = np.random.default_rng(seed)
    return WalkingBus(draw_robot(rng), rng)


def run(
    policy: Policy, folder: Path, seconds: float, bus: WalkingBus | None = None,
    stack: Stack = STACKS["closed-loop"], commands=FORWARD, watchers=(), imu=None,
) -> Outcome:  # fmt: skip
    bus = bus or robot()
    parts = assemble(policy, stack, JOINTS, CALIBRATION, None)
    guard = GuardedBus(bus)
    try:
        return deploy(
            guard, imu or bus, parts.controller, commands, seconds, folder / "walk.csv",
            parts.header, watchers=watchers,
        )  # fmt: skip
    finally:
        guard.close()


def test_a_trot_walks_through_controller_guard_and_bus(policy, tmp_path):
    bus = robot()
    score = WalkScore(bus, bus.robot)
    trotting = Trotting(policy.network, policy.contract)
    found = run(trotting, tmp_path, 4.0, bus, watchers=[score])
    assert found.stop_reason == "time is up" and not found.fell
    assert found.deadline_misses == 0 and found.steps.count == 200
    assert score.summary()["mean_motion"][0] == pytest.approx(0.15, abs=0.04)
    assert bus.robot.trunk(bus.now()).upright > 0.95


def test_a_log_repeats_bit_for_bit_and_another_policy_is_refused(policy, logged, tmp_path):
    path = tmp_path / "walk.csv"
    path.write_text(logged)
    walk = read_walk(path)
    assert len(walk.senses) == 25 and walk.ended == "time is up"
    assert replay(walk, reassemble(policy, walk.header, path)) is None
    # a small change of one input changes what follows
    spoilt = replace(walk.senses[20], position=walk.senses[20].position + 1e-3)
    walk.senses[20] = spoilt
    assert replay(walk, reassemble(policy, walk.header, path)) == 20
    other = Policy(policy.network, policy.contract.model_copy(update={"weights_sha256": "0" * 64}))
    with pytest.raises(InputError, match="another policy"):
        reassemble(other, walk.header, path)
    lines = logged.splitlines(keepends=True)
    for cut in (1, 40):
        path.write_text("".join(lines[:-2]) + lines[-2][:cut])
        walk = read_walk(path)
        assert len(walk.senses) == 24 and walk.ended is None, "a log cut short ends there"


def test_a_damaged_log_is_refused_in_a_sentence(logged, tmp_path):
    path = tmp_path / "walk.csv"

    def read(change):
        path.write_text(logged.replace(*change, 1) if change else "x")
        read_walk(path)

    cases = [
        (None, "no log of a walk"), (("schema_version: 1", "schema_version: 9"), "schema_version"),
        (("elapsed_s,", "elapsed,"), "columns"), (("# rest: ", "# rest: {"), "rest is not JSON"),
        (("# start_rad: [", "# start_rad: [1, "), "start_rad is"),
        (("# start_rad: [", "# start_rad: [1e400, "), "start_rad"),
        (("\n0.", "\n٠."), "is not a number"),
    ]  # fmt: skip
    assert_each_refused(cases, read, names=path)


def at_tick(tick: int, what: Callable[[WalkingBus], object], bus: WalkingBus):
    """A watcher that does something to a walking robot in one tick of its walk."""
    ticks = count(1)

    def watch(_):
        if next(ticks) == tick:
            what(bus)

    return watch


def limp(bus: WalkingBus) -> bool:
    """Whether no servo pushes any more."""
    loads = []
    for index in range(12):
        bus.robot.angle(index, bus.now() + 0.05)  # a load is of when an angle was asked for
        loads.append(bus.robot.load(index))
    return not np.any(loads)


def test_a_robot_that_falls_is_left_limp_and_the_log_says_so(policy, tmp_path):
    bus = robot()
    push = at_tick(10, lambda b: b.robot.push((0.0, 3.0)), bus)
    found = run(policy, tmp_path, 5.0, bus, watchers=[push])
    assert found.fell and "fell" in found.stop_reason
    assert read_walk(tmp_path / "walk.csv").ended == found.stop_reason
    assert limp(bus)


def test_an_imu_that_goes_silent_ends_the_walk(policy, tmp_path):
    bus = robot()

    class Silent:
        count = 0

        def imu(self):
            self.count += 1
            return bus.imu() if self.count < 100 else None

    found = run(policy, tmp_path, 5.0, bus, imu=Silent())
    assert "IMU has not answered" in found.stop_reason
    assert found.seconds < 1.0 + IMU_SILENT_S + 0.05
    assert limp(bus)


def test_a_policy_that_gives_nan_ends_the_walk_with_its_inputs_logged(policy, tmp_path):
    class Breaks(Trotting):
        def act(self, observation):
            found = super().act(observation)
            return found if self.tick < 20 else found * np.nan

    bus = robot()
    found = run(Breaks(policy.network, policy.contract), tmp_path, 2.0, bus)
    assert "not a number" in found.stop_reason and limp(bus)
    assert len(read_walk(tmp_path / "walk.csv").senses) == 19


def test_a_loop_that_stood_still_for_long_does_not_go_on(policy, tmp_path):
    bus = robot()
    short = at_tick(10, lambda b: b.sleep_until(b.now() + 0.1), bus)
    found = run(policy, tmp_path, 0.6, bus, watchers=[short])
    assert found.stop_reason == "time is up" and found.deadline_misses == 4
    bus = robot()
    long = at_tick(10, lambda b: b.sleep_until(b.now() + 0.3), bus)
    (tmp_path / "walk.csv").unlink()
    found = run(policy, tmp_path, 2.0, bus, watchers=[long])
    assert "deadlines" in found.stop_reason and limp(bus)
    assert found.seconds < 0.3
    assert read_walk(tmp_path / "walk.csv").ended == found.stop_reason


def test_ctrl_c_parks_the_robot(policy, tmp_path):
    def interrupt(_):
        raise KeyboardInterrupt

    bus = robot()
    found = run(policy, tmp_path, 2.0, bus, watchers=[interrupt])
    assert found.stop_reason == "Ctrl-C"
    assert limp(bus) and bus.robot.trunk(bus.now()).upright > 0.95


def test_a_full_disk_parks_the_robot_and_is_said(policy, tmp_path, monkeypatch):
    write = SyncedText.write

    def full(self, lines):
        if self.path.stat().st_size > 40_000:
            raise InputError(f"{self.path} cannot be written: No space left on device.")
        write(self, lines)

    monkeypatch.setattr(SyncedText, "write", full)
    bus = robot()
    with pytest.raises(InputError, match="No space left"):
        run(policy, tmp_path, 2.0, bus)
    assert limp(bus)


def test_a_robot_that_does_not_stand_still_at_the_start_does_not_walk(policy, tmp_path):
    bus = robot()

    class Shaken:
        count = 0

        def imu(self):
            self.count += 1
            sample = bus.imu()
            return replace(sample, rate_rad_s=sample.rate_rad_s + np.sin(self.count))

    with pytest.raises(InputError):
        run(policy, tmp_path, 1.0, bus, imu=Shaken())
    assert limp(bus) and not (tmp_path / "walk.csv").exists()


def test_what_is_sent_grows_over_the_fade_in(policy, tmp_path):
    trotting = Trotting(policy.network, policy.contract)
    run(trotting, tmp_path, 1.6, stack=Stack(fade_in_s=1.0))
    walk = read_walk(tmp_path / "walk.csv")
    pose, (low, high) = np.array(list(policy.contract.default_pose_rad.values())), limits()
    away, acted = walk.target - pose, walk.action * policy.contract.action_scale_rad
    share = np.array([s.elapsed_s for s in walk.senses]).clip(0, 1)
    inside = ((pose + acted >= low) & (pose + acted <= high)).all(axis=1)  # where no limit cuts
    assert inside.sum() > 20
    np.testing.assert_allclose(away[inside], (share[:, None] * acted)[inside], atol=0.02)


def test_the_policy_is_shown_a_servo_model_in_place_of_readings(policy):
    pose = np.array(list(policy.contract.default_pose_rad.values()))
    bent = JOINTS.per_servo().to_angles(JOINTS.to_counts(pose))
    model = linear_filter(JOINTS.joint_names, 0.02, 0.5, center=bent)
    trotting = Trotting(policy.network, policy.contract)
    stack = Stack("servo-model", fade_in_s=0.0)
    controller = Controller(trotting, stack, ServoModelObserver(model, 0.02), JOINTS)
    rest = Rest(np.array([0.0, 0.0, -1.0]), np.zeros(3))
    controller.reset(pose, rest)
    nowhere, level = np.full(12, np.nan), np.array([0.0, 0.0, 9.81])
    command, told = np.array([0.15, 0.0, 0.0]), pose
    for tick in range(20):
        senses = Senses(0.02 * tick, command, nowhere, np.zeros(12), np.zeros(3), level)
        decision = controller.step(senses)
        # half of what the servos were told, whatever the encoders say; the calf's through the rod
        seen = decision.observation[OBSERVATION_PARTS["joint_position_relative"]]
        np.testing.assert_allclose(seen, 0.5 * (told - pose), atol=1e-5)
        told = decision.target
    assert np.abs(told - pose).max() > 0.1


def test_a_stack_that_cannot_be_is_refused(policy):
    cases = [
        (lambda: assemble(policy, STACKS["lstm-servo"], JOINTS, CALIBRATION, None), "`servo`"),
        (
            lambda: assemble(policy, STACKS["lstm-servo"], JOINTS, CALIBRATION, Path("nowhere")),
            "no such folder",
        ),
        # out of range: `tests/cli/test_refusals.py`
        (lambda: Stack(scale_rad=np.nan), "scale_rad"),
        (lambda: constant((0, np.nan, 0)), "`command`"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda make: make())


def test_a_policy_gets_the_stack_of_its_training_and_the_published_observer_does_not_fit(policy):
    assert suited(policy.contract) == "closed-loop"
    ideal = policy.contract.model_copy(update={"feedback": "ideal"})
    assert suited(ideal) == "lstm-servo"
    assert suited(ideal.model_copy(update={"kind": "mlp"})) == "mlp-observer"
    parts = assemble(policy, Stack("published-pd"), JOINTS, CALIBRATION, None)
    assert not parts.match.fits and "Hz" in parts.match.sentence()
    assert assemble(policy, STACKS["closed-loop"], JOINTS, CALIBRATION, None).match.fits


# --------------------------------------------------------------------------------- commands


TRAINED = CommandRanges(forward_m_s=[-0.2, 0.2], sideways_m_s=[-0.1, 0.1], yaw_rad_s=[-0.5, 0.5])


def test_a_script_gives_one_command_after_the_other_clipped_to_the_training_and_says_so(tmp_path):
    path, said = tmp_path / "s.csv", []
    path.write_text("seconds,forward_m_s,left_m_s,turn_rad_s\n2,0.4,0,0\n1,0,0,-2\n1,0.2,0.1,0\n")
    command = script(path, TRAINED, said.append)
    np.testing.assert_array_equal(command(1.99), [0.2, 0, 0])
    np.testing.assert_array_equal(command(2.0), [0, 0, -0.5])
    np.testing.assert_array_equal(command(3.5), [0.2, 0.1, 0])
    assert command(4.0) is None
    np.testing.assert_array_equal(script(path)(0.0), [0.4, 0, 0])
    np.testing.assert_array_equal(constant((-0.3, 0, 0), TRAINED, said.append)(9.0), [-0.2, 0, 0])
    assert len(said) == 2 and "2 of 3 commands were clipped to what the policy was" in said[0]
    assert "-0.3 0 0 was clipped to -0.2 0 0" in said[1] and "forward -0.2 to 0.2 m/s" in said[1]
    constant((0.2, -0.1, 0.5), TRAINED, said.append)
    assert len(said) == 2


def test_keys_drive_no_further_than_the_training(monkeypatch):
    read_end, write_end = os.pipe()
    with os.fdopen(read_end) as keys:
        monkeypatch.setattr("sys.stdin", keys)
        driver = Driver(TRAINED)
        for typed, expected in ((b"wwww", 0.2), (b"w", 0.2), (b"s", 0.15), (b" ssssss", -0.2)):
            os.write(write_end, typed)
            np.testing.assert_allclose(driver(0.0), [expected, 0, 0])
    os.close(write_end)


def test_a_script_that_is_none_is_refused(tmp_path):
    path, head = tmp_path / "s.csv", "seconds,forward_m_s,left_m_s,turn_rad_s\n"

    def read(text):
        path.write_text(text)
        script(path)

    cases = [
        ("", "columns"), ("a,b\n1,2\n", "columns"), (head, "rows"),
        (head + "1,0,0,0\n-1,0,0,0\n", "line 3"),
        (head + "1,x,0,0\n", "line 2, column forward_m_s: 'x'"),
        (head + "1,90,0,0\n", "line 2"), (head + "1,0,0,0\n1,0,0\n", "cut short"),
    ]  # fmt: skip
    assert_each_refused(cases, read, names=path)
