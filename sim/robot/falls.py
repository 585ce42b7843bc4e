"""Falls, from where the bodies are: a robot that touches the ground with more than its feet.

The lowest points of trunk, hips and thighs are compared with the ground below them, so that a fall
needs no contact, and is the same in both kinds of physics (`sim.robot.mini_pupper.Physics`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.joints import LEGS
from pupper_sysid.sim.robot.mini_pupper import (
    HIP_BOX_AT_M,
    HIP_BOX_M,
    HIP_X_M,
    HIP_Y_M,
    SIDE,
    THIGH_M,
    THIGH_RADIUS_M,
    THIGH_X_M,
    THIGH_Y_M,
    TRUNK_BOX_AT_M,
    TRUNK_BOX_M,
)
from pupper_sysid.sim.robot.terrain import Ground

Array = NDArray[np.float64]

_SIDE = np.array([SIDE[leg] for leg in LEGS])
_HIP = np.stack([[HIP_X_M[leg] for leg in LEGS], _SIDE * HIP_Y_M, np.zeros(4)], axis=1)
_DOWN_M = float(np.hypot(THIGH_M, THIGH_Y_M)) + THIGH_RADIUS_M
_ASIDE_M = float(np.hypot(np.abs(_HIP[:, 0]).max() + THIGH_M, HIP_Y_M + _DOWN_M))
"""No point of trunk, hips and thighs is farther below the trunk's origin, or aside of it."""


def touches_ground(qpos: Array, gravity: Array, ground: Ground) -> NDArray[np.bool_]:
    """Whether trunk, hips or thighs touch the ground, shape (n,).

    Parameters
    ----------
    qpos : ndarray, shape (n, 19)
        MuJoCo's: position and quaternion of the trunk, joint angles.
    gravity : ndarray, shape (n, 3)
        Direction of gravity in the trunk's frame.
    ground : Ground
    """
    tilt = np.hypot(gravity[:, 0], gravity[:, 1])
    above = qpos[:, 2] - ground.highest_near(qpos[:, 0], qpos[:, 1])
    # a walking robot is too high for any pose to reach the ground, but with its feet
    low = np.flatnonzero(above < _DOWN_M + _ASIDE_M * tilt)
    found = np.zeros(len(qpos), bool)
    if len(low):
        points, radius = lowest_points(qpos[low, 7:])
        at = qpos[low, None, :3] + np.einsum("nij,npj->npi", _axes(qpos[low, 3:7]), points)
        gap = at[..., 2] - radius - ground.height(at[..., 0], at[..., 1])
        found[low] = gap.min(axis=1) < 0.0
    return found


def lowest_points(joints: Array) -> tuple[Array, Array]:
    """Points of which the lowest is that of trunk, hips and thighs, while the trunk is upright.

    Parameters
    ----------
    joints : ndarray, shape (n, 12)
        Joint angles [rad].

    Returns
    -------
    points : ndarray, shape (n, 28, 3)
        In the trunk's frame [m]: lower corners of the boxes, ends of the thighs.
    radius : ndarray, shape (28,)
        Around each point [m].
    """
    angles = joints.reshape(len(joints), 4, 3)
    thigh = angles[:, :, 1]
    corner = np.broadcast_to(_lower_corners(HIP_BOX_AT_M, HIP_BOX_M), (len(joints), 4, 4, 3)).copy()
    corner[..., 1] *= _SIDE[:, None]
    top = np.zeros((len(joints), 4, 2, 3))
    top[..., 0], top[..., 1] = THIGH_X_M, (_SIDE * THIGH_Y_M)[:, None]
    top[:, :, 1, 0] -= THIGH_M * np.sin(thigh)
    top[:, :, 1, 2] -= THIGH_M * np.cos(thigh)
    own = np.concatenate([corner, top], axis=2)  # in the hips' frames
    c, s = np.cos(angles[:, :, :1]), np.sin(angles[:, :, :1])
    y, z = own[..., 1].copy(), own[..., 2].copy()
    own[..., 1], own[..., 2] = c * y - s * z, s * y + c * z
    own += _HIP[:, None]
    trunk = np.broadcast_to(_lower_corners(TRUNK_BOX_AT_M, TRUNK_BOX_M), (len(joints), 4, 3))
    points = np.concatenate([trunk, own.reshape(len(joints), 24, 3)], axis=1)
    radius = np.zeros(points.shape[1])
    radius[4:].reshape(4, 6)[:, 4:] = THIGH_RADIUS_M
    return points, radius


def _lower_corners(at: tuple[float, ...], half: tuple[float, ...]) -> Array:
    """Lower four corners of a box, shape (4, 3)."""
    signs = np.array([(1, 1, -1), (1, -1, -1), (-1, 1, -1), (-1, -1, -1)])
    return np.array(at) + signs * half


def _axes(quaternion: Array) -> Array:
    """Rotation matrices, shape (n, 3, 3): columns are the trunk's axes in the world."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
