"""Dead time of servo models: a line of commands, late by any fraction of a time step.

`DelayedServo` is the base of the models that integrate an equation of motion; `DelayLine` holds the
commands that have been given and have not arrived yet; `fractional_shift` is its arithmetic, which
fitting calls on whole trials. Between time steps the command is interpolated linearly, as MuJoCo's
`<pid delay nsample interp="linear">` does: for a command that changes on time steps this is the
mean of the held command over the step, a continuous function of the delay.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError


class DelayedServo(ABC):
    """A `ServoModel` that integrates an equation of motion under delayed commands.

    Parameters
    ----------
    values : iterable of ndarray
        All its numbers; their broadcast shape is the batch until `reset` widens it.
    dead_time_s : ndarray
        From a command's arrival to its first effect [s].
    time_step_s : float
        Time step [s]; commands and positions are at this step.

    Raises
    ------
    InputError
        If the time step is not positive.
    """

    def __init__(
        self, values: Iterable[NDArray], dead_time_s: NDArray[np.float64], time_step_s: float
    ):
        refuse_time_step(type(self).__name__, time_step_s)
        self.time_step_s = float(time_step_s)
        self._own = np.broadcast_shapes(*(v.shape for v in values))
        self._delay_line = DelayLine(dead_time_s, self.time_step_s)
        self.reset(np.zeros(self._own))

    def __repr__(self) -> str:
        of = f" of {self._own} servos" if self._own else ""
        return f"{type(self).__name__}{of}, a step every {1e3 * self.time_step_s:g} ms"

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position` [rad], which has been the command for as long as the dead time.

        The batch becomes the shape to which `position` and the parameters broadcast.
        """
        position = np.asarray(position, float)
        self.batch = np.broadcast_shapes(position.shape, self._own)
        position = np.broadcast_to(position, self.batch)
        self._rest(position)
        self._delay_line.reset(position)

    def step(self, command: ArrayLike) -> NDArray[np.float64]:
        """Advance one time step under `command` [rad]; returns the position after it."""
        return self.rollout(np.broadcast_to(np.asarray(command, float), self.batch)[None])[0]

    def rollout(self, commands: ArrayLike) -> NDArray[np.float64]:
        """Positions [rad] after each command, shape (steps, *batch); continues from the state."""
        commands = np.asarray(commands, float)
        if commands.ndim == 1:  # one series for the whole batch
            commands = commands.reshape(-1, *[1] * len(self.batch))
        commands = np.broadcast_to(commands, (len(commands), *self.batch))
        return self._integrate(self._delay_line.shift(commands))

    @abstractmethod
    def _rest(self, position: NDArray[np.float64]) -> None:
        """Set the state to rest at `position`, of shape `batch`."""

    @abstractmethod
    def _integrate(self, delayed: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions after each delayed command; advances the state."""


def refuse_time_step(model: str, time_step_s: float) -> None:
    """Refuse a time step [s] that is not a positive number.

    Raises
    ------
    InputError
    """
    if not (np.isfinite(time_step_s) and time_step_s > 0):
        raise InputError(f"{model}: time_step_s is {time_step_s}; it must be positive.")


class DelayLine:
    """Commands on their way to the servos of a batch; starts when `reset` is called.

    Parameters
    ----------
    delay_s : ndarray
        Not negative, and finite [s].
    time_step_s : float
        Time between commands [s].

    Examples
    --------
    >>> line = DelayLine(np.array(0.003), 0.002)
    >>> line.reset(np.array(0.0))
    >>> line.shift(np.array([1.0, 1.0, 1.0])).tolist()
    [0.0, 0.5, 1.0]
    """

    def __init__(self, delay_s: NDArray[np.float64], time_step_s: float):
        self._delay_steps = delay_s / time_step_s
        self._rows = int(np.floor(np.max(delay_s) / time_step_s)) + 2

    def reset(self, command: NDArray[np.float64]) -> None:
        """Forget the past: `command` [rad] was given for as long as the delay.

        Its shape, to which the delay must broadcast, becomes the batch.
        """
        self._past = np.broadcast_to(command, (self._rows, *command.shape)).copy()

    def shift(self, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """What arrives while `commands` are given, both of shape (steps, *batch) [rad]."""
        history = np.concatenate([self._past, commands])
        self._past = history[len(history) - self._rows :].copy()
        delay = np.broadcast_to(self._delay_steps, commands.shape[1:]).reshape(-1)
        arrived = fractional_shift(history.reshape(len(history), -1), len(commands), delay)
        return arrived.reshape(commands.shape)


def fractional_shift(
    history: NDArray, steps: int, delay_steps: NDArray, column: NDArray | None = None
) -> NDArray[np.float64]:
    """Last `steps` rows of `history` as they arrive after fractional delays.

    Parameters
    ----------
    history : ndarray, shape (rows, series)
        Rows before the last `steps` are the past; there must be at least `max(delay_steps) + 1`.
    steps : int
    delay_steps : ndarray, shape (n,)
    column : ndarray of int, shape (n,), optional
        Which series each delay applies to; by default one each, in order.

    Returns
    -------
    ndarray, shape (steps, n)
    """
    series = history.shape[1]
    column = np.arange(series) if column is None else column
    whole = np.floor(delay_steps).astype(int)
    # one row more than requested: each row's successor is the other end of its interpolation
    row = np.arange(len(history) - steps - 1, len(history))[:, None]
    taken = np.take(history.reshape(-1), row * series + (column - whole * series))
    out = np.subtract(taken[:-1], taken[1:])
    out *= delay_steps - whole
    out += taken[1:]
    return out
