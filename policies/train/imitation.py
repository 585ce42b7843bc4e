"""A first gait: the policy learns to continue an open-loop trot before PPO begins.

Rewards alone seldom find a walk within the samples of two cores. So the policy first imitates one
(DAgger: the policy acts, the teacher gives the action it would have taken). The teacher needs no
clock: it computes the phase of the trot from the last two actions and returns the next point. The
rewards of PPO afterwards contain nothing of the trot.
"""

from __future__ import annotations

import numpy as np
import torch

from pupper_sysid.policies.network.hyperparameters import Imitation
from pupper_sysid.policies.train.learner import Learner
from pupper_sysid.sim.walking.env import PupperEnv


def teacher_actions(env: PupperEnv) -> np.ndarray:
    """Next actions of the trot in every environment, shape (n, 12)."""
    trot, scale = env.trot, env.config.action_scale
    span = env.config.control_step_s
    now, before = (env.default + scale * a for a in (env.action, env.last_action))
    phase = trot.phase_of(now, before, span, env.command) + 2 * np.pi * trot.frequency_hz * span
    return (trot.joints(phase, env.command) - env.default) / scale


def imitate(learner: Learner, how: Imitation, round_: int) -> float:
    """One round: act, query the teacher, learn; root mean square difference to it.

    In early rounds the teacher acts in some environments, so that the data contain a walk.
    """
    env, ppo = learner.env.env, learner.ppo
    share = max(0.0, 1.0 - 2.0 * round_ / max(how.iterations, 1))
    led = torch.from_numpy(env.rng.random(env.environments) < share)
    targets: list[torch.Tensor] = []
    with torch.inference_mode():
        for _ in range(learner.hyper.steps_per_environment):
            teacher = torch.from_numpy(teacher_actions(env).astype(np.float32))
            targets.append(teacher)
            actions = learner.act()
            actions = torch.where(led[:, None], teacher + learner.env.noise, actions)
            learner.observations, rewards, dones, extras = learner.env.step(actions)
            ppo.process_env_step(learner.observations, rewards, dones, extras)
        ppo.compute_returns(learner.observations)
    # the teacher's actions in place of those taken
    storage = ppo.storage
    storage.actions = torch.stack(targets)
    seen = storage.observations.flatten(0, 1)
    if round_ == 0:
        ppo.actor.update_normalization(seen)
        ppo.critic.update_normalization(seen)
    for group in ppo.optimizer.param_groups:
        group["lr"] = how.learning_rate * (1.0 - 0.9 * round_ / how.iterations)
    parts = how.minibatches
    if ppo.actor.is_recurrent:
        parts = min(parts, env.environments)  # it divides robots, not steps
        batches = storage.recurrent_mini_batch_generator(parts, how.epochs)
    else:
        batches = storage.mini_batch_generator(parts, how.epochs)
    errors = []
    for batch in batches:
        mean = ppo.actor(batch.observations, masks=batch.masks, hidden_state=batch.hidden_states[0])
        value = ppo.critic(batch.observations, masks=batch.masks)
        error = (mean - batch.actions).pow(2).mean()
        loss = error + 0.1 * (value - batch.returns).pow(2).mean()
        ppo.optimizer.zero_grad()
        loss.backward()
        if ppo.is_multi_gpu:
            ppo.reduce_parameters()
        torch.nn.utils.clip_grad_norm_(ppo.actor.parameters(), learner.hyper.gradient_norm)
        torch.nn.utils.clip_grad_norm_(ppo.critic.parameters(), learner.hyper.gradient_norm)
        ppo.optimizer.step()
        errors.append(float(error.detach()))
    if round_ > 0:
        ppo.actor.update_normalization(seen)
        ppo.critic.update_normalization(seen)
    storage.clear()
    return float(np.sqrt(np.mean(errors[-parts:])))
