"""Teachers of a first gait: what a policy imitates before PPO begins.

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

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.network.actor_critic import build
from pupper_sysid.policies.train.checkpoint import judged_weights, read_checkpoint
from pupper_sysid.policies.train.run_file import Run, check_teacher
from pupper_sysid.policies.train.vec_env import WalkingVecEnv
from pupper_sysid.policies.walks.conditions import share_of_usual
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.observation import CLOCK_SEEN, OBSERVATION_PARTS

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

    Parameters
    ----------
    env : WalkingVecEnv
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

    def __init__(self, env: WalkingVecEnv, state: dict[str, torch.Tensor] | None = None):
        self._vec_env, self._env = env, env.env
        self._command = self._env.command.copy()
        task = self._env.config
        self._range = _RANGE * (share_of_usual(task) if task.robot else 1.0)
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
        found = {"correction": self.correction, "since_s": self._since}
        return {name: torch.from_numpy(value.copy()) for name, value in found.items()}

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
        shown = (trot.joints(phase, command, env.body) - env.default) / scale
        return self._vec_env.tensor(shown.astype(np.float32))


class LearnedTeacher(Teacher):
    """Continues the gait of a network from whatever the last two actions were.

    The network acts by a clock that no policy sees. So the clock is set, as for the trot, to the
    phase at which the network would have acted most nearly as the robot just did: a policy without
    a memory can follow, and a robot that stands and is to walk begins to.

    Parameters
    ----------
    env : WalkingVecEnv
    network : MLPModel
        Of `load_teacher`.
    state : dict of str to Tensor, optional
        As for `Teacher`.
    """

    def __init__(
        self,
        env: WalkingVecEnv,
        network: MLPModel,
        state: dict[str, torch.Tensor] | None = None,
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
        shown = self._at(wide, self._grid.repeat(n)).view(n, count, -1)
        last, earlier = (
            self._vec_env.tensor(a.astype(np.float32))[:, None]
            for a in (self._env.action, self._env.last_action)
        )
        away = (shown - last).square().sum(-1)
        away += (shown.roll(_PER_STEP, 1) - earlier).square().sum(-1)
        return self._at(seen, lowest(away) + self._step)

    def _at(self, seen: TensorDict, phase: torch.Tensor) -> torch.Tensor:
        """Actions at phases of the clock, shape (k, 12)."""
        privileged = seen["privileged"].clone()
        privileged[:, _CLOCK] = torch.stack([torch.cos(phase), torch.sin(phase)], dim=-1)
        return self._network(TensorDict({**seen, "privileged": privileged}, seen.batch_size))


def lowest(values: torch.Tensor) -> torch.Tensor:
    """Phase [rad] of the lowest of values at equal distances of a cycle, shape (n,).

    It is the bottom of the parabola through the lowest and its neighbours.

    Parameters
    ----------
    values : Tensor, shape (n, k)
    """
    at, rows, count = values.argmin(1), torch.arange(len(values)), values.shape[1]
    before, here, after = (values[rows, (at + k) % count] for k in (-1, 0, 1))
    bend = (before - 2 * here + after).clamp(min=1e-12)
    return (at + (0.5 * (before - after) / bend).clamp(-0.5, 0.5)) * (2 * np.pi / count)


def load_teacher(folder: Path, checkpoint: str, run: Run, seen: TensorDict) -> MLPModel:
    """The network of a run of `--start teacher`.

    Parameters
    ----------
    folder : Path
        Of that run.
    checkpoint : str
        Name of its file there.
    run : Run
        That is to learn from it.
    seen : TensorDict
        Observations of its environment, for their sizes.
    """
    own = check_teacher(folder, run)
    content = read_checkpoint(folder / checkpoint)
    network, _ = build(own.architecture, seen, own.learner, own.task.control_step_s)
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
