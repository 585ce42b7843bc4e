"""The robot's model has the masses, sizes, limits, linkage and IMU that were published."""

import math
from typing import Any

import numpy as np
import pytest

from pupper_sysid.common.joints import JOINT_NAMES, LEGS
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import (
    STANDING_HEIGHT_M,
    Knee,
    Physics,
    foot_position,
    joint_angles,
    limits,
    robot_xml,
)
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.robot_in_air import error_in_air, standing

H = 0.002
STIFF = DelayedPDParameters(
    stiffness=20.0, damping=0.25, friction_loss=0.0, armature=8e-4, effort_limit=1e3,
    velocity_limit=1e3, dead_time_s=0.0,
)  # fmt: skip

# facts/hardware.md C4, left legs: mass [kg], centre [m], inertia xx yy zz xy xz yz [kg m²]
PUBLISHED = {
    "hip": (0.023343, (0.0068, 0.0052, 0.0066),
            (4.01e-6, 4.63e-6, 5.06e-6, -7.1e-7, -4.9e-8, -1.0e-7)),
    "thigh": (0.004137, (-0.0012, 0.0041, -0.0170),
              (1.42e-6, 1.48e-6, 2.63e-7, 2.5e-8, -1.9e-7, -1.8e-8)),
    "calf": (0.002549, (0.0003, -0.0001, -0.0379),
             (1.47e-6, 1.57e-6, 1.22e-7, 0.0, 2.1e-7, 0.0)),
}  # fmt: skip
MIRROR = np.diag([1.0, -1.0, 1.0])
KNEES: tuple[Knee, ...] = ("linkage", "serial")


def model_of(
    knee: Knee = "linkage", servo: DelayedPDParameters = STIFF, physics: Physics = "evaluation"
) -> Any:
    servos = dict.fromkeys(JOINT_NAMES, servo)
    return mujoco.MjModel.from_xml_string(robot_xml(servos, H, knee, physics=physics))


def inertia(model: Any, body: str) -> np.ndarray:
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body(body).iquat)
    axes = axes.reshape(3, 3)
    return axes @ np.diag(model.body(body).inertia) @ axes.T


def tensor(xx, yy, zz, xy, xz, yz) -> np.ndarray:
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


# ----------------------------------------------------------------------------- masses and sizes


def test_every_body_has_the_published_mass_centre_and_inertia_mirrored_on_the_right():
    model = model_of()
    assert model.body_mass.sum() == pytest.approx(0.465, abs=1e-9)
    for leg in LEGS:
        turn = np.eye(3) if leg.startswith("L") else MIRROR
        for kind, (mass, centre, moments) in PUBLISHED.items():
            name = f"{leg}_{kind}"
            assert model.body(name).mass[0] == pytest.approx(mass, rel=1e-9), name
            np.testing.assert_allclose(model.body(name).ipos, turn @ centre, atol=1e-9)
            own = turn @ tensor(*moments) @ turn
            np.testing.assert_allclose(inertia(model, name), own, atol=1e-12, err_msg=name)
    # 0.465 - 4 · (0.023343 + 0.004137 + 0.002549), and the tensor by 0.344884 / 0.125594
    assert model.body("trunk").mass[0] == pytest.approx(0.344884, abs=1e-6)
    np.testing.assert_allclose(model.body("trunk").ipos, (-0.0016, 0.0003, -0.0020))
    trunk = 2.746 * tensor(8.24e-5, 3.61e-4, 3.64e-4, 1.2e-6, -1.0e-5, 2.9e-7)
    np.testing.assert_allclose(inertia(model, "trunk"), trunk, rtol=1e-3, atol=1e-9)


