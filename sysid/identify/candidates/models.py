"""Candidate servo models of calibration, from a pure delay to a servo with backlash.

A candidate is a function from parameters and commands to positions, vectorised over any number of
simulations, with bounds and priors of its parameters. All are per unit of inertia (positions in
free air identify no more) and relative to the rest position.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, integrate


@dataclass(frozen=True)
class Parameter:
    """One number of a model, fitted as its logarithm unless it may be negative.

    Attributes
    ----------
    name : str
        Ends in its unit.
    nominal, low, high : float
        Where the search starts and the box it stays in.
    prior_sd : float
        Standard deviation of a Gaussian prior about `nominal`, of the logarithm where that is
        what is fitted. Wide: it decides only what the data leave open, such as a speed limit
        that was never reached.
    """

    name: str
    nominal: float
    low: float
    high: float
    prior_sd: float = float("inf")

    @property
    def logarithmic(self) -> bool:
        """Whether the logarithm is fitted."""
        return self.low > 0

    def encode(self, value):
        """Fitted coordinate of a value."""
        return np.log(value) if self.logarithmic else np.asarray(value, float)

    def decode(self, coordinate):
        """Value of a fitted coordinate."""
        return np.exp(coordinate) if self.logarithmic else np.asarray(coordinate, float)


@dataclass(frozen=True)
class CandidateModel:
    """A servo model to fit.

    Attributes
    ----------
    name : str
    parameters : tuple of Parameter
        The dead time [s] is the first and the offset [rad] the last, in every model.
    simulate : callable
        `(values, track) -> None`: `values` (parameters, simulations) without delay and offset;
        `track` (steps, simulations) holds delayed commands relative to rest and is overwritten
        with positions [rad], each step lasting `TIME_STEP_S`. The reference of
        `sysid.identify.candidates.kernel`, which fits run.
    columns : callable or None
        From values (candidates, parameters) without dead time and offset to the kernel's; None
        where they are the same.
    kernel : str or None
        Name in `sysid.identify.candidates.kernel.KINDS`; None where it is the model's.
    """

    name: str
    parameters: tuple[Parameter, ...]
    simulate: Callable[[NDArray, NDArray], None]
    columns: Callable[[NDArray], NDArray] | None = None
    kernel: str | None = None

    @property
    def names(self) -> list[str]:
        """Parameter names in order."""
        return [p.name for p in self.parameters]

    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper bounds of the fitted coordinates, shape (parameters,) each."""
        ends = ([float(p.encode(x)) for x in (p.low, p.high)] for p in self.parameters)
        low, high = np.array(list(ends)).T
        return low, high

    def encode(self, values: NDArray) -> NDArray[np.float64]:
        """Fitted coordinates of values (..., parameters)."""
        return np.stack([p.encode(values[..., j]) for j, p in enumerate(self.parameters)], axis=-1)

    def decode(self, points: NDArray) -> NDArray[np.float64]:
        """Values of fitted coordinates (..., parameters)."""
        return np.stack([p.decode(points[..., j]) for j, p in enumerate(self.parameters)], axis=-1)


def _pure_delay(values: NDArray, track: NDArray) -> None:
    track *= values[0]


def _first_order(values: NDArray, track: NDArray) -> None:
    gain, time_constant = values
    keep = np.exp(-TIME_STEP_S / time_constant)
    y = np.zeros_like(gain)
    for k in range(len(track)):
        y = keep * y + (1 - keep) * track[k]
        track[k] = y
    track *= gain


def _second_order(values: NDArray, track: NDArray) -> None:
    gain, frequency, damping = values
    h, w = TIME_STEP_S, frequency
    y, v = np.zeros_like(gain), np.zeros_like(gain)
    implicit = 1.0 / (1.0 + 2 * h * damping * w + (h * w) ** 2)
    for k in range(len(track)):  # backward Euler: stable for any frequency in the box
        v = (v + h * w * w * (track[k] - y)) * implicit
        y = y + h * v
        track[k] = y
    track *= gain


def _dc_servo(values: NDArray, track: NDArray) -> None:
    """Duty-limited DC motor: acceleration = stall · duty - back-EMF · speed - friction."""
    stiffness, friction, stall, no_load = values
    h = TIME_STEP_S
    y, v = np.zeros_like(stall), np.zeros_like(stall)
    implicit = 1.0 / (1.0 + h * stall / no_load)
    for k in range(len(track)):
        drive = np.minimum(np.maximum(stiffness * (track[k] - y), -stall), stall)
        free = (v + h * drive) * implicit
        v = np.sign(free) * np.maximum(np.abs(free) - h * friction * implicit, 0.0)
        y = y + h * v
        track[k] = y


