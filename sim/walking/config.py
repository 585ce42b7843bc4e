"""Settings of the walking task. Every field is a flag of `pupper-train`; units are in the names.

`PRESETS` are complete sets: `fast` is that of this project, `paper` and `release` follow the
published task (observation with the true speed of the trunk, wide commands, published rewards).

`PAPER_REWARDS` and `RELEASE_REWARDS` hold the weights of the paper's text and of the training
configuration its authors released; `DEFAULT_REWARDS` are those of this project. A weight is per
second: the sum is multiplied by the control period, as in Isaac Lab.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import LEGS
from pupper_sysid.sim.robot.body import Body, body_of
from pupper_sysid.sim.robot.mini_pupper import MASS_KG, Knee, Physics
from pupper_sysid.sim.robot.terrain import Terrain
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.draws import TYPICAL, Differences, check_range


@dataclass(frozen=True)
class Rewards:
    """Weights [1/s] and parameters of all terms; a weight of 0 leaves the term out."""

    base_linear_velocity: float = 2.0
    """Follow the commanded speed at every instant."""
    base_angular_velocity: float = 3.0
    """Follow the commanded turn rate at every instant."""
    stride_linear_velocity: float = 2.0
    """Follow the commanded speed on average over about a stride."""
    stride_angular_velocity: float = 2.0
    """Follow the commanded turn rate on average over about a stride."""
    stride_linear_sigma: float = 0.05
    """σ of the mean speed's error [m/s]."""
    stride_angular_sigma: float = 0.2
    """σ of the mean turn rate's error [rad/s]."""
    tracking_shape: str = "exponential"
    """`gaussian`: exp(-error²/σ²); `exponential`: exp(-error/σ), as published; `linear`:
    1 - error/σ, and -1 from 2 σ on, which pulls equally at errors of every size up to there."""
    linear_sigma: float = 0.1
    """σ of the speed error [m/s]."""
    angular_sigma: float = 0.3
    """σ of the turn rate's error [rad/s]."""
    fast_bonus: float = 0.0
    """Published: the speed term grows by this per m/s above `fast_above`."""
    fast_above: float = 0.15
    """Speed above which `fast_bonus` counts [m/s]."""
    progress: float = 0.0
    """How much nearer to the commanded speed the mean over a stride is than standing: pays from
    the first step on."""
    turn_progress: float = 0.0
    """The same of the turn rate."""
    alive: float = 0.5
    """Be upright."""
    unsupported: float = 0.0
    """Fewer than two feet on the ground."""
    short_swing: float = 0.0
    """Feet that come down after less than `shortest_swing`, by the share that was missing."""
    shortest_swing: float = 0.1
    """For `short_swing` [s]."""
    short_stance: float = 0.0
    """Feet that leave the ground after less than `shortest_stance`, by the share that was
    missing."""
    shortest_stance: float = 0.15
    """For `short_stance` [s]."""
    air_time: float = 0.0
    """Published: long swings and stances while moving, all feet down while standing."""
    air_time_most: float = 0.25
    """Longest swing that counts for `air_time` [s]."""
    foot_paths: float = 0.0
    """Feet pass under the trunk, swing back and rise as a trot's clock and the command say. A
    policy does not see the clock, which follows the feet; a teacher does."""
    foot_paths_sigma: float = 0.012
    """Its width: root of the summed squares of four feet's distances [m]."""
    stance: float = 0.0
    """Distance of the feet, all together, from `crouch` and `spread`. With it a policy begins by
    standing so: noise of actions moves feet by parts of a millimetre, from where 20 mm are far."""
    crouch: float = 0.02
    """How much lower than in the default pose the trunk is to be carried, for `stance` [m]."""
    spread: float = 0.007
    """How much farther to their sides than in the default pose feet are to be, likewise [m]."""
    clock_hz: float = 3.6
    """Steps of each foot per second by that clock."""
    clock_pull_hz: float = 0.2
    """How far from that rate it follows feet."""
    clock_duty: float = 0.72
    """Share of the time that a foot is to be down by that clock."""
    clock_height: float = 0.006
    """How far a foot is to rise by that clock, which so takes it as up [m]; lower ones count in
    proportion."""
    gait: float = 0.3
    """Diagonal feet together, the two pairs in turn (a trot)."""
    gait_threshold: float = 0.1
    """Like `moving_threshold`, for the gait [m/s]."""
    gait_sigma: float = 0.05
    """Its width [s²]."""
    gait_most: float = 0.15
    """Differences of times beyond this do not count more [s]."""
    foot_clearance: float = 0.0
    """Published: feet that move are at `clearance_height`."""
    clearance_height: float = 0.015
    """Height of a moving foot [m]."""
    clearance_sigma: float = 0.05
    """Its width [m]."""
    clearance_speed: float = 2.0
    """Inverse of the speed that counts as moving [s/m]."""
    swing_height: float = -400.0
    """Squared shortfall of a moving foot's height below `clearance_height`, by its speed [1/m³]."""
    low_swing: float = 0.0
    """Feet that come down after a swing whose highest point was below `least_clearance`, by the
    share that was missing."""
    least_clearance: float = 0.008
    """For `low_swing`: about a tenth of the standing height [m]."""
    torque_saturation: float = 0.0
    """Share of the time in which servos are at their torque limit, the mean of all."""
    torque_share: float = 0.0
    """Square of torque over its limit, the mean of all servos."""
    mechanical_power: float = 0.0
    """Positive mechanical power over the robot's weight, a speed [m/s]: cost of transport times
    speed."""
    action_smoothness: float = 0.0
    """Published: norm of the change of the action."""
    action_rate: float = -0.02
    """Squared change of the action."""
    action_jerk: float = -0.01
    """Squared change of the change of the action."""
    air_time_variance: float = 0.0
    """Published: feet that swing or stand for different times."""
    base_motion: float = -0.5
    """0.8 v_z² + 0.2 (|ω_x| + |ω_y|)."""
    bounce: float = 0.0
    """Speed at which the trunk rises or falls."""
    base_orientation: float = -1.0
    """Tilt."""
    foot_slip: float = -1.0
    """Speed of feet on the ground."""
    joint_position: float = -0.1
    """Distance from the default pose."""
    standing_factor: float = 10.0
    """Factor on `joint_position` while standing."""
    moving_threshold: float = 0.15
    """Speed from which a robot counts as moving without a command to [m/s]."""
    hip_abduction: float = 0.0
    """Distance of the hips from the default pose."""
    joint_torques: float = -5e-3
    """Norm of the torques."""
    joint_acceleration: float = -2e-5
    """Norm of the accelerations."""
    joint_velocity: float = -1e-3
    """Norm of the velocities."""


