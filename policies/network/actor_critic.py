"""Actor and critic of each architecture, for rsl_rl.

The critic is an MLP for all of them, so that they differ in the policy alone.
"""

from __future__ import annotations

from typing import Any

from rsl_rl.models import MLPModel, RNNModel
from tensordict import TensorDict

from pupper_sysid.policies.network.hyperparameters import Architecture, Hyperparameters
from pupper_sysid.policies.network.transformer import TransformerModel


def build(
    architecture: Architecture, observations: TensorDict, hyper: Hyperparameters
) -> tuple[MLPModel, MLPModel]:
    """Actor and critic.

    Parameters
    ----------
    architecture : Architecture
    observations : TensorDict
        An example, for the sizes.
    hyper : Hyperparameters
    """
    actor_groups = ["policy"]
    if architecture.kind == "mlp-actions":
        actor_groups.append("actions")
    critic_groups = ["policy"] + (["privileged"] if architecture.privileged_critic else [])
    groups = {"actor": actor_groups, "critic": critic_groups}
    common: dict[str, Any] = {"activation": "elu", "obs_normalization": hyper.normalise}
    gaussian = {
        "class_name": "GaussianDistribution", "init_std": hyper.initial_std, "std_type": "log",
    }  # fmt: skip
    own = common | {"hidden_dims": list(architecture.hidden), "distribution_cfg": gaussian}
    actions = 12
    if architecture.kind in ("lstm", "gru"):
        actor: MLPModel = RNNModel(
            observations, groups, "actor", actions, rnn_type=architecture.kind,
            rnn_hidden_dim=architecture.memory, **own,
        )  # fmt: skip
    elif architecture.kind == "transformer":
        actor = TransformerModel(observations, groups, "actor", actions, **own)
    else:
        actor = MLPModel(observations, groups, "actor", actions, **own)
    critic = MLPModel(
        observations, groups, "critic", 1, hidden_dims=list(architecture.critic_hidden), **common
    )
    return actor, critic
