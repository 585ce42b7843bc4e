"""Servos' commands and readings for a simulator on torch, of many robots at once.

    set_point = SetPoint(SERVOS, joint_names, num_envs, physics_dt, device)
    set_point.reset(joint_positions)                # at an episode's start; env_ids for some
    target = set_point.step(commands)               # before every physics step

    feedback = HeldFeedback(FEEDBACK, joint_names, num_envs, physics_dt, device)
    feedback.reset(joint_positions)
    reading = feedback.step(joint_positions)        # after every physics step

`SetPoint` is what the position loops follow: each command after its dead time, which is any
fraction of a physics step, at the speed that the servo allows. `HeldFeedback` is what a policy may
see: readings that are stale, lost at times, and quantised; take velocities from differences of
readings, since such servos measure none (`servo_models.held_feedback`).

`pupper-sysid export` copies both classes into its files, so they need nothing but torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch


class SetPoint:
    """Set-points of many robots' position loops: commands after their dead time, at limited speed.

    A command that changes on physics steps and takes effect within one is the mean of the two
    commands over that step. With a jitter every command has a latency of its own, and none
    overtakes the one before it.

    `servos` has, by joint, `dead_time_s`, `jitter_s` (standard deviation of the latency, part of
    the dead time) and `velocity_limit_rad_s`; `joint_names` is the order of the columns of what
    `step` is given, every `physics_dt` [s]; `generator` decides the latencies.
    """

    def __init__(
        self,
        servos: Mapping[str, Mapping[str, float]],
        joint_names: Sequence[str],
        num_envs: int,
        physics_dt: float,
        device: str = "cpu",
        generator: torch.Generator | None = None,
    ):
        def column(key: str) -> torch.Tensor:
            return torch.tensor([servos[name][key] for name in joint_names], device=device)

        self.dead_time, self.jitter = column("dead_time_s"), column("jitter_s")
        self.jitter = torch.minimum(self.jitter, self.dead_time)  # its mean is in the dead time
        self.slew = column("velocity_limit_rad_s") * physics_dt
        self.physics_dt, self.generator = physics_dt, generator
        self.longest = self.dead_time + 7 * self.jitter  # an exponential is longer once in 3,000
        slots = math.ceil(float(self.longest.max()) / physics_dt) + 2
        shape = (num_envs, len(joint_names))
        self.last = torch.zeros(shape, device=device)
        self.target = torch.zeros(shape, device=device)
        self.value = torch.zeros((*shape, slots), device=device)  # commands, the newest last
        self.arrival = torch.zeros((*shape, slots), device=device)  # from now on [s]

    def reset(self, position: torch.Tensor, env_ids: torch.Tensor | slice = slice(None)) -> None:
        """Begin as if `position`, shape (all environments, joints), had been commanded for long."""
        self.last[env_ids] = position[env_ids]
        self.target[env_ids] = position[env_ids]
        self.value[env_ids] = position[env_ids][..., None]
        self.arrival[env_ids] = -1.0

    def step(self, command: torch.Tensor) -> torch.Tensor:
        """Set-points of the next physics step; both (environments, joints) [rad]."""
        new = (command != self.last)[..., None]
        latency = self.dead_time.expand_as(command)
        if bool((self.jitter > 0).any()):
            draw = torch.rand(command.shape, device=command.device, generator=self.generator)
            late = self.jitter * -torch.log1p(-draw)
            latency = torch.minimum(self.dead_time - self.jitter + late, self.longest)
        latency = torch.maximum(latency, self.arrival[..., -1])
        value = torch.cat([self.value[..., 1:], command[..., None]], -1)
        arrival = torch.cat([self.arrival[..., 1:], latency[..., None]], -1)
        self.value = torch.where(new, value, self.value)
        self.arrival = torch.where(new, arrival, self.arrival)
        self.last = command.clone()
        start = self.arrival.clamp(0.0, self.physics_dt)
        start[..., 0] = 0.0
        end = torch.full_like(command, self.physics_dt)[..., None]
        share = torch.diff(start, dim=-1, append=end) / self.physics_dt
        wanted = (self.value * share).sum(-1)
        self.target = self.target + (wanted - self.target).clamp(-self.slew, self.slew)
        self.arrival = (self.arrival - self.physics_dt).clamp(min=-1.0)
        return self.target.clone()


class HeldFeedback:
    """Held readings of many robots at once.

    `feedback` has `poll_period_s`, `loss`, `quantum_rad` and `offset_rad` of each joint. The
    offset, an error of the joint's zero, is 0 unless you give one: that of a recording is not the
    servo's. `generator` decides phases and lost polls, other parameters are those of `SetPoint`.
    `reading` and `age`, shape (environments, joints), are what the host reads after the last step
    [rad], and since when that has been so [s].
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
        self.direct = self.period <= 0  # every reading is fresh
        polled = self.period[~self.direct]
        self.polls = math.floor(physics_dt / float(polled.min())) + 1 if len(polled) else 0
        shape = (num_envs, len(joint_names))
        self.until = torch.zeros(shape, device=device)  # the next poll [s]
        self.before = torch.zeros(shape, device=device)
        self.reading, self.age = torch.zeros((2, *shape), device=device)

    def reset(self, position: torch.Tensor, env_ids: torch.Tensor | slice = slice(None)) -> None:
        """Begin at rest at `position`, shape (all environments, joints), with a new phase."""
        robots, joints = self.until[env_ids].shape
        first = torch.rand(robots, 1, device=position.device, generator=self.generator)
        turn = torch.arange(joints, device=position.device) / joints
        self.until[env_ids] = (first + turn) % 1.0 * self.period
        self.age[env_ids] = self.period - self.until[env_ids]
        self.before[env_ids] = position[env_ids]
        self.reading[env_ids] = self._reported(position)[env_ids]

    def step(self, position: torch.Tensor) -> torch.Tensor:
        """Readings after one physics step that ended at `position`; both (environments, joints).

        A poll falls anywhere in a step and reads the position of its own instant.
        """
        self.until = self.until - self.physics_dt
        self.age = self.age + self.physics_dt
        change = (position - self.before) / self.physics_dt
        for _ in range(self.polls):
            due = (self.until <= 0) & ~self.direct
            draw = torch.rand(position.shape, device=position.device, generator=self.generator)
            fresh = due & (draw >= self.loss)
            ago = -self.until
            self.reading = torch.where(fresh, self._reported(position - change * ago), self.reading)
            self.age = torch.where(fresh, ago, self.age)
            self.until = torch.where(due, self.until + self.period, self.until)
        self.reading = torch.where(self.direct, self._reported(position), self.reading)
        self.age = torch.where(self.direct, torch.zeros_like(self.age), self.age)
        self.before = position.clone()
        return self.reading.clone()

    def _reported(self, position: torch.Tensor) -> torch.Tensor:
        counts = (position + self.offset) / self.quantum.clamp(min=1e-12)
        coarse = torch.round(counts) * self.quantum
        return torch.where(self.quantum > 0, coarse, position + self.offset)


