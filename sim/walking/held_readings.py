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
    linked : sequence of int
        Servos that turn their joint and the one before it, so that they read the sum of both.
    shortest_period : float
        Least factor on a robot's periods that `reset` is given.

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
        linked: Sequence[int] = (),
        shortest_period: float = 1.0,
    ):
        self._shortest = shortest_period
        self._period = np.array([f.poll_period_s for f in feedback])
        self._loss = np.array([f.loss for f in feedback])
        quantum = np.array([f.quantum_rad for f in feedback])
        # readings without quantisation step are left as they are
        self._quantum, self._exact = np.where(quantum > 0, quantum, 1.0), quantum <= 0
        self._offset = np.array([f.offset_rad for f in feedback])
        self._step, self.rng, self._linked = physics_step_s, rng, np.array(linked, int)
        self._direct = self._period <= 0
        self._servos = np.arange(len(feedback))
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

    def reset(
        self,
        ids: NDArray[np.intp],
        position: NDArray[np.float64],
        period: NDArray[np.float64] | float = 1.0,
    ) -> None:
        """Start robots `ids` at rest.

        Parameters
        ----------
        ids : ndarray of int
        position : ndarray, shape (len(ids), servos)
            Servo angles at which they rest [rad].
        period : ndarray, shape (len(ids),), or float
            Factor on the periods of their polls.
        """
        servos = len(self._period)
        wander = 1.0 + _DRIFT * self.rng.standard_normal((len(ids), 1))
        wander *= np.broadcast_to(period, len(ids))[:, None]
        self._lattice[ids] = self._period * wander
        first = self.rng.random((len(ids), 1)) + np.arange(servos) / servos
        self._next[ids] = self._lattice[ids] * (first % 1.0)
        self.position[ids] = self._reported(position)
        self.load[ids] = 0.0
        self.age_s[ids] = self._lattice[ids] - self._next[ids]

    def chances(self, steps: int) -> NDArray[np.float64]:
        """Draw what decides losses and jitters of a control step of so many physics steps.

        Shape (environments, rounds, 2, servos): for all robots at once and for all servos, due or
        not, so that neither the order in which robots are advanced nor their number at a time
        changes their readings, and twins (`shared_draws`) have the same.
        """
        rounds = 0
        if not self._direct.all():
            shortest = self._period[~self._direct].min() * (1 - 6 * _DRIFT) * self._shortest
            rounds = int(steps * self._step / shortest) + 1
        return self.rng.random((len(self.position), rounds, 2, len(self._period)))

    def advance(
        self,
        start: NDArray[np.float64],
        position: NDArray[np.float64],
        load: NDArray[np.float64],
        chances: NDArray[np.float64],
        rows: slice = slice(None),
    ) -> None:
        """Let one control step pass for the robots `rows`, n of them.

        Parameters
        ----------
        start : ndarray, shape (n, servos)
            Joint angles [rad] before.
        position : ndarray, shape (n, physics steps, servos or more)
            After each physics step; the last columns are the joint angles. C-contiguous, as `load`.
        load : ndarray, shape (n, physics steps, servos)
            Servo torque [N·m] in each physics step.
        chances : ndarray, shape (environments, rounds, 2, servos)
            See `chances`.
        rows : slice
        """
        count, steps, width = position.shape
        span, servos = steps * self._step, len(self._period)
        held, torque, age = self.position[rows], self.load[rows], self.age_s[rows]
        next_, lattice, direct = self._next[rows], self._lattice[rows], self._direct
        age += span
        if direct.any():
            now = position[:, -1, width - servos :].copy()
            now[:, self._linked] += now[:, self._linked - 1]
            held[:, direct] = self._reported(now)[:, direct]
            torque[:, direct], age[:, direct] = load[:, -1][:, direct], 0.0
        # places in the flat arrays, of each robot's and servo's first value
        first = np.arange(count)[:, None] * steps
        at, at_load = first * width + (width - servos + self._servos), first * servos + self._servos
        flat, flat_load = position.reshape(-1), load.reshape(-1)
        for lost, shifted in chances[rows].transpose(1, 2, 0, 3):
            due = next_ <= span
            due &= ~direct
            # a uniform jitter of the same variance stays within bounds
            instant = np.clip(next_ + _JITTER_S * np.sqrt(12) * (shifted - 0.5), 0.0, span)
            place = instant / self._step
            before = np.minimum(place.astype(np.intp), steps - 1)
            share = place - before
            angle = _between(flat, at + before * width, width, start, before, share)
            own = self._linked
            if len(own):
                angle[:, own] += _between(
                    flat, at[:, own - 1] + before[:, own] * width, width, start[:, own - 1],
                    before[:, own], share[:, own],
                )  # fmt: skip
            read = due & (lost >= self._loss)
            np.copyto(held, self._reported(angle), where=read)
            np.copyto(torque, flat_load.take(at_load + before * servos), where=read)
            np.copyto(age, span - instant, where=read)
            np.add(next_, lattice, out=next_, where=due)
        next_ -= span

    def _reported(self, angle: NDArray[np.float64]) -> NDArray[np.float64]:
        """`angle` as the encoder reports it: with its offset, in whole quantisation steps."""
        shifted = angle + self._offset
        whole = np.rint(shifted / self._quantum) * self._quantum
        return np.where(self._exact, shifted, whole) if self._exact.any() else whole


def _between(
    flat: NDArray[np.float64],
    at: NDArray[np.intp],
    width: int,
    start: NDArray[np.float64],
    before: NDArray[np.intp],
    share: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Values a `share` of a step after step `before`, which end at `at`; `start` is before all."""
    ends = flat.take(at)
    begins = np.where(before > 0, flat.take(at - width, mode="clip"), start)
    return begins + share * (ends - begins)
