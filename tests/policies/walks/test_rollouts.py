"""Rollouts: what is recorded is what happened, and looking at a policy does not change it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.analysis.trial import outcome
from pupper_sysid.policies.evaluation.evaluate import walk
from pupper_sysid.policies.network.attention import WIDTH
from pupper_sysid.policies.network.hyperparameters import Architecture
from pupper_sysid.policies.network.policy_export import write_policy
from pupper_sysid.policies.network.policy_file import Policy, load_policy
from pupper_sysid.policies.walks.conditions import Condition, evaluation_task
from pupper_sysid.policies.walks.rollouts import collect, replay
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.observation import OBSERVATION
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.tiny_training import ALL_KINDS, CALIBRATION, HISTORY, networks, tiny_run

TASK = Walking()
COMMAND = (0.1, -0.05, 0.3)


@pytest.fixture(scope="module")
def policies(tmp_path_factory) -> dict[str, Policy]:
    """One policy of each kind, with random weights and small actions, so that robots stand."""
    found = {}
    for kind in ALL_KINDS:
        weights = {k: v.clone() for k, v in networks(kind)[0].state_dict().items()}
        last = max(k for k in weights if k.startswith("mlp.") and k.endswith("weight"))
        weights[last] *= 0.03
        run = tiny_run(kind, architecture=Architecture(kind, (32, 16), 24, (16,)))
        history = HISTORY if kind == "mlp-actions" else 0
        folder = tmp_path_factory.mktemp(kind)
        write_policy(folder, weights, run, servo_ranges(CALIBRATION), history, {"seed": 0}, True)
        found[kind] = load_policy(folder)
    return found


def run(policy, **more):
    settings = {"robots": 3, "seconds": 0.5, "change": None} | more
    condition = Condition(
        evaluation_task(TASK), settings["robots"], COMMAND, change=settings["change"]
    )
    servos = servo_ranges(CALIBRATION)
    return collect(policy, servos, [condition], settings["seconds"], seed=3, threads=1)[0]


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_replay_of_what_a_policy_saw_is_what_it_did_and_had_in_mind(policies, kind):
    found = run(policies[kind])
    actions, hidden = replay(policies[kind], found.observation)
    np.testing.assert_allclose(actions, found.action, atol=1e-6)
    np.testing.assert_allclose(hidden, found.hidden, atol=1e-6)
    width = {"lstm": 24, "gru": 24, "transformer": WIDTH}.get(kind, 16)
    assert found.hidden.shape == (25, 3, width)
    assert np.ptp(found.hidden, axis=0).max() > 0


def test_hidden_states_are_the_cell_of_an_lstm_and_the_state_of_a_gru(policies):
    seen = np.random.default_rng(0).normal(size=(6, 2, 60)).astype(np.float32)
    for kind, part in (("lstm", 1), ("gru", 0)):
        network = policies[kind].network
        state = network.initial_state(2)
        _, hidden = replay(policies[kind], seen)
        with torch.inference_mode():
            for row, kept in zip(seen, hidden, strict=True):
                _, *state = network(torch.from_numpy(row), *state)
                np.testing.assert_allclose(kept, state[part][0].numpy(), atol=1e-6)


@pytest.mark.parametrize("kind", ["mlp", "transformer"])
def test_hidden_states_are_what_the_head_makes_actions_of(policies, kind):
    seen = np.random.default_rng(0).normal(size=(6, 2, 60)).astype(np.float32)
    actions, hidden = replay(policies[kind], seen)
    head = policies[kind].network.mlp
    head = head if kind == "transformer" else head[-1]
    with torch.inference_mode():
        expected = head(torch.from_numpy(hidden)).numpy()
    np.testing.assert_allclose(actions, expected, atol=1e-6)


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_probing_a_policy_in_the_middle_of_a_walk_does_not_change_the_walk(policies, kind):
    seen = np.random.default_rng(0).normal(size=(8, 2, 60)).astype(np.float32)
    policy, start = policies[kind], np.zeros((2, 12))
    policy.reset(start)
    alone = [policy.act(row) for row in seen]
    policy.reset(start)
    probed = []
    for row in seen:
        probed.append(policy.act(row))
        replay(policy, seen[::-1])
    run(policy, seconds=0.04)
    np.testing.assert_array_equal(probed, alone)
    # and no hook is left behind
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in policy.network.modules())


def test_a_rollout_is_the_walk_that_an_evaluation_sees(policies):
    found = run(policies["lstm"])
    same = walk(
        policies["lstm"], evaluation_task(TASK, 1.0), servo_ranges(CALIBRATION), 3, 3, COMMAND, 1
    )
    assert found.alive.all() and found.command == COMMAND
    np.testing.assert_array_equal(found.velocity, same.velocity[:25])
    np.testing.assert_array_equal(found.contact, same.contact[:25])


def test_observations_are_of_the_start_of_a_step_and_the_rest_of_its_end(policies):
    found = run(policies["mlp"])
    parts = np.split(found.observation, np.cumsum([size for _, size, _ in OBSERVATION])[:-1], -1)
    seen = {name: part for (name, _, _), part in zip(OBSERVATION, parts, strict=True)}
    np.testing.assert_allclose(seen["command"], np.broadcast_to(COMMAND, (25, 3, 3)), atol=1e-6)
    np.testing.assert_array_equal(seen["last_action"][1:], found.action[:-1])
    # the turn rate of the end of a step is seen at the start of the next, with noise of ±0.2 rad/s
    away = seen["base_angular_velocity"][1:, :, 2] - found.velocity[:-1, :, 2]
    assert np.abs(away).max() <= 0.2 + 1e-6
    np.testing.assert_allclose(found.action_rad, TASK.action_scale * found.action, rtol=1e-6)


def test_the_place_of_the_trunk_moves_as_its_velocity_says(policies):
    found = run(policies["mlp"], seconds=2.0)
    steps = np.diff(found.position, axis=0)
    assert np.abs(steps).max() < 0.1
    turned = np.cumsum(found.velocity[1:, :, 2] * TASK.control_step_s, axis=0)
    np.testing.assert_allclose(
        found.position[1:, :, 2] - found.position[0, :, 2], turned, atol=0.03
    )


def test_a_change_is_what_the_policy_sees_and_is_recorded(policies):
    asked = []

    def blind(step, observation):
        asked.append(step)
        observation[:, 12:48] = 0.0
        return observation

    found, plain = run(policies["gru"], change=blind), run(policies["gru"])
    assert asked == list(range(25))
    assert not found.observation[..., 12:48].any()
    actions, _ = replay(policies["gru"], found.observation)
    np.testing.assert_allclose(actions, found.action, atol=1e-6)
    # the rest of the first observation is the same: same servos, ground, start and noise
    np.testing.assert_array_equal(found.observation[0, :, :12], plain.observation[0, :, :12])
    assert np.abs(found.action[0] - plain.action[0]).max() > 0


def test_a_frozen_observation_makes_a_policy_without_memory_stand_still(policies):
    first = []

    def freeze(_, observation):
        first.append(observation.copy())
        return first[0]

    found = run(policies["mlp"], change=freeze)
    assert np.ptp(found.action, axis=0).max() == 0.0


class Folding(Policy):
    """Robots with odd numbers fold all legs and fall on their bellies; or all do."""

    everyone = False

    def act(self, observation):
        folds = (np.arange(len(observation)) % 2 == 1) | self.everyone
        return super().act(observation) + np.outer(folds, [0.0, 4.0, -4.0] * 4).astype(np.float32)


def test_robots_that_fell_stay_fallen_and_a_rollout_ends_with_the_last(policies):
    own = Folding(policies["mlp"].network, policies["mlp"].contract)
    found = run(own, robots=4, seconds=2.0)
    assert found.alive.shape == (100, 4)
    assert found.alive[-1].tolist() == [True, False, True, False]
    assert (np.diff(found.alive.astype(int), axis=0) <= 0).all()
    own.everyone = True
    short = run(own, robots=4, seconds=2.0)
    assert len(short.alive) == len(short.hidden) == len(short.position) < 100
    assert not short.alive[-1].any() and short.alive[-2].any()


def test_a_robot_that_leaves_the_ground_has_not_fallen(policies):
    def leave(step, env, robots):
        if step == 5:
            env.robots.qpos[robots[0], 0] = env.ground.half_size_m - 0.4

    task = evaluation_task(replace(TASK, terrain="rough"))
    own, servos = Condition(task, 2, COMMAND, disturb=leave), servo_ranges(CALIBRATION)
    (found,) = collect(policies["mlp"], servos, [own], 0.2, seed=3, threads=1)
    assert found.alive.sum(axis=0).tolist() == [5, 10] and not found.fell.any()
    assert outcome(found)["survival"] == 1.0


def test_observations_of_altered_walks_are_left_out_of_lean_rollouts(policies):
    plain = Condition(evaluation_task(TASK), 2, COMMAND)
    given, servos = [plain, replace(plain, change=lambda _, seen: seen)], servo_ranges(CALIBRATION)
    whole = collect(policies["lstm"], servos, given, 0.1, seed=3, threads=1)
    lean = collect(policies["lstm"], servos, given, 0.1, seed=3, threads=1, lean=True)
    assert [r.hidden.shape for r in whole] == [(5, 2, 24)] * 2
    assert [r.hidden.shape for r in lean] == [(5, 2, 24), (5, 0, 24)]
    assert lean[1].observation.shape == (5, 0, 60)
    np.testing.assert_array_equal(lean[0].hidden, whole[0].hidden)
    np.testing.assert_array_equal(lean[1].action, whole[1].action)


def test_a_rollout_of_no_time_is_refused(policies):
    with pytest.raises(InputError, match="shorter than one step"):
        run(policies["mlp"], seconds=0.0)
