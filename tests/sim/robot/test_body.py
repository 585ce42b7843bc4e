"""Bodies: the Mini Pupper's, and those made from a MJCF and a few lines of YAML."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.walks.conditions import evaluation_task
from pupper_sysid.sim.robot.body import Body, body_of, fixed_offsets, mini_pupper
from pupper_sysid.sim.robot.mini_pupper import robot_xml
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import PRESETS, Walking, for_robot
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

LEG = """<body name="{name}_hip" pos="{x} {y} 0"><inertial mass="0.05" pos="0 0 0"
    diaginertia="1e-5 1e-5 1e-5"/><joint name="{name}_roll" axis="1 0 0" range="-0.6 0.6"/>
  <body name="{name}_thigh" pos="0 {out} 0"><joint name="{name}_pitch" axis="0 1 0" range="-1 2"/>
    <inertial mass="0.05" pos="0 0 -0.05" diaginertia="1e-5 1e-5 1e-5"/>
    <body name="{name}_shank" pos="0 0 -0.1"><joint name="{name}_knee" axis="0 {sign} 0"
        range="-2.5 2.5"/><inertial mass="0.03" pos="0 0 -0.05" diaginertia="1e-5 1e-5 1e-5"/>
      <geom type="sphere" size="0.01" pos="0 0 -0.1"/></body></body></body>"""
PLACES = {
    "front_left": (1, 1),
    "front_right": (1, -1),
    "rear_left": (-1, 1),
    "rear_right": (-1, -1),
}


def mjcf(legs: dict[str, tuple[int, int]], base: str = "<freejoint/>", more: str = "") -> str:
    """A robot with three joints a leg; right knees turn the other way round."""
    made = "".join(
        LEG.format(name=n, x=0.12 * fore, y=0.05 * side, out=0.04 * side, sign=side)
        for n, (fore, side) in legs.items()
    )
    return f"""<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
      <body name="torso" pos="0 0 0.2">{base}<inertial mass="1" pos="0 0 0"
        diaginertia="0.01 0.01 0.01"/><geom type="box" size="0.1 0.04 0.03"/>{made}</body>
      </worldbody>{more}</mujoco>"""


POSE = 'pose: {"*_pitch": 0.7, "*_left_knee": -1.4, "*_right_knee": 1.4}\n'


def body(folder: Path, xml: str | None = None, config: str = POSE) -> Body:
    robot, own = folder / "robot.xml", folder / "robot.yaml"
    robot.write_text(xml or mjcf(PLACES))
    own.write_text(config)
    return body_of(str(robot), str(own))


def test_a_quadruped_gets_its_feet_gait_and_mirror_image_from_geometry(tmp_path):
    own = body(tmp_path)
    assert own.feet == tuple(f"foot_{n}_shank" for n in PLACES)
    np.testing.assert_array_equal(own.offsets, [0.0, 0.5, 0.5, 0.0])
    # 2 · 0.1 m · cos 0.7, and the foot's radius
    assert own.standing_height_m == pytest.approx(0.2 * np.cos(0.7) + 0.01)
    assert own.mirror_joints is not None and own.mirror_signs is not None
    names = [
        n.replace("left", "X").replace("right", "left").replace("X", "right") for n in own.joints
    ]
    assert [own.joints[i] for i in own.mirror_joints] == names
    # rolls turn about the forward axis, and right knees about the opposite one
    signs = [1.0 if n.endswith("pitch") else -1.0 for n in own.joints]
    np.testing.assert_array_equal(own.mirror_signs, signs)


def test_joints_that_put_feet_somewhere_are_the_inverse_of_where_feet_are(tmp_path):
    for own in (body(tmp_path), mini_pupper()):
        moved = np.random.default_rng(0).uniform(-0.05, 0.05, (20, len(own.feet), 3))
        feet = own.feet_at + own.standing_height_m * moved
        np.testing.assert_allclose(own.feet_in_trunk(own.joints_at(feet)), feet, atol=1e-6)


@pytest.mark.slow
def test_a_clocked_trot_carries_a_robot_that_no_one_has_seen_before(tmp_path):
    body(tmp_path)
    task = for_robot(PRESETS["fast"], tmp_path / "robot.xml", tmp_path / "robot.yaml")
    task = evaluation_task(task)
    assert task.body.commands == {} and task.commands.forward_m_s[1] > 0.2
    env = PupperEnv(task, servo_ranges("ideal", "ideal", task.body), 6, seed=0, threads=1)
    env.set_command(np.array([0.2, 0.0, 0.0]))
    speed = []
    for k in range(60):
        phase = np.full(6, 2 * np.pi * task.trot.frequency_hz * k * task.control_step_s)
        joints = task.trot.joints(phase, env.command, env.body)
        found = env.step((joints - env.default) / task.action_scale)
        assert not found.done.any()
        speed.append(found.facts.stride_velocity[:, 0])
    assert np.median(speed[30:]) == pytest.approx(0.2, rel=0.25)


def test_the_feet_of_the_mini_pupper_and_its_gait_are_what_the_rule_for_others_gives():
    own = mini_pupper()
    np.testing.assert_array_equal(fixed_offsets(own.feet_at), own.offsets)
    assert (own.scale, own.touch_n, *own.command_scale) == (1.0, 0.25, 1.0, 1.0, 1.0)
    assert Walking().body is own and Walking(knee="serial").body.linked == ()


def test_the_mini_puppers_own_file_makes_the_same_body(tmp_path):
    own = mini_pupper("serial")
    xml = robot_xml(servo_ranges("paper").nominal(), 0.002, "serial")
    pose = ", ".join(f"{n}: {a}" for n, a in zip(own.joints, own.pose, strict=True))
    read = body(tmp_path, xml, f"pose: {{{pose}}}\nfeet: [LF_foot, RF_foot, LB_foot, RB_foot]\n")
    assert read.joints == own.joints
    for name in ("pose", "low", "high", "offsets", "mirror_joints", "mirror_signs", "mirror_feet",
                 "leg_of"):  # fmt: skip
        np.testing.assert_array_equal(getattr(read, name), getattr(own, name), err_msg=name)
    np.testing.assert_allclose(read.feet_at, own.feet_at, atol=1e-9)
    assert read.mass_kg == pytest.approx(own.mass_kg)
    joints = np.random.default_rng(1).uniform(own.low, own.high, (9, 12))
    np.testing.assert_allclose(read.feet_in_trunk(joints), own.feet_in_trunk(joints), atol=1e-9)
    phase = np.linspace(0, 6, 9)
    command = np.tile([0.1, 0.02, 0.1], (9, 1))
    np.testing.assert_allclose(
        Trot().joints(phase, command, read), Trot().joints(phase, command, own), atol=1e-6
    )


@pytest.mark.parametrize(
    ("xml", "config", "words"),
    [
        (mjcf(PLACES, base=""), POSE, "no floating base: its first body (torso)"),
        ("<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>", POSE,
         "no hinge"),
        (None, "feet: [paw]\n" + POSE, "no site, geom or body 'paw'"),
        (None, "joints: [tail]\n" + POSE, "joints names 'tail'"),
        (None, "pose: home\n", "no keyframe 'home'; it has none"),
        (None, 'pose: {"*_roll": 2.0}\n', "beyond the limits of front_left_roll"),
        (None, "gait: gallop\n" + POSE, "gait 'gallop' is not known"),
        (None, "wheels: 4\n", "wheels"),
        (mjcf(PLACES).replace('size="0.01"', 'size="0.01" contype="0" conaffinity="0"'), POSE,
         "lowest geom is of the trunk"),
    ],
)  # fmt: skip
def test_what_a_robot_lacks_is_said_in_a_sentence(tmp_path, xml, config, words):
    with pytest.raises(InputError) as refused:
        body(tmp_path, xml, config)
    assert words in str(refused.value) and str(refused.value).endswith(".")


def test_a_servo_that_the_calibration_lacks_is_named(tmp_path):
    own = body(tmp_path, config=POSE + "servos: LF_elbow\n")
    with pytest.raises(InputError, match="servo of 'LF_elbow'"):
        servo_ranges("paper", "held", own)


def test_two_legs_walk_by_turns_and_joints_without_a_servo_are_fixed(tmp_path):
    two = {n: (0, side) for n, (_, side) in list(PLACES.items())[:2]}
    own = body(tmp_path, mjcf(two), "joints: ['*_pitch', '*_knee']\n" + POSE)
    assert len(own.joints) == 4 and any("fixed: front_left_roll" in n for n in own.notes)
    np.testing.assert_array_equal(own.offsets, [0.0, 0.5])
    assert own.together == () and own.apart == ((0, 1),)
