"""Exploration, its likelihood and schedule, and which policy is kept."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pupper_sysid.policies.network.actor_critic import ActionNoise
from pupper_sysid.policies.train.learner import Ranks
from pupper_sysid.policies.train.run_file import Exploration, Hyperparameters
from pupper_sysid.policies.train.selection import Judge
from pupper_sysid.policies.train.training import make_learner
from pupper_sysid.sim.walking.config import Walking
from support.tiny_training import tiny_run


def test_noise_is_about_the_networks_output_with_the_likelihood_of_a_gaussian():
    torch.manual_seed(0)
    noise = ActionNoise(2, init_std=0.5, learn_std=False)
    noise.set_std(torch.tensor([0.3, 0.4]))
    noise.update(torch.tensor([1.0, 2.0]).expand(4000, 2))
    drawn = noise.sample() - noise.centre
    assert drawn.std(0).tolist() == pytest.approx([0.3, 0.4], rel=0.05)
    action = torch.tensor([1.3, 2.1]).expand(4000, 2)
    by_hand = sum(
        -0.5 * (off / sd) ** 2 - math.log(sd * math.sqrt(2 * math.pi))
        for off, sd in ((0.3, 0.3), (0.1, 0.4))
    )
    assert noise.log_prob(action)[0].item() == pytest.approx(by_hand, rel=1e-5)


def test_the_standard_deviation_falls_by_equal_factors_between_two_points():
    explore = Exploration((0.4, 0.1), (1.0, 3.0))
    assert [explore.std_at(1e6 * m) for m in (0, 1, 2, 3, 9)] == pytest.approx(
        [0.4, 0.4, 0.2, 0.1, 0.1]
    )


def learning(**changes):
    made = make_learner(tiny_run(learner=replace(tiny_run().learner, **changes)), Ranks())
    made.rollout()
    return made


def weights(network) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in network.state_dict().items()}


def changed(before: dict[str, torch.Tensor], network) -> set[str]:
    now = network.state_dict()
    return {k.split(".")[0] for k, v in before.items() if not torch.equal(v, now[k])}


def test_first_only_the_critic_learns_and_then_the_policy_too_but_not_a_frozen_normaliser():
    learner = learning(
        critic_warmup=1, learning_rate=1e-3, learning_rates=(1e-6, 1e-2), desired_kl=1e3
    )  # fmt: skip
    actor, critic = weights(learner.ppo.actor), weights(learner.ppo.critic)
    learner.update()
    assert changed(actor, learner.ppo.actor) == {"obs_normalizer"}
    assert "mlp" in changed(critic, learner.ppo.critic)
    assert learner.ppo.learning_rate == 1e-3, "nothing is adapted before the policy learns"
    actor = weights(learner.ppo.actor)
    learner.rollout()
    assert learner.update()["kl"] > 0 and "mlp" in changed(actor, learner.ppo.actor)
    frozen = learning(freeze_normaliser=True, learning_rate=1e-3, desired_kl=1e3)
    actor = weights(frozen.ppo.actor)
    frozen.update()
    assert changed(actor, frozen.ppo.actor) == {"mlp"}, "nor is a scheduled deviation learned"


def test_the_learning_rate_follows_the_divergence_within_its_ends():
    for rate, falls in ((3e-2, True), (1e-7, False)):
        learner = learning(
            learning_rate=rate, learning_rates=(1e-7, 3e-2), desired_kl=1e-3,
            freeze_normaliser=True,
        )  # fmt: skip
        report = learner.update()
        if falls:
            assert report["kl"] > 2e-3 and learner.ppo.learning_rate < rate
            assert report["clip_fraction"] > 0
        else:
            assert report["kl"] < 5e-4 and learner.ppo.learning_rate > rate
        rates = [group["lr"] for group in learner.ppo.optimizer.param_groups]
        assert rates == [learner.ppo.learning_rate, Hyperparameters().critic_learning_rate]


def test_a_policy_is_judged_without_noise_and_always_on_the_same_walks():
    learner = make_learner(tiny_run(), Ranks())
    env = learner.env.env
    judge = Judge(Walking(episode_s=0.4), env.servos, 0, 1)
    first = judge(learner.actor)
    before = env.state
    torch.manual_seed(5)
    assert judge(learner.actor) == first
    assert all(np.array_equal(before[k], v) for k, v in env.state.items())
    with torch.no_grad():
        learner.actor.mlp[-1].bias += 0.5
    assert judge(learner.actor) != first


@pytest.mark.slow
def test_a_robot_that_stands_scores_about_nothing_and_one_that_falls_less():
    learner = make_learner(tiny_run(), Ranks())
    judge = Judge(Walking(episode_s=1.5), learner.env.env.servos, 0, 1)
    last = learner.actor.mlp[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.zero_()
    standing = judge(learner.actor)
    assert standing["score"] == pytest.approx(0.0, abs=0.1) and standing["score_falls"] == 0
    assert standing["score_turn"] == pytest.approx(0.0, abs=0.1)
    assert standing["score_steps_hz"] < 0.1 and standing["score_duty"] > 0.7
    with torch.no_grad():
        last.bias.copy_(torch.tensor([2.0, 2.0, 2.0] * 2 + [-2.0, -2.0, 0.0] * 2))
    fallen = judge(learner.actor)
    assert fallen["score_falls"] > 0.5 and fallen["score"] < -0.4
