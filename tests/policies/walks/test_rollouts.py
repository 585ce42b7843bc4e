"""Rollouts: what is recorded is what happened, and looking at a policy does not change it."""

import numpy as np
import pytest
import torch

from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.network.policy_network import WIDTH
from pupper_sysid.policies.walks.rollouts import (
    Rollout,
    collect,
    counted,
    pooled_errors,
    replay,
    stride_errors,
    tracking_errors,
)
from pupper_sysid.policies.walks.together import Condition, evaluation_task
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from pupper_sysid.sim.walking.step import OBSERVATION
from support.tiny_training import ALL_KINDS, CALIBRATION
from support.walks import walk

TASK = evaluation_task(Walking())
COMMAND = (0.1, -0.05, 0.3)
ROBOTS, STEPS = 3, 25
SEEN = np.random.default_rng(0).normal(size=(8, 2, 60)).astype(np.float32)


def rollouts(policy, *conditions: Condition, seconds: float = 0.5, **more) -> list[Rollout]:
    conditions = conditions or (Condition(TASK, ROBOTS, COMMAND),)
    return collect(policy, servo_ranges(CALIBRATION), conditions, seconds, 3, 1, **more)


@pytest.fixture(scope="module")
def plain(policies) -> dict[str, Rollout]:
    """Half a second of three robots, by kind of policy."""
    return {kind: rollouts(policies[kind])[0] for kind in ALL_KINDS}


def test_a_replay_of_what_a_policy_saw_is_what_it_did_and_had_in_mind(policies, plain):
    for kind, rollout in plain.items():
        actions, hidden = replay(policies[kind], rollout.observation)
        np.testing.assert_allclose(actions, rollout.action, atol=1e-6)
        np.testing.assert_allclose(hidden, rollout.hidden, atol=1e-6)
        width = {"lstm": 24, "gru": 24, "transformer": WIDTH}.get(kind, 16)
        assert rollout.hidden.shape == (STEPS, ROBOTS, width)
        assert np.ptp(rollout.hidden, axis=0).max() > 0
    # hidden is a cell, a state, or what the head makes actions of
    for kind, part in (("lstm", 1), ("gru", 0)):
        network = policies[kind].network
        state = network.initial_state(2)
        _, hidden = replay(policies[kind], SEEN)
        with torch.inference_mode():
            for row, kept in zip(SEEN, hidden, strict=True):
                _, *state = network(torch.from_numpy(row), *state)
                np.testing.assert_allclose(kept, state[part][0].numpy(), atol=1e-6)
    for kind in ("mlp", "transformer"):
        actions, hidden = replay(policies[kind], SEEN)
        head = policies[kind].network.mlp
        head = head if kind == "transformer" else head[-1]
        with torch.inference_mode():
            expected = head(torch.from_numpy(hidden)).numpy()
        np.testing.assert_allclose(actions, expected, atol=1e-6)


def test_probing_a_policy_in_the_middle_of_a_walk_does_not_change_the_walk(policies):
    for policy in policies.values():
        start = np.zeros((2, 12))
        policy.reset(start)
        alone = [policy.act(row) for row in SEEN]
        policy.reset(start)
        probed = []
        for row in SEEN:
            probed.append(policy.act(row))
            replay(policy, SEEN[::-1])
        rollouts(policy, seconds=0.04)
        np.testing.assert_array_equal(probed, alone)
        # and no hook is left behind
        assert not any(m._forward_hooks or m._forward_pre_hooks for m in policy.network.modules())


def test_a_rollout_is_the_walk_that_an_evaluation_sees(policies, plain):
    rollout = plain["lstm"]
    task = evaluation_task(Walking(), 1.0)
    same = walk(policies["lstm"], task, servo_ranges(CALIBRATION), ROBOTS, 3, COMMAND, 1)
    assert rollout.alive.all() and rollout.command == COMMAND
    np.testing.assert_array_equal(rollout.velocity, same.velocity[:STEPS])
    np.testing.assert_array_equal(rollout.contact, same.contact[:STEPS])


