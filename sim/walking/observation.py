"""What a policy of the walking task sees: 60 numbers, their order and their noise.

The order, the sizes and the noise are those of the published task. Nothing here needs MuJoCo, so
that policies can be loaded, exported and deployed without it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.joints import JOINT_NAMES, LEGS
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
OBSERVATION_SIZE = sum(size for _, size, _ in OBSERVATION)


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


PRIVILEGED = privileged_parts(len(JOINT_NAMES), len(LEGS))
"""That of the Mini Pupper."""
PRIVILEGED_PARTS = places(PRIVILEGED)
"""Where each of them is."""
PRIVILEGED_SIZE = sum(size for _, size in PRIVILEGED)
CLOCK_SEEN = slice(-4, -1)
"""Where the clock is in what the critic sees, of any robot."""


def privileged_of(
    parts: Sequence[NDArray[np.floating]], out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """What a critic in the simulator may know of n robots, shape (n, 106).

    Parts are those of `PRIVILEGED`, each of shape (n, k): velocity of the trunk in its own frame
    [m/s], joint angles from the default pose [rad] and velocities [rad/s], height above the ground
    [m], times of each foot in the air and on the ground [s], friction, dead times [s], added mass
    [kg], shift of the centre of mass [m], strength of the legs and of the battery relative to the
    model, errors of the joints' zeros [rad], rotation of the IMU [rad], errors of its rates
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
