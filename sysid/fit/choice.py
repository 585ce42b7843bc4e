"""Structures of one joint's servo, fitted, and the choice among them.

Every structure is fitted to the readings that count by output error, from seeded global starts and
from the fits of simpler structures, and scored on what was left out of the fit: a tone, or runs.
Its numbers are drawn from their posterior. Of the structures that the likelihood does not rule out,
the simplest whose error on unseen motion is about the smallest is exported; the intervals of its
numbers cover all of them (`choose`). A joint in free air is taken for a motor with any load where
that describes it decidedly better, or a profile of its set-point does (`settled`).

A joint in free air has the candidates of `sysid.fit.structure`; simulators run two of them. Under a
load or at several gains it is a motor with these friction terms or those (`FRICTIONS`).
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models import kernel
from pupper_sysid.sysid.fit.goodness import (
    DESCRIBED,
    DESCRIBED_ONE,
    goodness_of_fit,
    noise_by_run,
    overall,
)
from pupper_sysid.sysid.fit.misfit import Explanation, decided, explanations, with_delays
from pupper_sysid.sysid.fit.posterior import (
    FEW_ROUNDS,
    LEAST_FOLDS,
    ROUNDS,
    as_wide_as_folds,
    interval_of,
    sample,
    with_date_errors,
)
from pupper_sysid.sysid.fit.preparation import PreparedJoint
from pupper_sysid.sysid.fit.repeats import Repeats, compare_repeats
from pupper_sysid.sysid.fit.results import (
    TELLING_NATS,
    plausible,
)
from pupper_sysid.sysid.fit.run import Run, fresh_residuals
from pupper_sysid.sysid.fit.scores import held_out_residuals
from pupper_sysid.sysid.fit.search import (
    LEAVES_MOTION,
    Fit,
    Problem,
    evolved,
    fit_folds,
    folds_of,
    from_about,
    group_count,
    in_blocks,
    price_of_a_number,
    refine,
    search_widely,
    temperature_at,
    without_limit,
)
from pupper_sysid.sysid.fit.structure import (
    LIMITS,
    SIMULATED,
    Structure,
    candidate,
    servo_structure,
)
from pupper_sysid.sysid.lag.lag_budget import LagBudget

FRICTIONS = (
    (),
    ("stribeck",),
    ("load friction",),
    ("load friction", "static"),
    ("load friction", "quadratic"),
    ("load friction", "torque limit"),
    ("load friction", "quadratic", "static"),
    ("load friction", "quadratic", "torque limit"),
)
"""Friction of a motor under load, simplest first; then `ADDITIONS` to the best of them."""
SHORT_FRICTIONS = ((), ("load friction",))
"""For a joint in free air that DelayedPD does not describe."""
_PROFILE_NATS = 10.0
"""Log-likelihood by which a limited acceleration is better, from which all have it."""
_LEAST_GAIN = 0.05  # of log-likelihood: below it a limit that is a tenth higher is not reached
_CORRELATED = 4.0
"""Temperature above which residuals are a motion, not noise, however small they are beside it: of
recordings of the fitted structure (`benchmarks/wide_twins.py`, seed 170) none is above 1.2."""
_DESCRIBES_BETTER = 0.75
"""Errors over those of DelayedPD, below which a servo with more terms is exported."""
ADDITIONS = ("damping", "acceleration", "slew", "dead zone", "stribeck", "start duty")

_ACCELERATIONS_RAD_S2 = (6.0, 15.0, 40.0, 110.0)
"""Starts of a limit on the set-point's acceleration: its cost has many minima. A Feetech servo's
register counts 0.153 rad/s² from 1 to 254, whose largest is 39."""
_SHARES_OF_LAG = (0.1, 0.3, 0.5, 0.7)
_MOST_COMPARED = 3
_PREFERENCE = 1.02
"""Error on unseen motion, over the smallest, up to which a simpler structure is exported."""
_QUIETER, _QUIETER_ROUNDS = 0.7, 2
"""Noise that a fit leaves over the noise that it was weighed with, below which structures are
fitted anew; how often."""


@dataclass(frozen=True)
class Fitted:
    """One structure, fitted to one joint.

    Attributes
    ----------
    structure : Structure
    fit : Fit
        To all runs.
    draws : ndarray, shape (draws, parameters), or None
        From the posterior, in fitted coordinates.
    temperature : float
        How many readings count as one.
    folds : list of Fit or None
        Without the runs of each of `folds_of`; None where it was not compared.
    r_hat, effective : float
        Of the draws: see `sysid.fit.posterior.Posterior`.
    """

    structure: Structure
    fit: Fit
    draws: NDArray[np.float64] | None = None
    temperature: float = 1.0
    folds: list[Fit] | None = None
    r_hat: float = float("nan")
    effective: float = float("nan")

    @property
    def values(self) -> NDArray[np.float64]:
        """The fitted numbers, shape (parameters,)."""
        return self.structure.decode(self.fit.point)


def stages(ready: PreparedJoint) -> tuple[str, ...]:
    """Fits of a joint that can be made side by side, for `fit_structures`."""
    return SIMULATED if ready.scales.free_air else (("under load",))


def fit_structures(ready: PreparedJoint, stage: str) -> list[Fitted]:
    """Fit one of `SIMULATED` in free air, or the structures under load."""
    rng = ready.fit_rng()
    if not ready.scales.free_air:
        return _under_load(ready, rng)
    structure = candidate(stage, ready.scales)
    tried = {s.features: Fitted(s, fit) for s, fit in ready.first.values() if structure.contains(s)}
    fitted = _fitted(ready, structure, tried, rng, ready.first[stage][1])
    return [*tried.values(), _compared(ready, fitted, tried, rng)]


def _fitted(
    ready: PreparedJoint,
    structure: Structure,
    tried: Mapping[tuple[str, ...], Fitted],
    rng: np.random.Generator,
    first: Fit | None = None,
    short: bool = False,
) -> Fitted:
    """The best fit to all runs; structures that this one contains are among its starts."""
    problem = ready.bounded(structure)
    near = [f for f in tried.values() if structure.contains(f.structure)] or [*tried.values()]
    more = [structure.adopt(f.structure, f.fit.point) for f in near]
    if first is not None:
        more.append(first.point)
    elif structure.features in tried:
        more.append(tried[structure.features].fit.point)
    if "acceleration_limit" in structure.names and not np.isfinite(
        ready.scales.acceleration_rad_s2
    ):
        place = structure.names.index("acceleration_limit")
        for start in list(more):
            for limit in _ACCELERATIONS_RAD_S2:
                more.append(np.where(np.arange(len(start)) == place, np.log(limit), start))
    starts = np.array(more)
    if not ready.scales.free_air:  # the first structure was searched for
        best = evolved(problem, starts, rng, short)
    elif first is not None and temperature_at(problem, refine(problem, starts)) <= LEAVES_MOTION:
        # a search of the whole box finds nothing that is better
        best = _without_slight_limits(problem, evolved(problem, starts, rng, short=True))
    else:
        best = _without_slight_limits(problem, search_widely(problem, rng, starts, short))
    return Fitted(structure, best)


def _as_late(structure: Structure, point: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Critically damped servos that are as late as one at a point, by other dead times.

    Behind a profile the two parts of a lag are nearly the same motion, and the cost along their
    ridge is rugged. None of a structure without damping.
    """
    if "damping_per_s" not in structure.names:
        return []
    parts = [structure.names.index(n) for n in ("dead_time_s", "stiffness_per_s2", "damping_per_s")]
    dead_time_s, stiffness, damping = structure.decode(point)[parts]
    lag_s, servos = dead_time_s + damping / stiffness, []
    for share in _SHARES_OF_LAG:
        rate = 2.0 / ((1.0 - share) * lag_s)
        values = structure.decode(point)
        values[parts] = share * lag_s, rate**2, 2.0 * rate
        servos.append(np.clip(structure.encode(values), *structure.box))
    return servos


