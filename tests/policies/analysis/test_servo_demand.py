"""What a gait needs of its servos is held against what a servo has."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.cli.policy_choice import policy_at, simulator
from pupper_sysid.common.results import plain
from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.analysis.figures import demand_figure
from pupper_sysid.policies.analysis.servo_demand import _load, _top_speed, servo_demand
from pupper_sysid.policies.analysis.trial import Trial

SAMPLE = SAMPLES / "policies/mlp"


def numbers(**changed: float) -> dict[str, np.ndarray]:
    """One servo: 2 N·m at standstill, 1.8 left at 1 rad/s, 10 rad/s free."""
    own = {
        "effort_limit": 2.0, "back_emf": 0.2, "friction_loss": 0.0, "velocity_limit": 1000.0,
    } | changed  # fmt: skip
    return {name: np.array([value]) for name, value in own.items()}


def test_torque_left_falls_with_speed_in_the_direction_of_motion_and_rises_against_it():
    speed = np.array([[5.0], [5.0], [-5.0]])
    need = np.array([[0.5], [-1.5], [0.5]])
    used, short = _load(need, speed, numbers())
    # driving at 5 rad/s 1 N·m is left; braking there, 3
    np.testing.assert_allclose(used[:, 0], [0.5, 0.5, 0.5 / 3])
    assert not short.any()
    assert _load(np.array([[1.2]]), np.array([[5.0]]), numbers())[1].all()


def test_the_top_speed_is_that_of_the_motor_or_of_the_set_point():
    assert _top_speed(numbers())[0] == pytest.approx(10.0)
    assert _top_speed(numbers(friction_loss=0.4))[0] == pytest.approx(8.0)
    assert _top_speed(numbers(velocity_limit=6.0))[0] == pytest.approx(6.0)
    assert _top_speed(numbers(back_emf=0.0))[0] == 1000.0


@pytest.fixture(scope="module")
def trial() -> tuple:
    policy, run = policy_at(SAMPLE)
    task, servos = simulator(SAMPLE, policy, run, None, None)
    return policy, Trial(task, servos, robots=2, seconds=3.0, threads=1)


def test_a_gait_runs_on_the_servos_it_was_trained_on_and_not_on_ones_a_tenth_as_strong(trial):
    policy, walk = trial
    same = servo_demand(policy, walk, walk.servos, extra_dead_times_s=(0.0,))
    assert same.sufficient and same.verdict.startswith("Yes")
    thigh = same.joints["LF_thigh"]
    # the drawn servos differ from the middle of their interval
    assert thigh.torque_nm.p99 == pytest.approx(thigh.walked_nm.p99, rel=0.25)
    assert thigh.short == pytest.approx(thigh.walked_short, abs=0.05)

    servos = walk.servos
    weak = {name: x.copy() for name, x in servos.value.items()}
    weak["effort_limit"] = weak["effort_limit"] / 10
    weaker = servo_demand(
        policy, walk, replace(servos, value=weak, source="weak"), dead_time_known=False,
        extra_dead_times_s=(0.0,),
    )  # fmt: skip
    assert not weaker.sufficient and weaker.verdict.startswith("No: weak is short")
    assert weaker.dead_time_s is None and "no dead time" in weaker.verdict
    assert "samples" not in plain(weaker), "the picture's points are no part of --json"
    assert demand_figure(weaker).axes


@pytest.mark.slow
def test_a_servo_that_is_later_than_the_gait_bears_is_refused_for_its_dead_time(trial):
    policy, walk = trial
    late = {name: x.copy() for name, x in walk.servos.value.items()}
    late["dead_time_s"] = late["dead_time_s"] + 0.1
    found = servo_demand(
        policy, walk, replace(walk.servos, value=late, source="late"),
        extra_dead_times_s=(0.0, 0.02),
    )  # fmt: skip
    assert found.tolerated_at_least and found.tolerated_dead_time_s < found.dead_time_s
    assert not found.sufficient and "is more than the at least" in found.verdict
