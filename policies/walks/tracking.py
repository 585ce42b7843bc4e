"""Tracking errors of a walk, for evaluation, analyses and deployment alike.

An error is the mean absolute difference between the robot's true velocity (forward and sideways
speed in the trunk's frame, turn rate) and the command: at every control step, or averaged over a
stride. A robot that fell counts as one that stands still until the end of the walk, so that a walk
does not become better by falling; one that left the ground's edge counts until then.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.walking.step import Step

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

ERRORS = ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")
"""Names of the three errors in results and files."""

STRIDE_ERRORS = tuple(f"stride_{name}" for name in ERRORS)
"""Names of the errors of the velocity averaged over a stride."""

_STRIDE_S = (0.2, 1.0)  # strides that are averaged over
_USUAL_STRIDE_S = 0.3  # of robots that take no steps


def planar_velocity(facts: Step) -> Array:
    """Forward and sideways speed [m/s] and turn rate [rad/s] of each robot, shape (n, 3)."""
    return np.column_stack([facts.linear_velocity[:, :2], facts.angular_velocity[:, 2]])


def counted(velocity: Array, alive: Bools, fell: Bools) -> tuple[Array, Bools]:
    """What counts of walks: velocities, 0 after a fall, and the steps that count.

    Velocities have the shape (steps, n, 3). `alive`, shape (steps, n), says whether the robot has
    neither fallen nor left the ground's edge so far; `fell`, shape (n,), whether it fell. The steps
    that count, shape (steps, n), are of each robot those up to some step.
    """
    return np.where(alive[..., None], velocity, 0.0), alive | fell


def tracking_errors(velocity: Array, command: Array, alive: Bools, fell: Bools) -> Array:
    """Mean absolute error of each robot at every control step, shape (n, 3).

    Commands have the shape (3,) or (steps, n, 3), the others are as `counted` takes them.
    """
    shown, counts = counted(velocity, alive, fell)
    error = (counts[..., None] * np.abs(shown - command)).sum(axis=0)
    return error / np.maximum(counts.sum(axis=0), 1)[:, None]


def stride_errors(
    velocity: Array, command: Array, alive: Bools, fell: Bools, stride_s: Array, step_s: float
) -> Array:
    """Mean absolute error of each robot's velocity over its stride, shape (n, 3).

    The mean over a stride of velocity minus command, its size then averaged over all strides that
    begin at some step of the walk. Velocity (steps, n, 3), command (3,) or (steps, n, 3), `alive`
    and `fell` are as `counted` takes them; the stride of each robot, shape (n,), is used within 0.2
    to 1 s, and is 0.3 s where it is not finite.
    """
    shown, counts = counted(velocity, alive, fell)
    error = counts[..., None] * (shown - command)
    total = np.concatenate([np.zeros_like(error[:1]), error.cumsum(axis=0)])
    length = counts.sum(axis=0)
    span = np.clip(np.where(np.isfinite(stride_s), stride_s, _USUAL_STRIDE_S), *_STRIDE_S)
    window = np.clip(np.rint(span / step_s).astype(int), 1, np.maximum(length, 1))
    begin = np.arange(len(error))[:, None]
    inside = begin + window <= length
    ends = np.minimum(begin + window, len(error))[..., None]
    mean = (np.take_along_axis(total, ends, axis=0) - total[:-1]) / window[:, None]
    found = (inside[..., None] * np.abs(mean)).sum(axis=0)
    return found / np.maximum(inside.sum(axis=0), 1)[:, None]


def pooled_errors(
    velocity: Array, command: Array, alive: Bools, fell: Bools, steps: int
) -> dict[str, float]:
    """Mean absolute errors by name, over all steps of all robots that count.

    Velocities, `alive` and `fell` are as `counted` takes them, until no robot was up any more;
    `steps` is the length of the whole walk: to its end, a robot that fell stands still.
    """
    shown, counts = counted(velocity, alive, fell)
    after = int(fell.sum()) * max(steps - len(velocity), 0)
    error = np.abs(shown - command)[counts].sum(axis=0) + after * np.abs(command)
    return named(error / max(int(counts.sum()) + after, 1))


def named(errors: Array) -> dict[str, float]:
    """Three errors by name."""
    return dict(zip(ERRORS, errors.tolist(), strict=True))