def _without_slight_limits(problem: Problem, best: Fit) -> Fit:
    """The fit in free air, out of reach of limits that are hardly better than none.

    A torque that is cut for an instant makes up for what a step of the simulation, or a term that
    the servo has besides, is off.
    """
    names = problem.structure.names
    if not problem.structure.scales.free_air:
        return best
    least = price_of_a_number(problem, best)
    for limit in (names.index(name) for name in LIMITS if name in names):
        higher = best.point + 0.1 * (np.arange(len(names)) == limit)
        points = np.array([best.point, np.clip(higher, *problem.structure.box)])
        reached = np.ptp(problem.costs(points) - problem.prior(points)) > _LEAST_GAIN
        if reached and (without := without_limit(problem, best, limit)).cost < best.cost + least:
            best = without
    return best


def _under_load(
    ready: PreparedJoint,
    rng: np.random.Generator,
    frictions: Sequence[tuple[str, ...]] = FRICTIONS,
    most: float = float("inf"),
    profiled: Fitted | None = None,
) -> list[Fitted]:
    """Structures of a motor, those with draws that the likelihood does not rule out.

    None of them if the best one leaves more than `most` of residual over noise. All have a limit on
    the set-point's acceleration if there is a fit in free air that has one (`profiled`), or if that
    is better.
    """
    scales = ready.scales
    stated = scales.stated_features
    plain, first = next(iter(ready.first.values()))
    tried = {plain.features: Fitted(plain, first)}

    def try_out(*features: str, short: bool = False) -> None:
        structure = servo_structure(("back-EMF", *features), scales)
        tried[structure.features] = _fitted(ready, structure, tried, rng, short=short)

    if profiled is not None:
        features = [f for f in profiled.structure.features if f != "back-EMF"]
        structure = servo_structure(("back-EMF", *features), scales)
        near = structure.adopt(profiled.structure, profiled.fit.point)
        fit = refine(ready.bounded(structure), near[None])
        tried[structure.features] = Fitted(structure, fit)
        stated = tuple(dict.fromkeys((*stated, "acceleration")))
    elif "acceleration" not in stated:
        # first, because friction that grows with the load imitates a profile
        limited = (*stated, "acceleration")
        try_out(*stated)
        try_out(*limited)
        nats = _nats(ready, tried.values())
        names = [tried["back-EMF", *features].structure.name for features in (stated, limited)]
        if nats[names[0]] - nats[names[1]] > _PROFILE_NATS:
            stated = limited
    for features in frictions:
        if servo_structure(("back-EMF", *features, *stated), scales).features not in tried:
            try_out(*features, *stated)
    for addition in ADDITIONS:
        best = min(tried.values(), key=lambda f: f.fit.cost).structure.features[1:]
        if addition not in best:
            try_out(*best, addition, short=True)
    best = min(tried.values(), key=lambda f: f.fit.cost)
    if overall(goodness_of(ready, best)) > most:
        return []
    nats = _nats(ready, tried.values())
    likely = sorted(plausible(nats), key=lambda name: nats[name])[:_MOST_COMPARED]
    return [
        _compared(ready, f, tried, rng) if f.structure.name in likely else f for f in tried.values()
    ]


