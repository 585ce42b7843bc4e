"""Perturbations of observations: delay, noise, zeros, staleness.

Each function makes a `Change` for a `policies.walks.conditions.Condition`, or alters a recorded
sequence for `replay`. Parts are named as in `sim.walking.observation.OBSERVATION`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.policies.walks.conditions import Change
from pupper_sysid.sim.walking.observation import OBSERVATION_PARTS as PARTS

Observations = NDArray[np.float32]

JOINTS = slice(PARTS["joint_position_relative"].start, PARTS["joint_effort"].stop)
"""All that comes from the servos: positions, velocities, efforts (12:48)."""


def delayed(part: slice, steps: int) -> Change:
    """Delay a part by a number of control steps."""
    past: list[Observations] = []

    def value(step: int, now: Observations) -> Observations:
        past.append(now)
        del past[: -steps - 1]
        return past[0]

    return _altered(part, value)


def jittered(part: slice, mean_steps: int, rng: np.random.Generator) -> Change:
    """Delay a part by a lag that wanders between 0 and twice its mean, never back in time.

    The lag grows by at most one step per step, or an older value would follow a newer one.
    """
    past: list[Observations] = []
    lag = np.zeros(0, int)

    def value(step: int, now: Observations) -> Observations:
        nonlocal lag
        if not len(lag):
            lag = np.full(len(now), mean_steps)
        past.insert(0, now)
        del past[2 * mean_steps + 1 :]
        drawn = rng.integers(0, 2 * mean_steps + 1, len(lag))
        lag = np.minimum(np.minimum(drawn, lag + 1), len(past) - 1)
        return np.stack(past)[lag, np.arange(len(lag))]

    return _altered(part, value)


def noisy(part: slice, sigma: NDArray[np.floating], rng: np.random.Generator) -> Change:
    """Add white noise with a standard deviation per number of the part, in its own unit."""
    size = np.asarray(sigma, np.float32)
    return _altered(part, lambda _, now: now + size * rng.standard_normal(now.shape, np.float32))


def zeroed(part: slice) -> Change:
    """Set a part to zero."""
    return _altered(part, lambda _, now: np.zeros_like(now))


def held(part: slice, steps: int) -> Change:
    """Refresh a part only every `steps` control steps: staleness, as slow polls cause it."""
    latest: list[Observations] = []

    def value(step: int, now: Observations) -> Observations:
        if step % steps == 0:
            latest[:] = [now]
        return latest[0]

    return _altered(part, value)


def _altered(part: slice, value: Callable[[int, Observations], NDArray[np.floating]]) -> Change:
    """Replace a part by a function of the step and of a copy of the part."""

    def change(step: int, observation: Observations) -> Observations:
        observation[:, part] = value(step, observation[:, part].copy())
        return observation

    return change


def applied(change: Change, observations: Observations) -> Observations:
    """A recorded sequence of observations, shape (steps, n, 60), with the change applied."""
    return np.stack([change(i, seen.copy()) for i, seen in enumerate(observations)]).astype(
        np.float32
    )