def test_observations_are_of_the_start_of_a_step_and_the_rest_of_its_end(plain):
    rollout = plain["mlp"]
    ends = np.cumsum([size for _, size, _ in OBSERVATION])[:-1]
    parts = np.split(rollout.observation, ends, -1)
    seen = {name: part for (name, _, _), part in zip(OBSERVATION, parts, strict=True)}
    commands = np.broadcast_to(COMMAND, (STEPS, ROBOTS, 3))
    np.testing.assert_allclose(seen["command"], commands, atol=1e-6)
    np.testing.assert_array_equal(seen["last_action"][1:], rollout.action[:-1])
    # the turn rate of the end of a step is seen at the start of the next, with noise of ±0.2 rad/s
    away = seen["base_angular_velocity"][1:, :, 2] - rollout.velocity[:-1, :, 2]
    assert np.abs(away).max() <= 0.2 + 1e-6
    np.testing.assert_allclose(rollout.action_rad, TASK.action_scale * rollout.action, rtol=1e-6)


def test_a_change_is_what_the_policy_sees_and_is_recorded(policies, plain):
    steps, first = [], []

    def blind(step, observation):
        steps.append(step)
        observation[:, 12:48] = 0.0
        return observation

    (rollout,) = rollouts(policies["gru"], Condition(TASK, ROBOTS, COMMAND, change=blind))
    assert steps == list(range(STEPS))
    assert not rollout.observation[..., 12:48].any()
    actions, _ = replay(policies["gru"], rollout.observation)
    np.testing.assert_allclose(actions, rollout.action, atol=1e-6)
    # the rest of the first observation is the same: same servos, ground, start and noise
    usual = plain["gru"]
    np.testing.assert_array_equal(rollout.observation[0, :, :12], usual.observation[0, :, :12])
    assert np.abs(rollout.action[0] - usual.action[0]).max() > 0

    def freeze(_, observation):
        first.append(observation.copy())
        return first[0]

    (rollout,) = rollouts(policies["mlp"], Condition(TASK, 2, COMMAND, change=freeze), seconds=0.1)
    assert np.ptp(rollout.action, axis=0).max() == 0.0, "without memory, a frozen view stands still"


class Folding(Policy):
    """Robots with odd numbers fold all legs and fall on their bellies; or all do."""

    everyone = False

    def act(self, observation):
        folds = (np.arange(len(observation)) % 2 == 1) | self.everyone
        return super().act(observation) + np.outer(folds, [0.0, 4.0, -4.0] * 4).astype(np.float32)


def test_robots_that_fell_stay_fallen_and_a_rollout_ends_with_the_last(policies):
    policy = Folding(policies["mlp"].network, policies["mlp"].contract)
    two = Condition(TASK, 2, COMMAND)
    (rollout,) = rollouts(policy, two, seconds=1.5)
    assert rollout.alive.shape == (75, 2) and rollout.alive[-1].tolist() == [True, False]
    assert (np.diff(rollout.alive.astype(int), axis=0) <= 0).all()
    policy.everyone = True
    (short,) = rollouts(policy, two, seconds=1.5)
    assert len(short.alive) == len(short.hidden) == len(short.position) < short.whole_steps == 75
    assert not short.alive[-1].any() and short.alive[-2].any()


# ----- tracking errors: at every step, over a stride, and after a fall

STEP_S, STEPS_TRACKING = 0.02, 500
TIME = STEP_S * np.arange(STEPS_TRACKING)
UP, NONE = np.ones((STEPS_TRACKING, 1), bool), np.zeros(1, bool)


def of_sway(frequency_hz: float, size: float, offset: float = 0.0) -> np.ndarray:
    return np.repeat((offset + size * np.sin(2 * np.pi * frequency_hz * TIME))[:, None, None], 3, 2)


