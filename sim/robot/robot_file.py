"""A walking robot from its MJCF or URDF and a few lines of YAML, with measured servos on it.

    joints: [FR_hip_joint, …]      # by default those that position actuators or motors drive
    feet: [FR, FL, RR, RL]         # sites, geoms or bodies; by default the lowest geoms
    pose: home                     # a keyframe, or angles by joint: {"*_thigh_joint": 0.9, …}
    servos: LF_thigh               # one servo of the calibration for all, or {"*_hip_*": LF_hip, …}
    gait: trot                     # or walk, or {FR: 0.5, …}: shares of a cycle behind the first
    forward: y                     # where the front is in the trunk's frame, by default x
    commands: {forward_m_s: [-0.6, 0.6], sideways_m_s: [-0.3, 0.3], yaw_rad_s: [-1, 1]}

All lines may be left out; names may be patterns. z is up in the trunk's frame. The robot's own
actuators, sensors and ground are taken out, hinges without a servo fixed; visual meshes are not
needed. `Body.notes` lists the assumptions.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pupper_sysid.common.border import read_yaml, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.robot.body import Body, fixed_offsets
from pupper_sysid.sim.robot.engine import in_a_line, mujoco
from pupper_sysid.sim.robot.hinges import driven_joints, leaders
from pupper_sysid.sim.robot.mini_pupper import EVALUATION_SOLVER, Physics
from pupper_sysid.sim.robot.servo_mjcf import (
    FRICTION_SOLIMP,
    forget_actuator_defaults,
    friction_solref,
)
from pupper_sysid.sim.robot.terrain import Ground

Array = NDArray[np.float64]

_SAME_HEIGHT = 0.1  # feet's lowest points differ by less, in shares of the standing height
_SAME_SOLE = 0.03  # of the geoms of one foot, likewise
_LYING = 0.2  # sine of the slope below which an edge of a foot counts as nearly level
_SAME_PLACE = 0.06  # of a joint and its mirror image, likewise
_TOUCH = 1.3  # radius of a touch sensor's site, in those of the geom
_INVERSE_STEPS, _NUDGE_RAD = 6, 1e-4
_DAMPING, _LEVEL = 0.02, 0.05  # standing heights per rad: of joints, and of a sole's tilt
_HEIGHTS_M = (0.01, 5.0)  # of robots that walk
_NEGLIGIBLE = 1e-3  # inertia, in masses of the robot times standing heights squared
_WIDEST, _USUAL_GYRATION = 2.0, 0.3  # radii of gyration, in standing heights
_STEP, _REACHED = 0.05, 0.3  # of feet that are tried, in standing heights; share that is enough
_WAYS = {"forward_m_s": "forward", "sideways_m_s": "sideways"}
_FALLEN = 0.5  # share of the standing height below which the trunk has come down
_WALK = (0.0, 0.5, 0.75, 0.25)  # left front, right front, left rear, right rear
_STANDING = ("home", "stand", "standing", "default")  # names of keyframes to stand in
_QUARTERS = {"y": -1, "-x": 2, "-y": 1}  # of a turn to the left, to x
_AXES = ("x", "y", "-x", "-y")
_WORDS = {
    "front": "F", "fore": "F", "rear": "B", "back": "B", "hind": "B", "left": "L", "right": "R"
}  # fmt: skip
_REAR = {"RL": "BL", "LR": "BL", "RR": "BR"}  # codes in which an R stands for the rear
_CORNERS = {"FL": (1, 1), "FR": (1, -1), "BL": (-1, 1), "BR": (-1, -1)}
_PARTS = ("bodies", "geoms", "sites", "cameras", "lights", "frames")
_LEFT_RIGHT, _FRONT_BACK = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0])
_TRAINING_ITERATIONS = 8  # of PGS, as of the Mini Pupper

_Ends = Annotated[list[Annotated[float, Field(ge=-100, le=100)]], Field(min_length=2, max_length=2)]


class _Commands(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    forward_m_s: _Ends | None = None
    sideways_m_s: _Ends | None = None
    yaw_rad_s: _Ends | None = None


class RobotFile(BaseModel):
    """The YAML beside a MJCF."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    joints: list[str] | None = None
    feet: list[str] | None = None
    pose: str | dict[str, float] | None = None
    servos: str | dict[str, str] | None = None
    gait: str | dict[str, float] = "trot"
    forward: Literal["x", "y", "-x", "-y"] = "x"
    commands: _Commands = Field(default_factory=_Commands)


def body_from_file(path: Path, config: Path | None) -> Body:
    """The body of a robot's MJCF or URDF; `config` is its YAML."""
    if not path.is_file():
        raise InputError(f"There is no {path}. Give the robot's MJCF or URDF as `robot`.")
    settings = RobotFile()
    if config is not None:
        if not config.is_file():
            raise InputError(f"There is no {config}. Give the robot's YAML as `robot_config`.")
        content, lines = read_yaml(config)
        settings = validated(RobotFile, content or {}, config, lines)
    return _Reader(path, config, settings).body()


