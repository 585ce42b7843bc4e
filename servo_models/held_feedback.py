"""HeldFeedback: readings of a polled servo bus are stale, quantised and biased.

The bus polls each servo once per `poll_period_s`. A poll fails with probability `loss` and then
leaves the previous value in place, which the host reads. So a reading is the position at the last
successful poll, plus `offset_rad`, rounded to `quantum_rad`; its age is between zero and many
periods, on average `mean_age_s = poll_period_s * (1/2 + loss / (1 - loss))`.

    feedback = HeldFeedback(poll_period_s=0.0268, loss=0.42, quantum_rad=0.0057)
    feedback.reset(position, time_step_s=0.005, rng=np.random.default_rng(0))
    reading = feedback.step(position)               # after every time step

This is the definition, and its simulation in NumPy. Three more modules simulate it; they stay apart
because each has a random stream of its own, which recordings, checkpoints and exports repeat bit
for bit, and needs other parts: `sim.emulator.bench` gives the poll instants of one robot at
any time, with jitter and drift (the emulated buses measure there); `sim.walking.senses`
gives readings of many robots, a control step at a time; `sim.export.torch_servos` is copied into
exports and needs only torch (`tests/sim` holds each to the mean age above).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError


@dataclass(frozen=True)
class HeldFeedback:
    """Feedback of one joint, of any number of robots.

    Parameters
    ----------
    poll_period_s : float
        Time between polls [s]; 0 if every reading is fresh.
    loss : float
        Probability that a poll fails silently, 0 <= loss < 1.
    quantum_rad : float
        Quantisation step [rad]; 0 if readings are continuous.
    offset_rad : float
        Reading minus position, constant [rad].
    """

    poll_period_s: float = 0.0
    loss: float = 0.0
    quantum_rad: float = 0.0
    offset_rad: float = 0.0
    _state: ClassVar[dict[str, Any]]

    def __post_init__(self):
        # the simulation's state, no part of the value
        object.__setattr__(self, "_state", {})
        if not self.poll_period_s >= 0 or not np.isfinite(self.poll_period_s):
            raise InputError(
                f"HeldFeedback: poll_period_s is {self.poll_period_s}; it must be ≥ 0."
            )
        if not 0 <= self.loss < 1:
            raise InputError(f"HeldFeedback: loss is {self.loss}; it must be in [0, 1).")
        if not self.quantum_rad >= 0:
            raise InputError(f"HeldFeedback: quantum_rad is {self.quantum_rad}; it must be ≥ 0.")

    @property
    def mean_age_s(self) -> float:
        """Mean age of a reading at a random instant [s]."""
        return self.poll_period_s * (0.5 + self.loss / (1.0 - self.loss))

    def reset(
        self,
        position: ArrayLike,
        time_step_s: float,
        rng: np.random.Generator | None = None,
        until_poll_s: ArrayLike | None = None,
    ) -> None:
        """Begin at rest at `position` [rad], of any shape.

        Parameters
        ----------
        position : array_like
        time_step_s : float
            Time between two calls of `step` [s].
        rng : numpy.random.Generator, optional
            Draws the phases and lost polls; by default one without a seed.
        until_poll_s : array_like, optional
            Time until the first poll [s]; by default drawn.
        """
        if not (np.isfinite(time_step_s) and time_step_s > 0):
            raise InputError(f"HeldFeedback: time_step_s is {time_step_s}; it must be positive.")
        rng = rng or np.random.default_rng()
        before = np.array(position, float)
        drawn = self.poll_period_s * rng.random(before.shape)
        until = np.broadcast_to(drawn if until_poll_s is None else until_poll_s, before.shape)
        self._state.update(
            step=float(time_step_s), rng=rng, before=before, until=np.array(until, float),
            age=self.poll_period_s - until, reading=self._reported(before),
        )  # fmt: skip

    def step(self, position: ArrayLike) -> NDArray[np.float64]:
        """Readings [rad] after one time step that ended at `position` [rad], of the same shape.

        A poll falls anywhere in a step and reads the position of that instant.

        Examples
        --------
        >>> feedback = HeldFeedback(poll_period_s=0.01)
        >>> feedback.reset(0.0, time_step_s=0.004, until_poll_s=0.002)
        >>> [round(float(feedback.step(x)), 4) for x in (0.4, 0.8, 1.2)]
        [0.2, 0.2, 1.2]
        """
        state, now = self._state, np.asarray(position, float)
        if not state or state["before"].shape != now.shape:
            raise InputError(
                f"HeldFeedback: a step to positions of shape {now.shape} needs `reset` with "
                "positions of that shape first."
            )
        state["until"] = state["until"] - state["step"]
        state["age"] = state["age"] + state["step"]
        change = (now - state["before"]) / state["step"]
        while self.poll_period_s > 0 and (due := state["until"] <= 1e-12).any():
            fresh = due & (state["rng"].random(now.shape) >= self.loss)
            ago = np.maximum(-state["until"], 0.0)
            state["reading"] = np.where(fresh, self._reported(now - change * ago), state["reading"])
            state["age"] = np.where(fresh, ago, state["age"])
            state["until"] = np.where(due, state["until"] + self.poll_period_s, state["until"])
        if self.poll_period_s == 0:
            state["reading"], state["age"] = self._reported(now), np.zeros(now.shape)
        state["before"] = now.copy()
        return state["reading"].copy()

    @property
    def age_s(self) -> NDArray[np.float64]:
        """Ages of the readings after the last step [s]."""
        if not self._state:
            raise InputError("HeldFeedback: call `reset` first.")
        return self._state["age"].copy()

    def _reported(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        value = position + self.offset_rad
        if self.quantum_rad == 0:
            return value
        return np.round(value / self.quantum_rad) * self.quantum_rad
