"""Body: what a walking robot is, behind environment, rewards, falls, mirror images and files.

A `Body` is frozen: its servo joints in order, default pose, limits, feet, which servo holds the sum
of two joints, its mirror image, standing height, and the scales of its motion. `mini_pupper` is
the Mini Pupper 2; `sim.robot.robot_file.body_from_file` makes one of any legged robot's MJCF with a
few lines of YAML. `body_of` finds either by the names in the settings of a task.

Robots of other sizes move alike where speeds over √(g·length) are equal (Froude). `scale` is the
standing height over the Mini Pupper's; speeds grow with its root, as times do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.joints import JOINT_NAMES, KINDS, LEGS
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.robot.mini_pupper import (
    FOOT_RADIUS_M,
    MASS_KG,
    STANDING_HEIGHT_M,
    Knee,
    Physics,
    default_pose,
    foot_position,
    joint_angles,
    limits,
    robot_xml,
    touches_ground,
)

if TYPE_CHECKING:
    from pupper_sysid.sim.robot.terrain import Ground

Array = NDArray[np.float64]

MINI_PUPPER = "mini_pupper_2"


@dataclass(frozen=True, eq=False)
class Body:
    """A legged robot with position servos; arrays are in the order of `joints` and of `feet`."""

    name: str
    joints: tuple[str, ...]
    """With a servo each; after the trunk they are all of MuJoCo's positions, in its order."""
    feet: tuple[str, ...]
    """Names of sites; `<foot>_touch` are touch sensors."""
    pose: Array
    low: Array
    high: Array
    """`pose`, `low` and `high`: default pose and limits [rad]; shape (joints,)."""
    linked: tuple[int, ...]
    """Servos that hold the sum of their joint and the one before it, through a linkage."""
    leg_of: NDArray[np.intp]
    """The foot that a joint moves, -1 of none; shape (joints,)."""
    feet_at: Array
    """In the trunk's frame in the default pose [m]; shape (feet, 3)."""
    sole_m: Array
    """Height of a foot's site over the ground while it stands; shape (feet,)."""
    offsets: Array
    """Gait table: by how much of a cycle a foot is behind the first one's phase; shape (feet,)."""
    mirror_joints: NDArray[np.intp] | None
    mirror_signs: Array | None
    mirror_feet: NDArray[np.intp] | None
    """`mirror_joints`, `mirror_signs` and `mirror_feet`: which joint (foot) a joint is the image
    of, and its sign; None of a robot without an image."""
    standing_height_m: float
    """Of the trunk's origin above the ground, in the default pose."""
    mass_kg: float
    xml: Callable[[dict[str, DelayedPDParameters], float, Ground, Physics], str]
    """`xml(servos, time_step_s, ground, physics)` gives the MJCF on a `Ground`."""
    feet_in_trunk: Callable[[Array], Array]
    """Feet in the trunk's frame [m], shape (n, feet, 3), of joint angles (n, joints) [rad]."""
    joints_at: Callable[[Array, Array], Array]
    """The inverse: joint angles (n, joints) that put the feet there, or near, and turn those with
    ankles to headings (n, feet) [rad]."""
    touches_ground: Callable[[Array, Array, Ground], NDArray[np.bool_]]
    """`touches_ground(qpos, gravity, ground)`: whether more than feet do, shape (n,)."""
    foot_geoms: tuple[str, ...]
    trunk: str = "trunk"
    """`foot_geoms` and `trunk`: names of geoms that carry, and of the body with the floating
    base."""
    servo_of: dict[str, str] = field(default_factory=dict)
    """The joint of a calibration whose servo each joint has."""
    commands: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Ranges by field of `Commands`, where the robot's YAML states them."""
    notes: tuple[str, ...] = ()
    """Sentences about what was assumed."""
    hashes: dict[str, str] = field(default_factory=dict)

    @cached_property
    def together(self) -> tuple[tuple[int, int], ...]:
        """Pairs of feet that the gait moves together."""
        return self._pairs(lambda gap: gap < 0.01)

    @cached_property
    def apart(self) -> tuple[tuple[int, int], ...]:
        """Pairs of feet that the gait moves in turn."""
        return self._pairs(lambda gap: abs(gap - 0.5) < 0.01)

    def _pairs(self, is_pair: Callable[[float], bool]) -> tuple[tuple[int, int], ...]:
        n, sides = len(self.feet), self.sides
        gaps = (self.offsets[:, None] - self.offsets) % 1.0
        pairs = [(a, b) for a in range(n) for b in range(a + 1, n) if is_pair(gaps[a, b])]
        return tuple(sorted(pairs, key=lambda pair: bool(sides[pair[0]] == sides[pair[1]])))

    @cached_property
    def kinds(self) -> dict[str, NDArray[np.intp]]:
        """Joints by kind: the Mini Pupper's names, or their places on a leg."""
        if self.is_mini_pupper:
            return {kind: np.arange(k, len(self.joints), 3) for k, kind in enumerate(KINDS)}
        place = np.zeros(len(self.joints), int)
        for leg in range(len(self.feet)):
            leg_joints = np.flatnonzero(self.leg_of == leg)
            place[leg_joints] = np.arange(1, len(leg_joints) + 1)
        kinds = {f"joint {k}": np.flatnonzero(place == k) for k in range(1, place.max() + 1)}
        without_leg = np.flatnonzero(self.leg_of < 0)
        return kinds | ({"other": without_leg} if len(without_leg) else {})

    @cached_property
    def hips(self) -> NDArray[np.intp]:
        """The first joint of each leg."""
        first = [np.flatnonzero(self.leg_of == leg)[:1] for leg in range(len(self.feet))]
        return np.concatenate(first)

    @cached_property
    def swing_signs(self) -> Array:
        """Weights of the feet in the swing of the gait's clock: 1 in its first half, -1 after."""
        return np.cos(2 * np.pi * self.offsets)

    @cached_property
    def sides(self) -> Array:
        """1 of feet on the left, -1 on the right, 0 in the middle."""
        return np.sign(np.where(np.abs(self.feet_at[:, 1]) > 1e-6, self.feet_at[:, 1], 0.0))

    @cached_property
    def sways(self) -> bool:
        """Whether the gait carries the trunk on one side after the other, as on two legs."""
        return bool(np.abs((self.sides * np.exp(2j * np.pi * self.offsets)).sum()) > 0.5)

    @property
    def scale(self) -> float:
        """Length scale: standing height over the Mini Pupper's; exactly 1 of that."""
        return self.standing_height_m / STANDING_HEIGHT_M

    @property
    def command_scale(self) -> Array:
        """Factors on forward and sideways speed and turn rate of the Mini Pupper's, shape (3,)."""
        root = self.scale**0.5
        return np.array([root, root, 1.0 / root])

    @property
    def touch_n(self) -> float:
        """Force on a foot that is down: a quarter of what it carries while standing [N]."""
        return 0.25 * (self.mass_kg / MASS_KG) * (len(LEGS) / len(self.feet))

    @property
    def is_mini_pupper(self) -> bool:
        """Whether it is the Mini Pupper 2."""
        return self.name == MINI_PUPPER