def test_a_robot_one_millimetre_lower_is_one_millimetre_deep_and_one_let_go_stands_on_its_feet():
    for physics in ("evaluation", "training"):
        model = model_of(physics=physics)
        data = standing(model)
        data.qpos[2] -= 0.001
        mujoco.mj_forward(model, data)
        feet = {model.geom(f"{leg}_foot").id for leg in LEGS}
        assert {g for pair in data.contact.geom for g in pair} == feet | {model.geom("ground").id}
        assert data.contact.dist.min() == pytest.approx(-0.001, abs=1e-4)
        data = standing(model)
        mujoco.mj_step(model, data, 500)
        assert data.qpos[2] == pytest.approx(STANDING_HEIGHT_M, abs=0.003)
        load = sum(data.sensor(f"{leg}_foot_touch").data[0] for leg in LEGS)
        assert load == pytest.approx(0.465 * 9.81, rel=0.02)
        # at rest the chip, which hangs upside down, reads minus one g on its z
        reading = data.sensor("accelerometer").data / 9.81
        np.testing.assert_allclose(reading, [0.0, 0.0, -1.0], atol=0.05)


def test_joints_have_the_published_limits_in_the_projects_order():
    expected = {"thigh": (0.55, 2.40), "calf": (-2.18, -0.22)}
    low, high = limits()
    model = model_of()
    for i, name in enumerate(JOINT_NAMES):
        leg, kind = name.split("_")
        own = expected.get(kind, (-0.550, 0.425) if leg.startswith("L") else (-0.425, 0.550))
        assert (low[i], high[i]) == own
        assert tuple(model.joint(name).range) == own
        assert model.joint(name).qposadr[0] == 7 + i
        assert model.actuator(name).id == i


# ------------------------------------------------------------------------------------ kinematics


def random_poses(count: int = 50) -> np.ndarray:
    low, high = limits()
    return np.random.default_rng(0).uniform(low, high, (count, 12))


def test_forward_kinematics_are_mujocos_and_a_foot_out_of_reach_gets_a_straight_leg():
    model = model_of()
    data = mujoco.MjData(model)
    for pose in random_poses(10):
        data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
        data.qpos[7:] = pose
        mujoco.mj_kinematics(model, data)
        for i, leg in enumerate(LEGS):
            foot = foot_position(leg, *pose[3 * i : 3 * i + 3])
            np.testing.assert_allclose(foot, data.site(f"{leg}_foot").xpos, atol=1e-12)
    hip = np.array([0.05 - 0.00004, 0.0235, 0.0])  # under which the straight leg hangs
    found = joint_angles("LF", hip + np.array([0.0, 0.02445, -1.0]))
    # 1e-6 m short of straight: cos(bend) = 1 - 0.106e-6 / (0.05 · 0.056)
    np.testing.assert_allclose(found, [0.0, 0.0, 0.0], atol=0.01)
    assert np.isfinite(joint_angles("LF", hip)).all()


def test_a_positive_hip_angle_swings_the_left_foot_outward_and_the_right_one_inward():
    for leg, outward in (("LF", 1), ("RF", -1)):
        rest, moved = foot_position(leg, 0.0, 0.785, -1.57), foot_position(leg, 0.1, 0.785, -1.57)
        assert moved[1] > rest[1]
        assert np.sign(abs(moved[1]) - abs(rest[1])) == outward


# --------------------------------------------------------------------------------------- servos


ACTUATORS = ("data/samples/calibrated.yaml", "paper")


def swinging(actuator: str, knee: Knee, physics: Physics = "evaluation") -> np.ndarray:
    servos = servo_ranges(actuator).nominal()
    model = mujoco.MjModel.from_xml_string(robot_xml(servos, H, knee, physics=physics))
    return error_in_air(model, [servos[name] for name in JOINT_NAMES], exactly_solved=False)


def test_with_weightless_links_every_servo_of_the_robot_is_the_fitted_servo():
    for knee in KNEES:
        for actuator in ACTUATORS:
            np.testing.assert_allclose(swinging(actuator, knee), 0.0, atol=1e-6)
        # the iterations of training are enough for the measured friction: a count is 5.7 mrad,
        # and a tenth of it cannot be measured
        assert swinging(ACTUATORS[0], knee, "training").max() < math.pi / 550 / 10
