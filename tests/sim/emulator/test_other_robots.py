"""Robots that are no Mini Pupper: an arm of six servos."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import yaml

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sim.robot import hinges, robot_map
from pupper_sysid.sysid.recordings.files import load
from support.command_line import json_of, ran, refused, run
from support.exported_servos import in_free_air
from support.refusals import assert_each_refused

ARM = """<mujoco><worldbody>
<body><joint name="base_yaw" type="hinge" axis="0 0 1" range="-110 110"/><geom size=".02"/>
<body><joint name="shoulder" type="hinge" axis="0 1 0" range="20 120"/><geom size=".02"/>
<body><joint name="elbow" type="hinge" axis="0 1 0" range="-95 95"/><geom size=".02"/>
<body><joint name="wrist_pitch" type="hinge" axis="0 1 0" range="-95 95"/><geom size=".02"/>
<body><joint name="wrist_roll" type="hinge" axis="0 0 1"/><geom size=".02"/>
<body><joint name="gripper" type="hinge" axis="0 1 0" range="-10 100"/><geom size=".02"/>
</body></body></body></body></body></body></worldbody></mujoco>"""
BODY = (
    "<mujoco>{}<worldbody><body>"
    '<joint name="k" axis="0 0 1" range="{}"/>{}</body>{}</worldbody></mujoco>'
)
GEOM = '<geom size=".02"/>'


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("arm.xml").write_text(ARM)


def test_a_joint_map_has_the_model_s_joints_limits_and_the_servos_counts(capsys):
    found = json_of(capsys, "init-robot", "arm.xml")
    assert found["ids"] == [1, 2, 3, 4, 5, 6] and found["joints"][0] == "base_yaw"
    arm = load_joint_map(Path("arm.joints.yaml"))
    # 100° is 4096 / 360 · 100 = 1137.8 counts
    low, high = arm.file.joints["shoulder"].limits_counts
    assert (low, high) == (2048 - 568, 2048 + 568)
    assert arm.file.joints["shoulder"].neutral_rad == pytest.approx(np.radians(70))
    np.testing.assert_allclose(arm.to_counts(arm.zero_rad()), 2048)
    pose = dict(zip(arm.joint_names, arm.rest_pose(), strict=True))
    # 10° before its lower end, a gripper at zero has no room to swing
    assert pose["gripper"] == pytest.approx(np.radians(-10) + 0.4, abs=2e-3)
    assert pose["elbow"] == 0.0 and min(found["margin_rad"].values()) > 0.39


def test_hinges_that_an_actuator_drives_by_any_way_are_taken_and_others_named(capsys, read_here):
    driven = """</worldbody><tendon><fixed name="t"><joint joint="elbow" coef="1"/></fixed></tendon>
    <actuator><position joint="base_yaw"/><position jointinparent="shoulder"/>
    <position tendon="t"/></actuator>"""
    Path("driven.xml").write_text(ARM.replace("</worldbody>", driven))
    out, err = ran(capsys, "init-robot", "driven.xml", "--json")
    assert json.loads(out)["joints"] == ["base_yaw", "shoulder", "elbow"]
    assert json.loads(out)["left_out"] == ["wrist_pitch", "wrist_roll", "gripper"]
    assert "left out" in err and "wrist_pitch, wrist_roll, gripper" in " ".join(err.split())


def test_servos_without_a_model_file_get_a_map_from_their_names_and_ids(capsys, read_here):
    out, err = ran(
        capsys, "init-robot", "--servo", "xm430-w350", "--joints", "pan=7,tilt=3", "--json"
    )
    written = json.loads(out)
    assert (written["joint_map"], written["ids"]) == ("joints.yaml", [7, 3])
    assert "no limits are known" in err and "calibrate-joints" in err
    layout = load_joint_map(Path("joints.yaml"))
    assert layout.joint_names == ("pan", "tilt") and layout.file.servo == "XM430-W350"
    assert layout.file.joints["pan"].limits_rad == (-0.5, 0.5)


@pytest.mark.usefixtures("unexamined")
def test_an_arm_goes_from_its_model_to_a_calibration_networks_and_exports(capsys, read_here):
    for words in (
        "init-robot arm.xml",
        "sweep --joint-map arm.joints.yaml --joints elbow --freqs 2,4 --duration 3 --truth "
        "--out arm.csv",
        "calibrate arm.csv --out arm.yaml",
        "fit-servo arm.csv --arch fir --out servo",
        "export arm.yaml --to isaaclab",
        "export arm.yaml --to mjcf --out servos.xml",
    ):
        ran(capsys, *words.split())
    recording, found = load(Path("arm.csv")), load_calibration(Path("arm.yaml"))
    assert recording.joints == ["elbow"] == list(found.joint_names)
    truth = yaml.safe_load(Path("arm.truth.yaml").read_text())["joints"]["elbow"]["actuator"]
    dead_time_s = found.joint("elbow").actuator.dead_time_s.value
    assert dead_time_s == pytest.approx(truth["dead_time_s"], abs=4e-3)
    assert found.joint("elbow").feedback.poll_period_s.value == 0.0
    model = load_servo_model(Path("servo"), joints=["elbow"]).model
    start = float(recording.trials("elbow")[0].command_rad[0])
    model.reset([start])
    assert float(model.step([start])[0]) == pytest.approx(start, abs=0.02)
    arm = in_free_air(Path("servos.xml").read_text(), found.joint_names)
    assert arm.nu == 1 and arm.nsensor == 1


def read(text: str) -> None:
    """Make a joint map of a model."""
    Path("odd.xml").write_text(text)
    robot_map.joint_map_of(Path("odd.xml"), "sts3215")


def test_what_is_no_robot_is_refused_by_what_is_wrong(capsys, read_here):
    slide = '<actuator><position joint="lift"/></actuator></mujoco>'
    lift = '<body><joint name="lift" type="slide"/><geom size=".02"/></body></worldbody>'
    ignored = "the range of joint k is not two rising numbers"  # as MuJoCo does
    ends = ("nan nan", "60 -60", "10 10", "1e300 2e300", "inf 3")
    assert_each_refused(
        [
            ("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", "no hinge joint"),
            (ARM.replace("</worldbody>", lift).replace("</mujoco>", slide), "none of its hinges"),
            *((BODY.format("", e, GEOM, ""), ignored) for e in ends),
        ],
        read,
    )
    assert run(capsys, "init-robot", "arm.xml")[0] == 0
    assert "exists already" in refused(capsys, pupper_sysid, "init-robot", "arm.xml")
    unknown = ("sweep", "--joint-map", "arm.joints.yaml", "--joints", "LF_hip")
    assert "there is no LF_hip here" in refused(capsys, pupper_sysid, *unknown)


BOMBS = (
    '<asset><hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1"/></asset>',
    "<worldbody>" + "<replicate count='1000'>" * 3 + "<geom size='1'/>"
    "</replicate></replicate></replicate></worldbody>",
    '<include file="pipe"/>',
)


def test_a_model_that_cannot_be_read_or_takes_too_much_is_refused(monkeypatch):
    assert_each_refused(
        [("<mujoco><worldbody><body></worldbody></mujoco>", "MuJoCo's viewer")], read
    )
    with pytest.raises(InputError, match="nowhere.xml is no file"):
        robot_map.joint_map_of(Path("nowhere.xml"), "sts3215")
    monkeypatch.setattr(hinges, "_PATIENCE_S", 1)
    os.mkfifo("pipe")
    heavy = "take height fields, textures"
    assert_each_refused([(BODY.format(bomb, "-1 1", GEOM, ""), heavy) for bomb in BOMBS], read)
