"""One control step of the walking task: what happens in it, and what a policy and a critic see.

The observation is 60 numbers, whose order, sizes and noise are those of the published task. Nothing
here needs MuJoCo, so that policies can be loaded, exported and deployed without it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.joints import JOINT_NAMES, LEGS
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.walking.config import Observation


def observation_of(joints: int) -> tuple[tuple[str, int, float], ...]:
    """Name, size and half width of the published uniform noise of each part of an observation."""
    return (
        ("base_linear_velocity", 3, 0.1), ("base_angular_velocity", 3, 0.2),
        ("projected_gravity", 3, 0.05), ("command", 3, 0.0),
        ("joint_position_relative", joints, 0.01), ("joint_velocity", joints, 1.5),
        ("joint_effort", joints, 0.1), ("last_action", joints, 0.0),
    )  # fmt: skip


OBSERVATION = observation_of(len(JOINT_NAMES))
"""That of the Mini Pupper."""


def places(parts: Iterable[tuple[str, int]]) -> dict[str, slice]:
    """Where each of several parts is in a row of them."""
    names, sizes = zip(*parts, strict=True)
    ends = np.cumsum(sizes)
    return {
        name: slice(int(end) - size, int(end))
        for name, size, end in zip(names, sizes, ends, strict=True)
    }


OBSERVATION_PARTS = places((name, size) for name, size, _ in OBSERVATION)
"""Where each part of an observation is; up to the command, of any robot's."""

FALLEN_TILT = 0.6
"""Cosine of the tilt from which a robot has fallen: 53 degrees."""

VELOCITY_STEPS = 4
"""Joint velocity is the difference of readings this many control steps apart: polls are too rare
for less."""


def noise_of(
    config: Observation, joints: int, count: int, rng: np.random.Generator
) -> NDArray[np.float32] | None:
    """Draw the noise of `count` observations, shape (count, 60); None if it is off."""
    if not config.noise:
        return None
    parts = observation_of(joints)
    half = np.concatenate([np.full(size, width, np.float32) for _, size, width in parts])
    if config.base_velocity != "true":
        half[OBSERVATION_PARTS["base_linear_velocity"]] = 0.0
    noise = rng.random((count, len(half)), np.float32)
    noise *= 2
    noise -= 1
    noise *= half
    return noise


