"""Robots' own files: URDF and MJCF with followers, odd limits, absent meshes; LeRobot's JSON."""

import json
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.feetech import STS3215, FeetechBus
from pupper_sysid.hardware.joint_calibration import lerobot_calibration, read_lerobot
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.serial_servos import line as serial_line
from pupper_sysid.sim.emulator.bench import ServoBench
from pupper_sysid.sim.emulator.feetech import FeetechEmulator
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from pupper_sysid.sim.robot import robot_map
from support.command_line import ran, run
from support.servo_servers import on_a_port

LINK = """<link name="{0}"><inertial><mass value=".1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"
 ixy="0" ixz="0" iyz="0"/></inertial>{1}</link>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>
<axis xyz="0 0 1"/><limit lower="{3}" upper="{4}" effort="1" velocity="1"/>{5}</joint>"""
MESH = '<visual><geometry><mesh filename="package://arm/meshes/link.stl"/></geometry></visual>'
GEOM = '<geom size=".02"/>'


def urdf(*joints: tuple, mesh: str = "") -> str:
    """A chain of joints: name, lower, upper and what is inside the element."""
    links = "".join(LINK.format(f"l{k}", mesh) for k in range(len(joints) + 1))
    chain = "".join(
        JOINT.format(name, f"l{k}", f"l{k + 1}", low, high, more)
        for k, (name, low, high, more) in enumerate(joints)
    )
    return f'<robot name="arm">{links}{chain}</robot>'


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch, read_here):
    """Models are read in this process, which has MuJoCo already."""
    monkeypatch.chdir(tmp_path)


def robot_of(text: str, name: str = "arm.urdf") -> robot_map.RobotMap:
    Path(name).write_text(text)
    return robot_map.joint_map_of(Path(name), "sts3215")


PAN, TILT = ("pan", -1, 1, ""), ("tilt", -1, 1, "")


MESHES = MESH + MESH.replace("visual", "collision")


INERTIA = 'ixx="1e-4" iyy="1e-4" izz="1e-4"'


MIMIC = '<mimic joint="left" multiplier="-1"/>'


EQUALITY = f"""<mujoco><worldbody><body><joint name="left" range="0 45"/>{GEOM}</body>
<body><joint name="right" range="-45 0"/>{GEOM}</body></worldbody>
<equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality></mujoco>"""


