"""The first gait: judged on the servos of a run, corrected, searched, and taken over."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.policies.train import first_gait
from pupper_sysid.policies.train.first_gait import (
    FirstGait,
    GaitScore,
    fit_trot,
    fits_trots,
    judge_trots,
    suited,
    with_first_gait,
)
from pupper_sysid.policies.train.run_file import OWN, TROT, Imitation, preset, teacher_of
from pupper_sysid.policies.train.selection import COMMANDS
from pupper_sysid.policies.walks.together import share_of_usual, within
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Commands, Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_ranges
from support.tiny_training import CALIBRATION, tiny_run

GOOD = GaitScore(
    score=0.8, falls=0.0, forward_share=1.0, turn_share=1.0, speed_error_m_s=0.0155,
    mean_speed_error_m_s=0.0032, turn_error_rad_s=0.056, mean_turn_error_rad_s=0.021,
    clearance_p10_m=0.009, low_swing_share=0.02, saturated_share=0.3,
)  # fmt: skip
BAD = replace(GOOD, score=0.3, forward_share=0.4, speed_error_m_s=0.031, turn_error_rad_s=1.0)
FITTED = Trot(frequency_hz=2.5, duty=0.7, lift_m=0.02, crouch_m=0.01, spread_m=0.002)


def walked(command, shares) -> first_gait._Walked:
    """Robots that move at `shares`, shape (n, 3), of their commands, and stay up."""
    velocity = np.tile(command * shares, (5, 1, 1))
    up = np.ones(velocity.shape[:2], bool)
    return first_gait._Walked(
        np.ones(3), 1.0, 0.005, command, velocity, velocity, up, np.array([0.006]), 0.2, 0.3, 0.1
    )


def test_gains_are_corrected_by_the_share_of_the_speed_that_was_reached_in_each_direction():
    command = np.repeat(COMMANDS, 2, axis=0)
    shares = np.where(command[:, :1] < 0, 0.8, 1.25) * np.ones(3)
    shares[:, 1], shares[:, 2] = 0.9, 0.7
    trot = Trot(gain=1.0, back_gain=1.0, side_gain=1.0, turn_gain=1.0)
    found = first_gait._corrected(trot, walked(command, shares))
    assert found.gain == pytest.approx(1 / 1.25)
    assert found.gain * found.back_gain == pytest.approx(1 / 0.8)
    assert found.gain * found.side_gain == pytest.approx(1 / 0.9)
    assert found.turn_gain == pytest.approx(1 / 0.7)
    # a robot that stands, or walks the other way, says nothing of how much more it needs
    still = first_gait._corrected(trot, walked(command, -0.1 * np.ones(3)))
    assert still.gain == pytest.approx(first_gait._MOST_CORRECTION)


def test_the_cost_of_a_gait_grows_with_errors_low_feet_torque_saturation_and_sway():
    one = walked(COMMANDS, np.ones((len(COMMANDS), 3)))
    cost = first_gait._cost(one)
    worse = (
        walked(COMMANDS, 0.8 * np.ones((len(COMMANDS), 3))),
        replace(one, clearance_m=np.array([0.001])), replace(one, clearance_m=np.empty(0)),
        replace(one, torque_square=0.6), replace(one, saturated=0.5), replace(one, sway_rad_s=0.4),
        replace(one, up=one.up & (np.arange(5) < 4)[:, None]),
    )  # fmt: skip
    assert all(first_gait._cost(other) > cost + 0.02 for other in worse)
    # six tenths of the speed forward cost 2 * (0.9 - 0.6) beside their errors, whatever the errors
    # of the other directions: high steps do not pay for that
    forward = np.where((COMMANDS[:, 0] > 0)[:, None], 0.6, 1.0) * np.ones((len(COMMANDS), 3))
    assert first_gait._cost(walked(COMMANDS, forward)) > first_gait._cost(worse[1]) + 0.1


@pytest.fixture
def short(monkeypatch):
    """Walks of a second of one robot for each command."""
    monkeypatch.setattr(first_gait, "_SECONDS", 1.0)
    monkeypatch.setattr(first_gait, "_IGNORED_S", 0.4)
    monkeypatch.setattr(first_gait, "_EACH", 1)


def test_trots_are_judged_on_the_same_robots_and_with_servos_that_are_changed_for_one(short):
    servos, trot = servo_ranges(CALIBRATION), Trot(crouch_m=0.02)
    limp = {"effort_limit": 0.3, "stiffness": 0.3}
    usual, weak = judge_trots([trot] * 2, Walking(), servos, 0, 1, ({}, limp))
    assert usual.score > weak.score + 0.3
    assert usual.saturated_share < weak.saturated_share
    assert usual.clearance_p10_m > weak.clearance_p10_m


def test_a_task_of_slower_commands_is_judged_by_slower_walks_with_the_same_relative_errors():
    task = Walking(commands=Commands((-0.1, 0.1), (0.0, 0.0), (-0.5, 0.5)))
    np.testing.assert_allclose(share_of_usual(task), [0.5, 1.0, 1.0])
    assert (share_of_usual(Walking(commands=Commands((-9, 9), (-9, 9), (-9, 9)))) == 1).all()
    usual = walked(COMMANDS, np.full((len(COMMANDS), 3), 0.8))
    slower = walked(within(task, COMMANDS), np.full((len(COMMANDS), 3), 0.8))
    slower = replace(slower, scale=share_of_usual(task))
    a, b = first_gait._score(usual), first_gait._score(slower)
    assert (b.forward_m_s, b.turn_rad_s) == (0.075, 0.4) and "of 0.075 m/s forward" in str(b)
    assert a.forward_share == b.forward_share == pytest.approx(0.8)
    # nothing is missing sideways, where nothing is commanded
    assert (1 - b.score) == pytest.approx(2 / 3 * (1 - a.score))


@pytest.mark.slow
def test_a_trot_is_fitted_to_servos_of_two_thirds_of_the_stiffness_and_torque(monkeypatch):
    monkeypatch.setattr(first_gait, "_CANDIDATES", 24)
    monkeypatch.setattr(first_gait, "_GENERATIONS", 2)
    servos = servo_ranges(CALIBRATION)
    factors = {"stiffness": 0.65, "effort_limit": 0.8}

    def scaled(values):
        return {name: v * factors.get(name, 1.0) for name, v in values.items()}

    weak = ServoRanges(
        servos.source, scaled(servos.low), scaled(servos.value), scaled(servos.high),
        servos.feedback, servos.fallbacks,
    )  # fmt: skip
    shares = []
    found = fit_trot(preset("fast", "mlp").task, weak, 0, progress=shares.append)
    before, after = found.before, found.after
    # 35 % of the speed before. Their friction is more than half of their torque, so that feet
    # that keep up with the speed are not lifted as high as on other servos: the limit is named
    low, high = first_gait.FORWARD
    assert before.poor and low <= after.forward_share <= high
    assert before.forward_share < 0.6 and after.score > before.score + 0.05
    assert after.poor and found.limit in ("torque", "friction")
    assert shares == sorted(shares) and shares[-1] == 1.0


def test_a_search_that_is_ended_judges_what_there_is_and_names_no_limit(short, monkeypatch):
    steps = []
    walk = PupperEnv.step
    monkeypatch.setattr(PupperEnv, "step", lambda *a: steps.append(0) or walk(*a))
    found = fit_trot(Walking(), servo_ranges(CALIBRATION), 0, 1, ends=lambda: True)
    assert found.after.score >= found.before.score and found.limit is None
    judged = 3 * round(first_gait._SECONDS / Walking().control_step_s)
    assert len(steps) == judged  # none of the search


# ------------------------------------------------------------------------------ of a run


def test_a_fitted_trot_is_imitated_and_its_errors_widen_the_rewards_but_a_good_gait_stays():
    run = preset("fast", "mlp")
    assert suited(run, FirstGait(before=GOOD, trot=run.task.trot, after=GOOD, limit=None)) is run
    found = suited(run, FirstGait(before=BAD, trot=FITTED, after=BAD, limit="torque"))
    assert found.task.trot == FITTED and found.architecture == run.architecture
    before, after = run.task.rewards, found.task.rewards
    assert after.linear_sigma == pytest.approx(2 * before.linear_sigma)
    assert after.stride_linear_sigma == pytest.approx(before.stride_linear_sigma)
    assert after.angular_sigma == pytest.approx(3 * before.angular_sigma), "at most three times"
    assert (after.clock_hz, after.crouch) == (before.clock_hz, before.crouch)


def test_a_teacher_from_nothing_has_the_rhythm_and_the_stance_of_the_fitted_trot():
    run = preset("fast", "mlp", "scratch")
    found = suited(run, FirstGait(before=BAD, trot=FITTED, after=GOOD, limit=None))
    rewards = teacher_of(found).task.rewards
    assert (rewards.clock_hz, rewards.clock_duty) == (2.5, 0.7)
    assert (rewards.crouch, rewards.spread) == (0.01, 0.002)
    # and where nothing was fitted, those that it always had
    usual = teacher_of(run).task.rewards
    assert (usual.clock_hz, usual.clock_duty, usual.crouch) == (3.6, 0.72, 0.02)


def test_only_runs_that_begin_with_a_trot_or_their_own_teacher_are_fitted():
    def of(teacher, iterations=2, **changes):
        return tiny_run(imitation=Imitation(iterations, teacher), **changes)

    assert fits_trots(of(TROT)) and fits_trots(of(OWN))
    assert not fits_trots(of("runs/teacher")) and not fits_trots(of(TROT, iterations=0))
    assert not fits_trots(of(TROT, first_gait="keep"))
    assert not fits_trots(preset("fast", "mlp", "teacher"))
    assert not fits_trots(preset("paper", "lstm"))


def test_a_poor_gait_is_searched_where_there_is_time_and_the_user_reads_why(monkeypatch):
    own: list[GaitScore] = []
    monkeypatch.setattr(first_gait, "judge_trots", lambda *a: own)
    fitted = FirstGait(before=BAD, trot=FITTED, after=BAD, limit="friction")
    monkeypatch.setattr(first_gait, "fit_trot", lambda *a: fitted)
    cases = (
        (GOOD, tiny_run(), False, "score 0.80, 100 % of 0.15 m/s forward"),
        (BAD, tiny_run(), True, "What limits it most is their dry friction"),
        (BAD, tiny_run(), True, "`task.commands.forward_m_s` of -0.1 to 0.1"),
        (BAD, tiny_run(minutes=1.0), False, "was left out"),
        (GOOD, tiny_run(first_gait="fit"), True, "2.5 Hz, duty 0.70, lift 20 mm"),
        (replace(GOOD, forward_share=0.85), tiny_run(), True, "Searching"),
        (replace(GOOD, forward_share=1.2), tiny_run(), True, "Searching"),
        (replace(GOOD, clearance_p10_m=0.004), tiny_run(), True, "Searching"),
    )
    for judged, run, searched, sentence in cases:
        own[:], said = [judged], list[str]()
        found = with_first_gait(run, said.append)
        assert (found.task.trot == FITTED) == searched and (searched or found is run), sentence
        assert sentence in " ".join(said), sentence


def test_a_robot_that_does_not_even_stand_is_said_to():
    def sentence(**changes: float) -> str:
        task = Walking(commands=Commands(forward_m_s=(-0.2, 0.6)))
        after = replace(BAD, **changes)
        return first_gait._sentence(
            FirstGait(before=BAD, trot=FITTED, after=after, limit=None), task
        )

    assert "falls even where it is to stand" in sentence(standing_falls=0.5)
    assert "stand" not in sentence() and "-0.1 to 0.3) are easier" in sentence()