def _compared(
    ready: PreparedJoint,
    fitted: Fitted,
    tried: Mapping[tuple[str, ...], Fitted],
    rng: np.random.Generator,
) -> Fitted:
    """The fit with draws from its posterior, and with the fits to what is left of each fold."""
    structure, problem = fitted.structure, ready.bounded(fitted.structure)
    best = refine(problem, fitted.fit.point[None])
    temperature = temperature_at(problem, best)
    misfit = overall(goodness_of(ready, replace(fitted, fit=best)))
    rounds = FEW_ROUNDS if misfit > DESCRIBED else ROUNDS
    posterior = sample(problem, best, temperature, rng, rounds)
    points = posterior.points
    best = min(best, refine(problem, posterior.best.point[None]), key=lambda f: f.cost)
    best = _without_slight_limits(problem, best)
    parents = [
        (f.structure, f.folds)
        for f in tried.values()
        if f.folds and structure.contains(f.structure)
    ]
    parts = folds_of(problem.runs)
    folds = fit_folds(problem, parts, rng, points, parents)
    polled = ready.lag.feedback.kind == "lattice"
    points = with_date_errors(points, problem, best, ready.recorded, polled, rng)
    left_out, groups = folds, group_count(problem.runs)
    if len(parts) < LEAST_FOLDS:
        blocks, apart = in_blocks(problem)
        left_out, groups = fit_folds(blocks, apart, rng, points), len(apart)
    points = as_wide_as_folds(points, structure, best, left_out, groups)
    points = np.clip(points, *structure.box)
    return replace(
        fitted, fit=best, draws=points, temperature=temperature, folds=folds,
        r_hat=posterior.r_hat, effective=posterior.effective,
    )  # fmt: skip


