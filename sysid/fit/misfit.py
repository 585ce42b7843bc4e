"""What a servo that the model does not describe looks like: explanations, tried one by one.

Each explanation is the carried fit with one thing more, fitted from there: a low-pass filter in
front of the servo, play, a dead zone of the controller. The best is named where the likelihood is
decidedly better with it. Simulators do not run these, so the numbers stay those of the carried fit;
but a number that another explanation moves is not known better than the two are apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common import filters
from pupper_sysid.sysid.fit import kernel
from pupper_sysid.sysid.fit.run import Run
from pupper_sysid.sysid.fit.search import Fit, Problem, from_about, refine, search_widely
from pupper_sysid.sysid.fit.structure import Structure, servo_structure

_LOW_PASS_S = (0.004, 0.008, 0.016, 0.032, 0.064)
"""Time constants that are tried: below the first a filter is a delay, above the last a slow one."""
_SEARCHED_S = 0.016
"""Time constant from which a fit with a filter may lie far from the fit without it."""
_NATS = 10.0
"""Log-likelihood by which an explanation is named."""
_AS_LIKELY_NATS = -1.0
"""Log-likelihood from which the servo may as well be like that: a number that changes nothing has
it, by its own price of 1."""
_SHARES = np.array([0.4, 0.7, 0.95])
"""Of what friction holds back: parts that a dead zone or play is given at the start."""
_WORDS = {
    "backlash": ("backlash_rad", "play of {:.1f} mrad between motor and link"),
    "dead zone": ("dead_zone_rad", "a dead zone of {:.1f} mrad to either side in its controller"),
}  # fmt: skip


@dataclass(frozen=True)
class Explanation:
    """One thing more that describes a servo better.

    Attributes
    ----------
    words : str
    nats : float
        By how much the log-likelihood is better; about 0 where the data do not decide.
    dead_time_s : float
        Of the fit with it.
    point : ndarray, shape (parameters,), optional
        The carried structure's numbers in the fit with it, in fitted coordinates.
    """

    words: str
    nats: float
    dead_time_s: float
    point: NDArray[np.float64] | None = None

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
    """What describes the servo at least as well as the fit alone, best first.

    Parameters
    ----------
    problem : Problem
    best : Fit
        Of the carried structure.
    temperature : float
        How many readings count as one.
    anew : bool
        Whether a filter is searched for far from the fit, too, as it is where errors are larger
        than noise.
    rng : numpy.random.Generator
    """
    tried = _low_pass(problem, best, temperature, anew, rng)
    for feature in _WORDS:
        tried += _with_feature(problem, best, temperature, feature, rng)
    return sorted((x for x in tried if x.nats >= _AS_LIKELY_NATS), key=lambda x: -x.nats)


def decided(likely: Sequence[Explanation]) -> Explanation | None:
    """The best explanation if it is decidedly better than the fit alone."""
    return next((one for one in likely if one.nats > _NATS), None)


def filtered(run: Run, time_constant_s: float) -> Run:
    """The run with its command behind a first-order low-pass filter, at rest before."""
    ratio = time_constant_s / run.step_s
    left = np.exp(-1.0 / ratio)
    command = run.held[0]
    rest = command[0]
    end = rest + filters.filtered(
        np.array([1.0 - left, 0.0]), np.array([1.0, -left]), command - rest
    )
    before = np.concatenate([[rest], end[:-1]])
    mean = command + (before - command) * ratio * (1.0 - left)
    held = np.concatenate([mean[None], run.held[1:]])
    return replace(run, held=held, edges=kernel.edges_of(mean, end))


def _low_pass(
    problem: Problem, best: Fit, temperature: float, anew: bool, rng: np.random.Generator
) -> list[Explanation]:
    """The likeliest filter, and the slowest that is as likely as none."""
    structure = problem.structure
    anew = anew and structure.scales.free_air  # under load a search takes minutes
    fits = {}
    for constant in _LOW_PASS_S:
        behind, starts = _behind(problem, constant), _earlier(structure, best.point, constant)
        fits[constant] = refine(behind, starts)
        if anew and constant >= _SEARCHED_S:  # far from the fit without it
            fits[constant] = min(
                search_widely(behind, rng, starts, short=True), fits[constant], key=lambda f: f.cost
            )
    middle = min(fits, key=lambda t: fits[t].cost)
    for factor in (0.71, 1.41, 0.84, 1.19):  # between the constants that were tried
        between = middle * factor
        fits[between] = refine(_behind(problem, between), fits[middle].point[None])
        middle = min(fits, key=lambda t: fits[t].cost)
    nats = {t: (best.cost - fit.cost) / temperature - 1.0 for t, fit in fits.items()}
    slowest = max((t for t in fits if nats[t] >= _AS_LIKELY_NATS), default=middle)
    return [
        Explanation(
            f"a low-pass filter of about {1e3 * t:.0f} ms in front of it", nats[t],
            float(structure.decode(fits[t].point)[0]), fits[t].point,
        )
        for t in dict.fromkeys((middle, slowest))
    ]  # fmt: skip


def _behind(problem: Problem, time_constant_s: float) -> Problem:
    """The same fit with the commands behind a filter."""
    return replace(problem, runs=tuple(filtered(r, time_constant_s) for r in problem.runs))


def _earlier(structure: Structure, point: NDArray, time_constant_s: float) -> NDArray[np.float64]:
    """Points whose dead time is shorter by parts of a filter's lag, shape (starts, parameters)."""
    first = structure.parameters[0]
    delay = float(structure.decode(point)[0])
    starts = np.repeat(point[None], 4, axis=0)
    shorter = delay - time_constant_s * np.array([1.0, 0.75, 0.5, 0.0])
    starts[:, 0] = first.encode(np.clip(shorter, first.low, first.high))
    return starts


def _with_feature(
    problem: Problem, best: Fit, temperature: float, feature: str, rng: np.random.Generator
) -> list[Explanation]:
    structure = problem.structure
    if feature in structure.features:
        return []
    wider = servo_structure((*structure.features, feature), structure.scales)
    name, words = _WORDS[feature]
    values = np.repeat(wider.decode(wider.adopt(structure, best.point))[None], 6, axis=0)
    place = wider.names.index(name)
    values[:3, place] = 0.003, 0.01, 0.03
    if {"friction_rad_s2", "stiffness_per_s2"} <= {*wider.names}:
        # what friction holds back at the carried stiffness may be this in its place
        friction = values[3:, wider.names.index("friction_rad_s2")]
        values[3:, place] = _SHARES * friction / values[3:, wider.names.index("stiffness_per_s2")]
        friction *= 1.0 - _SHARES
    starts = np.clip(wider.encode(values), *wider.box)
    behind = replace(problem, structure=wider)
    fit = from_about(behind, refine(behind, starts), rng)
    values = wider.decode(fit.point)
    shared = [wider.names.index(name) for name in structure.names]
    return [
        Explanation(
            words.format(1e3 * values[place]), (best.cost - fit.cost) / temperature - 1.0,
            float(values[0]), fit.point[shared],
        )
    ]  # fmt: skip
