"""DelayedPD: a late, force-limited, speed-limited PD servo with dry friction, as MuJoCo steps it.

One servo holds one joint whose inertia is `armature`. A command takes effect after `dead_time_s`;
its set-point moves at `velocity_limit` at most, and the torque

    tau = clip(stiffness * (setpoint - position) - damping * velocity, ±effort_limit)
          - back_emf * velocity

works against a dry friction of `friction_loss`. A limit on the speed is one of two things: the
set-point slews (`velocity_limit`), or the motor's voltage runs out (`back_emf`; the no-load speed
is `effort_limit / back_emf`). A servo may have both. This module is the same arithmetic as MuJoCo's
native `<pid delay nsample interp="linear" slewmax forcerange>` on a hinge with `armature`,
`frictionloss` and `damping`, integrated with `implicitfast`;
`tests/servo_models/test_delayed_pd.py` holds the two together:

* dead time: the command of the past, linearly interpolated between time steps. For a command that
  changes on time steps this is the mean of the held command over the step, so the trajectory is a
  continuous function of the dead time;
* speed limit: `slewmax`, a limit on the set-point's rate (a servo's Goal_Speed);
* friction: a constraint that removes the whole velocity in one time step if `friction_loss`
  allows it (`sim.robot.servo_mjcf`). MuJoCo's default friction is far softer than
  a servo's gears: it would still creep at 1 rad/s;
* damping is integrated implicitly, except while the torque is clipped; back-EMF always is.

Free-air positions cannot tell the torques from the inertia: scaling stiffness, damping,
friction_loss, effort_limit, back_emf and armature together changes nothing (`per_inertia`).

`ServoModel` is what every servo model offers. `DelayedServo` is the base of those that integrate an
equation of motion, every 2 ms or so; its `DelayLine` holds the commands that have been sent and
have not arrived yet. Learned models step once per command of a controller, every 20 or 40 ms:
`AtControlRate` makes the others do so, too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError


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


class DelayedServo(ABC):
    """A `ServoModel` that integrates an equation of motion under delayed commands.

    `values` are all its numbers, whose broadcast shape is the batch until `reset` widens it; the
    dead time [s] is from a command's arrival to its first effect. Commands and positions are at the
    time step.
    """

    def __init__(
        self, values: Iterable[NDArray], dead_time_s: NDArray[np.float64], time_step_s: float
    ):
        refuse_time_step(type(self).__name__, time_step_s)
        self.time_step_s = float(time_step_s)
        self._shape = np.broadcast_shapes(*(v.shape for v in values))
        self._delay_line = DelayLine(dead_time_s, self.time_step_s)
        self.reset(np.zeros(self._shape))

    def __repr__(self) -> str:
        of = f" of {self._shape} servos" if self._shape else ""
        return f"{type(self).__name__}{of}, a step every {1e3 * self.time_step_s:g} ms"

    def reset(self, position: ArrayLike) -> None:
        """Rest at `position` [rad], which has been the command for as long as the dead time.

        The batch becomes the shape to which `position` and the parameters broadcast.
        """
        position = np.asarray(position, float)
        self.batch = np.broadcast_shapes(position.shape, self._shape)
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
    """Refuse a time step [s] that is not a positive number."""
    if not (np.isfinite(time_step_s) and time_step_s > 0):
        raise InputError(f"{model}: time_step_s is {time_step_s}; it must be positive.")


class DelayLine:
    """Commands on their way to the servos of a batch; starts when `reset` is called.

    The delay [s] is not negative, and finite; commands are a time step apart.

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
        steps = np.floor(delay).astype(int)
        # one row more than requested: each row's successor is the other end of its interpolation
        row = np.arange(len(history) - len(commands) - 1, len(history))[:, None]
        series = len(delay)
        taken = np.take(history.reshape(-1), row * series + (np.arange(series) - steps * series))
        arrived = np.subtract(taken[:-1], taken[1:])
        arrived *= delay - steps
        arrived += taken[1:]
        return arrived.reshape(commands.shape)