def _nats(ready: PreparedJoint, fitted: Iterable[Fitted]) -> dict[str, float]:
    """Log-likelihood below the best by name, one more per feature (Akaike's price of a number).

    All are counted at the temperature of the best one, or a worse fit would excuse itself.
    """
    fitted = [*fitted]
    best = min(fitted, key=lambda f: f.fit.cost)
    temperature = temperature_at(ready.bounded(best.structure), best.fit)
    count = {f.structure.name: len(f.structure.parameters) for f in fitted}
    least = {f.structure.name: f.fit.cost / temperature + count[f.structure.name] for f in fitted}
    lowest = min(least.values())
    return {name: value - lowest for name, value in least.items()}


def joined(stages: Mapping[str, Sequence[Fitted]]) -> list[Fitted]:
    """The fits of all stages, each structure once."""
    return list({f.structure.name: f for of_stage in stages.values() for f in of_stage}.values())


# ------------------------------------------------------------------------------- choice


@dataclass(frozen=True)
class Choice:
    """The structure that is exported, and those that the data do not tell from it.

    Attributes
    ----------
    exported : Fitted
        Fitted to all readings.
    likely : tuple of Fitted
        With draws, the exported one among them.
    nats : dict of str to float
        By how much the log-likelihood of each is below that of the best.
    unseen_rad : dict of str to float
        RMS error on unseen motion of those that were compared.
    noise_rad : tuple of float
    lag : LagBudget
        With dead time and offset.
    repeats : Repeats or None
        What several recordings in free air say of one another; the draws are widened by it.
    misfit : Explanation or None
        One thing more that describes the servo decidedly better.
    """

    exported: Fitted
    likely: tuple[Fitted, ...]
    nats: dict[str, float]
    unseen_rad: dict[str, float]
    noise_rad: tuple[float, ...]
    lag: LagBudget
    repeats: Repeats | None = None
    misfit: Explanation | None = None


def choose(ready: PreparedJoint, fitted: Sequence[Fitted]) -> Choice:
    """The structure that is exported, among those that were compared.

    `fitted`: all structures, from `fit_structures`.
    """
    simulated = [f for f in fitted if not ready.scales.free_air or f.structure.name in SIMULATED]
    nats = _nats(ready, simulated)
    compared = [f for f in simulated if f.draws is not None]
    unseen = {f.structure.name: _unseen(ready, f) for f in compared}
    likely = [f for f in compared if f.structure.name in plausible(nats)]
    if not likely:
        likely = [min(compared, key=lambda f: nats[f.structure.name])]
    exported = simplest(likely, nats, unseen)
    noise = ready.noise_rad
    if not ready.scales.free_air:  # the noise of the first structure was that of a worse one
        for _ in range(2):
            structure, values = exported.structure, exported.values
            parts = fresh_residuals(structure, values, ready.alike)
            noise = noise_by_run(parts, ready.runs, ready.least_rad)
            problem = replace(ready.problem(structure), noise_rad=noise)
            exported = replace(exported, fit=refine(problem, exported.fit.point[None]))
    likely = [exported if f.structure.name == exported.structure.name else f for f in likely]
    repeats = compare_repeats(ready.apart(exported.structure, exported.fit))
    if repeats is not None:
        likely = [_as_repeats(f, repeats, ready.fit_rng()) for f in likely]
        exported = next(f for f in likely if f.structure.name == exported.structure.name)
    lag = ready.lag.with_dead_time(_dead_time(ready, exported, likely), float(exported.values[-1]))
    return Choice(exported, tuple(likely), nats, unseen, noise, lag, repeats)


