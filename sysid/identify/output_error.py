"""Output-error identification: fit a servo model in free run from rest.

One cost serves the fit, the scores and the tests: the model is simulated under the zero-order-held,
truncated commands, looked up at the measurement time of each fresh reading, and compared with it
under a soft-L1 loss (a late poll must not steer the fit). Many fits run at once (joints, left-out
frequencies, starts) with one simulation call per iteration, which
makes pure NumPy fast enough.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.identify.candidates.models import CandidateModel
from pupper_sysid.sysid.identify.candidates.simulation import TrialData, moments_if_later, residuals

DIFFERENCE = 0.01  # relative step of the Jacobian; smaller ones drown in friction's stick-slip
_WIDE_DIFFERENCE = 0.03  # for the covariance: the slope over a likely error, not of one kink
_DELAY_GRID = 2.0  # steps between the delays tried for a start
_DENSE_DELAYS, _LONG_DELAYS = 40.0, 34  # steps up to which they are dense; how many beyond


@dataclass(frozen=True)
class Problem:
    """One fit: some trials of one joint (`use`), some parameters perhaps frozen.

    Attributes
    ----------
    trials : tuple of TrialData
    use : tuple of bool
        Which trials count in the fit.
    noise_rad : float or tuple of float
        Scale of the residuals, of all or per trial: the soft-L1 loss bends here, the prior is
        weighed against it.
    frozen : dict of str to float
        Parameters held at a value.
    recorded_minus_own : ndarray, optional, shape (samples of the used trials,)
        For a synthetic recording with other readings at the same times [rad].
    """

    trials: tuple[TrialData, ...]
    use: tuple[bool, ...]
    noise_rad: float | tuple[float, ...]
    frozen: dict[str, float]
    recorded_minus_own: NDArray[np.float64] | None = None

    def scale(self) -> NDArray[np.float64]:
        """Noise of each reading of the used trials [rad]."""
        return self._scale

    @cached_property
    def _scale(self) -> NDArray[np.float64]:
        noise = np.broadcast_to(self.noise_rad, len(self.trials))
        counts = [len(t.sample_step) * used for t, used in zip(self.trials, self.use, strict=True)]
        return np.repeat(noise, counts)

    @property
    def used(self) -> list[TrialData]:
        """The trials that count."""
        return [t for t, use in zip(self.trials, self.use, strict=True) if use]


@dataclass(frozen=True)
class Fit:
    """Result of one problem.

    Attributes
    ----------
    values : ndarray, shape (parameters,)
    cost : float
        Half the sum of robust squared residuals in units of the noise, plus the prior.
    covariance : ndarray, shape (parameters, parameters)
        Of the fitted coordinates (logarithms), for independent residuals of the noise's size.
    """

    values: NDArray[np.float64]
    cost: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True)
class _Space:
    """A model's fitted coordinates: their bounds and prior, arrays of shape (parameters,)."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    centre: NDArray[np.float64]
    precision: NDArray[np.float64]

    def cost(self, r: NDArray, points: NDArray) -> NDArray[np.float64]:
        """Soft-L1 of residuals in units of the noise, and prior; sums over the last axes."""
        prior = 0.5 * np.sum(self.precision * (points - self.centre) ** 2, axis=-1)
        return np.sum(np.sqrt(1 + r**2) - 1, axis=-1) + prior


@cache
def _space(model: CandidateModel) -> _Space:
    par = model.parameters
    low, high, centre = (
        np.array([float(p.encode(getattr(p, name))) for p in par])
        for name in ("low", "high", "nominal")
    )
    return _Space(low, high, centre, np.array([p.prior_sd**-2.0 for p in par]))


