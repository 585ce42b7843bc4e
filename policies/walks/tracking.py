"""Tracking errors of a walk, for evaluation, analyses and deployment alike.

An error is the mean absolute difference between the robot's true velocity (forward and sideways
speed in the trunk's frame, turn rate) and the command, over the control steps before a fall.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.walking.rewards import Step

Array = NDArray[np.float64]

ERRORS = ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")
"""Names of the three errors in results and files."""


def planar_velocity(facts: Step) -> Array:
    """Forward and sideways speed [m/s] and turn rate [rad/s] of each robot, shape (n, 3)."""
    return np.column_stack([facts.linear_velocity[:, :2], facts.angular_velocity[:, 2]])


def tracking_errors(velocity: Array, command: Array, alive: NDArray[np.bool_]) -> Array:
    """Mean absolute error of each robot while it is up, shape (n, 3); 0 if it never was.

    Parameters
    ----------
    velocity : ndarray, shape (steps, n, 3)
    command : ndarray, shape (3,) or (steps, n, 3)
    alive : ndarray of bool, shape (steps, n)
    """
    error = (alive[..., None] * np.abs(velocity - command)).sum(axis=0)
    return error / np.maximum(alive.sum(axis=0), 1)[:, None]


def pooled_errors(velocity: Array, command: Array, alive: NDArray[np.bool_]) -> dict[str, float]:
    """Mean absolute errors by name, over all steps of all robots that are up."""
    return named(np.abs(velocity - command)[alive].mean(axis=0))


def named(errors: Array) -> dict[str, float]:
    """Three errors by name."""
    return dict(zip(ERRORS, errors.tolist(), strict=True))
