"""A first gait: the policy learns to act as a teacher before PPO improves it.

Rewards alone seldom find a walk within the samples of two cores, for a policy that sees late
readings and no clock. So the policy first imitates a teacher (DAgger: the policy acts, the teacher
gives the action it would have taken). The rewards of PPO afterwards contain nothing of it.

`TrotTeacher` continues an open-loop trot, `LearnedTeacher` the gait of a network that was trained
from nothing (`--start teacher`). Both need no clock: they compute the phase of the gait from the
last two actions and return the next point. So a policy without a memory can learn to do the same.

A policy that imitates does not walk at its teacher's speeds: its strokes and its rhythm differ a
little, and noise of the actions loosens dry friction, so that a robot with it walks at other speeds
than without. So some robots act without noise, and the teacher corrects the commands that it
follows by how fast they walk (iterative learning control): after each round the errors of speed are
fitted as a function of the command, and a share of the fit is added to the correction. Where some
robots have no differences from the calibrated one, only these count: a low battery and a weak leg
slow a robot down, and no correction is right for it and for the calibrated one.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.network.actor_critic import build
from pupper_sysid.policies.train.learner import (
    Learner,
    WalkingVecEnv,
    judged_weights,
    read_checkpoint,
)
from pupper_sysid.policies.train.run_file import Imitation, Run, check_teacher
from pupper_sysid.policies.walks.together import share_of_usual
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.step import CLOCK_SEEN, OBSERVATION_PARTS

Array = NDArray[np.float64]

_SETTLED_S = 1.0  # after a new command
_RANGE = np.array([0.2, 0.1, 0.5])  # of commands [m/s, m/s, rad/s], so that features are of order 1
_MOST = 0.6  # of a coefficient of the correction
_RIDGE = 0.02  # in shares of the data
_FEWEST = 1000  # errors that are fitted
_QUIET = 4  # every so many robots act without noise
_COMMAND = OBSERVATION_PARTS["command"]
_CLOCK = slice(CLOCK_SEEN.start, CLOCK_SEEN.start + 2)  # cosine and sine
_PER_STEP = 4  # phases of a learned gait that are compared, per control step


class Teacher(ABC):
    """Shows actions for commands that are corrected by how the policy walks.

    The policy acts in `env`; `state` is that of a teacher before, to go on from. Robots of the mask
    `quiet`, shape (n,), are to act without noise: their speeds count. `correction`, shape (3, 6),
    has the coefficients of the correction, in shares of the largest commands.
    """

    def __init__(self, env: WalkingVecEnv, state: dict[str, torch.Tensor] | None = None):
        self._vec_env, self._env = env, env.env
        self._command = self._env.command.copy()
        self._range = _RANGE * share_of_usual(self._env.config)
        self.quiet = np.arange(env.num_envs) % _QUIET == 0
        self.correction, self._since = np.zeros((3, 6)), np.zeros(env.num_envs)
        if state:
            self.correction, self._since = (
                state[name].numpy().copy() for name in ("correction", "since_s")
            )
        self._features: list[Array] = []
        self._errors: list[Array] = []

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """All that a teacher of the same environment goes on with, between two rounds."""
        arrays = {"correction": self.correction, "since_s": self._since}
        return {name: torch.from_numpy(value.copy()) for name, value in arrays.items()}

    @abstractmethod
    def actions(self, observations: TensorDict) -> torch.Tensor:
        """Actions to learn in every environment, shape (n, 12), on the learner's device."""

    def corrected(self, command: Array) -> Array:
        """Commands that the teacher follows where these are given, shape (n, 3)."""
        more = np.einsum("nak,ak->na", _features(command / self._range), self.correction)
        return command + self._range * more

    def watch(self) -> None:
        """Take the speeds of the present step."""
        env = self._env
        changed = (env.command != self._command).any(axis=1) | (env.episode_step == 0)
        self._since = np.where(changed, 0.0, self._since + env.config.control_step_s)
        self._command = env.command.copy()
        walks = self.quiet & (self._since > _SETTLED_S) & env.command.any(axis=1)
        if env.config.differences.as_calibrated:
            walks &= env.robots.bodies.as_calibrated
        self._features.append(_features(env.command[walks] / self._range))
        self._errors.append((env.command - env.stride_velocity)[walks] / self._range)

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


