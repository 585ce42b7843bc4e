"""Impulse response of a servo from any recording, with its uncertainty: `joint_impulse_response`.

Between two writes the bus holds a command, so the set-point that a servo sees is a staircase with
known edges (`HeldCommand`). Its integral is piecewise linear and known at any time. A servo's
impulse response, constant within each bin of past time, answers with the staircase's mean over that
bin:

    y(t) = offset + Σ_j m_j · mean of c over (t - edge_{j+1}, t - edge_j]

with masses m_j that add up to the static gain. Nothing is sampled or interpolated. The response is
a Gaussian process that is zero up to a dead time and decays after it (the "tuned correlated" and
"stable spline" kernels); what the recording cannot tell, above all where a fast servo moves
between two readings at one phase of the loop, stays as wide as the process is. Dead time, decay,
smoothness and size are averaged over by their marginal likelihood.

The rest is no white noise: a servo is not linear. So its share of the uncertainty comes from
random weights of blocks of time, as does the count of effective readings in the likelihood.

References
----------
G. Pillonetto et al., "Kernel methods in system identification, machine learning and function
estimation: a survey", Automatica 50 (2014); D. Rubin, "The Bayesian bootstrap", Annals of
Statistics 9 (1981).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.feedback.staleness import quantum
from pupper_sysid.sysid.recordings.recording import Trial

LONGEST_S = 1.2  # length of the impulse response

_BLOCKS = 16
_FEWEST_BLOCKS = 8
_PER_LOOP = 8  # bins in a loop period
_FINEST_S, _COARSEST_S = 0.001, 0.005
_MOST_FINE = 60  # bins up to beyond the lag
_DRAWS = 300
_GROWTH = 1.12  # of bins beyond the lag
_BEYOND_S = 0.03
_DECAYS_S = (0.0007, 0.0015, 0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2)
_SIZES = 10.0 ** np.arange(-4, 8.1, 0.5)
_UNLIKELY = 12.0  # nats
_TINY = 1e-6  # of the motion's variance: no model of bins fits better
_STARTS_S, _LONG_ENOUGH_S = 0.3, 3.0  # what came before a motion's first command is not known
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
            spectrum = np.fft.rfft(level[first:last], size)
            near = np.fft.rfft(padded[first : last + 2 * most], size)
            product[k] = np.fft.irfft(near * np.conj(spectrum), size)[: 2 * most + 1]
        shift = np.asarray(step * np.arange(-most, most + 1), np.float64)
        return shift, 0.5 * (product + product[:, ::-1])


@dataclass(frozen=True)
class ImpulseResponse:
    """Draws of an impulse response, each a mass per bin of past time."""

    edges_s: NDArray[np.float64]
    """Shape (bins + 1,)."""
    masses: NDArray[np.float64]
    """They add up to the static gain, shape (draws, bins)."""
    weights: NDArray[np.float64]
    """Of the blocks of time behind each draw, shape (draws, blocks)."""
    stretches: tuple[Stretch, ...]
    """The readings it was found in."""
    explained: float
    """Share of the readings' variance that it explains."""

    @property
    def gain(self) -> float:
        """Static gain, the median of the draws."""
        return float(np.median(self.masses.sum(axis=1)))


@dataclass(frozen=True)
class _Prior:
    """One dead time and kernel: how likely it is for every size of the response."""

    dead_time_s: float
    bins: NDArray[np.int64]
    root: NDArray[np.float64]
    gram: NDArray[np.float64]
    moment: NDArray[np.float64]
    variance: NDArray[np.float64]
    complexity: NDArray[np.float64]
    gain_square: float
    """About the static gain's square: variance of the motion over that of the command."""

    def inverse(self, k: int) -> NDArray[np.float64]:
        """Posterior covariance over the noise's variance, whitened, at the k-th size."""
        return np.linalg.inv(self.gram + np.eye(len(self.gram)) / _SIZES[k])

    def score(self, count: float) -> NDArray[np.float64]:
        """Logarithm of the posterior of each size, from `count` effective readings.

        The squares of a servo's masses add up to the square of its gain at most, nearly. A larger
        response hides between readings: at one phase of the loop they see only the sum of the
        bins that one command fills.
        """
        larger = _SIZES * self.variance / self.gain_square
        return -0.5 * (count * np.log(self.variance) + self.complexity + larger)


