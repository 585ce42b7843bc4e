"""A robot in three dimensions: surfaces of its bodies, and where they were.

Of a recording the trunk is fixed in the air, since servos do not say where it was; joints that were
not recorded stay in the pose the robot is described in. Of a simulated walk all is known.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from pupper_sysid.policies.twin.actuators import robot_for
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.servo_robot import compiled
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.view.channels import poses
from pupper_sysid.sysid.view.rerun_file import Body

Array = NDArray[np.float64]
Surface = tuple[Array, NDArray[np.int64]]

POSES_PER_S = 30.0
_VISIBLE_GROUPS = 3  # MuJoCo's own viewer shows groups 0 to 2
_ROUND = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_RING = np.stack([np.cos(_ROUND), np.sin(_ROUND), np.zeros_like(_ROUND)], axis=1)
_BALL = np.concatenate(
    [_RING * [np.cos(t), np.cos(t), 0] + [0, 0, np.sin(t)] for t in np.linspace(-1.5, 1.5, 9)]
)


def robot_over_time(recording: Recording, model: Path | None = None) -> tuple[Array, list[Body]]:
    """Bodies of the recorded robot at the readings, each held until the next.

    Parameters
    ----------
    recording : Recording
    model : Path, optional
        MJCF or URDF of the robot; by default the Mini Pupper.

    Returns
    -------
    time_s : ndarray, shape (n,)
        At most `POSES_PER_S` a second [s].
    bodies : list of Body
        Those that have a shape.

    Raises
    ------
    InputError
        If the robot cannot be read, or lacks a recorded joint.
    """
    robot = robot_for(recording, model)
    made = compiled(robot, 0.0, fixed=True)
    time_s, held = poses(recording, POSES_PER_S)
    servo = np.tile(robot.rest_rad, (len(time_s), 1))
    for k, joint in enumerate(robot.joints):
        servo[:, k] = held.get(joint, servo[:, k])
    data = mujoco.MjData(made)
    angle = _joint_angles(made, data, robot.joints, servo + robot.shift_rad)
    at = [int(made.joint(name).qposadr[0]) for name in robot.joints]
    qpos = np.tile(data.qpos, (len(time_s), 1))
    qpos[:, at] = angle
    return time_s, bodies_over_time(made, qpos)


def bodies_over_time(model: Any, qpos: Array) -> list[Body]:
    """Bodies of a robot that have a shape, in its poses.

    Parameters
    ----------
    model : mujoco.MjModel
    qpos : ndarray, shape (n, model.nq)

    Returns
    -------
    list of Body
    """
    data = mujoco.MjData(model)
    position = np.empty((len(qpos), model.nbody, 3))
    quaternion = np.empty((len(qpos), model.nbody, 4))
    for k, row in enumerate(qpos):  # kinematics only
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        position[k], quaternion[k] = data.xpos, np.roll(data.xquat, -1, axis=1)
    bodies = []
    for body in range(1, model.nbody):
        if (surface := _surface_of(model, body)) is not None:
            name = model.body(body).name or f"body_{body}"
            bodies.append(Body(name, *surface, position[:, body], quaternion[:, body]))
    return bodies


def _joint_angles(model: Any, data: Any, joints: tuple[str, ...], servo: Array) -> Array:
    """Joint angles of servo angles: a servo that turns a tendon turns several joints."""
    at = [int(model.joint(name).qposadr[0]) for name in joints]

    def lengths(angles: Array) -> Array:
        data.qpos[at] = angles
        mujoco.mj_fwdPosition(model, data)
        return data.actuator_length.copy()

    zero = lengths(np.zeros(len(at)))
    moment = np.stack([lengths(row) - zero for row in np.eye(len(at))], axis=1)
    return np.linalg.solve(moment, (servo - zero).T).T.astype(np.float64)


def _surface_of(model: Any, body: int) -> Surface | None:
    """All visible shapes of a body as one surface in its frame; None where it has none."""
    vertices, triangles, count = [], [], 0
    first = int(model.body_geomadr[body])
    for geom in range(first, first + int(model.body_geomnum[body])):
        if model.geom_group[geom] >= _VISIBLE_GROUPS:
            continue
        shape = _shape(model, geom)
        if shape is None:
            continue
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        vertices.append(shape[0] @ turn.reshape(3, 3).T + model.geom_pos[geom])
        triangles.append(shape[1] + count)
        count += len(shape[0])
    return (np.concatenate(vertices), np.concatenate(triangles)) if vertices else None


def _shape(model: Any, geom: int) -> Surface | None:
    """A geom's surface in its own frame; None of planes and height fields."""
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        v, f = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
        return (
            model.mesh_vert[v : v + int(model.mesh_vertnum[mesh])].astype(float),
            model.mesh_face[f : f + int(model.mesh_facenum[mesh])].astype(np.int64),
        )
    up = np.array([0.0, 0.0, size[1]])
    points = {
        mujoco.mjtGeom.mjGEOM_BOX: _CORNERS * size,
        mujoco.mjtGeom.mjGEOM_SPHERE: _BALL * size[0],
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: _BALL * size,
        mujoco.mjtGeom.mjGEOM_CYLINDER: np.concatenate([_RING * size[0] + s * up for s in (-1, 1)]),
        mujoco.mjtGeom.mjGEOM_CAPSULE: np.concatenate([_BALL * size[0] + s * up for s in (-1, 1)]),
    }.get(kind)
    if points is None:
        return None
    return points, ConvexHull(points).simplices.astype(np.int64)
