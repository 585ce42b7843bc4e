"""Handicaps: what makes a walk harder than the usual conditions, for some robots of a batch.

A slope is a plane whose gravity is tilted, which is the same physics; the direction of gravity that
a policy sees is tilted with it. So robots on slopes, with loads, weak legs or slippery feet share a
batch with all others on flat ground. Robots begin at random headings, so a slope is walked up, down
and across. What is random comes from the seed and the robot's number: the same robot has the same
pushes and missed ticks under every condition and by whatever it walks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.joints import JOINT_NAMES, LEGS
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import TRUNK_BOX_AT_M, TRUNK_BOX_M
from pupper_sysid.sim.robot.motion import own_velocity
from pupper_sysid.sim.robot.robot_batch import RobotBatch
from pupper_sysid.sim.robot.terrain import STAIRS_M
from pupper_sysid.sim.walking.observation import OBSERVATION_PARTS

Array = NDArray[np.float64]

FIRST_PUSH_S, PUSH_EVERY_S = 3.0, 4.0
_GRAVITY = OBSERVATION_PARTS["projected_gravity"]
_ABOVE_M = TRUNK_BOX_AT_M[2] + TRUNK_BOX_M[2]  # loads lie on the trunk
_PER_LEG = len(JOINT_NAMES) // len(LEGS)
_OF_MOTOR = ("stiffness", "damping", "effort_limit")


@dataclass(frozen=True)
class Handicap:
    """What makes a robot's walk harder; the default is nothing."""

    push_m_s: float = 0.0
    """Horizontal speed that a push adds to the trunk, in a random direction, every 4 s from 3 s
    on."""
    slope_deg: float = 0.0
    """Slope of the ground."""
    riser_m: float | None = None
    """Height of steps, one of `STAIRS_M`; the task's ground must be `stairs`."""
    payload_kg: float = 0.0
    """Point mass on the trunk."""
    payload_at_m: tuple[float, float] = (0.0, 0.0)
    """Where it lies: forward and to the left of the trunk's origin."""
    weak_leg: float = 1.0
    """Factor on the torque of the motors of one leg, robot k's leg k of LF, RF, LB, RB and again;
    their friction stays."""
    missed_ticks: float = 0.0
    """Chance that a control tick is missed: the set-points stay, and the policy does not run."""
    extra_jitter_s: float = 0.0
    """Added to the standard deviation of the commands' latency [s]; its mean stays."""
    friction: float | None = None
    """Sliding friction of the feet on the ground, instead of the task's."""

    @property
    def gravity_direction(self) -> Array:
        """Unit vector, shape (3,), in axes of which the third is the ground's normal."""
        angle = np.radians(self.slope_deg)
        return np.array([np.sin(angle), 0.0, -np.cos(angle)])

    def since_push_s(self, time_s: float) -> float | None:
        """Time since the last push; None if there was none."""
        if not self.push_m_s or time_s < FIRST_PUSH_S:
            return None
        return (time_s - FIRST_PUSH_S) % PUSH_EVERY_S


def impose(robots: RobotBatch, ids: NDArray[np.intp], own: Handicap) -> None:
    """Give robots a handicap, at the start of their walk.

    `ids` are robots in the order of their numbers, from 0 on.
    """
    if own.weak_leg != 1.0:
        first = _PER_LEG * (np.arange(len(ids)) % len(LEGS))
        joints = first[:, None] + np.arange(_PER_LEG)
        for name in _OF_MOTOR:
            robots.drawn[name][ids[:, None], joints] *= own.weak_leg
    if own.friction is not None:
        robots.friction[ids] = own.friction
    if own.weak_leg != 1.0 or own.friction is not None:
        robots.write(ids)
    if own.payload_kg:
        _load(robots, ids, own.payload_kg, np.array([*own.payload_at_m, _ABOVE_M]))
    if own.slope_deg:
        size = np.linalg.norm(robots.model.opt.gravity)
        robots.field("opt.gravity")[ids] = size * own.gravity_direction
    if own.riser_m is not None:
        # pyramids are wider than the square in which robots are placed
        robots.move(ids, STAIRS_M[own.riser_m] + 3.0 * robots.qpos[ids, :2])


def _load(robots: RobotBatch, ids: NDArray[np.intp], mass_kg: float, at: Array) -> None:
    """Fix a point mass to the trunk."""
    trunk = robots.model.body("trunk").id
    mass, place, axes, inertia = (
        robots.field(name) for name in ("body_mass", "body_ipos", "body_iquat", "body_inertia")
    )
    for i in ids:
        before, centre = mass[i, trunk], place[i, trunk].copy()
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, axes[i, trunk])
        turn = turn.reshape(3, 3)
        whole = before + mass_kg
        away = at - centre
        # of both about their common centre: parallel axes with the reduced mass
        tensor = turn @ np.diag(inertia[i, trunk]) @ turn.T
        tensor += before * mass_kg / whole * (away @ away * np.eye(3) - np.outer(away, away))
        moments, turn = np.linalg.eigh(tensor)
        turn[:, 0] *= np.linalg.det(turn)
        mujoco.mju_mat2Quat(axes[i, trunk], turn.ravel())
        mass[i, trunk], inertia[i, trunk] = whole, moments
        place[i, trunk] = centre + mass_kg / whole * away
    robots.batch.set_const(ids)


def see_slope(
    observation: NDArray[np.float32], ids: NDArray[np.intp], robots: RobotBatch, own: Handicap
) -> None:
    """Tilt the gravity that robots on a slope see; `observation` is theirs, shape (k, 60)."""
    if own.slope_deg:
        flat = np.array([0.0, 0.0, -1.0])
        added = np.zeros((len(ids), 6))
        added[:, :3] = own.gravity_direction - flat
        observation[:, _GRAVITY] += own_velocity(robots.qpos[ids], added)


def push_directions(robots: int, steps: int, step_s: float, seed: int) -> dict[int, Array]:
    """Unit vectors, shape (robots, 2), by the control step before which robots are pushed."""
    first, every = round(FIRST_PUSH_S / step_s), round(PUSH_EVERY_S / step_s)
    rng = np.random.default_rng([seed, 5])
    found = {}
    for step in range(first, steps, every):
        angle = rng.uniform(-np.pi, np.pi, robots)
        found[step] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return found


def missed_ticks(robots: int, steps: int, seed: int) -> Array:
    """Numbers in 0–1, shape (steps, robots): a tick is missed where they are below its chance."""
    found = np.random.default_rng([seed, 4]).random((steps, robots))
    found[0] = 1.0  # the first tick begins the walk
    return found