class _Reader:
    """One robot's file on its way to a `Body`."""

    def __init__(self, path: Path, config: Path | None, settings: RobotFile):
        self.path, self.config, self.settings = path, config, settings
        self.where = str(config or path)
        self.notes: list[str] = []
        try:
            self.spec = mujoco.MjSpec.from_file(str(path))
        except ValueError as error:
            raise InputError(f"{path} is no MJCF that MuJoCo reads: {in_a_line(error)}.") from None
        bodies = self.spec.worldbody.bodies
        if len(bodies) and path.suffix == ".urdf":  # which cannot state that its base is free
            compiler = self.spec.compiler
            compiler.fusestatic, compiler.balanceinertia = False, True
            compiler.boundmass, compiler.boundinertia = 1e-6, 1e-9  # of frames without a mass
            bodies[0].add_freejoint()
            for mesh in self.spec.meshes:
                mesh.file = self._in_package(mesh.file)
        self.root = self._alone()
        self._remove_visuals()
        for k, body in enumerate(self.spec.bodies):
            body.name = body.name or ("trunk" if body is self.root else f"body {k}")
            body.gravcomp = 0.0
        if settings.forward != "x":
            self._turn_forward(_QUARTERS[settings.forward])
        original = self._compiled()
        self.joints = self._servo_joints(original)
        self.resting = self._keyframe(original)
        self._strip(original)
        self.model = self._compiled()
        self.pose, self.low, self.high = self._pose(original)
        self.data = mujoco.MjData(self.model)
        self._place(self.pose)
        self.feet = self._feet()

    # ------------------------------------------------------------------------- the MJCF

    def _alone(self) -> Any:
        """The robot's trunk; what else is in its world is taken out."""
        spec, world, joint = self.spec, self.spec.worldbody, mujoco.mjtJoint
        floating = [b for b in world.bodies if any(j.type == joint.mjJNT_FREE for j in b.joints)]
        hinged = [
            b for b in floating if any(j.type == joint.mjJNT_HINGE for j in b.find_all("joint"))
        ]
        if not floating:
            first = (world.bodies[0].name or "without a name") if len(world.bodies) else "none"
            raise InputError(
                f"{self.path} has no floating base: its first body ({first}) is fixed to the "
                "world, so the robot cannot walk. Give that body a <freejoint/>."
            )
        if len(hinged) > 1:
            raise InputError(
                f"{self.path} has {len(hinged)} floating bodies with hinges "
                f"({', '.join(b.name for b in hinged)}); a robot has one. Take the others out."
            )
        trunk = (hinged or floating)[0]
        others = [body for body in world.bodies if body != trunk]
        for element in (*world.geoms, *world.sites, *spec.cameras, *others):
            spec.delete(element)
        return trunk

    def _in_package(self, uri: str) -> str:
        """File of a `package://` path, looked for in the folders above the robot's file."""
        parts = Path(uri.partition("://")[2]).parts
        for folder in self.path.resolve().parents if parts else ():
            for file in (folder.joinpath(*parts), folder.joinpath(*parts[1:])):
                if file.is_file():
                    return str(file)
        return uri

    def _remove_visuals(self) -> None:
        """Take out what is only shown, and meshes whose files are not there."""
        spec, types = self.spec, mujoco.mjtGeom
        folder = (self.path.parent / (spec.meshdir or "")).resolve()
        missing = {
            m.name or Path(m.file).stem
            for m in spec.meshes
            if m.file and (m.file.endswith(".dae") or not (folder / m.file).is_file())
        }  # fmt: skip
        touching = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
        lost, massless = [], []
        for geom in list(spec.geoms):
            body = geom.parent
            collides = bool(geom.contype or geom.conaffinity) or geom.name in touching - {""}
            if collides and not (geom.contype or geom.conaffinity):
                geom.contype = 1
            if geom.type != types.mjGEOM_MESH:
                continue
            weighs = not _states_mass(spec, body) and geom.mass != 0 and geom.density != 0
            if geom.meshname in missing:
                lost += [geom.meshname] if collides else []
                massless += [body.name or "without a name"] if weighs else []
            elif collides or weighs:
                continue
            spec.delete(geom)
        used = {g.meshname for g in spec.geoms if g.type == types.mjGEOM_MESH}
        for mesh in list(spec.meshes):
            if (mesh.name or Path(mesh.file).stem) not in used:
                spec.delete(mesh)
            elif mesh.file:  # the model with servos is compiled from text, without a folder
                mesh.file = str(folder / mesh.file)
        spec.meshdir = ""
        for material in spec.materials:
            material.textures = [""] * len(material.textures)
        for element in (*spec.skins, *spec.textures):
            spec.delete(element)
        if lost:
            self.notes.append(
                f"Meshes of {self.path.name} that collide are not there, or not STL or OBJ "
                f"({_list(lost)}); the robot is built without them. They belong into {folder}."
            )
        if massless:
            self.notes.append(
                f"Masses of {_list(massless)} come from meshes that are not there and count as 0: "
                f"put them into {folder}, or give these bodies an <inertial>."
            )

    def _turn_forward(self, quarters: int) -> None:
        """Turn all that the trunk carries about its vertical axis, so that x is forward."""
        root, turn = self.root, np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), 0.5 * np.pi * quarters)
        frameless = [e for kind in _PARTS for e in getattr(root, kind) if e.frame is None]
        frame = root.add_frame(quat=turn)
        for part in frameless:
            part.set_frame(frame)
        if _states_mass(self.spec, root):
            model = self._compiled()
            at = model.body(root.name).id
            place, axes = np.zeros(3), np.zeros(4)
            mujoco.mju_rotVecQuat(place, model.body_ipos[at], turn)
            mujoco.mju_mulQuat(axes, turn, model.body_iquat[at])
            root.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            root.fullinertia = np.full(6, np.nan)
            root.ipos, root.iquat, root.inertia = place, axes, model.body_inertia[at]

    def _keyframe(self, original: Any) -> Array:
        """All positions of the file's joints in the keyframe that is the pose, or at rest."""
        names, pose = [original.key(k).name for k in range(original.nkey)], self.settings.pose
        if isinstance(pose, str):
            if pose not in names:
                raise InputError(
                    f"{self.where}: {self.path.name} has no keyframe '{pose}'; it has "
                    f"{', '.join(names) or 'none'}. Give angles by joint as `pose` instead."
                )
            return original.key_qpos[names.index(pose)].copy()
        positions = original.qpos0.copy()
        if isinstance(pose, dict):
            hinges = [original.joint(j).name for j in _hinges(original)]
            for pattern, angle in pose.items():
                for name in self._matching(pattern, hinges, "pose", "hinge"):
                    positions[original.joint(name).qposadr[0]] = angle
        elif names:
            chosen = next((k for k, n in enumerate(names) if n.lower() in _STANDING), 0)
            others = [n for n in names if n and n != names[chosen]]
            name = f"keyframe '{names[chosen]}'" if names[chosen] else "first keyframe"
            also = f"; it has {_list(others)}, too: `pose` names another" if others else ""
            self.notes.append(f"The default pose is the {name} of {self.path.name}{also}.")
            return original.key_qpos[chosen].copy()
        else:
            self.notes.append(
                f"{self.path.name} has no keyframe and there is no `pose`: the default pose is all "
                "joints at 0, or at the limit next to it, with which few robots can stand."
            )
        return positions

    def _servo_joints(self, original: Any) -> tuple[str, ...]:
        hinges = _hinges(original)
        if not hinges:
            raise InputError(
                f"{self.path} has no hinge joint: there is nothing for a servo to turn."
            )
        names = [original.joint(j).name for j in hinges]
        if "" in names:
            raise InputError(f"{self.path} has a hinge without a name. Give every joint a name.")
        if self.settings.joints is not None:
            chosen = {
                n for w in self.settings.joints for n in self._matching(w, names, "joints", "hinge")
            }
        elif driven := driven_joints(original) & set(hinges):
            chosen = {original.joint(j).name for j in driven}
        else:
            chosen = {original.joint(j).name for j in set(hinges) - set(leaders(original))}
            self.notes.append(
                f"{self.path.name} has no actuators of hinges: each of its {len(chosen)} hinges "
                "gets a servo."
            )
        fixed = [n for n in names if n not in chosen]
        if fixed:
            self.notes.append(f"Joints without a servo are fixed: {_list(fixed)}.")
        if original.neq or original.ntendon:
            self.notes.append(
                f"{self.path.name} couples bodies or joints (<equality>, <tendon>: closed "
                "linkages, joints that follow others). That is taken out: a leg with such a "
                "coupling moves otherwise than the robot's. Describe it as a chain with a servo on "
                "each joint."
            )
        return tuple(n for n in names if n in chosen)

    def _matching(self, pattern: str, names: Sequence[str], key: str, kind: str) -> list[str]:
        matching = [n for n in names if n == pattern or fnmatchcase(n, pattern)]
        if not matching:
            raise InputError(
                f"{self.where}: {key} names '{pattern}', but {self.path.name} has no such {kind}. "
                f"It has {', '.join(n for n in names if n)}."
            )
        return matching

    def _strip(self, original: Any) -> None:
        """Take out all but bodies, geoms and joints with a servo; fix the others in their pose."""
        spec, free = self.spec, mujoco.mjtJoint.mjJNT_FREE
        spec.option = mujoco.MjSpec().option
        for elements in (spec.actuators, spec.sensors, spec.keys, spec.tendons, spec.equalities,
                         spec.excludes, spec.pairs):  # fmt: skip
            for element in list(elements):
                spec.delete(element)
        forget_actuator_defaults(spec)
        plane, field = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD
        for geom in list(spec.geoms):
            if geom.type in (plane, field):
                spec.delete(geom)
        fixed = [j for j in spec.joints if j.type != free and j.name not in self.joints]
        self._turn(original, {j.parent.name for j in fixed})
        for joint in fixed:
            spec.delete(joint)
        for joint in spec.joints:
            if joint.type != free:
                # the servo's friction, inertia, damping and torque limit are all of the joint's
                joint.damping, joint.stiffness = np.zeros(3), np.zeros(3)
                joint.frictionloss = joint.armature = 0.0
                joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        for k, geom in enumerate(spec.geoms):
            geom.name = geom.name or f"geom {k}"

    def _turn(self, original: Any, bodies: set[str]) -> None:
        """Turn bodies of joints that are fixed as these are in the pose."""
        data = mujoco.MjData(original)
        data.qpos[:] = self.resting
        for name in self.joints:
            at = original.joint(name).qposadr[0]
            data.qpos[at] = original.qpos0[at]
        mujoco.mj_kinematics(original, data)
        for name in bodies:
            at = original.body(name).id
            above = int(original.body_parentid[at])
            back, place, turn = np.zeros(4), np.zeros(3), np.zeros(4)
            mujoco.mju_negQuat(back, data.xquat[above])
            mujoco.mju_rotVecQuat(place, data.xpos[at] - data.xpos[above], back)
            mujoco.mju_mulQuat(turn, back, data.xquat[at])
            body = self.spec.body(name)
            body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            body.pos, body.quat = place, turn

    def _compiled(self) -> Any:
        try:
            return self.spec.copy().compile()
        except ValueError as error:
            raise InputError(
                " ".join([f"{self.path} cannot be simulated: {in_a_line(error)}.", *self.notes])
            ) from None

    # ------------------------------------------------------------------------- pose

    def _pose(self, original: Any) -> tuple[Array, Array, Array]:
        model = self.model
        low, high = np.full((2, len(self.joints)), 0.0)
        pose = np.zeros(len(self.joints))
        for k, name in enumerate(self.joints):
            joint = model.joint(name)
            limited = bool(joint.limited[0])
            pose[k] = self.resting[original.joint(name).qposadr[0]]
            low[k], high[k] = joint.range if limited else (-np.pi, np.pi)
            if high[k] - low[k] > 2 * np.pi + 1e-6:  # no servo turns farther
                low[k], high[k] = pose[k] - np.pi, pose[k] + np.pi
        outside = [
            f"{n} ({p:g}, limits {a:g} to {b:g})"
            for n, p, a, b in zip(self.joints, pose, low, high, strict=True)
            if not a - 1e-6 <= p <= b + 1e-6
        ]
        if outside and isinstance(self.settings.pose, dict):
            raise InputError(
                f"{self.where}: pose is beyond the limits of {_list(outside)}. Angles are in "
                "radians."
            )
        return np.clip(pose, low, high), low, high

    def _place(self, pose: Array) -> None:
        """Put the trunk upright at the origin, the joints in `pose`."""
        self.data.qpos[:] = self.model.qpos0
        self.data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        self.data.qpos[7:] = pose
        mujoco.mj_kinematics(self.model, self.data)

    def _lowest(self, geom: int) -> float:
        """Height of the lowest point of a geom as it is placed."""
        return float(self._stands_on(geom)[0][2])

    def _stands_on(self, geom: int) -> tuple[Array, Array]:
        """Lowest point of a geom as it is placed, and the point about which it rolls there.

        That is the middle of a ball, the lower end of an upright limb, the middle of a lying one.
        """
        model, data = self.model, self.data
        size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
        at, axes = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
        types, down, radius = mujoco.mjtGeom, -axes[2], 0.0  # down in the geom's frame
        ends = np.zeros(3)  # half of the straight edges along its axes
        if kind == types.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            points = at + model.mesh_vert[first : first + count] @ axes.T
            low = points[:, 2].min()
            sole = points[points[:, 2] < low + _SAME_SOLE * np.ptp(points, axis=0).max()]
            middle = 0.5 * (sole.min(axis=0) + sole.max(axis=0))
            return np.array([*middle[:2], low]), middle
        if kind == types.mjGEOM_SPHERE:
            radius = size[0]
        elif kind == types.mjGEOM_CAPSULE:
            radius, ends[2] = size[0], size[1]
        elif kind == types.mjGEOM_CYLINDER:
            radius, ends[2] = size[0] * np.hypot(down[0], down[1]), size[1]
        elif kind == types.mjGEOM_ELLIPSOID:
            radius = np.linalg.norm(size * down)
        else:
            ends[:] = size
        point = at + axes @ (ends * np.clip(down / _LYING, -1.0, 1.0))
        return np.array([*point[:2], at[2] - radius - np.abs(ends * down).sum()]), point

    # ------------------------------------------------------------------------- feet

    def _feet(self) -> dict[str, list[int]]:
        """Geoms of each foot, by its name, the lowest first."""
        model = self.model
        collides = np.flatnonzero((model.geom_contype | model.geom_conaffinity) > 0)
        root = model.body(self.root.name).id
        of_robot = [int(g) for g in collides if model.body_rootid[model.geom_bodyid[g]] == root]
        if not of_robot:
            raise InputError(
                " ".join([f"{self.path}: no geom of the robot collides.", *self.notes])
                + " Give each foot a sphere, capsule or box that does (contype 1)."
            )
        by_body: dict[int, list[int]] = {}
        for g in sorted(of_robot, key=self._lowest):
            by_body.setdefault(int(model.geom_bodyid[g]), []).append(g)
        if self.settings.feet is None:
            return self._lowest_bodies(by_body)
        feet = {}
        for name in self.settings.feet:
            body, geom = self._body_of(name)
            if body not in by_body:
                raise InputError(
                    f"{self.where}: foot '{name}' has no geom that collides. Give its body a "
                    "sphere, capsule or box with contype 1."
                )
            feet[name] = [geom] if geom in by_body[body] else self._soles(by_body[body])
        return feet

    def _soles(self, geoms: list[int]) -> list[int]:
        """Those of a body's geoms, the lowest first, that are about as low."""
        low = self._lowest(geoms[0])
        return [g for g in geoms if self._lowest(g) - low < _SAME_SOLE * abs(low)]

    def _body_of(self, name: str) -> tuple[int, int]:
        """Body, and geom or -1, of a foot's name."""
        model, kinds = self.model, mujoco.mjtObj
        for kind, bodies in (
            (kinds.mjOBJ_SITE, model.site_bodyid), (kinds.mjOBJ_GEOM, model.geom_bodyid),
            (kinds.mjOBJ_BODY, range(model.nbody)),
        ):  # fmt: skip
            at = mujoco.mj_name2id(model, kind, name)
            if at >= 0:
                return int(bodies[at]), at if kind == kinds.mjOBJ_GEOM else -1
        sites = [model.site(i).name for i in range(model.nsite)]
        raise InputError(
            f"{self.where}: {self.path.name} has no site, geom or body '{name}' for a foot. It has "
            f"the sites {', '.join(n for n in sites if n) or 'none'}."
        )

    def _lowest_bodies(self, by_body: dict[int, list[int]]) -> dict[str, list[int]]:
        model = self.model
        low = {body: self._lowest(geoms[0]) for body, geoms in by_body.items()}
        ground = min(low.values())
        near = [b for b, z in low.items() if z - ground < _SAME_HEIGHT * abs(ground)]
        above = {int(model.body(self.root.name).id)}
        above = above.union(*map(self._ancestors, near))
        # of a chain of bodies, the last one that is so low
        ends = sorted(b for b in near if b not in above)
        carrying = set().union(*(self._ancestors(model.joint(n).bodyid[0]) for n in self.joints))
        low_bodies = ends or [int(model.body(self.root.name).id)]
        if beyond := [model.body(b).name for b in low_bodies if b in carrying]:
            why = (
                f"in the default pose its lowest geoms are of {_list(beyond)}, on which joints hang"
            )
            advice = "Give the `pose` in which it stands on its feet, or `feet`, in the YAML."
            raise InputError(" ".join([f"{self.path}: {why}.", *self.notes, advice]))
        feet = {model.body(b).name: self._soles(by_body[b]) for b in ends}
        self.notes.append(f"Feet, by the lowest geoms: {', '.join(feet)}.")
        return feet

    def _ancestors(self, body: int) -> set[int]:
        above = set()
        while body:
            body = int(self.model.body_parentid[body])
            above.add(body)
        return above

    # ------------------------------------------------------------------------- the body

    def body(self) -> Body:
        """Everything together."""
        model = self.model
        names = tuple(self.feet)
        if len(names) < 2:
            raise InputError(
                f"{self.where}: only one foot ({', '.join(names)}) was found; a robot "
                "that walks has two or more. Give `feet` in the YAML."
            )
        feet_at = self.feet_at = np.array(
            [
                np.mean([self._stands_on(g)[1] for g in geoms], axis=0)
                for geoms in self.feet.values()
            ]
        )
        soles = np.array([self._lowest(geoms[0]) for geoms in self.feet.values()])
        height = -float(soles.min())
        if not height > 0:
            raise InputError(f"{self.path}: the feet are not below the trunk in the default pose.")
        if not _HEIGHTS_M[0] < height < _HEIGHTS_M[1]:
            raise InputError(
                f"{self.path}: the trunk stands {height:.3g} m above the ground. Lengths are in "
                "metres: scale the file if they are in another unit."
            )
        self._bound_inertias(height)
        chains = [self._above(b) for b in self.foot_bodies]
        shared = Counter(j for chain in chains for j in chain)
        chains = [[j for j in chain if shared[j] == 1] for chain in chains]  # without a spine
        if not all(chains):
            still = names[[bool(chain) for chain in chains].index(False)]
            raise InputError(f"{self.where}: no joint with a servo moves foot '{still}' alone.")
        leg_of = np.full(len(self.joints), -1)
        for leg, chain in enumerate(chains):
            leg_of[chain] = leg
        joints, signs = self._mirror(height, _LEFT_RIGHT)
        feet_image = _images(feet_at, _SAME_PLACE * height)
        if joints is None or feet_image is None:
            joints = signs = feet_image = None
            turned = self._mirror(height, _FRONT_BACK)[0] is not None
            self.notes.append(
                "The robot has no mirror image by its geometry: training does without images."
                + (
                    " It is symmetric about x instead of y: if its front is where y points, write "
                    "`forward: y` (or -y)."
                    if turned
                    else ""
                )
            )
        if idle := [n for n, leg in zip(self.joints, leg_of, strict=True) if leg < 0]:
            self.notes.append(
                f"Servos that move no foot alone hold the pose: {_list(idle)}. A leg among them "
                "is not on the ground in the default pose."
            )
        self._compare_names(leg_of, feet_at)
        kinematics = self._kinematics()
        joints_at = self._inverse(kinematics, chains, height)
        commands = self.settings.commands.model_dump(exclude_none=True)
        for axis, (name, way) in enumerate(_WAYS.items()):
            displacement = np.eye(3)[axis] * _STEP * height
            feet = kinematics(joints_at((feet_at + displacement)[None], np.zeros((1, len(names)))))[
                0
            ]
            if (
                name not in commands
                and (feet - feet_at)[:, axis].mean() < _REACHED * displacement.max()
            ):
                commands[name] = [0.0, 0.0]
                self.notes.append(
                    f"The legs cannot step {way}: no command asks for it. `forward` names the axis "
                    "in front, `commands` the ranges."
                )
        xml = self._xml_writer(names)
        hashes = {"robot": sha256(self.path)}
        if self.config is not None:
            hashes["robot_config"] = sha256(self.config)

        def fallen(qpos: Array, gravity: Array, ground: Ground) -> NDArray[np.bool_]:
            above = qpos[:, 2] - ground.height(qpos[:, 0], qpos[:, 1])
            return above < _FALLEN * height

        return Body(
            name=self.path.stem, joints=self.joints, feet=tuple(f"foot_{n}" for n in names),
            pose=self.pose, low=self.low, high=self.high, linked=(), leg_of=leg_of,
            feet_at=feet_at, sole_m=feet_at[:, 2] - soles, offsets=self._offsets(names, feet_at),
            mirror_joints=joints, mirror_signs=signs, mirror_feet=feet_image,
            standing_height_m=height, mass_kg=float(model.body_mass.sum()), xml=xml,
            feet_in_trunk=kinematics, joints_at=joints_at,
            touches_ground=fallen,
            foot_geoms=tuple(model.geom(g).name for geoms in self.feet.values() for g in geoms),
            trunk=self.root.name, servo_of=self._servo_of(),
            commands={name: (ends[0], ends[1]) for name, ends in commands.items()},
            notes=tuple(self.notes), hashes=hashes,
        )  # fmt: skip

    def _bound_inertias(self, height: float) -> None:
        """Replace inertias that no body of this robot's size can have, as placeholders are."""
        model = self.model
        most = np.maximum(model.body_mass * _WIDEST**2, _NEGLIGIBLE * model.body_mass.sum())
        most *= height**2
        wide = [model.body(b).name for b in np.flatnonzero(model.body_inertia.max(axis=1) > most)]
        for name in wide:
            part = self.spec.body(name)
            part.fullinertia = np.full(6, np.nan)
            part.inertia = np.full(3, model.body(name).mass[0] * (_USUAL_GYRATION * height) ** 2)
        if wide:
            self.notes.append(
                f"Inertias of {_list(wide)} are those of bodies {_WIDEST:g} times as wide as the "
                "robot is high, or more, and were replaced by those of usual links: state theirs."
            )

    def _compare_names(self, leg_of: NDArray[np.intp], feet_at: Array) -> None:
        """Note where legs are called left and front by another axis than the one in front."""
        away, corners = feet_at[:, :2] - feet_at[:, :2].mean(axis=0), {}
        for leg, foot in enumerate(self.feet):
            text = " ".join([foot, *(self.joints[j] for j in np.flatnonzero(leg_of == leg))])
            codes: list[str] = re.findall(r"(?<![A-Za-z])[FRBHL][LRFBH](?![A-Za-z])", text)
            letters = {_WORDS[word] for word in re.findall("|".join(_WORDS), text.lower())}
            letters |= set("".join(_REAR.get(code, code) for code in codes).replace("H", "B"))
            if (corner := "".join(sorted(letters))) in _CORNERS:
                corners[leg] = _CORNERS[corner]
        x, y = away[list(corners)].T
        turned = [np.column_stack(pair) for pair in ((x, y), (y, -x), (-x, -y), (-y, x))]
        fits = [np.array_equal(np.sign(at).tolist(), [*corners.values()]) for at in turned]
        if any(fits) and not fits[0]:
            axis = _AXES[(_AXES.index(self.settings.forward) + fits.index(True)) % 4]
            self.notes.append(
                f"By the names of its legs the front is where {axis} points: if so, write "
                f"`forward: {axis}`."
            )

    def _above(self, body: int) -> list[int]:
        """Joints between trunk and a body, its own included, from the trunk on."""
        model, chain = self.model, []
        while body:
            for j in reversed(range(model.body_jntnum[body])):
                name = model.joint(int(model.body_jntadr[body]) + j).name
                if name in self.joints:
                    chain.append(self.joints.index(name))
            body = int(model.body_parentid[body])
        return chain[::-1]

    @property
    def foot_bodies(self) -> list[int]:
        """Of each foot."""
        return [int(self.model.geom_bodyid[geoms[0]]) for geoms in self.feet.values()]

    def _in_body(self, points: Array) -> Array:
        """Points of the feet's bodies, in these bodies' frames; shape (feet, 3)."""
        data, bodies = self.data, self.foot_bodies
        turns = data.xmat[bodies].reshape(-1, 3, 3)
        return ((points - data.xpos[bodies])[:, None] @ turns)[:, 0]

    def _kinematics(self, away: Sequence[float] = (0.0, 0.0, 0.0)):
        """Feet in the trunk's frame as a function of joint angles, without MuJoCo.

        Or points fixed to them, which are so far away from them in the default pose [m].
        """
        model, data, bodies = self.model, self.data, self.foot_bodies
        self._place(self.pose)
        fixed = self._in_body(self.feet_at + away)
        self._place(np.zeros(len(self.joints)))
        turns = data.xmat[bodies].reshape(-1, 3, 3)
        feet = data.xpos[bodies] + (turns @ fixed[..., None])[..., 0]
        # the joint next to the foot turns it first
        chains = [self._above(b)[::-1] for b in bodies]
        rounds = []
        for k in range(max(len(chain) for chain in chains)):
            legs = np.array([leg for leg, chain in enumerate(chains) if k < len(chain)])
            joints = np.array([chains[leg][k] for leg in legs])
            ids = [int(model.joint(self.joints[j]).id) for j in joints]
            rounds.append((legs, joints, data.xaxis[ids].copy(), data.xanchor[ids].copy()))
        self._place(self.pose)

        def feet_in_trunk(joints: Array) -> Array:
            places = np.repeat(feet[None], len(joints), axis=0)
            for legs, columns, axes, anchors in rounds:
                arm = places[:, legs] - anchors
                c, s = np.cos(joints[:, columns, None]), np.sin(joints[:, columns, None])
                along = (arm * axes).sum(axis=-1, keepdims=True) * axes
                # Rodrigues; np.cross is slow for few robots
                turned = np.stack(
                    [
                        axes[:, i - 2] * arm[..., i - 1] - axes[:, i - 1] * arm[..., i - 2]
                        for i in range(3)
                    ],
                    axis=-1,
                )
                places[:, legs] = anchors + c * (arm - along) + s * turned + along
            return places

        return feet_in_trunk

    def _inverse(self, kinematics: Any, chains: list[list[int]], height: float):
        """Joint angles that put the feet somewhere: damped least squares from the default pose.

        Out of reach, or where a leg has fewer than three joints, feet come as near as they can;
        with more, soles stay as level as they are in the default pose, and have a heading. `chains`
        are the joints of each leg alone.
        """
        pose, low, high = self.pose, self.low, self.high
        longest = max(len(chain) for chain in chains)
        level = _LEVEL * height * np.array([len(chain) > 3 for chain in chains])[:, None]
        tips = [self._kinematics(e) for e in np.eye(3)[[0, 2]]] if level.any() else []

        def reached(joints: Array) -> Array:
            """Feet, and the directions of their soles as lengths; shape (n, legs, 3 or 9)."""
            feet = kinematics(joints)
            axes = [level * (tip(joints) - feet) for tip in tips]
            return np.concatenate([feet, *axes], axis=-1)

        def joints_at(feet: Array, heading: Array) -> Array:
            joints = np.repeat(pose[None], len(feet), axis=0)
            if tips:
                none, one = np.zeros_like(heading), np.ones_like(heading)
                ahead = np.stack([np.cos(heading), np.sin(heading), none], axis=-1)
                up = np.stack([none, none, one], axis=-1)
                feet = np.concatenate([feet, level * ahead, level * up], axis=-1)
            for _ in range(_INVERSE_STEPS):
                current = reached(joints)
                slopes = np.zeros((*current.shape, longest))
                for k in range(longest):  # one joint of every leg at a time
                    moved = joints.copy()
                    for chain in chains:
                        if k < len(chain):
                            moved[:, chain[k]] += _NUDGE_RAD
                    slopes[..., k] = (reached(moved) - current) / _NUDGE_RAD
                away = (feet - current)[..., None]
                square = slopes.swapaxes(-1, -2) @ slopes
                square = square + (_DAMPING * height) ** 2 * np.eye(longest)
                turned = np.linalg.solve(square, slopes.swapaxes(-1, -2) @ away)[..., 0]
                for leg, chain in enumerate(chains):
                    joints[:, chain] += turned[:, leg, : len(chain)]
                joints = np.clip(joints, low, high)
            return joints

        return joints_at

    def _mirror(self, height: float, plane: Array) -> tuple[NDArray[np.intp] | None, Array | None]:
        """Image of each joint in a plane through the trunk, and its sign; None without."""
        model, data = self.model, self.data
        ids = [int(model.joint(name).id) for name in self.joints]
        at, axes = data.xanchor[ids], data.xaxis[ids]
        images = -axes * plane  # an axis is axial: the plane turns it the other way
        near = _SAME_PLACE * height
        before = np.array([len(self._above(int(model.jnt_bodyid[j]))) for j in ids])
        images_of, signs = np.zeros(len(ids), int), np.zeros(len(ids))
        for k in range(len(ids)):
            # the place of a joint along its axis is arbitrary
            apart = at - at[k] * plane
            beside = apart - (apart @ images[k])[:, None] * images[k]
            along = (axes * images[k]).sum(axis=1)
            fits = np.flatnonzero(
                (np.linalg.norm(beside, axis=1) < near)
                & (np.abs(along) > 0.99)
                & (before == before[k])  # two joints of a chain can turn about the same line
            )
            if not len(fits):
                return None, None
            images_of[k] = fits[np.argmin(np.linalg.norm(apart[fits], axis=1))]
            signs[k] = np.sign(along[images_of[k]])
        if (images_of[images_of] != np.arange(len(ids))).any():
            return None, None
        return images_of, signs

    def _offsets(self, names: tuple[str, ...], feet_at: Array) -> Array:
        gait = self.settings.gait
        if isinstance(gait, dict):
            missing = [n for n in names if n not in gait] or [n for n in gait if n not in names]
            if missing:
                raise InputError(
                    f"{self.where}: gait and feet differ in '{missing[0]}'; the feet are "
                    f"{', '.join(names)}."
                )
            return np.array([gait[n] % 1.0 for n in names])
        if gait == "walk" and len(names) == 4:
            right, rear = feet_at[:, 1] < 0, feet_at[:, 0] < feet_at[:, 0].mean()
            return np.array(_WALK)[right + 2 * rear]
        if gait not in ("trot", "walk", "biped"):
            raise InputError(
                f"{self.where}: gait '{gait}' is not known. Give trot, walk, biped, or the share "
                "of a cycle by which each foot is behind."
            )
        return fixed_offsets(feet_at)

    def _servo_of(self) -> dict[str, str]:
        servos = self.settings.servos
        if servos is None:
            return {}
        if isinstance(servos, str):
            return dict.fromkeys(self.joints, servos)
        servo_of = {}
        for pattern, servo in servos.items():
            for name in self._matching(pattern, self.joints, "servos", "joint with a servo"):
                servo_of[name] = servo
        return servo_of

    def _xml_writer(self, names: tuple[str, ...]):
        """Function that writes the MJCF with servos on a ground."""
        spec, model = self.spec, self.model
        feet_geoms = {model.geom(g).name for geoms in self.feet.values() for g in geoms}
        for site in list(spec.sites):
            spec.delete(site)
        for name, body_id, geoms, point in zip(
            names, self.foot_bodies, self.feet.values(), self._in_body(self.feet_at), strict=True
        ):
            places, reach = model.geom_pos[geoms], model.geom_rbound[geoms]
            radius = (np.linalg.norm(places - point, axis=1) + _TOUCH * reach).max()
            spec.body(model.body(body_id).name).add_site(
                name=f"foot_{name}", pos=point, type=mujoco.mjtGeom.mjGEOM_SPHERE, group=4,
                size=[float(radius), 0, 0],
            )  # fmt: skip
            spec.add_sensor(
                name=f"foot_{name}_touch", type=mujoco.mjtSensor.mjSENS_TOUCH,
                objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"foot_{name}",
            )  # fmt: skip

        def xml(
            servos: Mapping[str, DelayedPDParameters], step_s: float, ground: Ground,
            physics: Physics,
        ) -> str:  # fmt: skip
            robot = spec.copy()
            for geom in robot.geoms:
                foot = geom.name in feet_geoms
                collides = bool(geom.contype or geom.conaffinity)
                on = foot or (collides and physics == "evaluation")
                geom.contype, geom.conaffinity = int(on), 0
                if foot:
                    geom.priority, geom.condim = 1, max(geom.condim, 3)  # 1 is without friction
            option = robot.option
            option.timestep = step_s
            option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
            option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
            if physics == "evaluation":
                option.solver = mujoco.mjtSolver.mjSOL_NEWTON
                for name in ("iterations", "ls_iterations", "tolerance"):
                    setattr(option, name, EVALUATION_SOLVER[name])
            else:
                option.solver = mujoco.mjtSolver.mjSOL_PGS
                option.iterations = _TRAINING_ITERATIONS
            for joint_name in self.joints:
                servo = {name: float(x) for name, x in servos[joint_name].arrays().items()}
                joint = robot.joint(joint_name)
                joint.armature, joint.frictionloss = servo["armature"], servo["friction_loss"]
                joint.damping = np.array([servo["back_emf"], 0.0, 0.0])
                joint.solref_friction = list(friction_solref(step_s))
                joint.solimp_friction = list(FRICTION_SOLIMP)
                actuator = robot.add_actuator(
                    name=joint_name, target=joint_name, trntype=mujoco.mjtTrn.mjTRN_JOINT
                )
                speed, effort = servo["velocity_limit"], servo["effort_limit"]
                actuator.set_to_pid(
                    servo["stiffness"], servo["damping"],
                    slewmax=speed if np.isfinite(speed) else 0.0, ctrlspec=1,
                )  # fmt: skip
                actuator.interp = 1
                # two more than whole steps: MuJoCo silently truncates a delay beyond its buffer
                actuator.nsample = int(servo["dead_time_s"] / step_s) + 2
                actuator.delay = servo["dead_time_s"]
                if np.isfinite(effort):
                    actuator.forcelimited, actuator.forcerange = 1, [-effort, effort]
            robot.compile()
            text = robot.to_xml()
            at = text.index("<worldbody>") + len("<worldbody>")
            below = ground.xml.replace('material="grid"', f'material="{_GROUND}"')
            text = text[:at] + below + text[at:]
            sky = _SKY if physics == "evaluation" else ""
            return text.replace(
                "<worldbody>", f"<asset>{_GRID}{sky}{ground.assets}</asset><worldbody>", 1
            )

        return xml


