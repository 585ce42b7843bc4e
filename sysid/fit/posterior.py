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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.tones import least_squares
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.fit.run import Run
from pupper_sysid.sysid.fit.search import Fit, Problem, curvature, local
from pupper_sysid.sysid.fit.structure import Structure

STEPPING_SD_S = 0.1 * TIME_STEP_S
"""Error of a dead time [s] that no number of readings reduces, because the model moves in steps:
the shift that suits random servos simulated in steps of 0.1 ms best is 0 to 0.25 ms."""
_STEPPING_SHARE = 0.006
"""Relative error of torques that physics steps leave, whatever the number of readings: standard
deviation over random emulated pendulums that move in other steps."""
_HARMONICS = (1, 2, 3)
R_HAT, EFFECTIVE = 1.03, 400.0
"""Split-R̂ at most, and effective draws at least, of draws that have converged."""
_POPULATION, _ROUNDS, _ENOUGH = 384, 8, 300.0  # points a round, rounds, effective points
_CENTRES, _LEAST_CENTRES, _BANDWIDTH, _FREEDOM = 192, 48, 0.5, 5.0
_BETTER = 4.0  # log-likelihood by which another optimum has to be better
_CHAINS, _GENERATIONS, _BLOCKS = 16, 200, 4
_NOISE = 1e-3  # of a proposal, over the standard deviation
_STEP = 0.01
PHASE_SD_S = 0.0003
"""Standard deviation of the date error that all readings of a polled run share [s], about that of
the phase of a poll estimated from a few seconds."""
_DATE_DRAWS, _DATE_ITERATIONS = 24, 6
LEAST_FOLDS = 3
"""Fits without a part, below which their scatter says nothing."""
_MEDIAN_OF_NORMAL = float(ndtri(0.75))  # of the size of a standard normal number
_CURVATURE_STEP = 0.03  # the slope over a likely error, not of one kink
_OVERDISPERSED, _WIDEST = 1.3, 0.7  # of the first points, over a Gaussian's; and at most
_REMEMBERED_S = 0.5
_Z = float(ndtri(0.5 + LEVEL / 2))


@dataclass(frozen=True)
class Posterior:
    """Draws of a structure's parameters, and whether they can be trusted.

    Attributes
    ----------
    points : ndarray, shape (draws, parameters)
        In fitted coordinates.
    best : Fit
        The likeliest point that was met.
    r_hat : float
        Largest split-R̂ over the parameters: spread between chains over that within.
    effective : float
        Smallest number of independent draws that those of a parameter are worth.
    """

    points: NDArray[np.float64]
    best: Fit
    r_hat: float
    effective: float


def sample(
    problem: Problem,
    best: Fit,
    temperature: float,
    rng: np.random.Generator,
) -> Posterior:
    """Draw parameters from their posterior.

    Importance sampling finds where the posterior is: from a t distribution as the curvature at the
    optimum says, then from mixtures about the points that weigh most (population Monte Carlo).
    Chains from there propose points of the last mixture and steps along differences of two of its
    points, until they agree.

    Parameters
    ----------
    problem : Problem
    best : Fit
    temperature : float
        By which the cost of the readings is divided.
    rng : numpy.random.Generator
    """
    low, high = problem.structure.box

    def tempered(points: NDArray, ceiling: NDArray | float = np.inf) -> NDArray[np.float64]:
        inside = ((points >= low) & (points <= high)).all(axis=1)
        cost = np.full(len(points), np.inf)
        if inside.any():
            own = points[inside]
            prior = problem.prior(own)
            most = ceiling if np.isscalar(ceiling) else ceiling[inside]
            whole = problem.costs(own, (most - prior) * temperature + prior)
            cost[inside] = (whole - prior) / temperature + prior
        return cost

    points, cost, start, mixture = _populate(problem, tempered, best, temperature, rng)
    z, log_density, k = points.copy(), mixture.log_density(points), points.shape[1]
    kept: list[NDArray] = []
    for block in range(_BLOCKS):
        for generation in range(_GENERATIONS):
            if generation % 2:
                trial, trial_density = mixture.draw(len(z), rng)
                most = cost + log_density - trial_density - np.log(rng.random(len(z)))
            else:
                one, two = rng.integers(0, len(mixture.centres), (2, len(z)))
                gamma = 2.38 / np.sqrt(2 * k) * rng.uniform(0.3, 1.1, (len(z), 1))
                trial = z + gamma * (mixture.centres[one] - mixture.centres[two])
                trial += _NOISE * mixture.spread * rng.standard_normal(z.shape)
                trial_density = mixture.log_density(trial)
                most = cost - np.log(rng.random(len(z)))
            new = tempered(trial, most)
            accepted = new < most
            z = np.where(accepted[:, None], trial, z)
            cost = np.where(accepted, new, cost)
            log_density = np.where(accepted, trial_density, log_density)
            kept.append(z)
            first = int(np.argmin(cost))
            if cost[first] < start.cost:
                start = Fit(z[first], float(cost[first]))
        draws = np.array(kept)
        r_hat, effective = convergence(draws)
        if r_hat <= R_HAT and effective >= EFFECTIVE:
            break
        if block == 0:  # where the chains went says more than where they began
            cloud = draws.reshape(-1, k)
            mixture = _mixture_of(cloud, np.full(len(cloud), 1.0 / len(cloud)), mixture.wide, rng)
            log_density = mixture.log_density(z)
            kept = []
    whole = float(problem.costs(start.point[None])[0])
    return Posterior(draws.reshape(-1, k), Fit(start.point, whole), r_hat, effective)


