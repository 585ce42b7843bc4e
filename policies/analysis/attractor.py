"""The orbit of a gait: the closed curve of actions and hidden states, and its shape.

A gait is a limit cycle: along their largest directions of variance, actions and hidden states of a
policy go round one closed curve. `principal_components` finds these directions for several
conditions together (no delay, more delay …), so that their orbits share axes; `closure` measures
how well an orbit returns to itself after a period, `area_ratio` how much of its area is left.
`orbits` does all of it for a policy with late joints.

Variance explained means little without the closure: three components also explain all of the noise
in three dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import Result, internal
from pupper_sysid.policies.analysis.trial import NAN, Trial, moving_frequency, walking
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks import perturbations
from pupper_sysid.policies.walks.rollouts import replay

Array = NDArray[np.float64]

DELAYS_MS = (0.0, 160.0, 320.0)
"""Of the published orbits."""


@dataclass(frozen=True)
class PrincipalComponents:
    """Directions of largest variance of states with d numbers."""

    mean: Array
    """Shape (d,)."""
    axes: Array
    """Orthonormal, largest variance first; the largest number of each is positive; shape (k, d)."""
    variance: Array
    """Along all d directions, largest first; shape (d,)."""

    @property
    def explained(self) -> Array:
        """Share of the variance along each axis, shape (k,)."""
        return self.variance[: len(self.axes)] / self.variance.sum()

    @property
    def participation_ratio(self) -> float:
        """Number of directions that the variance is spread over, 1 to d: (Σ λ)² / Σ λ²."""
        return float(self.variance.sum() ** 2 / (self.variance**2).sum())

    def orbit(self, states: NDArray[np.floating]) -> Array:
        """States (..., d) along the axes, shape (..., k)."""
        return (np.asarray(states, float) - self.mean) @ self.axes.T


def principal_components(
    conditions: Sequence[NDArray[np.floating]], count: int
) -> PrincipalComponents:
    """Principal components of several conditions together.

    States are centred on their common mean and not standardised: all of them have one unit, and a
    joint that hardly moves should count little. Every state counts the same, so conditions count
    by their lengths.

    Conditions are actions or hidden states of shape (..., d), for example (steps, robots, d);
    `count` axes are kept.
    """
    states = np.concatenate([np.asarray(c, float).reshape(-1, np.shape(c)[-1]) for c in conditions])
    if len(states) <= count or states.shape[1] < count:
        raise InputError(
            f"{count} principal components need more than {count} states of at least {count} "
            f"numbers; these are {len(states)} of {states.shape[1]}."
        )
    mean = states.mean(axis=0)
    # of the small d × d matrix: states are many
    variance, axes = np.linalg.eigh((states - mean).T @ (states - mean) / len(states))
    variance, axes = np.clip(variance[::-1], 0.0, None), axes.T[::-1][:count]
    if not variance[0] > 0:
        raise InputError("Nothing varies in these states: there is no orbit to look at.")
    # the sign of an axis is arbitrary: fix it, or figures would flip between machines
    largest = np.abs(axes).argmax(axis=1)
    axes = axes * np.sign(axes[np.arange(count), largest])[:, None]
    return PrincipalComponents(mean, axes, variance)


def closure(orbit: NDArray[np.floating], step_s: float, frequency_hz: float) -> float:
    """Distance of an orbit from itself one period later: 0 closed, 1 as far as unrelated points.

    Root mean square distance between points one period apart, over the one between two points
    drawn at random from the orbit (√2 times its RMS radius). Between samples the orbit is
    interpolated by a cubic spline, since a period is no whole number of steps. NaN of an orbit that
    is shorter than two periods, or stays at one point.

    The orbit is of one robot, shape (steps, k) in any number of dimensions; the frequency is its
    gait's.
    """
    orbit = np.asarray(orbit, float)
    time = step_s * np.arange(len(orbit))
    period = 1.0 / frequency_hz
    radius2 = ((orbit - orbit.mean(axis=0)) ** 2).sum(axis=1).mean()
    if not time[-1] >= 2 * period or not radius2 > 0:
        return NAN
    before = time + period <= time[-1]
    later = CubicSpline(time, orbit)(time[before] + period)
    away2 = ((later - orbit[before]) ** 2).sum(axis=1).mean()
    return float(np.sqrt(away2 / (2 * radius2)))


def area(orbit: NDArray[np.floating]) -> float:
    """Area of the ellipse with the covariance of an orbit in the plane.

    A half axis a has the variance a²/2. Noise makes a band look rounder than it is; `closure`
    distinguishes noise from an orbit.

    Orbits have the shape (steps, 2), or (steps, n, 2) of n robots, each about its own centre.
    """
    orbit = np.asarray(orbit, float)
    away = (orbit - orbit.mean(axis=0)).reshape(-1, 2)
    minor, major = np.sqrt(2 * np.clip(np.linalg.eigvalsh(away.T @ away / len(away)), 0.0, None))
    return float(np.pi * float(major) * float(minor))


def area_ratio(orbit: NDArray[np.floating], reference: NDArray[np.floating]) -> float:
    """Area of an orbit over that of `reference`, on the same axes; NaN if that encloses none.

    Both as `area` takes them.
    """
    before = area(reference)
    return area(orbit) / before if before > 0 else NAN


@dataclass(frozen=True, kw_only=True)
class Orbits(Result):
    """Orbits of actions or hidden states of one robot, one per delay, on common axes."""

    states: list[Array] = internal()
    """Shape (steps, k) each; actions in rad."""
    orbits: list[Array] = internal()
    """Shape (steps, 3) each."""
    explained: list[float]
    """Shares of variance."""
    explained_3: float
    participation_ratio: float
    closure: list[float]
    """NaN where the orbit stands still."""
    area_ratio: list[float]
    """To no delay."""


def orbits(
    policy: Policy, trial: Trial, delays_ms: Sequence[float] = DELAYS_MS
) -> dict[str, Orbits]:
    """Orbits of `actions` and `hidden` states in replay with late joints.

    Of the first robot that walked long enough; empty if none walked and moved.
    """
    plain = trial.walk(policy)
    moving = walking(plain)
    if not moving:
        return {}
    robot, now = next(iter(moving.items()))
    acted, hidden_states = [], []
    for delay in delays_ms:
        change = perturbations.delayed(perturbations.JOINTS, round(delay / 1e3 / plain.step_s))
        actions, hidden = replay(policy, perturbations.applied(change, plain.observation))
        acted.append(plain.action_scale * actions[now, robot].astype(float))
        hidden_states.append(hidden[now, robot].astype(float))
    rate = moving_frequency(acted[0], plain.step_s)
    found = {}
    for name, conditions in (("actions", acted), ("hidden", hidden_states)):
        axes = principal_components(conditions, 3)
        paths = [axes.orbit(c) for c in conditions]
        found[name] = Orbits(
            states=conditions,
            orbits=paths,
            explained=axes.explained.tolist(),
            explained_3=float(axes.explained[:3].sum()),
            participation_ratio=float(axes.participation_ratio),
            closure=[closure(path, plain.step_s, rate) for path in paths],
            area_ratio=[area_ratio(path[:, :2], paths[0][:, :2]) for path in paths],
        )
    return found
