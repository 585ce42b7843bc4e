"""Reward terms of the walking task, and what feet, trunk and servos did over the last strides.

A term is a small function of a `Step` and the `Rewards` that gives one number per environment.
Rewards, the critic and scores look back over more than one control step: `Strides` counts swings
and stances and averages velocities, `EffortMeter` measures clearance and effort.

Two errors of the published terms are not repeated: penalties act on the joints they name, and foot
terms use the foot, not the knee, whose frame the published robot model calls a foot.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.imu import GRAVITY_M_S2
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.robot_batch import Moved, RobotBatch
from pupper_sysid.sim.walking.config import Rewards
from pupper_sysid.sim.walking.step import Step

Array = NDArray[np.float64]
_SLOW = (0.05, 0.15)  # commands [m/s, rad/s] that are not much above the trunk's sway


def base_linear_velocity(s: Step, p: Rewards) -> Array:
    """Tracking of the commanded speed, 0 to 1 (more with `fast_bonus`)."""
    error = np.linalg.norm((s.command - s.followed_velocity)[:, :2], axis=1)
    speed = np.linalg.norm(s.command[:, :2], axis=1)
    bonus = np.maximum(1.0, 1.0 + p.fast_bonus * (speed - p.fast_above))
    return _tracking(error, p.linear_sigma, p) * bonus


def base_angular_velocity(s: Step, p: Rewards) -> Array:
    """Tracking of the commanded turn rate, 0 to 1."""
    return _tracking(np.abs(s.command[:, 2] - s.followed_velocity[:, 2]), p.angular_sigma, p)


def stride_linear_velocity(s: Step, p: Rewards) -> Array:
    """Tracking of the commanded speed on average over a stride, 0 to 1."""
    error = np.linalg.norm(s.command[:, :2] - s.stride_velocity[:, :2], axis=1)
    return _tracking(error, p.stride_linear_sigma, p)


def stride_angular_velocity(s: Step, p: Rewards) -> Array:
    """Tracking of the commanded turn rate on average over a stride, 0 to 1."""
    return _tracking(np.abs(s.command[:, 2] - s.stride_velocity[:, 2]), p.stride_angular_sigma, p)


def progress(s: Step, p: Rewards) -> Array:
    """Share of the commanded speed by which the mean over a stride is nearer than 0, -1 to 1."""
    return _nearer(s.command[:, :2], s.stride_velocity[:, :2], _SLOW[0] * s.body.command_scale[0])


def turn_progress(s: Step, p: Rewards) -> Array:
    """The same of the turn rate."""
    return _nearer(s.command[:, 2:], s.stride_velocity[:, 2:], _SLOW[1] * s.body.command_scale[2])


def _nearer(command: Array, velocity: Array, slow: float) -> Array:
    speed = np.linalg.norm(command, axis=1)
    gained = speed - np.linalg.norm(command - velocity, axis=1)
    # below `slow` the share of a small command would be that of the trunk's sway
    return np.where(speed > 0, np.clip(gained / np.hypot(speed, slow), -1.0, 1.0), 0.0)


def unsupported(s: Step, p: Rewards) -> Array:
    """0 with half of the feet or more on the ground, 1 in flight, evenly between."""
    return np.maximum(1.0 - 2.0 / len(s.body.feet) * s.contact.sum(axis=1), 0.0)


def short_swing(s: Step, p: Rewards) -> Array:
    """Share of `shortest_swing` that was missing, summed over feet that have just come down."""
    missing = np.maximum(1.0 - s.last_air_s / p.shortest_swing, 0.0)
    return (s.landed * missing).sum(axis=1)


def short_stance(s: Step, p: Rewards) -> Array:
    """Share of `shortest_stance` that was missing, summed over feet that have just left."""
    missing = np.maximum(1.0 - s.last_contact_s / p.shortest_stance, 0.0)
    return (s.lifted * missing).sum(axis=1)


def air_time(s: Step, p: Rewards) -> Array:
    """Sum over feet of the present swing or stance, up to `air_time_most` [s]."""
    most = p.air_time_most
    longest = np.maximum(s.air_s, s.contact_s)
    walking = np.where(longest < most, np.minimum(longest, most), 0.0)
    standing = np.clip(s.contact_s - s.air_s, -most, most)
    moving = s.moving(p.moving_threshold)[:, None]
    return np.where(moving, walking, standing).sum(axis=1)


def gait(s: Step, p: Rewards) -> Array:
    """Product over pairs of feet: 1 if they move together, or in turn, as in a trot."""
    most = p.gait_most**2
    product = np.ones(len(s.command))
    air, contact = s.air_s, s.contact_s
    for pairs, first, second in (
        (s.body.together, air, contact), (s.body.apart, contact, air),
    ):  # fmt: skip
        for a, b in pairs:
            gap = np.minimum((air[:, a] - first[:, b]) ** 2, most)
            gap = gap + np.minimum((contact[:, a] - second[:, b]) ** 2, most)
            product = product * np.exp(-gap / p.gait_sigma)
    return np.where(s.moving(p.gait_threshold), product, 0.0)


def foot_paths(s: Step, p: Rewards) -> Array:
    """Nearness of the feet to where the clock wants them in the trunk's frame, -2 to 1.

    It is 1 - Σ e² / σ² of the four distances e, -2 at least; 0 for a robot that is to stand.

    While the clock wants a foot down, it passes evenly under its place in the default pose at the
    commanded speed, by the rule of Raibert (1986); meanwhile the others swing back and rise by
    `clock_height`. Margolis and Agrawal (2022) reward both. The mean place of the feet along the
    trunk and their height are free, and how far they are spread (see `stance`); of a gait that
    sways, their mean place to the side instead.
    """
    cycle = np.arctan2(s.clock[:, 1], s.clock[:, 0])[:, None] / (2 * np.pi)
    # since the middle of a foot's swing, -0.5 to 0.5 cycles
    phase = (cycle + s.body.offsets + 0.25) % 1.0 - 0.5
    half = 0.5 * (1.0 - p.clock_duty)
    swings = np.abs(phase) < half
    along = np.where(swings, phase / half, np.sign(phase) * (0.5 - np.abs(phase)) / (0.5 - half))
    x, y, turn = s.command.T[:, :, None]
    at = s.body.feet_at
    speed = np.stack([x - turn * at[:, 1], y + turn * at[:, 0]], axis=-1)
    away = _feet_away(s)
    away[..., :2] -= along[..., None] * speed * p.clock_duty / (2 * p.clock_hz)
    away[..., 2] -= np.where(swings, p.clock_height * np.cos(0.5 * np.pi * phase / half), 0.0)
    away[..., 0::2] -= away[..., 0::2].mean(axis=1, keepdims=True)
    # a gait that sways carries the trunk from foot to foot
    free = np.ones(len(at)) if s.body.sways else s.body.sides
    away[..., 1] -= free * (free * away[..., 1]).mean(axis=1, keepdims=True)
    missed = (away**2).sum(axis=(1, 2)) / p.foot_paths_sigma**2
    return np.where(np.abs(s.command).max(axis=1) > 0, np.maximum(1.0 - missed, -2.0), 0.0)


def stance(s: Step, p: Rewards) -> Array:
    """Distance of the feet, all together, from `crouch` and `spread` [m]; 0 while standing."""
    away = _feet_away(s)
    lower, wider = away[..., 2].mean(axis=1), (s.body.sides * away[..., 1]).mean(axis=1)
    missed = np.abs(lower - p.crouch) + np.abs(wider - p.spread)
    return np.where(np.abs(s.command).max(axis=1) > 0, missed, 0.0)


def _feet_away(s: Step) -> Array:
    """Feet in the trunk's frame less where they are in the default pose [m], shape (n, 4, 3)."""
    return s.body.feet_in_trunk(s.body.pose + s.position_relative) - s.body.feet_at