TIME_STEP_S = 0.002
"""Physics step of fitting and of training [s]: 500 Hz."""

FRICTION_IMPEDANCE = 0.9999
TORQUES = ("stiffness", "damping", "friction_loss", "effort_limit", "back_emf")
"""Numbers in proportion to the armature for the same motion."""


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


def whole_steps(low_s: float, high_s: float, time_step_s: float) -> tuple[int, int]:
    """An interval of a dead time [s] in whole time steps, rounded outward.

    Examples
    --------
    >>> whole_steps(0.0247, 0.0268, 0.002), whole_steps(0.024, 0.026, 0.002)
    ((12, 14), (12, 13))
    """
    low = int(np.floor(low_s / time_step_s + 1e-9))
    return low, int(np.ceil(high_s / time_step_s - 1e-9))


@dataclass(frozen=True)
class DelayedPDParameters:
    """Numbers of a DelayedPD servo; floats or arrays that broadcast against each other.

    Parameters
    ----------
    stiffness : array_like
        Torque per position error [N·m/rad].
    damping : array_like
        Torque per velocity [N·m·s/rad].
    friction_loss : array_like
        Dry (Coulomb) friction [N·m].
    armature : array_like
        Reflected inertia and load at the joint [kg·m²].
    effort_limit : array_like
        Largest torque [N·m].
    velocity_limit : array_like
        Largest rate of the set-point [rad/s].
    dead_time_s : array_like
        From a command's arrival to its first effect on the torque [s].
    back_emf : array_like
        Torque lost per velocity outside of the effort limit [N·m·s/rad]: back-EMF of the motor,
        viscous friction of the gears.
    """

    stiffness: ArrayLike
    damping: ArrayLike
    friction_loss: ArrayLike
    armature: ArrayLike
    effort_limit: ArrayLike
    velocity_limit: ArrayLike
    dead_time_s: ArrayLike
    back_emf: ArrayLike = 0.0

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """The numbers as arrays, by name."""
        return {f.name: np.asarray(getattr(self, f.name), float) for f in fields(self)}

    def per_inertia(self) -> DelayedPDParameters:
        """The same motion with an armature of 1: the ratios that free-air data identify."""
        values = self.arrays()
        ratios = {name: values[name] / values["armature"] for name in TORQUES}
        return replace(self, **ratios, armature=np.ones_like(values["armature"]))

    def scaled(self, armature: ArrayLike) -> DelayedPDParameters:
        """The same motion with another armature."""
        ratios, armature = self.per_inertia().arrays(), np.asarray(armature, float)
        return replace(self, **{n: ratios[n] * armature for n in TORQUES}, armature=armature)


class DelayedPD(DelayedServo):
    """The servo model that is fitted, and that training simulates. See the module's text.

    Parameters
    ----------
    parameters : DelayedPDParameters
        Their broadcast shape is the model's batch, until `reset` widens it.
    time_step_s : float
        Time step [s]; commands and positions are at this step.

    Raises
    ------
    InputError
        If a parameter is not a number or is negative, or the armature or time step is zero.
    """

    def __init__(self, parameters: DelayedPDParameters, time_step_s: float = TIME_STEP_S):
        self.parameters, self._values = parameters, parameters.arrays()
        for name, value in self._values.items():
            lowest = np.min(value)
            # an infinite limit is no limit
            if np.isnan(value).any() or lowest < 0 or (name == "armature" and lowest == 0):
                raise InputError(f"DelayedPD: {name} is {lowest}; it must be a positive number.")
        super().__init__(self._values.values(), self._values["dead_time_s"], time_step_s)

    def _rest(self, position: NDArray[np.float64]) -> None:
        self._state = (position.copy(), np.zeros(self.batch), position.copy())
        self._numbers = _per_step(self._values, self.batch, self.time_step_s)

    def _integrate(self, delayed: NDArray[np.float64]) -> NDArray[np.float64]:
        positions, self._state = _moved(delayed, self._state, self._numbers, self.time_step_s)
        return positions


