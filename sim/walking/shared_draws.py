"""Random numbers for robots of which some are twins: one robot, several conditions.

Twins have the same servos, friction, start, noise and feedback faults, so that they differ in
their conditions only (a command, a dead time, a push), until one of them falls. Numbers are drawn
for each different robot once and handed to all of its twins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Twins:
    """Which robots of an environment are the same one."""

    number: NDArray[np.intp]
    """Of each robot, shape (n,), from 0 on; twins have the same."""
    count: int
    """Different robots. Environments of one seed and count agree on the robot of a number."""


def generator(seed: int | list[int], twins: Twins | None = None) -> np.random.Generator:
    """Generator of a seed; with twins, one whose draws for all n robots are theirs.

    A draw is for all robots if the first axis of its size is n; others are plain ones of a
    generator of their own.
    """
    plain = np.random.default_rng(seed)
    return plain if twins is None else cast(np.random.Generator, _SharedDraws(plain, twins))


class _SharedDraws:
    """The methods of a generator that the environment uses."""

    def __init__(self, rng: np.random.Generator, twins: Twins):
        self._rng, self._twins = rng, twins
        self._other = rng.spawn(1)[0]
        self.bit_generator = rng.bit_generator

    def uniform(self, low: Any, high: Any, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.uniform(low, high, size), size)

    def random(self, size: Any, dtype: Any = np.float64) -> Any:
        return self._drawn(lambda rng, size: rng.random(size, dtype), size)

    def integers(self, low: int, high: int, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.integers(low, high, size), size)

    def exponential(self, scale: float, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.exponential(scale, size), size)

    def standard_normal(self, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.standard_normal(size), size)

    def _drawn(self, draw: Callable[[np.random.Generator, tuple[int, ...]], Any], size: Any) -> Any:
        first, *rest = np.atleast_1d(size).tolist()
        if first != len(self._twins.number):
            return draw(self._other, (first, *rest))
        return draw(self._rng, (self._twins.count, *rest))[self._twins.number]
