"""Attention over the last 16 observations: the network of a Transformer policy, torch only.

One layer of causal attention over the last `CONTEXT` observations of the episode. With one layer,
an output depends on exactly those observations, so that a pass over a sequence (each step attends
to the band of 16 before it) and a window per step give the same.

The state between steps is the last 15 raw observations and a flag for each; an empty place is never
attended to.
"""

from __future__ import annotations

import torch
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
