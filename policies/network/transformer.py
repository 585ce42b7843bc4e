"""A Transformer policy for rsl_rl, trained on whole sequences.

An update runs one pass over a rollout instead of one window per sample, at a tenth of the cost; see
`policies.network.attention`. Rollout and update have the same window, which ends on the present
observation and begins not before the episode.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import unpad_trajectories
from tensordict import TensorDict

from pupper_sysid.policies.network.attention import WIDTH, CausalAttention, empty_context, step


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
