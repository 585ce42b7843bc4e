"""What every servo model can do: say where a servo will be, given what it was told."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class ServoModel(Protocol):
    """A servo, or many: positions out, commands in, one fixed time step.

    All arrays share one trailing shape, the model's batch (joints, environments, trials,
    parameter candidates, or any combination that broadcasts). Angles are radians.
    """

    time_step_s: float

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position`, with that position as the only command ever given."""
        ...

    def step(self, command: ArrayLike) -> NDArray[np.floating]:
        """Advance one time step under `command`; returns the position after it."""
        ...

    def rollout(self, commands: ArrayLike) -> NDArray[np.floating]:
        """Positions after each of `commands`, shape (steps, *batch), from the present state."""
        ...