def foot_clearance(s: Step, p: Rewards) -> Array:
    """Nearness of moving feet to `clearance_height`, 0 to 1."""
    moves = np.tanh(p.clearance_speed * s.foot_speed_m_s)
    error = ((s.foot_height_m - p.clearance_height) ** 2 * moves).sum(axis=1)
    return np.exp(-error / p.clearance_sigma)


def swing_height(s: Step, p: Rewards) -> Array:
    """Squared shortfall below `clearance_height` times the foot's speed, summed [m³/s]."""
    short = np.maximum(p.clearance_height - s.foot_height_m, 0.0)
    return (short**2 * s.foot_speed_m_s).sum(axis=1)


def low_swing(s: Step, p: Rewards) -> Array:
    """Share of `least_clearance` that was missing, summed over feet whose swing has just ended."""
    missing = np.maximum(1.0 - s.clearance_m / p.least_clearance, 0.0)
    return np.where(s.swing_ended, missing, 0.0).sum(axis=1)


def air_time_variance(s: Step, p: Rewards) -> Array:
    """Variance over feet of their last swings and stances, up to half a second [s²]."""
    swings, stances = np.minimum(s.last_air_s, 0.5), np.minimum(s.last_contact_s, 0.5)
    return swings.var(axis=1, ddof=1) + stances.var(axis=1, ddof=1)