def fit(
    model: CandidateModel,
    problems: Sequence[Problem],
    starts: NDArray,
    iterations: int = 40,
    difference: float = DIFFERENCE,
) -> list[Fit]:
    """Levenberg-Marquardt on all problems at once.

    Parameters
    ----------
    model : CandidateModel
    problems : sequence of Problem
    starts : ndarray, shape (problems, parameters)
        Values to start from.
    iterations : int
        At most; problems that no longer improve drop out.
    difference : float
        Step of the Jacobian in fitted coordinates: a wide one looks past a rugged cost's dents.

    Returns
    -------
    list of Fit, one per problem
    """
    par, space = model.parameters, _space(model)
    k, low, high = len(par), space.low, space.high
    scale = np.where([p.logarithmic for p in par], 1.0, 0.01)
    z = np.array([[float(p.encode(v)) for p, v in zip(par, row, strict=True)] for row in starts])
    free = np.ones((len(problems), k), bool)
    for i, problem in enumerate(problems):
        for name, value in problem.frozen.items():
            j = model.names.index(name)
            free[i, j], z[i, j] = False, float(par[j].encode(value))
    z = np.where(free, np.clip(z, low, high), z)

    def evaluate(index: NDArray, points: NDArray, difference: float = difference):
        """Cost, gradient and curvature of the problems `index` at `points`."""
        step = difference * scale
        # the offset, last, moves every residual alike: no simulation needed for its column
        cloud = points[:, None, :] + np.concatenate([np.zeros((1, k)), np.diag(step)[:-1]])
        cost, gradient = np.empty(len(index)), np.empty((len(index), k))
        curvature = np.empty((len(index), k, k))
        for at, errors in _residuals(model, [problems[i] for i in index], cloud):
            noise = np.stack([problems[i].scale() for i in index[at]])
            r, variable = errors / noise[:, None], free[index[at]]
            jacobian = np.empty((len(at), k, noise.shape[1]))
            jacobian[:, :-1] = (r[:, 1:] - r[:, :1]) / step[:-1, None]
            jacobian[:, -1] = 1.0 / noise
            jacobian *= variable[:, :, None]
            weighted = jacobian / np.sqrt(1.0 + r[:, :1] ** 2)
            pull = space.precision * (points[at] - space.centre)
            cost[at] = space.cost(r[:, 0], points[at])
            gradient[at] = (weighted @ r[:, 0, :, None])[..., 0] + pull * variable
            curvature[at] = (
                weighted @ jacobian.mT + np.eye(k) * (space.precision * variable)[:, None]
            )
        return cost, gradient, curvature

    everyone = np.arange(len(problems))
    cost, gradient, curvature = evaluate(everyone, z)
    damp = np.full(len(problems), 1e-2)
    stalled = np.zeros(len(problems), int)
    for _ in range(iterations):
        active = np.flatnonzero(stalled < 2)
        if not len(active):
            break
        here, slope, bent = z[active], gradient[active], curvature[active]
        # a coordinate pressed against its bound must not hold back the others
        pressed = ((here <= low) & (slope > 0)) | ((here >= high) & (slope < 0))
        go = free[active] & ~pressed
        diagonal = np.diagonal(bent, axis1=1, axis2=2) + 1e-9
        matrix = bent + np.eye(k) * (damp[active, None] * diagonal)[:, None]
        matrix = np.where(go[:, :, None] & go[:, None], matrix, np.eye(k))
        step = np.linalg.solve(matrix, np.where(go, -slope, 0.0)[..., None])[..., 0]
        longest = np.max(np.abs(step) / scale, axis=1, keepdims=True)
        new = np.clip(here + step * np.minimum(1.0, 1.0 / np.maximum(longest, 1e-12)), low, high)
        new = np.where(free[active], new, here)
        cost_new, gradient_new, curvature_new = evaluate(active, new)
        gained = cost[active] - cost_new
        better = gained > 0
        moved = active[better]
        z[moved], cost[moved] = new[better], cost_new[better]
        gradient[moved], curvature[moved] = gradient_new[better], curvature_new[better]
        damp[active] = np.where(
            better, np.maximum(damp[active] / 4, 1e-6), np.minimum(damp[active] * 6, 1e6)
        )
        # 0.05 of log-likelihood is far below anything an interval would notice
        stalled[active] = np.where(gained < 0.05, stalled[active] + 1, 0)
    fits = []
    curvature = evaluate(everyone, z, _WIDE_DIFFERENCE)[2]
    for i in everyone:
        regular = curvature[i] + np.diag(np.where(free[i], 1e-9, 1.0))
        covariance = np.linalg.pinv(regular) * np.outer(free[i], free[i])
        values = np.array([float(p.decode(v)) for p, v in zip(par, z[i], strict=True)])
        fits.append(Fit(values, float(cost[i]), covariance))
    return fits


def evolve(
    model: CandidateModel,
    problem: Problem,
    starts: NDArray,
    rng: np.random.Generator,
    generations: int,
) -> tuple[Fit, NDArray[np.float64]]:
    """The best of a population that starts at `starts` and evolves, fitted to the end.

    Differential evolution finds its way between the local optima of a servo with dry friction,
    where a gradient does not.

    Parameters
    ----------
    model : CandidateModel
    problem : Problem
        Without frozen parameters.
    starts : ndarray, shape (population, parameters)
    rng : numpy.random.Generator
    generations : int

    Returns
    -------
    Fit
    ndarray, shape (population, parameters)
        The last population, in fitted coordinates.
    """
    low, high = model.box()
    # SciPy's annotations know names of methods only
    population: Any = np.clip(model.encode(starts), low, high)
    found = differential_evolution(
        lambda points: costs(model, problem, points.T), list(zip(low, high, strict=True)),
        init=population, rng=rng, maxiter=generations, mutation=(0.4, 0.9), recombination=0.9,
        tol=0.0, polish=False, vectorized=True, updating="deferred",
    )  # fmt: skip
    return fit(model, [problem], model.decode(found.x)[None])[0], found.population


