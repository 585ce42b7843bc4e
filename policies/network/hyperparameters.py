"""Settings of policies and of their training, one table for all architectures; without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from pupper_sysid.common.errors import InputError

Kind = Literal["mlp", "lstm", "gru", "transformer", "mlp-actions"]


@dataclass(frozen=True)
class Architecture:
    """Kind and size of a policy."""

    kind: Annotated[Kind, tyro.conf.Suppress] = "mlp"
    """Kind of network; `--policy` sets it."""
    hidden: tuple[int, ...] = (256, 128, 64)
    """Units of the layers of the head (of the MLP)."""
    memory: int = 128
    """Units of an LSTM or GRU."""
    critic_hidden: tuple[int, ...] = (256, 128, 64)
    """Units of the layers of the critic."""
    privileged_critic: bool = True
    """Whether the critic has the true state beside the observation."""

    def __post_init__(self):
        for name in ("hidden", "critic_hidden"):
            if not getattr(self, name):
                raise InputError(f"architecture.{name} is empty; give the units of each layer.")
        if min(*self.hidden, *self.critic_hidden, self.memory) < 1:
            raise InputError("A layer of the architecture has no units; each needs at least 1.")


@dataclass(frozen=True)
class Hyperparameters:
    """Of PPO; the same table for all architectures."""

    steps_per_environment: int = 24
    """Control steps between two updates."""
    epochs: int = 4
    """Passes over the data of an update."""
    minibatches: int = 4
    """Parts of the data per pass."""
    learning_rate: float = 1e-5
    """At the start, small enough to keep an imitated gait; then adapted to the KL divergence."""
    desired_kl: float = 0.01
    """KL divergence per update that the learning rate aims at."""
    discount: float = 0.99
    """γ."""
    gae_lambda: float = 0.95
    """λ of the generalised advantage estimate."""
    clip: float = 0.2
    """Of the probability ratio and of the change of the value."""
    entropy: float = 0.0005
    """Weight of the entropy."""
    value_weight: float = 0.5
    """Weight of the value's error."""
    gradient_norm: float = 1.0
    """Largest norm of a gradient."""
    initial_std: float = 0.015
    """Standard deviation of the actions at the start. Larger noise shakes dry friction in the
    servos loose: the policy would learn to walk on servos without it."""
    normalise: bool = True
    """Whether observations are normalised by their running mean and deviation."""
    mixed_precision: bool = False
    """Whether updates are computed in bfloat16; worth it where the processor has it (avx512_bf16,
    amx)."""

    def __post_init__(self):
        for name in ("steps_per_environment", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise InputError(f"learner.{name} is {getattr(self, name)}; it must be at least 1.")


@dataclass(frozen=True)
class Imitation:
    """Settings of the first gait's imitation."""

    iterations: int = 80
    """Rounds; 0 to start PPO from random weights."""
    epochs: int = 12
    """Passes over the data of a round."""
    minibatches: int = 16
    """Parts of the data per pass."""
    learning_rate: float = 1e-3
    """Of Adam, at the start; it falls to a tenth."""

    def __post_init__(self):
        for name, least in (("iterations", 0), ("epochs", 1), ("minibatches", 1)):
            if getattr(self, name) < least:
                raise InputError(
                    f"imitation.{name} is {getattr(self, name)}; it must be at least {least}."
                )
