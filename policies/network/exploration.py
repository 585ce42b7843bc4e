"""Persistent exploration: noise that lasts over several control steps, with its exact likelihood.

White noise of a few milliradians stays within the dead band of a servo with dry friction, and
larger white noise shakes the friction loose, so that the policy would learn on another robot. Noise
that lasts moves the joint instead. It is an autoregressive process of first order: with network
output m, correlation c from step to step and standard deviation s,

    action = m + e,    e = c · e_before + √(1 − c²) · s · z,    z ~ N(0, 1)

so that, given the state and `e_before`, the action is Gaussian about m + c · e_before with standard
deviation √(1 − c²) · s. `e_before` is the observation group `noise`; it is known to the likelihood
and to the critic, and never enters the policy's network.

Where steps are to be found, white noise is better. The likelihood takes e from the step before as
it was, so a change of m counts as if it lasted as the noise does: filtered by 1 / (1 − c·z⁻¹). At
the 3.6 Hz of a trot, with a time constant of 0.15 s, the gradient of what a joint does within a
stride is then turned by 61 degrees of the stride and is a third as large, beside that of where the
joint is on average.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.utils import unpad_trajectories
from tensordict import TensorDict
from torch.distributions import Normal

from pupper_sysid.policies.network.transformer import TransformerModel


class PersistentGaussian(GaussianDistribution):
    """Gaussian of an action, given the noise of the step before.

    Parameters
    ----------
    output_dim : int
    correlation : float
        Of the noise from one step to the next; 0 is white noise.
    least_std : float
        Floor of the standard deviation.
    **more
        As for `GaussianDistribution`.

    Attributes
    ----------
    centre : Tensor, shape (…, output_dim)
        Output of the network, m.
    noise_before : Tensor, shape (…, output_dim)
        To be set before `update`.
    """

    def __init__(
        self, output_dim: int, correlation: float = 0.0, least_std: float = 1e-6, **more: Any
    ):
        super().__init__(output_dim, std_range=(least_std, 1e6), std_type="log", **more)
        self.correlation = correlation
        self.centre = self.noise_before = torch.zeros(0)

    def update(self, mlp_output: torch.Tensor) -> None:
        """Take the network's output."""
        self.centre = mlp_output
        mean = mlp_output + self.correlation * self.noise_before
        std = torch.exp(self.log_std_param.clamp(*self.log_std_range))
        self._distribution = Normal(mean, (1.0 - self.correlation**2) ** 0.5 * std)

    @property
    def whole_std(self) -> torch.Tensor:
        """Standard deviation of the noise itself, s, shape (output_dim,)."""
        return torch.exp(self.log_std_param.detach().clamp(*self.log_std_range))

    def set_std(self, std: torch.Tensor) -> None:
        """Set the noise's standard deviation, shape (output_dim,)."""
        self.log_std_param.data.copy_(torch.log(std))


class _Exploring(MLPModel):
    """Gives the noise of the step before to the distribution."""

    def forward(
        self,
        obs: TensorDict,
        masks: torch.Tensor | None = None,
        hidden_state: Any = None,
        stochastic_output: bool = False,
    ) -> torch.Tensor:
        """The action, or its mean without noise."""
        if stochastic_output:
            noise = obs["noise"]
            before = noise if masks is None else unpad_trajectories(noise, masks)
            assert isinstance(self.distribution, PersistentGaussian)
            self.distribution.noise_before = before
        return super().forward(obs, masks, hidden_state, stochastic_output)


class MLPActor(_Exploring):
    """Feed-forward policy."""


class RNNActor(_Exploring, RNNModel):
    """Policy with an LSTM or GRU."""


class TransformerActor(_Exploring, TransformerModel):
    """Policy that attends to its past observations."""