CLOCK = ("clock_hz", "clock_pull_hz", "clock_height")
"""Names of the parameters that decide the phase of the trot's clock."""

DEFAULT_REWARDS = Rewards(
    base_linear_velocity=3.0, tracking_shape="gaussian", linear_sigma=0.035,
    stride_linear_sigma=0.015, angular_sigma=0.16, stride_angular_sigma=0.06,
    low_swing=-8.0, torque_saturation=-8.0, torque_share=-3.0, mechanical_power=-1.0,
)  # fmt: skip
"""With widths of about an imitated trot's errors, where the slope of a Gaussian is largest. Each of
the last four costs a trot that clears three quarters of `least_clearance`, with servos at their
limit for a quarter of the time and a power of its weight times 1 m/s, about a tenth of what exact
tracking pays: all are relative to limits and weight, so that they hold for other servos."""

RELEASE_REWARDS = Rewards(
    base_linear_velocity=15.0, base_angular_velocity=10.0, tracking_shape="exponential",
    linear_sigma=0.1, angular_sigma=0.2, stride_linear_velocity=0.0,
    stride_angular_velocity=0.0, fast_bonus=0.5, fast_above=0.15, alive=0.0,
    air_time=5.0, air_time_most=0.25, gait=10.0, gait_sigma=0.08, gait_most=0.15,
    foot_clearance=1.0, clearance_height=0.03, clearance_sigma=0.05, clearance_speed=2.0,
    swing_height=0.0, action_smoothness=-2.0, action_rate=0.0, action_jerk=0.0,
    air_time_variance=-1.0, base_motion=-2.0, base_orientation=-5.0, foot_slip=-0.5,
    joint_position=-3.0, standing_factor=10.0, moving_threshold=0.15, hip_abduction=-2.5,
    joint_torques=-5e-4, joint_acceleration=-2.5e-4, joint_velocity=-1e-2,
)  # fmt: skip
"""Weights of the authors' released training configuration."""