def _as_repeats(fitted: Fitted, repeats: Repeats, rng: np.random.Generator) -> Fitted:
    """The fit with draws as wide as recordings differ, in the numbers that it has, too."""
    assert fitted.draws is not None
    shift = dict(zip(repeats.names, repeats.of_the_next(rng, len(fitted.draws)).T, strict=True))
    none = np.zeros(len(fitted.draws))
    draws = fitted.draws + np.array([shift.get(name, none) for name in fitted.structure.names]).T
    return replace(fitted, draws=np.clip(draws, *fitted.structure.box))


def simplest(
    likely: Sequence[Fitted], nats: Mapping[str, float], unseen_rad: Mapping[str, float]
) -> Fitted:
    """The structure of fewest parameters that predicts unseen motion about as well as any.

    Structures of as many parameters cannot overfit one another: between them the likelihood
    decides, whose scatter over searches is far below that of the fits without a part.
    """
    by_count: dict[int, Fitted] = {}
    for f in sorted(likely, key=lambda f: nats[f.structure.name]):
        by_count.setdefault(len(f.structure.parameters), f)
    lowest = min(unseen_rad[f.structure.name] for f in by_count.values())
    if not np.isfinite(lowest):  # no folds
        return min(likely, key=lambda f: nats[f.structure.name])
    return next(
        f for _, f in sorted(by_count.items())
        if unseen_rad[f.structure.name] <= _PREFERENCE * lowest
    )  # fmt: skip


def _unseen(ready: PreparedJoint, fitted: Fitted) -> float:
    """RMS error on what was left out [rad]; NaN without folds."""
    runs = ready.alike
    folds = folds_of(runs)
    left_out = held_out_residuals(fitted.structure, fitted.folds or [], folds, runs)
    return rms(*left_out.values())


def _dead_time(ready: PreparedJoint, exported: Fitted, likely: Sequence[Fitted]) -> Interval:
    """Dead time, the interval over all structures that the data allow and the dates' doubt."""
    value = float(exported.values[0])
    ends = [intervals(f, value)["dead_time_s"] for f in likely]
    # readings that were taken later than dated lengthen the dead time, as they do the lag
    doubt = max(t.read_time_doubt_s for t in ready.recorded)
    hull = Interval(value, min(e.low for e in ends), max(e.high for e in ends))
    return less_age(hull, ready, doubt)


def less_age(dead_time_s: Interval, ready: PreparedJoint, doubt_s: float = 0.0) -> Interval:
    """A fitted dead time without the age of readings whose poll is unresolved: up to a loop."""
    fitted, age = dead_time_s, ready.lag.feedback.time_doubt_s
    low = max(fitted.low - 2 * age - doubt_s, 0.0)
    # readings are no older than the fitted dead time is long
    return Interval(max(fitted.value - age, fitted.value / 2), low, fitted.high + doubt_s)


def intervals(fitted: Fitted, dead_time_s: float | None = None) -> dict[str, Interval]:
    """Interval of each fitted number, and of the back-EMF where the structure has one."""
    structure, values = fitted.structure, fitted.values.copy()
    assert fitted.draws is not None
    draws = structure.decode(fitted.draws)
    if dead_time_s is not None:
        values[0] = dead_time_s
    ends = {
        name: interval_of(name, float(value), of_number)
        for name, value, of_number in zip(structure.names, values, draws.T, strict=True)
    }
    dead, box = ends["dead_time_s"], structure.parameters[0]
    if box.near(dead.low, box.low):  # where the search ends nothing speaks against none
        ends["dead_time_s"] = replace(dead, low=0.0)
    if {"no_load_speed_rad_s", "effort_rad_s2"} <= ends.keys():
        at = [structure.names.index(n) for n in ("effort_rad_s2", "no_load_speed_rad_s")]
        value = float(values[at[0]] / values[at[1]])
        ratio = draws[:, at[0]] / draws[:, at[1]]
        ends["back_emf_per_s"] = interval_of("back_emf_per_s", value, ratio)
    if fitted.structure.scales.free_air and fitted.structure.kind == kernel.SERVO:
        ends["braking_per_s"] = braking(fitted)
    return ends


