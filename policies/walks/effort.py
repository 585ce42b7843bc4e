"""Clearance of the feet and effort of the servos, from every physics step of a walk.

A swing of a third of a stride lasts three control steps, and a servo is at its torque limit for
parts of one, so both are taken from the state after each physics step (`PupperEnv.moved`).

A swing is the time between two contacts of a foot, of `SHORTEST_SWING_S` at least: shorter ones are
flickers of a foot that carries. Its clearance is the largest height of the sole over the ground in
it; a foot that stumbles in the air makes two swings. Mechanical power is the positive work of all
servos over time: none of them gives back what it brakes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.joints import LEGS
from pupper_sysid.hardware.imu import GRAVITY_M_S2
from pupper_sysid.sim.robot.mini_pupper import FOOT_RADIUS_M, foot_position
from pupper_sysid.sim.robot.terrain import Ground
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.step import Step

Array = NDArray[np.float64]

KINDS = ("hip", "thigh", "calf")
"""Kinds of joints, in their order on a leg."""
SHORTEST_SWING_S = 0.04
LOW_SWING_M = 0.002
"""Clearance below which a swing is low: the next pebble or seam ends it."""
_AT_LIMIT = 0.999


@dataclass(frozen=True)
class Effort:
    """One control step of n robots."""

    swing_ended: NDArray[np.bool_]
    """Feet that came down after a swing, shape (n, 4)."""
    clearance_m: Array
    """Shape (n, 4). Of the swings that ended; NaN of other feet."""
    saturated: Array
    """By kind of joint, the share of the step's time in which its servos are at their limit, shape
    (n, 3)."""
    torque_square: Array
    """Mean square of torque over limit, by kind of joint, shape (n, 3)."""
    work_j: Array
    """Positive work of all servos, shape (n,)."""
    carried_j: Array
    """Weight times the distance travelled in the step, at the mean velocity over a stride, shape
    (n,)."""


class EffortMeter:
    """Effort of the robots of an environment, step by step."""

    def __init__(self, env: PupperEnv):
        self._env = env
        self._highest = np.full((env.environments, len(LEGS)), -np.inf)

    def of(self, facts: Step) -> Effort:
        """Effort of the control step that was just taken, with what happened in it."""
        env, robots, step_s = self._env, self._env.robots, self._env.config.control_step_s
        limit = robots.field("actuator_forcerange")[:, :, 1]
        height = np.empty_like(self._highest)
        share = np.empty((env.environments, len(KINDS)))
        square, work = np.empty_like(share), np.empty(env.environments)
        for moved in env.moved:
            rows, load = moved.rows, moved.load
            height[rows] = sole_heights(moved.qpos, env.ground).max(axis=1)
            used = np.abs(load) / limit[rows][:, None]
            share[rows] = _by_kind((used >= _AT_LIMIT).mean(axis=1))
            square[rows] = _by_kind((used * used).mean(axis=1))
            angles = np.concatenate([moved.start[:, None], moved.qpos[..., 7:]], axis=1)
            turned = np.diff(robots.to_servo(angles), axis=1)
            work[rows] = np.maximum(load * turned, 0.0).sum(axis=(1, 2))
        highest = np.maximum(self._highest, height)
        ended = facts.contact & (facts.contact_s <= step_s + 1e-9)
        ended &= facts.last_air_s > SHORTEST_SWING_S - 1e-9
        self._highest = np.where(facts.contact, -np.inf, highest)
        travelled = step_s * np.linalg.norm(facts.stride_velocity[:, :2], axis=1)
        weight = GRAVITY_M_S2 * robots.field("body_mass").sum(axis=1)
        clearance = np.where(ended, highest, np.nan)
        return Effort(ended, clearance, share, square, work, weight * travelled)


def sole_heights(qpos: Array, ground: Ground) -> Array:
    """Heights of the soles above the ground under them [m], shape (..., 4).

    Parameters
    ----------
    qpos : ndarray, shape (..., 19)
    ground : Ground
    """
    w, x, y, z = np.moveaxis(qpos[..., 3:7], -1, 0)
    turn = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=-2,
    )  # fmt: skip
    flat = ground.heights is None and not len(ground.boxes)
    heights = []
    for i, leg in enumerate(LEGS):
        foot = foot_position(leg, *np.moveaxis(qpos[..., 7 + 3 * i : 10 + 3 * i], -1, 0))
        if flat:
            heights.append(qpos[..., 2] + (turn[..., 2, :] * foot).sum(axis=-1))
        else:
            at = qpos[..., :3] + np.einsum("...ij,...j->...i", turn, foot)
            heights.append(at[..., 2] - ground.height(at[..., 0], at[..., 1]))
    return np.stack(heights, axis=-1) - FOOT_RADIUS_M


def _by_kind(each: Array) -> Array:
    """Means over the legs, shape (n, 3), of values of all servos, shape (n, 12)."""
    return each.reshape(len(each), len(LEGS), len(KINDS)).mean(axis=1)
