"""Whether the set-point's acceleration was limited, and in which runs.

A Feetech servo moves its set-point at a limited acceleration if a register says so: 254 is
39 rad/s² at 4,096 counts a turn, 0 is no limit. Few logs state the register, and it may differ
between the recordings of one servo, so it belongs to the recording. Slow motions do not show it,
fast tones and jumps do. `settled` fits one limit that each run may have, or not; if there is one,
a run may also have a limit some times as large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.loaded import search
from pupper_sysid.sysid.loaded.errors import correlation, noise_of
from pupper_sysid.sysid.loaded.runs import RAMP_SHARES, Run, costs, residuals, with_ramp
from pupper_sysid.sysid.loaded.search import Fit, Problem
from pupper_sysid.sysid.loaded.structures import Scales, Structure

_STARTS_RAD_S2 = (15.0, 40.0, 110.0)
_SCANNED_RAD_S2 = np.geomspace(5.0, 150.0, 64)
_TELLING_NATS = 20.0
_TELLING_SHARE = 0.1
"""Share of the cost that the limit must explain: less is what many a sluggish term would."""
_ROUNDS = 2


@dataclass(frozen=True)
class EitherWay(Problem):
    """A fit in which each run has the share of the limit that suits it best.

    Attributes
    ----------
    shares : tuple of float
        What is tried: 1 is the limit, inf none.
    """

    shares: tuple[float, ...] = (1.0, math.inf)

    def scaled(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """As of `Problem`, for every candidate and run the best way."""
        values = self.structure.decode(points)
        chosen = []
        for ways, noise in zip(self._ways(), self.noise_rad, strict=True):
            left = np.stack(residuals(self.structure, values, ways)) / noise
            best = np.argmin(_cost(left), axis=0)
            chosen.append(left[best, np.arange(len(best))])
        return np.concatenate(chosen, axis=1)

    def run_costs(
        self, columns: NDArray[np.float64], dead_time_s: NDArray[np.float64], index: int
    ) -> NDArray[np.float64]:
        """As of `Problem`, of the best way."""
        noise = self.noise_rad[index]
        each = [costs(columns, dead_time_s, way, noise) for way in self._ways()[index]]
        return np.min(each, axis=0)

    def scanned(self, fit: Fit) -> Fit:
        """The best local fit from the best limit at this point: the cost has many minima there."""
        place = self.structure.names.index("acceleration_limit")
        points = np.repeat(fit.point[None], len(_SCANNED_RAD_S2), axis=0)
        points[:, place] = np.log(_SCANNED_RAD_S2)
        best = points[np.argmin(self.costs(points))]
        return search.refine(self, np.array([fit.point, best]))

    def settle(self, fit: Fit) -> tuple[Run, ...]:
        """The runs, each with the share that suits it best.

        With the limit or without, unless another share explains a tenth of what both leave.
        """
        values = self.structure.decode(fit.point)[None]
        found = []
        for ways, noise in zip(self._ways(), self.noise_rad, strict=True):
            cost = _cost(np.concatenate(residuals(self.structure, values, ways)) / noise)
            best = int(np.argmin(cost))
            plain = 0 if cost[0] <= cost[-1] else len(ways) - 1
            telling = cost[best] < (1 - _TELLING_SHARE) * cost[plain]
            found.append(ways[best if telling else plain])
        return tuple(found)

    def _ways(self) -> list[list[Run]]:
        """Of each run the ways in which it is tried."""
        return [
            [run] if run.ramp_known else [with_ramp(run, share) for share in self.shares]
            for run in self.runs
        ]


def settled(
    start: Fit,
    structure: Structure,
    runs: tuple[Run, ...],
    noise_rad: tuple[float, ...],
    least_rad: float,
    rng: np.random.Generator,
) -> tuple[Scales, tuple[Run, ...], tuple[float, ...]]:
    """Scales with the limit, the runs that have it or not, and their noise.

    Parameters
    ----------
    start : Fit
        Of `structure`, without a limit.
    structure : Structure
    runs : tuple of Run
        `ramp_share` is kept where `ramp_known`.
    noise_rad : tuple of float
        Of each run.
    least_rad : float
        Least noise.
    rng : numpy.random.Generator

    Returns
    -------
    scales, runs, noise_rad
        As given where the runs state it, or do not show a limit.
    """
    if all(r.ramp_known for r in runs):
        return structure.scales, runs, noise_rad
    plain = search.search(Problem(structure, runs, noise_rad), rng, start.point[None])[0]
    limited = Structure((*structure.features, "acceleration"), structure.scales)
    place = limited.names.index("acceleration_limit")
    points = np.repeat(limited.adopt(structure, plain.point[None]), len(_STARTS_RAD_S2), axis=0)
    points[:, place] = np.log(_STARTS_RAD_S2)
    either = EitherWay(limited, runs, noise_rad)
    fit = either.scanned(search.search(either, rng, points)[0])
    gain = plain.cost - fit.cost
    found = either.settle(fit)
    nats = gain / correlation(limited, fit, found, noise_rad)
    if not structure.scales.acceleration_stated and (
        nats < _TELLING_NATS or gain < _TELLING_SHARE * plain.cost
    ):
        return structure.scales, runs, noise_rad
    for _ in range(_ROUNDS):
        noise_rad = noise_of(limited, fit, found, least_rad)
        either = EitherWay(limited, runs, noise_rad, RAMP_SHARES)
        # a local fit stays near the dead time that it began with, and a share makes up for that
        fit = search.evolve(either, [either.scanned(fit)], rng, short=True)
        found = either.settle(fit)
    if structure.scales.acceleration_stated:
        return structure.scales, found, noise_rad
    limit = float(limited.decode(fit.point)[place])
    least = min((r.ramp_share for r in found), default=1.0)
    if np.isfinite(least):  # the servo's own limit is the one that is reached first
        found = tuple(with_ramp(r, r.ramp_share / least) for r in found)
        limit *= least
    return replace(structure.scales, acceleration_rad_s2=limit), found, noise_rad


def _cost(scaled: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sum(np.sqrt(1.0 + scaled**2) - 1.0, axis=-1)
