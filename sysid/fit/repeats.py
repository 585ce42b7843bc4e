"""Repeats: do the recordings of a joint agree, which one differs in what, and how widely they vary.

A servo is not the same on two days: its battery, temperature and grease are not, nor may be its
gain. Each recording is fitted apart, from the fit to all of them (`fit_apart`), and compared with
the others by normal approximations of their likelihoods (`compare_repeats`). Where one differs, the
one number that explains most of it is named, with the factor between it and the others. What each
number may vary by between recordings widens its interval, which then is for the next recording,
too. It is no error of the model: `between_recordings` is by how far readings differ for that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.interval import HALF_WIDTH_SD, Interval
from pupper_sysid.servo_models.calibration.quantity import words_of
from pupper_sysid.sysid.fit.goodness import (
    DESCRIBED,
    goodness_of_fit,
    noise_by_run,
    overall,
    temperature_of,
)
from pupper_sysid.sysid.fit.posterior import Straight
from pupper_sysid.sysid.fit.run import Run, fresh_residuals
from pupper_sysid.sysid.fit.search import Problem, curvature, local, refine
from pupper_sysid.sysid.fit.servo_prior import PER_INERTIA, UNIT_SD
from pupper_sysid.sysid.fit.structure import SERVO_TERMS, Structure

_ITERATIONS = 20  # from a fit to recordings that may differ much
_STEP = 0.03  # of slopes and curvatures: over a likely error, not of one kink
_LEAST_READINGS = 30
"""Of a recording, below which it is not compared."""
_NATS = 8.0
"""Log-likelihood by which one number explains a difference that is named: four standard deviations,
because recordings times numbers are tried. Of 20 pairs of recordings of independently simulated
servos, the second with 0.8 of the gains, 18 are named (29 November 2026)."""
_LEAST_CHANGE = 0.05
"""Logarithm of the smallest factor that is named: servos of one batch differ by more."""
_CHANGES = np.linspace(-1.2, 1.2, 121)
"""Logarithms of factors that are tried, from 0.3 to 3.3."""
_MOST = 12  # recordings that are fitted apart
_SPREADS = np.geomspace(1 / 150, 2.0, 60)
"""Standard deviations between recordings that are tried, in those between units: from a thousandth
of a number, which no recording shows, to more than units of one servo differ by."""
GAINS = ("stiffness_per_s2", "damping_per_s")
"""Numbers that the P gain and the supply voltage scale together."""


@dataclass(frozen=True)
class Difference:
    """One recording that differs from the others.

    Attributes
    ----------
    recording : str
    name : str
        Of the fitted number that explains most of the difference.
    factor : Interval
        That number over the one of the other recordings.
    nats : float
        By how much the log-likelihood is better with a number of its own.
    """

    recording: str
    name: str
    factor: Interval
    nats: float

    def sentence(self, joint: str) -> str:
        """The difference in words."""
        return (
            f"{joint}: {self.recording} differs from the other recordings: {words_of(self.name)} "
            f"{self.factor.value:.2f} ({self.factor.low:.2f} to {self.factor.high:.2f}) of theirs "
            f"(Δ log-likelihood {self.nats:.0f})."
        )


@dataclass(frozen=True)
class Repeats:
    """What the recordings of a joint say of one another.

    Attributes
    ----------
    names : tuple of str
        Fitted numbers.
    spreads : ndarray, shape (parameters, spreads)
        Standard deviations between recordings that are possible, of fitted coordinates.
    probabilities : ndarray, shape (parameters, spreads)
    recordings : int
    differences : tuple of Difference
    """

    names: tuple[str, ...]
    spreads: NDArray[np.float64]
    probabilities: NDArray[np.float64]
    recordings: int
    differences: tuple[Difference, ...]

    @property
    def between(self) -> NDArray[np.float64]:
        """Medians of the standard deviations, (parameters,)."""
        half = (self.probabilities.cumsum(axis=1) < 0.5).sum(axis=1)
        return np.take_along_axis(self.spreads, half[:, None], axis=1)[:, 0]

    def of_the_next(self, rng: np.random.Generator, draws: int) -> NDArray[np.float64]:
        """Distance of the next recording from the mean of these, (draws, parameters)."""
        chance = rng.random((draws, len(self.names), 1))
        drawn = (self.probabilities.cumsum(axis=1)[:, :-1] < chance).sum(axis=2)
        spread = np.take_along_axis(self.spreads[None], drawn[:, :, None], axis=2)[:, :, 0]
        return spread * np.sqrt(1.0 + 1.0 / self.recordings) * rng.standard_normal(drawn.shape)


def compare_repeats(apart: Mapping[str, Apart]) -> Repeats | None:
    """Compare the recordings that were fitted apart; None without any."""
    if not apart:
        return None
    named = []
    # of two, either differs from the other
    for source in [*apart][1 if len(apart) == 2 else 0 :]:
        others = [one for name, one in apart.items() if name != source]
        difference = _difference(source, apart[source], others)
        named += [difference] if difference is not None else []
    named.sort(key=lambda d: -d.nats)
    return _repeats(apart, tuple(named))


def _repeats(apart: Mapping[str, Apart], differences: tuple[Difference, ...] = ()) -> Repeats:
    every = [*apart.values()]
    points = np.array([one.point for one in every])
    variances = np.array([np.diag(np.linalg.inv(one.precision)) for one in every], float)
    return repeats_of(points, variances, every[0].part.structure, differences)


def fit_apart(
    problem: Problem, point: NDArray[np.float64], least_rad: float, quantum_rad: float
) -> dict[str, Apart]:
    """The fit to each recording alone, by its name; empty of one recording.

    `problem`: all runs. `point` of shape (parameters,): of the fit to all of them. `least_rad`:
    least noise that a run may have [rad]. `quantum_rad`: step of the readings [rad]; 0 if there is
    none.
    """
    sources = dict.fromkeys(r.source for r in problem.runs)
    parts = {s: problem.only([r.source == s for r in problem.runs]) for s in sources}
    parts = {s: part for s, part in parts.items() if part.samples >= _LEAST_READINGS}
    if not 1 < len(parts) <= len(sources) <= _MOST:
        return {}
    return {s: _apart(part, point, least_rad, quantum_rad) for s, part in parts.items()}


def mean_point(apart: Mapping[str, Apart], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Numbers of the mean servo of recordings that were fitted apart, shape (parameters,).

    A number of a recording weighs as much as its error and the spread between recordings leave it.
    The fit to all readings is another point: motions of servos that differ have a mean that is no
    servo's, which can move the fit along its ridge by more than the servos are apart. It is off by
    no more than units of a servo differ by: numbers that no recording tells are those of that fit.

    `point` of shape (parameters,): of the fit to all recordings.
    """
    every, spread = [*apart.values()], np.diag(_repeats(apart).between ** 2)
    structure = every[0].part.structure
    straight = Straight(structure)
    points = straight.of(np.array([*(one.point for one in every), point]))
    slope = np.linalg.inv(straight.slope(points))
    errors = [np.linalg.inv(one.precision) + spread for one in every]
    errors.append(np.diag(_between_units(structure) ** 2))
    weights = np.linalg.inv(slope @ errors @ slope.mT)
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, points))
    return np.clip(straight.fitted(mean), *structure.box)


