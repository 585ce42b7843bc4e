"""Output-error fit of a loaded servo to all of its runs, and the posterior of its parameters.

One cost serves the search, the local fit and the posterior: free runs against the readings, under a
soft-L1 loss in units of each run's noise, plus wide priors. All candidates are simulated abreast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.loaded.runs import Run, costs, residuals
from pupper_sysid.sysid.loaded.structures import Structure

_CANDIDATES, _KEEP, _FINAL = 1024, 12, 4
_SHORT, _LONG = 8, 20  # iterations of the local fit
_WIDE_STEP, _STEP = 0.05, 0.01  # of the Jacobian, in fitted coordinates
_LINEAR = 0.02  # scale of coordinates that are no logarithms
_POPULATION, _GENERATIONS, _SHORT_GENERATIONS = 48, 80, 30
_CHAINS, _SETTLING, _DRAWING = 32, 120, 120
_LARGEST_BATCH = 4_000_000  # residuals at once
_TOGETHER = 64  # starts


@dataclass(frozen=True)
class Problem:
    """One fit.

    Attributes
    ----------
    structure : Structure
    runs : tuple of Run
    noise_rad : tuple of float
        Of each run.
    """

    structure: Structure
    runs: tuple[Run, ...]
    noise_rad: tuple[float, ...]

    def scaled(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals in units of their noise, shape (candidates, samples)."""
        found = residuals(self.structure, self.structure.decode(points), self.runs)
        return np.concatenate([r / s for r, s in zip(found, self.noise_rad, strict=True)], axis=1)

    def prior(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minus the logarithm of the prior."""
        centre, sd = self.structure.prior
        return 0.5 * np.sum(((points - centre) / sd) ** 2, axis=-1)

    def run_costs(
        self, columns: NDArray[np.float64], dead_time_s: NDArray[np.float64], index: int
    ) -> NDArray[np.float64]:
        """Cost of candidates on the run `index`."""
        return costs(columns, dead_time_s, self.runs[index], self.noise_rad[index])

    def costs(
        self, points: NDArray[np.float64], ceiling: NDArray[np.float64] | float = np.inf
    ) -> NDArray[np.float64]:
        """Cost of each of `points` (candidates, parameters).

        Parameters
        ----------
        points : ndarray, shape (candidates, parameters)
        ceiling : ndarray, shape (candidates,), or float
            A candidate that costs as much after some runs is not simulated on the others; its cost
            is what it had by then.
        """
        found = self.prior(points)
        values = self.structure.decode(points)
        columns = self.structure.columns(values)
        for index in range(len(self.runs)):
            (left,) = np.nonzero(found < ceiling)
            found[left] += self.run_costs(columns[left], values[left, 0], index)
        return found


@dataclass(frozen=True)
class Fit:
    """Result of one problem: its point in fitted coordinates, and the cost there."""

    point: NDArray[np.float64]
    cost: float


def search(
    problem: Problem, rng: np.random.Generator, more: NDArray[np.float64] | None = None
) -> list[Fit]:
    """Fits from the best of many starts, best first.

    Parameters
    ----------
    problem : Problem
    rng : numpy.random.Generator
    more : ndarray, shape (starts, parameters), optional
        Further starts, in fitted coordinates.
    """
    starts = _sobol(problem.structure, rng, _CANDIDATES)
    best = _cheapest(problem, starts, _KEEP)
    if more is not None:
        best = np.concatenate([best, more])
    rough = _local(problem, best, _SHORT, _WIDE_STEP)
    order = sorted(rough, key=lambda f: f.cost)[:_FINAL]
    final = _local(problem, np.array([f.point for f in order]), _LONG, _STEP)
    return sorted([*final, *order], key=lambda f: f.cost)


def refine(problem: Problem, points: NDArray[np.float64]) -> Fit:
    """The best local fit from some points."""
    return min(_local(problem, points, _LONG, _STEP), key=lambda f: f.cost)


def evolve(
    problem: Problem, fits: Sequence[Fit], rng: np.random.Generator, short: bool = False
) -> Fit:
    """The best of a population that starts around `fits` and evolves, fitted to the end."""
    low, high = problem.structure.box
    seeds = np.array([f.point for f in fits])
    spread = np.where(problem.structure.logarithmic, 0.3, 0.5 * _LINEAR)
    around = seeds[rng.integers(0, len(seeds), _POPULATION)]
    z = np.clip(around + spread * rng.standard_normal(around.shape), low, high)
    z[: len(seeds)] = seeds[:_POPULATION]
    cost = problem.costs(z)
    everyone = np.arange(len(z))
    for _ in range(_SHORT_GENERATIONS if short else _GENERATIONS):
        one, two = (rng.permutation(everyone) for _ in range(2))
        toward = z[np.argsort(cost)[rng.integers(0, 6, len(z))]]
        factor = rng.uniform(0.4, 0.9, (len(z), 1))
        trial = z + factor * (toward - z) + factor * (z[one] - z[two])
        keep = rng.random(z.shape) > 0.9
        trial = np.clip(np.where(keep, z, trial), low, high)
        new = problem.costs(trial, cost)
        better = new < cost
        z[better], cost[better] = trial[better], new[better]
    return min(refine(problem, z[np.argsort(cost)[:2]]), *fits, key=lambda f: f.cost)


def sample(
    problem: Problem, best: Fit, temperature: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw parameters from their posterior by differential evolution Markov chains.

    ter Braak (2006), Statistics and Computing 16: 239–249, as in `sysid.identify.posterior`.

    Parameters
    ----------
    problem : Problem
    best : Fit
    temperature : float
        By which the cost of the readings is divided, at least 1: how many of them count as one.
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

    k = len(low)
    spread = np.where(problem.structure.logarithmic, 0.1, 0.1 * _LINEAR)
    z = np.clip(best.point + spread * rng.standard_normal((_CHAINS, k)), low, high)
    z[0] = best.point
    cost = tempered(z)
    everyone = np.arange(_CHAINS)
    kept, kept_cost = [], []
    for generation in range(_SETTLING + _DRAWING):
        one = (everyone + rng.integers(1, _CHAINS, _CHAINS)) % _CHAINS
        two = (everyone + rng.integers(1, _CHAINS, _CHAINS)) % _CHAINS
        gamma = 1.0 if generation % 10 == 0 else 2.38 / np.sqrt(2 * k)
        scale = gamma * rng.uniform(0.6, 1.1, (_CHAINS, 1))
        proposal = z + scale * (z[one] - z[two]) + 1e-3 * rng.standard_normal(z.shape)
        inside = ((proposal >= low) & (proposal <= high)).all(axis=1)
        most = cost - np.log(rng.random(_CHAINS))
        accepted = inside & ((new := tempered(np.clip(proposal, low, high), most)) < most)
        z = np.where(accepted[:, None], proposal, z)
        cost = np.where(accepted, new, cost)
        if generation >= _SETTLING:
            kept.append(z)
            kept_cost.append(cost)
    return np.concatenate(kept), np.concatenate(kept_cost)


def _sobol(structure: Structure, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Points that fill the prior's middle, shape (count, parameters)."""
    from scipy.stats import qmc  # half a second to import

    low, high = structure.box
    centre, sd = structure.prior
    reach = np.where(structure.logarithmic, 1.5 * sd, 0.5 * sd)
    low, high = np.maximum(low, centre - reach), np.minimum(high, centre + reach)
    unit = qmc.Sobol(len(low), rng=rng).random(count)
    points = low + unit * (high - low)
    points[0] = centre
    return points


def _cheapest(problem: Problem, points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """The `count` points of the lowest cost, the cheapest first; most others are given up early."""
    found = np.full(len(points), np.inf)
    for first in range(0, len(points), _TOGETHER):
        part = slice(first, first + _TOGETHER)
        found[part] = problem.costs(points[part], np.partition(found, count - 1)[count - 1])
    return points[np.argsort(found)[:count]]


def _local(
    problem: Problem, starts: NDArray[np.float64], iterations: int, difference: float
) -> list[Fit]:
    """Levenberg-Marquardt from every start, all abreast."""
    structure = problem.structure
    low, high = structure.box
    centre, sd = structure.prior
    k = len(low)
    scale = np.where(structure.logarithmic, 1.0, _LINEAR)
    step = difference * scale

    def evaluate(z: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Cost, gradient and curvature at points (starts, parameters)."""
        away = np.where(z + step > high, -1.0, 1.0) * step
        cloud = np.repeat(z[:, None, :], k + 1, axis=1)
        cloud[:, 1:, :] += away[:, None, :] * np.eye(k)
        costs, gradients, curvatures = [], [], []
        samples = sum(len(r.sample_step) for r in problem.runs)
        together = max(1, _LARGEST_BATCH // max(samples * (k + 1), 1))
        for first in range(0, len(z), together):
            part = cloud[first : first + together]
            r = problem.scaled(part.reshape(-1, k)).reshape(len(part), k + 1, -1)
            for n in range(len(part)):
                here = z[first + n]
                jacobian = (r[n, 1:] - r[n, 0]) / away[first + n][:, None]
                weight = 1.0 / np.sqrt(1.0 + r[n, 0] ** 2)
                costs.append(np.sum(np.sqrt(1.0 + r[n, 0] ** 2) - 1.0) + problem.prior(here))
                gradients.append(jacobian @ (weight * r[n, 0]) + (here - centre) / sd**2)
                curvatures.append((jacobian * weight) @ jacobian.T + np.diag(sd**-2.0))
        return np.array(costs), np.array(gradients), np.array(curvatures)

    z = np.clip(starts, low, high)
    cost, gradient, curvature = evaluate(z)
    damp, stalled = np.full(len(z), 1e-2), np.zeros(len(z), int)
    for _ in range(iterations):
        active = np.flatnonzero(stalled < 3)
        if not len(active):
            break
        new = z[active].copy()
        for n, i in enumerate(active):
            pressed = ((z[i] <= low) & (gradient[i] > 0)) | ((z[i] >= high) & (gradient[i] < 0))
            go = ~pressed
            matrix = curvature[i] + np.diag(damp[i] * (np.diag(curvature[i]) + 1e-9))
            move = np.zeros(k)
            move[go] = np.linalg.solve(matrix[np.ix_(go, go)], -gradient[i][go])
            longest = np.max(np.abs(move) / scale)
            new[n] = np.clip(z[i] + move * min(1.0, 1.0 / max(longest, 1e-12)), low, high)
        cost_new, gradient_new, curvature_new = evaluate(new)
        for n, i in enumerate(active):
            gained = cost[i] - cost_new[n]
            if gained > 0:
                z[i], cost[i] = new[n], cost_new[n]
                gradient[i], curvature[i] = gradient_new[n], curvature_new[n]
                damp[i] = max(damp[i] / 4, 1e-6)
            else:
                damp[i] = min(damp[i] * 6, 1e6)
            stalled[i] = stalled[i] + 1 if gained < 1e-4 * cost[i] + 0.02 else 0
    return [Fit(point, float(c)) for point, c in zip(z, cost, strict=True)]
