"""Settings of policies and of their training, one table for all architectures; without torch."""

from __future__ import annotations

from dataclasses import dataclass, field
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
    privileged_actor: bool = False
    """Whether the policy acts by the clock of the reward and sees, besides, its command, the IMU
    and the trunk's true speed alone: a teacher, which no robot can follow, for policies that can
    (`--start scratch`)."""

    def __post_init__(self):
        for name in ("hidden", "critic_hidden"):
            if not getattr(self, name):
                raise InputError(f"architecture.{name} is empty; give the units of each layer.")
        if min(*self.hidden, *self.critic_hidden, self.memory) < 1:
            raise InputError("A layer of the architecture has no units; each needs at least 1.")
        if self.privileged_actor and self.kind != "mlp":
            raise InputError(
                f"A teacher is an MLP, not a policy of kind {self.kind}. What learns from it "
                "can be of any kind."
            )


@dataclass(frozen=True)
class Exploration:
    """Noise of the actions while a policy learns."""

    std: tuple[float, float] = (0.05, 0.04)
    """Standard deviation at the start and at the end; 1 is `action_scale` radians. A learned one
    starts at the first and never falls below the second."""
    anneal_m_samples: tuple[float, float] = (0.0, 20.0)
    """Millions of samples between which it falls, by equal factors."""
    by_dead_band: bool = True
    """Whether joints of larger dead band (friction over stiffness) get more noise in proportion."""
    learned: bool = False
    """Whether the standard deviation is learned instead of scheduled, as published."""

    def __post_init__(self):
        if not min(self.std) > 0:
            raise InputError("learner.exploration.std must be positive.")

    def std_at(self, samples: float) -> float:
        """Scheduled standard deviation after so many samples."""
        (first, last), (begin, end) = self.std, self.anneal_m_samples
        share = (1e-6 * samples - begin) / max(end - begin, 1e-9)
        return first * (last / first) ** min(max(share, 0.0), 1.0)


@dataclass(frozen=True)
class Hyperparameters:
    """Of PPO; the same table for all architectures."""

    steps_per_environment: int = 24
    """Control steps between two updates."""
    epochs: int = 4
    """Passes over the data of an update."""
    minibatches: int = 4
    """Parts of the data per pass."""
    learning_rate: float = 1e-6
    """Of the policy, at the start; then adapted to the KL divergence."""
    learning_rates: tuple[float, float] = (1e-7, 1e-3)
    """Smallest and largest learning rate of the policy."""
    critic_learning_rate: float = 1e-3
    """Of the critic."""
    desired_kl: float = 0.01
    """KL divergence per update that the policy's learning rate aims at, of actions given the noise
    before."""
    critic_warmup: int = 0
    """First updates in which only the critic learns."""
    discount: float = 0.99
    """γ."""
    gae_lambda: float = 0.95
    """λ of the generalised advantage estimate."""
    clip: float = 0.2
    """Of the probability ratio and of the change of the value."""
    entropy: float = 0.0
    """Weight of the entropy; without effect unless the standard deviation is learned."""
    value_weight: float = 0.5
    """Weight of the value's error."""
    gradient_norm: float = 1.0
    """Largest norm of a gradient."""
    exploration: Exploration = field(default_factory=Exploration)
    mirror: bool = False
    """Whether every sample is also learned from as its mirror image, left for right; for policies
    without a memory."""
    normalise: bool = True
    """Whether observations are normalised by their running mean and deviation."""
    freeze_normaliser: bool = False
    """Whether that mean and deviation stay what they were at the start of PPO."""
    mixed_precision: bool = False
    """Whether updates are computed in bfloat16; worth it where the processor has it (avx512_bf16,
    amx)."""
    averaging: int = 1
    """Updates over which the weights of the policy that is judged and saved are averaged
    (exponentially), which smooths out the noise of single updates; 1 for the last ones."""

    def __post_init__(self):
        for name in ("steps_per_environment", "epochs", "minibatches", "averaging"):
            if getattr(self, name) < 1:
                raise InputError(f"learner.{name} is {getattr(self, name)}; it must be at least 1.")


TROT, OWN = "trot", "own"


@dataclass(frozen=True)
class Imitation:
    """Settings of the first gait's imitation."""

    iterations: int = 12
    """Rounds; 0 to start PPO from random weights."""
    teacher: str = TROT
    """`trot`: the open-loop trot; `own`: one that is trained from nothing first, in the run's
    folder `teacher/`; or the folder of a run of `--start teacher`."""
    rollouts: int = 5
    """Rollouts per round, each of as many steps as one of PPO."""
    epochs: int = 10
    """Passes over the data of a round."""
    minibatches: int = 16
    """Parts of each rollout per pass."""
    learning_rate: float = 1e-2
    """Of Muon (matrices) and Adam (biases) at the start; it falls to 0 with the last step."""
    correction_rate: float = 0.3
    """Share of the policy's errors of speed by which the teacher's commands change per round, in
    the second half of the rounds."""

    def __post_init__(self):
        least = {"iterations": 0, "rollouts": 1, "epochs": 1, "minibatches": 1}
        for name in least:
            if getattr(self, name) < least[name]:
                raise InputError(
                    f"imitation.{name} is {getattr(self, name)}; it must be at least {least[name]}."
                )
