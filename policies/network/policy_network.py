"""PolicyNetwork: a trained policy without its trainer, for playing, deploying and exporting.

Maps observation and state to action and state, and keeps no state inside. It takes the weights of
rsl_rl's models under their own names and computes the same (a test compares the two), but needs
torch only; ONNX and TorchScript files are made from it.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn

ACTIONS = 12
CONTEXT = 16  # observations that a Transformer sees
WIDTH, HEADS = 128, 4


class CausalAttention(nn.Module):
    """One pre-norm layer of multi-head attention and a feed-forward part, banded and causal.

    It attends to the last `CONTEXT` observations of the episode. With one layer, an output depends
    on exactly those, so that a pass over a sequence (each step attends to the band of 16 before it)
    and a window per step give the same. The state between steps is the last 15 raw observations and
    a flag for each; an empty place is never attended to. `size` is that of an observation.
    """

    def __init__(self, size: int):
        super().__init__()
        width, heads = WIDTH, HEADS
        self.embed = nn.Linear(size, width)
        # bias per head and age in steps: positions are relative, so that a sequence and a window
        # give the same
        self.age_bias = nn.Parameter(torch.zeros(heads, CONTEXT))
        self.before_attention = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.merge = nn.Linear(width, width)
        self.before_feed_forward = nn.LayerNorm(width)
        self.feed_forward = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width)
        )
        self.final = nn.LayerNorm(width)

    def forward(self, tokens: torch.Tensor, present: torch.Tensor, last: int) -> torch.Tensor:
        """Latents of the last `last` steps, shape (batch, last, width).

        `tokens` are normalised observations, oldest first, shape (batch, steps, size); `present`,
        shape (batch, steps), says which of them belong to the episode.
        """
        batch, steps, _ = tokens.shape
        x = self.embed(tokens)
        q, k, v = self.query_key_value(self.before_attention(x)).chunk(3, dim=-1)

        def split(t: torch.Tensor) -> torch.Tensor:
            return t.reshape(batch, -1, HEADS, WIDTH // HEADS).transpose(1, 2)

        q = q[:, steps - last :]
        age = (
            torch.arange(steps - last, steps, device=x.device)[:, None]
            - torch.arange(steps, device=x.device)[None, :]
        )
        inside = (age >= 0) & (age < CONTEXT)
        bias = self.age_bias[:, age.clamp(0, CONTEXT - 1)]
        allowed = inside[None, None] & present[:, None, None, :]
        # a step always attends to itself, or padding would divide by zero
        allowed = allowed | (age == 0)[None, None]
        mask = torch.where(allowed, bias[None], torch.full_like(bias[None], -1e9))
        mixed = nn.functional.scaled_dot_product_attention(split(q), split(k), split(v), mask)
        x = x[:, steps - last :] + self.merge(mixed.transpose(1, 2).reshape(batch, last, -1))
        x = x + self.feed_forward(self.before_feed_forward(x))
        return self.final(x)


def step(
    attention: CausalAttention, normalise: nn.Module, raw: torch.Tensor, context: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Latent of one more observation, shape (n, width), and the context after it."""
    now = torch.cat([raw, torch.ones_like(raw[:, :1])], dim=1)
    window = torch.cat([context, now[None]], dim=0)
    rows = window.transpose(0, 1)
    latent = attention(normalise(rows[..., :-1]), rows[..., -1] > 0.5, 1)
    return latent[:, 0], window[1:]


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

    `observation_size` includes past actions; `hidden` are the units of the head's layers, `memory`
    those of an LSTM or GRU, `actions` the joints with a servo.
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
        """One step: actions, shape (n, 12), and the parts of the next state."""
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

        A missing one is a KeyError, one of another shape a RuntimeError.
        """
        self.load_state_dict({name: weights[name] for name in self.state_dict()})
        self.eval()