class TrotTeacher(Teacher):
    """Continues the open-loop trot from whatever the last two actions were."""

    def actions(self, observations: TensorDict) -> torch.Tensor:
        """Next points of the trot, as actions."""
        env = self._env
        trot, scale, span = env.trot, env.config.action_scale, env.config.control_step_s
        command = self.corrected(env.command)
        now, before = (env.default + scale * a for a in (env.action, env.last_action))
        phase = (
            trot.phase_of(now, before, span, command, env.body)
            + 2 * np.pi * trot.frequency_hz * span
        )
        target = (trot.joints(phase, command, env.body) - env.default) / scale
        return self._vec_env.tensor(target.astype(np.float32))


class LearnedTeacher(Teacher):
    """Continues the gait of a network from whatever the last two actions were.

    The network acts by a clock that no policy sees. So the clock is set, as for the trot, to the
    phase at which the network would have acted most nearly as the robot just did: a policy without
    a memory can follow, and a robot that stands and is to walk begins to.

    The network is that of `load_teacher`.
    """

    def __init__(
        self, env: WalkingVecEnv, network: MLPModel, state: dict[str, torch.Tensor] | None = None
    ):
        super().__init__(env, state)
        self._network = network.to(env.device)
        config = self._env.config
        cycles = config.rewards.clock_hz * config.control_step_s
        self._step, count = 2 * np.pi * cycles, _PER_STEP * round(1 / cycles)
        self._grid = torch.arange(count, device=env.device) * (2 * np.pi / count)

    def actions(self, observations: TensorDict) -> torch.Tensor:
        """What the network does next where the policy is, without noise."""
        n, count = len(observations), len(self._grid)
        policy = observations["policy"].clone()
        command = self.corrected(self._env.command)
        policy[:, _COMMAND] = self._vec_env.tensor(command.astype(np.float32))
        seen = TensorDict({"policy": policy, "privileged": observations["privileged"]}, [n])
        wide = seen.repeat_interleave(count, 0)
        candidates = self._at(wide, self._grid.repeat(n)).view(n, count, -1)
        last, earlier = (
            self._vec_env.tensor(a.astype(np.float32))[:, None]
            for a in (self._env.action, self._env.last_action)
        )
        away = (candidates - last).square().sum(-1)
        away += (candidates.roll(_PER_STEP, 1) - earlier).square().sum(-1)
        return self._at(seen, lowest(away) + self._step)

    def _at(self, seen: TensorDict, phase: torch.Tensor) -> torch.Tensor:
        """Actions at phases of the clock, shape (k, 12)."""
        privileged = seen["privileged"].clone()
        privileged[:, _CLOCK] = torch.stack([torch.cos(phase), torch.sin(phase)], dim=-1)
        return self._network(TensorDict({**seen, "privileged": privileged}, seen.batch_size))


def lowest(values: torch.Tensor) -> torch.Tensor:
    """Phase [rad] of the lowest of values at equal distances of a cycle, shape (n,).

    It is the bottom of the parabola through the lowest and its neighbours.

    Values have the shape (n, k).
    """
    at, rows, count = values.argmin(1), torch.arange(len(values)), values.shape[1]
    before, lowest, after = (values[rows, (at + k) % count] for k in (-1, 0, 1))
    bend = (before - 2 * lowest + after).clamp(min=1e-12)
    return (at + (0.5 * (before - after) / bend).clamp(-0.5, 0.5)) * (2 * np.pi / count)


