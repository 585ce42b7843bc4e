"""Observers: the simulated servo is the trained one, the paper's resonates, readings are kept."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.policies.deploy.stacks import (
    HeldEncoder,
    JointEstimate,
    Observer,
    ServoModelObserver,
    SyntheticPD,
    Zero,
)
from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.networks import CommandNetwork
from support.refusals import assert_each_refused
from support.saved_servo_models import linear_filter

P = 0.02
CALIBRATED = DelayedPDParameters(
    stiffness=np.linspace(9.0, 11.0, 12),
    damping=0.083,
    friction_loss=0.0167,
    armature=8.08e-4,
    effort_limit=0.35,
    velocity_limit=7.6,
    dead_time_s=np.linspace(0.0201, 0.0287, 12),
)
UNKNOWN = np.full(12, np.nan)


def one_period_late(period_s: float = P) -> CommandNetwork:
    """Each joint is where it was told to be one period ago."""
    return linear_filter(JOINT_NAMES, period_s, 0.0, 1.0, 0.0)


OBSERVERS: dict[str, Callable[[], Observer]] = {
    "synthetic PD": lambda: SyntheticPD(CALIBRATED, P),
    "paper PD": lambda: SyntheticPD.paper(P),
    "servo model": lambda: ServoModelObserver(one_period_late(), P),
    "held encoder": lambda: HeldEncoder(P, 4),
    "zero": lambda: Zero(P),
}


def walk(steps: int, period_s: float = P) -> np.ndarray:
    """Targets of a gait-like motion, another for each joint, shape (steps, 12)."""
    time = period_s * np.arange(steps)[:, None]
    joint = np.arange(12)
    return 0.2 * np.sin(2 * np.pi * 2.5 * time + joint) + 0.1 * np.sign(np.sin(7 * time))


# ---------------------------------------------------------------------------------- every one


def numbers(estimate: JointEstimate) -> np.ndarray:
    return np.stack([estimate.position, estimate.velocity, estimate.effort])


@pytest.mark.parametrize("make", OBSERVERS.values(), ids=OBSERVERS.keys())
def test_every_observer_rests_forgets_at_a_reset_and_keeps_robots_apart(make):
    observer, fresh = make(), make()
    for target in walk(30):
        observer.step(target, target)
    rest = np.linspace(-1, 1, 12)
    for one in (observer, fresh):
        one.reset(rest)
    for _ in range(3):
        estimate = numbers(observer.step(rest, rest))
        np.testing.assert_array_equal(estimate, numbers(fresh.step(rest, rest)))
        np.testing.assert_allclose(estimate, [rest, 0 * rest, 0 * rest], atol=1e-5)

    together, alone = make(), make()
    shift = np.arange(6).reshape(2, 3, 1) / 10
    together.reset(np.zeros((2, 3, 12)) + shift)
    alone.reset(np.zeros(12) + shift[1, 2])
    earlier: list[tuple[JointEstimate, np.ndarray]] = []
    for target in walk(20):
        many = together.step(target + shift, target + shift)
        one = alone.step(target + shift[1, 2], target + shift[1, 2])
        assert numbers(many).shape == (3, 2, 3, 12)
        np.testing.assert_allclose(numbers(many)[:, 1, 2], numbers(one), atol=2e-5)
        earlier.append((one, numbers(one)))
    for estimate, kept in earlier:
        np.testing.assert_array_equal(numbers(estimate), kept, "an estimate changed later")


def test_inputs_that_no_observer_can_use_are_refused():
    for name in ("synthetic PD", "servo model"):
        observer = OBSERVERS[name]()
        targets = [(UNKNOWN, "not finite")]
        assert_each_refused(targets, lambda target, own=observer: own.step(target, UNKNOWN))
        assert np.isfinite(observer.step(np.zeros(12), UNKNOWN).position).all()
    cases = [
        (lambda: SyntheticPD(replace(CALIBRATED, armature=0.0), P), "armature"),
        (lambda: SyntheticPD(replace(CALIBRATED, dead_time_s=-0.1), P), "dead_time_s"),
        (lambda: SyntheticPD.paper(0.01), "0.02 and 0.04 s"),
    ]
    assert_each_refused(cases, lambda use: use())


# ---------------------------------------------------------------------------------- synthetic PD


@pytest.mark.parametrize("period_s", [0.02, 0.04])
def test_with_the_trained_parameters_it_is_the_trained_servo(period_s):
    observer, servo = SyntheticPD(CALIBRATED, period_s), DelayedPD(CALIBRATED)
    start, per_period = np.full(12, 0.1), round(period_s / servo.time_step_s)
    observer.reset(start)
    servo.reset(start)
    targets = walk(80, period_s)
    expected = servo.rollout(np.repeat(targets, per_period, axis=0))
    estimates = [observer.step(target, UNKNOWN) for target in targets]
    positions = np.stack([e.position for e in estimates])
    assert positions == pytest.approx(expected[per_period - 1 :: per_period], abs=1e-12)
    # semi-implicit Euler: the last change of position is the velocity times the time step
    change = np.diff(expected, axis=0)[per_period - 2 :: per_period] / servo.time_step_s
    assert np.stack([e.velocity for e in estimates]) == pytest.approx(change, abs=1e-9)


def test_effort_and_position_end_at_their_limits_and_come_back():
    stiff = replace(CALIBRATED, stiffness=10.0, friction_loss=0.35, dead_time_s=0.0)
    observer = SyntheticPD(stiff, P)
    # dry friction as large as the limit: the joint cannot move, so torque = stiffness * target
    half = observer.step(np.full(12, 0.0175), UNKNOWN)
    assert half.position == pytest.approx(np.zeros(12), abs=1e-4)
    assert half.effort == pytest.approx(np.full(12, 0.175), abs=0.0035)
    assert observer.step(np.full(12, -0.1), UNKNOWN).effort == pytest.approx(np.full(12, -0.35))
    low, high = np.full(12, -0.1), np.linspace(0.05, 0.2, 12)
    observer = SyntheticPD(CALIBRATED, P, limits_rad=(low, high))
    pushed = [observer.step(np.full(12, 0.5), UNKNOWN) for _ in range(40)]
    assert all((estimate.position <= high).all() for estimate in pushed)
    assert np.array_equal(pushed[-1].position, high)
    assert (pushed[-1].velocity == 0).all()
    back = [observer.step(np.zeros(12), UNKNOWN) for _ in range(40)]
    assert np.abs(back[-1].position).max() < 0.01


def test_a_servo_too_stiff_for_its_substeps_is_refused_with_how_many_it_needs():
    stiff = replace(CALIBRATED, stiffness=70.0, damping=0.0)
    limit = 2 / np.sqrt(70.0 / 8.08e-4)  # of semi-implicit Euler without damping
    assert SyntheticPD(stiff, P, substeps=int(np.ceil(P / limit)))
    with pytest.raises(InputError, match=f"take {int(np.ceil(P / limit))} or more"):
        SyntheticPD(stiff, P, substeps=2)


# ---------------------------------------------------------------------------------- the paper's


def paper_swing(targets: np.ndarray, period_s: float, delay_steps: int, limit: float) -> np.ndarray:
    """The authors' arithmetic, facts/paper.md 5.2: explicit damping, a queue of targets."""
    q = v = 0.0
    queue, dt, found = [0.0] * (delay_steps + 1), period_s / 4, []
    for target in targets:
        queue = [*queue[1:], target]
        for _ in range(4):
            v += (70 * (queue[0] - q) - 1.2 * v - 0.03 * np.sign(v)) / 0.20 * dt
            q += v * dt
            if abs(q) > limit:
                q, v = np.sign(q) * limit, 0.0
        found.append(q)
    return np.array(found)