def _delayed_pd(values: NDArray, track: NDArray) -> None:
    names = ("stiffness", "damping", "friction_loss", "effort_limit", "velocity_limit", "back_emf")
    own = _without_back_emf(values.T).T if len(values) < len(names) else values
    rest = np.zeros_like(values[0])
    parameters = dict(zip(names, own, strict=True)) | {"armature": np.ones_like(rest)}
    integrate(track, (rest, rest, rest), parameters, TIME_STEP_S, out=track)


def _without_back_emf(values: NDArray) -> NDArray:
    return np.insert(values, 5, 0.0, axis=1)


def _back_emf_pd(values: NDArray, track: NDArray) -> None:
    _delayed_pd(_from_no_load_speed(values.T).T, track)


def _from_no_load_speed(values: NDArray) -> NDArray:
    """Stiffness, damping, friction, effort; no set-point slew; back-EMF from the no-load speed."""
    pd, no_load = values[:, :4], values[:, 4]
    return np.column_stack([pd, np.full(len(pd), np.inf), pd[:, 3] / no_load])


def _delayed_pd_backlash(values: NDArray, track: NDArray) -> None:
    half = 0.5 * values[-1]
    _delayed_pd(values[:-1], track)
    y = np.zeros_like(half)
    for k in range(len(track)):  # play: the output moves only when the gap is taken up
        y = np.minimum(np.maximum(y, track[k] - half), track[k] + half)
        track[k] = y


_DELAY = Parameter("dead_time_s", 0.02, 0.001, 0.4)
_OFFSET = Parameter("offset_rad", 0.0, -2.0, 2.0)
_GAIN = Parameter("gain", 1.0, 0.5, 1.5)
# The priors cover hobby servos. Speed: data sheets say 0.08 to 0.2 s per 60 degrees, 13 to 5 rad/s,
# about a geometric mean of 8.3. The rest: stiff enough to hold a leg, and torque enough to bring
# it to that speed within a few hundredths of a second.
_STIFFNESS = Parameter("stiffness_per_s2", 9000.0, 30.0, 200000.0, 1.0)
_DAMPING = Parameter("damping_per_s", 90.0, 1.0, 2000.0, 1.0)
_FRICTION = Parameter("friction_rad_s2", 120.0, 0.1, 10000.0, 1.2)
_EFFORT = Parameter("effort_rad_s2", 450.0, 5.0, 20000.0, 0.6)
_SPEED = Parameter("velocity_limit_rad_s", 8.3, 0.3, 60.0, 0.3)
_PD = (_DELAY, _STIFFNESS, _DAMPING, _FRICTION, _EFFORT, _SPEED)

_TIME_CONSTANT = Parameter("time_constant_s", 0.02, 0.0005, 0.5)
_NATURAL_FREQUENCY = Parameter("natural_frequency_rad_s", 90.0, 8.0, 600.0)
_DAMPING_RATIO = Parameter("damping_ratio", 0.8, 0.1, 4.0)
_NO_LOAD_SPEED = Parameter("no_load_speed_rad_s", 9.0, 0.3, 60.0, 0.4)
_BACKLASH = Parameter("backlash_rad", 0.01, 0.0005, 0.15, 1.0)

CANDIDATE_MODELS = (
    CandidateModel("pure_delay", (_DELAY, _GAIN, _OFFSET), _pure_delay),
    CandidateModel("fopdt", (_DELAY, _GAIN, _TIME_CONSTANT, _OFFSET), _first_order),
    CandidateModel(
        "sopdt", (_DELAY, _GAIN, _NATURAL_FREQUENCY, _DAMPING_RATIO, _OFFSET), _second_order
    ),
    CandidateModel(
        "dc_servo", (_DELAY, _STIFFNESS, _FRICTION, _EFFORT, _NO_LOAD_SPEED, _OFFSET), _dc_servo
    ),
    CandidateModel("delayed_pd", (*_PD, _OFFSET), _delayed_pd, _without_back_emf),
    CandidateModel(
        "delayed_pd_back_emf",
        (*_PD[:-1], _NO_LOAD_SPEED, _OFFSET),
        _back_emf_pd,
        _from_no_load_speed,
        "delayed_pd",
    ),
    CandidateModel(
        "delayed_pd_backlash", (*_PD, _BACKLASH, _OFFSET), _delayed_pd_backlash, _without_back_emf
    ),
)
"""All candidates, simplest first."""


def candidate_model(name: str) -> CandidateModel:
    """The candidate called `name`."""
    return next(m for m in CANDIDATE_MODELS if m.name == name)
