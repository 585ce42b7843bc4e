"""What feet, trunk and servos of many robots did over the last strides, for rewards and scores.

`Strides` counts swings and stances and averages velocities: rewards and the critic look back over
more than one control step.

A swing of a third of a stride lasts three control steps, and a servo is at its torque limit for
parts of one, so `EffortMeter` takes clearance and effort from the state after each physics step
(`Moved`). A swing is the time between two contacts of a foot, of `SHORTEST_SWING_S` at least:
shorter ones are flickers of a foot that carries. Its clearance is the largest height of the sole
over the ground in it; a foot that stumbles in the air makes two swings. Mechanical power is the
positive work of all servos over time: none of them gives back what it brakes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.imu import GRAVITY_M_S2
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.robot_batch import Moved, RobotBatch
from pupper_sysid.sim.walking.config import Rewards

Array = NDArray[np.float64]

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
    """Effort of robots, step by step."""

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
