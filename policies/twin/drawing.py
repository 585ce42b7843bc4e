"""A robot in three dimensions: surfaces of its bodies, and where they were.

Of a recording the trunk is fixed in the air, since servos do not say where it was; joints that were
not recorded stay in the pose the robot is described in. Of a simulated walk all is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS, JointCalibration
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.replay import (
    ServoRobot,
    compiled,
    mini_pupper_robot,
    robot_of,
    servo_angles,
)
from pupper_sysid.sim.walking.servo_ranges import (
    IDEAL,
    check_actuator,
    is_servo_model,
    nearest_joint,
    servo_ranges,
)
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.view import Body, poses

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Actuator:
    """Servos of all joints of a robot."""

    values: dict[str, Array]
    """By field of `DelayedPDParameters`, shape (joints,)."""
    calibration: Calibration | None
    """The same with their feedback, for every joint; None of ideal servos."""
    fallbacks: dict[str, str]
    """Joints that were not calibrated, and the joint whose numbers they have."""


def actuator_of(name: str, robot: ServoRobot, recording: Recording) -> Actuator:
    """The servos that `name` means, on the joints of a robot.

    It is a calibration file, a servo card, a preset, or `ideal`.
    """
    check_actuator(name)
    if is_servo_model(name):
        raise InputError(
            f"{name} is a learned servo model: it predicts positions, whatever the servo carries. "
            "`pupper-sysid compare` takes it; give a calibration here."
        )
    if name == IDEAL:
        ideal = servo_ranges(IDEAL).value.items()
        return Actuator({f: np.full(len(robot.joints), x[0]) for f, x in ideal}, None, {})
    return of_calibration(load_calibration(name), robot, recording)


def of_calibration(calibration: Calibration, robot: ServoRobot, recording: Recording) -> Actuator:
    """The servos of a calibration, on the joints of a robot.

    A calibration that knows other P gains is taken at the one that the recording names.
    """
    calibration, fallbacks = spread_over(calibration, robot.joints)
    gains = {t.p_gain for joint in recording.joints for t in recording.trials(joint)}
    if len(gains) == 1 and np.isfinite(gain := gains.pop()):
        joints = {
            joint: fitted.at_p_gain(gain) if fitted.servo else fitted
            for joint, fitted in calibration.joints.items()
        }
        calibration = calibration.model_copy(update={"joints": joints})
    servos = [calibration.joint(joint).actuator for joint in robot.joints]
    values = {
        field: np.array([getattr(servo, key).value for servo in servos])
        for field, key in PARAMETER_KEYS.items()
    }
    return Actuator(values, calibration, fallbacks)


def stronger(values: dict[str, Array], factor: float) -> dict[str, Array]:
    """Servos with the same motion in free air whose torques are larger by a factor.

    `values` are by field of `DelayedPDParameters`, shape (joints,).
    """
    scaled = DelayedPDParameters(**values).scaled(factor * values["armature"])
    return {name: np.asarray(getattr(scaled, name)) for name in values}


def spread_over(
    calibration: Calibration, joints: tuple[str, ...]
) -> tuple[Calibration, dict[str, str]]:
    """A calibration for all of some joints, and those that have another's numbers."""
    near = {joint: nearest_joint(joint, calibration.joint_names) for joint in joints}
    spread: dict[str, JointCalibration] = {j: calibration.joint(n) for j, n in near.items()}
    fallbacks = {joint: n for joint, n in near.items() if n != joint}
    return calibration.model_copy(update={"joints": spread}), fallbacks


def robot_for(recording: Recording, model: Path | None = None) -> ServoRobot:
    """The robot that a recording is of.

    `model` is its MJCF or URDF; by default it is the Mini Pupper, if the joints are its.
    """
    joints = recording.joints
    if model is not None:
        return robot_of(model, joints)
    if strange := [joint for joint in joints if joint not in JOINT_NAMES]:
        raise InputError(
            f"{recording.name} has the joint {strange[0]}, which is none of the Mini Pupper's, so "
            "its robot is not known here. Give the robot's MJCF or URDF with `robot`."
        )
    bus = recording.metadata.get("bus") or {}
    return mini_pupper_robot("serial" if bus.get("linkage") == "none" else "linkage")


Surface = tuple[Array, NDArray[np.int64]]

POSES_PER_S = 30.0
_VISIBLE_GROUPS = 3  # MuJoCo's viewer shows groups 0 to 2
_ROUND = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_RING = np.stack([np.cos(_ROUND), np.sin(_ROUND), np.zeros_like(_ROUND)], axis=1)
_BALL = np.concatenate(
    [_RING * [np.cos(t), np.cos(t), 0] + [0, 0, np.sin(t)] for t in np.linspace(-1.5, 1.5, 9)]
)


def robot_over_time(recording: Recording, model: Path | None = None) -> tuple[Array, list[Body]]:
    """Bodies of the recorded robot at the readings, each held until the next.

    As `robot_for` finds it. Gives times [s], at most `POSES_PER_S` a second, and the bodies that
    have a shape.
    """
    robot = robot_for(recording, model)
    time_s, held = poses(recording, POSES_PER_S)
    servo = np.tile(robot.rest_rad, (len(time_s), 1))
    for k, joint in enumerate(robot.joints):
        servo[:, k] = held.get(joint, servo[:, k])
    return time_s, HungRobot(robot).bodies(servo)


class HungRobot:
    """A robot with its trunk fixed in the air, in poses of its servos."""

    def __init__(self, robot: ServoRobot):
        self.robot = robot
        self._model = compiled(robot, 0.0, fixed=True)
        self._surfaces = _surfaces(self._model)

    def bodies(self, servo_rad: Array, gravity: Array | None = None) -> list[Body]:
        """Its bodies that have a shape.

        Servo angles (n, joints) are as recordings have them, in the order of the robot's joints.
        The direction of gravity in the trunk's frame, shape (n, 3), gives roll and pitch; the
        heading stays forward. By default, and where it is NaN, the trunk is level.
        """
        model = self._model
        qpos = np.tile(model.qpos0, (len(servo_rad), 1))
        at = [int(model.joint(name).qposadr[0]) for name in self.robot.joints]
        # a servo that turns a tendon turns several joints
        qpos[:, at] = (servo_rad + self.robot.shift_rad) @ np.linalg.inv(servo_angles(model)[at])
        bodies = bodies_over_time(model, qpos, self._surfaces)
        return bodies if gravity is None else _tilted(bodies, gravity)


def bodies_over_time(
    model: Any, qpos: Array, surfaces: dict[int, Surface] | None = None
) -> list[Body]:
    """Bodies of a robot that have a shape, in its poses.

    Poses are `qpos`, shape (n, model.nq); `surfaces` the shapes, by number of the body, where they
    are known already.
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
    """All visible shapes of each body that has one as one surface in its frame, by its number."""
    surfaces = {}
    for body in range(1, model.nbody):
        vertices, triangles, count = [], [], 0
        first = int(model.body_geomadr[body])
        for geom in range(first, first + int(model.body_geomnum[body])):
            shape = None if model.geom_group[geom] >= _VISIBLE_GROUPS else _shape(model, geom)
            if shape is not None:
                turn = np.empty(9)
                mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
                vertices.append(shape[0] @ turn.reshape(3, 3).T + model.geom_pos[geom])
                triangles.append(shape[1] + count)
                count += len(shape[0])
        if vertices:
            surfaces[body] = np.concatenate(vertices), np.concatenate(triangles)
    return surfaces


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
    return None if points is None else (points, ConvexHull(points).simplices.astype(np.int64))
