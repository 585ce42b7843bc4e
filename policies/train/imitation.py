"""A first gait: the policy learns to continue an open-loop trot before PPO begins.

Rewards alone seldom find a walk within the samples of two cores. So the policy first imitates one
(DAgger: the policy acts, the teacher gives the action it would have taken). The teacher needs no
clock: it computes the phase of the trot from the last two actions and returns the next point. The
rewards of PPO afterwards contain nothing of the trot.

A policy that imitates a trot does not walk at its speeds: its strokes and its rhythm differ a
little, and noise of the actions loosens dry friction, so that a robot with it walks at other speeds
than without. So some robots act without noise, and the teacher corrects the commands that it
follows by how fast they walk (iterative learning control): after each round the errors of speed are
fitted as a function of the command, and a share of the fit is added to the correction. Where some
robots have no differences from the calibrated one, only these count: a low battery and a weak leg
slow a robot down, and no correction is right for it and for the calibrated one.
"""

from __future__ import annotations

import copy
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.storage import RolloutStorage

from pupper_sysid.policies.network.hyperparameters import Imitation
from pupper_sysid.policies.train.learner import Learner
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.env import PupperEnv

Array = NDArray[np.float64]

_SETTLED_S = 1.0  # after a new command
_RANGE = np.array([0.2, 0.1, 0.5])  # of commands [m/s, m/s, rad/s], so that features are of order 1
_MOST = 0.6  # of a coefficient of the correction
_RIDGE = 0.02  # in shares of the data
_FEWEST = 1000  # errors that are fitted
_QUIET = 4  # every so many robots act without noise


class Teacher:
    """The trot, following commands that are corrected by how the policy walks.

    Parameters
    ----------
    env : PupperEnv
        In which the policy acts.
    state : dict of str to Tensor, optional
        Of a teacher before, to go on from.

    Attributes
    ----------
    quiet : ndarray of bool, shape (n,)
        Robots that are to act without noise, whose speeds count.
    correction : ndarray, shape (3, 6)
        Coefficients of the correction, in shares of the largest commands.
    """

    def __init__(self, env: PupperEnv, state: dict[str, torch.Tensor] | None = None):
        self._env, self._command = env, env.command.copy()
        self.quiet = np.arange(env.environments) % _QUIET == 0
        self.correction, self._since = np.zeros((3, 6)), np.zeros(env.environments)
        if state:
            self.correction, self._since = (
                state[name].numpy().copy() for name in ("correction", "since_s")
            )
        self._features: list[Array] = []
        self._errors: list[Array] = []

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """All that a teacher of the same environment goes on with, between two rounds."""
        found = {"correction": self.correction, "since_s": self._since}
        return {name: torch.from_numpy(value.copy()) for name, value in found.items()}

    def actions(self) -> Array:
        """Next actions of the trot in every environment, shape (n, 12)."""
        env = self._env
        trot, scale, span = env.trot, env.config.action_scale, env.config.control_step_s
        command = self.corrected(env.command)
        now, before = (env.default + scale * a for a in (env.action, env.last_action))
        phase = trot.phase_of(now, before, span, command) + 2 * np.pi * trot.frequency_hz * span
        return (trot.joints(phase, command) - env.default) / scale

    def corrected(self, command: Array) -> Array:
        """Commands that the trot follows where these are given, shape (n, 3)."""
        more = np.einsum("nak,ak->na", _features(command), self.correction)
        return command + _RANGE * more

    def watch(self) -> None:
        """Take the speeds of the present step."""
        env = self._env
        changed = (env.command != self._command).any(axis=1) | (env.episode_step == 0)
        self._since = np.where(changed, 0.0, self._since + env.config.control_step_s)
        self._command = env.command.copy()
        walks = self.quiet & (self._since > _SETTLED_S) & env.command.any(axis=1)
        if env.config.differences.as_calibrated:
            walks &= env.robots.bodies.as_calibrated
        self._features.append(_features(env.command[walks]))
        self._errors.append((env.command - env.stride_velocity)[walks] / _RANGE)

    def adapt(self, rate: float) -> None:
        """Add a share `rate` of the errors since the last time, fitted, to the correction."""
        features, errors = np.concatenate(self._features), np.concatenate(self._errors)
        self._features, self._errors = [], []
        if not rate or len(errors) < _FEWEST:
            return
        for axis in range(3):
            x = features[:, axis]
            square = x.T @ x / len(x) + _RIDGE * np.eye(x.shape[1])
            self.correction[axis] += rate * np.linalg.solve(square, x.T @ errors[:, axis] / len(x))
        np.clip(self.correction, -_MOST, _MOST, out=self.correction)


def _features(command: Array) -> Array:
    """Of each axis, what its speed may depend on, shape (n, 3, 6).

    Only what is odd under a mirror image where the axis is, and even where it is.
    """
    x, y, turn = (command / _RANGE).T
    alone = Trot.turning_in_place(command)
    return np.stack(
        [
            np.stack([np.maximum(x, 0), np.minimum(x, 0), x * abs(x), x * abs(y), x * abs(turn),
                      y * turn], axis=-1),
            np.stack([y, y * abs(y), y * abs(x), y * abs(turn), turn, x * turn], axis=-1),
            np.stack([turn, turn * abs(turn), alone, turn * abs(x), turn * abs(y), y], axis=-1),
        ],
        axis=1,
    )  # fmt: skip


def imitate(learner: Learner, teacher: Teacher, how: Imitation, round_: int) -> float:
    """One round: act, query the teacher, learn; root mean square difference to it.

    In early rounds the teacher acts in some environments, so that the data contain a walk; once the
    policy walks alone, its speeds correct the teacher's commands.
    """
    ppo = learner.ppo
    share = max(0.0, 1.0 - 2.0 * round_ / max(how.iterations, 1))
    rollouts = [_shown(learner, teacher, share) for _ in range(how.rollouts)]
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


def _shown(learner: Learner, teacher: Teacher, share: float) -> RolloutStorage:
    """One rollout, with the teacher's actions in place of those taken.

    The teacher acts for a share of the robots.
    """
    env, ppo = learner.env.env, learner.ppo
    led = learner.env.tensor(env.rng.random(env.environments) < share)
    quiet = learner.env.tensor(teacher.quiet)
    targets: list[torch.Tensor] = []
    with torch.inference_mode():
        for _ in range(learner.hyper.steps_per_environment):
            shown = learner.env.tensor(teacher.actions().astype(np.float32))
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

    The trot bends sharply in its twelve joints, and Adam needs ten times as many steps to follow.
    """
    return [
        torch.optim.Muon(
            [p for p in parameters if p.ndim == 2], weight_decay=0.0,
            adjust_lr_fn="match_rms_adamw",
        ),
        torch.optim.Adam([p for p in parameters if p.ndim != 2]),
    ]  # fmt: skip
