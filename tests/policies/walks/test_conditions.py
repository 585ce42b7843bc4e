"""Walks under many conditions at once are the walks under each of them alone."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.evaluation.evaluate import Recorder
from pupper_sysid.policies.walks import together as module
from pupper_sysid.policies.walks.together import (
    RANDOM,
    Condition,
    evaluation_task,
    random_commands,
    share_of_usual,
    walk_together,
    within,
)
from pupper_sysid.sim.robot.mini_pupper import default_pose
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Commands, Walking
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.legged import legged
from support.refusals import assert_each_refused


def test_commands_are_as_far_within_a_robots_ranges_as_usual_ones_within_theirs(tmp_path):
    dog = tmp_path / "dog.xml"
    dog.write_text(legged({"a": (1, 1), "b": (1, -1), "c": (-1, 1), "d": (-1, -1)}))
    own = Commands((0.0, 0.4), (0.0, 0.0), (-1.0, 1.0))
    usual = np.array([[0.15, 0.08, 0.4], [-0.15, -0.08, -0.4]])
    task = replace(TASK, commands=own, robot=str(dog))
    found = within(task, usual)
    # never backward, never sideways
    np.testing.assert_allclose(found, [[0.3, 0.0, 0.8], [0.0, 0.0, -0.8]])
    # errors of what no command asks for count as on a Mini Pupper of this size
    assert share_of_usual(task)[1] == task.body.command_scale[1] > 1.0


SERVOS = servo_ranges(SAMPLES / "calibrated.yaml")
TASK = evaluation_task(Walking())
ROUGH = replace(TASK, terrain="rough")


class Stepping:
    """Lifts the legs in turn, in each robot alike; robots of the other kind fold up and fall."""

    def __init__(self, falls: bool = False):
        self.falls = falls

    def reset(self, action):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.falls:
            return np.tile([0.0, 4.0, -4.0] * 4, (len(observation), 1))
        wave = 0.2 * np.sin(0.4 * self.step + np.arange(12))
        return np.repeat(wave[None], len(observation), axis=0)


def together(given, policy=None, seconds=0.5, threads=2, seed=3, recorder=Recorder, **more):
    return walk_together(
        policy or Stepping(), SERVOS, given, seconds, seed, threads, recorder, **more
    )


CONDITIONS = (
    Condition(TASK, 2), Condition(TASK, 2, None, 0.04), Condition(ROUGH, 2),
    Condition(ROUGH, 2, (0.1, 0.0, 0.2)),
)  # fmt: skip


def test_conditions_walked_together_are_those_walked_alone():
    """To the last bit, on any number of threads: robots share draws and an environment only."""
    walks = together(CONDITIONS, seconds=0.2, threads=3)
    for condition, walked in zip(CONDITIONS, walks, strict=True):
        (alone,) = together([condition], seconds=0.2, threads=1)
        np.testing.assert_array_equal(walked.velocity, alone.velocity)
        np.testing.assert_array_equal(walked.command, alone.command)
    usual, late, rough, commanded = walks
    assert not np.allclose(usual.velocity, late.velocity)
    assert not np.allclose(usual.velocity, rough.velocity)
    # the same robots at the same commands
    np.testing.assert_array_equal(usual.command, rough.command)
    assert (commanded.command == (0.1, 0.0, 0.2)).all()


def test_changed_observations_and_pushes_reach_the_robots_of_their_condition_only():
    seen, pushed = [], []

    class Watching(Recorder):
        def keep(self, now):
            seen.append(now.observation.copy())
            super().keep(now)

    def blind(step, observation):
        return np.zeros_like(observation)

    def push(step, env, robots):
        pushed.append(robots.tolist())
        env.robots.push(robots, np.tile([0.0, 0.3], (len(robots), 1)))

    given = [Condition(TASK, 2), Condition(TASK, 2, change=blind), Condition(TASK, 2, disturb=push)]
    usual, same, moved = together(given, seconds=0.2, threads=1, recorder=Watching)
    np.testing.assert_array_equal(usual.velocity, same.velocity)  # these legs do not look
    assert np.abs(moved.velocity - usual.velocity)[..., :2].max() > 0.05
    shown = [np.abs(rows).max() > 0 for step in seen for rows in np.split(step, len(step) // 2)]
    assert sum(not any_ for any_ in shown) == 10 and len(pushed) == 10
    assert all(len(robots) == 2 for robots in pushed)


def test_progress_grows_to_its_end_and_an_error_or_interruption_ends_all_walks():
    shares = []
    together(CONDITIONS, seconds=0.2, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1.0)
    assert len(shares) >= 2 * 10  # two kinds of ground, ten steps
    before = threading.active_count()

    def interrupt(share):
        if share > 0.2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        together(CONDITIONS, progress=interrupt)
    assert threading.active_count() == before


def test_random_commands_are_new_every_five_seconds_and_within_their_ranges():
    command = random_commands(200, 1000, 0.02, 0)
    changes = (np.diff(command, axis=0) != 0).all(axis=-1).sum(axis=0)
    assert changes.mean() == pytest.approx(20.0 / RANDOM.every_s, rel=0.1)
    assert changes.var() == pytest.approx(changes.mean(), rel=0.3)  # exponential intervals
    for axis, ends in enumerate((RANDOM.forward_m_s, RANDOM.sideways_m_s, RANDOM.yaw_rad_s)):
        assert command[..., axis].min() == pytest.approx(ends[0], rel=0.02)
        assert command[..., axis].max() == pytest.approx(ends[1], rel=0.02)
    np.testing.assert_array_equal(command[:, :5], random_commands(200, 1000, 0.02, 0)[:, :5])


def test_robots_walk_on_the_learned_servos_that_were_given(monkeypatch, tmp_path):
    """A folder as actuator is a learned servo model, not ideal servos."""
    model, given = object(), []
    monkeypatch.setattr(module, "servo_model_of", lambda source, step: (model, source, step))
    monkeypatch.setattr(module, "PupperEnv", lambda *all_: given.extend(all_) or 1 / 0)
    servos = replace(servo_ranges("ideal"), source=str(tmp_path))
    with pytest.raises(ZeroDivisionError):
        walk_together(None, servos, [Condition(TASK, 2)], 1.0, 3, 1, Recorder)
    assert (model, str(tmp_path), 0.02) in given


def test_policy_trot_and_standing_robots_share_an_environment_and_differ_in_their_actions_only(
    monkeypatch,
):
    monkeypatch.setattr(module, "_AT_A_TIME", 1)
    actions = []

    class Watching(Recorder):
        def keep(self, now):
            actions.append(now.action.copy())
            super().keep(now)

    given = [Condition(TASK, 2, (0.1, 0.0, 0.0), walker=w) for w in ("policy", "trot", "standing")]
    found = together(given, seconds=0.4, threads=1, recorder=Watching)
    own, trot, standing = np.split(np.array(actions), 3, axis=1)
    np.testing.assert_allclose(own[:, 0, 3], 0.2 * np.sin(0.4 * np.arange(1, 21) + 3), rtol=1e-6)
    assert not standing.any() and np.ptp(trot, axis=0).max() > 0.1
    clock = 2 * np.pi * Trot().frequency_hz * 0.02 * np.arange(20)
    joints = Trot().joints(clock, np.tile([0.1, 0, 0], (20, 1)))
    np.testing.assert_allclose(trot[:, 1] * TASK.action_scale + default_pose(), joints, atol=1e-6)
    # the same robots before they have acted differently
    firsts = np.array([walked.velocity[0] for walked in found])
    assert np.ptp(firsts, axis=0).max() < 0.05
    assert np.abs(found[1].velocity - found[2].velocity).max() > 0.05


def test_walks_that_no_machine_could_do_are_refused():
    def walk(asked):
        robots, seconds, threads, extra_s = asked
        given = [Condition(TASK, robots, (0.1, 0.0, 0.0), extra_s, walker="trot")]
        together(given, seconds=seconds, threads=threads)

    assert_each_refused(
        [
            ((10**30, 1.0, 1, 0.0), "robots for 1 s"), ((1, 1e12, 1, 0.0), "1 robots for 1e"),
            ((1, 1.0, -1, 0.0), "threads"), ((1, 1.0, 1, 1e9), "dead time"),
            ((1, 0.0, 1, 0.0), "shorter than one step"),
        ],
        walk,
    )  # fmt: skip