def base_motion(s: Step, p: Rewards) -> Array:
    """Bouncing and rocking of the trunk."""
    rocking = np.abs(s.angular_velocity[:, :2]).sum(axis=1)
    return 0.8 * s.linear_velocity[:, 2] ** 2 + 0.2 * rocking


def joint_position(s: Step, p: Rewards) -> Array:
    """Norm of the distance from the default pose [rad], more while standing."""
    factor = np.where(s.moving(p.moving_threshold), 1.0, p.standing_factor)
    return np.linalg.norm(s.position_relative, axis=1) * factor


TERMS: dict[str, Callable[[Step, Rewards], Array]] = {
    "base_linear_velocity": base_linear_velocity,
    "base_angular_velocity": base_angular_velocity,
    "stride_linear_velocity": stride_linear_velocity,
    "stride_angular_velocity": stride_angular_velocity,
    "progress": progress,
    "turn_progress": turn_progress,
    "alive": lambda s, p: np.ones(len(s.command)),
    "unsupported": unsupported,
    "short_swing": short_swing,
    "short_stance": short_stance,
    "air_time": air_time,
    "foot_paths": foot_paths,
    "stance": stance,
    "gait": gait,
    "foot_clearance": foot_clearance,
    "swing_height": swing_height,
    "low_swing": low_swing,
    "torque_saturation": lambda s, p: s.saturated.mean(axis=1),
    "torque_share": lambda s, p: s.torque_square.mean(axis=1),
    "mechanical_power": lambda s, p: s.power_w / s.weight_n,  # m/s
    "action_smoothness": lambda s, p: _norm(s.action - s.last_action),
    "action_rate": lambda s, p: _square(s.action - s.last_action),
    "action_jerk": lambda s, p: _square(s.action - 2 * s.last_action + s.earlier_action),
    "air_time_variance": air_time_variance,
    "base_motion": base_motion,
    "bounce": lambda s, p: np.abs(s.linear_velocity[:, 2]),  # m/s
    "base_orientation": lambda s, p: _norm(s.gravity[:, :2]),  # sine of the tilt
    "foot_slip": lambda s, p: (s.contact * s.foot_speed_m_s).sum(axis=1),  # m/s
    "joint_position": joint_position,
    "hip_abduction": lambda s, p: _norm(s.position_relative[:, s.body.hips]),  # rad
    "joint_torques": lambda s, p: _norm(s.torque),  # N·m
    "joint_acceleration": lambda s, p: _norm(s.acceleration),  # rad/s²
    "joint_velocity": lambda s, p: _norm(s.velocity),  # rad/s
}
"""All terms by the name of their weight; those of a line are as `Rewards` says."""


GUIDES = ("foot_paths", "gait")
"""Terms that lead to steps; a curriculum may fade them."""
PROGRESS = ("progress", "turn_progress")
"""Terms that lead to travel; a curriculum may let them wait until there are steps."""


def weighted(
    step: Step, rewards: Rewards, penalties: float = 1.0, guides: float = 1.0, progress: float = 1.0
) -> dict[str, Array]:
    """Every term that counts, times its weight.

    `penalties`, `guides` and `progress` are factors on negative weights and on those of `GUIDES`
    and `PROGRESS`, for a curriculum.
    """
    factors: dict[str, float] = {
        **dict.fromkeys(GUIDES, guides), **dict.fromkeys(PROGRESS, progress),
    }  # fmt: skip
    terms = {}
    for name, term in TERMS.items():
        weight = getattr(rewards, name)
        factor = penalties if weight < 0 else factors.get(name, 1.0)
        if weight:
            terms[name] = weight * factor * term(step, rewards)
    return terms


def _norm(values: Array) -> Array:
    return np.linalg.norm(values, axis=1)


