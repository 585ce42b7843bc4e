"""Output-error identification: fit a servo model in free run from rest.

One cost serves the fit, the scores and the tests: the model is simulated under the zero-order-held,
truncated commands, looked up at the measurement time of each fresh reading, and compared with it
under a soft-L1 loss (a late poll must not steer the fit). Many fits run at once (joints, left-out
frequencies, starts) with one simulation call per iteration, which
makes pure NumPy fast enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.identify.models import CandidateModel
from pupper_sysid.sysid.identify.simulation import TrialData, moments_if_later, residuals

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
        noise = np.broadcast_to(self.noise_rad, len(self.trials))
        counts = [len(t.sample_step) * used for t, used in zip(self.trials, self.use, strict=True)]
        return np.repeat(noise, counts)


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

    @classmethod
    def of(cls, model: CandidateModel) -> _Space:
        par = model.parameters
        low, high, centre = (
            np.array([float(p.encode(getattr(p, name))) for p in par])
            for name in ("low", "high", "nominal")
        )
        return cls(low, high, centre, np.array([p.prior_sd**-2.0 for p in par]))

    def cost(self, r: NDArray, points: NDArray) -> NDArray[np.float64]:
        """Soft-L1 of residuals in units of the noise, and prior; sums over the last axes."""
        prior = 0.5 * np.sum(self.precision * (points - self.centre) ** 2, axis=-1)
        return np.sum(np.sqrt(1 + r**2) - 1, axis=-1) + prior


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
    par, space = model.parameters, _Space.of(model)
    k, low, high = len(par), space.low, space.high
    scale = np.where([p.logarithmic for p in par], 1.0, 0.01)
    z = np.array([[float(p.encode(v)) for p, v in zip(par, row, strict=True)] for row in starts])
    free = np.ones((len(problems), k), bool)
    for i, problem in enumerate(problems):
        for name, value in problem.frozen.items():
            j = model.names.index(name)
            free[i, j], z[i, j] = False, float(par[j].encode(value))
    z = np.where(free, np.clip(z, low, high), z)

    scales: dict[int, NDArray] = {id(p): p.scale() for p in problems}

    def evaluate(index: NDArray, points: NDArray, difference: float = difference):
        """Cost, gradient and curvature of the problems `index` at `points`."""
        step = difference * scale
        # the offset, last, moves every residual alike: no simulation needed for its column
        cloud = points[:, None, :] + np.concatenate([np.zeros((1, k)), np.diag(step)[:-1]])
        residuals = _residuals(model, [problems[i] for i in index], cloud)
        costs, gradients, curvatures = [], [], []
        for n, i in enumerate(index):
            noise = scales[id(problems[i])]
            r = residuals[n] / noise
            slopes = (r[1:] - r[0]).T / step[:-1]
            jacobian = np.hstack([slopes, 1.0 / noise[:, None]]) * free[i]
            weight = 1.0 / np.sqrt(1.0 + r[0] ** 2)
            pull = space.precision * (points[n] - space.centre) * free[i]
            costs.append(space.cost(r[0], points[n]))
            gradients.append(jacobian.T @ (weight * r[0]) + pull)
            curvatures.append((jacobian.T * weight) @ jacobian + np.diag(space.precision * free[i]))
        return np.array(costs), np.array(gradients), np.array(curvatures)

    everyone = np.arange(len(problems))
    cost, gradient, curvature = evaluate(everyone, z)
    damp = np.full(len(problems), 1e-2)
    stalled = np.zeros(len(problems), int)
    for _ in range(iterations):
        active = np.flatnonzero(stalled < 2)
        if not len(active):
            break
        new = z[active].copy()
        for n, i in enumerate(active):
            diagonal = np.diag(curvature[i]) + 1e-9
            # a coordinate pressed against its bound must not hold back the others
            pressed = ((z[i] <= low) & (gradient[i] > 0)) | ((z[i] >= high) & (gradient[i] < 0))
            go = free[i] & ~pressed
            matrix = curvature[i] + np.diag(damp[i] * diagonal)
            step = np.zeros(k)
            step[go] = np.linalg.solve(matrix[np.ix_(go, go)], -gradient[i][go])
            longest = np.max(np.abs(step) / scale)
            new[n] = np.clip(z[i] + step * min(1.0, 1.0 / max(longest, 1e-12)), low, high)
            new[n] = np.where(free[i], new[n], z[i])
        cost_new, gradient_new, curvature_new = evaluate(active, new)
        for n, i in enumerate(active):
            gained = cost[i] - cost_new[n]
            if gained > 0:
                z[i], cost[i] = new[n], cost_new[n]
                gradient[i], curvature[i] = gradient_new[n], curvature_new[n]
                damp[i] = max(damp[i] / 4, 1e-6)
            else:
                damp[i] = min(damp[i] * 6, 1e6)
            # 0.05 of log-likelihood is far below anything an interval would notice
            stalled[i] = stalled[i] + 1 if gained < 0.05 else 0
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
    r = _residuals(model, [problem], points[None])[0] / problem.scale()
    return _Space.of(model).cost(r, points)


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
    best = []
    for problem in problems:
        used = [t for t, use in zip(problem.trials, problem.use, strict=True) if use]
        count = sum(len(t.sample_step) for t in used)
        mean, square = np.sum([moments[id(t)] for t in used], axis=0) / count
        shifted = values.copy()
        shifted[:, 0] += TIME_STEP_S * later[np.argmin(square - mean**2, axis=0)]
        r = residuals(model, shifted, used)
        offset = -np.median(r, axis=1)
        robust = np.sqrt(1 + ((r + offset[:, None]) / problem.scale()) ** 2).sum(axis=1)
        order = np.argsort(robust)[:keep]
        chosen = shifted[order]
        chosen[:, -1] += offset[order]
        best.append(chosen)
    return np.array(best)


def _residuals(
    model: CandidateModel, problems: Sequence[Problem], points: NDArray
) -> list[NDArray]:
    """Model minus fresh reading of each problem's used trials, (candidates, samples) each."""
    values = np.stack([p.decode(points[..., j]) for j, p in enumerate(model.parameters)], axis=-1)
    groups: dict[tuple[int, tuple[bool, ...]], list[int]] = {}
    for i, problem in enumerate(problems):  # fits to the same trials are one simulation
        groups.setdefault((id(problem.trials), problem.use), []).append(i)
    found: dict[int, NDArray] = {}
    for (_, use), members in groups.items():
        used = [t for t, u in zip(problems[members[0]].trials, use, strict=True) if u]
        each = residuals(model, values[members].reshape(-1, values.shape[-1]), used)
        found.update(zip(members, each.reshape(len(members), points.shape[1], -1), strict=True))
    for i, problem in enumerate(problems):
        if problem.recorded_minus_own is not None:
            found[i] = found[i] + problem.recorded_minus_own
    return [found[i] for i in range(len(problems))]
