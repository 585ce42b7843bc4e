"""Evaluation: falls and tracking errors, by command, ground and added dead time."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.evaluation.evaluate import (
    BATTERY,
    WALKERS,
    Case,
    Recorder,
    battery_robots,
    evaluate,
    figures_of,
    in_short,
    share_interval,
    table,
    usual_robots,
)  # fmt: skip
from pupper_sysid.policies.evaluation.evaluate import RANDOM as RANDOM_COMMANDS
from pupper_sysid.policies.walks.together import (
    DIRECTIONS,
    RANDOM,
    Condition,
    evaluation_task,
    walk_together,
)
from pupper_sysid.sim.robot.mini_pupper import MASS_KG
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Curriculum, Walking, for_robot
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.legged import legged
from support.walks import walk

CALIBRATION = str(SAMPLES / "calibrated.yaml")


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
    moved, asked = (np.abs(x).mean(axis=0) for x in (found.velocity, found.command))
    assert (np.abs(found.error - asked) <= moved + 1e-9).all()
    # ideal servos stand still after a drop of 2 mm: what is left is the command
    np.testing.assert_allclose(found.error.mean(axis=0), asked.mean(axis=0), rtol=0.05)
    ends = np.array([RANDOM.forward_m_s[1], RANDOM.sideways_m_s[1], RANDOM.yaw_rad_s[1]])
    assert (asked <= ends).all() and (asked > 0).all()


def test_a_fall_counts_once_and_its_error_is_that_of_standing_to_the_end_of_the_episode():
    """Also where all robots of a condition have fallen, and nothing is simulated any more."""
    task, command = evaluation_task(Walking(), 1.2), np.array([0.2, -0.05, -0.4])

    class Folding(Scripted):
        def act(self, observation):
            return np.tile([0.0, 4.0, -4.0] * 4, (len(observation), 1))

    for policy, fell in ((Scripted(), [False, True] * 2), (Folding(), [True] * 4)):
        walked = walk(policy, task, servo_ranges(CALIBRATION), 4, 3, tuple(command), threads=1)
        assert walked.command.shape == (60, 4, 3) and walked.fell.tolist() == fell
        assert figures_of(walked).fall_rate == np.mean(fell)
        steps = walked.alive.sum(axis=0)
        assert ((steps < 60) == walked.fell).all(), "the end of the episode is no fall"
        for i, up in enumerate(steps):
            before = np.abs(walked.velocity[:up, i] - command).sum(axis=0)
            expected = (before + (60 - up) * np.abs(command)) / 60
            np.testing.assert_allclose(walked.error[i], expected)


def test_a_trot_clears_the_ground_and_works_and_a_standing_robot_does_neither():
    task, forward = evaluation_task(Walking(), 2.0), (0.15, 0.0, 0.0)
    both = [Condition(task, 2, forward, walker=walker) for walker in ("trot", "standing")]
    walks = walk_together(None, servo_ranges(CALIBRATION), both, 2.0, 3, 1, Recorder)
    trot, still = (figures_of(walked, forward) for walked in walks)
    # no foot rises above the lift of its set-points, but for what the trunk rocks
    assert 0.0 < trot.clearance_p10_m < trot.clearance_p50_m < 1.5 * Trot().lift_m
    assert 0.0 <= trot.low_swing_share < 0.5
    # work goes into friction and impacts: more than that of lifting a leg at each step
    assert trot.mechanical_power_w > 0.5 > 5 * still.mechanical_power_w
    weight_n = 9.81 * MASS_KG
    assert trot.cost_of_transport == pytest.approx(
        trot.mechanical_power_w / (weight_n * trot.speed_share * 0.15), rel=0.25
    )  # of the whole walk, its slow start and payloads included
    for kind in ("hip", "thigh", "calf"):
        share, rms = trot.torque_saturated_share[kind], trot.rms_torque_share[kind]
        assert 0.0 <= share <= rms**2 <= 1.0 + 1e-9, "a saturated servo has a square of 1"
    assert np.isnan(still.clearance_p50_m) or still.clearance_p50_m < trot.clearance_p50_m


def test_policy_trot_and_standing_walk_as_the_same_robots_in_every_row():
    shares = []
    found = evaluate(
        None, Walking(episode_s=0.1), servo_ranges(CALIBRATION), table(("flat", "rough"), (0, 40)),
        usual_robots(5), 7, 1, progress=shares.append,
    )  # fmt: skip
    names = [row.name for row in found.conditions]
    assert names == ["random commands", *DIRECTIONS, "ground: rough", "dead time +40 ms"]
    assert [row.command for row in found.conditions] == [None, *DIRECTIONS.values(), None, None]
    first = found.conditions[0]
    assert [getattr(first, walker).episodes for walker in WALKERS] == [5, 2, 2]
    assert {row.policy.episodes for row in found.conditions[1:]} == {1}
    assert found.episode_s == 0.1 and found.actuator == CALIBRATION and found.seed == 7
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1.0)
    task = evaluation_task(Walking(), 0.1)
    standing = walk(None, task, servo_ranges(CALIBRATION), 5, 7, None, 1, "standing")
    of_two = {f.name: getattr(standing, f.name)[:, :2] for f in fields(standing)[3:]}
    own = figures_of(replace(standing, fell=standing.fell[:2], **of_two))
    beside = first.standing
    assert (beside.mae_vx_m_s, beside.duty) == (own.mae_vx_m_s, own.duty)
    assert first.trot.mae_vx_m_s != own.mae_vx_m_s


def test_the_open_loop_trot_keeps_its_clock_and_follows_its_commands():
    """At its own rhythm, on straight paths the commanded speed within a tenth."""
    task = evaluation_task(Walking(), 4.0)
    found = walk(None, task, servo_ranges(CALIBRATION), 3, 0, (0.15, 0.0, 0.0), 1, "trot")
    own = figures_of(found, (0.15, 0.0, 0.0))
    steps = found.contact - found.contact.mean(axis=0)
    power = (np.abs(np.fft.rfft(steps, 4000, axis=0)) ** 2).sum(axis=(1, 2))
    rhythm_hz = np.fft.rfftfreq(4000, found.step_s)[power.argmax()]
    assert own.fall_rate == 0 and rhythm_hz == pytest.approx(Trot().frequency_hz, rel=0.02)
    # a foot that bounces as it comes down makes two swings
    assert 1.0 < own.stride_hz / rhythm_hz < 1.15
    # its feet clear the ground once it walks; those of a trot of small errors alone by 2.8 mm here
    walking = found.clearance_m[round(1.0 / found.step_s) :]
    assert np.nanquantile(walking, 0.1) > 0.004
    assert own.speed_share == pytest.approx(1.0, abs=0.15)
    assert own.speed_share == pytest.approx(own.mean_velocity[0] / 0.15)
    assert 0.5 < np.mean(own.duty) < 0.75
    # within a stride the trunk sways: averaged over it, the error is a fraction
    assert own.stride_mae_vx_m_s < 0.75 * own.mae_vx_m_s
    assert 0 < own.heading_drift_deg < 90
    turned = np.degrees(np.abs(found.heading[-1] - found.heading[0]))
    assert own.heading_drift_deg == pytest.approx(turned.mean())


def test_the_battery_has_a_row_for_each_condition_and_its_falls_say_what_came_before():
    names = [case.name for case in BATTERY]
    assert len(set(names)) == len(names) and max(map(len, names)) <= 18
    groups = {case.group for case in BATTERY}
    assert groups == {
        "push", "slope", "stairs", "payload", "leg", "ticks", "dead time", "jitter", "friction",
        "robot",
    }  # fmt: skip
    hard = [case for case in BATTERY if case.name == "pushes of 1.2 m/s"]
    found = evaluate(
        Scripted(), Walking(episode_s=3.4), servo_ranges(CALIBRATION), hard, battery_robots(2), 0, 1
    )
    assert [row.name for row in found.conditions] == [RANDOM_COMMANDS.name, hard[0].name]
    assert all(getattr(row, w).episodes == 2 for row in found.conditions for w in WALKERS)
    # the second of the scripted robots folds up and falls on its belly
    belly = [f for f in found.falls if f.walker == "policy" and f.episode == 1]
    assert {f.row for f in belly} == {row.name for row in found.conditions}
    assert all(f.time_s < 1.5 and not f.tipped and f.since_push_s is None for f in belly)
    pushed = [f for f in found.falls if f.row == hard[0].name and f.since_push_s is not None]
    assert all(0 <= f.since_push_s <= 0.4 and f.time_s > 3.0 for f in pushed)
    short = in_short(found.falls)
    assert sum(own["falls"] for own in short) == len(found.falls)
    assert sum(own["after_push"] for own in short) == len(pushed)


def test_an_evaluation_has_no_pushes_no_curriculum_gentle_starts_and_walks_of_its_seed():
    task = evaluation_task(Walking(terrain="rough"))
    assert task.randomisation.push_m_s == 0 and task.randomisation.on_the_move == 0
    assert task.curriculum == Curriculum() and task.commands == RANDOM
    assert task.episode_s == Walking().episode_s and task.physics == "evaluation"
    assert Case("direction", "forward").condition(task, 1, "trot").task.terrain == "flat"
    assert Case("ground", "s", terrain="slopes").condition(task, 1, "trot").task.terrain == "slopes"
    task, servos = evaluation_task(Walking(), 0.2), servo_ranges(CALIBRATION)
    one, same, other = (walk(None, task, servos, 3, seed, threads=1).error for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_intervals_are_over_episodes():
    """Of no falls in 30 episodes, 1 - 0.05^(1/30); of errors 0 and 2, 1 ± 6.314 (t, one degree)."""
    none = share_interval(0, 30)
    assert (none.value, none.low) == (0.0, 0.0) and none.high == pytest.approx(1 - 0.05 ** (1 / 30))
    every = share_interval(30, 30)
    assert every.high == 1.0 and every.low == pytest.approx(0.05 ** (1 / 30))
    found = walk(None, evaluation_task(Walking(), 0.1), servo_ranges("ideal"), 2, 0, threads=1)
    own = figures_of(found).intervals["mae_yaw_rad_s"]
    half = abs(found.error[0, 2] - found.error[1, 2]) / 2
    assert own.value == pytest.approx(found.error[:, 2].mean())
    assert own.high - own.value == pytest.approx(6.3138 * half, rel=1e-4)


def test_the_battery_is_as_hard_for_another_robot_by_its_size_and_weight(tmp_path):
    dog = tmp_path / "dog.xml"
    dog.write_text(legged({"a": (1, 1), "b": (1, -1), "c": (-1, 1), "d": (-1, -1)}))
    task = for_robot(Walking(episode_s=0.1), dog, None)
    body, groups = task.body, ("push", "payload", "stairs")
    cases = [case for case in BATTERY if case.group in groups]
    servos = servo_ranges("ideal", "ideal", body)
    rows = evaluate(None, task, servos, cases, battery_robots(2), 0, 1).conditions[1:]
    # loads of a third of the Mini Pupper's weight, in lengths of its height
    grams = f"{1e3 * 0.15 * body.mass_kg / MASS_KG:.0f} g"
    assert [row.name for row in rows if row.group == "payload"] == [
        f"{grams}, {4 * body.scale:.0f} cm left", f"{grams}, {8 * body.scale:.0f} cm behind",
    ]  # fmt: skip
    pushed = next(row.name for row in rows if row.group == "push")
    assert pushed == f"pushes of {0.4 * body.scale**0.5:.2g} m/s"
