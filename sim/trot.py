"""An open-loop trot: where the twelve joints go, given a phase and a commanded motion.

Each foot moves fore and aft (or along whatever the command asks of it) with the cosine of its
phase, is on the ground for half a cycle and lifted along a half sine for the other; diagonal pairs
are half a cycle apart. It is the environment's first test, and what `sim.walking_env` and
`policies.imitation` call a reference.

`phase_of` reads the phase off joint targets, so that the trot can be continued from any action by
someone who does not see a clock.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.joints import LEGS
from sim.mini_pupper import default_pose, foot_position, joint_angles

_PAIR = np.array([1.0, -1.0, -1.0, 1.0])  # LF, RF, LB, RB: +1 moves with LF


@dataclass(frozen=True)
class Trot:
    """A trot. Feet leave the ground for half of each cycle."""

    frequency_hz: float = 3.5
    """Strides per second."""
    lift_m: float = 0.010
    """Height of a swinging foot."""
    gain: float = 1.0
    """Speed of the feet over the commanded speed; above 1 makes up for slip."""

    def joints(
        self, phase: NDArray[np.float64], command: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Joint targets [rad], shape (n, 12).

        Parameters
        ----------
        phase : ndarray, shape (n,)
            Of LF and RB [rad]; at 0 they touch down in front.
        command : ndarray, shape (n, 3)
            Forward and sideways speed [m/s], turn rate [rad/s]; 0, 0, 0 stands.
        """
        stroke = self._strokes(command)
        moving = np.abs(command).max(axis=1) > 0
        angles = []
        for i, leg in enumerate(LEGS):
            own = phase if _PAIR[i] > 0 else phase + np.pi
            foot = _NEUTRAL[i] + np.concatenate(
                [
                    stroke[:, i] * np.cos(own)[:, None],
                    (self.lift_m * moving * np.maximum(-np.sin(own), 0.0))[:, None],
                ],
                axis=1,
            )
            angles.append(joint_angles(leg, foot))
        return np.where(moving[:, None], np.concatenate(angles, axis=1), default_pose())

    def phase_of(
        self, joints: NDArray[np.float64], command: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Phase [rad], shape (n,), of the point of the trot that is nearest to joint targets.

        Parameters
        ----------
        joints : ndarray, shape (n, 12)
        command : ndarray, shape (n, 3)
            Not all 0: a standing robot has no phase.
        """
        stroke = self._strokes(command)
        along, lifted = np.zeros(len(joints)), np.zeros(len(joints))
        for i, leg in enumerate(LEGS):
            away = foot_position(leg, *joints[:, 3 * i : 3 * i + 3].T) - _NEUTRAL[i]
            along += _PAIR[i] * (away[:, :2] * stroke[:, i]).sum(axis=1)
            lifted -= _PAIR[i] * away[:, 2] / 2
        size = np.maximum((stroke**2).sum(axis=(1, 2)), 1e-12)
        return np.arctan2(lifted / self.lift_m, along / size)

    def _strokes(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Half of each foot's stroke along x and y [m], shape (n, 4, 2)."""
        x, y = _NEUTRAL[:, 0], _NEUTRAL[:, 1]
        speed = np.stack(
            [command[:, :1] - command[:, 2:] * y, command[:, 1:2] + command[:, 2:] * x], axis=-1
        )
        # from +A to -A in half a cycle: the mean speed of the stance is 4 A f
        return self.gain * speed / (4 * self.frequency_hz)


_NEUTRAL = np.array(
    [foot_position(leg, *default_pose()[3 * i : 3 * i + 3]) for i, leg in enumerate(LEGS)]
)
