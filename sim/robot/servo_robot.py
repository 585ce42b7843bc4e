"""A robot whose joints are turned by position servos, compiled for MuJoCo with any servos.

`mini_pupper_robot` is this project's own robot, `robot_of` any other from its MJCF or URDF: its
actuators are taken out, and each of its joints that is recorded, or that an actuator drove, gets
the servo of `sim.robot.servo_mjcf` instead. `compiled` gives the model with its trunk free, on the
ground, or fixed in the air, in the physics in which policies are evaluated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.hinges import hinges_of
from pupper_sysid.sim.robot.mini_pupper import EVALUATION_SOLVER, Knee, default_pose, robot_xml
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

    own = spec()
    model = _compile(own, path.name)
    if model.narena > _LARGEST_ARENA_BYTES:
        raise InputError(
            f"{path} asks for {model.narena / 1e9:.1f} GB of memory for the simulation. Take the "
            "size out, or give less than 1 GB."
        )
    rest = model.qpos0[[int(model.joint(name).qposadr[0]) for name in joints]]
    free = _root(own, joints[0]) is not None
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
    """The description with servos, and without what refers to its own actuators."""
    for own in (spec.actuators, spec.sensors, spec.keys):
        for element in list(own):
            spec.delete(element)
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
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"{name} cannot be simulated with servos on its joints: {reason}."
        ) from None
