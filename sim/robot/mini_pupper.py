"""Mini Pupper 2 as a MuJoCo model, written from published dimensions; primitives only.

`robot_xml` gives the MJCF text of the robot on a piece of ground. Twelve hinges are named as
everywhere in this project (`LF_hip` …), in its order. Masses, centres and inertias are those of the
published URDF with the centres of mass of its meshes (several of the URDF's own are outside their
bodies), and the trunk scaled so that the robot weighs its 0.465 kg.

The real knee is a parallel linkage: servo 3 sits in the hip module and holds the calf's absolute
angle, thigh + calf, through a push rod. `knee="linkage"` models it as a tendon with coefficients
1, 1, which carries the servo's rotor inertia and friction; `knee="serial"` puts the servo at the
knee, as the paper and the URDF do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES, LEGS
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.robot.servo_mjcf import (
    INTEGRATOR,
    attributes,
    joint_attributes,
    numbers,
    pid_element,
)

if TYPE_CHECKING:
    from pupper_sysid.sim.robot.terrain import Ground

Array = NDArray[np.float64]
Knee = Literal["linkage", "serial"]
Physics = Literal["training", "evaluation"]
"""`evaluation`: the whole robot touches the ground, and Newton solves the constraints to their end.
`training`: only the feet do, and few iterations of PGS are near enough; for half the cost."""

MASS_KG = 0.465
THIGH_M, CALF_M = 0.050, 0.056
FOOT_RADIUS_M = 0.0085
STANDING_HEIGHT_M = 0.0835
"""Height of the trunk's origin above the ground, in the default pose."""

HIP_X_M = {"LF": 0.05, "RF": 0.05, "LB": -0.066, "RB": -0.066}
HIP_Y_M, THIGH_Y_M, CALF_Y_M = 0.0235, 0.0197, 0.00475
THIGH_X_M = -0.00004
SIDE = {"LF": 1, "RF": -1, "LB": 1, "RB": -1}
"""+1 for left legs, -1 for right ones."""

LIMITS_RAD = {
    name: {
        "hip": (-0.550, 0.425) if name.startswith("L") else (-0.425, 0.550),
        "thigh": (0.55, 2.40),
        "calf": (-2.18, -0.22),
    }[name.split("_")[1]]
    for name in JOINT_NAMES
}

# Mass [kg], centre [m], inertia xx yy zz xy xz yz [kg m²] of left legs (URDF masses and tensors,
# centres of the meshes; hip plate, thigh shell and foot counted with their bodies).
_HIP = (0.023343, (0.0068, 0.0052, 0.0066), (4.01e-6, 4.63e-6, 5.06e-6, -7.1e-7, -4.9e-8, -1.0e-7))
_THIGH = (
    0.004137, (-0.0012, 0.0041, -0.0170), (1.42e-6, 1.48e-6, 2.63e-7, 2.5e-8, -1.9e-7, -1.8e-8),
)  # fmt: skip
_CALF = (0.002549, (0.0003, -0.0001, -0.0379), (1.47e-6, 1.57e-6, 1.22e-7, 0.0, 2.1e-7, 0.0))
_TRUNK_CENTRE = (-0.0016, 0.0003, -0.0020)
_TRUNK_INERTIA = (8.24e-5, 3.61e-4, 3.64e-4, 1.2e-6, -1.0e-5, 2.9e-7)
_TRUNK_URDF_KG = 0.125594
TRUNK_KG = MASS_KG - 4 * (_HIP[0] + _THIGH[0] + _CALF[0])

# trunk's box and the corner at its centre, from the extents of the published meshes
TRUNK_BOX_M, TRUNK_BOX_AT_M = (0.0905, 0.030, 0.0266), (-0.0012, 0.0, -0.00015)
HIP_BOX_M, HIP_BOX_AT_M = (0.0215, 0.0145, 0.0155), (0.0045, 0.00335, 0.0065)
"""Half sizes and centre of a left hip's box, in its own frame [m]."""
THIGH_RADIUS_M = 0.0045

# Newton reaches machine precision in three iterations and ends there, whatever its tolerance; it
# needs 50 steps of line search (MuJoCo's default), since dry friction is a sharp corner of its
# cost, and a tolerance that light links do not fall below while they still move. PGS's eight
# iterations leave 1 mrad/s of a walking robot's joint speeds (in the median; 14 in 1 % of steps).
EVALUATION_SOLVER = {"solver": "Newton", "iterations": 20, "ls_iterations": 50, "tolerance": 1e-15}
_SOLVERS = {
    "training": 'solver="PGS" iterations="8"',
    "evaluation": attributes({name: str(value) for name, value in EVALUATION_SOLVER.items()}),
}