def observed(
    parts: Sequence[NDArray[np.floating]],
    noise: NDArray[np.float32] | None,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Observations of n robots, shape (n, 60).

    Parts are true values in the order of `OBSERVATION`, each of shape (n, size of the part); noise
    is that of `noise_of`. They are written to `out`, where it is given.
    """
    if out is None:
        out = np.empty((len(parts[0]), sum(p.shape[1] for p in parts)), np.float32)
    row = np.concatenate(parts, axis=1, out=out)
    if noise is not None:
        row[:, : noise.shape[1]] += noise  # none on the parts of a user, which come last
    return row


def privileged_parts(joints: int, feet: int) -> tuple[tuple[str, int], ...]:
    """Name and size of each part of what the critic sees."""
    return (
        ("base_linear_velocity", 3), ("joint_position_relative", joints),
        ("joint_velocity", joints), ("height", 1), ("air_s", feet), ("contact_s", feet),
        ("friction", 1), ("dead_time_s", joints), ("added_mass", 1), ("centre_of_mass", 3),
        ("leg_strength", feet), ("battery", 1), ("joint_zero", joints), ("imu_mounting", 3),
        ("gyro_bias", 3), ("imu_age", 2), ("readings", 3), ("true_angular_velocity", 3),
        ("true_gravity", 3), ("stride_velocity", 3), ("earlier_action", joints), ("clock", 3),
        ("time_left", 1),
    )  # fmt: skip


PRIVILEGED_PARTS = places(privileged_parts(len(JOINT_NAMES), len(LEGS)))
"""Where each of them is, of the Mini Pupper."""
CLOCK_SEEN = slice(-4, -1)
"""Where the clock is in what the critic sees, of any robot."""


def privileged_of(
    parts: Sequence[NDArray[np.floating]], out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """What a critic in the simulator may know of n robots, shape (n, 106).

    Parts are those of `privileged_parts`, each of shape (n, k): velocity of the trunk in its own
    frame [m/s], joint angles from the default pose [rad] and velocities [rad/s], height above the
    ground [m], times of each foot in the air and on the ground [s], friction, dead times [s], added
    mass [kg], shift of the centre of mass [m], strength of the legs and of the battery relative to
    the model, errors of the joints' zeros [rad], rotation of the IMU [rad], errors of its rates
    [rad/s], its latency and period [s], factors on the readings' periods and on the commands'
    jitter with whether efforts are read, rates [rad/s] and direction of gravity as they are, speeds
    over about a stride [m/s, rad/s], the action before the last, clock of a trot (see `Strides`),
    share of the episode that is left. They are written to `out`, where it is given.
    """
    velocity, angle, speed, height, air, stance, friction, dead_time, *differs = parts
    mass, centre, legs, battery, zero, turn, bias, age, factors, *more = differs
    scaled = [velocity, angle, 0.1 * speed, 10 * height, air, stance.clip(0, 1), friction]
    scaled += [10 * dead_time, 10 * mass, 100 * centre, legs, battery, 20 * zero, 20 * turn]
    scaled += [20 * bias, 50 * age, factors, *more]
    if out is None:
        out = np.empty((len(velocity), sum(p.shape[1] for p in scaled)), np.float32)
    return np.concatenate(scaled, axis=1, out=out)


Array = NDArray[np.float64]

_VECTORS = ("linear_velocity", "angular_velocity", "gravity", "stride_velocity", "clock")
_OF_JOINTS = (
    "position_relative", "velocity", "acceleration", "torque", "saturated", "torque_square",
)  # fmt: skip
_OF_FEET = (
    "air_s", "contact_s", "last_air_s", "last_contact_s", "foot_height_m", "foot_speed_m_s",
    "clearance_m",
)  # fmt: skip
_NUMBERS = ("power_w", "weight_n")
_FLAGS = ("contact", "landed", "lifted", "swing_ended")


@dataclass(frozen=True)
class Step:
    """What happened in one control step, for all environments: robots of 12 joints and 4 feet."""

    body: Body
    """The robot, which gives the numbers of joints and feet."""
    command: Array
    """Forward and sideways speed [m/s], turn rate [rad/s]; shape (n, 3)."""
    linear_velocity: Array
    angular_velocity: Array
    gravity: Array
    """`linear_velocity`, `angular_velocity` and `gravity`: of the trunk, in its own frame [m/s,
    rad/s, unit vector]; shape (n, 3)."""
    position_relative: Array
    velocity: Array
    acceleration: Array
    torque: Array
    """`position_relative`, `velocity`, `acceleration` and `torque`: of the joints, from the default
    pose [rad, rad/s, rad/s², N·m]; shape (n, 12)."""
    action: Array
    last_action: Array
    earlier_action: Array
    """`action`, `last_action` and `earlier_action`: raw outputs of the policy: this, the one
    before, and the one before that; shape (n, 12)."""
    contact: NDArray[np.bool_]
    """Shape (n, 4)."""
    air_s: Array
    contact_s: Array
    """`air_s` and `contact_s`: time that each foot has been in the air, on the ground; 0 if it is
    not; shape (n, 4)."""
    last_air_s: Array
    last_contact_s: Array
    """`last_air_s` and `last_contact_s`: duration of the last swing and stance; shape (n, 4)."""
    landed: NDArray[np.bool_]
    lifted: NDArray[np.bool_]
    """`landed` and `lifted`: feet that came down, or left the ground, in this step; shape (n,
    4)."""
    foot_height_m: Array
    foot_speed_m_s: Array
    """`foot_height_m` and `foot_speed_m_s`: of the sole above the ground; of the foot along it;
    shape (n, 4)."""
    stride_velocity: Array
    """Forward and sideways speed and turn rate, averaged over about a stride [m/s, rad/s]; shape
    (n, 3)."""
    clock: Array
    """Cosine and sine of a trot's clock that follows the feet, and how well they keep to it, -1 to
    1; see `Strides`; shape (n, 3)."""
    swing_ended: NDArray[np.bool_]
    """Feet that came down after a swing; see `EffortMeter`, as all that follow; shape (n, 4)."""
    clearance_m: Array
    """Of the swings that ended; NaN of other feet; shape (n, 4)."""
    saturated: Array
    torque_square: Array
    """`saturated` and `torque_square`: share of the step in which a servo is at its torque limit;
    mean square of torque over limit; shape (n, 12)."""
    power_w: Array
    weight_n: Array
    """`power_w` and `weight_n`: positive mechanical power of all servos; weight of the robot; shape
    (n,)."""

    @property
    def planar_velocity(self) -> Array:
        """Forward and sideways speed [m/s] and turn rate [rad/s] of the trunk, shape (n, 3)."""
        return np.column_stack([self.linear_velocity[:, :2], self.angular_velocity[:, 2]])

    @property
    def followed_velocity(self) -> Array:
        """Forward and sideways speed [m/s] and turn rate [rad/s] to be as commanded, shape (n, 3).

        Those of the trunk; over a stride where a gait cannot do without sway (`Body.sways`).
        """
        return self.stride_velocity if self.body.sways else self.planar_velocity

    def moving(self, threshold_m_s: float) -> NDArray[np.bool_]:
        """Whether a robot is commanded to move, or moves, shape (n,)."""
        commanded = np.abs(self.command).max(axis=1) > 0
        return commanded | (np.linalg.norm(self.linear_velocity[:, :2], axis=1) > threshold_m_s)


@dataclass(frozen=True)
class StepResult:
    """What one step gave."""

    observation: NDArray[np.float32]
    """Shape (n, 60)."""
    privileged: NDArray[np.float32]
    """The truth, for a critic; shape (n, k)."""
    reward: Array
    """Shape (n,)."""
    done: NDArray[np.bool_]
    timed_out: NDArray[np.bool_]
    """`done` and `timed_out`: episode over; over because its time was up; shape (n,)."""
    terms: dict[str, Array]
    """Each reward term, weighted and times the control period; shape (n,)."""
    terminal: dict[str, NDArray]
    """`ids` of environments whose time was up, and their last `observation` and `privileged`."""
    unforeseen: dict[str, NDArray]
    """`ids` of other environments that were given a new command or a push after this step, and
    `observation` and `privileged` as they would be without."""
    facts: Step
    """What happened, before any new episode."""


@dataclass(frozen=True)
class Unfinished:
    """A step that goes on: what was drawn for it, and arrays that parts of the robots fill in."""

    velocity_before: Array
    chances: Array
    noise: NDArray[np.float32] | None
    pushed: NDArray[np.intp]
    push: Array
    facts: dict[str, Any]
    terms: dict[str, Array]
    observation: NDArray[np.float32]
    privileged: NDArray[np.float32]
    fallen: NDArray[np.bool_]


def empty_facts(
    body: Body, command: Array, action: Array, last_action: Array, earlier_action: Array
) -> dict[str, Any]:
    """Arrays of a `Step` that are to be filled in; the given ones are copied."""
    facts: dict[str, Any] = {
        "command": command.copy(), "action": action.copy(), "last_action": last_action.copy(),
        "earlier_action": earlier_action.copy(),
    }  # fmt: skip
    for names, size in (
        (_VECTORS, 3), (_OF_JOINTS, len(body.joints)), (_OF_FEET, len(body.feet)),
    ):  # fmt: skip
        facts |= {name: np.empty((len(command), size)) for name in names}
    facts |= {name: np.empty(len(command)) for name in _NUMBERS}
    return facts | {name: np.empty((len(command), len(body.feet)), bool) for name in _FLAGS}


def unforeseen_of(
    now: Unfinished, command: Array, done: NDArray[np.bool_], base_velocity: str
) -> dict[str, NDArray]:
    """`StepResult.unforeseen` of a step, with everything filled in.

    `command`, shape (n, 3), is that after the step, `done`, shape (n,), says which episodes are
    over, `base_velocity` is as in `Observation`.
    """
    before, velocity = now.facts["command"], now.facts["linear_velocity"]
    changed = (before != command).any(axis=1)
    changed[now.pushed] = True
    ids = np.flatnonzero(changed & ~done)
    if not len(ids):
        return {"ids": ids}
    observation, privileged = now.observation[ids], now.privileged[ids]
    place = PRIVILEGED_PARTS["base_linear_velocity"]
    if base_velocity == "true":
        seen = OBSERVATION_PARTS["base_linear_velocity"]
        observation[:, seen] += velocity[ids] - privileged[:, place]
    observation[:, OBSERVATION_PARTS["command"]] = before[ids]
    privileged[:, place] = velocity[ids]
    return {"ids": ids, "observation": observation, "privileged": privileged}
