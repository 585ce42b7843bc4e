"""Handicaps: slopes, loads, weak legs, pushes, missed ticks, jitter, stairs, slippery ground."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.evaluation.evaluate import Recorder
from pupper_sysid.policies.walks import together
from pupper_sysid.policies.walks.together import (
    Condition,
    Handicap,
    evaluation_task,
    impose,
    missed_ticks,
    push_directions,
    walk_together,
)
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import robot_xml
from pupper_sysid.sim.robot.terrain import STAIRS_M
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from pupper_sysid.sim.walking.step import OBSERVATION_PARTS

SERVOS = servo_ranges(SAMPLES / "calibrated.yaml")
TASK = evaluation_task(Walking())
ALL = np.arange(4)


def robots_with(own: Handicap, task: Walking = TASK) -> PupperEnv:
    env = PupperEnv(task, SERVOS, 4, 1, 1)
    impose(env.robots, ALL, own)
    return env


def walked(*own: Handicap, seconds: float = 0.5, recorder=Recorder, policy=None, **more):
    given = [Condition(more.get("task", TASK), 2, (0.1, 0.0, 0.0), handicap=h) for h in own]
    given = [replace(c, walker=more.get("walker", "policy")) for c in given]
    return walk_together(policy, SERVOS, given, seconds, 3, 1, recorder)


@pytest.fixture(autouse=True)
def in_one_environment(monkeypatch):
    monkeypatch.setattr(together, "_AT_A_TIME", 1)


def watched(*own: Handicap, **more) -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions of all robots, shapes (steps, n, …)."""
    moments = []

    class Watching(Recorder):
        def keep(self, now):
            moments.append((now.observation.copy(), now.action.copy()))
            super().keep(now)

    walked(*own, recorder=Watching, **more)
    seen, acted = zip(*moments, strict=True)
    return np.array(seen), np.array(acted)


def test_on_a_slope_gravity_pulls_and_is_seen_along_the_tilted_direction():
    task = replace(TASK, observation=replace(TASK.observation, noise=False))
    sloped, level = Handicap(slope_deg=15.0), Handicap()
    env = robots_with(sloped)
    pull = env.robots.field("opt.gravity")
    np.testing.assert_allclose(np.linalg.norm(pull, axis=1), 9.81)
    np.testing.assert_allclose(np.degrees(np.arccos(-pull[:, 2] / 9.81)), 15.0)
    seen, _ = watched(sloped, level, seconds=1.0, task=task)
    seen = seen[-1, :, OBSERVATION_PARTS["projected_gravity"]]
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 1.0, rtol=1e-5)
    tilt = np.degrees(np.arccos(-seen[:, 2]))
    # the robot stands along the ground, but for the sag of its servos
    np.testing.assert_allclose(tilt[:2], 15.0, atol=3.0)
    assert (tilt[2:] < 3.0).all()


def test_a_load_is_a_point_mass_that_is_fixed_to_the_trunk():
    """Mass matrices are those of MuJoCo's own robot with a small heavy body on it."""
    own = Handicap(payload_kg=0.15, payload_at_m=(-0.08, 0.03))
    env = robots_with(own)
    heavy = env.robots.batch.get_model(2)
    env.robots.payload_kg[:] = 0.0  # for the other robot: without the payload that is drawn
    text = robot_xml(servo_ranges("ideal").nominal(), 0.002)
    height = 0.0266 - 0.00015
    body = (
        f'<body pos="-0.08 0.03 {height}"><inertial pos="0 0 0" mass="0.15" '
        'diaginertia="1e-12 1e-12 1e-12"/></body>'
    )
    text = re.sub(r'(<freejoint name="root"/>)', r"\1" + body, text)
    text = text.replace('<body name="trunk"', '<body name="trunk" ', 1)
    other = mujoco.MjModel.from_xml_string(text)
    trunk = heavy.body("trunk").id
    other.body_mass[trunk] = heavy.body_mass[trunk] - 0.15
    other.dof_armature[:] = heavy.dof_armature
    matrices = []
    for model in (heavy, other):
        data = mujoco.MjData(model)
        data.qpos[3:7] = 0.9, 0.1, -0.3, 0.2
        mujoco.mj_forward(model, data)
        found = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, found)
        matrices.append(found)
    np.testing.assert_allclose(matrices[0][:6, :6], matrices[1][:6, :6], rtol=1e-6, atol=1e-10)


