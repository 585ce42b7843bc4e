"""A robot under given commands: many copies at once, each with its own servos and its own ground.

`mini_pupper_robot` is the Mini Pupper 2, `robot_of` any other from its MJCF or URDF: its
actuators are taken out, and each of its joints that is recorded, or that an actuator drove, gets
the servo of `sim.robot.servo_mjcf` instead. `compiled` gives the model with its trunk free, on the
ground, or fixed in the air, in the physics in which policies are evaluated.

`replay` steps the whole robot of such a `ServoRobot` in `mujoco.batch`: links with their masses,
gravity and, where its trunk is free, contacts with the ground. Commands are given for every physics
step, so that they act when they were sent. Copies rest under their first set-point for a second
before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters
from pupper_sysid.sim.robot import servo_mjcf
from pupper_sysid.sim.robot.engine import in_a_line, mujoco
from pupper_sysid.sim.robot.hinges import hinges_of
from pupper_sysid.sim.robot.mini_pupper import EVALUATION_SOLVER, Knee, default_pose, robot_xml
from pupper_sysid.sim.robot.robot_batch import gravity_direction
from pupper_sysid.sim.robot.servo_mjcf import FRICTION_SOLIMP, friction_solref

Array = NDArray[np.float64]

_IN_THE_AIR_M = 1.0
_LARGEST_ARENA_BYTES = 1 << 30  # MuJoCo allocates it once per thread
_NUMBERS = DelayedPDParameters(
    stiffness=1.0, damping=0.1, friction_loss=0.1, armature=1e-3, effort_limit=1.0,
    velocity_limit=1.0, dead_time_s=0.0,
)  # fmt: skip
"""Of a servo before its own are written; none is without limit, or MuJoCo would leave it out."""


@dataclass(frozen=True)
class ServoRobot:
    """A robot and its servos' joints, before it is compiled."""

    name: str
    joints: tuple[str, ...]
    """With a servo each, in the order of all arrays."""
    rest_rad: Array
    """Servo angles of the pose that it is described in, as recordings have them; shape
    (joints,)."""
    shift_rad: Array
    """MuJoCo's servo angle less that of a recording: behind a linkage a recording's is measured
    with the other joint at its neutral; shape (joints,)."""
    free: bool
    """Whether it can stand on the ground: nothing fixes it to the world."""
    spec: Callable[[], Any]
    """Its description, a new `mujoco.MjSpec` with a servo on each joint."""


def mini_pupper_robot(knee: Knee = "linkage") -> ServoRobot:
    """The Mini Pupper 2 in its default pose."""
    rest, shift = default_pose(), np.zeros(len(JOINT_NAMES))
    if knee == "linkage":
        shift[2::3] = rest[1::3]
    servos = dict.fromkeys(JOINT_NAMES, _NUMBERS)
    xml = robot_xml(servos, TIME_STEP_S, knee, imu=False)
    spec = mujoco.MjSpec.from_string
    return ServoRobot("Mini Pupper 2", JOINT_NAMES, rest, shift, True, lambda: spec(xml))


def robot_of(path: Path, recorded: Sequence[str]) -> ServoRobot:
    """A robot from its MJCF or URDF, with servos on its driven and on its recorded joints.

    `recorded` are the joints of the recordings.
    """
    hinges = {hinge.name: hinge for hinge in hinges_of(path)}  # also holds it to limits
    if missing := [joint for joint in recorded if joint not in hinges]:
        raise InputError(
            f"{path} has no hinge {', '.join(missing)}, which the recording has. Its hinges are "
            f"{', '.join(hinges) or 'none'}. Rename them there as in the recording."
        )
    joints = (*recorded, *(n for n, h in hinges.items() if h.driven and n and n not in recorded))

    def spec() -> Any:
        return _with_servos(mujoco.MjSpec.from_file(str(path)), joints)

    description = spec()
    model = _compile(description, path.name)
    if model.narena > _LARGEST_ARENA_BYTES:
        raise InputError(
            f"{path} asks for {model.narena / 1e9:.1f} GB of memory for the simulation. Take the "
            "size out, or give less than 1 GB."
        )
    rest = model.qpos0[[int(model.joint(name).qposadr[0]) for name in joints]]
    free = _root(description, joints[0]) is not None
    return ServoRobot(path.stem, joints, rest, np.zeros(len(joints)), free, spec)