FLAT_GROUND = (
    '<geom name="ground" type="plane" size="0 0 0.05" material="grid" contype="0" conaffinity="1"/>'
)


def robot_xml(
    servos: dict[str, DelayedPDParameters],
    time_step_s: float,
    knee: Knee = "linkage",
    ground: str = FLAT_GROUND,
    assets: str = "",
    physics: Physics = "evaluation",
    imu: bool = True,
) -> str:
    """MJCF of the robot.

    `servos` are scalars, one per joint; the joint's name is the actuator's, too, and the dead time
    sets the length of the delay line. Geoms of the `ground` need `conaffinity="1"`; `assets` is
    what it needs inside `<asset>`. With the `physics` of training the model has nothing that it
    does not simulate: no geoms but feet and ground, and no light. With `imu` it has the sensors
    `gyro` and `accelerometer`; `<leg>_foot_touch` [N] it always has.
    """
    complete = physics == "evaluation"
    legs = "".join(_leg(leg, servos, time_step_s, knee, complete) for leg in LEGS)
    tendons = ""
    if knee == "linkage":
        calves = {leg: joint_attributes(servos[f"{leg}_calf"], time_step_s) for leg in LEGS}
        tendons = "".join(
            f'<fixed name="{leg}_calf_servo" {attributes(calf)}><joint joint="{leg}_thigh" '
            f'coef="1"/><joint joint="{leg}_calf" coef="1"/></fixed>'
            for leg, calf in calves.items()
        )
        tendons = f"<tendon>{tendons}</tendon>"
    actuators = []
    for name in JOINT_NAMES:
        at = "tendon" if knee == "linkage" and name.endswith("calf") else "joint"
        names = {"name": name, at: name if at == "joint" else f"{name}_servo"}
        actuators.append(pid_element(names, servos[name], time_step_s))
    sensors = "".join(f'<touch name="{leg}_foot_touch" site="{leg}_foot"/>' for leg in LEGS)
    if imu:
        sensors += '<gyro name="gyro" site="imu"/><accelerometer name="accelerometer" site="imu"/>'
    scale = TRUNK_KG / _TRUNK_URDF_KG
    trunk = _inertial(TRUNK_KG, _TRUNK_CENTRE, tuple(scale * x for x in _TRUNK_INERTIA))
    shape = ""
    if complete:
        shape = (
            # it goes with the robot, and so does the part of the ground that shadows are drawn on
            '<light mode="trackcom" pos="-0.3 -0.2 1.2" dir="0.25 0.17 -1" directional="true" '
            'diffuse="0.75 0.75 0.75" specular="0.1 0.1 0.1" castshadow="true"/>'
            f'<geom name="trunk" type="box" size="{numbers(*TRUNK_BOX_M)}" '
            f'pos="{numbers(*TRUNK_BOX_AT_M)}" rgba="0.2 0.35 0.6 1"/>'
        )
    return f"""<mujoco model="mini_pupper_2">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{time_step_s!r}" integrator="{INTEGRATOR}" cone="pyramidal"
    {_SOLVERS[physics]}/>
  <visual>
    <global offwidth="1280" offheight="720"/><quality shadowsize="4096"/>
    <map shadowclip="12" shadowscale="0.6" znear="0.01"/>
    <headlight ambient="0.3 0.3 0.3" diffuse="0.15 0.15 0.15" specular="0 0 0"/>
  </visual>
  <asset>
    <texture name="grid" type="2d" builtin="checker" rgb1="0.80 0.83 0.87" rgb2="0.68 0.72 0.77"
      width="300" height="300"/>
    <material name="grid" texture="grid" texrepeat="5 5" texuniform="true"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.95 0.97 1" rgb2="0.7 0.8 0.95"
      width="64" height="64"/>
    {assets}
  </asset>
  <default>
    <geom contype="1" conaffinity="0" friction="0.8 0.005 0.0001" priority="0"/>
    <default class="visual"><geom contype="0" conaffinity="0" group="2" mass="0"/></default>
  </default>
  <worldbody>
    {ground}
    <body name="trunk" pos="0 0 {STANDING_HEIGHT_M}">
      <freejoint name="root"/>
      {trunk}
      <site name="imu" pos="0 0 0" xyaxes="0 1 0 1 0 0" group="3"/>
      {shape}
      {legs}
    </body>
  </worldbody>
  {tendons}
  <actuator>{"".join(actuators)}</actuator>
  <sensor>{sensors}</sensor>
</mujoco>"""


