"""Rollouts of a policy, step by step, and the errors by which it follows its commands.

`collect` runs a policy in the simulator under a number of conditions and records everything that
the analyses of gait and internal dynamics need; observations may be altered on the way (ablated,
delayed, frozen). `replay` feeds recorded observations to a policy in open loop. Neither changes the
state of the given policy, so a policy can be probed in the middle of a walk. The hidden state is
that of the published analyses: the cell of an LSTM, the state of a GRU, the latent of a
Transformer, the last hidden layer of an MLP.

A tracking error, in evaluation, analyses and deployment alike, is the mean absolute difference
between the robot's true velocity (forward and sideways speed in the trunk's frame, turn rate) and
the command: at every control step, or averaged over a stride. A robot that fell counts as one that
stands still until the end of the walk, so that a walk does not become better by falling; one that
left the ground's edge counts until then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.utils.hooks import RemovableHandle

from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.network.policy_network import ACTIONS, PolicyNetwork
from pupper_sysid.policies.walks.together import Condition, Moment, StepRecorder, walk_together
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

Array = NDArray[np.float64]

Bools = NDArray[np.bool_]

ERRORS = ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")
"""Names of the three errors in results and files."""

STRIDE_ERRORS = tuple(f"stride_{name}" for name in ERRORS)
"""Names of the errors of the velocity averaged over a stride."""

_STRIDE_S = (0.2, 1.0)  # strides that are averaged over
_USUAL_STRIDE_S = 0.3  # of robots that take no steps


def counted(velocity: Array, alive: Bools, fell: Bools) -> tuple[Array, Bools]:
    """What counts of walks: velocities, 0 after a fall, and the steps that count.

    Velocities have the shape (steps, n, 3). `alive`, shape (steps, n), says whether the robot has
    neither fallen nor left the ground's edge so far; `fell`, shape (n,), whether it fell. The steps
    that count, shape (steps, n), are of each robot those up to some step.
    """
    return np.where(alive[..., None], velocity, 0.0), alive | fell


def tracking_errors(velocity: Array, command: Array, alive: Bools, fell: Bools) -> Array:
    """Mean absolute error of each robot at every control step, shape (n, 3).

    Commands have the shape (3,) or (steps, n, 3), the others are as `counted` takes them.
    """
    moved, counts = counted(velocity, alive, fell)
    error = (counts[..., None] * np.abs(moved - command)).sum(axis=0)
    return error / np.maximum(counts.sum(axis=0), 1)[:, None]


def stride_errors(
    velocity: Array, command: Array, alive: Bools, fell: Bools, stride_s: Array, step_s: float
) -> Array:
    """Mean absolute error of each robot's velocity over its stride, shape (n, 3).

    The mean over a stride of velocity minus command, its size then averaged over all strides that
    begin at some step of the walk. Velocity (steps, n, 3), command (3,) or (steps, n, 3), `alive`
    and `fell` are as `counted` takes them; the stride of each robot, shape (n,), is used within 0.2
    to 1 s, and is 0.3 s where it is not finite.
    """
    moved, counts = counted(velocity, alive, fell)
    error = counts[..., None] * (moved - command)
    total = np.concatenate([np.zeros_like(error[:1]), error.cumsum(axis=0)])
    length = counts.sum(axis=0)
    span = np.clip(np.where(np.isfinite(stride_s), stride_s, _USUAL_STRIDE_S), *_STRIDE_S)
    window = np.clip(np.rint(span / step_s).astype(int), 1, np.maximum(length, 1))
    begin = np.arange(len(error))[:, None]
    inside = begin + window <= length
    ends = np.minimum(begin + window, len(error))[..., None]
    mean = (np.take_along_axis(total, ends, axis=0) - total[:-1]) / window[:, None]
    errors = (inside[..., None] * np.abs(mean)).sum(axis=0)
    return errors / np.maximum(inside.sum(axis=0), 1)[:, None]


def pooled_errors(
    velocity: Array, command: Array, alive: Bools, fell: Bools, steps: int
) -> dict[str, float]:
    """Mean absolute errors by name, over all steps of all robots that count.

    Velocities, `alive` and `fell` are as `counted` takes them, until no robot was up any more;
    `steps` is the length of the whole walk: to its end, a robot that fell stands still.
    """
    moved, counts = counted(velocity, alive, fell)
    after = int(fell.sum()) * max(steps - len(velocity), 0)
    error = np.abs(moved - command)[counts].sum(axis=0) + after * np.abs(command)
    return named(error / max(int(counts.sum()) + after, 1))


def named(errors: Array) -> dict[str, float]:
    """Three errors by name."""
    return dict(zip(ERRORS, errors.tolist(), strict=True))


_LAST_ACTION = slice(-ACTIONS, None)  # of an observation


@dataclass(frozen=True)
class Rollout:
    """A walk of n robots under one command.

    Observation, action and hidden state belong to the start of a control step, all else to its
    end. Rows of a robot that is no longer `alive` are meaningless: it was reset.
    """

    step_s: float
    """Control step [s]."""
    command: tuple[float, float, float]
    """Forward and sideways speed [m/s], turn rate [rad/s]."""
    action_scale: float
    """Radians per unit of action."""
    observation: NDArray[np.float32]
    """As given to the policy, changes included; shape (steps, n, 60), or (steps, 0, 60) of
    lean rollouts."""
    action: NDArray[np.float32]
    """Raw outputs of the policy; shape (steps, n, 12)."""
    hidden: NDArray[np.float32]
    """LSTM: cell; GRU: state; Transformer: latent; MLP: last hidden layer; shape (steps, n, k), or
    (steps, 0, k)."""
    joint_position: Array
    """True joint angles [rad], not readings; shape (steps, n, 12)."""
    contact: NDArray[np.bool_]
    """Which feet were on the ground; shape (steps, n, 4)."""
    velocity: Array
    """Forward and sideways speed in the trunk's frame [m/s], turn rate [rad/s]; shape (steps, n,
    3)."""
    position: Array
    """Trunk's x and y [m] and heading [rad, continuous] in the world; shape (steps, n, 3)."""
    alive: NDArray[np.bool_]
    """Whether the robot has neither fallen nor left the ground's edge so far; shape (steps, n)."""
    fell: NDArray[np.bool_]
    """Whether it fell; one that left the ground's edge did not; shape (n,)."""
    whole_steps: int = 0
    """Control steps of the whole walk, of which the last are missing if no robot was up."""

    @property
    def action_rad(self) -> Array:
        """Joint targets from the default pose [rad], before limits, shape (steps, n, 12)."""
        return self.action_scale * self.action.astype(float)


