"""The learner: what it is given (vec_env), what it adds to PPO, and its checkpoints."""

import copy
import os
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import LEGS
from pupper_sysid.policies.train.learner import (
    CHECKPOINT_VERSION,
    Learner,
    Ranks,
    WalkingVecEnv,
    judged_weights,
    read_checkpoint,
)
from pupper_sysid.policies.train.training import make_env, make_learner
from pupper_sysid.sim.robot.body import mini_pupper
from pupper_sysid.sim.robot.mini_pupper import SIDE, foot_position
from pupper_sysid.sim.walking.config import Rewards, Walking
from support.refusals import assert_each_refused
from support.tiny_training import observations, ppo, tiny_run

GAMMA = 0.99

# ------------------------------------------------------------------------------ vec_env


def walkers(episode_steps: int, history: int, robots: int = 3) -> WalkingVecEnv:
    run = tiny_run(environments=robots, task=Walking(episode_s=0.02 * episode_steps))
    return WalkingVecEnv(make_env(run, Ranks()), history)


def act(env: WalkingVecEnv, number: float):
    """All joints of all robots do `number`."""
    return env.step(torch.full((env.num_envs, 12), number))


def history_of(groups, robot: int) -> list[list[float]]:
    return groups["actions"][robot].reshape(-1, 12).tolist()


def test_past_actions_are_newest_first_and_after_a_time_out_begin_anew_but_for_the_terminal_ones():
    assert set(walkers(4, 0).get_observations().keys()) == {"policy", "privileged", "noise"}
    env = walkers(episode_steps=4, history=3)
    start = env.env.action.astype(np.float32).copy()
    for robot in range(3):
        assert history_of(env.get_observations(), robot) == [start[robot].tolist()] * 3
    for step in range(1, 5):
        seen, _, dones, extras = act(env, 0.01 * step)
        assert bool(dones.all()) is (step == 4)
        for robot in range(3) if step == 2 else ():
            newest, before, oldest = history_of(seen, robot)
            assert newest == pytest.approx([0.02] * 12) and before == pytest.approx([0.01] * 12)
            assert oldest == start[robot].tolist()
    assert extras["terminal_ids"].tolist() == [0, 1, 2]
    for robot in range(3):
        taken = history_of(extras["terminal_observations"], robot)
        assert [row[0] for row in taken] == pytest.approx([0.04, 0.03, 0.02])
        own = env.env.action[robot].astype(np.float32).tolist()
        assert history_of(seen, robot) == [own] * 3
        assert abs(own[0] - 0.04) > 1e-3  # the start action, not the last one taken


def test_noise_is_observed_a_new_episode_begins_without_and_what_was_handed_out_does_not_change():
    env = walkers(episode_steps=2, history=2)
    first = env.get_observations()
    kept = first.clone()
    env.noise = torch.full((3, 12), 0.3)
    assert act(env, 0.3)[0]["noise"].eq(0.3).all()
    assert all(torch.equal(first[k], kept[k]) for k in ("policy", "privileged", "actions"))
    env.noise = torch.full((3, 12), 0.2)
    seen, _, dones, extras = act(env, 0.0)
    assert dones.all() and seen["noise"].eq(0.0).all()
    assert extras["terminal_observations"]["noise"].eq(0.2).all()


def test_a_first_policy_stands_as_low_and_wide_as_its_rewards_want():
    rewards = Rewards(stance=-200.0, crouch=0.015, spread=0.005)
    learner = make_learner(tiny_run(task=Walking(rewards=rewards)), Ranks())
    env = learner.env.env
    with torch.no_grad():
        action = learner.actor(learner.observations).numpy()
    joints = env.default + env.config.action_scale * action
    for i, leg in enumerate(LEGS):
        away = foot_position(leg, *joints[:, 3 * i : 3 * i + 3].T) - mini_pupper().feet_at[i]
        # the rest of the network is small, not 0
        wanted = np.broadcast_to([0.0, 0.005 * SIDE[leg], 0.015], away.shape)
        np.testing.assert_allclose(away, wanted, atol=1.5e-3)
    free = make_learner(tiny_run(), Ranks())
    assert free.actor(free.observations).abs().max() < 0.1


# ------------------------------------------------------------------------------ time-outs