PAPER_REWARDS = replace(RELEASE_REWARDS, action_smoothness=-1.0, joint_position=-0.7)
"""Weights that the paper's text names; the rest as released."""


def narrowed(rewards: Rewards, linear: float, angular: float) -> Rewards:
    """The same with the widths of the tracking terms times a factor."""
    if linear == angular == 1.0:
        return rewards
    return replace(
        rewards,
        linear_sigma=linear * rewards.linear_sigma,
        stride_linear_sigma=linear * rewards.stride_linear_sigma,
        angular_sigma=angular * rewards.angular_sigma,
        stride_angular_sigma=angular * rewards.stride_angular_sigma,
    )


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
    dead_band: tuple[float, float] = (0.015, 0.05)
    """Speed [m/s] and turn rate [rad/s] below which a command means: stand."""

    def __post_init__(self):
        if not min(self.dead_band) >= 0:
            raise InputError("commands.dead_band must be 0 or more.")
        for name in ("forward_m_s", "sideways_m_s", "yaw_rad_s"):
            check_range("commands", name, getattr(self, name))


@dataclass(frozen=True)
class Observation:
    """What the policy sees: 60 numbers in the order of `sim.walking.step.OBSERVATION`."""

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
            check_range("randomisation", name, getattr(self, name), least)


