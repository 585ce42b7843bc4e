"""Base of the learned servo models: parameters per joint, normalisation, layout of arrays.

Inside, arrays are (joints, environments, …), so that one matrix product per joint serves all
environments; outside they are (*environments, joints), as everywhere in this project.
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

    Parameters
    ----------
    joints : sequence of str
    time_step_s : float
    parameters : mapping of str to ndarray
        Each with the joints on its first axis: `command_center`, `command_scale`,
        `position_center`, `position_scale`, `bound`, `fir_bias`, each (joints,); `fir` (joints,
        taps), newest command first; and those of the subclass. All but `bound` are finite.
    feedback : bool
        Whether the network's last input is the position predicted last.
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

    def _shape(self, name: str, axes: int) -> tuple[int, ...]:
        if name not in self.parameters or self.parameters[name].ndim != axes:
            raise InputError(f"A servo model needs {name} with {axes} axes. Fit it again.")
        return self.parameters[name].shape

    def _need(self, name: str, shape: tuple[int, ...]) -> None:
        expected = (len(self.joints), *shape)
        if name not in self.parameters or self.parameters[name].shape != expected:
            found = self.parameters[name].shape if name in self.parameters else "nothing"
            raise InputError(
                f"A servo model needs {name} of shape {expected}; found {found}. Fit it again."
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
