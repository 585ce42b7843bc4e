"""A first gait: the policy learns to act as a teacher before PPO improves it.

Rewards alone seldom find a walk within the samples of two cores, for a policy that sees late
readings and no clock. So the policy first imitates one of `policies.train.teachers` (DAgger: the
policy acts, the teacher gives the action it would have taken). The rewards of PPO afterwards
contain nothing of the teacher.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from itertools import chain

import numpy as np
import torch
from rsl_rl.storage import RolloutStorage

from pupper_sysid.policies.network.hyperparameters import Imitation
from pupper_sysid.policies.train.learner import Learner
from pupper_sysid.policies.train.teachers import Teacher


def imitate(
    learner: Learner,
    teacher: Teacher,
    how: Imitation,
    round_: int,
    stop_requested: Callable[[], bool] = lambda: False,
) -> float | None:
    """One round: act, query the teacher, learn; root mean square difference to it.

    In early rounds the teacher acts in some environments, so that the data contain a walk; once the
    policy walks alone, its speeds correct the teacher's commands.

    Returns None where a stop was requested within the round, which then is incomplete: the policy
    plays, but learning goes on from what was saved before.
    """
    ppo = learner.ppo
    share = max(0.0, 1.0 - 2.0 * round_ / max(how.iterations, 1))
    rollouts = []
    for _ in range(how.rollouts):
        rollout = _shown(learner, teacher, share, stop_requested)
        if rollout is None:
            return None
        rollouts.append(rollout)
    teacher.adapt(0.0 if share else how.correction_rate)
    networks = (ppo.actor, ppo.critic)
    for rollout in rollouts:
        for network in networks:
            network.update_normalization(rollout.observations.flatten(0, 1))
    parts = how.minibatches
    if ppo.actor.is_recurrent:
        parts = min(parts, learner.env.num_envs)  # it divides robots, not steps
        batches = [r.recurrent_mini_batch_generator(parts, how.epochs) for r in rollouts]
    else:
        batches = [r.mini_batch_generator(parts, how.epochs) for r in rollouts]
    # all of them in turn, so that the last is not remembered best
    ordered = chain.from_iterable(zip(*batches, strict=True))
    steps = parts * how.epochs * how.rollouts
    optimisers = _optimisers([p for n in networks for p in n.parameters() if p.requires_grad])
    errors = []
    for step, batch in enumerate(ordered):
        if stop_requested():
            return None
        done = (round_ + step / steps) / how.iterations
        for optimiser in optimisers:
            for group in optimiser.param_groups:
                group["lr"] = how.learning_rate * (1.0 - done)
        mean = ppo.actor(batch.observations, masks=batch.masks, hidden_state=batch.hidden_states[0])
        value = ppo.critic(batch.observations, masks=batch.masks)
        error = (mean - batch.actions).pow(2).mean()
        loss = error + (value - batch.returns).pow(2).mean()
        for network in networks:
            network.zero_grad()
        loss.backward()
        if ppo.is_multi_gpu:
            ppo.reduce_parameters()
        for optimiser in optimisers:
            optimiser.step()
        errors.append(float(error.detach()))
    return float(np.sqrt(np.mean(errors[-parts * how.rollouts :])))


def _shown(
    learner: Learner, teacher: Teacher, share: float, stop_requested: Callable[[], bool]
) -> RolloutStorage | None:
    """One rollout, with the teacher's actions in place of those taken; None if it was stopped.

    The teacher acts for a share of the robots.
    """
    env, ppo = learner.env.env, learner.ppo
    led = learner.env.tensor(env.rng.random(env.environments) < share)
    quiet = learner.env.tensor(teacher.quiet)
    targets: list[torch.Tensor] = []
    with torch.inference_mode():
        for _ in range(learner.hyper.steps_per_environment):
            if stop_requested():
                return None
            shown = teacher.actions(learner.observations)
            targets.append(shown)
            centre = learner.act() - learner.env.noise
            learner.env.noise[quiet] = 0.0
            actions = torch.where(led[:, None], shown, centre) + learner.env.noise
            learner.observations, rewards, dones, extras = learner.env.step(actions)
            ppo.process_env_step(learner.observations, rewards, dones, extras)
            teacher.watch()
        ppo.compute_returns(learner.observations)
    found = copy.deepcopy(ppo.storage)
    found.actions = torch.stack(targets)
    ppo.storage.clear()
    return found


def _optimisers(parameters: list[torch.nn.Parameter]) -> list[torch.optim.Optimizer]:
    """Muon for matrices, Adam for the rest.

    A gait bends sharply in its twelve joints, and Adam needs ten times as many steps to follow.
    """
    return [
        torch.optim.Muon(
            [p for p in parameters if p.ndim == 2], weight_decay=0.0,
            adjust_lr_fn="match_rms_adamw",
        ),
        torch.optim.Adam([p for p in parameters if p.ndim != 2]),
    ]  # fmt: skip