def mini_pupper(knee: Knee = "linkage") -> Body:
    """The Mini Pupper 2, whose third servo of a leg holds thigh + calf behind a linkage."""
    return _mini_pupper(knee)


@cache
def _mini_pupper(knee: Knee) -> Body:

    def xml(servos: dict[str, DelayedPDParameters], step_s: float, ground: Any, physics: Physics):
        return robot_xml(servos, step_s, knee, ground.xml, ground.assets, physics, False)

    def feet_in_trunk(joints: Array) -> Array:
        by_leg = joints.reshape(-1, len(LEGS), 3)
        return np.stack([foot_position(leg, *by_leg[:, i].T) for i, leg in enumerate(LEGS)], axis=1)

    def joints_at(feet: Array, heading: Array) -> Array:
        return np.concatenate([joint_angles(leg, feet[:, i]) for i, leg in enumerate(LEGS)], axis=1)

    pose, (low, high) = default_pose(), limits()
    mirrored = [LEGS.index({"L": "R", "R": "L"}[leg[0]] + leg[1:]) for leg in LEGS]
    return Body(
        name=MINI_PUPPER, joints=JOINT_NAMES, feet=tuple(f"{leg}_foot" for leg in LEGS),
        pose=pose, low=low, high=high,
        linked=tuple(range(2, len(JOINT_NAMES), 3)) if knee == "linkage" else (),
        leg_of=np.arange(len(JOINT_NAMES)) // 3, feet_at=feet_in_trunk(pose[None])[0],
        sole_m=np.full(len(LEGS), FOOT_RADIUS_M),
        offsets=np.array([0.0, 0.5, 0.5, 0.0]),
        mirror_joints=np.array([3 * leg + k for leg in mirrored for k in range(3)]),
        # hips turn about the forward axis, thighs and calves about the axis from side to side
        mirror_signs=np.array([-1.0 if name.endswith("hip") else 1.0 for name in JOINT_NAMES]),
        mirror_feet=np.array(mirrored), standing_height_m=STANDING_HEIGHT_M, mass_kg=MASS_KG,
        xml=xml, feet_in_trunk=feet_in_trunk, joints_at=joints_at,
        touches_ground=touches_ground,
        foot_geoms=tuple(f"{leg}_foot" for leg in LEGS),
    )  # fmt: skip


@cache
def body_of(robot: str, robot_config: str, knee: Knee = "linkage") -> Body:
    """The body that a task's settings name.

    Paths of a MJCF and of its YAML are both empty for the Mini Pupper 2, of which `knee` is.
    """
    if not robot:
        return mini_pupper(knee)
    from pupper_sysid.sim.robot.robot_file import body_from_file

    return body_from_file(Path(robot), Path(robot_config) if robot_config else None)


def fixed_offsets(feet_at: Array) -> Array:
    """Gait table by geometry: feet of a side alternate from front to back, sides are opposite.

    Of four feet that is a trot, of two a walk on two legs, of six a tripod gait.
    """
    offsets = np.zeros(len(feet_at))
    for right in (False, True):
        side_feet = np.flatnonzero((feet_at[:, 1] < 0) == right)
        ahead = side_feet[np.argsort(-feet_at[side_feet, 0], kind="stable")]
        offsets[ahead] = 0.5 * ((np.arange(len(side_feet)) + right) % 2)
    return offsets