def joint_stretches(
    joint: str, trials: Sequence[Trial], read: Sequence[Readings]
) -> tuple[Stretch, ...]:
    """Staircases and readings of a joint, in blocks: about 16, at least one per trial."""
    parts, step = [], quantum(trials)
    for trial, reading in zip(trials, read, strict=True):
        send, order = trial.send_time_s, np.argsort(reading.time_s, kind="stable")
        tone = trial.frequency_hz > 0 or send[-1] - send[0] < _LONG_ENOUGH_S
        time = reading.time_s[order]
        used = time > send[0] + (0.0 if tone else _STARTS_S)
        still = np.ptp(trial.command_rad) == 0 and trial.command_rad[0] == trial.initial_command_rad
        if np.sum(used) >= 8 and np.ptp(time[used]) > 0 and not still:
            value = _inside_counts(trial, reading, step)[order]
            parts.append((HeldCommand.of(trial), time[used], value[used]))
    if not parts or not any(np.ptp(value) > 0 for _, _, value in parts):
        raise InputError(
            f"{joint}: its command does not move, or its position does not, so there is no lag to "
            "measure. Record a sweep with `pupper-sysid sweep`."
        )
    spans = np.array([time[-1] - time[0] for _, time, _ in parts])
    shares = np.maximum(1, np.round(_BLOCKS * spans / spans.sum())).astype(int)
    shares = np.maximum(shares, int(np.ceil(_FEWEST_BLOCKS / len(parts))))
    return tuple(
        Stretch(held, time, value, int(k))
        for (held, time, value), k in zip(parts, shares, strict=True)
    )


def _inside_counts(trial: Trial, reading: Readings, step_rad: float) -> NDArray[np.float64]:
    """Readings that are fresh because they changed, moved to where the joint was.

    A joint that moves less than a count between polls changes its reading at the edge of a count,
    not in its middle; taken as they are, such readings run ahead of the motion.
    """
    value, rows = reading.position_rad, reading.rows
    if len(rows) < 3 or len(rows) == np.isfinite(trial.position_rad).sum():
        return value
    before = trial.position_rad[: rows[0]][np.isfinite(trial.position_rad[: rows[0]])]
    moved = np.diff(value, prepend=before[-1] if len(before) else value[0])
    first = 2 * reading.time_s[0] - reading.time_s[1]
    passed = np.maximum(np.diff(reading.time_s, prepend=first), 1e-6)
    poll = float(np.quantile(passed, 0.1))
    between = np.minimum(step_rad, np.abs(moved) / passed * poll)
    return value - 0.5 * np.sign(moved) * (step_rad - between)


def joint_impulse_response(
    joint: str, trials: Sequence[Trial], read: Sequence[Readings], rng: np.random.Generator
) -> ImpulseResponse:
    """Draw impulse responses of a joint that the readings of all of its trials allow.

    The command must move in at least one of the trials.
    """
    parts = joint_stretches(joint, trials, read)
    loop_s = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    top = rough_lag(parts) + loop_s + _BEYOND_S
    finest = max(np.clip(loop_s / _PER_LOOP, _FINEST_S, _COARSEST_S), top / _MOST_FINE)
    edges = past_bins(finest, top, _GROWTH)
    sums = _pooled([part.sums(edges) for part in parts])
    gram, moment = sums.gram.sum(axis=0), sums.moment.sum(axis=0)
    square, count = float(sums.square.sum()), float(sums.count.sum())
    fine = np.flatnonzero(edges[1:] <= edges[1] * _MOST_FINE * 1.01)
    dead_times = edges[fine]

    def fit(chosen: NDArray) -> list[_Prior]:
        kernels = [(d, decay, smooth) for d in chosen for decay in _DECAYS_S for smooth in (0, 1)]
        return [
            prior
            for kernel in kernels
            if (prior := _fit(gram, moment, square, count, edges, *kernel)) is not None
        ]

    priors = fit(dead_times[::3])
    best = _best(priors, count)
    inflation = _inflation(sums, *best)
    for _ in range(2):
        # dead times between the tried ones, where they are likely
        score = np.array([p.score(count / inflation).max() for p in priors])
        tried = np.array([p.dead_time_s for p in priors])
        near = np.unique(tried[score > score.max() - _UNLIKELY])
        reach = np.min(np.abs(dead_times[:, None] - near), axis=1) < 2.5 * edges[1]
        priors += fit(dead_times[reach & ~np.isin(dead_times, tried)])
        best = _best(priors, count / inflation)
        inflation = _inflation(sums, *best)
    masses, weights = _draw(priors, sums, inflation, len(edges) - 1, rng)
    prior, k = best
    return ImpulseResponse(
        edges, masses, weights, tuple(parts), 1.0 - float(prior.variance[k]) * count / square
    )