def foot_position(leg: str, hip: float, thigh: float, calf: float) -> np.ndarray:
    """Centre of a foot in the trunk's frame [m], shape (..., 3), from its joint angles [rad]."""
    side = SIDE[leg]
    x = THIGH_X_M - THIGH_M * np.sin(thigh) - CALF_M * np.sin(np.add(thigh, calf))
    down = -THIGH_M * np.cos(thigh) - CALF_M * np.cos(np.add(thigh, calf))
    out = side * (THIGH_Y_M + CALF_Y_M)
    y = out * np.cos(hip) - down * np.sin(hip)
    z = out * np.sin(hip) + down * np.cos(hip)
    return np.stack(np.broadcast_arrays(HIP_X_M[leg] + x, side * HIP_Y_M + y, z), axis=-1)


def joint_angles(leg: str, foot: np.ndarray) -> np.ndarray:
    """Joint angles of a leg [rad], shape (..., 3), for a foot in the trunk's frame [m].

    Out of reach, the nearest straight or folded leg is taken. The knee bends backward.
    """
    side = SIDE[leg]
    x = foot[..., 0] - HIP_X_M[leg] - THIGH_X_M
    y, z = foot[..., 1] - side * HIP_Y_M, foot[..., 2]
    out = side * (THIGH_Y_M + CALF_Y_M)
    down = -np.sqrt(np.maximum(y**2 + z**2 - out**2, 1e-8))
    hip = np.arctan2(out * z - down * y, out * y + down * z)
    reach = np.clip(np.hypot(x, down), abs(THIGH_M - CALF_M) + 1e-6, THIGH_M + CALF_M - 1e-6)
    bend = np.arccos(
        np.clip((reach**2 - THIGH_M**2 - CALF_M**2) / (2 * THIGH_M * CALF_M), -1.0, 1.0)
    )
    calf = -bend
    thigh = np.arctan2(-x, -down) + np.arctan2(
        CALF_M * np.sin(bend), THIGH_M + CALF_M * np.cos(bend)
    )
    return np.stack(np.broadcast_arrays(hip, thigh, calf), axis=-1)


def default_pose() -> np.ndarray:
    """Standing joint angles [rad], shape (12,)."""
    return np.array([DEFAULT_POSE[name] for name in JOINT_NAMES])


def limits() -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper joint limits [rad], each (12,)."""
    low, high = np.array([LIMITS_RAD[name] for name in JOINT_NAMES]).T
    return low, high


# ---------------------------------------------------------------------------------- pieces


def _leg(
    leg: str, servos: dict[str, DelayedPDParameters], step: float, knee: Knee, complete: bool
) -> str:
    """One leg; if not `complete`, without parts that are only seen or touch the ground in falls."""
    side = SIDE[leg]
    joints = {
        kind: f'<joint name="{leg}_{kind}" type="hinge" axis="{axis}" '
        f'range="{numbers(*LIMITS_RAD[f"{leg}_{kind}"])}" '
        + (
            ""
            if kind == "calf" and knee == "linkage"
            else attributes(joint_attributes(servos[f"{leg}_{kind}"], step))
        )
        + "/>"
        for kind, axis in (("hip", "1 0 0"), ("thigh", "0 1 0"), ("calf", "0 1 0"))
    }
    x, y, z = HIP_BOX_AT_M
    hip = thigh = calf = ""
    if complete:
        hip = (
            f'<geom name="{leg}_hip" type="box" size="{numbers(*HIP_BOX_M)}" '
            f'pos="{x} {side * y} {z}" rgba="0.25 0.25 0.28 1"/>'
        )
        thigh = (
            f'<geom name="{leg}_thigh" type="capsule" size="{THIGH_RADIUS_M}" '
            f'fromto="0 0 0 0 0 {-THIGH_M}" rgba="0.9 0.55 0.15 1"/>'
        )
        calf = f'<geom class="visual" type="capsule" size="0.0015" fromto="0 0 0 0 0 {-CALF_M}"/>'
    # a cylinder's rim on a plane makes up to eight contacts, a sphere one, in the same place
    return f"""<body name="{leg}_hip" pos="{HIP_X_M[leg]} {side * HIP_Y_M} 0">
        {joints["hip"]}{_mirrored(_HIP, side)}{hip}
        <body name="{leg}_thigh" pos="{THIGH_X_M} {side * THIGH_Y_M} 0">
          {joints["thigh"]}{_mirrored(_THIGH, side)}{thigh}
          <body name="{leg}_calf" pos="0 {side * CALF_Y_M} {-THIGH_M}">
            {joints["calf"]}{_mirrored(_CALF, side)}{calf}
            <geom name="{leg}_foot" type="sphere" size="{FOOT_RADIUS_M}" pos="0 0 {-CALF_M}"
              priority="1" rgba="0.1 0.1 0.1 1"/>
            <site name="{leg}_foot" type="sphere" size="0.013" pos="0 0 {-CALF_M}" group="4"/>
          </body>
        </body>
      </body>"""


def _mirrored(body: tuple, side: int) -> str:
    mass, (x, y, z), (xx, yy, zz, xy, xz, yz) = body
    return _inertial(mass, (x, side * y, z), (xx, yy, zz, side * xy, xz, side * yz))


def _inertial(mass: float, centre: tuple, inertia: tuple) -> str:
    return f'<inertial mass="{mass!r}" pos="{numbers(*centre)}" fullinertia="{numbers(*inertia)}"/>'


_SIDE = np.array([SIDE[leg] for leg in LEGS])
_HIPS_M = np.stack([[HIP_X_M[leg] for leg in LEGS], _SIDE * HIP_Y_M, np.zeros(4)], axis=1)
_DOWN_M = float(np.hypot(THIGH_M, THIGH_Y_M)) + THIGH_RADIUS_M
_ASIDE_M = float(np.hypot(np.abs(_HIPS_M[:, 0]).max() + THIGH_M, HIP_Y_M + _DOWN_M))
"""No point of trunk, hips and thighs is farther below the trunk's origin, or aside of it."""