def _square(values: Array) -> Array:
    return (values**2).sum(axis=1)


def _tracking(error: Array, sigma: float, p: Rewards) -> Array:
    if p.tracking_shape == "linear":
        return np.maximum(1.0 - error / sigma, -1.0)
    if p.tracking_shape == "gaussian":
        return np.exp(-((error / sigma) ** 2))
    return np.exp(-error / sigma)


_STRIDE_S = 0.2  # time constant of the average over a stride of the Mini Pupper


class Strides:
    """Counters of n robots, of control steps of `span_s`.

    `air_s` and `stance_s`, shape (n, 4): time that each foot has been in the air, on the ground; 0
    if it is not. `velocity`, shape (n, 3): forward and sideways speed and turn rate, averaged over
    about a stride [m/s, rad/s].

    `phase`, shape (n,): φ, of the gait's clock, from 0 to 1: of a trot, left front and right rear
    are to be up in its first half, the others in its second. A phase-locked loop: it runs at
    `clock_hz` and follows what feet do in turn, x, the difference of the pairs' heights as shares
    of `clock_height` (-1 to 1), by 2·`clock_pull_hz`·x·cos 2πφ. Feet that step as x = sin 2πft draw
    it along for f within `clock_pull_hz` of `clock_hz`; at other rates it passes them by.
    `in_time`, shape (n,): 2x·sin 2πφ, averaged over about a stride: 1 for such feet.
    """

    def __init__(self, body: Body, robots: int, span_s: float, rewards: Rewards):
        self._span, self._rewards, feet = span_s, rewards, len(body.feet)
        self._share = span_s / (_STRIDE_S * float(body.command_scale[0]))
        self._touch_n, self._signs = body.touch_n, body.swing_signs
        self._in_turn = np.argsort(-self._signs, kind="stable")
        self.air_s, self.stance_s = np.zeros((2, robots, feet))
        self._last_air, self._last_stance = np.zeros((2, robots, feet))
        self._feet_at = np.zeros((robots, feet, 2))
        self.velocity = np.zeros((robots, 3))
        self.phase, self.in_time = np.zeros((2, robots))

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, live."""
        return {
            "air_s": self.air_s, "stance_s": self.stance_s, "last_air_s": self._last_air,
            "last_stance_s": self._last_stance, "feet_at": self._feet_at,
            "velocity": self.velocity, "phase": self.phase, "in_time": self.in_time,
        }  # fmt: skip

    def clock(self, rows: slice | NDArray[np.intp]) -> Array:
        """Cosine and sine of the phase, and `in_time`, of some robots, shape (k, 3)."""
        angle = 2 * np.pi * self.phase[rows]
        return np.column_stack([np.cos(angle), np.sin(angle), self.in_time[rows]])

    def reset(self, ids: NDArray[np.intp], feet_at: Array, velocity: Array) -> None:
        """Begin anew with some robots, whose feet are there and whose trunks move so."""
        for value in (
            self.air_s, self.stance_s, self._last_air, self._last_stance, self.phase,
            self.in_time,
        ):  # fmt: skip
            value[ids] = 0.0
        self._feet_at[ids], self.velocity[ids] = feet_at, velocity

    def advance(
        self,
        rows: slice,
        touch: Array,
        feet: tuple[Array, Array],
        velocity: Array,
        facts: dict[str, Any],
    ) -> None:
        """Let one control step pass for k robots `rows`, and write what happened into `facts`.

        `touch`, shape (k, 4), are the forces of the ground on the feet at the end of the step [N];
        `feet` the places of the soles, shape (k, 4, 2), and their heights above the ground, shape
        (k, 4) [m]; `velocity`, shape (k, 3), forward and sideways speed and turn rate of the trunk
        [m/s, rad/s].
        """
        span, (at, height) = self._span, feet
        np.greater(touch, self._touch_n, out=facts["contact"])
        np.logical_and(facts["contact"], self.air_s[rows] > 0, out=facts["landed"])
        np.logical_and(~facts["contact"], self.stance_s[rows] > 0, out=facts["lifted"])
        self._count(rows, facts["contact"])
        moved = at - self._feet_at[rows]
        self._feet_at[rows] = at
        moved *= moved
        np.sqrt(moved.sum(axis=-1), out=facts["foot_speed_m_s"])
        facts["foot_speed_m_s"] /= span
        facts["foot_height_m"][:] = height
        self.velocity[rows] += self._share * (velocity - self.velocity[rows])
        self._tick(rows, height)
        for name, value in (
            ("air_s", self.air_s), ("contact_s", self.stance_s), ("last_air_s", self._last_air),
            ("last_contact_s", self._last_stance), ("stride_velocity", self.velocity),
        ):  # fmt: skip
            facts[name][:] = value[rows]
        facts["clock"][:] = self.clock(rows)

    def _count(self, rows: slice, contact: NDArray[np.bool_]) -> None:
        air, stance = self.air_s[rows], self.stance_s[rows]
        np.copyto(self._last_air[rows], air, where=contact & (air > 0))
        np.copyto(self._last_stance[rows], stance, where=~contact & (stance > 0))
        air += self._span
        stance += self._span
        air[contact] = 0.0
        stance[~contact] = 0.0

    def _tick(self, rows: slice, height: Array) -> None:
        rewards = self._rewards
        share = np.clip(height / rewards.clock_height, 0.0, 1.0)
        swing = np.zeros(len(share))
        for foot in self._in_turn:
            swing += self._signs[foot] * share[:, foot]
        swing *= 2.0 / len(self._signs)
        phase, in_time = self.phase[rows], self.in_time[rows]
        angle = 2 * np.pi * phase
        in_time += self._share * (2 * swing * np.sin(angle) - in_time)
        phase += self._span * rewards.clock_hz
        phase += 2 * self._span * rewards.clock_pull_hz * swing * np.cos(angle)
        phase %= 1.0


SHORTEST_SWING_S = 0.04
LOW_SWING_M = 0.002
"""Clearance below which a swing is low: the next pebble or seam ends it."""
_AT_LIMIT = 0.999


class EffortMeter:
    """Clearance of the swings and effort of the servos, step by step.

    A swing of a third of a stride lasts three control steps, and a servo is at its torque limit for
    parts of one, so both are of the state after each physics step (`Moved`). A swing is the time
    between two contacts of a foot, of `SHORTEST_SWING_S` at least: shorter ones are flickers of a
    foot that carries. Its clearance is the largest height of the sole over the ground in it; a foot
    that stumbles in the air makes two swings. Mechanical power is the positive work of all servos
    over time: none of them gives back what it brakes.
    """

    def __init__(self, robots: RobotBatch, step_s: float):
        self._robots, self._step_s = robots, step_s
        self._highest = np.full((robots.environments, len(robots.body.feet)), -np.inf)

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, live."""
        return {"highest_m": self._highest}

    def reset(self, ids: NDArray[np.intp]) -> None:
        """Begin anew with some robots."""
        self._highest[ids] = -np.inf

    def advance(self, moved: Moved, facts: dict[str, Any]) -> None:
        """Write clearance and effort of one control step of some robots into `facts` of a `Step`.

        `facts` already has the contacts.
        """
        rows, robots = moved.rows, self._robots
        highest = np.maximum(self._highest[rows], robots.sole_heights(moved.feet).max(axis=1))
        ended = facts["contact"] & (facts["contact_s"] <= self._step_s + 1e-9)
        ended &= facts["last_air_s"] > SHORTEST_SWING_S - 1e-9
        facts["swing_ended"][:] = ended
        facts["clearance_m"][:] = np.where(ended, highest, np.nan)
        self._highest[rows] = np.where(facts["contact"], -np.inf, highest)
        limit = robots.field("actuator_forcerange")[rows, None, :, 1]
        share = np.abs(moved.load) / limit
        facts["saturated"][:] = (share >= _AT_LIMIT).mean(axis=1)
        facts["torque_square"][:] = (share * share).mean(axis=1)
        angles = np.concatenate([moved.start[:, None], moved.qpos[..., 7:]], axis=1)
        turned = np.diff(robots.to_servo(angles), axis=1)
        work = np.maximum(moved.load * turned, 0.0).sum(axis=(1, 2))
        facts["power_w"][:] = work / self._step_s
        facts["weight_n"][:] = GRAVITY_M_S2 * robots.field("body_mass")[rows].sum(axis=1)


def by_kind(body: Body, values: Array) -> Array:
    """Means over the joints of each of `Body.kinds`, shape (n, kinds), of values of all servos."""
    return np.stack([values[:, joints].mean(axis=1) for joints in body.kinds.values()], axis=1)
