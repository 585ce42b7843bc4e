"""Posterior of a structure's parameters by population Monte Carlo: intervals that hold.

Many servos move alike: a long, curved ridge of parameters explains a recording equally well. Its
curvature at the optimum, or refits from there, see one end of it. The compiled simulation is fast
enough to weigh thousands of points instead: `sample` draws parameters in proportion to prior and
likelihood by population Monte Carlo, until the draws have converged.

Residuals are not white; the likelihood, not the prior, is tempered by `temperature_of`: how many
readings count as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.fit.goodness import LEAST_NOISE_RAD
from pupper_sysid.sysid.fit.run import with_late_commands
from pupper_sysid.sysid.fit.search import Fit, Problem, curvatures, jacobians, local
from pupper_sysid.sysid.fit.structure import Structure
from pupper_sysid.sysid.recordings.recording import Trial

STEPPING_SD_S = 0.1 * TIME_STEP_S
"""Error of a dead time [s] that no number of readings reduces, because the model moves in steps:
the shift that suits random servos simulated in steps of 0.1 ms best is 0 to 0.25 ms."""
STEPPING_SHARE = 0.006
"""Relative error of torques that physics steps leave, whatever the number of readings: standard
deviation over random emulated pendulums that move in other steps."""
_PROFILE_SHARE = 0.02
"""The same of a limited acceleration: chirps and jumps of six random servos in steps of 0.1 ms are
matched best in steps of 2 ms by limits that are 1 to 3 % lower."""
R_HAT, EFFECTIVE = 1.03, 400.0
"""R̂ at most, and effective draws at least, of draws that have converged."""
ROUNDS, FEW_ROUNDS = 32, 8
"""Populations at most; and of a joint that the model does not describe, whose gains are not known
however exactly its posterior is."""
_OFFSET_SHARE = 0.1
"""Error of an offset that steps leave, over the least noise of a fit: 0.003 to 0.01 mrad in four of
80 servos simulated in steps of 0.1 ms."""
_POPULATION, _DRAWS = 384, 2000
_CENTRES, _BY_WEIGHT, _WIDE_ONES, _FREEDOM, _GROUPS = 12, 4, 3, 5.0, 8
_RISE = (0.5, 400.0)  # by which an axis is made longer or shorter, squared
HARDLY_CONVERGED = 1.1, 100.0
"""R̂ above, or effective draws below, which draws say little: the ends of an interval are off by a
fifth of a standard deviation and more."""
_BETTER = 4.0  # log-likelihood by which another optimum has to be better
_STEP = 0.01
LATCH_SD_S = 0.0003
"""Standard deviation of the time that a command waits in a servo whose loop turns once in a
millisecond [s]."""
PHASE_SD_S = 0.0003
"""Standard deviation of the date error that all readings of a polled run share [s], about that of
the phase of a poll estimated from a few seconds."""
_DATE_DRAWS, _ITERATIONS = 24, 6
LEAST_FOLDS = 3
"""Fits without a part, below which their scatter says nothing."""
_MEDIAN_OF_NORMAL = float(ndtri(0.75))  # of the size of a standard normal number
_CURVATURE_STEP = 0.03  # the slope over a likely error, not of one kink
_OVERDISPERSED, _WIDEST = 1.3, 0.7  # of the first points, over a Gaussian's; and at most
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
        Largest R̂ over the parameters: spread of and within parts of the points, over that within.
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
    rounds: int = ROUNDS,
) -> Posterior:
    """Draw parameters from their posterior by population Monte Carlo.

    Each population is drawn from a mixture of t distributions, and weighed by posterior over the
    density of all mixtures so far (deterministic mixture weights). The next mixture stands about
    points drawn by weight, each with the covariance that the curvature of the cost has there, so
    that it bends with a ridge. This goes on until the weighted points are worth enough draws.

    Parameters
    ----------
    problem : Problem
    best : Fit
    temperature : float
        By which the cost of the readings is divided.
    rng : numpy.random.Generator
    rounds : int
        Populations, at most.

    References
    ----------
    Cappé, O. et al. (2008). Adaptive importance sampling in general mixture classes. Statistics and
    Computing 18: 447–459.
    Ionides, E. L. (2008). Truncated importance sampling. Journal of Computational and Graphical
    Statistics 17: 295–311.
    """
    target = _Target(problem, temperature)
    begin = target.straight.of(best.point[None])
    least = float(target.cost(begin)[0])
    mixture = _Mixture.about(target, begin)
    mixtures: list[_Mixture] = []
    points, cost, density = np.empty((0, begin.shape[1])), np.empty(0), np.empty(0)
    weight, r_hat, effective = np.empty(0), float("inf"), 1.0
    for turn in range(rounds):
        drawn = mixture.draw(_POPULATION, rng)
        drawn_cost = target.cost(drawn)
        first = int(np.argmin(drawn_cost))
        if not np.isfinite(drawn_cost[first]):  # all beyond the bounds
            mixture = replace(mixture, roots=0.5 * mixture.roots)
            continue
        if (
            drawn_cost[first] < least - _BETTER and turn < rounds // 2
        ):  # an optimum beside: begin there
            start = target.straight.fitted(drawn[first : first + 1])
            fit = local(problem, start, _ITERATIONS, _CURVATURE_STEP)[0]
            begin = target.straight.of(fit.point[None])
            least = float(target.cost(begin)[0])
            mixture, mixtures = _Mixture.about(target, begin), []
            points, cost, density = points[:0], cost[:0], density[:0]
            continue
        density = np.logaddexp(density, mixture.log_density(points))
        mixtures.append(mixture)
        of_drawn = np.asarray(logsumexp([m.log_density(drawn) for m in mixtures], axis=0))
        points, cost = np.concatenate([points, drawn]), np.concatenate([cost, drawn_cost])
        density = np.concatenate([density, of_drawn])
        weight = np.exp(-cost - density - np.max(-cost - density))
        weight /= weight.sum()
        r_hat, effective = convergence(points, weight)
        if r_hat <= R_HAT and effective >= EFFECTIVE:
            break
        mixture = _Mixture.of(target, points, weight, rng)
    if not len(points):
        return Posterior(np.repeat(best.point[None], _DRAWS, axis=0), best, r_hat, effective)
    likeliest = target.straight.fitted(points[int(np.argmin(cost))])
    least_cost = float(problem.costs(likeliest[None])[0])
    # truncated, so that few points do not stand for all where there was no convergence
    weight = np.minimum(weight, 1.0 / np.sqrt(len(weight)))
    draws = target.straight.fitted(points[rng.choice(len(points), _DRAWS, p=weight / weight.sum())])
    return Posterior(draws, Fit(likeliest, least_cost), r_hat, effective)


@dataclass(frozen=True)
class Straight:
    """Coordinates in which the ridges of a structure's posterior are straight.

    Of damping and back-EMF a motion inside of the effort limit tells the sum only, so that in the
    logarithms of damping, effort and speed the posterior is a thin bent shell, of which a mixture
    covers a part, and which a shift of each number leaves. Here the logarithms of the sum and of
    back-EMF over damping stand for those of damping and speed; the determinant of the change is 1.
    """

    structure: Structure

    @cached_property
    def _places(self) -> tuple[int, int, int] | None:
        """Of damping, speed and effort in the coordinates; None where they are not all fitted."""
        names = self.structure.names
        for three in (
            ("damping_per_s", "no_load_speed_rad_s", "effort_rad_s2"),
            ("damping", "no_load_speed_rad_s", "stall_torque"),
        ):
            if {*three} <= {*names}:
                damping, speed, effort = (names.index(name) for name in three)
                return damping, speed, effort
        return None

    def of(self, fitted: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (..., parameters) of fitted coordinates in these."""
        if self._places is None:
            return fitted
        damping, speed, effort = self._places
        points = fitted.copy()
        back_emf = fitted[..., effort] - fitted[..., speed]
        points[..., damping] = np.logaddexp(fitted[..., damping], back_emf)
        points[..., speed] = back_emf - fitted[..., damping]
        return points

    def fitted(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `of`."""
        if self._places is None:
            return points
        damping, speed, effort = self._places
        fitted = points.copy()
        fitted[..., damping] = points[..., damping] - np.logaddexp(0.0, points[..., speed])
        fitted[..., speed] = points[..., effort] - fitted[..., damping] - points[..., speed]
        return fitted

    def slope(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fitted coordinates by these at points (n, parameters), (n, parameters, parameters)."""
        slope = np.tile(np.eye(points.shape[1]), (len(points), 1, 1))
        if self._places is None:
            return slope
        damping, speed, effort = self._places
        share = 1.0 / (1.0 + np.exp(-points[:, speed]))  # of back-EMF in the sum
        slope[:, damping, speed] = -share
        slope[:, speed, damping] = -1.0
        slope[:, speed, speed] = share - 1.0
        slope[:, speed, effort] = 1.0
        return slope


@dataclass(frozen=True)
class _Target:
    """The tempered posterior of a problem, in coordinates in which its ridge is straight."""

    problem: Problem
    temperature: float

    @cached_property
    def straight(self) -> Straight:
        """The coordinates."""
        return Straight(self.problem.structure)

    def cost(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minus the logarithm of the density; infinite outside of the box."""
        low, high = self.problem.structure.box
        fitted = self.straight.fitted(points)
        inside = ((fitted >= low) & (fitted <= high)).all(axis=1)
        cost = np.full(len(points), np.inf)
        if inside.any():
            prior = self.problem.prior(fitted[inside])
            readings = self.problem.costs(fitted[inside]) - prior
            cost[inside] = readings / self.temperature + prior
        return np.where(np.isfinite(cost), cost, np.inf)

    def curvature(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hessian of `cost` at points (n, parameters), Gauss-Newton's."""
        precision = self.problem.structure.prior_precision
        bent = curvatures(self.problem, self.straight.fitted(points), _STEP) - precision
        slope = self.straight.slope(points)
        return slope.mT @ (bent / self.temperature + precision) @ slope

    def inside(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points moved into the box."""
        straight = self.straight
        return straight.of(np.clip(straight.fitted(points), *self.problem.structure.box))


@dataclass(frozen=True)
class _Mixture:
    """t distributions that weigh alike.

    Attributes
    ----------
    centres : ndarray, shape (components, parameters)
    roots : ndarray, shape (components, parameters, parameters)
        Of their scale matrices.
    """

    centres: NDArray[np.float64]
    roots: NDArray[np.float64]

    @classmethod
    def about(cls, target: _Target, centres: NDArray[np.float64]) -> _Mixture:
        """As wide at each centre as the cost says: by its curvature, then along the axes.

        A ridge bends, so a step of one standard deviation along an axis of the curvature often
        costs far more than half a unit of log-likelihood; the axis is made shorter then.
        """
        k = centres.shape[1]
        values, axes = np.linalg.eigh(target.curvature(centres))
        sizes = np.minimum(1.0 / np.sqrt(np.maximum(values, 1e-12)), _WIDEST)
        steps = np.swapaxes(axes * sizes[:, None, :], 1, 2)
        ends = np.concatenate([centres[:, None] + steps, centres[:, None] - steps], axis=1)
        ends = target.inside(ends.reshape(-1, k))
        cost = target.cost(np.concatenate([centres, ends]))
        middle, ends = cost[: len(centres)], cost[len(centres) :].reshape(-1, 2, k)
        rise = ends.sum(axis=1) - 2.0 * middle[:, None]  # 1 of a normal distribution
        rise = np.where(np.isfinite(rise), rise, _RISE[1])
        sizes = np.minimum(sizes / np.sqrt(np.clip(rise, *_RISE)), _WIDEST)
        return cls(centres, axes * (_OVERDISPERSED * sizes)[:, None, :])

    @classmethod
    def of(
        cls, target: _Target, points: NDArray, weight: NDArray, rng: np.random.Generator
    ) -> _Mixture:
        """About points drawn by weight, the heaviest points, and as wide as all of them.

        A heavy point is one where the mixtures so far have too few.
        """
        flat = np.minimum(weight, 1.0 / _CENTRES)  # clipped, so that no single point carries it
        flat = flat / flat.sum()
        heaviest = np.argsort(-weight)[: _CENTRES - _BY_WEIGHT]
        centres = points[np.append(rng.choice(len(points), _BY_WEIGHT, p=flat), heaviest)]
        narrow = cls.about(target, centres)
        middle = flat @ points
        apart = points - middle
        covariance = (flat * apart.T) @ apart + 1e-12 * np.eye(len(middle))
        wide = _OVERDISPERSED * np.linalg.cholesky(covariance)
        return cls(
            np.concatenate([centres, np.tile(middle, (_WIDE_ONES, 1))]),
            np.concatenate([narrow.roots, np.tile(wide, (_WIDE_ONES, 1, 1))]),
        )

    def draw(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Points (count, parameters)."""
        k = self.centres.shape[1]
        steps = rng.standard_normal((count, k))
        steps /= np.sqrt(rng.chisquare(_FREEDOM, (count, 1)) / _FREEDOM)
        component = rng.integers(0, len(self.centres), count)
        return self.centres[component] + np.einsum("nij,nj->ni", self.roots[component], steps)

    def log_density(self, points: NDArray) -> NDArray[np.float64]:
        """Up to a constant, shape (points,)."""
        k = self.centres.shape[1]
        inverse = np.linalg.inv(self.roots)
        white = np.einsum("cij,cnj->cni", inverse, points[None] - self.centres[:, None])
        power = -0.5 * (_FREEDOM + k) * np.log1p(np.sum(white**2, axis=2) / _FREEDOM)
        log_det = np.linalg.slogdet(self.roots)[1]
        return logsumexp(power - log_det[:, None], axis=0) - np.log(len(self.centres))


def convergence(points: NDArray[np.float64], weight: NDArray[np.float64]) -> tuple[float, float]:
    """Largest R̂ and smallest number of effective draws over the parameters, of weighted points.

    The variance of a mean over independent weighted points is the weighted mean square of
    w (x − mean); R̂ is that between `_GROUPS` parts of the points and within them.

    `points` of shape (points, parameters). `weight` of shape (points,): their sum is 1.
    """
    middle = weight @ points
    apart = points - middle
    variance = np.maximum(weight @ apart**2, 1e-300)
    effective = variance / np.maximum(weight**2 @ apart**2, 1e-300)
    effective = np.minimum(effective, 1.0 / np.sum(weight**2))  # one heavy point has no variance
    means = []
    for part in range(_GROUPS):
        group_weight = weight[part::_GROUPS]
        means.append(group_weight @ points[part::_GROUPS] / max(group_weight.sum(), 1e-300))
    between = np.var(means, axis=0, ddof=1)
    return float(np.sqrt(1.0 + between / variance).max()), float(effective.min())


def with_date_errors(
    draws: NDArray[np.float64],
    problem: Problem,
    best: Fit,
    recorded: Sequence[Trial],
    polled: bool,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Draws with what errors of dates, which many readings share, do to the optimum.

    A command waits for the servo's next turn, and the servo carries that on for many readings: of
    each draw here all commands are late at random (`LATCH_SD_S`), by no more than residuals allow.
    The phase of a poll is estimated for each trial, so that its readings are early or late together
    (`PHASE_SD_S`). No likelihood of independent readings knows that, and stiffness, damping and
    limits move more by it than the dead time does.

    `draws` of shape (draws, parameters). `recorded`: the trials of the runs, as recorded. `polled`:
    whether readings are dated by a poll's lattice.
    """
    runs, point = problem.runs, best.point[None]
    (plain,), (jacobian,) = jacobians(problem, point, _CURVATURE_STEP)
    ends = np.cumsum([len(run.sample_step) for run in runs])[:-1]

    def off(latch_s: Sequence[float], phase_s: float) -> NDArray[np.float64]:
        """Residuals of the best fit with commands and polls at other times, less its own."""
        late = [
            with_late_commands(run, trial, sd, rng)
            for run, trial, sd in zip(runs, recorded, latch_s, strict=True)
        ]
        shifted = tuple(
            replace(run, sample_step=np.maximum(run.sample_step + by / run.step_s, 0.0))
            for run, by in zip(late, phase_s * rng.standard_normal(len(runs)), strict=True)
        )
        return replace(problem, runs=shifted).scaled(point)[0] - plain

    moved = off([LATCH_SD_S] * len(runs), 0.0)
    latch_s = [
        LATCH_SD_S * min(1.0, rms(noise) / max(rms(of_latch), 1e-12))
        for noise, of_latch in zip(np.split(plain, ends), np.split(moved, ends), strict=True)
    ]
    errors = np.array([off(latch_s, PHASE_SD_S if polled else 0.0) for _ in range(_DATE_DRAWS)])
    straight = Straight(problem.structure)
    (slope,) = straight.slope(straight.of(point))
    weighted = slope.T @ (jacobian / np.sqrt(1.0 + plain**2))
    bent = weighted @ jacobian.T @ slope + slope.T @ problem.structure.prior_precision @ slope
    # a number without a slope and without a prior is moved by nothing
    apart = -(np.linalg.pinv(bent, hermitian=True) @ (weighted @ errors.T)).T
    return straight.fitted(straight.of(draws) + apart[rng.integers(0, len(apart), len(draws))])


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
        spread = np.sqrt(np.mean((values - centre) ** 2, axis=0))
        factor = np.sqrt(groups - 1.0) * apart / np.maximum(spread, 1e-12)
        return centre + (values - centre) * np.maximum(1.0, factor)

    left_out = np.array([f.point for f in folds])
    straight = Straight(structure)
    wide = straight.fitted(wider(*(straight.of(x) for x in (best.point, draws, left_out))))
    # a dead time may well be close to none: of it the difference counts, not the ratio
    delay, delays, others = (structure.decode(x)[..., 0] for x in (best.point, draws, left_out))
    first = structure.parameters[0]
    wide[:, 0] = first.encode(np.clip(wider(delay, delays, others), first.low, first.high))
    return wide


# ------------------------------------------------------------------------------- intervals


def interval_of(name: str, value: float, draws: NDArray) -> Interval:
    """Interval of one number from its draws, no narrower than the simulation's steps allow.

    `value`: as fitted. `draws` of shape (draws,).
    """
    interval = Interval.of_draws(value, draws)
    low, high = min(value, interval.low), max(value, interval.high)
    if name == "dead_time_s":
        grain = _Z * STEPPING_SD_S
    elif name.endswith("offset_rad"):
        grain = _Z * _OFFSET_SHARE * LEAST_NOISE_RAD
    elif name.endswith("hanging_rad") or value <= 0:
        return Interval(value, low, high)
    else:
        share = _PROFILE_SHARE if name == "acceleration_limit" else STEPPING_SHARE
        grain = _Z * share * value
    low, high = value - float(np.hypot(value - low, grain)), value + np.hypot(high - value, grain)
    return Interval(value, low if name.endswith("offset_rad") else max(low, 0.0), float(high))
