"""Held feedback of many robots at once (`servo_models.held_feedback`), one control step at a time.

The simulator gives the positions after each physics step, and each poll that falls between them is
interpolated there. Servo `i` of twelve is polled a share `i / 12` of a round after the first, in
the order of the joints (the robot's firmware, and so the emulated bus, goes by the servos' ids).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sim.emulator.robot import RobotSpec

# as of the emulated bus
_JITTER_S, _DRIFT = RobotSpec.poll_jitter_s, RobotSpec.poll_drift


class HeldReadings:
    """Readings of all servos of `environments` robots.

    Parameters
    ----------
    feedback : sequence of HeldFeedback
        Of each servo.
    environments : int
    physics_step_s : float
        Time between the positions that `advance` is given [s].
    rng : numpy.random.Generator

    Attributes
    ----------
    position, load : ndarray, shape (environments, servos)
        Readings: angle [rad] and torque [N·m] at the last successful poll.
    age_s : ndarray, shape (environments, servos)
        Age of the readings [s].
    rng : numpy.random.Generator
        Draws phases, drift, jitter and lost polls.
    """

    def __init__(
        self,
        feedback: Sequence[HeldFeedback],
        environments: int,
        physics_step_s: float,
        rng: np.random.Generator,
    ):
        self._period = np.array([f.poll_period_s for f in feedback])
        self._loss = np.array([f.loss for f in feedback])
        self._quantum = np.array([f.quantum_rad for f in feedback])
        self._offset = np.array([f.offset_rad for f in feedback])
        self._step, self.rng = physics_step_s, rng
        shape = (environments, len(feedback))
        self._lattice = np.ones(shape)  # period of each robot's rounds
        self._next = np.zeros(shape)  # time until the next poll
        self.position, self.load = np.zeros(shape), np.zeros(shape)
        self.age_s = np.zeros(shape)

    @property
    def state(self) -> dict[str, NDArray[np.float64]]:
        """Everything that changes, for an exact copy."""
        return {
            "lattice": self._lattice, "next": self._next, "position": self.position,
            "load": self.load, "age_s": self.age_s,
        }  # fmt: skip

    def reset(self, ids: NDArray[np.intp], position: NDArray[np.float64]) -> None:
        """Start robots `ids` at rest at `position` [rad], shape (len(ids), servos)."""
        servos = len(self._period)
        wander = 1.0 + _DRIFT * self.rng.standard_normal((len(ids), 1))
        self._lattice[ids] = self._period * wander
        first = self.rng.random((len(ids), 1)) + np.arange(servos) / servos
        self._next[ids] = self._lattice[ids] * (first % 1.0)
        self.position[ids] = self._reported(position)
        self.load[ids] = 0.0
        self.age_s[ids] = self._lattice[ids] - self._next[ids]

    def advance(self, position: NDArray[np.float64], load: NDArray[np.float64]) -> None:
        """Let one control step pass.

        Parameters
        ----------
        position, load : ndarray, shape (environments, physics steps + 1, servos)
            Angle [rad] and torque [N·m] at the start and after each physics step.
        """
        steps = position.shape[1] - 1
        span = steps * self._step
        direct = self._period <= 0
        if direct.any():
            self.position[:, direct] = self._reported(position[:, -1])[:, direct]
            self.load[:, direct], self.age_s[:, direct] = load[:, -1][:, direct], 0.0
        polled = ~direct
        self.age_s[:, polled] += span
        while True:
            due = polled & (self._next <= span)
            if not due.any():
                break
            row, servo = np.nonzero(due)
            # for all servos, due or not, so that twins (`shared_draws`) have the same numbers
            chance = self.rng.random((len(due), 2, due.shape[1]))[row, :, servo].T
            succeeded = chance[0] >= self._loss[servo]
            at = self._next[row, servo]
            # a uniform jitter of the same variance stays within bounds
            jittered = np.clip(at + _JITTER_S * np.sqrt(12) * (chance[1] - 0.5), 0.0, span)
            row_, servo_, jittered = row[succeeded], servo[succeeded], jittered[succeeded]
            place = jittered / self._step
            before = np.minimum(place.astype(int), steps - 1)
            share = place - before
            angle = (1 - share) * position[row_, before, servo_]
            angle += share * position[row_, before + 1, servo_]
            self.position[row_, servo_] = self._reported(angle, servo_)
            self.load[row_, servo_] = load[row_, before + 1, servo_]
            self.age_s[row_, servo_] = span - jittered
            self._next[row, servo] = at + self._lattice[row, servo]
        self._next[:, polled] -= span

    def _reported(
        self, angle: NDArray[np.float64], servo: NDArray[np.intp] | slice = slice(None)
    ) -> NDArray[np.float64]:
        """`angle` as the encoder reports it: with its offset, in whole quantisation steps."""
        quantum = self._quantum[servo]
        shifted = angle + self._offset[servo]
        whole = np.round(shifted / np.where(quantum > 0, quantum, 1.0)) * quantum
        return np.where(quantum > 0, whole, shifted)