def settled(
    ready: PreparedJoint, every: list[Fitted]
) -> tuple[PreparedJoint, list[Fitted], Choice]:
    """The joint, its fits and the choice among them.

    A joint in free air is taken for any servo, with an unknown load, where a profile of the
    set-point describes it better, or DelayedPD does not and such a servo may.
    """
    if not ready.scales.free_air:
        return ready, every, _explained(ready, choose(ready, every))
    ready, every = _with_their_noise(ready, every)
    choice = choose(ready, every)
    goodness, plain = goodness_of(ready, choice.exported), _explained(ready, choice)
    profiled, gained = with_profile(ready, choice.exported)
    stated = bool(np.isfinite(ready.scales.acceleration_rad_s2))
    enough = -_PROFILE_NATS if stated else _PROFILE_NATS  # a register is believed unless refuted
    if gained > enough and not stated:  # it was searched for, so what else there may be is, too
        plain = _explained(ready, choice, anew=True)
    # in cost, because likelihoods are counted at temperatures of their own
    alternative = -np.inf if plain.misfit is None else plain.misfit.nats * plain.misfit.temperature
    most = _DESCRIBES_BETTER * overall(goodness)
    if gained < enough or choice.exported.fit.cost - profiled.fit.cost < alternative:
        plain, profiled = _perhaps_profiled(ready, plain, profiled, gained), None
    elif stated or not undescribed(goodness_of(ready, profiled)):
        most = np.inf
    else:  # a motor's friction beside it may describe it
        most = DESCRIBED
    if profiled is None and not undescribed(goodness):
        return ready, every, plain
    any_servo = ready if profiled is None else ready.with_noise_of(profiled.structure, profiled.fit)
    any_servo = any_servo.as_any_servo()
    loaded = _under_load(any_servo, any_servo.fit_rng(), SHORT_FRICTIONS, most, profiled)
    if not loaded:
        if profiled is not None:
            plain = _perhaps_profiled(ready, plain, profiled, gained)
        return ready, every, plain
    wider = choose(any_servo, loaded)
    if profiled is None and choice.exported.fit.cost - wider.exported.fit.cost < alternative:
        return ready, every, plain  # that is no term of a servo
    # the noise that `most` is relative to is an upper bound, which a worse fit finds larger
    smaller = _DESCRIBES_BETTER * _error_rad(ready, choice.exported)
    if profiled is None and _error_rad(any_servo, wider.exported) > smaller:
        return ready, every, plain
    return any_servo, loaded, _explained(any_servo, wider)


def _with_their_noise(
    ready: PreparedJoint, every: list[Fitted]
) -> tuple[PreparedJoint, list[Fitted]]:
    """The joint and its fits, made anew where they leave far less noise than they were given.

    Noise is what the first fits leave; one that missed a motion's limits hides that motion.
    """
    for _ in range(_QUIETER_ROUNDS):
        best = min(every, key=lambda f: f.fit.cost)
        quieter = ready.with_noise_of(best.structure, best.fit)
        if min(map(operator.truediv, quieter.noise_rad, ready.noise_rad)) > _QUIETER:
            break
        first = {
            f.structure.name: (
                f.structure, refine(quieter.problem(f.structure), f.fit.point[None])
            )
            for f in every
        }  # fmt: skip
        ready = replace(quieter, first=first)
        every = joined({stage: fit_structures(ready, stage) for stage in stages(ready)})
    return ready, every


def _explained(ready: PreparedJoint, choice: Choice, anew: bool = False) -> Choice:
    """The choice with what a misfit looks like; `anew` searches for it far from the fit."""
    exported = choice.exported
    anew = anew or (ready.scales.free_air and exported.temperature > _CORRELATED)
    anew = anew or bool(undescribed(goodness_of(ready, exported)))
    if not (anew or ready.scales.free_air):
        return choice  # a motor under load has enough terms to imitate a filter
    likely = []
    for fitted in choice.likely:
        if fitted is exported or ready.scales.free_air:
            likely += _alternatives(
                ready, fitted, exported, choice.nats, anew and fitted is exported
            )
    likely.sort(key=lambda one: -one.nats)
    named = decided(likely)
    if named is not None:
        named = with_delays(named, likely)
        age = ready.lag.feedback.time_doubt_s
        dead, *ends = (max(t - age, 0.0) for t in (named.dead_time_s, *named.delays_s))
        named = replace(named, dead_time_s=dead, delays_s=(ends[0], ends[1]))
    elif likely and exported.draws is not None and ready.scales.free_air:
        choice = _stacked(ready, choice, likely)
    return replace(choice, misfit=named)


