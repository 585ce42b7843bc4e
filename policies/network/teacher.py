"""Actor of a teacher: a gait by a clock, with little besides that its network could follow.

A teacher learns from nothing, by PPO. Adam moves every weight about as far whether its gradient is
signal or noise, and PPO limits how far all of them together move the actions. So inputs that say
nothing about a gait cost most of what an update may change: with the 145 numbers that a critic sees
a teacher travelled after 1.4 million samples, with these 19 after half a million ("What it took" in
`benchmarks/README.md`).
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from pupper_sysid.policies.network.exploration import MLPActor
from pupper_sysid.sim.walking.observation import OBSERVATION_PARTS, PRIVILEGED_PARTS

_SEEN = ("base_angular_velocity", "projected_gravity", "command")
_TRUE = ("base_linear_velocity", "clock")
_HARMONICS = (2, 3)
"""Of the clock, beside the first: feet rise and come down within a quarter of a cycle."""


class TeacherActor(MLPActor):
    """Network of a teacher.

    It sees rates and gravity as the IMU reads them, the command, the trunk's true speed, and the
    clock of its reward with two harmonics; nothing of the joints.
    """

    def get_latent(
        self, obs: TensorDict, masks: torch.Tensor | None = None, hidden_state: Any = None
    ) -> torch.Tensor:
        """Its inputs, normalised, shape (…, 19)."""
        return self.obs_normalizer(inputs(obs))

    def update_normalization(self, obs: TensorDict) -> None:
        """Take means and deviations of its inputs."""
        if self.obs_normalization:
            self.obs_normalizer.update(inputs(obs))  # pyright: ignore

    def _get_obs_dim(self, obs: TensorDict, obs_groups: dict, obs_set: str):
        return obs_groups[obs_set], inputs(obs).shape[-1]


def inputs(obs: TensorDict) -> torch.Tensor:
    """What a teacher sees of the groups `policy` and `privileged`, shape (…, 19)."""
    parts = [obs["policy"][..., OBSERVATION_PARTS[name]] for name in _SEEN]
    parts += [obs["privileged"][..., PRIVILEGED_PARTS[name]] for name in _TRUE]
    phase = torch.atan2(parts[-1][..., 1:2], parts[-1][..., :1])
    angles = torch.cat([k * phase for k in _HARMONICS], dim=-1)
    return torch.cat([*parts, torch.cos(angles), torch.sin(angles)], dim=-1)
