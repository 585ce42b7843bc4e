"""Fisher information of a trial about a servo model, and of two models against each other.

A trial is simulated under the present fit. Its readings y have the sensitivities
J = ∂y/∂θ to the fitted coordinates θ (logarithms of the parameters) and an uncorrelated error of
variance floor² + (speed · jitter)²: commands and polls come early or late at random, which moves a
fast joint further than a slow one. With W the inverse variances, JᵀWJ is what the trial says about
θ; its inverse, with what is known already, is the covariance to expect (Fedorov, Theory of Optimal
Experiments, 1972). One shift in time of all readings of a tone is a nuisance coordinate: no model
is exact at every tone, and the dates of a polled bus are not. So no tone can say everything.

Two models that fit equally well are told apart by a trial in which they still differ after each has
been fitted again (T-optimality: Atkinson and Fedorov, Biometrika 62, 1975).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.fit.posterior import PHASE_SD_S
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run, residuals
from pupper_sysid.sysid.fit.structure import Structure

_STEP = 0.03  # of the sensitivities: the slope over a likely error, not of one kink
_LINEAR_STEP = 3e-4


@dataclass(frozen=True)
class Noise:
    """Error of the readings of a trial.

    Attributes
    ----------
    floor_rad : float
        Standard deviation at rest: sensor noise and quantisation.
    jitter_s : float
        Standard deviation of the times of commands and readings.
    """

    floor_rad: float
    jitter_s: float

    def weights(self, speed_rad_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse variances [1/rad²] of readings of a joint at these speeds."""
        return 1.0 / (self.floor_rad**2 + (speed_rad_s * self.jitter_s) ** 2)


@dataclass(frozen=True)
class Hypothesis:
    """A servo model with the parameters that explain what is known.

    Attributes
    ----------
    model : Structure
    values : ndarray, shape (parameters,)
    known : ndarray, shape (parameters, parameters)
        Information about the fitted coordinates so far, the prior included.
    """

    model: Structure
    values: NDArray[np.float64]
    known: NDArray[np.float64]


@dataclass(frozen=True)
class Response:
    """A trial as one hypothesis predicts it.

    Attributes
    ----------
    position_rad, weights : ndarray, shape (samples,)
        Readings, and their inverse variances [1/rad²].
    sensitivity : ndarray, shape (samples, parameters + 1)
        Of the readings to the fitted coordinates, and to the shift in time of the tone.
    """

    position_rad: NDArray[np.float64]
    weights: NDArray[np.float64]
    sensitivity: NDArray[np.float64]

    def inner(self, a: NDArray, b: NDArray) -> NDArray[np.float64]:
        """Weighted inner product aᵀWb, shape (columns of a, columns of b)."""
        return (a.T * self.weights) @ b

    @property
    def information(self) -> NDArray[np.float64]:
        """Of the trial about parameters and shift, shape (parameters + 1, parameters + 1)."""
        return self.inner(self.sensitivity, self.sensitivity)


def without_shift(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Information of a tone's trials, summed, about the parameters whatever its shift in time."""
    shift, own = information[:-1, -1], information[-1, -1] + PHASE_SD_S**-2
    return information[:-1, :-1] - np.outer(shift, shift) / own


def pooled(
    informations: Iterable[tuple[Hashable, NDArray[np.float64]]],
) -> NDArray[np.float64] | float:
    """Information of trials about the parameters, each with the name of its tone; 0 of none."""
    by_tone: dict[Hashable, NDArray[np.float64]] = {}
    for tone, information in informations:
        by_tone[tone] = by_tone.get(tone, 0.0) + information
    return sum((without_shift(total) for total in by_tone.values()), start=0.0)


def prior_information(model: Structure) -> NDArray[np.float64]:
    """Of the model's prior, shape (parameters, parameters); a wide one where it has none."""
    sd = np.array([min(p.prior_sd, 2.0 if p.logarithmic else 1.0) for p in model.parameters])
    return np.diag(sd**-2.0)


def respond(hypothesis: Hypothesis, trial: Run, noise: Noise, seen: float = 1.0) -> Response:
    """Simulate one trial and its sensitivities.

    Parameters
    ----------
    hypothesis : Hypothesis
    trial : Run
        Command, and the times of the readings; their positions are ignored.
    noise : Noise
    seen : float
        Share of the readings that arrive.
    """
    model, values = hypothesis.model, hypothesis.values
    par = model.parameters
    step = np.array([_STEP if p.logarithmic else _LINEAR_STEP for p in par])
    centre = np.array([float(p.encode(v)) for p, v in zip(par, values, strict=True)])
    cloud = np.concatenate([centre + np.diag(step), centre - np.diag(step)])
    ends = np.stack([p.decode(cloud[:, j]) for j, p in enumerate(par)], axis=-1)
    off = residuals(model, ends, [trial])[0]
    track = free_run(model, values, [trial])[0]
    speed = at_steps(np.gradient(track) / trial.step_s, trial.sample_step)
    slope = (off[: len(par)] - off[len(par) :]).T / (2 * step)
    shift = slope[:, :1] / values[0]  # of the logarithm: a tone's shift is a dead time of its own
    return Response(
        at_steps(track, trial.sample_step),
        seen * noise.weights(speed),
        np.hstack([slope, shift]),
    )


def fitted_noise(
    model: Structure, values: NDArray, trials: Sequence[Run], least_rad: float
) -> Noise:
    """Noise that explains the residuals of a fit, tone by tone.

    Least squares of each trial's mean squared residual over floor² + jitter² · mean squared speed,
    relative to the former; both not negative.

    Parameters
    ----------
    model : Structure
    values : ndarray, shape (parameters,)
    trials : sequence of Run
    least_rad : float
        Smallest floor.
    """
    from scipy.optimize import nnls

    square, speed = [], []
    for trial, track in zip(trials, free_run(model, values, trials), strict=True):
        off = at_steps(track, trial.sample_step) - trial.sample_rad
        bound = 4 * 1.4826 * np.median(np.abs(off)) + 1e-12  # an upset is not the noise
        square.append(np.mean(np.clip(off, -bound, bound) ** 2))
        speed.append(np.mean(np.gradient(track) ** 2) / trial.step_s**2)
    rows = np.column_stack([np.ones(len(square)), speed]) / np.maximum(square, 1e-12)[:, None]
    (floor, jitter), _ = nnls(rows, np.ones(len(rows)))
    return Noise(max(float(np.sqrt(floor)), least_rad), float(np.sqrt(jitter)))


def separation(
    truth: Sequence[Response], rival: Sequence[Response], known: NDArray[np.float64]
) -> float:
    """Nats by which trials are expected to prefer the true model to a rival that is fitted again.

    Parameters
    ----------
    truth, rival : sequence of Response
        The same trials under both.
    known : ndarray, shape (parameters, parameters)
        Information about the rival's coordinates so far.
    """
    total, pull, curvature = 0.0, np.zeros(len(known)), known.copy()
    for true, wrong in zip(truth, rival, strict=True):
        off = (wrong.position_rad - true.position_rad)[:, None]
        push, information = wrong.inner(wrong.sensitivity, off)[:, 0], wrong.information
        own = information[-1, -1] + PHASE_SD_S**-2
        total += wrong.inner(off, off).item() - push[-1] ** 2 / own
        pull += push[:-1] - information[:-1, -1] * push[-1] / own
        curvature += without_shift(information)
    return 0.5 * max(total - float(pull @ np.linalg.solve(curvature, pull)), 0.0)
