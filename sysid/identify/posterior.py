"""Posterior of a model's parameters by an ensemble of Markov chains: intervals that hold.

The cost of a servo with dry friction is rugged, and many servos move alike: a long, curved ridge of
parameters explains a recording equally well. Its curvature at the optimum, or refits from there,
see one dent of it. The compiled simulation is fast enough to walk along the whole ridge instead:
`sample` draws parameters in proportion to prior and likelihood by differential evolution Markov
chains, from a population that has been evolved.

Residuals are not white. What counts against a parameter is their power at the tone and its
harmonics, where its effect is; `noise_ratio` compares it with their power elsewhere, and the
likelihood is tempered by it.

References
----------
ter Braak, C. J. F. (2006). A Markov chain Monte Carlo version of the genetic algorithm
differential evolution. Statistics and Computing 16: 239–249.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.tones import least_squares
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters
from pupper_sysid.servo_models.step_size import lag_of_steps
from pupper_sysid.sysid.identify.candidates.models import CandidateModel
from pupper_sysid.sysid.identify.candidates.simulation import TrialData
from pupper_sysid.sysid.identify.output_error import Fit, Problem, costs
from pupper_sysid.sysid.identify.search import fresh_residuals

HARMONICS = (1, 2, 3)
STEPPING_SD_S = 0.5 * TIME_STEP_S
"""Error of a dead time [s] that no number of readings reduces, because the model moves in steps:
standard deviation over 60 random emulated servos with half that step."""
_CHAINS = 32
_SETTLING, _GENERATIONS = 130, 140
_LEFT_OUT = 20  # generations after the change of steps
_START_SD = 0.1  # of the logarithms about the fit that chains start from
_OFFSET_START_SD_RAD = 5e-4
_JUMP_EVERY = 10  # a jump by a whole difference lets chains change between optima
_NOISE = 1e-3  # of a proposal, in fitted coordinates


@dataclass(frozen=True)
class Posterior:
    """Draws of a model's parameters, simulated in half of the fit's physics steps.

    Attributes
    ----------
    model : CandidateModel
    values : ndarray, shape (draws, parameters)
    best : ndarray, shape (parameters,)
        The draw with the lowest cost.
    lowest_cost : float
        Before tempering.
    temperature : float
        See `noise_ratio`.
    """

    model: CandidateModel
    values: NDArray[np.float64]
    best: NDArray[np.float64]
    lowest_cost: float
    temperature: float

    @property
    def spread(self) -> NDArray[np.float64]:
        """Standard deviations of the fitted coordinates, shape (parameters,)."""
        return self.model.encode(self.values).std(axis=0)

    def intervals(self, fitted: NDArray[np.float64]) -> dict[str, Interval]:
        """Interval of each parameter, and of the back-EMF where the model has one.

        Parameters
        ----------
        fitted : ndarray, shape (parameters,)
            Values for the fit's physics steps.

        Returns
        -------
        dict of str to Interval
            The fitted values, with ends that hold the servo's own numbers, too: a step makes gains
            look larger than they are in continuous time.
        """
        names = self.model.names
        found = {}
        for name, value, own, continuous in zip(
            names, fitted, self.values.T, in_continuous_time(names, self.values).T, strict=True
        ):
            both = [Interval.of_draws(value, draws) for draws in (own, continuous)]
            found[name] = Interval(
                float(value),
                min(value, *(i.low for i in both)),
                max(value, *(i.high for i in both)),
            )
        if {"stiffness_per_s2", "effort_rad_s2"} <= set(names):
            found["dead_time_s"] = self._dead_time(fitted, found["dead_time_s"])
        if "no_load_speed_rad_s" in names:
            effort, speed = (names.index(n) for n in ("effort_rad_s2", "no_load_speed_rad_s"))
            draws = self.values[:, effort] / self.values[:, speed]
            found["back_emf_per_s"] = Interval.of_draws(fitted[effort] / fitted[speed], draws)
        return found

    def _dead_time(self, fitted: NDArray[np.float64], drawn: Interval) -> Interval:
        """The interval for the fit's physics steps, with the error that steps leave."""
        value = float(fitted[0])
        own = dict(zip(self.model.names, fitted, strict=True))
        effort = own["effort_rad_s2"]
        servo = DelayedPDParameters(
            own["stiffness_per_s2"], own["damping_per_s"], own["friction_rad_s2"], 1.0, effort,
            own.get("velocity_limit_rad_s", np.inf), value,
            effort / own["no_load_speed_rad_s"] if "no_load_speed_rad_s" in own else 0.0,
        )  # fmt: skip
        # what the fit's steps add to the dead time that half as long ones ask for
        more = float(lag_of_steps(servo, 0.5 * TIME_STEP_S, TIME_STEP_S)[0])
        grain = ndtri(0.5 + LEVEL / 2) * STEPPING_SD_S
        if not np.isfinite(more):  # too slow for the tones that tell: up to a whole step
            more, grain = 0.0, max(grain, TIME_STEP_S)
        low, high = np.quantile(self.values[:, 0], [(1 - LEVEL) / 2, (1 + LEVEL) / 2]) + more
        low, high = min(low, value), max(high, value)
        return Interval(
            value,
            max(float(value - np.hypot(value - low, grain)), 0.0),
            float(value + np.hypot(high - value, grain)),
        )


