"""Actor and critic of each architecture, for rsl_rl.

The critic is an MLP for all of them, so that they differ in the policy alone.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from pupper_sysid.policies.network.exploration import (
    MLPActor,
    PersistentGaussian,
    RNNActor,
    TransformerActor,
)
from pupper_sysid.policies.network.hyperparameters import Architecture, Hyperparameters
from pupper_sysid.policies.network.teacher import TeacherActor

_FIRST_HEAD = 0.01  # factor on a policy's last weights (Andrychowicz et al., 2021)


def build(
    architecture: Architecture,
    observations: TensorDict,
    hyper: Hyperparameters,
    control_step_s: float,
    first_action: torch.Tensor | None = None,
) -> tuple[MLPModel, MLPModel]:
    """Actor and critic.

    Parameters
    ----------
    architecture : Architecture
    observations : TensorDict
        An example, for the sizes.
    hyper : Hyperparameters
    control_step_s : float
        Time between two actions, over which the noise of exploration decays.
    first_action : Tensor, shape (12,), optional
        What the policy does at first, whatever it sees; by default 0, the default pose.
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
        "class_name": PersistentGaussian, "init_std": explore.std[0],
        "least_std": explore.std[1] if explore.learned else 1e-6, "learn_std": explore.learned,
        "correlation": explore.correlation(control_step_s),
    }  # fmt: skip
    own = common | {"hidden_dims": list(architecture.hidden), "distribution_cfg": gaussian}
    actions = observations["noise"].shape[-1]
    if architecture.kind in ("lstm", "gru"):
        actor: MLPModel = RNNActor(
            observations, groups, "actor", actions, rnn_type=architecture.kind,
            rnn_hidden_dim=architecture.memory, **own,
        )  # fmt: skip
    elif architecture.kind == "transformer":
        actor = TransformerActor(observations, groups, "actor", actions, **own)
    else:
        network = TeacherActor if architecture.privileged_actor else MLPActor
        actor = network(observations, groups, "actor", actions, **own)
    # the first policy stands; another wide one would swing through its last action, and fast
    head = [layer for layer in actor.mlp if isinstance(layer, torch.nn.Linear)][-1]
    with torch.no_grad():
        head.weight.mul_(_FIRST_HEAD)
        head.bias.copy_(torch.zeros(actions) if first_action is None else first_action)
    critic = MLPModel(
        observations, groups, "critic", 1, hidden_dims=list(architecture.critic_hidden), **common
    )
    return actor, critic
