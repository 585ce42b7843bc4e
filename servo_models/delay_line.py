"""A delay line: commands reach the servo later than they were given, by any fraction of a step.

Every servo model here meets its commands late. `DelayLine` holds what has been commanded but has
not arrived yet, so that a model can be run piece by piece; `fractional_shift` is its arithmetic,
which fitting calls on whole trials. Between time steps the command is interpolated linearly, as
MuJoCo's `<pid delay nsample interp="linear">` does: for a command that changes on time steps this
is the mean of the held command over the step, a continuous function of the delay.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
    # one row more than asked for: each row's successor is the other end of its interpolation
    row = np.arange(len(history) - steps - 1, len(history))[:, None]
    taken = np.take(history.reshape(-1), row * series + (column - whole * series))
    out = np.subtract(taken[:-1], taken[1:])
    out *= delay_steps - whole
    out += taken[1:]
    return out
