"""Output-error fit of one structure to runs: global starts, local fits, evolution, folds.

One cost serves the search, the local fit, the folds and the posterior: free runs against the
readings that count, under a soft-L1 loss in units of each run's noise (a late poll must not steer
the fit), plus wide priors. All candidates are simulated abreast.

The cost of a servo with dry friction has many local optima along ridges (delay trades against
damping, friction against effort). So many seeded starts are simulated once, the best are improved a
little, the best of those are fitted to convergence, a population evolves around them, and local
fits from points about the best go on until none is better. A structure that contains another one
starts from its fit, too, so that it never costs more.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.fit.goodness import temperature_of
from pupper_sysid.sysid.fit.run import Run, costs, fresh_residuals, moments_if_later, residuals
from pupper_sysid.sysid.fit.structure import LIMITS, Structure

_CANDIDATES, _KEEP, _FINAL = 512, 12, 4
_REFINED = 2  # of the fits in coarse steps, those that are fitted in fine ones
_SHORT, _LONG = 8, 20  # iterations of the local fit
_WIDE_STEP, _STEP = 0.05, 0.01
"""Steps of the Jacobian in fitted coordinates: a wide one looks past a rugged cost's dents, one
smaller than the second drowns in friction's stick-slip."""
_POPULATION, _LEADERS = 48, 12
_GENERATIONS, _SHORT_GENERATIONS = (600, 60), (200, 20)
"""Members of the population, and those the others move toward. Generations at most, and how many
without a better member end it: of a search, and of a short one."""
LEAVES_MOTION, _FINE_ROUNDS = 1.5, 2
"""Temperature above which a fit in free air leaves motion, not noise: 0.6 to 1.2 of the best fits
to servos of the fitted structure. Populations in fine steps then, at most."""
_NEAR, _NEAR_ROUNDS, _NEAR_ITERATIONS = 12, 12, 12
_FALLS, _CUT_STARTS = -np.linspace(0.0, np.log(30.0), 15), 3  # of the logarithm of a limit
_FAR_ABOVE = 10.0  # from a limit to one that no motion reaches
_NEAR_SD, _NEAR_STEP = (0.02, 0.5), 0.02
"""Of the local fits about the best one: how many in a round, rounds at most, iterations, standard
deviation of their starts and step of the Jacobian in fitted coordinates."""
_SEARCHED_STEPS = 15_000
"""What a search simulates of all runs together, if there is more: 30 s in steps of 2 ms, as of a
sweep of ten tones."""
_LARGEST_BATCH = 4_000_000  # residuals at once
_LEAST_GAIN = 0.05  # of log-likelihood: far below anything that an interval would notice
_DELAY_GRID = 2.0  # steps between the delays tried for a start
_DENSE_DELAYS, _LONG_DELAYS = 40.0, 34  # steps up to which they are dense; how many beyond
_START_RAD = 0.3  # offset within which a start may lie where no prior says so
_MOST_FOLDS = 6
_BLOCKS = 4
_FOLD_DRAWS, _FOLD_STARTS = 512, 6