def test_a_time_out_is_worth_the_value_of_the_state_reached_and_a_fall_nothing():
    """Robot 0 goes on, 1 falls, 2 runs out of time: r + γ V(reached), r, and r."""
    learner = ppo("mlp", robots=3, steps=1)
    learner.gamma = GAMMA
    generator = torch.Generator().manual_seed(1)
    before, reached, after = (observations(3, generator) for _ in range(3))
    with torch.inference_mode():
        learner.act(before)
        extras = {
            "terminal_ids": torch.tensor([2]), "terminal_observations": reached[2:],
            "unforeseen_ids": torch.zeros(0, dtype=torch.long),
        }  # fmt: skip
        rewards = torch.tensor([10.0, 20.0, 30.0])
        learner.process_env_step(after, rewards, torch.tensor([False, True, True]), extras)
        learner.compute_returns(after)
        value = {n: learner.critic(o)[:, 0] for n, o in [("s", before), ("r", reached)]}
        next_value = learner.critic(after)[:, 0]
    assert abs(value["r"][2] - value["s"][2]) > 0.05, "or the two could not be told apart"
    stored = learner.storage.rewards[0, :, 0]
    bootstrapped = 30.0 + GAMMA * float(value["r"][2])
    assert stored.tolist() == pytest.approx([10.0, 20.0, bootstrapped], abs=1e-5)
    assert rewards.tolist() == [10.0, 20.0, 30.0]
    # with one step, the return is r + γ V(next) where the episode goes on, and r where it ended
    goes_on = 10.0 + GAMMA * float(next_value[0])
    returns = learner.storage.returns[0, :, 0]
    assert returns.tolist() == pytest.approx([goes_on, 20.0, bootstrapped], abs=1e-5)


def test_what_chance_does_after_a_step_is_not_credited_to_it():
    """Robot 1 is pushed: its advantage is that of the state without the push."""
    learner = ppo("mlp", robots=2, steps=1)
    generator = torch.Generator().manual_seed(1)
    before, after, without = (observations(2, generator) for _ in range(3))
    with torch.inference_mode():
        learner.act(before)
        extras = {
            "terminal_ids": torch.zeros(0, dtype=torch.long),
            "unforeseen_ids": torch.tensor([1]), "unforeseen_observations": without[1:],
        }  # fmt: skip
        learner.process_env_step(after, torch.tensor([1.0, 2.0]), torch.zeros(2).bool(), extras)
        learner.compute_returns(after)
        reached = learner.critic(torch.cat([after[:1], without[1:]]))[:, 0]
        assert (learner.critic(without)[1] - learner.critic(after)[1]).abs() > 0.05
    expected = torch.tensor([1.0, 2.0]) + learner.gamma * reached
    torch.testing.assert_close(learner.storage.returns[0, :, 0], expected)


# ------------------------------------------------------------------------------ checkpoints


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> bytes:
    """That of an MLP after one update."""
    path = tmp_path_factory.mktemp("checkpoint") / "last.pt"
    saved(path)
    return path.read_bytes()


def saved(path: Path, kind: str = "mlp") -> Learner:
    learner = make_learner(tiny_run(kind), Ranks())
    learner.rollout()
    learner.update()
    learner.save(path, {"note": 5})
    return learner


def weights_of(learner):
    return *learner.actor.state_dict().values(), *learner.averaged.state_dict().values()


@pytest.mark.parametrize("kind", ["mlp-actions", "gru"])
def test_a_loaded_learner_goes_on_exactly_as_the_one_that_was_saved(tmp_path, kind):
    path = tmp_path / "last.pt"
    first = saved(path, kind)
    second = make_learner(tiny_run(kind, seed=99), Ranks())
    rng = torch.get_rng_state()
    assert second.load(path) == {"note": 5} and second.iteration == 1
    for learner in (first, second):
        torch.set_rng_state(read_checkpoint(path)["torch_rng"])
        learner.rollout()
        learner.update()
    assert not torch.equal(rng, torch.get_rng_state())
    for a, b in zip(
        (*weights_of(first), *first.observations.values()),
        (*weights_of(second), *second.observations.values()),
        strict=True,
    ):
        assert torch.equal(a, b)


def updating(averaging: int, updates: int, tmp_path):
    """Weights after each update, those that would be saved, and the last checkpoint."""
    hyper = replace(
        tiny_run().learner, averaging=averaging, critic_warmup=1, learning_rate=1e-2,
        learning_rates=(1e-2, 1e-2), desired_kl=1e9,
    )  # fmt: skip
    learner = make_learner(tiny_run(learner=hyper), Ranks())
    after = []
    for _ in range(updates):
        learner.rollout()
        learner.update()
        after.append(learner.actor.mlp[0].weight.detach().clone())
    learner.save(tmp_path / "last.pt", {})
    return after, learner.averaged.mlp[0].weight.detach(), read_checkpoint(tmp_path / "last.pt")


def test_the_policy_that_is_saved_has_the_mean_of_the_last_updates_weights(tmp_path):
    """The critic's first update changes no policy and does not count."""
    after, averaged, checkpoint = updating(2, 4, tmp_path)
    assert (after[1] != after[0]).any() and (after[3] != after[2]).any()
    wanted = 0.5 * after[3] + 0.25 * after[2] + 0.25 * after[1]
    torch.testing.assert_close(averaged, wanted)
    assert torch.equal(judged_weights(checkpoint)["mlp.0.weight"], averaged)