def test_over_a_stride_a_sway_of_its_frequency_averages_to_nothing_and_an_offset_stays():
    """The mean size of a sine is 2/π of its amplitude; its mean over a period is 0."""
    sway = of_sway(2.5, 0.3)  # a period of 20 steps
    command, stride = np.zeros(3), np.array([0.4])
    instant = tracking_errors(sway, command, UP, NONE)
    np.testing.assert_allclose(instant, 2 / np.pi * 0.3, rtol=0.01)
    over = stride_errors(sway, command, UP, NONE, stride, STEP_S)
    np.testing.assert_allclose(over, 0.0, atol=1e-12)
    over = stride_errors(of_sway(2.5, 0.3, -0.1), command, UP, NONE, stride, STEP_S)
    np.testing.assert_allclose(over, 0.1, rtol=1e-9)
    # of a slow error, all stays: sin(x)/x with x = π · 0.4 s · 0.05 Hz
    slow = stride_errors(of_sway(0.05, 0.3), command, UP, NONE, stride, STEP_S)
    exact = tracking_errors(of_sway(0.05, 0.3), command, UP, NONE) * np.sinc(0.4 * 0.05)
    np.testing.assert_allclose(slow, exact, rtol=0.05)


def test_each_robot_has_its_own_stride_or_a_usual_one_and_none_too_long_a_one():
    sways = np.concatenate([of_sway(2.5, 0.3), of_sway(2.0, 0.3)], axis=1)
    up, fell = np.ones((STEPS_TRACKING, 2), bool), np.zeros(2, bool)

    def errors(*strides):
        return stride_errors(sways, np.zeros(3), up, fell, np.array(strides), STEP_S)

    np.testing.assert_allclose(errors(0.4, 0.5), 0.0, atol=1e-12)
    assert (errors(0.5, 0.4) > 0.02).all()
    for stride, used in ((np.inf, 0.3), (np.nan, 0.3), (7.0, 1.0), (0.01, 0.2)):
        np.testing.assert_array_equal(errors(stride, 0.4), errors(used, 0.4))


def test_a_robot_that_fell_stands_and_one_that_left_the_ground_is_not_counted_any_more():
    velocity = np.full((STEPS_TRACKING, 3, 3), 0.2)
    command = np.array([0.2, 0.1, -0.4])
    alive = np.ones((STEPS_TRACKING, 3), bool)
    alive[100:, 1:] = False
    velocity[100:, 1:] = 77.0  # of another episode
    fell = np.array([False, True, False])
    up, down = np.array([0.0, 0.1, 0.6]), np.abs(command)
    found = tracking_errors(velocity, command, alive, fell)
    np.testing.assert_allclose(found[[0, 2]], [up, up], atol=1e-12)
    np.testing.assert_allclose(found[1], (100 * up + 400 * down) / 500)
    over = stride_errors(velocity, command, alive, fell, np.full(3, 0.4), STEP_S)
    np.testing.assert_allclose(over[[0, 2]], [up, up], atol=1e-12)
    np.testing.assert_allclose(over[1], found[1], rtol=0.05)
    shown, counts = counted(velocity, alive, fell)
    assert not shown[100:, 1:].any() and counts.sum(axis=0).tolist() == [500, 500, 100]


def test_falling_early_is_never_better_than_walking_on_and_pooled_errors_count_all_to_the_end():
    rng = np.random.default_rng(0)
    command = np.array([0.15, 0.0, 0.0])
    velocity = command + 0.02 * rng.standard_normal((STEPS_TRACKING, 1, 3))
    errors = []
    for last in (500, 400, 250, 100, 1):
        alive = (np.arange(STEPS_TRACKING) < last)[:, None]
        fell = np.array([last < STEPS_TRACKING])
        errors.append(tracking_errors(velocity, command, alive, fell)[0, 0])
    assert errors == sorted(errors) and errors[-1] == pytest.approx(0.15, rel=0.01)
    velocity, alive = np.full((100, 2, 3), 0.1), np.ones((100, 2), bool)
    alive[50:, 0] = alive[-1:, 1] = False
    command = np.array([0.3, 0.1, 0.0])
    found = pooled_errors(velocity, command, alive, np.ones(2, bool), 500)
    walked = 50 + 99
    expected = (walked * np.abs(0.1 - command) + (1000 - walked) * command) / 1000
    np.testing.assert_allclose(list(found.values()), expected)