class ServoBank:
    """Commands and readings of a group of servos, in the order in which simulators call for them.

    Parameters are those of `SetPoint` and `HeldFeedback`.
    """

    def __init__(
        self,
        servos: Mapping[str, Mapping[str, float]],
        feedback: Mapping[str, Mapping[str, float]],
        joint_names: Sequence[str],
        num_envs: int,
        physics_dt: float,
        device: str = "cpu",
    ):
        self.set_point = SetPoint(servos, joint_names, num_envs, physics_dt, device)
        self.feedback = HeldFeedback(feedback, joint_names, num_envs, physics_dt, device)
        self.new = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.any_new = True  # known here without waiting for the device
        self.has_read = False

    def restart(self, env_ids: torch.Tensor | slice | Sequence[int] | None = None) -> None:
        """Let robots begin anew; they are taken to rest where they are seen next."""
        self.new[slice(None) if env_ids is None else env_ids] = True
        self.any_new = True

    def read(self, position: torch.Tensor) -> torch.Tensor:
        """Readings now that the joints are at `position`, once or more after a physics step."""
        if not self.has_read:
            self.feedback.step(position)
            self.has_read = True
        if self.any_new:
            self.feedback.reset(position, self.new)
            self.set_point.reset(position, self.new)
            self.new[:] = False
            self.any_new = False
        return self.feedback.reading.clone()

    def command(self, command: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
        """Set-points of the next physics step, which begins at `position`; all [rad]."""
        self.read(position)
        self.has_read = False
        return self.set_point.step(command)
