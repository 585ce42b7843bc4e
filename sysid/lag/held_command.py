"""The held command as an exact function of time, and what a linear servo would make of it.

Between two writes the bus holds a command, so the set-point that a servo sees is a staircase with
known edges. Its integral is piecewise linear and known at any time. A servo's impulse response,
constant within each bin of past time, answers with the staircase's mean over that bin:

    y(t) = Σ_j m_j · mean of c over (t - edge_{j+1}, t - edge_j]

with masses m_j that add up to the static gain. Nothing is sampled or interpolated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.recordings.recording import Trial

_CHUNK = 2048  # rows at once: bounded memory however long the recording
_GRID_S = 0.002
_MOST_POINTS = 2_000_000


@dataclass(frozen=True)
class HeldCommand:
    """A trial's staircase, relative to the command in force before it."""

    time_s: NDArray[np.float64]
    """When each command was sent, shape (rows,)."""
    command_rad: NDArray[np.float64]
    """Command minus the initial one, shape (rows,)."""
    area: NDArray[np.float64]
    """Integral of the staircase up to each time [rad s], shape (rows,)."""

    @classmethod
    def of(cls, trial: Trial) -> HeldCommand:
        """The staircase of `trial`."""
        command = trial.command_rad - trial.initial_command_rad
        steps = command[:-1] * np.diff(trial.send_time_s)
        return cls(trial.send_time_s, command, np.concatenate([[0.0], np.cumsum(steps)]))

    def integral(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integral of the staircase up to any time [rad s]; 0 before the first command."""
        row = np.searchsorted(self.time_s, time_s, side="right") - 1
        at = np.maximum(row, 0)
        area = self.area[at] + self.command_rad[at] * (time_s - self.time_s[at])
        return np.where(row < 0, 0.0, area)

    def levels(
        self, start_s: float, stop_s: float, step_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Middle of each step of time, and the staircase's mean in it."""
        edges = np.arange(start_s, stop_s, step_s)
        return 0.5 * (edges[1:] + edges[:-1]), np.diff(self.integral(edges)) / step_s

    def means(
        self, time_s: NDArray[np.float64], edges_s: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Means over bins of the past, shape (times, bins), `edges_s` [s] ago (rising)."""
        past = self.integral(time_s[:, None] - edges_s)
        return (past[:, :-1] - past[:, 1:]) / np.diff(edges_s)


def past_tones(
    time_s: NDArray[np.float64],
    edges_s: NDArray[np.float64],
    frequency_hz: NDArray[np.float64],
    phasor: NDArray[np.complex128],
) -> NDArray[np.float64]:
    """Means over bins of the past of a sum of tones `Re(P exp(2πj f t))`, shape (times, bins)."""
    turn = 2j * np.pi * frequency_hz
    now = phasor / turn * np.exp(np.outer(time_s, turn))
    past = np.exp(-np.outer(turn, edges_s))
    return (now @ (past[:, :-1] - past[:, 1:])).real / np.diff(edges_s)


@dataclass(frozen=True)
class Sums:
    """Normal equations of readings on bin means, one per block; offsets of trials are removed."""

    gram: NDArray[np.float64]
    """Shape (blocks, bins, bins)."""
    moment: NDArray[np.float64]
    """Shape (blocks, bins)."""
    square: NDArray[np.float64]
    """Shape (blocks,)."""
    count: NDArray[np.float64]
    """Readings, shape (blocks,)."""


@dataclass(frozen=True)
class Stretch:
    """A trial's staircase and the readings that answer it, cut into blocks of equal duration."""

    held: HeldCommand
    time_s: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    """`time_s` and `position_rad`: when each reading was measured, rising, and what it was, shape
    (readings,)."""
    blocks: int

    def edges_s(self) -> NDArray[np.float64]:
        """Times at which blocks begin and end."""
        return np.linspace(self.time_s[0], self.time_s[-1], self.blocks + 1)

    def sums(self, edges_s: NDArray[np.float64]) -> Sums:
        """Normal equations of this stretch on bins of past time `edges_s`."""
        bins = len(edges_s) - 1
        gram, moment = np.zeros((self.blocks, bins, bins)), np.zeros((self.blocks, bins))
        total, value = np.zeros((self.blocks, bins)), np.zeros(self.blocks)
        square, count = np.zeros(self.blocks), np.zeros(self.blocks)
        y = self.position_rad - self.position_rad.mean()
        for block, rows in self._chunks():
            means = self.held.means(self.time_s[rows], edges_s)
            gram[block] += means.T @ means
            moment[block] += means.T @ y[rows]
            total[block] += means.sum(axis=0)
            value[block] += y[rows].sum()
            square[block] += y[rows] @ y[rows]
            count[block] += len(means)
        centre = total.sum(axis=0) / count.sum()
        cross = total[:, :, None] * centre
        gram += count[:, None, None] * np.outer(centre, centre) - cross - cross.swapaxes(1, 2)
        return Sums(gram, moment - value[:, None] * centre, square, count)

    def _chunks(self) -> Iterator[tuple[int, slice]]:
        """Block and rows, a few at a time."""
        ends = np.searchsorted(self.time_s, self.edges_s())
        ends[0], ends[-1] = 0, len(self.time_s)
        for block in range(self.blocks):
            for first in range(ends[block], ends[block + 1], _CHUNK):
                yield block, slice(first, min(first + _CHUNK, ends[block + 1]))

    def autocorrelation(self, longest_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Products of the staircase with itself, shifted; the mean is removed.

        Returns the shifts, `-longest_s` to `longest_s`, and the sums over each block's time, shape
        (blocks, shifts), even in the shift.
        """
        span = float(self.time_s[-1] - self.time_s[0])
        step = max(_GRID_S, span / _MOST_POINTS)
        _, level = self.held.levels(self.time_s[0], self.time_s[-1], step)
        level = level - level.mean()
        most = int(np.ceil(longest_s / step))
        padded = np.pad(level, most)
        ends = np.linspace(0, len(level), self.blocks + 1).astype(int)
        product = np.empty((self.blocks, 2 * most + 1))
        for k, (first, last) in enumerate(pairwise(ends)):
            size = 1 << int(np.ceil(np.log2(last - first + 2 * most + 1)))
            own = np.fft.rfft(level[first:last], size)
            near = np.fft.rfft(padded[first : last + 2 * most], size)
            product[k] = np.fft.irfft(near * np.conj(own), size)[: 2 * most + 1]
        shift = np.asarray(step * np.arange(-most, most + 1), np.float64)
        return shift, 0.5 * (product + product[:, ::-1])