def load_teacher(folder: Path, checkpoint: str, run: Run, seen: TensorDict) -> MLPModel:
    """The network of a run of `--start teacher`.

    It is a file in the run's folder, `run` is to learn from it, and `seen` are observations of its
    environment, for their sizes.
    """
    teacher = check_teacher(folder, run)
    content = read_checkpoint(folder / checkpoint)
    network, _ = build(teacher.architecture, seen, teacher.learner)
    try:
        network.load_state_dict(judged_weights(content))
    except RuntimeError as error:
        raise InputError(
            f"The teacher in {folder} is of a version of pupper-train whose teachers see something "
            "else. Train one with this version: pupper-train --start teacher."
        ) from error
    network.requires_grad_(False)
    return network.eval()


def _features(share: Array) -> Array:
    """Of each axis, what its speed may depend on, shape (n, 3, 6), of shares of the commands.

    Only what is odd under a mirror image where the axis is, and even where it is.
    """
    x, y, turn = share.T
    alone = Trot.turning_in_place(share * _RANGE)
    return np.stack(
        [
            np.stack([np.maximum(x, 0), np.minimum(x, 0), x * abs(x), x * abs(y), x * abs(turn),
                      y * turn], axis=-1),
            np.stack([y, y * abs(y), y * abs(x), y * abs(turn), turn, x * turn], axis=-1),
            np.stack([turn, turn * abs(turn), alone, turn * abs(x), turn * abs(y), y], axis=-1),
        ],
        axis=1,
    )  # fmt: skip


def imitate(
    learner: Learner,
    teacher: Teacher,
    settings: Imitation,
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
    share = max(0.0, 1.0 - 2.0 * round_ / max(settings.iterations, 1))
    rollouts = []
    for _ in range(settings.rollouts):
        rollout = _taught_rollout(learner, teacher, share, stop_requested)
        if rollout is None:
            return None
        rollouts.append(rollout)
    teacher.adapt(0.0 if share else settings.correction_rate)
    networks = (ppo.actor, ppo.critic)
    for rollout in rollouts:
        for network in networks:
            network.update_normalization(rollout.observations.flatten(0, 1))
    minibatches = settings.minibatches
    if ppo.actor.is_recurrent:
        minibatches = min(minibatches, learner.env.num_envs)  # groups of robots, not of steps
        batches = [r.recurrent_mini_batch_generator(minibatches, settings.epochs) for r in rollouts]
    else:
        batches = [r.mini_batch_generator(minibatches, settings.epochs) for r in rollouts]
    # rollouts alternate, so that the last one has no more weight than the others
    ordered = chain.from_iterable(zip(*batches, strict=True))
    steps = minibatches * settings.epochs * settings.rollouts
    optimisers = _optimisers([p for n in networks for p in n.parameters() if p.requires_grad])
    errors = []
    for step, batch in enumerate(ordered):
        if stop_requested():
            return None
        done = (round_ + step / steps) / settings.iterations
        for optimiser in optimisers:
            for group in optimiser.param_groups:
                group["lr"] = settings.learning_rate * (1.0 - done)
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
    return float(np.sqrt(np.mean(errors[-minibatches * settings.rollouts :])))


def _taught_rollout(
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
            taught = teacher.actions(learner.observations)
            targets.append(taught)
            centre = learner.act() - learner.env.noise
            learner.env.noise[quiet] = 0.0
            actions = torch.where(led[:, None], taught, centre) + learner.env.noise
            learner.observations, rewards, dones, extras = learner.env.step(actions)
            ppo.process_env_step(learner.observations, rewards, dones, extras)
            teacher.watch()
        ppo.compute_returns(learner.observations)
    rollout = copy.deepcopy(ppo.storage)
    rollout.actions = torch.stack(targets)
    ppo.storage.clear()
    return rollout


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
    """The nearly orthogonal U V' of a matrix U S V'; singular values are 0.7 to 1.2, not 1."""
    a, b, c = _QUINTIC
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix
    x = x / x.norm().clamp(min=1e-7)
    for _ in range(_ITERATIONS):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.T if tall else x
