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
from collections.abc import Callable, Mapping, Sequence

import torch


def _columns(
    numbers: Mapping[str, Mapping[str, float]], joint_names: Sequence[str], device: str
) -> Callable[[str], torch.Tensor]:
    """Numbers of all joints by their key, each of shape (joints,)."""
    return lambda key: torch.tensor([numbers[name][key] for name in joint_names], device=device)


class SetPoint:
    """Set-points of many robots' position loops: commands after their dead time, at limited speed.

    What `step` gives is the mean over the step of a set-point that begins to run whenever a command
    arrives. With a jitter every command has a latency of its own, and none overtakes the one
    before it.

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
        column = _columns(servos, joint_names, device)
        self.dead_time, self.jitter = column("dead_time_s"), column("jitter_s")
        self.jitter = torch.minimum(self.jitter, self.dead_time)  # its mean is in the dead time
        self.speed = column("velocity_limit_rad_s").clamp(max=1e9)  # beyond, at once
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
        """Mean set-points over the next physics step; both (environments, joints) [rad]."""
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
        times = torch.diff(start, dim=-1, append=end)
        # until the first arrival of the step, and what arrives in the rest of it
        place = (times > 0).int().argmax(-1, keepdim=True)
        until = times.gather(-1, place)[..., 0]
        before = self.value.gather(-1, place)[..., 0]
        left_s = self.physics_dt - until
        after = ((self.value * times).sum(-1) - before * until) / left_s.clamp(min=1e-9)
        self.goal = torch.where(left_s > 0, after, before)
        area = self._run(before, until) + self._run(self.goal, left_s)
        self.arrival = (self.arrival - self.physics_dt).clamp(min=-1.0)
        return area / self.physics_dt

    def _run(self, goal: torch.Tensor, duration: torch.Tensor) -> torch.Tensor:
        """Let the set-point run to a goal for a time; its integral over this time."""
        reach = self.speed * duration
        change = torch.minimum(torch.maximum(goal - self.target, -reach), reach)
        self.target = self.target + change
        return self.target * duration - change * change.abs() / (2 * self.speed)


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
        column = _columns(feedback, joint_names, device)
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
    """Torques and readings of a group of servos, in the order in which simulators call for them.

    Parameters are those of `SetPoint` and `HeldFeedback`; `servos` also has, by joint, `stiffness`,
    `damping`, `effort_limit` and `back_emf`, `inertia`, the armature with what else moved in the
    recordings, and `step_s`, the steps of MuJoCo in which these numbers are the servo's. Dry
    friction and armature are the simulator's.
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
        column = _columns(servos, joint_names, device)
        self.stiffness, self.damping = column("stiffness"), column("damping")
        self.limit, self.brake = column("effort_limit"), column("back_emf")
        # a simulator's velocity is that of half a step ago, and MuJoCo brakes with the next one
        lead = (physics_dt + column("step_s")) / 2
        self.steps_ahead, self.per_torque = lead / physics_dt, lead / column("inertia")
        # a step's torque is one of its beginning: it takes the mean of the set-points around that;
        # MuJoCo's is that half a step later or, where it runs, has run for all of its first step
        later, lead_s = {}, []
        for name in joint_names:
            servo = servos[name]
            part = (servo["dead_time_s"] / servo["step_s"] + 1e-6) % 1.0
            runs = servo["velocity_limit_rad_s"] < 1000.0  # which stands for none
            ahead = servo["step_s"] * (1 + part if runs else 0.5)
            delay = servo["dead_time_s"] + physics_dt / 2 - ahead
            later[name] = {**servo, "dead_time_s": max(delay, 0.0)}
            lead_s.append(max(-delay, 0.0))
        self.set_point = SetPoint(later, joint_names, num_envs, physics_dt, device)
        self.reach = self.set_point.speed * torch.tensor(lead_s, device=device)
        self.feedback = HeldFeedback(feedback, joint_names, num_envs, physics_dt, device)
        self.effort, self.velocity = torch.zeros((2, num_envs, len(joint_names)), device=device)
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
            self.effort[self.new], self.velocity[self.new] = 0.0, torch.nan
            self.new[:] = False
            self.any_new = False
        return self.feedback.reading.clone()

    def efforts(
        self, command: torch.Tensor, position: torch.Tensor, velocity: torch.Tensor
    ) -> torch.Tensor:
        """Torques of the next physics step [N·m], of joints at `position` [rad] with `velocity`.

        The servo brakes with the velocity of the present: the acceleration of the last step goes
        on, but for what the torque changes of it. So the motion is the servo's to the second order
        of the step, whatever load the joint has, and a joint at rest gets the whole torque.
        """
        self.read(position)
        self.has_read = False
        target = self.set_point.step(command)
        # where a dead time is too short to be made shorter, the set-point is taken as ahead
        to_go = self.set_point.goal - target
        target = target + torch.minimum(torch.maximum(to_go, -self.reach), self.reach)
        drive = self.stiffness * (target - position)
        change = torch.nan_to_num(velocity - self.velocity, nan=0.0)  # NaN: none before
        now = velocity + self.steps_ahead * change - self.per_torque * self.effort
        brakes = self.damping + self.brake
        free = (drive - brakes * now) / (1 + self.per_torque * brakes)
        motor = drive - self.damping * (now + self.per_torque * free)
        largest = torch.minimum(torch.maximum(motor, -self.limit), self.limit)
        clipped = (largest - self.brake * now) / (1 + self.per_torque * self.brake)
        self.effort = torch.where(motor == largest, free, clipped)
        self.velocity = velocity.clone()
        return self.effort.clone()