def test_without_averaging_the_policy_that_is_saved_is_the_last(tmp_path):
    after, averaged, checkpoint = updating(1, 2, tmp_path)
    assert torch.equal(averaged, after[1])
    checkpoint.pop("average")  # as of an older version
    assert torch.equal(judged_weights(checkpoint)["mlp.0.weight"], after[1])
    torch.save(checkpoint, tmp_path / "old.pt")
    learner = make_learner(tiny_run(), Ranks())
    learner.load(tmp_path / "old.pt")
    assert torch.equal(learner.averaged.mlp[0].weight, after[1])


def test_a_checkpoint_of_another_run_is_refused(checkpoint, tmp_path):
    path, run = tmp_path / "last.pt", tiny_run()
    path.write_bytes(checkpoint)
    cases = [
        (tiny_run("gru"), "run says gru"),
        (
            replace(run, architecture=replace(run.architecture, hidden=(17,))),
            "does not fit this run's networks",
        ),
        (tiny_run(environments=5), "settings of the run"),
        (tiny_run(task=Walking(episode_s=0.2, knee="serial")), "settings of the run"),
    ]
    assert_each_refused(cases, lambda run: make_learner(run, Ranks()).load(path))


def test_what_is_no_checkpoint_or_of_another_version_or_incomplete_is_refused(checkpoint, tmp_path):
    path, learner = tmp_path / "last.pt", make_learner(tiny_run(), Ranks())
    assert_each_refused([(path, "does not exist")], learner.load, names=path)
    path.write_bytes(checkpoint)
    good = torch.load(path, weights_only=True)
    without_command = {k: v for k, v in good["environment"].items() if k != "command"}

    def load(content):
        path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
        learner.load(path)

    cases = [
        *((checkpoint[: int(share * len(checkpoint))], "damaged") for share in (0.0, 0.3, 0.99)),
        (np.random.default_rng(0).bytes(5000), "damaged"), ([1, 2], "not a checkpoint"),
        (good | {"schema": "something else"}, "not a checkpoint"),
        (good | {"schema_version": 1}, "older version"),
        (good | {"schema_version": 2}, "older version"),
        (good | {"schema_version": CHECKPOINT_VERSION + 1}, "Upgrade"),
        *(
            ({k: v for k, v in good.items() if k != part}, f"has no {part}")
            for part in ("hidden", "environment", "learning_rate")
        ),
        *((good | {"average": damaged}, "no set of weights") for damaged in (5, {}, [1, 2])),
        (good | {"environment": without_command}, "command"),
    ]  # fmt: skip
    assert_each_refused(cases, load, names=path)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_code_in_a_checkpoint_is_not_run_and_gigabytes_are_not_unpacked(tmp_path):
    path, made = tmp_path / "last.pt", tmp_path / "made"
    for save in (
        lambda: torch.save({"schema": "pupper-checkpoint", "more": Runs(str(made))}, path),
        lambda: path.write_bytes(pickle.dumps(Runs(str(made)))),
    ):
        save()
        with pytest.raises(InputError, match="damaged"):
            read_checkpoint(path)
        assert not made.exists()
    pickle.loads(pickle.dumps(Runs(str(made))))
    assert made.exists(), "or the test would prove nothing"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("last/data/0", bytes(100_000_000))
    with pytest.raises(InputError, match="is compressed, which torch's files are not"):
        read_checkpoint(path)


class Runs:
    """An object whose unpickling makes a folder."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def test_a_recurrent_policy_needs_an_environment_per_minibatch():
    run = tiny_run("lstm", environments=1)
    with pytest.raises(InputError, match="1 environments cannot be split into 2 minibatches"):
        make_learner(run, Ranks())
    make_learner(tiny_run("mlp", environments=1), Ranks())


def test_an_update_that_went_much_too_far_is_taken_back_and_the_rate_falls(tmp_path):
    """Adam's first step is as long as its rate, however small the gradient."""
    run = tiny_run(learner=replace(tiny_run().learner, learning_rate=0.1, desired_kl=0.01))
    learner = make_learner(run, Ranks())
    before = copy.deepcopy(learner.actor.mlp.state_dict())
    learner.rollout()
    found = learner.update()
    assert found["kl"] > 0.1
    for name, value in learner.actor.mlp.state_dict().items():
        torch.testing.assert_close(value, before[name])
    assert learner.ppo.learning_rate == pytest.approx(0.1 / 3)
    learner.hyper = replace(learner.hyper, desired_kl=1e6)
    learner.rollout()
    learner.update()
    assert any((v != before[name]).any() for name, v in learner.actor.mlp.state_dict().items())
