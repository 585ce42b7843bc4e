"""RecurrentNetwork: servo position from all past commands, by a linear filter and an LSTM.

As `CommandNetwork`, but the linear filter is corrected by the mean output of several long
short-term memory networks (Hochreiter and Schmidhuber 1997, with forget gates):

    i, f, o = sigmoid(…), g = tanh(…) of  input · weight_input + hidden · weight_hidden + bias
    cell = f * cell + i * g,   hidden = o * tanh(cell)
    position = centre + spread * (fir · x + fir_bias + mean(bound * tanh(hidden · out / bound)))

Its memory starts empty and is filled by `warm_up` steps at the position of rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.servo_models.command_network import Parameters, bounded
from pupper_sysid.servo_models.joint_arrays import JointArrays


class RecurrentNetwork(JointArrays):
    """FIR filter and bounded LSTM, per joint. See the module's text.

    Parameters
    ----------
    joints : sequence of str
    time_step_s : float
    parameters : mapping of str to ndarray
        Those of `JointArrays` and, with members m, inputs n and hidden units h:
        `weight_input` (joints, m, n, 4 h), `weight_hidden` (joints, m, h, 4 h), `bias`
        (joints, m, 4 h) for the gates i, f, g, o; `weight_out` (joints, m, h), `bias_out`
        (joints, m).
    feedback : bool
        Whether the network's last input is the position predicted last.
    warm_up : int
        Steps at rest that fill the memory after a reset.

    Raises
    ------
    InputError
        If shapes do not fit each other, or a number is not finite.
    """

    def __init__(
        self,
        joints: Sequence[str],
        time_step_s: float,
        parameters: Parameters,
        feedback: bool = False,
        warm_up: int = 16,
    ):
        self.warm_up = warm_up
        super().__init__(joints, time_step_s, parameters, feedback)

    def _prepare(self) -> None:
        _, members, hidden, gates = self._shape("weight_hidden", 4)
        self._need("weight_hidden", (members, gates // 4, gates))
        self._need("weight_input", (members, 1 + self.feedback, gates))
        self._need("bias", (members, gates))
        self._need("weight_out", (members, hidden))
        self._need("bias_out", (members,))
        self._memory = (members, hidden)

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position` [rad], shape (*environments, joints); it sets how many there are."""
        here = self._enter(position)
        members, hidden = self._memory
        shape = (len(self.joints), members, here.shape[1], hidden)
        self._hidden, self._cell = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        rest = self._normal_command(here)
        self._history = np.repeat(rest[..., None], self.taps, axis=-1)
        at_rest = self._normal_position(here)
        for _ in range(self.warm_up):
            self._last = at_rest
            self._advance(rest)
        self._last = at_rest

    def step(self, command: ArrayLike) -> NDArray[np.float32]:
        """Advance one time step under `command` [rad]; returns the position after it [rad]."""
        self._advance(self._normal_command(self._arrange(command)))
        return self._leave(self._last)

    def rollout(self, commands: ArrayLike) -> NDArray[np.float32]:
        """Positions [rad] after each command, shape (steps, *environments, joints)."""
        return np.stack([self.step(command) for command in np.asarray(commands, np.float32)])

    @property
    def memory(self) -> dict[str, NDArray[np.float32]]:
        """See `JointArrays`: states of the cells, newest commands and last position."""
        return {
            "hidden": self._hidden, "cell": self._cell,
            "history": np.moveaxis(self._history, -1, 1), "last": self._last,
        }  # fmt: skip

    def _advance(self, newest: NDArray) -> None:
        """One step of all memories; leaves the normalised position in `_last`."""
        p = self.parameters
        self._history[..., 1:] = self._history[..., :-1]
        self._history[..., 0] = newest
        seen = newest[..., None]
        if self.feedback:
            seen = np.concatenate([seen, self._last[..., None]], axis=-1)
        gates = np.matmul(seen[:, None], p["weight_input"])
        gates += np.matmul(self._hidden, p["weight_hidden"])
        gates += p["bias"][:, :, None]
        i, f, g, o = np.split(gates, 4, axis=-1)
        self._cell = _sigmoid(f) * self._cell + _sigmoid(i) * np.tanh(g)
        self._hidden = _sigmoid(o) * np.tanh(self._cell)
        out = np.einsum("jmeh,jmh->jme", self._hidden, p["weight_out"]) + p["bias_out"][..., None]
        linear = np.matmul(self._history, p["fir"][..., None])[..., 0] + p["fir_bias"][:, None]
        self._last = linear + bounded(out, p["bound"][:, None, None]).mean(axis=1)


def _sigmoid(x: NDArray) -> NDArray:
    return 0.5 + 0.5 * np.tanh(0.5 * x)  # no overflow, whatever the sign
