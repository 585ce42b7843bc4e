"""A robot under given commands: many copies at once, each with its own servos and its own ground.

`replay` steps the whole robot of a `ServoRobot` in `mujoco.batch`: links with their masses, gravity
and, where its trunk is free, contacts with the ground. Commands are given for every physics step,
so that they act when they were sent. Copies rest under their first set-point for a second before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sim.robot import servo_mjcf
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.motion import gravity_direction
from pupper_sysid.sim.robot.servo_robot import ServoRobot, compiled

Array = NDArray[np.float64]

SETTLE_S = 1.0
_FALLEN = 0.5  # cosine of the tilt of a trunk from how it stood
GYRO_STEPS = 10
"""Physics steps between samples of the gyro."""
_CHUNK = 50 * GYRO_STEPS  # physics steps per call: what is recorded of them must fit the memory
_GAP_M, _FAR_M = 0.002, 10.0
_BEYOND_RAD = 0.05  # of a limit beyond what was read


@dataclass(frozen=True)
class Replayed:
    """Motion of n copies of a robot."""

    servo_rad: NDArray[np.float32]
    """Servo angles at the edges of physics steps, as recordings have them; shape (n, steps + 1,
    joints)."""
    fell_s: Array
    """When a trunk had tilted by 60° [s]; infinite where it never did, or is fixed; shape (n,)."""
    gyro_rad_s: NDArray[np.float32]
    """Rates of the trunk about its own axes at every tenth step; 0 where it is fixed; shape (n,
    steps // 10, 3)."""


def replay(
    robot: ServoRobot,
    fixed: bool,
    servos: Mapping[str, Array],
    commands: Array,
    which: NDArray[np.intp],
    reach: Array,
    friction: Array,
    payload: Array,
    threads: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> Replayed:
    """Let copies of a robot move under commands.

    The trunk of a free robot can be `fixed` in the air. `servos` are arrays of shape (n, joints) by
    field of `DelayedPDParameters`.

    `commands`, shape (sequences, steps + 1, joints), are set-points [rad] as recordings have them:
    those in force for long before, then those of each physics step; `which`, shape (n,), is the
    sequence of each copy. Limits of the robot's description that are narrower than the servo angles
    at which it has been, `reach`, shape (rows, joints), are widened to hold them.

    `friction` is the sliding friction of all contacts of a copy, `payload` the share of the robot's
    mass that is added to its trunk, both shape (n,). `threads` are 0 for all cores; `progress` is
    called with the share that is done.
    """
    from mujoco.batch import Batch  # needs mujoco 4; its message names the module

    model = compiled(robot, float(servos["dead_time_s"].max()), fixed)
    joints = np.array([int(model.joint(name).qposadr[0]) for name in robot.joints])
    mix = _mixing(model)  # servo angles are qpos @ mix
    unmix = np.linalg.inv(mix[joints])
    reached = (reach + robot.shift_rad) @ unmix
    low, high = reached.min(axis=0) - _BEYOND_RAD, reached.max(axis=0) + _BEYOND_RAD
    for joint, name in enumerate(robot.joints):  # each may go to where it was read
        ends = model.joint(name).range
        ends[:] = min(ends[0], low[joint]), max(ends[1], high[joint])
    trunk = int(model.body_rootid[model.joint(robot.joints[0]).bodyid[0]])
    base = int(model.body_jntadr[trunk])
    free = base >= 0 and model.jnt_type[base] == mujoco.mjtJoint.mjJNT_FREE
    root = int(model.jnt_qposadr[base]) if free else None  # of its position in qpos
    spin = int(model.body_dofadr[trunk]) + 3  # a free joint's rates are in the body's axes
    n, steps = len(which), commands.shape[1] - 1
    batch = Batch(model, n, threads)
    _equip(batch, model, servos, friction, payload, trunk)
    held = commands[which, 0] + robot.shift_rad
    qpos = batch.bind("qpos")
    qpos[:, joints] = held @ unmix
    if root is not None:
        qpos[:, root + 2] += _lift(model, trunk, qpos)
    before = _down(qpos, root)
    batch.bind("ctrl")[:] = batch.bind("act")[:] = held
    batch.bind("history")[:] = servo_mjcf.delay_lines(servo_mjcf.empty_delay_lines(model), held)
    warned = batch.warning.copy()
    batch.step(None, round(SETTLE_S / TIME_STEP_S))
    found = np.empty((n, steps + 1, len(robot.joints)), np.float32)
    fell = np.full(n, np.inf)
    found[:, 0] = qpos @ mix - robot.shift_rad
    gyro = np.zeros((n, steps // GYRO_STEPS, 3), np.float32)
    for at in range(0, steps, _CHUNK):
        control = commands[which, at + 1 : at + 1 + _CHUNK] + robot.shift_rad
        count = control.shape[1]
        recorded = batch.rollout(count, control, record=("qpos", "qvel"))
        moved = recorded["qpos"]
        found[:, at + 1 : at + 1 + count] = moved @ mix - robot.shift_rad
        fallen = np.einsum("nsk,nk->ns", _down(moved, root), before) < _FALLEN
        when = TIME_STEP_S * (at + 1 + fallen.argmax(axis=1))
        fell = np.minimum(fell, np.where(fallen.any(axis=1), when, np.inf))
        if root is not None:
            seen = recorded["qvel"][:, GYRO_STEPS - 1 :: GYRO_STEPS, spin : spin + 3]
            gyro[:, at // GYRO_STEPS :][:, : seen.shape[1]] = seen
        progress((at + count) / steps)
    if (batch.warning != warned).any() or not np.isfinite(found).all():
        raise InputError(
            f"{robot.name} becomes unstable in physics steps of {1e3 * TIME_STEP_S:g} ms with one "
            "of these actuators. Leave out the one that is stiffest for its armature."
        )
    return Replayed(found, fell, gyro)


def _mixing(model) -> Array:
    """Angle of each servo by positions of joints, shape (nq, servos)."""
    mix = np.zeros((model.nq, model.nu))
    kinds = zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)
    for servo, (kind, target) in enumerate(kinds):
        if kind == mujoco.mjtTrn.mjTRN_JOINT:
            mix[model.jnt_qposadr[target], servo] = 1.0
            continue
        first = model.tendon_adr[target]
        for wrap in range(first, first + model.tendon_num[target]):
            mix[model.jnt_qposadr[model.wrap_objid[wrap]], servo] = model.wrap_prm[wrap]
    return mix


def _equip(
    batch, model, servos: Mapping[str, Array], friction: Array, payload: Array, trunk: int
) -> None:
    """Give each copy its servos, its friction and its payload."""
    targets = model.actuator_trnid[:, 0]
    on_tendon = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    tendon_of = {int(i): int(targets[i]) for i in np.flatnonzero(on_tendon)}
    dof_of = {int(i): int(model.jnt_dofadr[targets[i]]) for i in np.flatnonzero(~on_tendon)}
    names = (
        *servo_mjcf.BATCH_FIELDS,
        "geom_friction",
        "body_mass",
        *(servo_mjcf.TENDON_FIELDS if tendon_of else ()),
    )
    fields = {name: batch.expand(name) for name in names}
    servo_mjcf.write_servos(fields, np.arange(len(friction)), servos, dof_of, tendon_of)
    fields["geom_friction"][:, :, 0] = friction[:, None]
    fields["body_mass"][:, trunk] += payload * model.body_subtreemass[trunk]
    batch.set_const()


def _lift(model, trunk: int, qpos: Array) -> Array:
    """Height by which each copy must be lifted to be just above the ground [m], shape (n,)."""
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    own = np.flatnonzero(touching & (model.body_rootid[model.geom_bodyid] == trunk))
    ground = np.flatnonzero(touching & (model.geom_bodyid == 0))
    poses, which = np.unique(qpos, axis=0, return_inverse=True)
    gaps, data = [], mujoco.MjData(model)
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        gaps.append(
            min(
                (
                    mujoco.mj_geomDistance(model, data, int(a), int(b), _FAR_M, None)
                    for a in ground
                    for b in own
                ),
                default=0.0,
            )
        )
    return _GAP_M - np.array(gaps)[which.ravel()]


def _down(qpos: Array, root: int | None) -> Array:
    """Direction of gravity in the trunk's frame, shape (..., 3); z where it is fixed."""
    if root is None:
        return np.broadcast_to([0.0, 0.0, -1.0], (*qpos.shape[:-1], 3))
    own = qpos[..., root : root + 7]
    return gravity_direction(own.reshape(-1, 7)).reshape(*own.shape[:-1], 3)
