"""Rollouts: observations, actions and hidden states of a policy while it walks, step by step.

`collect` runs a policy in the simulator under one command and records everything that the analyses
of gait and internal dynamics need; observations may be altered on the way (ablated, delayed,
frozen). `replay` feeds recorded observations to a policy in open loop. Neither changes the state of
the given policy, so a policy can be probed in the middle of a walk.

The hidden state is that of the published analyses: the cell of an LSTM, the state of a GRU, the
latent of a Transformer, the last hidden layer of an MLP.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.utils.hooks import RemovableHandle

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.analysis.evaluation import evaluation_task
from pupper_sysid.policies.analysis.tracking import planar_velocity
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.network.policy_network import ACTIONS, PolicyNetwork
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_model_of

Array = NDArray[np.float64]
Change = Callable[[int, NDArray[np.float32]], NDArray[np.floating]]
"""`change(step, observation)` returns the observation, shape (n, 60), for the policy; it may alter
the one it was given."""

Disturb = Callable[[int, PupperEnv], None]
"""`disturb(step, environment)` acts on the robots before their action, such as a push."""

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
    """As given to the policy, changes included; shape (steps, n, 60)."""
    action: NDArray[np.float32]
    """Raw outputs of the policy; shape (steps, n, 12)."""
    hidden: NDArray[np.float32]
    """LSTM: cell; GRU: state; Transformer: latent; MLP: last hidden layer; shape (steps, n, k)."""
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

    @property
    def action_rad(self) -> Array:
        """Joint targets from the default pose [rad], before limits, shape (steps, n, 12)."""
        return self.action_scale * self.action.astype(float)


def collect(
    policy: Policy,
    task: Walking,
    servos: ServoRanges,
    command: tuple[float, float, float],
    robots: int,
    seconds: float,
    seed: int,
    threads: int = 0,
    change: Change | None = None,
    disturb: Disturb | None = None,
) -> Rollout:
    """Walk from a gentle start, without pushes but those of `disturb`.

    Rollouts of one seed have the same servos, ground, start and noise until a robot falls.

    Parameters
    ----------
    policy : Policy
        Keeps its own state.
    task : Walking
        Made gentle by `evaluation_task`.
    servos : ServoRanges
    command : (float, float, float)
        Forward and sideways speed [m/s], turn rate [rad/s].
    robots : int
    seconds : float
        Duration; a rollout ends sooner when no robot is up any more.
    seed, threads : int
    change : Change, optional
        Alters observations.
    disturb : Disturb, optional
        Acts on the robots.

    Raises
    ------
    InputError
        If `seconds` is shorter than a step, or the environment cannot be made.
    """
    step_s = task.control_step_s
    steps = round(seconds / step_s)
    if steps < 1:
        raise InputError(f"A rollout of {seconds} s is shorter than one step of {step_s} s.")
    # a step longer, so that no episode times out within it
    task = evaluation_task(task, (steps + 1) * step_s)
    env = PupperEnv(task, servos, robots, seed, threads, servo_model_of(servos.source, step_s))
    env.set_command(np.array(command))
    observation, _ = env.observe()
    alive = np.ones(robots, bool)
    seen, acted, joints, contact, velocity, position, lives = ([] for _ in range(7))
    with _observed(policy) as (own, hidden):
        own.reset(env.action)
        for step in range(steps):
            shown = observation if change is None else change(step, observation)
            action = own.act(shown)
            if disturb:
                disturb(step, env)
            found = env.step(action)
            observation, facts = found.observation, found.facts
            alive = alive & ~found.done
            seen.append(np.array(shown, np.float32))
            acted.append(action)
            joints.append(facts.position_relative + env.default)
            contact.append(facts.contact)
            velocity.append(planar_velocity(facts))
            position.append(np.column_stack([env.robots.qpos[:, :2], heading(env.robots.qpos)]))
            lives.append(alive)
            if not alive.any():
                break
    place = np.array(position)
    place[..., 2] = np.unwrap(place[..., 2], axis=0)
    return Rollout(
        step_s, command, task.action_scale, np.array(seen), np.array(acted), np.array(hidden),
        np.array(joints), np.array(contact), np.array(velocity), place, np.array(lives),
    )  # fmt: skip


def replay(
    policy: Policy, observations: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Actions and hidden states of a policy on recorded observations, in open loop.

    Starts as at the start of an episode; a policy that sees its past actions begins with the one in
    the first observation for all of them, and continues with its own.

    Parameters
    ----------
    policy : Policy
        Keeps its own state.
    observations : ndarray, shape (steps, n, 60)

    Returns
    -------
    actions : ndarray of float32, shape (steps, n, 12)
    hidden : ndarray of float32, shape (steps, n, k)
        See `Rollout`.
    """
    with _observed(policy) as (own, hidden):
        own.reset(observations[0][:, _LAST_ACTION])
        actions = [own.act(row) for row in observations]
    return np.array(actions), np.array(hidden)


@contextmanager
def _observed(policy: Policy) -> Iterator[tuple[Policy, list[NDArray[np.float32]]]]:
    """A copy of a policy with its own state, and the hidden states as it acts."""
    hidden: list[NDArray[np.float32]] = []

    def keep(state: torch.Tensor) -> None:
        hidden.append(state.numpy().copy())

    handle = _listen(policy.network, keep)
    try:
        # a policy replaces its state and never writes into it
        yield copy(policy), hidden
    finally:
        handle.remove()


def _listen(network: PolicyNetwork, keep: Callable[[torch.Tensor], None]) -> RemovableHandle:
    """Call `keep` with the hidden state, shape (n, k), each time the network runs."""
    if network.kind in ("lstm", "gru"):

        def of_memory(_: nn.Module, given: tuple, found: tuple) -> None:
            state = found[1][1] if network.kind == "lstm" else found[1]
            keep(state[0])

        return network.rnn["rnn"].register_forward_hook(of_memory)
    # a Transformer's latent enters its head; an MLP's last hidden layer enters its output layer
    reader = network.mlp if network.kind == "transformer" else network.mlp[-1]
    return reader.register_forward_pre_hook(lambda _, given: keep(given[0]))


def heading(qpos: Array) -> Array:
    """Heading of each trunk [rad], shape (n,)."""
    w, x, y, z = qpos[:, 3:7].T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