_SKY = (
    '<texture name="sky of the walk" type="skybox" builtin="gradient" rgb1="0.95 0.97 1" '
    'rgb2="0.7 0.8 0.95" width="64" height="64"/>'
)
_GROUND = "grid of the walk"
_GRID = (
    f'<texture name="{_GROUND}" type="2d" builtin="checker" rgb1="0.80 0.83 0.87" '
    'rgb2="0.68 0.72 0.77" width="300" height="300"/>'
    f'<material name="{_GROUND}" texture="{_GROUND}" texrepeat="5 5" texuniform="true"/>'
)


def _hinges(model: Any) -> list[int]:
    return np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE).tolist()


def _images(places: Array, near: float) -> NDArray[np.intp] | None:
    """Which place each place is the mirror image of; None if one has none."""
    distance = np.linalg.norm(places[:, None] * [1, -1, 1] - places[None], axis=-1)
    image = distance.argmin(axis=1)
    return image if (distance.min(axis=1) < near).all() else None


def _states_mass(spec: Any, body: Any) -> bool:
    """Whether a body's mass is of its <inertial>, not of its geoms."""
    ways = mujoco.mjtInertiaFromGeom
    way = spec.compiler.inertiafromgeom
    return way == ways.mjINERTIAFROMGEOM_FALSE or bool(
        way == ways.mjINERTIAFROMGEOM_AUTO and body.explicitinertial
    )


def _list(names: Sequence[str]) -> str:
    """The first names of a list."""
    names = list(dict.fromkeys(names))
    return ", ".join(names[:6]) + (", …" if len(names) > 6 else "")
