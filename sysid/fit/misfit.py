"""What a servo that the model does not describe looks like: explanations, tried one by one.

Each explanation is the exported fit with one thing more, fitted from there: a low-pass filter in
front of the servo, play, a dead zone or an integral term of the controller, more friction at rest,
gravity, or a link that bends and whose inertia the motor feels late. The best is named where the
likelihood is decidedly better with it. Simulators do not run these, so the numbers stay those of
the exported fit; but a number that another moves is not known better than the two are apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.filters import filtered
from pupper_sysid.common.interval import LEVEL
from pupper_sysid.servo_models import kernel
from pupper_sysid.sysid.fit.run import Run
from pupper_sysid.sysid.fit.search import (
    Fit,
    Problem,
    from_about,
    refine,
    refined,
    search_widely,
    temperature_at,
)
from pupper_sysid.sysid.fit.structure import Structure, servo_structure

_LOW_PASS_S = (0.004, 0.008, 0.016, 0.032, 0.064)
"""Time constants that are tried: below the first a filter is a delay, above the last a slow one."""
_CLOSER_S, _SEARCHED = tuple(np.geomspace(0.004, 0.064, 17)), 2
"""The same where errors are larger than noise, and how many of them are searched widely: of many
exact readings a constant that is off by a tenth makes no sense."""
_BETWEEN, _NEAR_BY = (0.71, 1.41, 0.84, 1.19), (0.92, 1.09, 0.96, 1.04)
"""Factors about the likeliest: all between two that were tried, then more closely."""
_REFINED = 2  # of the fits in coarse steps, those that are fitted in fine ones
_NATS = 10.0
"""Log-likelihood by which an explanation is named."""
_POSSIBLE_NATS = -3.0
"""Logarithm of a twentieth: an explanation that is less likely moves no end of a 90 % interval."""
_WITHIN_NATS = float(ndtri(0.5 + LEVEL / 2)) ** 2 / 2
"""Log-likelihood that a number at the end of its interval costs."""
_DELAY_STEP_S, _DELAY_STEPS = 0.0005, 14
"""First step to another dead time, half as long again each time, and how many at most: 0.3 s."""
_SHARES = np.array([0.4, 0.7, 0.95])
"""Of what friction holds back: parts that a dead zone or play is given at the start."""
_LEFT = (0.3, 0.05)
"""Shares of the friction that may be left then."""
_LINKS_HZ = tuple(np.geomspace(4.0, 40.0, 9))
_STARTS = 6  # of a feature's, those of the lowest cost
_TRADED = ("backlash", "dead zone")  # with friction


@dataclass(frozen=True)
class _Feature:
    """One thing more: its words, its numbers at the starts, and the unit of the first in words."""

    words: str
    starts: Mapping[str, tuple[float, ...]]
    unit: float = 1.0
    of: str = ""
    """What the starts are shares of."""
    free_air_only: bool = False
    """Whether a servo under load has this, or something alike, among its own terms."""


def _grid(**numbers: tuple[float, ...]) -> dict[str, tuple[float, ...]]:
    """Every combination of some values of numbers."""
    return dict(zip(numbers, zip(*product(*numbers.values()), strict=True), strict=True))


_FEATURES = {
    "backlash": _Feature(
        "play of {:.1f} mrad between motor and link", {"backlash_rad": (0.003, 0.01, 0.03)}, 1e-3
    ),
    "dead zone": _Feature(
        "a dead zone of {:.1f} mrad to either side in its controller",
        {"dead_zone_rad": (0.003, 0.01, 0.03)}, 1e-3,
    ),
    "integral": _Feature(
        "an integral term in its controller, of {:.2g}/s times the proportional one",
        {"integral_per_s": (0.5, 4.0, 32.0)},
    ),
    "stribeck": _Feature(
        "more friction at rest than in motion",
        {"stribeck_friction": (0.3, 1.0, 2.0), "stribeck_speed_rad_s": (0.3, 0.1, 0.5)},
        of="friction_rad_s2", free_air_only=True,
    ),
    "gravity": _Feature(
        "a load whose weight pulls at it",
        {"gravity_sin": (0.1, -0.1, 0.0), "gravity_cos": (0.0, 0.0, 0.1)},
        of="effort_rad_s2", free_air_only=True,
    ),
    "flexible": _Feature(
        "a link that bends, with {:.0f} % of the inertia behind it",
        _grid(link_share=(0.05, 0.15, 0.35), link_hz=_LINKS_HZ, link_damping_ratio=(0.05, 0.2)),
        0.01, free_air_only=True,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Explanation:
    """One thing more that describes a servo better.

    Attributes
    ----------
    words : str
    nats : float
        By how much the log-likelihood is better, less the price of the numbers that are added
        (Schwarz's criterion).
    dead_time_s : float
        Of the fit with it.
    weight : float
        Its posterior density over that of the fit alone, 1 at most.
    point : ndarray, shape (parameters,), optional
        The exported structure's numbers in the fit with it, in fitted coordinates.
    fitted : (Problem, Fit), optional
        With it.
    temperature : float
        At which its likelihood is counted: that of the better of the two fits.
    delays_s : tuple of float
        The shortest and the longest dead time with it.
    """

    words: str
    nats: float
    dead_time_s: float
    weight: float = 1.0
    point: NDArray[np.float64] | None = None
    fitted: tuple[Problem, Fit] | None = None
    temperature: float = 1.0
    delays_s: tuple[float, float] = (np.inf, -np.inf)

    @property
    def claim(self) -> str:
        """What it says of the servo."""
        if self.nats > _NATS:
            return f"the servo moves as if it had {self.words}"
        return f"the servo may as well have {self.words}"

    def sentence(self, joint: str) -> str:
        """The explanation in words."""
        return (
            f"{joint}: {self.claim} (Δ log-likelihood {self.nats:.0f}); its dead time would be "
            f"{1e3 * self.dead_time_s:.1f} ms then."
        )


def explanations(
    problem: Problem, best: Fit, temperature: float, anew: bool, rng: np.random.Generator
) -> list[Explanation]:
    """What describes the servo about as well as the fit alone, or better, best first.

    `best`: of the exported structure. `temperature`: how many readings count as one. `anew`:
    whether a filter is searched for far from the fit, too, as it is where errors are larger than
    noise.
    """
    tried = _low_pass(problem, best, temperature, anew, rng)
    for feature in _FEATURES:
        tried += _with_feature(problem, best, temperature, feature, rng)
    # all at the temperature of the best: a worse fit would excuse itself by its own errors
    temperature = min([temperature, *(temperature_at(one.problem, one.fit) for one in tried)])
    explained = [_explanation(one, problem, best, temperature) for one in tried]
    return sorted((x for x in explained if x is not None), key=lambda x: -x.nats)


@dataclass(frozen=True)
class _Tried:
    """A fit with one thing more, the numbers that it adds, and the exported structure's in it."""

    words: str
    problem: Problem
    fit: Fit
    numbers: int
    shared: Sequence[int]
    of_readings: bool = False
    """Whether its weight is that of the readings alone."""


def _explanation(
    tried: _Tried, problem: Problem, best: Fit, temperature: float
) -> Explanation | None:
    """What was tried beside the exported fit; None if it is less likely than counts."""
    fit, behind = tried.fit, tried.problem
    better = _tempered(problem, best, temperature) - _tempered(behind, fit, temperature)
    counted = better
    if tried.of_readings:
        counted = (_unlikely(problem, best) - _unlikely(behind, fit)) / temperature
    if counted < _POSSIBLE_NATS:
        return None
    price = 0.5 * tried.numbers * float(np.log(problem.samples / temperature))
    return Explanation(
        tried.words, better - price, float(behind.structure.decode(fit.point)[0]),
        float(np.exp(min(counted, 0.0))),
        fit.point[list(tried.shared)], (behind, fit), temperature,
    )  # fmt: skip


def decided(likely: Sequence[Explanation]) -> Explanation | None:
    """The best explanation if it is decidedly better than the fit alone."""
    return next((one for one in likely if one.nats > _NATS), None)


def with_delays(best: Explanation, likely: Sequence[Explanation]) -> Explanation:
    """The best explanation with the dead times that those as likely as it allow.

    `likely`: all, the best one among them.
    """
    ends = [best.dead_time_s]
    for one in likely:
        room = one.nats - best.nats + _WITHIN_NATS
        if one.fitted is not None and room >= 0:
            ends += [_end(*one.fitted, best.temperature, room, way) for way in (-1.0, 1.0)]
    return replace(best, delays_s=(min(ends), max(ends)))


def _end(problem: Problem, fit: Fit, temperature: float, room: float, way: float) -> float:
    """The dead time [s] to one side of a fit's at which the log-likelihood has lost `room`.

    All other numbers are fitted anew: gains trade against a delay along ridges that are longer than
    the scatter about one point of them.
    """
    structure = problem.structure
    first, least = structure.parameters[0], _tempered(problem, fit, temperature)
    point, delay, lost = fit.point, float(structure.decode(fit.point)[0]), 0.0
    step = _DELAY_STEP_S
    for _ in range(_DELAY_STEPS):
        there = float(np.clip(delay + way * step, first.low, first.high))
        if there == delay:
            break
        there_only = replace(first, low=there, high=there)
        at = replace(structure, parameters=(there_only, *structure.parameters[1:]))
        start = np.concatenate([[first.encode(there)], point[1:]])
        best = refine(replace(problem, structure=at), start[None])
        costs = _tempered(problem, best, temperature) - least
        if costs > room:
            return delay + (there - delay) * max(room - lost, 0.0) / (costs - lost)
        point, delay, lost, step = best.point, there, costs, 1.5 * step
    return delay


def low_passed(run: Run, time_constant_s: float) -> Run:
    """The run with its command behind a first-order low-pass filter, at rest before."""
    ratio = time_constant_s / run.step_s
    decay = np.exp(-1.0 / ratio)
    command = run.held[0]
    rest = command[0]
    end = rest + filtered(np.array([1.0 - decay, 0.0]), np.array([1.0, -decay]), command - rest)
    before = np.concatenate([[rest], end[:-1]])
    mean = command + (before - command) * ratio * (1.0 - decay)
    held = np.concatenate([mean[None], run.held[1:]])
    return replace(run, held=held, edges=kernel.edges_of(mean, end))


def _low_pass(
    problem: Problem, best: Fit, temperature: float, anew: bool, rng: np.random.Generator
) -> list[_Tried]:
    """The likeliest filter, and those that are about as likely."""
    structure = problem.structure
    anew = anew and structure.scales.free_air  # under load a search takes minutes
    coarse = {
        t: refine(_behind(problem.coarse, t), _earlier(structure, best.point, t))
        for t in (_CLOSER_S if anew else _LOW_PASS_S)
    }
    likeliest = sorted(coarse, key=lambda t: coarse[t].cost)
    if anew:
        likeliest = likeliest[:_SEARCHED]
    else:
        most = coarse[likeliest[0]].cost + 2.0 * _WITHIN_NATS * temperature
        likeliest = [t for t in likeliest if coarse[t].cost <= most]
    behind = {t: _behind(problem, t) for t in likeliest}
    fits = {t: refine(behind[t], coarse[t].point[None]) for t in likeliest}
    if anew:
        for t in likeliest:
            wide = search_widely(behind[t], rng, coarse[t].point[None], short=True)
            fits[t] = min(wide, fits[t], key=lambda f: f.cost)
    middle = min(fits, key=lambda t: fits[t].cost)
    # gains make up for a part of a filter, so that its own lie along a ridge
    fits[middle] = from_about(behind[middle], fits[middle], rng)
    for factors, least_nats in ((_BETWEEN, -np.inf), (_NEAR_BY, _NATS)):
        shared_temperature = min(temperature, temperature_at(behind[middle], fits[middle]))
        if best.cost - fits[middle].cost < least_nats * shared_temperature:
            break
        for factor in factors:
            between = middle * factor
            starts = _earlier(structure, fits[middle].point, between - middle)
            behind[between] = _behind(problem, between)
            fits[between] = refine(behind[between], starts)
            if fits[middle].cost < best.cost:  # there is a filter, so that its constant matters
                fits[between] = from_about(behind[between], fits[between], rng)
            middle = min(fits, key=lambda t: fits[t].cost)
    temperature = min(temperature, temperature_at(behind[middle], fits[middle]))
    most = _tempered(behind[middle], fits[middle], temperature) + _WITHIN_NATS
    as_likely = [t for t in fits if _tempered(behind[t], fits[t], temperature) <= most]
    return [
        _Tried(
            f"a low-pass filter of about {1e3 * t:.0f} ms in front of it", behind[t], fits[t], 1,
            range(len(best.point)),
        )
        for t in dict.fromkeys((middle, *as_likely))
    ]  # fmt: skip


def _tempered(problem: Problem, fit: Fit, temperature: float) -> float:
    """Minus the logarithm of the posterior's density at a fit."""
    cost = _unlikely(problem, fit)
    return cost / temperature + fit.cost - cost


def _unlikely(problem: Problem, fit: Fit) -> float:
    """Cost of a fit without its prior."""
    return fit.cost - float(problem.prior(fit.point[None])[0])


def _behind(problem: Problem, time_constant_s: float) -> Problem:
    """The same fit with the commands behind a filter."""
    return replace(problem, runs=tuple(low_passed(r, time_constant_s) for r in problem.runs))


def _earlier(structure: Structure, point: NDArray, time_constant_s: float) -> NDArray[np.float64]:
    """Points whose dead time is shorter by parts of a filter's lag, shape (starts, parameters)."""
    first = structure.parameters[0]
    delay = float(structure.decode(point)[0])
    starts = np.repeat(point[None], 4, axis=0)
    shorter = delay - time_constant_s * np.array([1.0, 0.75, 0.5, 0.0])
    starts[:, 0] = first.encode(np.clip(shorter, first.low, first.high))
    return starts


def _with_feature(
    problem: Problem, best: Fit, temperature: float, name: str, rng: np.random.Generator
) -> list[_Tried]:
    structure, feature = problem.structure, _FEATURES[name]
    if name in structure.features or (feature.free_air_only and not structure.scales.free_air):
        return []
    wider = servo_structure((*structure.features, name), structure.scales)
    if feature.of and feature.of not in wider.names:
        return []
    exported = wider.decode(wider.adopt(structure, best.point))
    count = len(next(iter(feature.starts.values())))
    values = np.repeat(exported[None], count, axis=0)
    for number, starts in feature.starts.items():
        full_value = 1.0
        if feature.of and not number.endswith("_rad_s"):
            full_value = exported[wider.names.index(feature.of)]
        values[:, wider.names.index(number)] = full_value * np.array(starts)
    place = wider.names.index(next(iter(feature.starts)))
    if name in _TRADED and {"friction_rad_s2", "stiffness_per_s2"} <= {*wider.names}:
        # what friction holds back at the exported stiffness may be this in its place
        traded = values.copy()
        friction = traded[:, wider.names.index("friction_rad_s2")]
        traded[:, place] = _SHARES * friction / traded[:, wider.names.index("stiffness_per_s2")]
        friction *= 1.0 - _SHARES
        values = np.concatenate([values, traded])
    starts = np.clip(wider.encode(values), *wider.box)
    behind = replace(problem, structure=wider)
    starts = starts[np.argsort(behind.coarse.costs(starts))[:_STARTS]]
    fits = [_from_coarse(behind, starts)]
    if best.cost - fits[0].cost > temperature:  # there is something, so that its size matters
        fits = [from_about(behind, fits[0], rng)]
    if name in _TRADED and {"friction_rad_s2", "stiffness_per_s2"} <= {*wider.names}:
        # what the two hold back together may be all that the data tell: the least likely friction
        known = np.concatenate([fits[0].point[None], starts])
        fits += [_with_less_friction(behind, known, share, place) for share in _LEFT]
    temperature = min(temperature, temperature_at(behind, fits[0]))
    likeliest = int(np.argmin([_tempered(behind, fit, temperature) for fit in fits]))
    gained = _tempered(problem, best, temperature)
    gained -= _tempered(behind, fits[likeliest], temperature)
    size = float(wider.decode(fits[likeliest].point)[place])
    box = wider.parameters[place]
    # one that is as small or as large as it may be is another thing
    sized = not (box.near(size, box.low) or box.near(size, box.high))
    if gained < _POSSIBLE_NATS:
        return []
    # by the readings alone: what they tell of friction is not its prior's to say
    most = min(_unlikely(behind, fit) for fit in fits) + temperature * _WITHIN_NATS
    return [
        _Tried(
            feature.words.format(float(wider.decode(fit.point)[place]) / feature.unit), behind, fit,
            len(wider.names) - len(structure.names),
            [wider.names.index(name) for name in structure.names],
            of_readings=k > 0 and _unlikely(behind, fit) <= most,
        )
        for k, fit in enumerate(fits)
        if (k == likeliest and sized) or (k > 0 and _unlikely(behind, fit) <= most)
    ]  # fmt: skip


def _with_less_friction(
    behind: Problem, known: NDArray[np.float64], share: float, place: int
) -> Fit:
    """The fit with no more friction than a share of the most that is in some points.

    From these points, with a larger dead zone or play (number `place`), which hold back as much.
    """
    wider = behind.structure
    friction, stiffness = (wider.names.index(n) for n in ("friction_rad_s2", "stiffness_per_s2"))
    values = wider.decode(known)
    limit = wider.parameters[friction]
    most = max(share * float(values[:, friction].max()), 1.01 * limit.low)
    less = np.minimum(values[:, friction], most)
    values[:, place] += (values[:, friction] - less) / values[:, stiffness]
    values[:, friction] = less
    bounded = list(wider.parameters)
    bounded[friction] = replace(limit, high=most)
    structure = replace(wider, parameters=tuple(bounded))
    starts = np.clip(structure.encode(values), *structure.box)
    fit = _from_coarse(replace(behind, structure=structure), starts)
    return replace(fit, point=np.clip(fit.point, *wider.box))


def _from_coarse(problem: Problem, starts: NDArray[np.float64]) -> Fit:
    """The best local fit from starts that are fitted in coarse steps first."""
    rough = refined(problem.coarse, starts)[:_REFINED]
    return refine(problem, np.array([fit.point for fit in rough]))