def rough_lag(parts: Sequence[Stretch]) -> float:
    """The lag to a bin of 15 ms, without an interval [s]."""
    edges = np.linspace(0.0, LONGEST_S, 81)
    sums = _pooled([part.sums(edges) for part in parts])
    gram, moment = sums.gram.sum(axis=0), sums.moment.sum(axis=0)
    square, count = float(sums.square.sum()), float(sums.count.sum())
    decays = 0.05, 0.1, 0.2, 0.4
    priors = [_fit(gram, moment, square, count, edges, 0.0, d, 0) for d in decays]
    prior, k = _best([p for p in priors if p is not None], count)
    mean = prior.root @ (prior.inverse(k) @ prior.moment)
    # the readings' own correlation with the command would see one phase of the staircase only
    return float(edges[int(np.argmax(gram @ mean))] + edges[1] / 2)


def past_bins(width_s: float, until_s: float, growth: float) -> NDArray[np.float64]:
    """Edges of bins of past time up to `LONGEST_S`: of one width, then growing."""
    edges = list(np.arange(0.0, until_s, width_s))
    while edges[-1] < LONGEST_S:
        width_s *= growth
        edges.append(edges[-1] + width_s)
    return np.array(edges)


def _pooled(sums: Sequence[Sums]) -> Sums:
    """All blocks of all stretches, in units of the command's variance."""
    unit = sum(np.trace(s.gram.sum(axis=0)) for s in sums)
    unit /= sums[0].gram.shape[1] * sum(s.count.sum() for s in sums)
    return Sums(
        np.concatenate([s.gram for s in sums]) / unit,
        np.concatenate([s.moment for s in sums]) / unit,
        np.concatenate([s.square for s in sums]) / unit,
        np.concatenate([s.count for s in sums]),
    )


def _fit(
    gram: NDArray, moment: NDArray, square: float, count: float, edges: NDArray,
    dead_time_s: float, decay_s: float, smooth: int,
) -> _Prior | None:  # fmt: skip
    """Likelihood under one kernel, for all sizes at once; None if it has no square root."""
    middle, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    bins = np.flatnonzero(middle > dead_time_s)
    past = middle[bins] - dead_time_s
    later = np.maximum(past[:, None], past)
    if smooth:
        rate = 0.5 / decay_s
        kernel = np.exp(-rate * (past[:, None] + past + later)) / 2 - np.exp(-3 * rate * later) / 6
    else:
        kernel = np.exp(-later / decay_s)
    kernel *= width[bins, None] * width[bins]
    kernel /= np.trace(kernel)
    kernel[np.diag_indices_from(kernel)] *= 1 + 1e-9
    kernel[np.diag_indices_from(kernel)] += 1e-14
    try:
        root = np.linalg.cholesky(kernel)
    except np.linalg.LinAlgError:
        return None
    whitened = root.T @ gram[bins[0] :, bins[0] :] @ root
    projected = root.T @ moment[bins]
    fitted, complexity = _evidence(whitened.copy(), projected.copy(), _SIZES)
    # a fast response may begin late in a gap between readings; a slow one may not, and there are
    # fewer ways to have it: all places of a jump are equally likely only with this prior
    complexity = complexity + 2 * np.log(decay_s)
    variance = np.maximum(square - fitted, _TINY * square) / count
    gain_square = square / count  # in units of the command's variance
    return _Prior(dead_time_s, bins, root, whitened, projected, variance, complexity, gain_square)