def in_continuous_time(names: Sequence[str], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Parameters (draws, parameters) of half physics steps as those of a servo without steps.

    In a step h the drive acts over h / (1 + h d) at damping d, in continuous time over
    (1 - exp(-h d')) / d' with exp(-h d') = 1 / (1 + h d): stiffness, damping and friction are
    smaller by d' / d. While the torque is clipped, the same holds with the back-EMF alone.
    """
    found, at = values.copy(), {name: j for j, name in enumerate(names)}
    if "damping_per_s" not in at or "friction_rad_s2" not in at:
        return found
    h, damping = 0.5 * TIME_STEP_S, values[:, at["damping_per_s"]]
    brake = np.zeros_like(damping)
    if "no_load_speed_rad_s" in at:
        brake = values[:, at["effort_rad_s2"]] / values[:, at["no_load_speed_rad_s"]]
        found[:, at["effort_rad_s2"]] *= np.log1p(h * brake) / (h * brake)
    total = damping + brake
    ratio = np.log1p(h * total) / (h * total)
    for name in ("stiffness_per_s2", "friction_rad_s2"):
        found[:, at[name]] *= ratio
    found[:, at["damping_per_s"]] = np.maximum(
        (np.log1p(h * total) - np.log1p(h * brake)) / h, 1e-3 * damping
    )
    return found


def in_half_steps(data: tuple[TrialData, ...]) -> tuple[TrialData, ...]:
    """The same trials in physics steps of half the length: nearer to a servo without steps."""
    return tuple(t.in_half_steps() for t in data)


def posterior(
    model: CandidateModel,
    data: tuple[TrialData, ...],
    noise_rad: tuple[float, ...],
    best: Fit,
    rng: np.random.Generator,
) -> Posterior:
    """Draw the parameters of a model from their posterior, around the best fit.

    Parameters
    ----------
    model : CandidateModel
    data : tuple of TrialData
    noise_rad : tuple of float
        Of each trial.
    best : Fit
        To all trials.
    rng : numpy.random.Generator
    """
    residuals = fresh_residuals(model, best.values, data)
    scaled = [r / n for r, n in zip(residuals, noise_rad, strict=True)]
    temperature = noise_ratio(scaled, data, len(model.parameters))
    problem = Problem(in_half_steps(data), (True,) * len(data), noise_rad, {})
    centre = model.encode(best.values)
    sd = np.where([p.logarithmic for p in model.parameters], _START_SD, _OFFSET_START_SD_RAD)
    start = centre + sd * rng.standard_normal((_CHAINS, len(centre)))
    start[0] = centre
    # the chains settle in the fit's steps, which cost half as much
    coarse = replace(problem, trials=data)
    settled, _ = sample(model, coarse, start, temperature, _SETTLING, rng, _SETTLING - 1)
    points, cost = sample(model, problem, settled, temperature, _GENERATIONS, rng, _LEFT_OUT)
    lowest = int(np.argmin(cost))
    values = model.decode(points)
    return Posterior(model, values, values[lowest], float(cost[lowest]), temperature)


def sample(
    model: CandidateModel,
    problem: Problem,
    population: NDArray[np.float64],
    temperature: float,
    generations: int,
    rng: np.random.Generator,
    left_out: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw parameters from their posterior.

    Parameters
    ----------
    model : CandidateModel
    problem : Problem
        Without frozen parameters.
    population : ndarray, shape (chains, parameters)
        Fitted coordinates that the chains start from.
    temperature : float
        By which the cost is divided: at least 1, see `noise_ratio`.
    generations : int
    rng : numpy.random.Generator
    left_out : int
        Of the generations, from the first on.

    Returns
    -------
    points : ndarray, shape (draws, parameters)
        In fitted coordinates.
    cost : ndarray, shape (draws,)
        Before tempering.
    """
    chains, k = population.shape
    low, high = model.box()
    z = np.clip(population, low, high)
    cost = costs(model, problem, z)
    kept, kept_cost = [], []
    everyone = np.arange(chains)
    for generation in range(generations):
        # two others of the population, different from each other
        one = (everyone + rng.integers(1, chains, chains)) % chains
        two = (everyone + rng.integers(1, chains, chains)) % chains
        gamma = 1.0 if generation % _JUMP_EVERY == 0 else 2.38 / np.sqrt(2 * k)
        scale = gamma * rng.uniform(0.6, 1.1, (chains, 1))
        proposal = z + scale * (z[one] - z[two]) + _NOISE * rng.standard_normal(z.shape)
        inside = ((proposal >= low) & (proposal <= high)).all(axis=1)
        new = costs(model, problem, np.clip(proposal, low, high))
        accepted = inside & (np.log(rng.random(chains)) < (cost - new) / temperature)
        z = np.where(accepted[:, None], proposal, z)
        cost = np.where(accepted, new, cost)
        if generation >= left_out:
            kept.append(z)
            kept_cost.append(cost)
    return np.concatenate(kept), np.concatenate(kept_cost)


def noise_ratio(
    residuals: Sequence[NDArray[np.float64]], trials: Sequence[TrialData], parameters: int
) -> float:
    """Power of residuals at the tones' harmonics over their power elsewhere, at least 1.

    Parameters
    ----------
    residuals : sequence of ndarray, shape (samples,) each
        In units of their noise.
    trials : sequence of TrialData
    parameters : int
        Fitted to them: so many numbers less are left of the power at the harmonics.
    """
    within, elsewhere, count, others = 0.0, 0.0, 0, 0
    for r, trial in zip(residuals, trials, strict=True):
        if not trial.frequency_hz > 0 or len(r) < 4 * len(HARMONICS):
            continue
        turn = 2 * np.pi * trial.frequency_hz * trial.step_s * trial.sample_step
        design = np.column_stack([f(n * turn) for n in HARMONICS for f in (np.sin, np.cos)])
        repeating = design @ least_squares(design, r)
        within += float(repeating @ repeating)
        elsewhere += float(np.sum((r - repeating) ** 2))
        count += design.shape[1]
        others += len(r) - design.shape[1]
    if count <= parameters or not elsewhere > 0:
        return 1.0
    return max(1.0, (within / (count - parameters)) / (elsewhere / others))