ASSETS = f"""<mujoco><asset><texture name="t" type="2d" file="absent.png"/>
<material name="m" texture="t"/><mesh name="s" file="absent.stl"/></asset><worldbody>
<body><joint name="k" range="-40 40"/>{GEOM.replace("/>", ' material="m"/>')}
<geom type="mesh" mesh="s"/><site material="m"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("text", "name", "following"),
    [
        (urdf(("left", 0, 0.8, ""), ("right", -0.8, 0, MIMIC)), "arm.urdf", {"right": "left"}),
        (EQUALITY, "arm.xml", {"right": "left"}),
    ],
    ids=["mimic", "equality"],
)
def test_a_joint_that_follows_another_gets_no_servo_and_is_named(text, name, following):
    robot = robot_of(text, name)
    assert robot.joint_map.joint_names == ("left",) and robot.joint_map.ids == (1,)
    assert robot.following == following and robot.left_out == []


def test_files_that_an_mjcf_names_need_not_be_there():
    robot = robot_of(ASSETS, "arm.xml")
    assert robot.joint_map.joint_names == ("k",) and robot.doubts == []


@pytest.mark.parametrize(
    ("original", "other"),
    [
        ("", ""),  # absent meshes alone
        ('izz="1e-4"', ""),  # a mass without an inertia
        (INERTIA, 'ixx="1e-4" iyy="1e-4" izz="9e-4"'),
        (INERTIA, 'ixx="1e-4" iyy="-1e-4" izz="1e-4"'),
        ("<limit", '<limit drake:acceleration="2.5"'),  # a prefix that nothing declares
        ("</robot>", '<drake:ignored name="a:b"/></robot>'),
        ("package://arm/", "package:/arm/"),
        ('<axis xyz="0 0 1"/>', '<origin rpy="0, 0, 1"/><axis xyz="0 0 1"/>'),
        ('<child link="l1"/>', '<child link="missing"/>'),
        ("</robot>", '<transmission><joint name="pan"/></transmission></robot>'),
    ],
)
def test_a_urdf_that_mujoco_refuses_still_states_its_joints(original, other):
    text = urdf(PAN, TILT, mesh=MESHES)
    assert original in text
    robot = robot_of(text.replace(original, other) if original else text)
    assert robot.joint_map.joint_names == ("pan", "tilt") and robot.doubts == []


@pytest.mark.parametrize(
    ("limits", "kept", "doubt"),
    [
        ((-90, 90), (-np.pi / 2, np.pi / 2), "pan (-90 to 90) cannot be radians"),
        ((0, 0), (-0.5, 0.5), "limits of pan are 0 to 0"),
        (("-1e16", "1e16"), (-3.11, 3.11), None),
        (None, (-3.11, 3.11), None),  # a joint that turns on and on
    ],
    ids=["degrees", "zero", "endless", "continuous"],
)
def test_limits_that_no_servo_has_are_replaced_and_odd_ones_questioned(limits, kept, doubt):
    text = urdf(("pan", *(limits or (0, 0)), ""), ("tilt", -1.2, 0.7, ""))
    if limits is None:
        text = text.replace("revolute", "continuous", 1)
    robot = robot_of(text)
    pan, tilt = (robot.joint_map.file.joints[name] for name in ("pan", "tilt"))
    assert pan.limits_rad == pytest.approx(kept, abs=0.01)
    assert tilt.limits_rad == pytest.approx((-1.2, 0.7))
    assert len(robot.doubts) == (doubt is not None)
    assert all(doubt in said for said in robot.doubts)


def test_a_urdf_is_numbered_from_the_base_on_whatever_the_order_of_its_file():
    joints = [JOINT.format(name, f"l{k}", f"l{k + 1}", -1, 1, "") for k, name in enumerate("abc")]
    joints.append(JOINT.format("d", "l1", "l9", -1, 1, ""))  # a second limb, from a's link on
    loop = JOINT.format("e", "l8", "l8", -1, 1, "")
    robot = robot_of(f'<robot name="arm">{loop}{"".join(reversed(joints))}</robot>')
    assert robot.joint_map.joint_names == ("a", "d", "b", "c", "e")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (urdf(("pan", "${-pi}", "${pi}", "")), "xacro FILE > robot.urdf"),
        ('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arm/></robot>', "xacro FILE"),
        (urdf(("pan", -1, 1, ""), ("pan", -1, 1, "")), "two joints are called 'pan'"),
        (urdf(("pan", "nan", 1, "")), "the range of joint pan is not two rising numbers"),
        (urdf(("pan", 1, -1, "")), "the range of joint pan is not two rising numbers"),
        (urdf(("pan", 1, 1, "")), "the range of joint pan is not two rising numbers"),
    ],
)
def test_a_urdf_that_states_no_robot_is_refused_with_the_reason(text, words):
    with pytest.raises(InputError) as refused:
        robot_of(text)
    assert words in str(refused.value)


def test_names_that_no_file_or_column_can_have_are_changed_and_said():
    robot = robot_of(urdf(("left/waist", -1, 1, ""), ("8", -1, 1, ""), ("left_waist", -1, 1, "")))
    assert robot.joint_map.joint_names == ("left_waist_", "joint_8", "left_waist")
    assert "left/waist is left_waist_, 8 is joint_8" in robot.doubts[0]


FOLLOWER = {
    "pan": {"id": 3, "drive_mode": 0, "homing_offset": -120, "range_min": 900, "range_max": 3100},
    "tilt": {"id": 5, "drive_mode": 1, "homing_offset": 87, "range_min": 1200, "range_max": 2900},
}  # fmt: skip


def lerobot_files() -> None:
    Path("follower.json").write_text(json.dumps(FOLLOWER))
    Path("arm.urdf").write_text(urdf(("pan", -1.6, 1.6, ""), ("tilt", -1.2, 1.2, "")))


def test_lerobots_calibration_goes_in_and_comes_out_again(capsys):
    lerobot_files()
    out, _ = ran(
        capsys, "init-robot", "arm.urdf", "--lerobot-calibration", "follower.json", "--out",
        "m.yaml",
    )  # fmt: skip
    chosen = load_joint_map(Path("m.yaml"))
    assert "guess" not in out + chosen.file.source and "calibrate-joints" not in out
    pan, tilt = chosen.file.joints["pan"], chosen.file.joints["tilt"]
    assert (pan.id, pan.sign, pan.limits_counts, pan.homing_offset) == (3, 1, (900, 3100), -120)
    assert (tilt.id, tilt.sign, tilt.limits_counts, tilt.homing_offset) == (5, -1, (1200, 2900), 87)
    assert lerobot_calibration(chosen, {}) == FOLLOWER


def test_a_line_with_other_homing_offsets_than_lerobots_is_refused(capsys, monkeypatch):
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.1)
    lerobot_files()
    run(capsys, "init-robot", "arm.urdf", "--lerobot-calibration", "follower.json")
    layout = load_joint_map(Path("arm.joints.yaml")).per_servo()
    rng = np.random.default_rng(0)
    robot = draw_robot(rng, RobotSpec(poll_period_s=0, loss=0, quantum_rad=0), layout)
    servos = FeetechEmulator(ServoBench(robot, layout, rng), STS3215, rng)
    with on_a_port(servos) as server:
        bus = FeetechBus(server.device, 1_000_000, layout)
        bus.refuse_unfit()
        assert np.abs(bus.read().position_rad - layout.rest_pose()).max() < 0.03
        bus.close()
        servos._set(5, "homing_offset", 0)
        guard = GuardedBus(FeetechBus(server.device, 1_000_000, layout))
        with pytest.raises(BusError, match="tilt: the register homing_offset .* holds with 87"):
            guard.torque(True)
        guard.close()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([], "must map joints to entries"),
        ({"pan": 3}, "pan must have drive_mode"),
        ({"homing_offset": [2048], "drive_mode": [0], "motor_names": ["pan"]}, "an older LeRobot"),
        ({"pan": FOLLOWER["pan"] | {"drive_mode": 2}}, "drive_mode"),
        ({"pan": FOLLOWER["pan"] | {"range_max": 900}}, "was not moved through its range"),
        ({"pan": FOLLOWER["pan"], "tilt": FOLLOWER["pan"]}, "two joints have the same id"),
    ],
)
def test_what_is_no_calibration_of_lerobot_is_refused(data, words):
    Path("odd.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=words):
        read_lerobot(Path("odd.json"))


def test_a_calibration_of_other_joints_names_both():
    lerobot_files()
    Path("arm.urdf").write_text(urdf(("Rotation", -1.6, 1.6, "")))
    with pytest.raises(InputError, match=r"Rotation.*pan, tilt.*Rename"):
        robot_map.joint_map_of(Path("arm.urdf"), "sts3215", read_lerobot(Path("follower.json")))