@dataclass(frozen=True)
class Problem:
    """One fit.

    Attributes
    ----------
    structure : Structure
    runs : tuple of Run
    noise_rad : tuple of float
        Of each run: the soft-L1 loss bends here, the prior is weighed against it.
    recordings : int
        How many have had their differences taken from their readings; each cost as many numbers
        as the structure has.
    whole : bool
        Whether the runs have all of their readings.
    """

    structure: Structure
    runs: tuple[Run, ...]
    noise_rad: tuple[float, ...]
    recordings: int = 1
    whole: bool = True

    @cached_property
    def samples(self) -> int:
        """Readings that count."""
        return sum(len(r.sample_step) for r in self.runs)

    def scaled(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals in units of their noise, shape (candidates, samples)."""
        parts = residuals(self.structure, self.structure.decode(points), self.runs)
        scaled = [r / s for r, s in zip(parts, self.noise_rad, strict=True)]
        return np.concatenate([np.empty((len(points), 0)), *scaled], axis=1)

    def prior(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minus the logarithm of the prior."""
        return self.structure.prior_cost(points)

    def costs(
        self, points: NDArray[np.float64], ceiling: NDArray[np.float64] | float = np.inf
    ) -> NDArray[np.float64]:
        """Cost of each of `points` (candidates, parameters).

        `points` of shape (candidates, parameters). `ceiling` of shape (candidates,): a candidate
        that costs as much after some runs is not simulated on the others; its cost is what it had
        by then.
        """
        cost = self.prior(points)
        values = self.structure.decode(points)
        columns = self.structure.columns(values)
        for run, noise in zip(self.runs, self.noise_rad, strict=True):
            (below,) = np.nonzero(cost < ceiling)
            if not len(below):
                break
            cost[below] += costs(self.structure, columns[below], values[below, 0], run, noise)
        return cost

    def costs_by_run(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of the readings of each run, without the prior, shape (runs, candidates)."""
        values = self.structure.decode(points)
        columns = self.structure.columns(values)
        return np.array([
            costs(self.structure, columns, values[:, 0], run, noise)
            for run, noise in zip(self.runs, self.noise_rad, strict=True)
        ])  # fmt: skip

    @cached_property
    def excerpt(self) -> Problem:
        """The same fit to the readings that a search needs (`Run.excerpts`)."""
        if not self.whole:
            return self
        steps = _SEARCHED_STEPS / max(len(self.runs), 1)
        parts = [run.excerpts(steps * run.step_s) for run in self.runs]
        if all(part[0] is run for part, run in zip(parts, self.runs, strict=True)):
            return self
        noise = [(s,) * len(part) for s, part in zip(self.noise_rad, parts, strict=True)]
        return replace(
            self, runs=tuple(itertools.chain(*parts)), noise_rad=tuple(itertools.chain(*noise)),
            whole=False,
        )  # fmt: skip

    @cached_property
    def coarse(self) -> Problem:
        """The excerpt in longer steps (`Run.coarser`): twice the length, no shorter than usual."""
        return replace(
            self.excerpt, runs=tuple(_coarse(run) for run in self.excerpt.runs), whole=False
        )

    def only(self, use: Sequence[bool] | NDArray[np.bool_]) -> Problem:
        """The same fit to some of the runs."""
        kept = [i for i, used in enumerate(use) if used]
        return replace(
            self, runs=tuple(self.runs[i] for i in kept),
            noise_rad=tuple(self.noise_rad[i] for i in kept),
        )  # fmt: skip


def _coarse(run: Run) -> Run:
    longer = run.coarser()
    return longer if longer.step_s > (1.0 - 1e-9) * TIME_STEP_S else _coarse(longer)


@dataclass(frozen=True)
class Fit:
    """Result of one problem.

    Attributes
    ----------
    point : ndarray, shape (parameters,)
        In fitted coordinates.
    cost : float
        Half the sum of robust squared residuals in units of the noise, plus the prior.
    """

    point: NDArray[np.float64]
    cost: float


def temperature_at(problem: Problem, fit: Fit) -> float:
    """The temperature of a fit's own residuals."""
    values = problem.structure.decode(fit.point)
    residuals = fresh_residuals(problem.structure, values, problem.runs)
    scaled = [r / noise for r, noise in zip(residuals, problem.noise_rad, strict=True)]
    return temperature_of(scaled, problem.runs, problem.recordings * len(values))


def price_of_a_number(problem: Problem, fit: Fit) -> float:
    """By how much a further number must lower the cost of a fit: Schwarz's criterion."""
    return float(0.5 * np.log(problem.samples) * temperature_at(problem, fit))


def search(
    problem: Problem,
    rng: np.random.Generator,
    more: NDArray[np.float64] | None = None,
    keep: int = _KEEP,
    final: int = _FINAL,
) -> list[Fit]:
    """Fits from the best of many starts, best first.

    `more` of shape (starts, parameters): further starts, in fitted coordinates. `keep`: how many of
    the starts are improved a little. `final`: how many of those are fitted to the end.
    """
    starts = Starts(problem.coarse, rng).best(keep)
    if more is not None and len(more):
        starts = np.concatenate([starts, more])
    rough = refined(problem.coarse, starts, final)[:_REFINED]
    fits = local(problem, np.array([f.point for f in rough]), _LONG, _STEP)
    return sorted(fits, key=lambda f: f.cost)


def search_widely(
    problem: Problem,
    rng: np.random.Generator,
    more: NDArray[np.float64] | None = None,
    short: bool = False,
) -> Fit:
    """The best fit of `search`, then of a population of its starts that evolves.

    `more` of shape (starts, parameters): further starts, in fitted coordinates. `short`: fewer
    generations.
    """
    crowd = Starts(problem.coarse, rng).best(_POPULATION)
    starts = crowd[:_KEEP]
    if more is not None and len(more):
        starts = np.concatenate([starts, more])
    return evolved(problem, starts, rng, short, crowd)


def evolved(
    problem: Problem,
    starts: NDArray[np.float64],
    rng: np.random.Generator,
    short: bool = False,
    crowd: NDArray[np.float64] | None = None,
) -> Fit:
    """The best fit from starts, searched in coarse steps and fitted to the end in fine ones.

    `starts` of shape (starts, parameters): in fitted coordinates; those of simpler structures are
    kept as they are, too. `crowd`: as for `evolve`.
    """
    best = evolve(problem.coarse, refined(problem.coarse, starts), rng, short, crowd)
    near = np.concatenate([best.point[None], starts[-_FINAL:]])
    best = refine(problem, near[np.argsort(problem.costs(near))[:_REFINED]])
    for _ in range(_FINE_ROUNDS if problem.structure.scales.free_air else 0):
        if temperature_at(problem, best) <= LEAVES_MOTION:
            break
        # a stiff servo at its limits moves otherwise in coarse steps
        evolved_fit = evolve(problem.excerpt, [best], rng, short, near)
        best = min(best, refine(problem, evolved_fit.point[None]), key=lambda f: f.cost)
    return from_about(problem, with_limits(problem, best), rng)


def from_about(problem: Problem, best: Fit, rng: np.random.Generator) -> Fit:
    """The best of local fits from points about the best one, until a round finds none better.

    A ridge has dents in which a local fit ends; in coarse steps they lie elsewhere. In free air
    only: the structures under load have so many numbers that a better optimum predicts worse.
    """
    if not problem.structure.scales.free_air:
        return best
    excerpt = problem.excerpt
    if excerpt is not problem:
        about = from_about(excerpt, refine(excerpt, best.point[None]), rng)
        return min(best, refine(problem, about.point[None]), key=lambda f: f.cost)
    low, high = problem.structure.box
    shape, (least, most) = (_NEAR, len(best.point)), np.log(_NEAR_SD)
    for _ in range(_NEAR_ROUNDS):
        sd = np.exp(rng.uniform(least, most, (_NEAR, 1))) * problem.structure.scale
        near = np.clip(best.point + sd * rng.standard_normal(shape), low, high)
        fits = local(problem, near, _NEAR_ITERATIONS, _NEAR_STEP)
        before, best = best.cost, min(best, *fits, key=lambda f: f.cost)
        if before - best.cost < 1.0:  # one more number's worth
            break
    return best


def with_limits(problem: Problem, best: Fit) -> Fit:
    """The better of a fit and of local fits from where a limit would begin to cut its motion.

    A limit that the motion does not reach has no slope, so that no local fit leads to a servo at
    its limit. A known load tells torques from inertia, and the search finds such limits.
    """
    if problem.structure.scales.known_load:
        return best
    point, names = best.point, problem.structure.names
    limits = [names.index(name) for name in LIMITS if name in names]
    points = np.tile(point, (len(limits), len(_FALLS), 1))
    for n, limit in enumerate(limits):
        points[n, :, limit] += _FALLS
    points = np.clip(points, *problem.structure.box)
    every = points.reshape(-1, len(point))
    costs = (problem.costs(every) - problem.prior(every)).reshape(len(limits), -1)
    cut = costs > costs[:, :1] + 1.0
    first = np.where(cut.any(axis=1), cut.argmax(axis=1), 0)
    starts = [points[n, k : k + _CUT_STARTS] for n, k in enumerate(first) if k > 1]
    if not starts:
        return best
    fits = local(problem, np.concatenate(starts), _LONG, _STEP)
    return min(best, *fits, key=lambda f: f.cost)


def without_limit(problem: Problem, best: Fit, limit: int) -> Fit:
    """The fit with number `limit` kept out of the motion's reach."""
    structure = problem.structure
    p = structure.parameters[limit]
    least = min(_FAR_ABOVE * float(structure.decode(best.point)[limit]), 0.99 * p.high)
    parameters = [*structure.parameters]
    parameters[limit] = replace(p, low=least)
    kept = replace(structure, parameters=tuple(parameters))
    start = np.clip(best.point, *kept.box)
    return refine(replace(problem, structure=kept), start[None])


def refined(problem: Problem, starts: NDArray[np.float64], final: int = _FINAL) -> list[Fit]:
    """Fits from starts in fitted coordinates, best first: all a little, the best to the end."""
    rough = sorted(local(problem, starts, _SHORT, _WIDE_STEP), key=lambda f: f.cost)[:final]
    ends = local(problem, np.array([f.point for f in rough]), _LONG, _STEP)
    return sorted([*ends, *rough], key=lambda f: f.cost)


def refine(problem: Problem, points: NDArray[np.float64]) -> Fit:
    """The best local fit from some points (starts, parameters).

    Where a search needs not all readings, the fit to all of them begins at the best of the fits to
    those, and of the points.
    """
    if problem.excerpt is not problem:
        ends = [f.point for f in local(problem.excerpt, points, _LONG, _STEP)]
        points = np.concatenate([points, ends])
        points = points[[int(np.argmin(problem.costs(points)))]]
    return min(local(problem, points, _LONG, _STEP), key=lambda f: f.cost)


class Starts:
    """Quasi-random parameter vectors, each with the dead time and offset that suit runs best.

    The vectors fill the box of fitted coordinates, within two standard deviations of the prior
    where there is one. A delay only shifts the motion in time, so that one simulation serves all
    delays, and any choice of runs (`best`): the most rugged coordinate is not searched.

    `count`: how many vectors.
    """

    def __init__(
        self, problem: Problem, rng: np.random.Generator, count: int = _CANDIDATES
    ) -> None:
        self._problem = problem
        structure = problem.structure
        values = structure.decode(_spread(structure, rng, count))
        first = structure.parameters[0]
        values[:, 0], values[:, -1] = first.low, 0.0
        longest = (first.high - first.low) / TIME_STEP_S
        # as dense as a twentieth of the delay, and never denser than two steps
        later = np.unique(np.concatenate([
            np.arange(0.0, min(longest, _DENSE_DELAYS), _DELAY_GRID),
            np.geomspace(_DENSE_DELAYS, max(longest, _DENSE_DELAYS), _LONG_DELAYS).round(),
        ]))  # fmt: skip
        self._values, self._later_s = values, TIME_STEP_S * later
        self._moments = np.array([
            moments_if_later(structure, values, run, later * TIME_STEP_S / run.step_s)
            for run in problem.runs
        ])  # fmt: skip

    def best(self, keep: int, use: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """The `keep` of the lowest cost on the runs, or some of them, in fitted coordinates."""
        problem = self._problem if use is None else self._problem.only(use)
        moments = self._moments if use is None else self._moments[use]
        total, square = moments.sum(axis=0) / max(problem.samples, 1)
        delay = np.argmin(square - total**2, axis=0)
        values = self._values.copy()
        values[:, 0] += self._later_s[delay]
        spread = (square - total**2)[delay, np.arange(len(delay))]
        likely = np.argsort(spread)[: 8 * keep]
        precision = problem.structure.prior[1]
        values = values[likely]
        if precision[-1] == 0:
            values[:, -1] = -total[delay, np.arange(len(delay))][likely]
        points = np.clip(problem.structure.encode(values), *problem.structure.box)
        # by the readings alone: a prior that is off would leave out what suits them best
        return points[np.argsort(problem.costs(points) - problem.prior(points))[:keep]]


def _spread(structure: Structure, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Points that fill the prior's middle, shape (count, parameters).

    A Latin hypercube; under load, where many structures are compared, the more even sequence of
    Sobol, whose import takes half a second.
    """
    low, high = structure.box
    centre, precision = structure.prior
    reach = 2.0 / np.sqrt(np.maximum(precision, 1e-12))
    if structure.shared is not None:
        reach = np.hypot(reach, [2.0 * p.shared_sd for p in structure.parameters])
    reach = np.where(structure.logarithmic, reach, np.minimum(reach, _START_RAD))
    low, high = np.maximum(low, centre - reach), np.minimum(high, centre + reach)
    if structure.scales.free_air:
        rows = np.tile(np.arange(count), (len(low), 1))
        share = (rng.permuted(rows, axis=1).T + rng.random((count, len(low)))) / count
    else:
        from scipy.stats import qmc

        share = qmc.Sobol(len(low), rng=rng).random(count)
    points = low + share * (high - low)
    points[0] = centre
    return points


def local(
    problem: Problem, starts: NDArray[np.float64], iterations: int, difference: float
) -> list[Fit]:
    """Levenberg-Marquardt from every start (starts, parameters), all abreast.

    `starts` of shape (starts, parameters): in fitted coordinates. `iterations`: at most; starts
    that no longer improve drop out. `difference`: step of the Jacobian.
    """
    structure = problem.structure
    low, high = structure.box
    scale = structure.scale
    z = np.clip(starts, low, high)
    k = z.shape[1]
    cost, gradient, curvature = _slopes(problem, z, difference)
    damp, stalled = np.full(len(z), 1e-2), np.zeros(len(z), int)
    for _ in range(iterations):
        active = np.flatnonzero(stalled < 2)
        if not len(active):
            break
        here, slope, bent = z[active], gradient[active], curvature[active]
        # a coordinate pressed against its bound must not hold back the others
        go = ~(((here <= low) & (slope > 0)) | ((here >= high) & (slope < 0)))
        diagonal = np.diagonal(bent, axis1=1, axis2=2) + 1e-9
        matrix = bent + np.eye(k) * (damp[active, None] * diagonal)[:, None]
        matrix = np.where(go[:, :, None] & go[:, None], matrix, np.eye(k))
        move = np.linalg.solve(matrix, np.where(go, -slope, 0.0)[..., None])[..., 0]
        longest = np.max(np.abs(move) / scale, axis=1, keepdims=True)
        new = np.clip(here + move * np.minimum(1.0, 1.0 / np.maximum(longest, 1e-12)), low, high)
        cost_new, gradient_new, curvature_new = _slopes(problem, new, difference)
        gained = cost[active] - cost_new
        better = gained > 0
        moved = active[better]
        z[moved], cost[moved] = new[better], cost_new[better]
        gradient[moved], curvature[moved] = gradient_new[better], curvature_new[better]
        damp[active] = np.where(
            better, np.maximum(damp[active] / 4, 1e-6), np.minimum(damp[active] * 6, 1e6)
        )
        stalled[active] = np.where(gained < _LEAST_GAIN, stalled[active] + 1, 0)
    return [Fit(point, float(c)) for point, c in zip(z, cost, strict=True)]


def curvature(problem: Problem, point: NDArray[np.float64], difference: float) -> NDArray:
    """Hessian of the cost at a point, Gauss-Newton's, shape (parameters, parameters)."""
    return curvatures(problem, point[None], difference)[0]


def curvatures(problem: Problem, points: NDArray[np.float64], difference: float) -> NDArray:
    """The same at points (n, parameters), shape (n, parameters, parameters)."""
    return _slopes(problem, points, difference)[2]


def jacobians(
    problem: Problem, points: NDArray[np.float64], difference: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Scaled residuals at points (starts, samples), and their slopes (starts, parameters, samples).

    `points` of shape (starts, parameters).
    """
    structure, k = problem.structure, points.shape[1]
    step = difference * structure.scale
    away = np.where(points + step > structure.box[1], -1.0, 1.0) * step
    cloud = np.repeat(points[:, None, :], k + 1, axis=1)
    cloud[:, 1:] += away[:, None, :] * np.eye(k)
    r = problem.scaled(cloud.reshape(-1, k)).reshape(len(cloud), k + 1, -1)
    return r[:, 0], (r[:, 1:] - r[:, :1]) / away[:, :, None]


def _slopes(problem: Problem, points: NDArray, difference: float) -> tuple[NDArray, ...]:
    """Cost, gradient and curvature at points (starts, parameters)."""
    structure, k = problem.structure, points.shape[1]
    pull = structure.prior_slope(points)
    cost, gradient = problem.prior(points), np.empty(points.shape)
    bent = np.empty((len(points), k, k))
    together = max(1, _LARGEST_BATCH // max(problem.samples * (k + 1), 1))
    for first in range(0, len(points), together):
        at = slice(first, first + together)
        residuals, jacobian = jacobians(problem, points[at], difference)
        with np.errstate(over="ignore"):  # an unstable candidate costs infinitely much
            root = np.sqrt(1.0 + residuals**2)
        weighted = jacobian / root[:, None]
        cost[at] += np.sum(root - 1.0, axis=-1)
        gradient[at] = (weighted @ residuals[:, :, None])[..., 0] + pull[at]
        bent[at] = weighted @ jacobian.mT + structure.prior_precision
    return cost, gradient, bent


def evolve(
    problem: Problem,
    fits: Sequence[Fit],
    rng: np.random.Generator,
    short: bool = False,
    crowd: NDArray[np.float64] | None = None,
) -> Fit:
    """The best of a population that evolves around fits, fitted to the end.

    Differential evolution finds its way between the local optima of a servo with dry friction,
    where a gradient does not.

    `short`: fewer generations. `crowd` of shape (places, parameters): further members, in fitted
    coordinates.
    """
    low, high = problem.structure.box
    seeds = np.array([f.point for f in fits])
    if crowd is not None:
        seeds = np.concatenate([seeds, crowd])
    seeds = seeds[:_POPULATION]
    spread = 0.3 * problem.structure.scale
    around = seeds[rng.integers(0, min(len(fits), len(seeds)), _POPULATION)]
    z = np.clip(around + spread * rng.standard_normal(around.shape), low, high)
    z[: len(seeds)] = seeds
    cost = problem.costs(z)
    everyone = np.arange(len(z))
    most, patience = _SHORT_GENERATIONS if short else _GENERATIONS
    lowest, since = np.inf, 0
    for _ in range(most):
        if lowest - cost.min() > 1.0:  # one more number's worth
            lowest, since = float(cost.min()), 0
        elif (since := since + 1) > patience:
            break
        one, two = (rng.permutation(everyone) for _ in range(2))
        toward = z[np.argsort(cost)[rng.integers(0, _LEADERS, len(z))]]
        factor = rng.uniform(0.4, 0.9, (len(z), 1))
        trial = z + factor * (toward - z) + factor * (z[one] - z[two])
        keep = rng.random(z.shape) > 0.9
        trial = np.clip(np.where(keep, z, trial), low, high)
        new = problem.costs(trial, cost)
        better = new < cost
        z[better], cost[better] = trial[better], new[better]
    best = refine(problem, z[np.argsort(cost)[:2]])
    return min(best, *fits, key=lambda f: f.cost)


# ------------------------------------------------------------------------------- folds


def folds_of(runs: Sequence[Run]) -> dict[str, NDArray[np.bool_]]:
    """Which runs are left out together: a tone, or else a part of the runs of every gain and load.

    Returns shape (runs,): true where left out, by what is. A tone is named by its frequency [Hz].
    Of many tones some are picked, evenly; runs without tones are divided in as many parts, all of a
    gain between others besides. Empty if there is only one run or tone.
    """
    tones = np.array([r.tone for r in runs])
    labels = [r.label for r in runs]
    if len(runs) and (tones > 0).all() and len({r.p_gain for r in runs}) == 1:
        names = np.unique(tones)
        if len(names) < 2:
            return {}
        if len(names) > _MOST_FOLDS:  # a fine sweep: every n-th frequency says as much
            names = names[np.round(np.linspace(0, len(names) - 1, _MOST_FOLDS)).astype(int)]
        return {f"{name:g}": tones == name for name in np.unique(names)}
    if len(runs) < 2:
        return {}
    count = min(4, len(runs))
    kinds = list(dict.fromkeys(labels))
    turn = [labels[:n].count(x) + kinds.index(x) for n, x in enumerate(labels)]
    folds = {
        f"part {k + 1} of {count}": np.array([t % count == k for t in turn]) for k in range(count)
    }
    gains = sorted({r.p_gain for r in runs})
    for gain in gains[1:-1][:2]:
        folds[f"P {gain:g}"] = np.array([r.p_gain == gain for r in runs])
    return {name: out for name, out in folds.items() if out.any() and not out.all()}


def in_blocks(problem: Problem) -> tuple[Problem, dict[str, NDArray[np.bool_]]]:
    """The same fit with the readings of each run in consecutive blocks, and which to leave out.

    For runs of which `folds_of` finds too few parts: one motion still has a beginning and an end.

    Returns the fit with as many runs for each run as there are blocks, under the same commands,
    and folds as from `folds_of`.
    """
    runs, noise = [], []
    for run, run_noise in zip(problem.runs, problem.noise_rad, strict=True):
        for block in np.array_split(np.arange(len(run.sample_step)), _BLOCKS):
            runs.append(
                replace(run, sample_step=run.sample_step[block], sample_rad=run.sample_rad[block])
            )
            noise.append(run_noise)
    place = np.arange(len(runs)) % _BLOCKS
    folds = {f"block {k + 1}": place == k for k in range(_BLOCKS)}
    return replace(problem, runs=tuple(runs), noise_rad=tuple(noise)), folds


def group_count(runs: Sequence[Run]) -> int:
    """Groups of readings of which `folds_of` leaves out one at a time."""
    tones = {r.tone for r in runs}
    return len(tones) if min(tones) > 0 else min(4, len(runs))


def fit_folds(
    problem: Problem,
    folds: Mapping[str, NDArray[np.bool_]],
    rng: np.random.Generator,
    draws: NDArray[np.float64] | None = None,
    parents: Sequence[tuple[Structure, Sequence[Fit]]] = (),
) -> list[Fit]:
    """The best fit without each fold's runs.

    A fold's fit is the lowest cost on its own runs, from draws of the posterior (from starts all
    over the box without any), and from the fits of simpler structures to the same runs: so it is
    as good an optimum as that of all runs.

    `problem`: all runs. `folds`: from `folds_of`. `draws` of shape (draws, parameters): in fitted
    coordinates. `parents`: structures that this one contains, and their fits, one per fold.
    """
    if not folds:
        return []
    starts, by_run = None, None
    if draws is None:
        starts = Starts(problem, rng)
    else:
        draws = np.unique(draws, axis=0)
        draws = draws[rng.permutation(len(draws))[:_FOLD_DRAWS]]
        by_run = problem.costs_by_run(draws)
    fits = []
    for n, out in enumerate(folds.values()):
        part = problem.only(~out)
        if starts is not None:
            crowd = [starts.best(_KEEP, ~out)]
        else:
            assert draws is not None and by_run is not None
            cost_without = by_run[~out].sum(axis=0) + problem.prior(draws)
            crowd = [draws[np.argsort(cost_without)[:_FOLD_STARTS]]]
        for parent, parent_folds in parents:
            crowd.append(problem.structure.adopt(parent, parent_folds[n].point[None]))
        rough = refined(part.coarse, np.concatenate(crowd), _REFINED)[:_REFINED]
        fits.append(refine(part, np.array([f.point for f in rough])))
    return fits
