"""A fall from kinematics is what MuJoCo's contacts of the whole robot would say."""

from __future__ import annotations

from typing import Any

import numpy as np

from pupper_sysid.common.joints import LEGS
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.falls import touches_ground
from pupper_sysid.sim.robot.mini_pupper import limits, robot_xml
from pupper_sysid.sim.robot.terrain import Ground, make_ground
from pupper_sysid.sim.walking.servo_ranges import servo_ranges


def ground_of(kind) -> Ground:
    return make_ground(kind, np.random.default_rng(3))


def model_on(ground: Ground) -> Any:
    servos = servo_ranges("ideal").nominal()
    xml = robot_xml(servos, 0.002, "linkage", ground.xml, ground.assets)
    model = mujoco.MjModel.from_xml_string(xml)
    ground.fill(model)
    return model


def random_robots(ground: Ground, count: int) -> np.ndarray:
    """Near the ground, in any pose, tilted by less than a fall."""
    rng = np.random.default_rng(0)
    qpos = np.zeros((count, 19))
    qpos[:, :2] = rng.uniform(-5, 5, (count, 2))
    qpos[:, 2] = ground.height(*qpos[:, :2].T) + rng.uniform(0.02, 0.12, count)
    axis = rng.standard_normal((count, 3)) * [1, 1, 0]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half, yaw = np.radians(rng.uniform(0, 53, (count, 1))) / 2, rng.uniform(0, np.pi, (count, 1))
    tilt = np.concatenate([np.cos(half), np.sin(half) * axis], axis=1)
    turn = np.concatenate([np.cos(yaw), 0 * yaw, 0 * yaw, np.sin(yaw)], axis=1)
    for row, a, b in zip(qpos[:, 3:7], turn, tilt, strict=True):
        mujoco.mju_mulQuat(row, a, b)
    qpos[:, 7:] = rng.uniform(*limits(), (count, 12))
    return qpos


def gravity(qpos: np.ndarray) -> np.ndarray:
    found = np.zeros((len(qpos), 3))
    for row, quaternion in zip(found, qpos[:, 3:7], strict=True):
        back = np.zeros(4)
        mujoco.mju_negQuat(back, quaternion)
        mujoco.mju_rotVecQuat(row, np.array([0.0, 0.0, -1.0]), back)
    return found


def depth_of_contact(model: Any, qpos: np.ndarray) -> np.ndarray:
    """How deep trunk, hips and thighs are in the ground [m]; 0 where they are not."""
    data, feet = mujoco.MjData(model), [model.geom(f"{leg}_foot").id for leg in LEGS]
    found = []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        own = ~np.isin(data.contact.geom, feet).any(axis=1)
        found.append(-min(data.contact.dist[own], default=0.0))
    return np.array(found)


def test_on_flat_ground_a_fall_is_any_contact_but_of_the_feet():
    ground = ground_of("flat")
    qpos = random_robots(ground, 2000)
    touching = touches_ground(qpos, gravity(qpos), ground)
    depth = depth_of_contact(model_on(ground), qpos)
    assert 0.2 < (depth > 0).mean() < 0.9
    np.testing.assert_array_equal(touching, depth > 0)


def test_on_other_ground_corners_and_knees_are_compared_with_the_ground_below_them():
    for kind in ("rough", "slopes", "steps"):
        ground = ground_of(kind)
        qpos = random_robots(ground, 1000)
        depth = depth_of_contact(model_on(ground), qpos)
        touching = touches_ground(qpos, gravity(qpos), ground)
        # between its corners a box can be on a bump, of 2 cm at most
        assert touching[depth > 0.02].all() and not touching[depth == 0].any()
        assert (touching == (depth > 0)).mean() > 0.95


def test_ground_within_fifteen_centimetres_is_never_higher_than_said():
    rng = np.random.default_rng(0)
    for kind in ("flat", "rough", "slopes", "steps"):
        ground = ground_of(kind)
        at = rng.uniform(-7.5, 7.5, (2000, 2))
        turn = rng.uniform(0, 2 * np.pi, 2000)
        away = at + 0.15 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        assert (ground.highest_near(*at.T) >= ground.height(*away.T)).all()
