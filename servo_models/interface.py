"""Interface of servo models: predict servo position from commanded position."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


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
