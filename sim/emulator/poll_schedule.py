"""Poll instants of an emulated bus, and which polls fail (`servo_models.held_feedback`).

The servo task of the robot's firmware polls one servo after the other: servo `i` of `n` a share
`i / n` of a round after the first. The length of a round wanders slowly, each poll has its own
small jitter, and each fails with the same probability, silently.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_CHUNK = 256
_DRIFT_MEMORY_S = 5.0  # recordings of 3 s see different mean periods, so it wanders over seconds
_WARM_UP_ROUNDS = 64


class PollSchedule:
    """Poll instants of all servos, drawn as time goes on.

    Parameters
    ----------
    period_s : float
        Mean length of a round [s], positive.
    phase_s : ndarray, shape (servos,)
        A poll instant of each servo on the lattice at time 0 [s].
    loss : float
        Probability that a poll fails.
    jitter_s : float
        Standard deviation of a single poll instant [s].
    drift : float
        Relative standard deviation of the round's length as it wanders.
    rng : numpy.random.Generator
    """

    def __init__(
        self,
        period_s: float,
        phase_s: NDArray[np.float64],
        loss: float,
        jitter_s: float,
        drift: float,
        rng: np.random.Generator,
    ):
        self._period, self._phase = period_s, np.asarray(phase_s, float)
        self._loss, self._jitter, self._drift, self._rng = loss, jitter_s, drift, rng
        servos = len(self._phase)
        self._servo = np.arange(servos)
        self._round = np.zeros(servos, int)
        self._next_start = -_WARM_UP_ROUNDS * period_s  # readings exist when the host arrives
        self._wander = drift * rng.standard_normal()
        self._instants = np.empty((0, servos))
        self._succeeded = np.empty((0, servos), bool)
        self.latest_s = np.full(servos, -np.inf)
        """Last successful poll of each servo [s]; -inf before the first."""

    def advance(self, time_s: float) -> NDArray[np.float64]:
        """Last successful poll of each servo up to `time_s` [s]; time must not go backwards."""
        while True:
            if self._round.max() >= len(self._instants):
                self._draw()
            instants = self._instants[self._round, self._servo]
            due = instants <= time_s
            if not due.any():
                return self.latest_s
            success = due & self._succeeded[self._round, self._servo]
            self.latest_s = np.where(success, instants, self.latest_s)
            self._round += due

    def _draw(self) -> None:
        """Append a chunk of rounds, and drop those that lie behind every servo."""
        memory = np.exp(-self._period / _DRIFT_MEMORY_S)
        kicks = self._drift * np.sqrt(1 - memory**2) * self._rng.standard_normal(_CHUNK)
        starts = np.empty(_CHUNK)
        for i, kick in enumerate(kicks):
            starts[i] = self._next_start
            self._next_start += self._period * (1 + self._wander)
            self._wander = memory * self._wander + kick
        shape = (_CHUNK, len(self._servo))
        # half a round is far beyond any jitter meant here, and keeps the polls in order
        bound = 0.49 * self._period
        jitter = np.clip(self._jitter * self._rng.standard_normal(shape), -bound, bound)
        done = int(self._round.min())
        instants = starts[:, None] + self._phase + jitter
        self._instants = np.concatenate([self._instants[done:], instants])
        succeeded = self._rng.random(shape) >= self._loss
        self._succeeded = np.concatenate([self._succeeded[done:], succeeded])
        self._round -= done