def integrate(
    delayed: NDArray[np.float64],
    state: tuple[NDArray, NDArray, NDArray],
    values: dict[str, NDArray],
    time_step_s: float,
    implicit: bool = True,
) -> tuple[NDArray[np.float64], tuple[NDArray, NDArray, NDArray]]:
    """Step the servo through commands that have already been delayed.

    Commands as they take effect [rad] and positions have the shape (steps, *batch); the state is
    (position, velocity, setpoint), each of shape batch; values are the fields of
    `DelayedPDParameters` but the dead time, each broadcastable to batch. `implicit` brakes with the
    velocity at the step's end, as MuJoCo does, instead of the present one. Gives positions and the
    state after the last step.
    """
    numbers = _per_step(values, delayed.shape[1:], time_step_s, implicit)
    return _moved(delayed, state, numbers, time_step_s)


def _per_step(
    values: dict[str, NDArray], batch: tuple[int, ...], h: float, implicit: bool = True
) -> tuple[NDArray[np.float64], ...]:
    """Numbers of `_steps`, each of shape (servos,)."""

    def flat(value):
        return np.array(np.broadcast_to(value, batch), dtype=float).reshape(-1)

    kp, kd, friction, effort, brake = (flat(values[name] / values["armature"]) for name in TORQUES)
    slew = flat(values["velocity_limit"] * h)
    damped = h * (kd + brake) if implicit else np.zeros_like(kd)
    # explicit where the torque is clipped: MuJoCo drops the damping's derivative there
    braked = h * brake if implicit else np.zeros_like(kd)
    return kp, kd, friction, effort, brake, slew, h / (1.0 + damped), h / (1.0 + braked)


def _moved(
    delayed: NDArray[np.float64], state: tuple[NDArray, NDArray, NDArray],
    numbers: tuple[NDArray[np.float64], ...], h: float,
) -> tuple[NDArray[np.float64], tuple[NDArray, NDArray, NDArray]]:  # fmt: skip
    steps, batch = len(delayed), delayed.shape[1:]
    positions = np.empty((steps, len(numbers[0])))
    position, velocity, setpoint = (np.array(x, dtype=float).reshape(-1) for x in state)
    arrived = np.ascontiguousarray(delayed, dtype=float).reshape(steps, -1)
    compiled(_steps)(arrived, positions, position, velocity, setpoint, *numbers, h)
    after = (position.reshape(batch), velocity.reshape(batch), setpoint.reshape(batch))
    return positions.reshape(delayed.shape), after


@cache
def compiled(loop: Callable) -> Callable:
    """The loop compiled; numba is imported by the first model that moves."""
    from numba import njit

    return njit(cache=True, nogil=True, error_model="numpy")(loop)


def _steps(
    delayed, positions, position, velocity, setpoint, kp, kd, friction, effort, brake, slew,
    inverse, clipped, h,
):  # fmt: skip
    """Fill `positions`, shape (steps, servos); position, velocity and set-point move in place."""
    for k in range(delayed.shape[0]):
        for n in range(delayed.shape[1]):
            setpoint[n] += min(max(delayed[k, n] - setpoint[n], -slew[n]), slew[n])
            demand = (setpoint[n] - position[n]) * kp[n] - kd[n] * velocity[n]
            force = min(max(demand, -effort[n]), effort[n])
            gain = inverse[n] if force == demand else clipped[n]
            if brake[n] != 0.0:
                force -= brake[n] * velocity[n]
            stop = (velocity[n] * (1.0 / h) + force) * -FRICTION_IMPEDANCE
            force += min(max(stop, -friction[n]), friction[n])
            velocity[n] += force * gain
            position[n] += velocity[n] * h
            positions[k, n] = position[n]
