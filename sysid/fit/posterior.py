"""Posterior of a structure's parameters by an ensemble of Markov chains: intervals that hold.

The cost of a servo with dry friction is rugged, and many servos move alike: a long, curved ridge of
parameters explains a recording equally well. Its curvature at the optimum, or refits from there,
see one dent of it. The compiled simulation is fast enough to walk along the whole ridge instead:
`sample` draws parameters in proportion to prior and likelihood by differential evolution Markov
chains, from a population as wide as the curvature at the optimum says.

Residuals are not white; the likelihood, not the prior, is tempered by `temperature_of`: how many
readings count as one.

References
----------
ter Braak, C. J. F. (2006). A Markov chain Monte Carlo version of the genetic algorithm
differential evolution. Statistics and Computing 16: 239–249.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.tones import least_squares
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.fit.run import Run
from pupper_sysid.sysid.fit.search import Fit, Problem, curvature, local
from pupper_sysid.sysid.fit.structure import Structure

STEPPING_SD_S = 0.5 * TIME_STEP_S
"""Error of a dead time [s] that no number of readings reduces, because the model moves in steps:
standard deviation over random emulated servos with half that step."""
_STEPPING_SHARE = 0.006
"""Relative error of torques that physics steps leave, whatever the number of readings: standard
deviation over random emulated pendulums that move in other steps."""
_HARMONICS = (1, 2, 3)
_CHAINS = 32
_SETTLING, _DRAWING = 250, 250
_JUMP_EVERY = 10  # a jump by a whole difference lets chains change between optima
_NOISE = 1e-3  # of a proposal, in fitted coordinates
PHASE_SD_S = 0.0003
"""Standard deviation of the date error that all readings of a polled run share [s], about that of
the phase of a poll estimated from a few seconds."""
_DATE_DRAWS, _DATE_ITERATIONS = 24, 6
LEAST_FOLDS = 3
"""Fits without a part, below which their scatter says nothing."""
_MEDIAN_OF_NORMAL = float(ndtri(0.75))  # of the size of a standard normal number
_CURVATURE_STEP = 0.03  # the slope over a likely error, not of one kink
_OVERDISPERSED, _WIDEST = 1.5, 0.7  # of the first points, over a Gaussian's; and at most
_REMEMBERED_S = 0.5
_Z = float(ndtri(0.5 + LEVEL / 2))


def sample(
    problem: Problem,
    best: Fit,
    temperature: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw parameters from their posterior.

    Parameters
    ----------
    problem : Problem
    best : Fit
    temperature : float
        By which the cost of the readings is divided, at least 1.
    rng : numpy.random.Generator

    Returns
    -------
    points : ndarray, shape (draws, parameters)
        In fitted coordinates.
    cost : ndarray, shape (draws,)
        Tempered.
    """
    low, high = problem.structure.box

    def tempered(points: NDArray, ceiling: NDArray | float = np.inf) -> NDArray[np.float64]:
        prior = problem.prior(points)
        whole = problem.costs(points, (ceiling - prior) * temperature + prior)
        return (whole - prior) / temperature + prior

    z = np.clip(_around(problem, best, temperature, rng), low, high)
    z[0] = best.point
    chains, k = z.shape
    cost = tempered(z)
    everyone = np.arange(chains)
    kept, kept_cost = [], []
    for generation in range(_SETTLING + _DRAWING):
        one = (everyone + rng.integers(1, chains, chains)) % chains
        two = (everyone + rng.integers(1, chains, chains)) % chains
        gamma = 1.0 if generation % _JUMP_EVERY == 0 else 2.38 / np.sqrt(2 * k)
        scale = gamma * rng.uniform(0.6, 1.1, (chains, 1))
        proposal = z + scale * (z[one] - z[two]) + _NOISE * rng.standard_normal(z.shape)
        inside = ((proposal >= low) & (proposal <= high)).all(axis=1)
        most = cost - np.log(rng.random(chains))
        accepted = inside & ((new := tempered(np.clip(proposal, low, high), most)) < most)
        z = np.where(accepted[:, None], proposal, z)
        cost = np.where(accepted, new, cost)
        if generation >= _SETTLING:
            kept.append(z)
            kept_cost.append(cost)
    return np.concatenate(kept), np.concatenate(kept_cost)


