"""CommandNetwork: where a servo will be, from the last commands it was given.

One model per joint, all joints computed at once. With `x` the last commands, newest first, each
less its mean and over its spread in training,

    position = centre + spread * (fir · x + fir_bias + bound * tanh(network(x) / bound))

The first part is a linear filter (finite impulse response, FIR): the honest baseline, and all there
is of a model without a network. The second, a feed-forward network with ReLU, corrects it by no
more than `bound`: far from what it was trained on the model falls back to the linear one instead of
inventing. No reading is needed, so a stale or dead encoder cannot mislead it.

A network may also be shown the position it predicted last (`feedback`), as the published servo
models were; then errors can build up over time, and `bound` is infinite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from common.errors import InputError
from servo_models.joint_arrays import JointArrays

Parameters = Mapping[str, NDArray[np.floating]]


class CommandNetwork(JointArrays):
    """FIR filter and bounded network, per joint. See the module's text.

    Parameters
    ----------
    joints : sequence of str
        Their order is that of the last axis of commands and positions.
    time_step_s : float
        Time between commands [s].
    parameters : mapping of str to ndarray
        `command_center`, `command_scale`, `position_center`, `position_scale`, `bound`,
        `fir_bias`, each (joints,); `fir` (joints, taps), newest command first; and, with a network,
        `weight_0` (joints, inputs, units), `bias_0` (joints, units), `weight_1`, … to one output.
    feedback : bool
        Whether the network's last input is the position predicted last.

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
    ):
        super().__init__(joints, time_step_s, parameters)
        self.feedback = feedback
        self.taps = self._shape("fir", 2)[1]
        self._depth = sum(name.startswith("weight_") for name in parameters)
        width = self.taps + feedback
        for layer in range(self._depth):
            units = self._shape(f"weight_{layer}", 3)[2]
            self._need(f"weight_{layer}", (width, units))
            self._need(f"bias_{layer}", (units,))
            width = units
        if (self._depth and width != 1) or (feedback and not self._depth):
            raise InputError(f"A servo network must end in one output; this one has {width}.")
        self._need("fir_bias", ())
        self._need("bound", ())
        self._transposed = [
            np.ascontiguousarray(np.swapaxes(self.parameters[f"weight_{n}"], 1, 2))
            for n in range(self._depth)
        ]
        self.reset(np.zeros(len(self.joints)))

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position` [rad], shape (*environments, joints); it sets how many there are."""
        here = self._enter(position)
        self._history = np.repeat(self._normal_command(here)[:, None], self.taps, axis=1)
        self._last = self._normal_position(here)

    def step(self, command: ArrayLike) -> NDArray[np.float32]:
        """Advance one time step under `command` [rad]; returns the position after it [rad]."""
        newest = self._normal_command(self._arrange(command))
        self._history[:, 1:] = self._history[:, :-1]
        self._history[:, 0] = newest
        self._last = self._forward(self._history, self._last)
        return self._leave(self._last)

    def rollout(self, commands: ArrayLike) -> NDArray[np.float32]:
        """Positions [rad] after each command, shape (steps, *environments, joints)."""
        commands = np.asarray(commands, np.float32)
        if self.feedback:
            return np.stack([self.step(c) for c in commands])
        given = np.stack([self._normal_command(self._arrange(c)) for c in commands], axis=1)
        # newest first in the history, oldest first in time: one axis that can be windowed
        time = np.concatenate([self._history[:, ::-1], given], axis=1)
        windows = np.lib.stride_tricks.sliding_window_view(time, self.taps, axis=1)[:, 1:, :, ::-1]
        joints, steps, environments, taps = windows.shape
        x = np.moveaxis(windows, -1, 1).reshape(joints, taps, steps * environments)
        out = self._forward(x, self._last).reshape(joints, steps, environments)
        self._history = np.ascontiguousarray(time[:, : -self.taps - 1 : -1])
        self._last = out[:, -1]
        return self._leave_all(np.moveaxis(out, 1, 2))

    def one_step(
        self, commands: NDArray[np.floating], position: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Positions after each command when the last position is measured instead of predicted.

        Parameters
        ----------
        commands : ndarray, shape (steps, joints)
        position : ndarray, shape (steps, joints)
            Measured when each command was given [rad].

        Returns
        -------
        ndarray, shape (steps, joints)
        """
        out = []
        for command, here in zip(commands, position, strict=True):
            self._last = self._normal_position(self._arrange(here))
            out.append(self.step(command))
        return np.stack(out)

    def _forward(self, x: NDArray, last: NDArray) -> NDArray[np.float32]:
        """Normalised positions (joints, n) from normalised commands (joints, taps, n)."""
        p = self.parameters
        out = np.matmul(p["fir"][:, None], x)[:, 0] + p["fir_bias"][:, None]
        if not self._depth:
            return out
        # joint by joint, so that a layer of many environments stays in the processor's cache
        for j in range(len(self.joints)):
            h = np.concatenate([x[j], last[j, None]]) if self.feedback else x[j]
            for layer in range(self._depth):
                h = self._transposed[layer][j] @ h
                h += p[f"bias_{layer}"][j, :, None]
                if layer < self._depth - 1:
                    np.maximum(h, 0.0, out=h)
            out[j] += bounded(h[0], p["bound"][j])
        return out


def bounded(value: NDArray, bound: NDArray) -> NDArray:
    """`bound * tanh(value / bound)`; the value itself where the bound is infinite."""
    if np.isinf(bound).all():
        return value
    return bound * np.tanh(value / bound)