def between_recordings(
    structure: Structure,
    point: NDArray[np.float64],
    apart: Mapping[str, Apart],
    runs: Sequence[Run],
) -> tuple[NDArray[np.float64], ...]:
    """By how far readings differ from those of one servo, shape (samples,) for each run [rad].

    It is the motion with the numbers of the reading's recording less that with those of all. Zero
    in a recording that was not fitted apart.

    `point` of shape (parameters,): of that servo. `apart`: from `fit_apart`.
    """
    of_all = fresh_residuals(structure, structure.decode(point), runs)
    return tuple(
        fresh_residuals(structure, structure.decode(apart[run.source].point), [run])[0] - common
        if run.source in apart else np.zeros_like(common)
        for run, common in zip(runs, of_all, strict=True)
    )  # fmt: skip


@dataclass(frozen=True)
class Apart:
    """Fit to one recording alone.

    Attributes
    ----------
    part : Problem
        With the noise that is left without the other recordings.
    point : ndarray, shape (parameters,)
    precision : ndarray, shape (parameters, parameters)
    misfit : float
        Residual over noise, of all motions; NaN where that is not known.
    """

    part: Problem
    point: NDArray[np.float64]
    precision: NDArray[np.float64]
    misfit: float


def _apart(part: Problem, point: NDArray, least_rad: float, quantum_rad: float) -> Apart:
    """Fit to one recording, from the fit to all of them."""
    structure, runs = part.structure, part.runs
    residuals: list[NDArray[np.float64]] = []
    for _ in range(2):
        point = refine(part, local(part, point[None], _ITERATIONS, _STEP)[0].point[None]).point
        residuals = fresh_residuals(structure, structure.decode(point), runs)
        part = replace(part, noise_rad=noise_by_run(residuals, runs, least_rad))
    scaled = [r / n for r, n in zip(residuals, part.noise_rad, strict=True)]
    temperature = temperature_of(scaled, runs, len(point))
    misfit = overall(goodness_of_fit(structure, structure.decode(point), runs, quantum_rad))
    if misfit > DESCRIBED:
        temperature *= misfit**2
    prior = structure.prior_precision
    bent = (curvature(part, point, _STEP) - prior) / temperature
    return Apart(part, point, bent + prior + 1e-9 * np.eye(len(bent)), misfit)


