"""Interface of servo models: predict servo position from commanded position.

`DelayedPD` and `SparseEquation` step every 2 ms or so; learned models step once per command of a
controller, every 20 or 40 ms. `AtControlRate` gives both the same interface.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S


class ServoModel(Protocol):
    """One servo or a batch of servos with a fixed time step: commands in, positions out.

    All arrays share one trailing shape, the model's batch (joints, environments, trials,
    parameter candidates, or any combination that broadcasts). Angles are radians.
    """

    time_step_s: float

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position`, which has been the command for ever."""
        ...

    def step(self, command: ArrayLike) -> NDArray[np.floating]:
        """Advance one time step under `command`; returns the position after it."""
        ...

    def rollout(self, commands: ArrayLike) -> NDArray[np.floating]:
        """Positions after each of `commands`, shape (steps, *batch), from the present state."""
        ...


def substeps(time_step_s: float) -> int:
    """Physics steps of at most `TIME_STEP_S` that fill one step of `time_step_s` [s]."""
    return max(1, int(np.ceil(time_step_s / TIME_STEP_S - 1e-9)))


class AtControlRate:
    """`model`, stepped `count` times per command, each command held for all of them.

    `offset_rad`, the bias of the readings, is added to its positions.
    """

    def __init__(self, model: ServoModel, count: int, offset_rad: ArrayLike = 0.0):
        if count < 1:
            raise InputError(f"AtControlRate: {count} steps per command; it must be at least 1.")
        self.model, self.count = model, count
        self.offset_rad = np.asarray(offset_rad, float)
        self.time_step_s = model.time_step_s * count

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position`, as `model` does."""
        self.model.reset(position)

    def step(self, command: ArrayLike) -> NDArray[np.floating]:
        """Advance one command; returns the position at its end [rad]."""
        return self.rollout(np.asarray(command, float)[None])[0]

    def rollout(self, commands: ArrayLike) -> NDArray[np.floating]:
        """Positions [rad] at the end of each command."""
        return self.every_step(commands)[self.count - 1 :: self.count]

    def every_step(self, commands: ArrayLike) -> NDArray[np.floating]:
        """Positions [rad] after each step of the model, `count` of them per command."""
        held = np.repeat(np.asarray(commands, float), self.count, axis=0)
        return self.model.rollout(held) + self.offset_rad
