"""Networks that predict servo position from commands: feed-forward and LSTM, one per joint.

One model per joint, all joints computed at once. With `x` the last commands, newest first, each
normalised by its mean and spread in training, a `CommandNetwork` is

    position = centre + spread * (fir · x + fir_bias + bound * tanh(network(x) / bound))

The first part is a linear filter (finite impulse response, FIR), the baseline; a model may have no
other. The second, a feed-forward network with ReLU, corrects it by no more than `bound`, so that
far from its training data the model is nearly linear. No reading is needed: stale feedback has no
influence. With `feedback` the network's last input is the position it predicted last, as in the
published servo models; then errors can build up over time, and `bound` is infinite.

In a `RecurrentNetwork` the linear filter is corrected by the mean output of several long
short-term memory networks (Hochreiter and Schmidhuber 1997, with forget gates):

    i, f, o = sigmoid(…), g = tanh(…) of  input · weight_input + hidden · weight_hidden + bias
    cell = f * cell + i * g,   hidden = o * tanh(cell)
    position = centre + spread * (fir · x + fir_bias + mean(bound * tanh(hidden · out / bound)))

Its memory starts empty and is filled by `warm_up` steps at the position of rest.

`JointArrays`, the base of both, has parameters per joint, normalisation and the layout of arrays:
inside they are (joints, environments, …), so that one matrix product per joint serves all
environments; outside (*environments, joints), as everywhere in this project.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import refuse_time_step

_SAME_RATE = 0.02


def same_rate(one_s: float, other_s: float) -> bool:
    """Whether two time steps agree within 2 %: a recorded rate is never quite the nominal one."""
    return abs(one_s / other_s - 1) <= _SAME_RATE


class JointArrays(ABC):
    """A learned `ServoModel`; see the module's text.

    Parameters are arrays with the joints on the first axis: `command_center`, `command_scale`,
    `position_center`, `position_scale`, `bound`, `fir_bias`, each (joints,); `fir` (joints, taps),
    newest command first; and those of the subclass. All but `bound` are finite. With `feedback` the
    network's last input is the position predicted last.
    """

    def __init__(
        self,
        joints: Sequence[str],
        time_step_s: float,
        parameters: Mapping[str, NDArray[np.floating]],
        feedback: bool = False,
    ):
        refuse_time_step("A servo model", time_step_s)
        self.joints = tuple(joints)
        self.time_step_s = float(time_step_s)
        self.parameters = {k: np.ascontiguousarray(v, np.float32) for k, v in parameters.items()}
        for name, value in self.parameters.items():
            if value.ndim == 0 or len(value) != len(self.joints):
                raise InputError(
                    f"A servo model's {name} has shape {value.shape}; its first axis must be the "
                    f"{len(self.joints)} joints."
                )
            if np.isnan(value).any() or (name != "bound" and np.isinf(value).any()):
                raise InputError(
                    f"A servo model's {name} holds NaN or infinite numbers: its training failed "
                    "or the file was damaged. Fit it again."
                )
        scales = ("command_scale", "position_scale", "bound")
        for name in (*scales, "command_center", "position_center", "fir_bias"):
            self._need(name, ())
        for name in scales:
            if not (self.parameters[name] > 0).all():
                raise InputError(f"A servo model's {name} must be positive. Fit it again.")
        self.feedback = feedback
        self.taps = self._shape("fir", 2)[1]
        self._environments: tuple[int, ...] = ()
        self._last = np.zeros((len(self.joints), 1), np.float32)  # normalised position
        self._prepare()
        self.reset(np.zeros(len(self.joints)))

    @abstractmethod
    def _prepare(self) -> None:
        """Check the subclass's parameters, and derive from them what steps need."""

    @abstractmethod
    def step(self, command: ArrayLike) -> NDArray[np.float32]:
        """Advance one time step under `command` [rad]; returns the position after it [rad]."""

    @abstractmethod
    def reset(self, position: ArrayLike) -> None:
        """Rest at `position` [rad], shape (*environments, joints); it sets how many there are."""

    @property
    @abstractmethod
    def memory(self) -> dict[str, NDArray[np.float32]]:
        """State between steps, writable; environments are on axis 2 (axis 1 of `last`)."""

    def reset_some(self, rows: NDArray[np.intp], position: ArrayLike) -> None:
        """Rest at `position` [rad], shape (len(rows), joints), in environments `rows` only."""
        fresh = copy(self)
        fresh.reset(position)
        new = fresh.memory
        for name, value in self.memory.items():
            if name == "last":
                value[:, rows] = new[name]
            else:
                value[:, :, rows] = new[name]

    def one_step(
        self, commands: NDArray[np.floating], position: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Positions after each command, each from the measured position before it (one-step).

        `position` was measured when each command was given [rad]; all have the shape (steps,
        joints).
        """
        out = []
        for command, position_now in zip(commands, position, strict=True):
            self._last = self._normal_position(self._arrange(position_now))
            out.append(self.step(command))
        return np.stack(out)

    def _shape(self, name: str, axes: int) -> tuple[int, ...]:
        if name not in self.parameters or self.parameters[name].ndim != axes:
            raise InputError(f"A servo model needs {name} with {axes} axes. Fit it again.")
        return self.parameters[name].shape

    def _need(self, name: str, shape: tuple[int, ...]) -> None:
        expected = (len(self.joints), *shape)
        if name not in self.parameters or self.parameters[name].shape != expected:
            actual = self.parameters[name].shape if name in self.parameters else "nothing"
            raise InputError(
                f"A servo model needs {name} of shape {expected}; found {actual}. Fit it again."
            )

    def _enter(self, position: ArrayLike) -> NDArray[np.float32]:
        """Take the environments' shape from `position`, and arrange it."""
        shape = np.shape(position)
        if not shape or shape[-1] != len(self.joints):
            raise InputError(
                f"A servo model of {len(self.joints)} joints was given positions of shape {shape}; "
                "the last axis must be the joints."
            )
        self._environments = shape[:-1]
        return self._arrange(position)

    def _arrange(self, value: ArrayLike) -> NDArray[np.float32]:
        """(*environments, joints) to (joints, environments)."""
        full = np.broadcast_to(
            np.asarray(value, np.float32), (*self._environments, len(self.joints))
        )
        return full.reshape(-1, len(self.joints)).T

    def _normal_command(self, command: NDArray) -> NDArray[np.float32]:
        p = self.parameters
        return (command - p["command_center"][:, None]) / p["command_scale"][:, None]

    def _normal_position(self, position: NDArray) -> NDArray[np.float32]:
        p = self.parameters
        return (position - p["position_center"][:, None]) / p["position_scale"][:, None]

    def _leave(self, normal: NDArray) -> NDArray[np.float32]:
        """Normalised (joints, environments) to positions (*environments, joints) [rad]."""
        p = self.parameters
        position = normal * p["position_scale"][:, None] + p["position_center"][:, None]
        return position.T.reshape(*self._environments, len(self.joints))

    def _leave_all(self, normal: NDArray) -> NDArray[np.float32]:
        """Normalised (joints, environments, steps) to (steps, *environments, joints) [rad]."""
        p = self.parameters
        position = normal * p["position_scale"][:, None, None] + p["position_center"][:, None, None]
        return np.moveaxis(position, (0, 2), (2, 0)).reshape(
            normal.shape[-1], *self._environments, len(self.joints)
        )


_FEW = 16
"""Environments up to which all joints are computed in one call, since calls cost the most."""

Parameters = Mapping[str, NDArray[np.floating]]


class CommandNetwork(JointArrays):
    """FIR filter and bounded network, per joint. See the module's text.

    With a network, parameters beyond those of `JointArrays` are `weight_0` (joints, inputs, units),
    `bias_0` (joints, units), `weight_1`, … to one output.
    """

    def _prepare(self) -> None:
        self._depth = sum(name.startswith("weight_") for name in self.parameters)
        width = self.taps + self.feedback
        for layer in range(self._depth):
            units = self._shape(f"weight_{layer}", 3)[2]
            self._need(f"weight_{layer}", (width, units))
            self._need(f"bias_{layer}", (units,))
            width = units
        if (self._depth and width != 1) or (self.feedback and not self._depth):
            raise InputError(f"A servo network must end in one output; this one has {width}.")
        # relu(h + b) = max(h, -b) + b: the one pass over a layer; b moves on to the next bias
        self._layers: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
        activations = np.zeros((len(self.joints), self.taps + self.feedback), np.float32)
        for n in range(self._depth):
            weight = self.parameters[f"weight_{n}"]
            bias = self.parameters[f"bias_{n}"] + np.matmul(activations[:, None], weight)[:, 0]
            self._layers.append((np.ascontiguousarray(np.swapaxes(weight, 1, 2)), -bias[..., None]))
            activations = bias

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position` [rad], shape (*environments, joints); it sets how many there are."""
        initial = self._enter(position)
        # room for as many new commands as are remembered: moving the rest is seldom needed
        self._room = np.empty((len(self.joints), 2 * self.taps, initial.shape[1]), np.float32)
        self._remember(np.repeat(self._normal_command(initial)[:, None], self.taps, axis=1))
        self._last = self._normal_position(initial)
        self._work = [np.empty((len(w[0]), initial.shape[1]), np.float32) for w, _ in self._layers]

    def step(self, command: ArrayLike) -> NDArray[np.float32]:
        """Advance one time step under `command` [rad]; returns the position after it [rad]."""
        if self._newest == 0:
            self._remember(self._history.copy())
        self._newest -= 1
        self._room[:, self._newest] = self._normal_command(self._arrange(command))
        self._last = self._forward(self._history, self._last)
        return self._leave(self._last)

    def rollout(self, commands: ArrayLike) -> NDArray[np.float32]:
        """Positions [rad] after each command, shape (steps, *environments, joints)."""
        commands = np.asarray(commands, np.float32)
        if self.feedback:
            return np.stack([self.step(c) for c in commands])
        inputs = np.stack([self._normal_command(self._arrange(c)) for c in commands], axis=1)
        # newest first in the history, oldest first in time: one axis that can be windowed
        time = np.concatenate([self._history[:, ::-1], inputs], axis=1)
        windows = np.lib.stride_tricks.sliding_window_view(time, self.taps, axis=1)[:, 1:, :, ::-1]
        joints, steps, environments, taps = windows.shape
        x = np.moveaxis(windows, -1, 1).reshape(joints, taps, steps * environments)
        out = self._forward(x, self._last).reshape(joints, steps, environments)
        self._remember(time[:, : -self.taps - 1 : -1])
        self._last = out[:, -1]
        return self._leave_all(np.moveaxis(out, 1, 2))

    def _forward(self, x: NDArray, last: NDArray) -> NDArray[np.float32]:
        """Normalised positions (joints, n) from normalised commands (joints, taps, n)."""
        p = self.parameters
        out = np.matmul(p["fir"][:, None], x)[:, 0] + p["fir_bias"][:, None]
        if not self._depth:
            return out
        if x.shape[-1] <= _FEW:
            h = np.concatenate([x, last[:, None]], axis=1) if self.feedback else x
            for weight, low in self._layers[:-1]:
                h = np.maximum(np.matmul(weight, h), low)
            weight, low = self._layers[-1]
            return out + bounded((np.matmul(weight, h) - low)[:, 0], p["bound"][:, None])
        correction = np.empty_like(out)
        # joint by joint, so that a layer of many environments stays in the processor's cache
        work = self._work if x.shape[-1] == self._work[0].shape[-1] else [None] * self._depth
        for j in range(len(self.joints)):
            h = np.concatenate([x[j], last[j, None]]) if self.feedback else x[j]
            for n, (weight, low) in enumerate(self._layers):
                h = np.matmul(weight[j], h, out=work[n])
                if n < self._depth - 1:
                    np.maximum(h, low[j], out=h)
            np.subtract(h[0], self._layers[-1][1][j, 0], out=correction[j])
        out += bounded(correction, p["bound"][:, None])
        return out

    @property
    def memory(self) -> dict[str, NDArray[np.float32]]:
        """See `JointArrays`: newest commands and last position, normalised."""
        return {"history": self._history, "last": self._last}

    @property
    def _history(self) -> NDArray[np.float32]:
        """Normalised commands (joints, taps, environments), newest first."""
        return self._room[:, self._newest : self._newest + self.taps]

    def _remember(self, history: NDArray) -> None:
        self._newest = self.taps
        self._room[:, self.taps :] = history


def bounded(value: NDArray, bound: NDArray) -> NDArray:
    """`bound * tanh(value / bound)`; the value itself where the bound is infinite."""
    if np.isinf(bound).all():
        return value
    return bound * np.tanh(value / bound)


class RecurrentNetwork(JointArrays):
    """FIR filter and bounded LSTM, per joint. See the module's text.

    With members m, inputs n and hidden units h, parameters beyond those of `JointArrays` are
    `weight_input` (joints, m, n, 4 h), `weight_hidden` (joints, m, h, 4 h) and `bias` (joints, m, 4
    h) for the gates i, f, g, o; `weight_out` (joints, m, h), `bias_out` (joints, m). `warm_up`
    steps at rest fill the memory after a reset.
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
        initial = self._enter(position)
        members, hidden = self._memory
        shape = (len(self.joints), members, initial.shape[1], hidden)
        self._hidden, self._cell = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        rest = self._normal_command(initial)
        self._history = np.repeat(rest[..., None], self.taps, axis=-1)
        at_rest = self._normal_position(initial)
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
