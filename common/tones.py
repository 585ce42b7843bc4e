"""Sines by linear least squares at irregular times, and the block bootstrap of such a fit.

`Re(P exp(jφ))` at angles φ [rad] is linear in the phasor P: `sine_design` has the columns,
`fit_sine` solves for one sine beside an offset, `block_bootstrap` repeats a fit under random
weights of its blocks. Normal equations are sums over blocks, so that a thousand repetitions cost
little more than one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


def sine_design(*angles_rad: NDArray) -> NDArray[np.float64]:
    """Columns of a least-squares fit: one, then cosine and sine of each tone's angles [rad]."""
    columns = [np.ones_like(angles_rad[0])]
    for angle in angles_rad:
        columns += [np.cos(angle), np.sin(angle)]
    return np.stack(columns, axis=1)


def least_squares(design: NDArray, value: NDArray) -> NDArray[np.float64]:
    """Coefficients of `design` that fit `value`; each column of `value` is fitted alone."""
    return np.linalg.lstsq(design, value, rcond=None)[0]


def phasors(solution: NDArray) -> NDArray[np.complex128]:
    """Phasors P of `Re(P exp(jφ))` from coefficients of `sine_design` on the last axis."""
    return solution[..., 1::2] - 1j * solution[..., 2::2]


class Sine(NamedTuple):
    """`offset + Re(phasor exp(jφ))`, a number or an array over channels each."""

    offset: NDArray[np.float64]
    phasor: NDArray[np.complex128]


def fit_sine(angle_rad: NDArray, value: NDArray) -> Sine:
    """Sine and offset that fit `value`, shape (rows,) or (rows, channels), best.

    Examples
    --------
    >>> angle = np.linspace(0.0, 9.0, 50)
    >>> sine = fit_sine(angle, 3.0 + 2.0 * np.cos(angle - 0.5))
    >>> [round(float(x), 9) for x in (sine.offset, abs(sine.phasor), -np.angle(sine.phasor))]
    [3.0, 2.0, 0.5]
    """
    offset, cosine, sine = least_squares(sine_design(angle_rad), value)
    return Sine(offset, cosine - 1j * sine)


class BlockFit(NamedTuple):
    """A least-squares fit with its bootstrap."""

    solution: NDArray[np.float64]
    """Shape (columns,)."""
    drawn: NDArray[np.float64]
    """The same under random weights of the blocks, shape (draws, columns)."""
    blocks: int
    """How many blocks were weighted."""

    def inflated(self, factor: float) -> NDArray[np.float64]:
        """The draws, their distance from the solution multiplied by `factor`."""
        return self.solution + factor * (self.drawn - self.solution)


def block_bootstrap(
    design: NDArray,
    value: NDArray,
    block: NDArray,
    rng: np.random.Generator,
    draws: int,
    fewest: int = 1,
) -> BlockFit:
    """Least squares, repeated with exponential random weights of the blocks (Bayesian bootstrap).

    `block` labels each row's block: rows of one block keep together. Fewer than `fewest` blocks are
    replaced by this many runs of neighbouring rows.

    References
    ----------
    D. Rubin, "The Bayesian bootstrap", Annals of Statistics 9 (1981).
    """
    names, block = np.unique(block, return_inverse=True)
    columns = design.shape[1]
    # Gram matrix and right-hand side of every block
    gram, moment = np.zeros((len(names), columns, columns)), np.zeros((len(names), columns))
    np.add.at(gram, block, design[:, :, None] * design[:, None, :])
    np.add.at(moment, block, design * value[:, None])
    solution = np.linalg.solve(gram.sum(0), moment.sum(0))
    if len(gram) < fewest:
        runs = np.array_split(np.arange(len(value)), fewest)
        gram = np.stack([design[run].T @ design[run] for run in runs])
        moment = np.stack([design[run].T @ value[run] for run in runs])
    weights = rng.exponential(size=(draws, len(gram)))
    drawn = np.linalg.solve(np.tensordot(weights, gram, axes=1), (weights @ moment)[..., None])
    return BlockFit(solution, np.asarray(drawn[..., 0], np.float64), len(gram))
