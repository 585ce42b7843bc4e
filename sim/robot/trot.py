"""An open-loop trot: joint set-points from a phase and a commanded motion.

Diagonal pairs of feet are half a cycle apart. A foot on the ground passes under the trunk at the
commanded speed, so the trunk moves evenly; in the air it swings back and is lifted along a half
sine. Feet stand for more than half of a cycle: while all four carry, the trunk does not turn on a
diagonal. It is the reference of `sim.walking.env` and `policies.train.imitation`.

The defaults were chosen among 40 trots that walked on this robot with calibrated servos: feet clear
the ground by 9 mm in nine tenths of the swings that are judged before a training, against 5 mm of a
trot of 3.6 Hz that was searched for small errors alone, at the same errors there; under random
commands those of speed are a tenth to a fifth larger. Slower strides leave torque to lift feet, and
lower stances fall less often when pushed. The calves' range ends before the top of a swing: the
environment, which holds set-points within the joints' range, cuts off 1 to 3 of its 15 mm.

`phase_of` finds the phase of joint set-points, so that the trot can be continued from any action
without a clock.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.robot.body import Body, mini_pupper

Array = NDArray[np.float64]

_GRID = np.linspace(0.0, 2 * np.pi, 96, endpoint=False)


@dataclass(frozen=True)
class Trot:
    """A trot."""

    frequency_hz: float = 3.0
    """Strides per second."""
    lift_m: float = 0.015
    """Height of a swinging foot."""
    duty: float = 0.7
    """Share of a cycle in which a foot stands."""
    crouch_m: float = 0.021
    """How much lower than in the default pose the trunk is carried."""
    spread_m: float = 0.01
    """How much farther than in the default pose each foot is to its side."""
    even_swing: float = 1.0
    """How evenly a foot swings back: 0 as half a cosine, 1 at constant speed."""
    gain: float = 0.889
    """Speed of the feet over the commanded speed; this robot walks a little farther than its feet
    while it trots."""
    back_gain: float = 0.996
    """Factor on `gain` backward."""
    side_gain: float = 0.972
    """Factor on `gain` sideways."""
    turn_gain: float = 0.725
    """The same of turning: this robot turns farther than its feet while it trots."""
    turn_dead_band_rad_s: float = 0.087
    """Turn rate that is lost where feet do not step sideways: strokes of 1 mm lie in the dead band
    of the hips' friction. A turning command gets it on top."""

    def __post_init__(self):
        if not 0 < self.duty < 1 or not self.frequency_hz > 0:
            raise InputError(
                f"A trot of {self.frequency_hz} Hz in which feet stand for {self.duty} of a cycle "
                "is impossible: trot.frequency_hz must be positive, trot.duty between 0 and 1."
            )

    def joints(self, phase: Array, command: Array, body: Body | None = None) -> Array:
        """Joint set-points [rad], shape (n, 12).

        `phase`, shape (n,), is that of LF and RB [rad]: at 0 they touch down in front. `command`,
        shape (n, 3), is forward and sideways speed [m/s] and turn rate [rad/s]; 0, 0, 0 stands. The
        body is the Mini Pupper by default.
        """
        body = body or mini_pupper()
        along, up = self._cycle(phase, body)
        centre = feet_at(body, self.crouch_m, self.spread_m)
        stroke = self._strokes(command, centre)
        moving = np.abs(command).max(axis=1) > 0
        feet = np.empty((len(command), *centre.shape))
        for i in range(len(centre)):
            path = np.concatenate([stroke[:, i] * along[i][:, None], up[i][:, None]], axis=1)
            feet[:, i] = centre[i] + path
        # a foot that stands turns under the trunk as it passes
        heading = self._turn(command) * self.duty / (2 * self.frequency_hz) * along
        return np.where(moving[:, None], body.joints_at(feet, heading.T), body.pose)

    def phase_of(
        self,
        joints: Array,
        earlier: Array,
        between_s: float,
        command: Array,
        body: Body | None = None,
    ) -> Array:
        """Phase [rad], shape (n,), of the point of the trot nearest to joint set-points.

        The set-points `between_s` before them distinguish feet that rise from feet that come down,
        which short strokes alone do not. Both have the shape (n, 12); `command`, shape (n, 3), is
        not all 0: a standing robot has no phase. The body is the Mini Pupper by default.
        """
        body = body or mini_pupper()
        centre = feet_at(body, self.crouch_m, self.spread_m)
        stroke = self._strokes(command, centre)
        step = 2 * np.pi * self.frequency_hz * between_s
        distance = np.zeros((len(joints), len(_GRID)))
        for targets, phase in ((joints, _GRID), (earlier, _GRID - step)):
            along, up = self._cycle(phase, body)
            feet = body.feet_in_trunk(targets)
            for i in range(len(centre)):
                away = feet[:, i] - centre[i]
                # |away - path|² without the part that is the same at every phase
                distance -= 2 * (away[:, :2] * stroke[:, i]).sum(axis=1)[:, None] * along[i]
                distance += (stroke[:, i] ** 2).sum(axis=1)[:, None] * along[i] ** 2
                distance += up[i] * (up[i] - 2 * away[:, 2:])
        nearest = distance.argmin(axis=1)
        rows = np.arange(len(joints))
        before, at, after = (distance[rows, (nearest + k) % len(_GRID)] for k in (-1, 0, 1))
        # the bottom of the parabola through the three lowest points
        bend = np.maximum(before - 2 * at + after, 1e-15)
        return _GRID[nearest] + _GRID[1] * np.clip(0.5 * (before - after) / bend, -0.5, 0.5)

    def _cycle(self, phase: Array, body: Body) -> tuple[NDArray, NDArray]:
        """Where feet are in their strokes, 1 to -1, and how high [m], each shape (4, n)."""
        foot_phase = (phase / (2 * np.pi) + body.offsets[:, None]) % 1.0
        stands = foot_phase < self.duty
        swing = np.pi * (foot_phase - self.duty) / (1.0 - self.duty)
        even, round_ = 2.0 / np.pi * swing - 1.0, -np.cos(swing)
        back = round_ + self.even_swing * (even - round_)
        along = np.where(stands, 1.0 - 2.0 * foot_phase / self.duty, back)
        return along, np.where(stands, 0.0, self.lift_m * np.sin(swing))

    def _strokes(self, command: Array, centre: Array) -> Array:
        """Half of each foot's stroke along x and y [m], shape (n, 4, 2)."""
        x, y = centre[:, 0], centre[:, 1]
        ahead = self.gain * np.where(command[:, :1] < 0, self.back_gain, 1.0)
        forward, sideways = ahead * command[:, :1], self.gain * self.side_gain * command[:, 1:2]
        turn = self._turn(command)[:, None]
        speed = np.stack([forward - turn * y, sideways + turn * x], axis=-1)
        # from +A to -A while it stands
        return speed * self.duty / (2 * self.frequency_hz)

    def _turn(self, command: Array) -> Array:
        """Turn rate of the feet [rad/s], shape (n,): a gain that depends on the command."""
        more = self.turn_dead_band_rad_s * self.turning_in_place(command)
        return self.turn_gain * command[:, 2] + more

    @staticmethod
    def turning_in_place(command: Array) -> Array:
        """Sign of the turn where feet do not step sideways, 0 where they do; smooth, shape (n,)."""
        sideways, turn = command[:, 1], command[:, 2]
        within = np.maximum(1.0 - (sideways / _BREAKS_LOOSE_M_S) ** 2, 0.0)
        return within * np.tanh(turn / _SOFT)


_BREAKS_LOOSE_M_S = 0.025  # speed sideways from which steps move the hips in any case
_SOFT = 0.05  # rad/s over which the dead band is added


def feet_at(body: Body, crouch_m: float, spread_m: float) -> Array:
    """Feet in the trunk's frame [m], shape (4, 3), of a trunk that is lower, and farther apart."""
    none = np.zeros(len(body.feet))
    return body.feet_at + np.column_stack([none, spread_m * body.sides, none + crouch_m])


def stance(body: Body, crouch_m: float, spread_m: float) -> Array:
    """Joint angles [rad], shape (12,), of a robot that stands so low and wide."""
    feet = feet_at(body, crouch_m, spread_m)[None]
    return body.joints_at(feet, np.zeros(feet.shape[:2]))[0]