@dataclass(frozen=True)
class _Mixture:
    """t distributions about centres that weigh alike, and one wide one."""

    centres: NDArray[np.float64]
    root: NDArray[np.float64]  # of their covariance
    wide: NDArray[np.float64]  # of the covariance of the wide one
    middle: NDArray[np.float64]
    share: float  # of the wide one

    @property
    def spread(self) -> NDArray[np.float64]:
        """Standard deviation of each coordinate."""
        return np.sqrt(np.sum(self.wide**2, axis=1))

    def draw(self, count: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Points (count, parameters) and the logarithm of their density."""
        k = len(self.middle)
        steps = rng.standard_normal((count, k))
        steps /= np.sqrt(rng.chisquare(_FREEDOM, (count, 1)) / _FREEDOM)
        about = self.centres[rng.integers(0, len(self.centres), count)] + steps @ self.root.T
        widely = self.middle + steps @ self.wide.T
        points = np.where(rng.random((count, 1)) < self.share, widely, about)
        return points, self.log_density(points)

    def log_density(self, points: NDArray) -> NDArray[np.float64]:
        """Up to a constant, shape (points,)."""

        def student(apart: NDArray, root: NDArray) -> NDArray:
            size = np.sum(np.linalg.solve(root, apart.reshape(-1, k).T) ** 2, axis=0)
            power = -0.5 * (_FREEDOM + k) * np.log1p(size / _FREEDOM)
            return power.reshape(apart.shape[:-1]) - np.linalg.slogdet(root)[1]

        k = len(self.middle)
        wide = student(points - self.middle, self.wide) + np.log(self.share)
        if self.share >= 1.0:
            return wide
        near = student(points[:, None, :] - self.centres, self.root)
        near = logsumexp(near, axis=1) - np.log(len(self.centres)) + np.log1p(-self.share)
        return np.logaddexp(wide, near)


def _populate(
    problem: Problem, tempered: Callable[..., NDArray], best: Fit, temperature: float,
    rng: np.random.Generator,
) -> tuple[NDArray, NDArray, Fit, _Mixture]:  # fmt: skip
    """Points of equal weight, their cost, the best one met, and a mixture about them."""
    k = len(best.point)
    start = Fit(best.point, float(tempered(best.point[None])[0]))
    root = _root(problem, start.point, temperature)
    mixture = _Mixture(start.point[None], root, root, start.point, 1.0)
    points, cost = np.empty((0, k)), np.empty(0)
    mixtures: list[_Mixture] = []
    log_density = np.empty((0, 0))  # (mixtures, points)
    for turn in range(_ROUNDS):
        drawn, _ = mixture.draw(_POPULATION, rng)
        own = tempered(drawn)
        first = int(np.argmin(own))
        # an optimum beside: begin again there
        if own[first] < start.cost - _BETTER and turn < _ROUNDS // 2:
            fit = local(problem, drawn[first : first + 1], _DATE_ITERATIONS, _CURVATURE_STEP)[0]
            start = Fit(fit.point, float(tempered(fit.point[None])[0]))
            root = _root(problem, start.point, temperature)
            mixture = _Mixture(start.point[None], root, root, start.point, 1.0)
            points, cost, mixtures = np.empty((0, k)), np.empty(0), []
            log_density = np.empty((0, 0))
            continue
        mixtures.append(mixture)
        old = [m.log_density(drawn) for m in mixtures]
        log_density = np.block([
            [np.vstack([log_density, mixture.log_density(points)[None]]) if len(points) else
             np.empty((1, 0)), np.array(old)]
        ])  # fmt: skip
        points, cost = np.concatenate([points, drawn]), np.concatenate([cost, own])
        log_weight = -cost - logsumexp(log_density, axis=0)
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        effective = 1.0 / np.sum(weight**2)
        mixture = _mixture_of(points, weight, root, rng)
        if effective >= _ENOUGH:
            break
    chosen = rng.choice(len(points), _CHAINS, p=weight)
    return points[chosen], cost[chosen], start, mixture


def _mixture_of(
    points: NDArray, weight: NDArray, root: NDArray, rng: np.random.Generator
) -> _Mixture:
    """The next mixture about weighted points; `root` is that of the last covariance."""
    # clipped, so that a single point does not carry it
    flat = np.minimum(weight, 1.0 / _LEAST_CENTRES)
    flat = flat / flat.sum()
    centres = points[rng.choice(len(points), _CENTRES, p=flat)]
    middle = flat @ points
    apart = points - middle
    covariance = (flat * apart.T) @ apart + (1e-6 * root) @ root.T
    wide = np.linalg.cholesky(covariance + 1e-18 * np.eye(len(middle)))
    return _Mixture(centres, _BANDWIDTH * wide, 1.3 * wide, middle, 0.3)


def _root(problem: Problem, point: NDArray, temperature: float) -> NDArray[np.float64]:
    """Root of the covariance at an optimum by the curvature of the tempered cost."""
    precision = np.diag(problem.structure.prior[1])
    bent = (curvature(problem, point, _STEP) - precision) / temperature + precision
    values, vectors = np.linalg.eigh(bent)
    return vectors * np.minimum(_OVERDISPERSED / np.sqrt(np.maximum(values, 1e-12)), _WIDEST)


def convergence(draws: NDArray[np.float64]) -> tuple[float, float]:
    """Largest split-R̂ and smallest number of effective draws over the parameters.

    Parameters
    ----------
    draws : ndarray, shape (generations, chains, parameters)

    References
    ----------
    Gelman, A. et al. (2013). Bayesian Data Analysis, 3rd ed., section 11.4–11.5.
    """
    half = len(draws) // 2
    x = np.concatenate([draws[:half], draws[half : 2 * half]], axis=1)
    within = x.var(axis=0, ddof=1).mean(axis=0)
    between = half * x.mean(axis=0).var(axis=0, ddof=1)
    total = (half - 1) / half * within + between / half
    total = np.maximum(total, 1e-300)
    r_hat = np.sqrt(total / np.maximum(within, 1e-300))
    rho = np.empty((half - 1, x.shape[2]))
    for lag in range(1, half):
        variogram = np.mean((x[lag:] - x[:-lag]) ** 2, axis=(0, 1))
        rho[lag - 1] = 1.0 - variogram / (2.0 * total)
    # Geyer's initial positive sequence: pairs of autocorrelations while their sum is positive
    pairs = rho[: 2 * (len(rho) // 2)].reshape(-1, 2, x.shape[2]).sum(axis=1)
    memory = 1.0 + 2.0 * np.sum(np.cumprod(pairs > 0, axis=0) * np.maximum(pairs, 0), axis=0)
    return float(r_hat.max()), float((half * x.shape[1] / memory).min())


def temperature_of(
    residuals: Sequence[NDArray[np.float64]], runs: Sequence[Run], parameters: int
) -> float:
    """By which the cost of readings is divided: readings per independent one, over their weight.

    A soft-L1 cost weighs each reading less than its noise deserves. The ratio of the variance of
    its slope to its mean curvature (Godambe) makes up for that: 0.57 for normal noise.

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
    every = np.concatenate([np.empty(0), *residuals])
    if not len(every):
        return 1.0
    bent = np.mean((1.0 + every**2) ** -1.5)
    weight = float(np.mean(every**2 / (1.0 + every**2)) / max(bent, 1e-12))
    pairs = list(zip(residuals, runs, strict=True))
    tones = [(r, run) for r, run in pairs if run.tone > 0 and len(r) >= 4 * len(_HARMONICS)]
    if sum(len(r) for r, _ in tones) > sum(len(r) for r, _ in pairs) / 2:
        return weight * _at_harmonics(tones, parameters)
    return weight * _autocorrelation([(r, run) for r, run in pairs if len(r) > 1])


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


def interval_of(name: str, value: float, draws: NDArray) -> Interval:
    """Interval of one number from its draws, no narrower than the simulation's steps allow.

    Parameters
    ----------
    name : str
    value : float
        As fitted.
    draws : ndarray, shape (draws,)
    """
    own = Interval.of_draws(value, draws)
    low, high = min(value, own.low), max(value, own.high)
    if name == "dead_time_s":
        grain = _Z * STEPPING_SD_S
    elif name.endswith(("hanging_rad", "offset_rad")) or value <= 0:
        return Interval(value, low, high)
    else:
        grain = _Z * _STEPPING_SHARE * value
    low, high = value - float(np.hypot(value - low, grain)), value + np.hypot(high - value, grain)
    return Interval(value, max(low, 0.0), float(high))