def _alternatives(
    ready: PreparedJoint, fitted: Fitted, exported: Fitted, nats: Mapping[str, float], anew: bool
) -> list[Explanation]:
    """What explains the servo beside a likely structure, in the exported one's numbers."""
    problem = ready.bounded(fitted.structure)
    best = replace(fitted.fit, cost=float(problem.costs(fitted.fit.point[None])[0]))
    tried = explanations(problem, best, exported.temperature, anew, ready.fit_rng())
    if fitted is exported:
        return tried
    below = nats[fitted.structure.name] - nats[exported.structure.name]
    shared = [
        (exported.structure.names.index(name), k)
        for k, name in enumerate(fitted.structure.names) if name in exported.structure.names
    ]  # fmt: skip
    alternatives = []
    for one in tried:
        assert one.point is not None
        point = exported.fit.point.copy()
        for place, k in shared:
            point[place] = one.point[k]
        weight = min(one.weight * float(np.exp(-below)), 1.0)
        alternatives.append(replace(one, nats=one.nats - below, weight=weight, point=point))
    return alternatives


def _stacked(ready: PreparedJoint, choice: Choice, alternatives: Sequence[Explanation]) -> Choice:
    """The choice with draws of the exported servo about its numbers in each alternative, too.

    The data do not tell the servo from the alternatives: each has draws in proportion to its
    likelihood.
    """
    exported = choice.exported
    assert exported.draws is not None
    apart, weights = [np.zeros_like(exported.fit.point)], [1.0]
    for one in alternatives:
        if one.point is not None:
            apart.append(one.point - exported.fit.point)
            weights.append(one.weight)
    ends = np.cumsum(weights) / np.sum(weights)
    places = (np.arange(len(exported.draws)) + 0.5) / len(exported.draws)
    turn = ready.fit_rng().permutation(np.searchsorted(ends, places))
    draws = np.clip(exported.draws + np.array(apart)[turn], *exported.structure.box)
    wider = replace(exported, draws=draws)
    likely = tuple(wider if f is exported else f for f in choice.likely)
    lag = replace(choice.lag, dead_time_s=_dead_time(ready, wider, likely))
    return replace(choice, exported=wider, likely=likely, lag=lag)


def with_profile(ready: PreparedJoint, exported: Fitted) -> tuple[Fitted, float]:
    """The exported servo with a limit on its set-point's acceleration, and its gain in likelihood.

    Damping imitates such a profile within the noise, at a dead time that is wrong by tens of
    milliseconds, so that goodness of fit does not show it. The limit is off in the Mini Pupper's
    servos, which have none, and where the header says so.
    """
    unlimited = [t.servo.set_point_acceleration_rad_s2 == np.inf for t in ready.recorded]
    unnamed = all(t.servo.model is None for t in ready.recorded)
    if all(unlimited) or (unnamed and ready.joint in JOINT_NAMES):
        return exported, -np.inf
    features = (*exported.structure.features, *ready.scales.stated_features, "acceleration")
    structure = servo_structure(tuple(dict.fromkeys(features)), ready.scales)
    tried = {exported.structure.features: exported}
    fitted = _fitted(ready, structure, tried, ready.fit_rng(), short=True)
    gained = _gained(ready, exported, fitted)
    if gained < -TELLING_NATS and unnamed:  # of a servo that may have none
        return fitted, gained
    quieter = ready.with_noise_of(structure, fitted.fit)
    if max(map(operator.truediv, quieter.noise_rad, ready.noise_rad)) < _QUIETER:
        # the noise was the motion that the exported one cannot make
        tried[structure.features] = fitted
        fitted = _fitted(quieter, structure, tried, ready.fit_rng(), short=True)
    problem, rng = quieter.bounded(structure), ready.fit_rng()
    best = refine(problem, fitted.fit.point[None])
    for start in _as_late(structure, best.point):
        fit = from_about(problem, refine(problem, start[None]), rng)
        best = min(best, fit, key=lambda f: f.cost)
    cost = float(ready.bounded(structure).costs(best.point[None])[0])
    fitted = replace(fitted, fit=Fit(best.point, cost))
    return fitted, _gained(ready, exported, fitted)


