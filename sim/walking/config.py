"""Settings of the walking task. Every field is a flag of `pupper-train`; units are in the names.

`PRESETS` are complete sets: `fast` is this project's own, `paper` and `release` follow the
published task (observation with the true speed of the trunk, wide commands, published rewards).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.robot.mini_pupper import Knee, Physics
from pupper_sysid.sim.robot.terrain import Terrain
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.rewards import DEFAULT, PAPER, RELEASE, Rewards

EVALUATION_STEP_S = 0.002
"""Longest time step of the physics in which policies are evaluated."""


@dataclass(frozen=True)
class Commands:
    """Commanded motion, drawn anew at random times."""

    forward_m_s: tuple[float, float] = (-0.2, 0.2)
    """Range of the forward speed."""
    sideways_m_s: tuple[float, float] = (-0.1, 0.1)
    """Range of the speed to the left."""
    yaw_rad_s: tuple[float, float] = (-0.5, 0.5)
    """Range of the turn rate to the left."""
    standing: float = 0.15
    """Share of commands of zero: stand."""
    single: float = 0.3
    """Share of commands along one of the three axes only."""
    every_s: float = 5.0
    """Mean time between two commands (exponential)."""

    def __post_init__(self):
        for name in ("forward_m_s", "sideways_m_s", "yaw_rad_s"):
            _check_range("commands", name, getattr(self, name))


@dataclass(frozen=True)
class Observation:
    """What the policy sees: 60 numbers in the order of `sim.walking.observation.OBSERVATION`."""

    noise: bool = True
    """Whether the published uniform noise is added."""
    base_velocity: Literal["zero", "true"] = "zero"
    """The trunk's speed, which this robot cannot measure: zeros, or (as published) the true one."""


@dataclass(frozen=True)
class Randomisation:
    """Random differences between episodes. Servos vary within the calibration's intervals."""

    friction: tuple[float, float] = (0.3, 1.0)
    """Of feet on the ground, sliding."""
    payload_kg: tuple[float, float] = (-0.05, 0.05)
    """Added to the trunk."""
    torque_scale: tuple[float, float] = (0.8, 1.25)
    """Factor on all torques and the armature: free-air recordings leave their scale open."""
    joint_rad: float = 0.2
    """Largest distance of a joint from the default pose at the start."""
    joint_rad_s: float = 1.0
    """Largest speed of a joint at the start."""
    base_velocity_m_s: tuple[float, float, float] = (0.3, 0.2, 0.1)
    """Largest speed of the trunk along its axes at the start."""
    base_rate_rad_s: tuple[float, float, float] = (0.2, 0.2, 0.3)
    """Largest rate of the trunk about its axes at the start."""
    push_m_s: float = 0.2
    """Largest horizontal speed that a push gives the trunk; 0 for none."""
    push_every_s: tuple[float, float] = (10.0, 15.0)
    """Time between pushes."""
    on_the_move: float = 0.5
    """Share of episodes that start in the pose of a trot, at a random phase."""

    def __post_init__(self):
        for name, least in (
            ("friction", 0.0), ("payload_kg", -math.inf), ("torque_scale", 0.0),
            ("push_every_s", 0.0),
        ):  # fmt: skip
            _check_range("randomisation", name, getattr(self, name), least)


@dataclass(frozen=True)
class Curriculum:
    """Grow from easy to full: delay, penalties, action scale and commands, in equal stages."""

    on: bool = False
    """Whether the task grows; otherwise it is full from the start."""
    stages: int = 4
    """How many stages, the last one full."""
    stage_steps: int = 2400
    """Control steps (of every environment) per stage."""
    easiest: float = 0.25
    """Share of delay, penalties and commands in the first stage."""
    action_scale: float = 0.6
    """Share of the action scale in the first stage."""

    def level(self, step: int) -> float:
        """0 in the first stage, 1 in the last."""
        if not self.on or self.stages < 2:
            return 1.0
        return min(step // self.stage_steps, self.stages - 1) / (self.stages - 1)


@dataclass(frozen=True)
class Walking:
    """The walking task."""

    episode_s: float = 20.0
    """Length of an episode."""
    physics_step_s: float = 0.002
    """Time step of the physics. In steps other than 2 ms the servos' delay is adapted so that they
    keep the lag that was measured. Training in steps of 4 ms takes half the time."""
    physics: Physics = "training"
    """`training`: only feet touch the ground, and a few iterations solve the constraints nearly;
    `evaluation`: the whole robot does, and they are solved to their end. Programs that evaluate
    take the latter, in steps of 2 ms or less, whatever a policy was trained in."""
    control_step_s: float = 0.02
    """Time between two actions."""
    action_scale: float = 0.5
    """Radians per unit of the policy's output, added to the default pose."""
    knee: Knee = "linkage"
    """`linkage`: servo 3 holds thigh + calf, as on the robot; `serial`: as in the paper."""
    terrain: Terrain = "flat"
    """Kind of ground."""
    commands: Commands = field(default_factory=Commands)
    observation: Observation = field(default_factory=Observation)
    randomisation: Randomisation = field(default_factory=Randomisation)
    curriculum: Curriculum = field(default_factory=Curriculum)
    rewards: Rewards = DEFAULT
    trot: Trot = field(default_factory=Trot)
    """The reference: episodes may start in its poses, and imitation learns to continue it."""

    def __post_init__(self):
        ratio = self.control_step_s / max(self.physics_step_s, 1e-9)
        if self.physics_step_s <= 0 or abs(ratio - round(ratio)) > 1e-6 or ratio < 1:
            raise InputError(
                f"control_step_s ({self.control_step_s}) must be a whole multiple of "
                f"physics_step_s ({self.physics_step_s})."
            )
        if not self.episode_s >= self.control_step_s:
            raise InputError(f"episode_s is {self.episode_s}; it must be at least one step.")
        for name in ("standing", "single"):
            if not 0 <= getattr(self.commands, name) <= 1:
                raise InputError(f"commands.{name} must be between 0 and 1.")

    def evaluated(self) -> Walking:
        """The same task in the physics of evaluation."""
        step = self.physics_step_s
        if step > EVALUATION_STEP_S:
            step = self.control_step_s / math.ceil(self.control_step_s / EVALUATION_STEP_S - 1e-6)
        return replace(self, physics="evaluation", physics_step_s=step)

    @property
    def substeps(self) -> int:
        """Physics steps per action."""
        return round(self.control_step_s / self.physics_step_s)

    @property
    def episode_steps(self) -> int:
        """Actions per episode."""
        return round(self.episode_s / self.control_step_s)


def _check_range(part: str, name: str, ends: tuple[float, float], least: float = -math.inf) -> None:
    """Refuse a range that cannot be drawn from."""
    low, high = ends
    if not (least <= low <= high and math.isfinite(high - low)):
        above = f" from {least:g} on" if math.isfinite(least) else ""
        raise InputError(
            f"{part}.{name} is {low:g} to {high:g}; give the lower end, then the upper one{above}."
        )


_PUBLISHED = Walking(
    commands=Commands((-0.35, 0.35), (-0.35, 0.35), (-0.30, 0.30), 0.25, 0.0, 10.0),
    observation=Observation(base_velocity="true"),
    randomisation=Randomisation(torque_scale=(1.0, 1.0), push_m_s=0.5, on_the_move=0.0),
    rewards=RELEASE,
)

PRESETS = {
    "fast": Walking(),
    "paper": replace(_PUBLISHED, rewards=PAPER),
    "release": _PUBLISHED,
}
"""Complete settings by name."""