@pytest.mark.parametrize(("period_s", "delay_steps"), [(0.02, 9), (0.04, 5)])
def test_the_papers_preset_moves_as_the_authors_arithmetic(period_s, delay_steps):
    targets = 0.2 * np.sin(2 * np.pi * 2 * period_s * np.arange(200))
    targets[:20] = 0.0
    for limit in (np.inf, 0.25):
        observer = SyntheticPD.paper(period_s, (-limit, limit))
        moved = [observer.step(np.full(12, t), UNKNOWN) for t in targets]
        positions = np.array([e.position[0] for e in moved])
        expected = paper_swing(targets, period_s, delay_steps, limit)
        assert np.abs(expected).max() > min(0.34, limit - 1e-9)  # 1.7 times 0.2 rad, when free
        # dry friction differs where the joint turns round: here it can hold it
        assert np.abs(positions - expected).max() < 1e-3
        # nothing arrives before the delay is over
        assert np.flatnonzero(expected)[0] == np.flatnonzero(positions)[0] == 20 + delay_steps
        assert (np.array([e.effort for e in moved]) == 0).all()


# ---------------------------------------------------------------------------------- servo model


def test_a_servo_model_runs_freely_and_its_velocity_is_the_difference():
    # a recorded rate is never quite the one that was asked for
    assert ServoModelObserver(one_period_late(1.0002 * P), P).period_s == P
    observer = ServoModelObserver(one_period_late(), P)
    observer.reset(np.zeros(12))
    targets = [np.full(12, x) for x in (0.1, 0.3, 0.2)]
    found = [observer.step(t, np.full(12, 99.0)) for t in targets]
    assert [f.position[0] for f in found] == pytest.approx([0.0, 0.1, 0.3])
    assert [f.velocity[0] for f in found] == pytest.approx([0.0, 5.0, 10.0], rel=1e-5)
    assert all((f.effort == 0).all() for f in found)


# ---------------------------------------------------------------------------------- held encoder


def test_readings_pass_velocity_spans_the_contracts_steps_and_a_missing_one_leaves_the_last():
    observer = HeldEncoder(P, velocity_steps=4)
    observer.reset(np.zeros(12))
    # reading = step number + joint / 100, so that a wrong gather shows
    joint = np.arange(12) / 100
    found = [observer.step(UNKNOWN, k + joint) for k in range(1, 8)]
    assert found[-1].position == pytest.approx(7 + joint)
    assert found[-1].velocity == pytest.approx(np.full(12, 4 / (4 * P)))
    # before the span is over it reaches back to the position at reset
    assert found[1].velocity == pytest.approx((2 + joint) / (4 * P))
    assert (found[-1].effort == 0).all()
    observer = HeldEncoder(P, velocity_steps=1)
    observer.reset(np.full(12, 0.1))
    partly = observer.step(UNKNOWN, np.where(np.arange(12) == 3, np.nan, 0.2))
    assert (partly.position[3], partly.velocity[3], partly.position[4]) == (0.1, 0.0, 0.2)
    assert partly.velocity[4] == pytest.approx(0.1 / P)
    later = observer.step(UNKNOWN, UNKNOWN)
    assert np.array_equal(later.position, partly.position) and (later.velocity == 0).all()