def costs(
    model: CandidateModel, problem: Problem, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Cost of each of `points`, which are fitted coordinates (candidates, parameters)."""
    r = residuals(model, model.decode(points), problem.used)
    if problem.recorded_minus_own is not None:
        r = r + problem.recorded_minus_own
    return _space(model).cost(r / problem.scale(), points)


def global_starts(
    model: CandidateModel,
    problems: Sequence[Problem],
    rng: np.random.Generator,
    candidates: int,
    keep: int,
) -> NDArray[np.float64]:
    """The `keep` best of `candidates` quasi-random parameter vectors, per problem.

    The vectors fill the box of fitted coordinates, within two standard deviations of the prior
    where there is one. Each gets its best delay and offset: a delay only shifts the motion in time,
    so that one simulation serves all delays and the most rugged coordinate is not searched.

    Returns
    -------
    ndarray, shape (problems, keep, parameters)
    """
    par = model.parameters
    from scipy.stats import qmc  # half a second to import

    unit = qmc.Sobol(len(par), rng=rng).random(candidates)
    columns = []
    for p, u in zip(par, unit.T, strict=True):
        low, high = float(p.encode(p.low)), float(p.encode(p.high))
        if np.isfinite(p.prior_sd):
            middle = float(p.encode(p.nominal))
            low, high = max(low, middle - 2 * p.prior_sd), min(high, middle + 2 * p.prior_sd)
        elif p.name == "offset_rad":
            low = high = 0.0
        columns.append(low + u * (high - low))
    cloud = np.stack(columns, axis=1)
    cloud[0] = [float(p.encode(p.nominal)) for p in par]
    values = np.stack([p.decode(c) for p, c in zip(par, cloud.T, strict=True)], axis=-1)
    values[:, 0] = par[0].low
    longest = (par[0].high - par[0].low) / TIME_STEP_S
    # as dense as a twentieth of the delay, and never denser than two steps
    later = np.unique(np.concatenate([
        np.arange(0.0, min(longest, _DENSE_DELAYS), _DELAY_GRID),
        np.geomspace(_DENSE_DELAYS, max(longest, _DENSE_DELAYS), _LONG_DELAYS).round(),
    ]))  # fmt: skip
    every = {id(trial): trial for problem in problems for trial in problem.trials}
    moments = {key: np.array(moments_if_later(model, values, t, later)) for key, t in every.items()}
    seen = {key: _Shifted(model, values, TIME_STEP_S * later, t) for key, t in every.items()}
    best = []
    for problem in problems:
        used = problem.used
        count = sum(len(t.sample_step) for t in used)
        mean, square = np.sum([moments[id(t)] for t in used], axis=0) / count
        delay = np.argmin(square - mean**2, axis=0)
        shifted = values.copy()
        shifted[:, 0] += TIME_STEP_S * later[delay]
        r = np.concatenate([seen[id(t)].at(delay) for t in used], axis=1)
        offset = -np.median(r, axis=1)
        robust = np.sqrt(1 + ((r + offset[:, None]) / problem.scale()) ** 2).sum(axis=1)
        order = np.argsort(robust)[:keep]
        chosen = shifted[order]
        chosen[:, -1] += offset[order]
        best.append(chosen)
    return np.array(best)


class _Shifted:
    """Residuals of candidates on one trial with delays added, each simulated once.

    Problems share most trials and most of the delays that suit a candidate best.
    """

    def __init__(
        self, model: CandidateModel, values: NDArray, later_s: NDArray, trial: TrialData
    ) -> None:
        self._model, self._values, self._later_s, self._trial = model, values, later_s, trial
        self._delay = np.full(len(values), -1)
        self._found = np.empty((len(values), len(trial.sample_step)))

    def at(self, delay: NDArray[np.int64]) -> NDArray[np.float64]:
        """Residuals (candidates, samples) with delay number `delay` of each candidate.

        The array is overwritten by the next call.
        """
        new = np.flatnonzero(delay != self._delay)
        if len(new):
            moved = self._values[new].copy()
            moved[:, 0] += self._later_s[delay[new]]
            self._found[new] = residuals(self._model, moved, [self._trial])
            self._delay[new] = delay[new]
        return self._found


def _residuals(
    model: CandidateModel, problems: Sequence[Problem], points: NDArray
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Model minus fresh reading: places of problems of the same trials, and residuals of each.

    The residuals are (problems, candidates, samples). Fits to the same trials are one simulation.
    """
    values = model.decode(points)
    groups: dict[tuple[int, tuple[bool, ...]], list[int]] = {}
    for i, problem in enumerate(problems):
        groups.setdefault((id(problem.trials), problem.use), []).append(i)
    for members in groups.values():
        flat = values[members].reshape(-1, values.shape[-1])
        each = residuals(model, flat, problems[members[0]].used)
        found = each.reshape(len(members), points.shape[1], -1)
        for n, i in enumerate(members):
            more = problems[i].recorded_minus_own
            if more is not None:
                found[n] += more
        yield np.array(members), found
