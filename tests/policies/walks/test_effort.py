"""Clearance of swings and effort of servos, from made-up motion whose answer is known."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from pupper_sysid.common.joints import LEGS
from pupper_sysid.policies.walks.effort import EffortMeter, sole_heights
from pupper_sysid.sim.robot.mini_pupper import (
    FOOT_RADIUS_M,
    MASS_KG,
    default_pose,
    limits,
    robot_xml,
)
from pupper_sysid.sim.robot.motion import Moved
from pupper_sysid.sim.robot.terrain import make_ground
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

FLAT = make_ground("flat", np.random.default_rng(0))
STEP_S, SUBSTEPS = 0.02, 10


@pytest.mark.parametrize("terrain", ["flat", "rough", "stairs"])
def test_soles_are_where_mujocos_sites_are(terrain):
    rng = np.random.default_rng(3)
    ground = make_ground(terrain, np.random.default_rng(0))
    model = mujoco.MjModel.from_xml_string(robot_xml(servo_ranges("paper").nominal(), 0.002))
    data = mujoco.MjData(model)
    qpos = np.zeros((2, 3, 19))
    qpos[..., :3] = rng.uniform(-1, 1, (2, 3, 3))
    qpos[..., 3:7] = rng.normal(size=(2, 3, 4))
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    qpos[..., 7:] = rng.uniform(*limits(), (2, 3, 12))
    found = sole_heights(qpos, ground)
    for at in np.ndindex(2, 3):
        data.qpos[:] = qpos[at]
        mujoco.mj_kinematics(model, data)
        for i, leg in enumerate(LEGS):
            x, y, z = data.site(f"{leg}_foot").xpos
            expected = z - FOOT_RADIUS_M - ground.height(np.array([x]), np.array([y]))[0]
            assert found[at][i] == pytest.approx(expected, abs=1e-9)


class Made:
    """One robot that rises and sinks with all feet, whose servos turn and push as told."""

    def __init__(self, limit_nm: float = 0.5):
        fields = {
            "actuator_forcerange": np.tile([-limit_nm, limit_nm], (1, 12, 1)),
            "body_mass": np.full((1, 2), MASS_KG / 2),
        }
        self.environments, self.ground = 1, FLAT
        self.config = SimpleNamespace(control_step_s=STEP_S)
        self.robots = SimpleNamespace(field=fields.__getitem__, to_servo=lambda joints: joints)
        self.moved: list[Moved] = []
        pose = np.zeros((1, 1, 19))
        pose[..., 3], pose[..., 7:] = 1.0, default_pose()
        self._pose = pose
        self._ground_m = float(sole_heights(pose, FLAT)[0, 0, 0])

    def step(self, meter, heights_m, contact, contact_s=0.0, last_air_s=0.0, speed=0.0,
             torque_nm=0.0, turned_rad=0.0):  # fmt: skip
        """One control step; `heights_m` are those of the soles after each physics step."""
        qpos = np.repeat(self._pose, SUBSTEPS, axis=1)
        qpos[0, :, 2] = np.asarray(heights_m) - self._ground_m
        start = qpos[:, 0, 7:].copy()
        qpos[0, :, 7:] += np.linspace(0, turned_rad, SUBSTEPS + 1)[1:, None]
        load = np.broadcast_to(torque_nm, (1, SUBSTEPS, 12))
        self.moved = [Moved(slice(0, 1), start, qpos, load, np.zeros((1, 4)))]
        four = np.ones((1, 4))
        facts = SimpleNamespace(
            contact=four * contact > 0, contact_s=four * contact_s, last_air_s=four * last_air_s,
            stride_velocity=np.array([[speed, 0.0, 9.0]]),
        )  # fmt: skip
        return meter.of(facts)


def test_the_clearance_of_a_swing_is_its_highest_point_between_two_control_steps():
    made = Made()
    meter = EffortMeter(made)
    made.step(meter, np.full(SUBSTEPS, 0.05), contact=True, contact_s=0.2)  # carried: no swing
    arc = 0.006 * np.sin(np.pi * np.arange(1, 31) / 31)
    for part in np.split(arc, 3)[:2]:
        assert np.isnan(made.step(meter, part, contact=False).clearance_m).all()
    landed = made.step(meter, np.split(arc, 3)[2], True, contact_s=STEP_S, last_air_s=0.04)
    assert landed.swing_ended.all()
    np.testing.assert_allclose(landed.clearance_m, arc.max(), atol=1e-9)
    # what was before is forgotten, and a flicker of one step is no swing
    made.step(meter, np.full(SUBSTEPS, 0.001), contact=False)
    flicker = made.step(meter, np.zeros(SUBSTEPS), True, contact_s=STEP_S, last_air_s=0.02)
    assert not flicker.swing_ended.any() and np.isnan(flicker.clearance_m).all()


def test_only_positive_work_counts_and_saturation_is_by_kind_of_joint():
    made = Made(limit_nm=0.5)
    meter, still = EffortMeter(made), np.zeros(SUBSTEPS)
    torque = np.zeros((SUBSTEPS, 12))
    torque[:, 2::3] = -0.25  # calves brake
    torque[:4, 1::3] = 0.5  # thighs drive, at their limit for 4 of 10 physics steps
    done = made.step(meter, still, True, speed=0.2, torque_nm=torque, turned_rad=0.1)
    np.testing.assert_allclose(done.saturated, [[0.0, 0.4, 0.0]])
    np.testing.assert_allclose(done.torque_square, [[0.0, 0.4, 0.25]])
    np.testing.assert_allclose(done.work_j, 4 * 0.5 * 0.04)
    np.testing.assert_allclose(done.carried_j, 9.80665 * MASS_KG * 0.2 * STEP_S)
