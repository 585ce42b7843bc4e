"""A policy of another robot, deployed on its emulation: with its servos, guard, log and replay."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from pupper_sysid.cli.programs import pupper_deploy
from pupper_sysid.hardware.imu import GRAVITY_M_S2, from_chip
from pupper_sysid.policies.deploy.walk_log import read_walk
from pupper_sysid.policies.network.policy_file import write_policy
from pupper_sysid.policies.network.policy_network import PolicyNetwork
from pupper_sysid.sim.walking.config import for_robot
from pupper_sysid.sim.walking.robot import WalkingBus, _model, calibrated_robot
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.command_line import run_program
from support.legged import legged
from support.tiny_training import CALIBRATION, tiny_run

SERVO = "sts3215-bam-m1"
HEXAPOD = {f"{'LR'[side < 0]}{k}": (1 - k, side) for side in (1, -1) for k in range(3)}


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    """Folder of a policy that holds the default pose of a hexapod and twitches."""
    folder = tmp_path_factory.mktemp("hexapod")
    robot, config = folder / "hexapod.xml", folder / "hexapod.yaml"
    robot.write_text(legged(HEXAPOD, mirrored=False))
    config.write_text(
        'pose: {"*_pitch": 0.7, "*_knee": -1.4}\ncommands: {forward_m_s: [-0.1, 0.2]}\n'
    )
    own = tiny_run()
    task = for_robot(own.task, robot, config)
    shape = replace(own.architecture, hidden=(8,))
    own = replace(own, task=task, architecture=shape, actuator=SERVO)
    torch.manual_seed(0)
    joints = len(task.body.joints)
    network = PolicyNetwork("mlp", 12 + 4 * joints, (8,), 8, own.learner.normalise, joints)
    weights = network.state_dict()
    for name in weights:
        if name.startswith("mlp.2"):
            weights[name] *= 0.02
    servos = servo_ranges(SERVO, body=task.body)
    write_policy(folder / "walker", weights, own, servos, 0, {"seed": 0})
    return folder / "walker"


@pytest.fixture
def deploy(capsys, tmp_path, monkeypatch) -> Callable[..., tuple[int, str, str]]:
    """Run pupper-deploy in an empty folder: exit code, output, messages."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: run_program(capsys, pupper_deploy, *arguments)


@pytest.mark.slow
def test_a_hexapod_walks_behind_guard_and_log_and_its_log_repeats(deploy, policy):
    code, out, err = deploy(
        policy, "--actuator", SERVO, "--seconds", 1, "--command", 0.4, 0, 0, "--name", "h"
    )
    assert code == 0, err
    assert f"emulated hexapod has the servos of {SERVO}" in err
    assert "clipped to 0.2 0 0" in err
    walk = read_walk(Path("walks/h/walk.csv"))
    assert walk.ended == "time is up" and walk.target.shape == (50, 18)
    assert walk.observation.shape == (50, 84) and walk.senses[0].command[0] == 0.2
    assert walk.header["joints"][:3] == ["L0_roll", "L0_pitch", "L0_knee"]
    header = Path("walks/h/recording.csv").read_text()
    assert "R2_knee" in header
    code, out, err = deploy(policy, "--replay", "walks/h/walk.csv")
    assert code == 0 and "50 ticks repeated" in out, err


def test_without_a_calibration_the_emulated_robot_has_the_servos_of_the_training(deploy, policy):
    code, _, err = deploy(policy, "--seconds", 0.2, "--name", "h")
    assert code == 0 and f"servos of the training, {SERVO}" in err
    walk = read_walk(Path("walks/h/walk.csv"))
    assert walk.ended == "time is up" and walk.target.shape == (10, 18)


def test_a_real_bus_needs_the_joint_map_of_that_robot(deploy, policy):
    code, _, err = deploy(policy, "--bus", "esp32")
    assert code == 2 and "joint map of that robot" in err and "--joint-map" in err
    code, _, err = deploy(policy, "--bus", "feetech:/dev/null", "--joint-map", "sts3215")
    assert code == 2 and "has no L0_roll" in err


def test_the_emulated_hexapod_stands_where_its_calibration_says(policy):
    """Knees sag by the torque of a sixth of the weight on bent legs over the stiffness."""
    task = for_robot(tiny_run().task, policy.parent / "hexapod.xml", policy.parent / "hexapod.yaml")
    body, rng = task.body, np.random.default_rng(0)
    truth = calibrated_robot(servo_ranges(SERVO, body=body), rng, body)
    bus = WalkingBus(truth, rng, body=body)
    assert bus.joint_names == body.joints
    trunk = bus.robot.trunk(0.0)
    assert trunk.upright > 0.99
    assert trunk.position_m[2] == pytest.approx(body.standing_height_m, rel=0.1)
    # a knee is 0.1 · sin 0.7 m beside its foot, which carries a sixth of 1.78 kg
    servo = truth.servos[body.joints.index("L1_knee")].actuator
    sag = 1.78 * 9.81 / 6 * 0.1 * np.sin(0.7) / float(np.asarray(servo.stiffness))
    stands = bus.robot.angle(body.joints.index("L1_knee"), 0.0)
    assert abs(stands + 1.4) < 3 * sag + 0.02


def test_the_imu_of_another_robot_measures_in_its_trunks_axes(policy):
    task = for_robot(tiny_run().task, policy.parent / "hexapod.xml", policy.parent / "hexapod.yaml")
    servos = servo_ranges(SERVO, body=task.body).in_steps_of(0.001).nominal()
    model = _model(task.body, servos)
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[2], data.qpos[7:] = 5.0, task.body.pose
    data.qvel[3:6] = [0.1, 0.2, 0.3]
    data.qfrc_applied[:3] = [1.0, 2.0, 3.0]
    mujoco.mj_forward(model, data)
    acceleration, rate = (data.sensor(name).data for name in ("accelerometer", "gyro"))
    sample = from_chip(0.0, np.concatenate([acceleration / GRAVITY_M_S2, np.degrees(rate)]))
    assert sample is not None
    # the trunk stands level in the world: its axes are the world's
    np.testing.assert_allclose(sample.rate_rad_s, [0.1, 0.2, 0.3], atol=1e-3)
    np.testing.assert_allclose(sample.acceleration_m_s2, data.qacc[:3], atol=1e-2)


def test_a_policy_without_its_robots_file_says_which_is_missing(deploy, policy, tmp_path):
    import shutil

    moved = tmp_path / "moved"
    shutil.copytree(policy, moved)
    text = (moved / "contract.json").read_text()
    (moved / "contract.json").write_text(text.replace(str(policy.parent), "/nowhere"))
    code, _, err = deploy(moved, "--actuator", CALIBRATION)
    assert code == 2 and "hexapod.xml" in err and "is not here" in err