def compiled(robot: ServoRobot, longest_dead_time_s: float, fixed: bool) -> Any:
    """The robot as a `mujoco.MjModel` in steps of 2 ms; its actuators are the servos, in order.

    Its servos have at most that dead time [s]. A free robot is above the ground, or, if `fixed`,
    hangs in the air, its trunk fixed.
    """
    spec = robot.spec()
    root = _root(spec, robot.joints[0])
    if root is not None and fixed:
        root.parent.pos = root.parent.pos + np.array([0.0, 0.0, _IN_THE_AIR_M])
        spec.delete(root)
    elif root is not None and not any(g.contype or g.conaffinity for g in spec.worldbody.geoms):
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(type=plane, size=[0, 0, 0.05], contype=1, conaffinity=1)
    for actuator in spec.actuators:
        # two more than whole steps: MuJoCo silently truncates a delay beyond its buffer
        actuator.nsample = int(longest_dead_time_s / TIME_STEP_S) + 2
    option = spec.option
    option.timestep = TIME_STEP_S
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    for name in ("iterations", "ls_iterations", "tolerance"):
        setattr(option, name, EVALUATION_SOLVER[name])
    model = _compile(spec, robot.name)
    dofs = [int(model.joint(name).dofadr[0]) for name in robot.joints]
    model.dof_solref[dofs] = friction_solref(TIME_STEP_S)
    model.dof_solimp[dofs] = FRICTION_SOLIMP
    return model


def _with_servos(spec: Any, joints: Sequence[str]) -> Any:
    """The description with servos, and without what refers to its former actuators."""
    for elements in (spec.actuators, spec.sensors, spec.keys):
        for element in list(elements):
            spec.delete(element)
    servo_mjcf.forget_actuator_defaults(spec)
    for name in joints:
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_pid(1.0, 0.1, slewmax=1.0, ctrlspec=1)  # commands are positions
        servo.interp, servo.nsample = 1, 2
        servo.forcelimited, servo.forcerange = 1, [-1.0, 1.0]
    return spec


def _root(spec: Any, joint: str) -> Any:
    """The free joint of the body that carries a joint; None if it is fixed to the world."""
    body = spec.joint(joint).parent
    while body.parent is not None and body.parent.name != spec.worldbody.name:
        body = body.parent
    return next((j for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_FREE), None)


def _compile(spec: Any, name: str) -> Any:
    try:
        return spec.compile()
    except ValueError as error:
        raise InputError(
            f"{name} cannot be simulated with servos on its joints: {in_a_line(error)}."
        ) from None


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
    mix = servo_angles(model)  # servo angles are qpos @ mix
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
        qpos[:, root + 2] += _lift_m(model, trunk, qpos)
    before = _down(qpos, root)
    batch.bind("ctrl")[:] = batch.bind("act")[:] = held
    batch.bind("history")[:] = servo_mjcf.delay_lines(servo_mjcf.empty_delay_lines(model), held)
    warned = batch.warning.copy()
    batch.step(None, round(SETTLE_S / TIME_STEP_S))
    servo_rad = np.empty((n, steps + 1, len(robot.joints)), np.float32)
    fell = np.full(n, np.inf)
    servo_rad[:, 0] = qpos @ mix - robot.shift_rad
    gyro = np.zeros((n, steps // GYRO_STEPS, 3), np.float32)
    for at in range(0, steps, _CHUNK):
        control = commands[which, at + 1 : at + 1 + _CHUNK] + robot.shift_rad
        count = control.shape[1]
        recorded = batch.rollout(count, control, record=("qpos", "qvel"))
        moved = recorded["qpos"]
        servo_rad[:, at + 1 : at + 1 + count] = moved @ mix - robot.shift_rad
        fallen = np.einsum("nsk,nk->ns", _down(moved, root), before) < _FALLEN
        when = TIME_STEP_S * (at + 1 + fallen.argmax(axis=1))
        fell = np.minimum(fell, np.where(fallen.any(axis=1), when, np.inf))
        if root is not None:
            seen = recorded["qvel"][:, GYRO_STEPS - 1 :: GYRO_STEPS, spin : spin + 3]
            gyro[:, at // GYRO_STEPS :][:, : seen.shape[1]] = seen
        progress((at + count) / steps)
    if (batch.warning != warned).any() or not np.isfinite(servo_rad).all():
        raise InputError(
            f"{robot.name} becomes unstable in physics steps of {1e3 * TIME_STEP_S:g} ms with one "
            "of these actuators. Leave out the one that is stiffest for its armature."
        )
    return Replayed(servo_rad, fell, gyro)


def servo_angles(model: Any) -> Array:
    """Matrix, shape (nq, servos), by which positions of joints give the angles of the servos."""
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


def _lift_m(model, trunk: int, qpos: Array) -> Array:
    """Height by which each copy must be lifted to be just above the ground [m], shape (n,)."""
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    touching_trunk = np.flatnonzero(touching & (model.body_rootid[model.geom_bodyid] == trunk))
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
                    for b in touching_trunk
                ),
                default=0.0,
            )
        )
    return _GAP_M - np.array(gaps)[which.ravel()]


def _down(qpos: Array, root: int | None) -> Array:
    """Direction of gravity in the trunk's frame, shape (..., 3); z where it is fixed."""
    if root is None:
        return np.broadcast_to([0.0, 0.0, -1.0], (*qpos.shape[:-1], 3))
    pose = qpos[..., root : root + 7]
    return gravity_direction(pose.reshape(-1, 7)).reshape(*pose.shape[:-1], 3)
