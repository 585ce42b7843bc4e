"""A Transformer policy with a context of 16 steps, trained on whole sequences.

One layer of causal attention over the last `CONTEXT` observations of the episode. With one layer,
an output depends on exactly those observations, so the update runs one pass over a rollout (each
step attends to the band of 16 before it) instead of one window per sample, at a tenth of the cost.
Rollout and update have the same window, which ends on the present observation and begins not before
the episode.

The state between steps is the last 15 raw observations and a flag for each; an empty place is never
attended to.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import unpad_trajectories
from tensordict import TensorDict
from torch import nn

CONTEXT = 16
WIDTH, HEADS = 128, 4


class CausalAttention(nn.Module):
    """One pre-norm layer of multi-head attention and a feed-forward part, banded and causal.

    Parameters
    ----------
    size : int
        Numbers per observation.
    width, heads : int
        Of the layer.
    """

    def __init__(self, size: int, width: int = WIDTH, heads: int = HEADS):
        super().__init__()
        self.heads, self.width = heads, width
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
        """Latents of the last `last` steps.

        Parameters
        ----------
        tokens : tensor, shape (batch, steps, size)
            Normalised observations, oldest first.
        present : tensor of bool, shape (batch, steps)
            Which of them belong to the episode.
        last : int

        Returns
        -------
        tensor, shape (batch, last, width)
        """
        batch, steps, _ = tokens.shape
        x = self.embed(tokens)
        q, k, v = self.query_key_value(self.before_attention(x)).chunk(3, dim=-1)

        def split(t: torch.Tensor) -> torch.Tensor:
            return t.reshape(batch, -1, self.heads, self.width // self.heads).transpose(1, 2)

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


class TransformerModel(MLPModel):
    """Actor of rsl_rl with `CausalAttention` before the head."""

    is_recurrent = True

    def __init__(
        self, obs: TensorDict, obs_groups: dict, obs_set: str, output_dim: int, **more: Any
    ):
        super().__init__(obs, obs_groups, obs_set, output_dim, **more)
        self.attention = CausalAttention(self.obs_dim)
        self._context: torch.Tensor | None = None  # (CONTEXT - 1, n, obs_dim + 1)

    def _get_latent_dim(self) -> int:
        return WIDTH

    def get_latent(
        self, obs: TensorDict, masks: torch.Tensor | None = None, hidden_state: Any = None
    ) -> torch.Tensor:
        """Latent of the present step, or of all steps of padded trajectories."""
        raw = torch.cat([obs[group] for group in self.obs_groups], dim=-1)
        if masks is None:
            if self._context is None:
                self._context = empty_context(len(raw), self.obs_dim, raw)
            latent, self._context = step(self.attention, self.obs_normalizer, raw, self._context)
            return latent
        if hidden_state is None:
            raise ValueError("The context before each trajectory is needed in an update.")
        before = hidden_state.transpose(0, 1)
        tokens = torch.cat([before[..., :-1], raw.transpose(0, 1)], dim=1)
        present = torch.cat([before[..., -1] > 0.5, masks.transpose(0, 1)], dim=1)
        latent = self.attention(self.obs_normalizer(tokens), present, raw.shape[0])
        return unpad_trajectories(latent.transpose(0, 1), masks)

    def reset(self, dones: torch.Tensor | None = None, hidden_state: Any = None) -> None:
        """Clear the context of all robots, or of those whose episodes ended."""
        if dones is None:
            self._context = hidden_state
        elif self._context is not None:
            self._context = self._context.clone()
            self._context[:, dones.bool()] = 0.0

    def get_hidden_state(self) -> Any:
        """The observations before the next one."""
        return self._context

    def detach_hidden_state(self, dones: torch.Tensor | None = None) -> None:
        """Nothing to do: the context holds observations, not results."""


def empty_context(count: int, size: int, like: torch.Tensor) -> torch.Tensor:
    """State before an episode's first step, shape (CONTEXT - 1, count, size + 1)."""
    return torch.zeros(CONTEXT - 1, count, size + 1, device=like.device)


def step(
    attention: CausalAttention, normalise: nn.Module, raw: torch.Tensor, context: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Latent of one more observation, shape (n, width), and the context after it."""
    now = torch.cat([raw, torch.ones_like(raw[:, :1])], dim=1)
    whole = torch.cat([context, now[None]], dim=0)
    rows = whole.transpose(0, 1)
    latent = attention(normalise(rows[..., :-1]), rows[..., -1] > 0.5, 1)
    return latent[:, 0], whole[1:]
