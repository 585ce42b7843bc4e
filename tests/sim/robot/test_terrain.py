"""The ground that can be looked up is the ground that MuJoCo simulates."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from pupper_sysid.common.joints import LEGS
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import limits, robot_xml, touches_ground
from pupper_sysid.sim.robot.terrain import SPACING_M, STAIRS_M, TILE_M, Ground, make_ground
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

KINDS = ("flat", "rough", "slopes", "troughs", "steps", "mixed")


def ground_of(kind) -> Ground:
    return make_ground(kind, np.random.default_rng(3))


def heights_of(ground: Ground) -> np.ndarray:
    assert ground.heights is not None
    return ground.heights


def simulated(ground: Ground) -> Any:
    servos = servo_ranges("ideal").nominal()
    model = mujoco.MjModel.from_xml_string(
        robot_xml(servos, 0.002, "linkage", ground.xml, ground.assets)
    )
    ground.fill(model)
    return model


def hit_by_rays(ground: Ground, points: np.ndarray) -> np.ndarray:
    """Heights at which rays from above hit MuJoCo's ground [m]."""
    model = simulated(ground)
    data = mujoco.MjData(model)
    data.qpos[2] = 10.0  # the robot out of the way
    mujoco.mj_forward(model, data)
    down, geom = [0.0, 0.0, -1.0], np.zeros(1, np.int32)
    return np.array(
        [3.0 - mujoco.mj_ray(model, data, [*p, 3.0], down, None, 1, -1, geom, None) for p in points]
    )


def test_heights_are_where_rays_hit_mujocos_ground():
    for kind in KINDS:
        ground, points = ground_of(kind), np.random.default_rng(0).uniform(-7.9, 7.9, (200, 2))
        below = hit_by_rays(ground, points)
        assert kind == "flat" or np.ptp(below) > 0.005, "even ground compares nothing"
        np.testing.assert_allclose(ground.height(*points.T), below, atol=1e-6)


def test_slopes_are_gentle_and_hills_and_troughs_end_in_a_flat_platform_of_60_centimetres():
    for kind, sign in (("slopes", 1), ("troughs", -1)):
        heights = heights_of(ground_of(kind))
        # the last row and column repeat their neighbours; between tiles there is a step of one edge
        inside = heights[: len(heights) // 2, : len(heights) // 2]
        steepest = max(np.abs(np.diff(inside, axis=axis)).max() for axis in (0, 1)) / SPACING_M
        assert 2.0 < np.degrees(np.arctan(steepest)) <= 8.531
        count = round(TILE_M / SPACING_M)
        for row, column in product((0, count), (0, count)):
            tile = sign * heights[row : row + count, column : column + count]
            middle = tile[count // 2 - 6 : count // 2 + 6, count // 2 - 6 : count // 2 + 6]
            assert np.ptp(middle) == 0.0
            assert middle.max() == tile.max() > 0.1
            assert tile.min() >= 0.0
            assert np.ptp(tile[count // 2 - 7 : count // 2 + 7, count // 2]) > 0


def test_steps_are_level_and_as_high_as_a_foot_is_lifted_at_most():
    heights, count = heights_of(ground_of("steps")), round(TILE_M / SPACING_M)
    tile = heights[:count, :count]
    risers = np.unique(np.round(np.diff(tile[count // 2, : count // 2]), 9))
    assert len(risers) == 2 and risers[0] == 0 and 0.003 <= risers[1] <= 0.01
    # mostly treads
    assert (np.diff(tile[count // 2]) == 0).mean() > 0.8


def test_rough_ground_is_one_or_two_centimetres_high_with_a_flat_border_around_each_tile():
    heights = heights_of(ground_of("rough"))
    assert set(np.unique(heights)) == {0.0, 0.01, 0.02}
    count = round(TILE_M / SPACING_M)
    tile = heights[:count, :count]
    assert not tile[:5].any()
    assert not tile[:, -5:].any()
    assert tile[5:-5, 5:-5].min() == 0.01
    # a fair choice between two heights, within four standard deviations
    inner = tile[5:-5, 5:-5].ravel() == 0.02
    assert inner.mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(inner.size))


def test_flat_ground_never_ends_and_other_ground_goes_on_as_at_its_edge():
    ground = ground_of("flat")
    assert ground.heights is None and ground.half_size_m == np.inf
    assert not ground.height(np.array([0.0, 1e6]), np.array([1.0, -1e6])).any()
    ground = ground_of("slopes")
    inside = ground.height(np.array([ground.half_size_m]), np.array([1.0]))
    beyond = ground.height(np.array([ground.half_size_m + 5.0]), np.array([1.0]))
    np.testing.assert_array_equal(beyond, inside)


def test_stairs_are_where_rays_hit_them_and_rise_by_their_steps_over_nothing():
    ground = ground_of("stairs")
    points = np.random.default_rng(0).uniform((-9.0, -3.0), (9.0, 3.0), (300, 2))
    np.testing.assert_allclose(ground.height(*points.T), hit_by_rays(ground, points), atol=1e-9)
    assert (ground.highest_near(*points.T) >= ground.height(*points.T)).all()
    for riser, (middle, side) in STAIRS_M.items():
        out = middle + np.linspace(0.0, 3.0, 100_000)
        rises = -np.diff(ground.height(out, np.full_like(out, side)))
        np.testing.assert_allclose(rises[rises > 0], riser)  # each between two neighbours
        assert (rises > 0).sum() == 7 and ground.highest_near(out, out * 0).max() == 7 * riser


# ----- a fall from kinematics is what MuJoCo's contacts of the whole robot would say


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
    depth = depth_of_contact(simulated(ground), qpos)
    assert 0.2 < (depth > 0).mean() < 0.9
    np.testing.assert_array_equal(touching, depth > 0)


def test_on_other_ground_corners_and_knees_are_compared_with_the_ground_below_them():
    for kind in ("rough", "slopes", "steps"):
        ground = ground_of(kind)
        qpos = random_robots(ground, 1000)
        depth = depth_of_contact(simulated(ground), qpos)
        touching = touches_ground(qpos, gravity(qpos), ground)
        # between its corners a box can be on a bump, of 2 cm at most
        assert touching[depth > 0.02].all() and not touching[depth == 0].any()
        assert (touching == (depth > 0)).mean() > 0.95