def _directions(names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """What one recording may differ in: a number, the position loop's gains, or the inertia."""
    at = {name: np.array([n == name for n in names], float) for name in names[:-1]}
    several = {"gains (stiffness and damping)": GAINS, "torques over inertia": PER_INERTIA}
    for name, members in several.items():
        member_directions = [at[member] for member in members if member in at]
        if len(member_directions) > 1:
            at[name] = np.sum(member_directions, axis=0)
    return at


def _difference(source: str, one: Apart, others: Sequence[Apart]) -> Difference | None:
    """In what a recording differs from all others; None if it does not.

    Whether it does and by how much is asked of the difference of the two fits, in which direction
    of the run's own readings: a large difference is beyond a parabola. What does not differ is as
    all recordings have it in the first; the second have it as the others alone do, which may be far
    along their ridge, so that they do not say by how much. The factor is as uncertain as what it
    leaves of the difference (Birge's ratio, if that is above 1).
    """
    structure = one.part.structure
    rest = sum(o.precision for o in others)
    middle = np.linalg.solve(rest, sum(o.precision @ o.point for o in others))
    weight = np.linalg.inv(np.linalg.inv(one.precision) + np.linalg.inv(rest))
    pull = weight @ (one.point - middle)
    directions = _directions(structure.names)
    nats = {n: 0.5 * (v @ pull) ** 2 / (v @ weight @ v) for n, v in directions.items()}
    if max(nats.values()) < _NATS:
        return None
    costs = {}
    for name, direction in directions.items():
        if nats[name] < _NATS:
            continue
        points = np.clip(middle + _CHANGES[:, None] * direction, *structure.box)
        costs[name] = float(one.part.costs(points).min())
    name = min(costs, key=lambda n: costs[n])
    direction = directions[name]
    bent = direction @ weight @ direction
    change = float(direction @ pull / bent)
    unexplained = one.point - middle - change * direction
    birge = unexplained @ weight @ unexplained / (len(unexplained) - 1)
    sd = np.sqrt(max(birge, 1.0) / bent)
    if abs(change) < _LEAST_CHANGE:
        return None
    factor = Interval(
        *(float(np.exp(change + z * sd)) for z in (0.0, -HALF_WIDTH_SD, HALF_WIDTH_SD))
    )
    return Difference(source, name, factor, float(nats[name]))


def repeats_of(
    points: NDArray[np.float64],
    variances: NDArray[np.float64],
    structure: Structure,
    differences: tuple[Difference, ...] = (),
) -> Repeats:
    """How widely numbers vary between recordings, from fits to each alone.

    A moment estimate (DerSimonian and Laird's) is none half of the time if there are two
    recordings: intervals with it hold 65 % of the next ones if numbers vary by three standard
    errors. Here every size of the variation (`_SPREADS`) is as likely as any other before the
    recordings are seen, and the mean of all recordings is integrated out.

    `points`, `variances`: of the fitted coordinates, (recordings, parameters).

    References
    ----------
    Gelman, A. (2006). Prior distributions for variance parameters in hierarchical models. Bayesian
    Analysis 1: 515–534, section 2.
    """
    spreads = _between_units(structure)[:, None] * _SPREADS
    weight = 1.0 / (variances[:, :, None] + spreads**2)
    mean = (weight * points[:, :, None]).sum(axis=0) / weight.sum(axis=0)
    cost = np.log(weight.sum(axis=0)) - np.log(weight).sum(axis=0)
    cost += (weight * (points[:, :, None] - mean) ** 2).sum(axis=0)
    likelihood = np.exp(0.5 * (cost.min(axis=1, keepdims=True) - cost))
    probabilities = likelihood / likelihood.sum(axis=1, keepdims=True)
    return Repeats(structure.names, spreads, probabilities, len(points), differences)


def _between_units(structure: Structure) -> NDArray[np.float64]:
    """Standard deviations of numbers between units of a servo, shape (parameters,)."""
    return np.array([
        UNIT_SD if p.logarithmic
        else p.marginal_sd if np.isfinite(p.marginal_sd) else SERVO_TERMS[p.name].prior_sd
        for p in structure.parameters
    ])  # fmt: skip


def by_number(repeats: Repeats | None) -> dict[str, float]:
    """Standard deviations between recordings by the fitted number's name, if not 0."""
    if repeats is None:
        return {}
    return {
        name: float(sd)
        for name, sd in zip(repeats.names, repeats.between, strict=True)
        if sd > 0 and name != "offset_rad"
    }
