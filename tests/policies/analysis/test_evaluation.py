"""Evaluation: falls and tracking errors, by command, ground and added dead time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.policies.analysis import evaluation
from pupper_sysid.policies.analysis.evaluation import _share, evaluate, summary, walk
from pupper_sysid.policies.walks.conditions import DIRECTIONS, RANDOM, evaluation_task
from pupper_sysid.sim.walking.config import Curriculum, Walking
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

CALIBRATION = str(Path(__file__).resolve().parents[3] / "data/samples/calibrated.yaml")


class Scripted:
    """Robots with even numbers stand; the others fold all legs and fall on their bellies."""

    def reset(self, action):
        self.rows = np.arange(len(action))

    def act(self, observation):
        return np.outer(self.rows % 2, [0.0, 4.0, -4.0] * 4)


def test_a_robot_that_stands_still_is_wrong_by_what_it_was_asked_and_what_it_moved():
    """Triangle inequality, |error - asked| ≤ mean speed, for every episode and axis."""
    task = evaluation_task(Walking(), 1.0)
    found = walk(None, task, servo_ranges("ideal"), 6, 3, threads=1)
    assert not found.fell.any() and found.alive.all()
    moved = np.abs(found.velocity).mean(axis=0)
    assert (np.abs(found.error - found.commanded) <= moved + 1e-9).all()
    # ideal servos stand still after a drop of 2 mm: what is left is the command
    np.testing.assert_allclose(found.error.mean(axis=0), found.commanded.mean(axis=0), rtol=0.05)
    ends = np.array([RANDOM.forward_m_s[1], RANDOM.sideways_m_s[1], RANDOM.yaw_rad_s[1]])
    assert (found.commanded <= ends).all() and (found.commanded > 0).all()


def test_the_error_is_that_of_the_command_given():
    task = evaluation_task(Walking(), 0.4)
    command = (0.15, -0.05, 0.4)
    found = walk(None, task, servo_ranges(CALIBRATION), 3, 3, command, threads=1)
    np.testing.assert_allclose(found.commanded, [np.abs(command)] * 3)
    expected = np.abs(found.velocity - command).mean(axis=0)
    np.testing.assert_allclose(found.error, expected)


def test_the_share_of_falls_counts_each_robot_that_fell_once_and_no_time_out():
    task = evaluation_task(Walking(), 2.0)
    found = walk(Scripted(), task, servo_ranges(CALIBRATION), 6, 3, (0.0, 0.0, 0.0), threads=1)
    assert found.fell.tolist() == [False, True] * 3
    assert summary(found).fall_rate == 0.5
    lived = found.alive.sum(axis=0)
    assert (lived[1::2] < task.episode_steps).all()
    assert (lived[::2] == task.episode_steps).all()


def test_an_evaluation_covers_all_commands_and_says_where():
    shares = []
    found = evaluate(
        None, Walking(episode_s=0.1), servo_ranges(CALIBRATION), 5, 0, 1, progress=shares.append
    )
    assert [row.name for row in found.by_command] == list(DIRECTIONS)
    assert [row.command for row in found.by_command] == list(DIRECTIONS.values())
    commands = np.array(list(DIRECTIONS.values()))
    for axis in range(3):
        assert (commands[:, axis] > 0).any() and (commands[:, axis] < 0).any()
    assert not commands[list(DIRECTIONS).index("stand")].any()
    assert found.episodes == 5 and found.episode_s == 0.1 and found.actuator == CALIBRATION
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1.0)


def test_no_condition_is_walked_twice(monkeypatch):
    """Flat ground and no added dead time are the first half of the random commands' episodes."""
    walked, together = [], evaluation.walk_together

    def counted(policy, servos, conditions, *rest):
        walked.extend(conditions)
        return together(policy, servos, conditions, *rest)

    monkeypatch.setattr(evaluation, "walk_together", counted)
    found = evaluate(
        None, Walking(episode_s=0.2), servo_ranges(CALIBRATION), 4, 0, 1,
        grounds=("flat", "rough"), extra_delays_ms=(0.0, 40.0),
    )  # fmt: skip
    assert [c.robots for c in walked] == [4, *[1] * 7, 2, 2]
    flat, rough = found.by_terrain
    usual, late = found.by_extra_delay
    assert flat.intervals == usual.intervals and flat.episodes == usual.episodes == 2
    assert rough.mae_vx_m_s != flat.mae_vx_m_s != late.mae_vx_m_s
    alone = walk(None, evaluation_task(Walking(), 0.2), servo_ranges(CALIBRATION), 4, 0, threads=1)
    assert flat.mae_vx_m_s == pytest.approx(float(alone.error[:2, 0].mean()))


def test_intervals_are_over_episodes():
    """Of no falls in 30 episodes, 1 - 0.05^(1/30); of errors 0 and 2, 1 ± 6.314 (t, one degree)."""
    none = _share(0, 30)
    assert (none.value, none.low) == (0.0, 0.0) and none.high == pytest.approx(1 - 0.05 ** (1 / 30))
    every = _share(30, 30)
    assert every.high == 1.0 and every.low == pytest.approx(0.05 ** (1 / 30))
    found = walk(None, evaluation_task(Walking(), 0.1), servo_ranges("ideal"), 2, 0, threads=1)
    own = summary(found).intervals.mae_yaw_rad_s
    half = abs(found.error[0, 2] - found.error[1, 2]) / 2
    assert own.value == pytest.approx(found.error[:, 2].mean())
    assert own.high - own.value == pytest.approx(6.3138 * half, rel=1e-4)


def test_an_evaluation_has_no_pushes_no_curriculum_and_gentle_starts():
    task = evaluation_task(Walking())
    assert task.randomisation.push_m_s == 0 and task.randomisation.on_the_move == 0
    assert task.curriculum == Curriculum() and task.commands == RANDOM
    assert task.episode_s == Walking().episode_s
    assert task.physics == "evaluation"


def test_an_evaluation_is_the_same_for_the_same_seed_and_another_for_another():
    task, servos = evaluation_task(Walking(), 0.2), servo_ranges(CALIBRATION)
    one, same, other = (walk(None, task, servos, 3, seed, threads=1).error for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
