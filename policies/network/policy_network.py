"""PolicyNetwork: a trained policy without its trainer, for playing, deploying and exporting.

Maps observation and state to action and state, and keeps no state inside. It takes the weights of
rsl_rl's models under their own names and computes the same (a test compares the two), but needs
torch only; ONNX and TorchScript files are made from it.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn

from pupper_sysid.policies.network.attention import CONTEXT, WIDTH, CausalAttention, step

ACTIONS = 12
_EPSILON = 1e-2  # of rsl_rl's normaliser


class Normaliser(nn.Module):
    """Running mean and deviation of observations, as rsl_rl keeps them."""

    _mean: torch.Tensor
    _std: torch.Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("_mean", torch.zeros(1, size))
        self.register_buffer("_std", torch.ones(1, size))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalised observations."""
        return (x - self._mean) / (self._std + _EPSILON)


class PolicyNetwork(nn.Module):
    """A policy of one of the kinds of `policies.network.actor_critic`.

    Parameters
    ----------
    kind : str
    observation_size : int
        Length of the observation, past actions included.
    hidden : sequence of int
        Units of the head's layers.
    memory : int
        Units of an LSTM or GRU.
    normalise : bool
    actions : int
        Joints with a servo.
    """

    def __init__(
        self,
        kind: str,
        observation_size: int,
        hidden: tuple[int, ...],
        memory: int,
        normalise: bool,
        actions: int = ACTIONS,
    ):
        super().__init__()
        self.kind, self.observation_size, self.memory = kind, observation_size, memory
        self.actions = actions
        self.obs_normalizer = Normaliser(observation_size) if normalise else nn.Identity()
        before = observation_size
        if kind in ("lstm", "gru"):
            cell = nn.LSTM if kind == "lstm" else nn.GRU
            self.rnn = nn.ModuleDict({"rnn": cell(observation_size, memory)})
            before = memory
        elif kind == "transformer":
            self.attention = CausalAttention(observation_size)
            before = WIDTH
        layers: list[nn.Module] = []
        for units in hidden:
            layers += [nn.Linear(before, units), nn.ELU()]
            before = units
        self.mlp = nn.Sequential(*layers, nn.Linear(before, actions))

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the parts of the state."""
        return {"lstm": ("h", "c"), "gru": ("h",), "transformer": ("context",)}.get(self.kind, ())

    def initial_state(self, count: int) -> tuple[torch.Tensor, ...]:
        """State at the start of an episode of `count` robots; all zeros."""
        if self.kind == "transformer":
            return (torch.zeros(CONTEXT - 1, count, self.observation_size + 1),)
        return tuple(torch.zeros(1, count, self.memory) for _ in self.state_names)

    def forward(self, observation: torch.Tensor, *state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """One step.

        Parameters
        ----------
        observation : tensor, shape (n, observation_size)
        *state : tensors
            As `initial_state` or the step before gave them.

        Returns
        -------
        action : tensor, shape (n, 12)
        *state : tensors
        """
        if self.kind == "transformer":
            latent, context = step(self.attention, self.obs_normalizer, observation, state[0])
            return self.mlp(latent), context
        x = self.obs_normalizer(observation)
        if self.kind == "lstm":
            y, (h, c) = self.rnn["rnn"](x[None], (state[0], state[1]))
            return self.mlp(y[0]), h, c
        if self.kind == "gru":
            y, h = self.rnn["rnn"](x[None], state[0])
            return self.mlp(y[0]), h
        return (self.mlp(x),)

    def take(self, weights: Mapping[str, torch.Tensor]) -> None:
        """Use the weights of an rsl_rl actor (its `state_dict`).

        Raises
        ------
        KeyError, RuntimeError
            If one is missing, or of another shape.
        """
        self.load_state_dict({name: weights[name] for name in self.state_dict()})
        self.eval()