def touches_ground(qpos: Array, gravity: Array, ground: Ground) -> NDArray[np.bool_]:
    """Whether trunk, hips or thighs touch the ground, shape (n,): a fall.

    Their lowest points are compared with the ground below them, so that a fall needs no contact,
    and is the same in both kinds of `Physics`.

    `qpos`, shape (n, 19), is MuJoCo's: position and quaternion of the trunk, joint angles.
    `gravity`, shape (n, 3), is its direction in the trunk's frame.
    """
    tilt = np.hypot(gravity[:, 0], gravity[:, 1])
    above = qpos[:, 2] - ground.highest_near(qpos[:, 0], qpos[:, 1])
    # a walking robot is too high for any pose to reach the ground, but with its feet
    low = np.flatnonzero(above < _DOWN_M + _ASIDE_M * tilt)
    touching = np.zeros(len(qpos), bool)
    if len(low):
        points, radius = lowest_points(qpos[low, 7:])
        at = qpos[low, None, :3] + np.einsum("nij,npj->npi", _axes(qpos[low, 3:7]), points)
        gap = at[..., 2] - radius - ground.height(at[..., 0], at[..., 1])
        touching[low] = gap.min(axis=1) < 0.0
    return touching


def lowest_points(joints: Array) -> tuple[Array, Array]:
    """Points of which the lowest is that of trunk, hips and thighs, while the trunk is upright.

    Joint angles [rad] have the shape (n, 12). Gives points in the trunk's frame [m], shape (n, 28,
    3): lower corners of the boxes, ends of the thighs; and the radius around each [m], shape (28,).
    """
    angles = joints.reshape(len(joints), 4, 3)
    thigh = angles[:, :, 1]
    corner = np.broadcast_to(_lower_corners(HIP_BOX_AT_M, HIP_BOX_M), (len(joints), 4, 4, 3)).copy()
    corner[..., 1] *= _SIDE[:, None]
    top = np.zeros((len(joints), 4, 2, 3))
    top[..., 0], top[..., 1] = THIGH_X_M, (_SIDE * THIGH_Y_M)[:, None]
    top[:, :, 1, 0] -= THIGH_M * np.sin(thigh)
    top[:, :, 1, 2] -= THIGH_M * np.cos(thigh)
    leg_points = np.concatenate([corner, top], axis=2)  # in the hips' frames
    c, s = np.cos(angles[:, :, :1]), np.sin(angles[:, :, :1])
    y, z = leg_points[..., 1].copy(), leg_points[..., 2].copy()
    leg_points[..., 1], leg_points[..., 2] = c * y - s * z, s * y + c * z
    leg_points += _HIPS_M[:, None]
    trunk = np.broadcast_to(_lower_corners(TRUNK_BOX_AT_M, TRUNK_BOX_M), (len(joints), 4, 3))
    points = np.concatenate([trunk, leg_points.reshape(len(joints), 24, 3)], axis=1)
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