def _gained(ready: PreparedJoint, exported: Fitted, wider: Fitted) -> float:
    """Log-likelihood that a wider structure gains over the exported one."""
    nats = _nats(ready, (exported, wider))
    return nats[exported.structure.name] - nats[wider.structure.name]


def _perhaps_profiled(
    ready: PreparedJoint, choice: Choice, profiled: Fitted, gained: float
) -> Choice:
    """The choice with a profile as its explanation, where the data allow one as well.

    One that leaves the dead time where it is changes nothing.
    """
    dead = choice.lag.dead_time_s
    assert dead is not None
    delay = max(float(profiled.values[0]) - ready.lag.feedback.time_doubt_s, 0.0)
    if choice.misfit is not None or gained < -TELLING_NATS or dead.low <= delay <= dead.high:
        return choice
    limit = float(profiled.values[profiled.structure.names.index("acceleration_limit")])
    words = f"a profile whose acceleration is limited to about {limit:.0f} rad/s²"
    return replace(choice, misfit=Explanation(words, gained, delay))


def braking(fitted: Fitted) -> Interval:
    """Damping and back-EMF together, per inertia [1/s]."""
    names = fitted.structure.names

    def total(values: NDArray) -> NDArray:
        effort, speed, damping = (
            values[..., names.index(n)] if n in names else np.asarray(absent)
            for n, absent in (
                ("effort_rad_s2", 0.0), ("no_load_speed_rad_s", np.inf), ("damping_per_s", 0.0)
            )
        )  # fmt: skip
        return damping + effort / speed

    value = float(total(fitted.values))
    if fitted.draws is None:
        return Interval(value, value, value)
    return interval_of("damping", value, total(fitted.structure.decode(fitted.draws)))


def goodness_of(ready: PreparedJoint, fitted: Fitted) -> dict[str, float]:
    """Residual over noise by tone, or label of the run, as `goodness_of_fit` has it.

    Of several recordings it is that of the one which is described least; of all together if each
    has too few readings.
    """

    def of_runs(runs: Sequence[Run]) -> dict[str, float]:
        return goodness_of_fit(fitted.structure, fitted.values, runs, ready.quantum_rad)

    least: dict[str, float] = {}
    for source in ready.recordings if len(ready.recordings) > 1 else ():
        ratios = of_runs([r for r in ready.alike if r.source == source])
        ratios = {f"{motion} of {source}": r for motion, r in ratios.items()}
        least = max(least, ratios, key=_misfit)
    return least if np.isfinite(overall(least)) else of_runs(ready.alike)


def _misfit(goodness: Mapping[str, float]) -> float:
    """Above 1 where a servo is not described; 0 where that is not known."""
    ratios = [overall(goodness) / DESCRIBED, *(r / DESCRIBED_ONE for r in goodness.values())]
    return float(np.fmax.reduce([0.0, *ratios]))


def _error_rad(ready: PreparedJoint, fitted: Fitted) -> float:
    """RMS error on fresh readings [rad]."""
    return rms(*fresh_residuals(fitted.structure, fitted.values, ready.alike))


def undescribed(goodness: Mapping[str, float]) -> str | None:
    """Why the model's gains mean little; None if it describes the servo, as far as is known."""
    ratio = overall(goodness)
    if ratio > DESCRIBED:
        return f"the model does not describe this servo: its errors are {ratio:.1f} times the noise"
    if not _misfit(goodness) > 1.0:
        return None
    motion = max(goodness, key=lambda name: np.nan_to_num(goodness[name]))
    return (
        f"the model does not describe this servo in the motion {motion}: its errors are "
        f"{goodness[motion]:.1f} times the noise there"
    )
