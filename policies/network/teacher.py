"""Actor of a teacher: a gait by a clock, with little besides that its network could follow.

A teacher learns from nothing, by PPO. Adam moves every weight about as far whether its gradient is
signal or noise, and PPO limits how far all of them together move the actions. So inputs that say
nothing about a gait cost most of what an update may change: with the 145 numbers that a critic sees
a teacher travelled after 1.4 million samples, with 19 of these after 0.5, and with the products of
command and clock after 0.4 (one run each).
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from pupper_sysid.policies.network.exploration import MLPActor
from pupper_sysid.sim.walking.observation import CLOCK_SEEN, OBSERVATION_PARTS

_SEEN = ("base_angular_velocity", "projected_gravity", "command")
_HARMONICS = torch.tensor([1.0, 2.0, 3.0])
"""Of the clock: feet rise and come down within a quarter of a cycle."""


class TeacherActor(MLPActor):
    """Network of a teacher.

    It sees rates and gravity as the IMU reads them, the command, the clock of its reward with two
    harmonics, and these times each part of the command; nothing of the joints. But for the clock
    it sees nothing that a policy does not: what it answers to can be imitated.
    """

    def get_latent(
        self, obs: TensorDict, masks: torch.Tensor | None = None, hidden_state: Any = None
    ) -> torch.Tensor:
        """Its inputs, normalised, shape (…, 34)."""
        return self.obs_normalizer(inputs(obs))

    def update_normalization(self, obs: TensorDict) -> None:
        """Take means and deviations of its inputs."""
        if self.obs_normalization:
            self.obs_normalizer.update(inputs(obs))  # pyright: ignore

    def _get_obs_dim(self, obs: TensorDict, obs_groups: dict, obs_set: str):
        return obs_groups[obs_set], inputs(obs).shape[-1]


def inputs(obs: TensorDict) -> torch.Tensor:
    """What a teacher sees of the groups `policy` and `privileged`, shape (…, 34)."""
    policy, privileged = obs["policy"], obs["privileged"]
    seen = [policy[..., OBSERVATION_PARTS[name]] for name in _SEEN]
    cos, sin, in_time = privileged[..., CLOCK_SEEN].split(1, -1)
    angles = torch.atan2(sin, cos) * _HARMONICS.to(sin.device)
    waves = torch.cat([torch.cos(angles), torch.sin(angles)], dim=-1)
    # a foot's stroke is its speed times a function of the clock: Raibert's rule
    strokes = (seen[-1][..., None] * waves[..., None, :]).flatten(-2)
    return torch.cat([*seen, in_time, waves, strokes], dim=-1)
