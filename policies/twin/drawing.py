"""A robot in three dimensions: surfaces of its bodies, and where they were.

Of a recording the trunk is fixed in the air, since servos do not say where it was; joints that were
not recorded stay in the pose the robot is described in. Of a simulated walk all is known.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from pupper_sysid.policies.twin.actuators import robot_for
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.servo_robot import compiled
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.view.channels import poses
from pupper_sysid.sysid.view.rerun_file import Body

if TYPE_CHECKING:
    from pupper_sysid.sim.robot.servo_robot import ServoRobot

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
    """
    robot = robot_for(recording, model)
    time_s, held = poses(recording, POSES_PER_S)
    servo = np.tile(robot.rest_rad, (len(time_s), 1))
    for k, joint in enumerate(robot.joints):
        servo[:, k] = held.get(joint, servo[:, k])
    return time_s, HungRobot(robot).bodies(servo)


class HungRobot:
    """A robot with its trunk fixed in the air, in poses of its servos.

    Parameters
    ----------
    robot : ServoRobot
    """

    def __init__(self, robot: ServoRobot):
        self.robot = robot
        self._model = compiled(robot, 0.0, fixed=True)
        self._surfaces = _surfaces(self._model)

    def bodies(self, servo_rad: Array, gravity: Array | None = None) -> list[Body]:
        """Its bodies that have a shape.

        Parameters
        ----------
        servo_rad : ndarray, shape (n, joints)
            Servo angles as recordings have them, in the order of the robot's joints.
        gravity : ndarray, shape (n, 3), optional
            Direction of gravity in the trunk's frame, which gives roll and pitch; the heading stays
            forward. By default, and where it is NaN, the trunk is level.
        """
        model, joints = self._model, self.robot.joints
        data = mujoco.MjData(model)
        qpos = np.tile(data.qpos, (len(servo_rad), 1))
        at = [int(model.joint(name).qposadr[0]) for name in joints]
        qpos[:, at] = _joint_angles(model, data, joints, servo_rad + self.robot.shift_rad)
        found = bodies_over_time(model, qpos, self._surfaces)
        return found if gravity is None else _tilted(found, gravity)


def bodies_over_time(
    model: Any, qpos: Array, surfaces: dict[int, Surface] | None = None
) -> list[Body]:
    """Bodies of a robot that have a shape, in its poses.

    Parameters
    ----------
    model : mujoco.MjModel
    qpos : ndarray, shape (n, model.nq)
    surfaces : dict, optional
        The shapes, by number of the body, where they are known already.

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
    return [
        Body(
            model.body(body).name or f"body_{body}", *surface, position[:, body],
            quaternion[:, body],
        )
        for body, surface in (surfaces or _surfaces(model)).items()
    ]  # fmt: skip


def _tilted(bodies: list[Body], gravity: Array) -> list[Body]:
    """Bodies turned about the first one's place, the trunk's, by roll and pitch."""
    down = np.where(np.isfinite(gravity), gravity, [0.0, 0.0, -1.0])
    roll = np.arctan2(-down[:, 1], -down[:, 2])
    pitch = np.arctan2(down[:, 0], np.hypot(down[:, 1], down[:, 2]))
    turn = Rotation.from_euler("xy", np.stack([roll, pitch], axis=1))  # about the world's axes
    trunk = bodies[0].position
    return [
        replace(
            body, position=trunk + turn.apply(body.position - trunk),
            quaternion=(turn * Rotation.from_quat(body.quaternion)).as_quat(),
        )
        for body in bodies
    ]  # fmt: skip


def _surfaces(model: Any) -> dict[int, Surface]:
    """Shapes of the bodies that have one, by their numbers."""
    every = ((body, _surface_of(model, body)) for body in range(1, model.nbody))
    return {body: surface for body, surface in every if surface is not None}


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
