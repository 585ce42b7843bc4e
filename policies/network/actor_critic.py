"""Actor and critic of each architecture, for rsl_rl, and the noise with which actors explore.

The critic is an MLP for all of them, so that they differ in the policy alone.

Actors explore by white noise: where steps are to be found, noise that lasts over half a stride is
credited with what it did in the other half.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.utils import unpad_trajectories
from tensordict import TensorDict
from torch.distributions import Normal

from pupper_sysid.policies.network.policy_network import CONTEXT, WIDTH, CausalAttention, step
from pupper_sysid.policies.train.run_file import Architecture, Hyperparameters
from pupper_sysid.sim.walking.step import CLOCK_SEEN, OBSERVATION_PARTS


class ActionNoise(GaussianDistribution):
    """Gaussian of an action about the network's output, `centre`.

    `least_std` is the floor of the standard deviation.
    """

    def __init__(self, output_dim: int, least_std: float = 1e-6, **more: Any):
        super().__init__(output_dim, std_range=(least_std, 1e6), std_type="log", **more)
        self.centre = torch.zeros(0)

    def update(self, mlp_output: torch.Tensor) -> None:
        """Take the network's output."""
        self.centre = mlp_output
        self._distribution = Normal(mlp_output, self.whole_std)

    @property
    def whole_std(self) -> torch.Tensor:
        """Standard deviation, shape (output_dim,)."""
        return torch.exp(self.log_std_param.clamp(*self.log_std_range))

    def set_std(self, std: torch.Tensor) -> None:
        """Set the noise's standard deviation, shape (output_dim,)."""
        self.log_std_param.data.copy_(torch.log(std))


class TransformerActor(MLPModel):
    """Policy that attends to its past observations, with `CausalAttention` before the head.

    An update runs one pass over whole sequences of a rollout instead of one window per sample, at a
    tenth of the cost. Rollout and update have the same window, which ends on the present
    observation and begins not before the episode.
    """

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
                size = CONTEXT - 1, len(raw), self.obs_dim + 1
                self._context = torch.zeros(size, device=raw.device)
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


_SEEN = ("base_angular_velocity", "projected_gravity", "command")
_HARMONICS = torch.tensor([1.0, 2.0, 3.0])
"""Of the clock: feet rise and come down within a quarter of a cycle."""


class TeacherActor(MLPModel):
    """Network of a teacher: a gait by a clock, with little besides that its network could follow.

    A teacher learns from nothing, by PPO. Adam moves every weight about as far whether its gradient
    is signal or noise, and PPO limits how far all of them together move the actions. So inputs that
    say nothing about a gait cost most of what an update may change: with the 145 numbers that a
    critic sees a teacher travelled after 1.4 million samples, with 19 of these after 0.5, and with
    the products of command and clock after 0.4 (one run each).

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


_FIRST_HEAD = 0.01  # factor on a policy's last weights (Andrychowicz et al., 2021)


def build(
    architecture: Architecture,
    observations: TensorDict,
    hyper: Hyperparameters,
    first_action: torch.Tensor | None = None,
) -> tuple[MLPModel, MLPModel]:
    """Actor and critic.

    `observations` are an example, for the sizes. `first_action`, shape (12,), is what the policy
    does at first, whatever it sees; by default 0, the default pose.
    """
    actor_groups = ["policy"]
    if architecture.kind == "mlp-actions":
        actor_groups.append("actions")
    if architecture.privileged_actor:
        actor_groups = ["policy", "privileged"]
    critic_groups = ["policy", "noise"]
    if architecture.privileged_critic:
        critic_groups.append("privileged")
    groups = {"actor": actor_groups, "critic": critic_groups}
    common: dict[str, Any] = {"activation": "elu", "obs_normalization": hyper.normalise}
    explore = hyper.exploration
    gaussian = {
        "class_name": ActionNoise, "init_std": explore.std[0],
        "least_std": explore.std[1] if explore.learned else 1e-6, "learn_std": explore.learned,
    }  # fmt: skip
    of_actor = common | {"hidden_dims": list(architecture.hidden), "distribution_cfg": gaussian}
    actions = observations["noise"].shape[-1]
    if architecture.kind in ("lstm", "gru"):
        actor: MLPModel = RNNModel(
            observations, groups, "actor", actions, rnn_type=architecture.kind,
            rnn_hidden_dim=architecture.memory, **of_actor,
        )  # fmt: skip
    elif architecture.kind == "transformer":
        actor = TransformerActor(observations, groups, "actor", actions, **of_actor)
    else:
        network = TeacherActor if architecture.privileged_actor else MLPModel
        actor = network(observations, groups, "actor", actions, **of_actor)
    # the first policy stands; another wide one would swing through its last action, and fast
    head = [layer for layer in actor.mlp if isinstance(layer, torch.nn.Linear)][-1]
    with torch.no_grad():
        head.weight.mul_(_FIRST_HEAD)
        head.bias.copy_(torch.zeros(actions) if first_action is None else first_action)
    critic = MLPModel(
        observations, groups, "critic", 1, hidden_dims=list(architecture.critic_hidden), **common
    )
    return actor, critic