def collect(
    policy: Policy,
    servos: ServoRanges,
    conditions: Sequence[Condition],
    seconds: float,
    seed: int,
    threads: int = 0,
    progress: Callable[[float], None] = lambda share: None,
    lean: bool = False,
) -> list[Rollout]:
    """Walk from a gentle start under every condition, without pushes but those of a condition.

    Robot k of every rollout of one seed has the same servos, start and noise until one falls. Each
    condition has a command; a rollout ends sooner when no robot is up any more. Lean rollouts of
    altered walks lack observations and hidden states: of 16 robots over 10 s, 4 MB or more.
    """
    recorder = partial(_Recorder, lean=lean)
    return walk_together(policy, servos, conditions, seconds, seed, threads, recorder, progress)


class _Recorder(StepRecorder[Rollout]):
    """Rollouts of one environment."""

    def __init__(
        self, env: PupperEnv, policy: Policy | None, conditions: Sequence[Condition], lean: bool
    ):
        assert policy is not None
        super().__init__(env, policy, conditions)
        records_all = [not (lean and (c.change or c.disturb)) for c in conditions]
        self._recorded = np.flatnonzero(np.repeat(records_all, [c.robots for c in conditions]))
        self._seen: list[NDArray[np.float32]] = []
        self._hidden: list[NDArray[np.float32]] = []
        _listen(policy.network, lambda state: self._hidden.append(state.numpy()[self._recorded]))

    def arrays(self, now: Moment) -> dict[str, NDArray]:
        qpos = self.env.robots.qpos
        self._seen.append(now.observation[self._recorded].astype(np.float32))
        return {
            "action": now.action, "contact": now.facts.contact, "alive": now.alive,
            "joint_position": now.facts.position_relative + self.env.default,
            "velocity": now.facts.planar_velocity,
            "position": np.column_stack([qpos[:, :2], heading(qpos)]),
        }  # fmt: skip

    def of(self, condition: Condition, robots: slice, steps: int, commands: Array) -> Rollout:
        arrays = self.stacked(robots, steps)
        arrays["position"][..., 2] = np.unwrap(arrays["position"][..., 2], axis=0)
        inside = np.flatnonzero((self._recorded >= robots.start) & (self._recorded < robots.stop))
        for name, recorded in (("observation", self._seen), ("hidden", self._hidden)):
            arrays[name] = np.stack([step[inside] for step in recorded[:steps]])
        task, command = condition.task, condition.command
        assert command is not None
        arrays["fell"] = self.fell[robots]
        whole = len(commands)
        return Rollout(task.control_step_s, command, task.action_scale, **arrays, whole_steps=whole)


def replay(
    policy: Policy, observations: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Actions and hidden states of a policy on recorded observations, in open loop.

    Starts as at the start of an episode; a policy that sees its past actions begins with the one in
    the first observation for all of them, and continues with its own.

    The policy keeps its own state. Observations have the shape (steps, n, 60). Actions have the
    shape (steps, n, 12), hidden states (steps, n, k); see `Rollout`.
    """
    hidden: list[NDArray[np.float32]] = []
    handle = _listen(policy.network, lambda state: hidden.append(state.numpy().copy()))
    player = copy(policy)  # a policy replaces its state and never writes into it
    try:
        player.reset(observations[0][:, _LAST_ACTION])
        actions = [player.act(row) for row in observations]
    finally:
        handle.remove()
    return np.array(actions), np.array(hidden)


def _listen(network: PolicyNetwork, keep: Callable[[torch.Tensor], None]) -> RemovableHandle:
    """Call `keep` with the hidden state, shape (n, k), each time the network runs."""
    if network.kind in ("lstm", "gru"):

        def of_memory(_: nn.Module, inputs: tuple, outputs: tuple) -> None:
            state = outputs[1][1] if network.kind == "lstm" else outputs[1]
            keep(state[0])

        return network.rnn["rnn"].register_forward_hook(of_memory)
    # a Transformer's latent enters its head; an MLP's last hidden layer enters its output layer
    reader = network.mlp if network.kind == "transformer" else network.mlp[-1]
    return reader.register_forward_pre_hook(lambda _, inputs: keep(inputs[0]))


def heading(qpos: Array) -> Array:
    """Heading of each trunk [rad], shape (n,)."""
    w, x, y, z = qpos[:, 3:7].T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