@njit(cache=True, fastmath=True, error_model="numpy")
def _evidence(a, b, sizes):
    """b' (a + I / size)^-1 b and log det(I + size a) per size; `a` and `b` are overwritten.

    Householder reflections make `a` tridiagonal once for all sizes. Compiled, because a thousand
    small eigenvalue problems in threads of BLAS take a hundred times as long on a busy machine.
    """
    n = len(b)
    diagonal, side = np.zeros(n), np.zeros(n)
    v, w = np.zeros(n), np.zeros(n)
    for k in range(n - 2):
        norm = 0.0
        for i in range(k + 1, n):
            v[i] = a[k, i]
            norm += v[i] * v[i]
        head = -np.sqrt(norm) if v[k + 1] > 0 else np.sqrt(norm)
        side[k] = head
        if norm == 0.0:
            continue
        v[k + 1] -= head
        scale = 2.0 / (norm + v[k + 1] * v[k + 1] - (v[k + 1] + head) ** 2)
        along, inside = 0.0, 0.0
        for i in range(k + 1, n):
            total = 0.0
            for j in range(k + 1, n):
                total += a[i, j] * v[j]
            w[i] = scale * total
            along += w[i] * v[i]
            inside += b[i] * v[i]
        for i in range(k + 1, n):
            w[i] -= 0.5 * scale * along * v[i]
            b[i] -= scale * inside * v[i]
        for i in range(k + 1, n):
            vi, wi = v[i], w[i]
            for j in range(k + 1, n):
                a[i, j] -= vi * w[j] + wi * v[j]
    for k in range(n):
        diagonal[k] = max(a[k, k], 0.0)
    if n > 1:
        side[n - 2] = a[n - 2, n - 1]
    fitted, logarithm = np.zeros(len(sizes)), np.zeros(len(sizes))
    for s in range(len(sizes)):
        pivot, whitened = 1.0, 0.0
        for k in range(n):
            across = sizes[s] * side[k - 1] if k > 0 else 0.0
            share = across / pivot if k > 0 else 0.0
            pivot = max(1.0 + sizes[s] * diagonal[k] - share * across, 1e-12)
            whitened = b[k] - share * whitened
            fitted[s] += sizes[s] * whitened * whitened / pivot
            logarithm[s] += np.log(pivot)
    return fitted, logarithm


def _best(priors: Sequence[_Prior], count: float) -> tuple[_Prior, int]:
    scores = np.array([p.score(count) for p in priors])
    i, k = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return priors[int(i)], int(k)


def _scores(sums: Sums, prior: _Prior, inverse: NDArray) -> NDArray[np.float64]:
    """Gradient of the fit in every block, in the prior's coordinates."""
    mean, bins = prior.root @ (inverse @ prior.moment), prior.bins
    residual_moment = sums.moment[:, bins] - sums.gram[:, bins[0] :, bins[0] :] @ mean
    return residual_moment @ prior.root


def _inflation(sums: Sums, prior: _Prior, k: int) -> float:
    """Readings per effective reading, from how much the blocks differ; at least 1."""
    inverse = prior.inverse(k)
    scores = _scores(sums, prior, inverse)
    spread = float(np.sum((scores @ inverse) * scores)) / float(prior.variance[k])
    return max(1.0, spread / max(_used(inverse, k), 1e-9))


def _used(inverse: NDArray, k: int) -> float:
    """Effective number of parameters."""
    return len(inverse) - float(np.trace(inverse)) / _SIZES[k]


def _draw(
    priors: Sequence[_Prior], sums: Sums, inflation: float, size: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draws of the masses and of the weights of blocks that belong to them."""
    count, blocks = float(sums.count.sum()), len(sums.count)
    score = np.array([p.score(count / inflation) for p in priors])
    chance = np.exp(score - score.max()).ravel()
    picked = rng.choice(chance.size, _DRAWS, p=chance / chance.sum())
    weights = rng.exponential(size=(_DRAWS, blocks))
    masses = np.zeros((_DRAWS, size))
    for flat in np.unique(picked):
        i, k = divmod(int(flat), len(_SIZES))
        prior, rows = priors[i], np.flatnonzero(picked == flat)
        inverse = prior.inverse(k)
        # what was fitted away from the blocks is missing from their spread
        freedom = max(count - inflation * _used(inverse, k), count / 4)
        lost = np.sqrt(count / freedom * blocks / (blocks - 1))
        noise = (weights[rows] - 1.0) @ _scores(sums, prior, inverse) * lost
        free = np.sqrt(inflation * prior.variance[k] / _SIZES[k])
        noise += free * rng.standard_normal((len(rows), len(prior.bins)))
        masses[rows[:, None], prior.bins] = (prior.moment + noise) @ inverse @ prior.root.T
    return masses, weights