def test_one_leg_of_each_robot_is_weak_with_its_friction_and_slippery_are_the_feet():
    plain, weak = robots_with(Handicap()).robots, robots_with(Handicap(weak_leg=0.25)).robots
    for name in ("stiffness", "damping", "effort_limit"):
        ratio = (weak.drawn[name] / plain.drawn[name]).reshape(4, 4, 3)
        np.testing.assert_allclose(
            ratio, np.where(np.eye(4, dtype=bool), 0.25, 1.0)[..., None] * np.ones(3)
        )
    np.testing.assert_array_equal(weak.drawn["friction_loss"], plain.drawn["friction_loss"])
    for own in (weak, plain):
        limits = own.field("actuator_forcerange")[..., 1]
        np.testing.assert_allclose(limits, own.drawn["effort_limit"])
    slippery = robots_with(Handicap(friction=0.15)).robots
    foot = slippery.model.geom("RB_foot").id
    np.testing.assert_allclose(slippery.field("geom_friction")[:, foot, 0], 0.15)


def test_robots_stand_on_the_stairs_of_their_steps():
    task = replace(TASK, terrain="stairs")
    for riser, middle in STAIRS_M.items():
        env = robots_with(Handicap(riser_m=riser), task)
        qpos = env.robots.qpos
        assert (np.abs(qpos[:, :2] - middle) <= 1.5).all()
        under = env.ground.height(qpos[:, 0], qpos[:, 1])
        np.testing.assert_allclose(under / riser, np.rint(under / riser), atol=1e-9)
        above = qpos[:, 2] - under
        assert (above > 0.08).all() and (above < 0.09 + 2 * riser).all()
        for _ in range(25):
            assert not env.step(np.zeros((4, 12))).done.any()


def test_pushes_add_to_the_velocity_every_four_seconds_and_are_the_same_by_whatever_one_walks():
    directions = push_directions(3, 1000, 0.02, 0)
    assert list(directions) == [150, 350, 550, 750, 950]
    np.testing.assert_allclose(np.linalg.norm(list(directions.values()), axis=-1), 1.0)
    own = Handicap(push_m_s=0.3)
    walks = walk_together(
        None, SERVOS,
        [
            Condition(TASK, 2, (0.1, 0.0, 0.0), walker=walker, handicap=handicap)
            for walker in ("policy", "standing", "trot") for handicap in (Handicap(), own)
        ],
        3.04, 3, 1, Recorder,
    )  # fmt: skip
    for plain, pushed in zip(walks[::2], walks[1::2], strict=True):
        np.testing.assert_array_equal(plain.velocity[:150], pushed.velocity[:150])
        jump = np.linalg.norm((pushed.velocity - plain.velocity)[150, :, :2], axis=-1)
        assert (jump > 0.1).all() and (jump < 0.35).all()
    # a policy that is none stands as well
    np.testing.assert_array_equal(walks[1].velocity[150], walks[3].velocity[150])
    assert own.since_push_s(2.9) is None and own.since_push_s(7.5) == pytest.approx(0.5)
    assert Handicap().since_push_s(7.5) is None


class Counting:
    """Acts by how often it has acted, for each robot."""

    def reset(self, action):
        self.count = np.zeros(len(action))

    def act(self, observation, missed=None):
        self.count += 1 if missed is None else ~missed
        return np.repeat(self.count[:, None], 12, axis=1) / 1000


def test_in_a_missed_tick_set_points_stay_the_policy_does_not_run_and_the_trot_keeps_its_clock():
    late = Handicap(missed_ticks=0.3)
    _, actions = watched(late, Handicap(), seconds=2.0, policy=Counting())
    actions = 1000 * actions[..., 0]
    missed = missed_ticks(2, 100, 3) < 0.3
    expected = np.cumsum(~missed, axis=0)
    np.testing.assert_allclose(actions[:, :2], expected, rtol=1e-5)
    np.testing.assert_allclose(actions[:, 2:], np.arange(1, 101)[:, None] * np.ones(2), rtol=1e-5)
    assert missed.mean() == pytest.approx(0.3, abs=0.1)
    _, actions = watched(late, Handicap(), seconds=0.8, walker="trot")
    missed = missed_ticks(2, 40, 3) < 0.3
    for robot in range(2):
        runs, held = ~missed[:, robot], np.flatnonzero(missed[:, robot])
        np.testing.assert_array_equal(actions[runs, robot], actions[runs, 2 + robot])
        np.testing.assert_array_equal(actions[held, robot], actions[held - 1, robot])


def test_jitter_leaves_the_mean_latency_and_no_command_comes_before_an_earlier_one():
    delays = []

    class Delays(Recorder):
        def keep(self, now):
            delays.append(self.env.robots.field("actuator_delay").copy())
            super().keep(now)

    plain, jittered = walked(
        Handicap(), Handicap(extra_jitter_s=0.02), seconds=4.0, recorder=Delays, walker="standing"
    )
    found = np.array(delays)
    assert (np.diff(found, axis=0) <= 0.02 + 1e-9).all() and (found >= 0).all()
    # joints of a robot are late by the same time: one frame has all their commands
    late = found[:, 2:] - found[:, :2]
    assert np.ptp(late, axis=2).max() < 0.03
    assert late.std() > 0.008 and np.abs(late.mean()) < 0.005
    assert plain.alive.all() and jittered.alive.all()