def _around(
    problem: Problem, best: Fit, temperature: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Points to begin from, shape (chains, parameters), wider than a Gaussian about the optimum."""
    precision = np.diag(problem.structure.prior[1])
    bent = (curvature(problem, best.point, _CURVATURE_STEP) - precision) / temperature + precision
    values, vectors = np.linalg.eigh(bent)
    reach = np.minimum(_OVERDISPERSED / np.sqrt(np.maximum(values, 1e-12)), _WIDEST)
    return best.point + (rng.standard_normal((_CHAINS, len(values))) * reach) @ vectors.T


def temperature_of(
    residuals: Sequence[NDArray[np.float64]], runs: Sequence[Run], parameters: int
) -> float:
    """Readings per independent one, at least 1.

    What counts against a parameter is the power of residuals where its effect is. Of a tone that is
    at the tone and its harmonics: their power there over their power elsewhere. Of other motions it
    is at low frequencies: 1 + 2 Σ ρ(k), up to where the autocorrelation ρ vanishes, and no further
    than half a second, because what friction leaves for longer hardly moves with a parameter.

    Parameters
    ----------
    residuals : sequence of ndarray, shape (samples,) each
        In units of their noise.
    runs : sequence of Run
    parameters : int
        Fitted to them: so many numbers less are left of the power at the harmonics.
    """
    pairs = list(zip(residuals, runs, strict=True))
    tones = [(r, run) for r, run in pairs if run.tone > 0 and len(r) >= 4 * len(_HARMONICS)]
    if sum(len(r) for r, _ in tones) > sum(len(r) for r, _ in pairs) / 2:
        return _at_harmonics(tones, parameters)
    return _autocorrelation([(r, run) for r, run in pairs if len(r) > 1])


def _at_harmonics(tones: Sequence[tuple[NDArray, Run]], parameters: int) -> float:
    within, elsewhere, count, others = 0.0, 0.0, 0, 0
    for r, run in tones:
        turn = 2 * np.pi * run.frequency_hz * run.step_s * run.sample_step
        design = np.column_stack([f(n * turn) for n in _HARMONICS for f in (np.sin, np.cos)])
        repeating = design @ least_squares(design, r)
        within += float(repeating @ repeating)
        elsewhere += float(np.sum((r - repeating) ** 2))
        count += design.shape[1]
        others += len(r) - design.shape[1]
    if count <= parameters or not elsewhere > 0:
        return 1.0
    return max(1.0, (within / (count - parameters)) / (elsewhere / others))


def _autocorrelation(pairs: Sequence[tuple[NDArray, Run]]) -> float:
    if not pairs:
        return 1.0
    apart = np.concatenate([np.diff(run.sample_step) * run.step_s for _, run in pairs])
    longest = _REMEMBERED_S / max(float(np.median(apart)), 1e-4)
    longest = int(min(longest, min(len(r) for r, _ in pairs) - 1))
    total, lagged = 0.0, np.zeros(longest)
    for r, _ in pairs:
        x = np.clip(r, -4, 4)
        total += float(x @ x)
        for lag in range(1, longest + 1):
            lagged[lag - 1] += float(x[lag:] @ x[:-lag])
    rho = lagged / max(total, 1e-18)
    return float(max(1.0, 1.0 + 2.0 * np.sum(rho * np.cumprod(rho > 0.05))))


def with_date_errors(
    draws: NDArray[np.float64], problem: Problem, best: Fit, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draws with what it does to the optimum that the readings of each run share a date error.

    The phase of a poll is estimated for each trial, so its readings are early or late together, by
    `PHASE_SD_S`. No likelihood of independent readings knows that, and stiffness, damping and
    friction move more by it than the dead time does.

    Parameters
    ----------
    draws : ndarray, shape (draws, parameters)
    problem : Problem
    best : Fit
    rng : numpy.random.Generator
    """
    moved = []
    for _ in range(_DATE_DRAWS):
        runs = tuple(
            replace(r, sample_step=np.maximum(r.sample_step + late / r.step_s, 0.0))
            for r, late in zip(
                problem.runs, PHASE_SD_S * rng.standard_normal(len(problem.runs)), strict=True
            )
        )  # fmt: skip
        shifted = replace(problem, runs=runs)
        moved.append(local(shifted, best.point[None], _DATE_ITERATIONS, _CURVATURE_STEP)[0].point)
    apart = np.array(moved) - best.point
    return draws + apart[rng.integers(0, len(apart), len(draws))]


def as_wide_as_folds(
    draws: NDArray[np.float64],
    structure: Structure,
    best: Fit,
    folds: Sequence[Fit],
    groups: int,
) -> NDArray[np.float64]:
    """Draws spread as far about the optimum as the fits without one group of readings say.

    A likelihood takes readings for independent; those of one tone share an error of their dates,
    and of the model. The jackknife over groups does not: the variance of a number is (n - 1) times
    the mean squared difference that leaving out one of n groups makes. The median stands for the
    mean, because a number that only one tone excites is lost without that tone.

    Parameters
    ----------
    draws : ndarray, shape (draws, parameters)
    structure : Structure
    best : Fit
        To all readings.
    folds : sequence of Fit
        Without one group each.
    groups : int
        How many there are.

    References
    ----------
    Shao, J. and Tu, D. (1995). The Jackknife and Bootstrap. Springer, chapter 2.
    """
    if len(folds) < LEAST_FOLDS:
        return draws

    def wider(centre: NDArray, values: NDArray, of_folds: NDArray) -> NDArray[np.float64]:
        apart = np.median(np.abs(of_folds - centre), axis=0) / _MEDIAN_OF_NORMAL
        own = np.sqrt(np.mean((values - centre) ** 2, axis=0))
        factor = np.sqrt(groups - 1.0) * apart / np.maximum(own, 1e-12)
        return centre + (values - centre) * np.maximum(1.0, factor)

    left_out = np.array([f.point for f in folds])
    wide = wider(best.point, draws, left_out)
    # a dead time may well be close to none: of it the difference counts, not the ratio
    delay, delays, others = (structure.decode(x)[..., 0] for x in (best.point, draws, left_out))
    first = structure.parameters[0]
    wide[:, 0] = first.encode(np.clip(wider(delay, delays, others), first.low, first.high))
    return wide


# ------------------------------------------------------------------------------- intervals


def interval_of(name: str, value: float, draws: NDArray, continuous: NDArray) -> Interval:
    """Interval of one number, from its draws and what they are of a servo without steps.

    Parameters
    ----------
    name : str
    value : float
        As fitted.
    draws, continuous : ndarray, shape (draws,)
        In the fit's physics steps, and in continuous time: a step makes gains look larger.
    """
    both = [Interval.of_draws(value, x) for x in (draws, continuous)]
    low, high = min(value, *(i.low for i in both)), max(value, *(i.high for i in both))
    if name == "dead_time_s":
        grain = _Z * STEPPING_SD_S
    elif name.endswith(("hanging_rad", "offset_rad")) or value <= 0:
        return Interval(value, low, high)
    else:
        grain = _Z * _STEPPING_SHARE * value
    low, high = value - float(np.hypot(value - low, grain)), value + np.hypot(high - value, grain)
    return Interval(value, max(low, 0.0), float(high))


def in_continuous_time(
    structure: Structure, values: NDArray[np.float64], inertia: NDArray[np.float64] | float = 1.0
) -> NDArray[np.float64]:
    """Parameters (draws, parameters) of physics steps as those of a servo without steps.

    In a step h the drive acts over h / (1 + h d) at damping d over the inertia, in continuous time
    over (1 - exp(-h d')) / d' with exp(-h d') = 1 / (1 + h d): stiffness, damping and friction are
    smaller by d' / d. While the torque is clipped, the same holds with the back-EMF alone.

    Parameters
    ----------
    structure : Structure
    values : ndarray, shape (draws, parameters)
    inertia : ndarray, shape (draws,), or float
        Of armature and load; 1 without a known load.
    """
    at = {name: j for j, name in enumerate(structure.names)}
    place = {
        term: at[name] for term, names in _BRAKED.items() for name in names if name in at
    }  # fmt: skip
    if not {"stiffness", "friction", "effort"} <= place.keys():
        return values
    exact, h = values.copy(), TIME_STEP_S
    brake = np.zeros(len(values))
    if "speed" in place:
        brake = values[:, place["effort"]] / values[:, place["speed"]] / inertia
        exact[:, place["effort"]] *= _shorter(h * brake)
    damping = values[:, place["damping"]] / inertia if "damping" in place else 0.0
    total = damping + brake
    for term in ("stiffness", "friction"):
        exact[:, place[term]] *= _shorter(h * total)
    if "damping" in place:
        own = (np.log1p(h * total) - np.log1p(h * brake)) / h
        exact[:, place["damping"]] = np.maximum(own, 1e-3 * damping) * inertia
    return exact


_BRAKED = {
    "stiffness": ("stiffness", "stiffness_per_s2"), "speed": ("no_load_speed_rad_s",),
    "friction": ("friction_loss", "friction_rad_s2"), "damping": ("damping", "damping_per_s"),
    "effort": ("stall_torque", "effort_rad_s2"),
}  # fmt: skip


def _shorter(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(x > 1e-9, np.log1p(x) / np.maximum(x, 1e-9), 1.0)