Ramp = tuple[float, float, float, float]
"""A factor before and after a part of a training, and the part's ends in millions of samples,
between which the factor changes linearly."""
_FULL: Ramp = (1.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Curriculum:
    """From easy to full, as a training goes on: factors on parts of the task; 1 is the task.

    Four numbers each: factor at first and at last, millions of samples where it begins and ends to
    change.
    """

    commands: Ramp = _FULL
    """On commanded speeds."""
    push: Ramp = _FULL
    """On the speed that a push gives."""
    penalties: Ramp = _FULL
    """On rewards of negative weight."""
    guides: Ramp = _FULL
    """On the rewards that lead to steps: `foot_paths` and `gait`."""
    progress: Ramp = _FULL
    """On the rewards that lead to travel: `progress` and `turn_progress`."""
    linear_sigma: Ramp = _FULL
    """On the widths of the speed's tracking terms."""
    angular_sigma: Ramp = _FULL
    """On the widths of the turn rate's tracking terms."""

    def at(self, samples: float) -> dict[str, float]:
        """All factors, by field, after so many samples."""
        factors = {}
        for part in fields(self):
            first, last, begin, end = getattr(self, part.name)
            share = (1e-6 * samples - begin) / max(end - begin, 1e-9)
            factors[part.name] = first + (last - first) * min(max(share, 0.0), 1.0)
        return factors


@dataclass(frozen=True)
class Walking:
    """The walking task."""

    robot: str = ""
    """MJCF or URDF of the robot; empty for the Mini Pupper 2. `pupper-train --robot` sets it, and
    scales the task."""
    robot_config: str = ""
    """YAML beside it (`sim.robot.robot_file`)."""
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
    differences: Differences = field(default_factory=Differences)
    """Of robots from their model; off in evaluations, whose conditions are their own."""
    curriculum: Curriculum = field(default_factory=Curriculum)
    rewards: Rewards = DEFAULT_REWARDS
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
        """The same task in the physics of evaluation, on robots that are as their model."""
        step = self.physics_step_s
        if step > EVALUATION_STEP_S:
            step = self.control_step_s / math.ceil(self.control_step_s / EVALUATION_STEP_S - 1e-6)
        return replace(self, physics="evaluation", physics_step_s=step, differences=Differences())

    @property
    def body(self) -> Body:
        """The robot."""
        return body_of(self.robot, self.robot_config, self.knee)

    @property
    def substeps(self) -> int:
        """Physics steps per action."""
        return round(self.control_step_s / self.physics_step_s)

    @property
    def episode_steps(self) -> int:
        """Actions per episode."""
        return round(self.episode_s / self.control_step_s)


_PUBLISHED = Walking(
    commands=Commands(
        (-0.35, 0.35), (-0.35, 0.35), (-0.30, 0.30), 0.25, 0.0, 10.0, dead_band=(0.0, 0.0)
    ),
    observation=Observation(base_velocity="true"),
    randomisation=Randomisation(torque_scale=(1.0, 1.0), push_m_s=0.5, on_the_move=0.0),
    rewards=RELEASE_REWARDS,
)

_SCRATCH = Walking(
    physics_step_s=0.004,
    commands=Commands(every_s=4.0, standing=0.1),
    randomisation=Randomisation(
        on_the_move=0.0, joint_rad=0.1, joint_rad_s=0.5, push_m_s=1.2, push_every_s=(3.0, 8.0)
    ),
    differences=TYPICAL,
    curriculum=Curriculum(
        commands=(0.6, 1.0, 1.0, 4.0),
        # first steps by the clock; then they are to travel, then to do so evenly
        progress=(0.0, 1.0, 0.3, 0.6),
        penalties=(0.3, 1.0, 0.5, 3.0),
        push=(0.0, 1.0, 1.5, 5.0),
        guides=(1.0, 0.4, 3.0, 7.0),
        linear_sigma=(1.5, 0.5, 2.0, 5.0),
        angular_sigma=(2.0, 0.5, 2.0, 5.0),
    ),
    rewards=Rewards(
        foot_paths=15.0, gait=0.0, stance=-200.0, alive=0.1, progress=8.0, turn_progress=4.0,
        tracking_shape="linear",
        base_linear_velocity=6.0, linear_sigma=0.1, base_angular_velocity=12.0, angular_sigma=0.5,
        stride_linear_velocity=2.0, stride_linear_sigma=0.1,
        stride_angular_velocity=2.0, stride_angular_sigma=0.4,
        unsupported=-8.0, short_swing=-4.0, short_stance=-8.0, shortest_stance=0.16,
        swing_height=-1400.0, clearance_height=0.008, base_orientation=-2.0, base_motion=-18.0,
        bounce=-60.0,
        foot_slip=-1.0, joint_position=-0.2, action_rate=-0.5, action_jerk=-0.2,
    ),
)  # fmt: skip
"""Settings with which a walk is found from nothing ("A walk from nothing" in
`benchmarks/README.md`)."""

PRESETS = {
    "fast": Walking(
        # half of the robots are as calibrated, so that speeds are learned exactly
        differences=replace(TYPICAL, as_calibrated=0.5),
        randomisation=Randomisation(push_m_s=0.6, push_every_s=(5.0, 10.0)),
    ),
    "scratch": _SCRATCH,
    "paper": replace(_PUBLISHED, rewards=PAPER_REWARDS),
    "release": _PUBLISHED,
}  # fmt: skip
"""Complete settings by name."""


_LENGTHS = (
    "clock_height", "clearance_height", "clearance_sigma", "least_clearance",
)  # fmt: skip
_SPEEDS = (
    "linear_sigma", "stride_linear_sigma", "fast_above", "gait_threshold", "moving_threshold",
)  # fmt: skip
_RATES = ("angular_sigma", "stride_angular_sigma", "clock_hz", "clock_pull_hz")
_TIMES = ("shortest_swing", "shortest_stance", "air_time_most", "gait_most")
_PER_SPEED = ("bounce", "foot_slip", "mechanical_power", "clearance_speed")


def for_robot(task: Walking, robot: str | Path, robot_config: str | Path | None) -> Walking:
    """A task of the Mini Pupper, for the robot in a MJCF and its YAML, by Froude scaling.

    Where g is the same, times and speeds of like motions grow with the root of the length, turn
    rates fall with it, torques grow with weight times length. So lengths, speeds and rates of a
    task, found on the Mini Pupper, are multiplied by the scale of `Body`, weights of rewards that
    have a unit divided by it. What the robot's YAML gives stays as it is.
    """
    config = str(Path(robot_config).resolve()) if robot_config else ""
    task = replace(task, robot=str(Path(robot).resolve()), robot_config=config)
    body = task.body
    length, mass = body.scale, body.mass_kg / MASS_KG
    speed, rate = float(body.command_scale[0]), float(body.command_scale[2])
    random, differ = task.randomisation, task.differences

    def times(values: tuple[float, ...], factor: float) -> tuple:
        return tuple(factor * v for v in values)

    return replace(
        task, commands=_commands(task.commands, body), rewards=_rewards(task.rewards, body),
        randomisation=replace(
            random, payload_kg=times(random.payload_kg, mass), push_m_s=speed * random.push_m_s,
            base_velocity_m_s=times(random.base_velocity_m_s, speed),
            base_rate_rad_s=times(random.base_rate_rad_s, rate),
            joint_rad_s=rate * random.joint_rad_s, on_the_move=0.0,
        ),
        trot=replace(
            task.trot, frequency_hz=rate * task.trot.frequency_hz, lift_m=length * task.trot.lift_m,
            crouch_m=0.0, spread_m=0.0, gain=1.0, back_gain=1.0, side_gain=1.0, turn_gain=1.0,
            turn_dead_band_rad_s=0.0,
        ),
        differences=replace(differ, centre_of_mass_m=times(differ.centre_of_mass_m, length)),
    )  # fmt: skip


def _commands(commands: Commands, body: Body) -> Commands:
    names, sizes = ("forward_m_s", "sideways_m_s", "yaw_rad_s"), body.command_scale.tolist()
    ranges = {
        n: tuple(s * end for end in getattr(commands, n)) for n, s in zip(names, sizes, strict=True)
    }
    speed, _, rate = sizes
    dead_band = (speed * commands.dead_band[0], rate * commands.dead_band[1])
    return replace(commands, dead_band=dead_band, **ranges | body.commands)


def _rewards(rewards: Rewards, body: Body) -> Rewards:
    length, speed, _, rate = body.scale, *body.command_scale.tolist()
    time, torque = speed, body.mass_kg / MASS_KG * length
    # feet of a robot whose commands are slower have shorter strokes, and they are summed over feet
    usual, commands = speed * max(Commands().forward_m_s), _commands(Commands(), body)
    fastest = max(map(abs, (*commands.forward_m_s, *commands.sideways_m_s)))
    strokes = min(max(fastest / usual, 0.25), 1.0) * (len(body.feet) / len(LEGS)) ** 0.5
    factors = (
        dict.fromkeys(_LENGTHS, length) | dict.fromkeys(_SPEEDS, speed)
        | dict.fromkeys(_RATES, rate) | dict.fromkeys(_TIMES, time)
        | dict.fromkeys(_PER_SPEED, 1.0 / speed)
        | {
            # the default pose is that of the robot's file
            "crouch": 0.0, "spread": 0.0, "stance": 1.0 / length, "gait_sigma": time**2,
            "foot_paths_sigma": strokes * length, "swing_height": 1.0 / (length**2 * speed),
            "joint_torques": 1.0 / torque, "joint_acceleration": time**2, "joint_velocity": time,
            "air_time": rate,
        }
    )  # fmt: skip
    return replace(rewards, **{name: getattr(rewards, name) * f for name, f in factors.items()})
