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
from typing import Any

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
    matrices = [p for p in parameters if p.ndim == 2]
    muon = (
        torch.optim.Muon(matrices, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
        if multiplies_bfloat16(matrices[0].device)
        else Float32Muon(matrices)
    )
    return [muon, torch.optim.Adam([p for p in parameters if p.ndim != 2])]


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether a device multiplies matrices of bfloat16 in hardware; torch's Muon computes in it.

    Processors without AVX-512 BF16 or AMX emulate it, 40 times slower than float32.
    """
    if device.type != "cpu":
        return True
    names = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, name, lambda: False)() for name in names)


class Float32Muon(torch.optim.Optimizer):
    """Muon (Jordan et al. 2024) in float32, otherwise as torch's with `match_rms_adamw`.

    A step is along the orthogonal factor of the matrix of Nesterov's momentum, found by five
    iterations of Newton and Schulz with a polynomial of degree five, scaled to the root mean square
    of a step of AdamW.

    Parameters
    ----------
    parameters : list of Parameter
        Matrices.
    """

    def __init__(self, parameters: list[torch.nn.Parameter]):
        super().__init__(parameters, {"lr": 1e-3})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Move every matrix along its gradients so far; a closure is not called."""
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is None:
                    continue
                state = self.state[matrix]
                if not state:
                    state["momentum"] = torch.zeros_like(matrix)
                mean = state["momentum"].lerp_(matrix.grad, 1.0 - _MOMENTUM)
                update = orthogonal_factor(matrix.grad.lerp(mean, _MOMENTUM))
                matrix.add_(update, alpha=-group["lr"] * _ADAMW_RMS * max(matrix.shape) ** 0.5)


_MOMENTUM = 0.95
_ADAMW_RMS = 0.2  # of AdamW's steps, over its rate (Liu et al. 2025)
_QUINTIC = (3.4445, -4.7750, 2.0315)  # steepest at 0 of those that keep singular values near 1
_ITERATIONS = 5


def orthogonal_factor(matrix: torch.Tensor) -> torch.Tensor:
    """The nearly orthogonal U V' of a matrix U S V'; singular values are 0.7 to 1.2, not 1.

    Parameters
    ----------
    matrix : Tensor, shape (m, n)
    """
    a, b, c = _QUINTIC
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix
    x = x / x.norm().clamp(min=1e-7)
    for _ in range(_ITERATIONS):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.T if tall else x
