"""Held feedback for a simulator on torch (`servo_models.held_feedback`): stale, quantised, biased.

    feedback = HeldFeedback(FEEDBACK, joint_names, num_envs, physics_dt, device)
    feedback.reset(joint_positions)                 # at an episode's start; env_ids for some
    reading = feedback.step(joint_positions)        # after every physics step

Give the readings to the policy in place of the joint positions, and take velocities from
differences of readings: such servos measure none. `pupper-sysid export` copies the class into its
files, so it needs nothing but torch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch


class HeldFeedback:
    """Held readings of many robots at once.

    Parameters
    ----------
    feedback : dict of joint name to dict
        `poll_period_s`, `loss`, `quantum_rad` and `offset_rad` of each joint. The offset, an error
        of the joint's zero, is 0 unless you give one: that of a recording is not the servo's.
    joint_names : sequence of str
        Order of the columns of what `step` is given.
    num_envs : int
    physics_dt : float
        Time between two calls of `step` [s].
    device : str
    generator : torch.Generator, optional
        Decides phases and lost polls.
    """

    def __init__(
        self,
        feedback: Mapping[str, Mapping[str, float]],
        joint_names: Sequence[str],
        num_envs: int,
        physics_dt: float,
        device: str = "cpu",
        generator: torch.Generator | None = None,
    ):
        def column(key: str) -> torch.Tensor:
            return torch.tensor([feedback[name][key] for name in joint_names], device=device)

        self.period, self.loss = column("poll_period_s"), column("loss")
        self.quantum, self.offset = column("quantum_rad"), column("offset_rad")
        self.physics_dt, self.generator = physics_dt, generator
        shape = (num_envs, len(joint_names))
        self.left = torch.zeros(shape, device=device)
        self.reading = torch.zeros(shape, device=device)

    def reset(self, position: torch.Tensor, env_ids: torch.Tensor | slice = slice(None)) -> None:
        """Begin at rest at `position`, shape (all environments, joints), with a new phase."""
        robots, joints = self.left[env_ids].shape
        first = torch.rand(robots, 1, device=position.device, generator=self.generator)
        turn = torch.arange(joints, device=position.device) / joints
        self.left[env_ids] = (first + turn) % 1.0 * self.period
        self.reading[env_ids] = self._reported(position)[env_ids]

    def step(self, position: torch.Tensor) -> torch.Tensor:
        """Readings after one physics step that ended at `position`; both (environments, joints)."""
        self.left -= self.physics_dt
        due = self.left <= 0
        draw = torch.rand(position.shape, device=position.device, generator=self.generator)
        fresh = due & (draw >= self.loss)
        self.reading = torch.where(fresh, self._reported(position), self.reading)
        # a period shorter than a step, or 0, is due in every step
        self.left = torch.where(due, (self.left + self.period).clamp(min=0), self.left)
        return self.reading.clone()

    def _reported(self, position: torch.Tensor) -> torch.Tensor:
        counts = (position + self.offset) / self.quantum.clamp(min=1e-12)
        coarse = torch.round(counts) * self.quantum
        return torch.where(self.quantum > 0, coarse, position + self.offset)
