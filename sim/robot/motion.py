"""What the physics did in one control step, and quantities of the trunk in its own frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Moved:
    """One control step of some robots, k of them. Arrays are overwritten by the next step."""

    rows: slice
    """Which robots."""
    start: Array
    """Joint angles before [rad]; shape (k, 12)."""
    qpos: Array
    """MuJoCo's, after each physics step; joint angles last; shape (k, physics steps, 19)."""
    load: Array
    """Servo torques in each physics step [N·m]; shape (k, physics steps, 12)."""
    touch: Array
    """Largest force on each foot in the last 6 ms [N]; shape (k, 4)."""
    feet: Array
    """Places of the feet in the world before each physics step [m]; on a Warp device only the last;
    shape (k, physics steps, 4, 3)."""


def gravity_direction(qpos: Array) -> Array:
    """Direction of gravity in the trunk's frame, shape (n, 3), from MuJoCo's positions."""
    w, x, y, z = qpos[:, 3:7].T.copy()
    found = np.empty((len(qpos), 3))
    found[:, 0] = 2 * (w * y - x * z)
    found[:, 1] = -2 * (y * z + w * x)
    found[:, 2] = 2 * (x * x + y * y) - 1
    return found


def own_velocity(qpos: Array, qvel: Array) -> Array:
    """Velocity of the trunk in its own frame [m/s], shape (n, 3), from MuJoCo's state."""
    w, x, y, z = qpos[:, 3:7].T.copy()
    a, b, c = qvel[:, :3].T.copy()
    # rotate by the inverse: v + w t + t × q with t = 2 (v × q), by hand: np.cross is slow
    t, u, v = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    found = np.empty((len(qpos), 3))
    found[:, 0] = a + w * t + u * z - v * y
    found[:, 1] = b + w * u + v * x - t * z
    found[:, 2] = c + w * v + t * y - u * x
    return found


def planar(velocity: Array, qvel: Array) -> Array:
    """Forward and sideways speed [m/s] and turn rate [rad/s], shape (n, 3).

    `velocity` is that of `own_velocity`.
    """
    return np.column_stack([velocity[:, :2], qvel[:, 5]])
