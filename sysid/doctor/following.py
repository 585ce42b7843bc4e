"""How a position follows its command: how well, how late, how far, with which sign.

Each trial's position is regressed on its held command, low-passed (two equal poles, some time
constants) and shifted by every lag from early to late. A servo's position is explained by a late
and low-passed command with a positive gain; what is explained as well or better by an early, an
inverted or no command is no servo's position. `following` pools trials by their explained variance,
so that a whole-period ambiguity of one tone is settled by the others and by the onset from rest.

The model is a crude one on purpose: it takes milliseconds and knows nothing of poll, friction or
limits. It judges a recording; it measures nothing that is printed as a servo's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.feedback.rows import fresh_rows
from pupper_sysid.sysid.feedback.staleness import staleness
from pupper_sysid.sysid.recordings.recording import Trial

LATEST_S, EARLIEST_S = 0.8, -0.6
LATE_S = 0.02

_POLES_S = (0.0, 0.01, 0.02, 0.04, 0.08, 0.16)
_GRID_S = 0.005
_FINEST_S = 0.001
_MOST_POINTS = 1 << 14
_OVERLAP = 0.5  # of the readings must have a command at a lag
_AT_ONCE_S, _SURELY = 0.02, 0.01
_CLEAR_NATS, _BEYOND, _OF_THE_REST = 10.0, 4.0, 0.3
_CORRELATED_ROWS = 4.0  # rows whose errors count as one


@dataclass(frozen=True)
class Following:
    """How the position of one joint follows its command.

    Attributes
    ----------
    explained : float
        Share of the position's variance that the command explains with a lag and a sign for each
        trial by itself.
    score : float
        The same of the best causal servo of positive gain, one for all trials.
    inverted_score, early_score : float
        The same of the best causal one of negative gain, and of the command itself moved, or
        low-passed and moved, to before it was sent.
    lag_s, plain_score : float
        Shift of the command as it was held that explains most, low-passed by nothing, and the
        share that it explains.
    late_score : float
        Share that the best causal servo explains whose lag is `LATE_S` or more.
    early_lag_s : float
        Shift of that command; negative.
    gain : ndarray, shape (trials,)
        Position per command of each trial in the best causal servo; NaN where nothing moves.
    residual_rad : tuple of ndarray
        Per trial: what is left of each new reading.
    rows : float
        Rows that count as independent.
    """

    explained: float
    score: float
    inverted_score: float
    early_score: float
    lag_s: float
    plain_score: float
    late_score: float
    early_lag_s: float
    gain: NDArray[np.float64]
    residual_rad: tuple[NDArray[np.float64], ...]
    rows: float

    @property
    def at_once(self) -> bool:
        """Whether the position goes with the command, beyond doubt: no servo is that fast."""
        noise = 2 * _CLEAR_NATS * (1 - self.explained) / max(self.rows, 1.0)
        rival = self.explained - self.plain_score
        late = self.explained - self.late_score
        return abs(self.lag_s) < _AT_ONCE_S and late > max(_BEYOND * rival + noise, _SURELY)

    def better(self, share: float, least: float = 0.0) -> bool:
        """Whether a rival that explains `share` beats the causal servo beyond doubt.

        Both fall short of `explained`, because one lag for all tones is a crude model: the rival
        must fall short by a quarter of that only, and noise must not explain the difference.

        Parameters
        ----------
        share : float
        least : float
            Smallest difference that counts, where a single tone may fit either.
        """
        noise = 2 * _CLEAR_NATS * (1 - self.explained) / max(self.rows, 1.0)
        short, rival = self.explained - self.score, self.explained - share
        least = max(least, _OF_THE_REST * (1 - self.explained))
        return short > max(_BEYOND * rival + noise, least)


def following(trials: Sequence[Trial], step: float) -> Following | None:
    """Explain the position of one joint by its command.

    Parameters
    ----------
    trials : sequence of Trial
        All of this joint, three rows or more each, with sound time stamps.
    step : float
        Quantisation step [rad]: trials that move by little more weigh little.

    Returns
    -------
    Following or None
        None if no trial has enough motion of both.
    """
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    grid = max(min(loop / 4, _GRID_S), _FINEST_S)
    lags = grid * np.arange(round(EARLIEST_S / grid), round(LATEST_S / grid) + 1)
    live = staleness(trials).kind == "live"
    maps = [_correlations(t, live, grid, len(lags)) for t in trials]
    spread = np.array([_variance(t.position_rad) for t in trials])
    noise = (max(step, 1e-5) ** 2) / 4
    weight = np.array([0.0 if m is None else 1.0 for m in maps]) * spread / (spread + noise)
    if not weight.sum() > 0:
        return None
    weight /= weight.sum()
    rho = np.stack([np.zeros((len(_POLES_S), len(lags))) if m is None else m for m in maps])
    causal = lags >= -0.5 * grid

    def pooled(sign: float) -> NDArray[np.float64]:
        return np.tensordot(weight, np.maximum(sign * rho, 0.0) ** 2, axes=1)

    right, inverted = pooled(1.0), pooled(-1.0)
    late = np.where(causal, right, -1.0)
    pole, at = np.unravel_index(int(np.argmax(late)), late.shape)
    # two equal poles are late by twice their time constant
    total = lags + 2 * np.array(_POLES_S)[:, None]
    early = np.where(total < -0.5 * grid, right, -1.0)
    first = np.unravel_index(int(np.argmax(early)), early.shape)
    gains, residuals = zip(
        *(_fitted(t, live, _POLES_S[pole], float(lags[at]), grid) for t in trials), strict=True
    )
    rows = sum(len(_samples(t, live)[0]) for t in trials)
    return Following(
        explained=float(weight @ (rho**2).max(axis=(1, 2))),
        score=float(late[pole, at]),
        inverted_score=float(np.where(causal, inverted, 0.0).max()),
        early_score=float(early.max()),
        lag_s=_peak(right[0], lags),
        plain_score=float(right[0].max()),
        late_score=float(np.where(causal & (total >= LATE_S), right, 0.0).max()),
        early_lag_s=float(lags[first[1]]),
        gain=np.array(gains),
        residual_rad=residuals,
        rows=rows / _CORRELATED_ROWS,
    )


def _variance(position: NDArray[np.float64]) -> float:
    seen = position[np.isfinite(position)]
    return float(np.var(seen)) if len(seen) > 2 else 0.0


def _samples(trial: Trial, live: bool) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows with a new reading, and about when it was measured."""
    if live:
        rows = np.flatnonzero(np.isfinite(trial.position_rad))
        return rows, trial.read_time_s[rows]
    rows = fresh_rows(trial)
    rows = rows[rows > 0]
    return rows, 0.5 * (trial.read_time_s[rows] + trial.read_time_s[rows - 1])


def _on_grid(
    trial: Trial, live: bool, grid: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Held command on the grid, sum of the positions that fall on each point, and their number."""
    begin, end = trial.send_time_s[0], max(trial.send_time_s[-1], trial.read_time_s[-1])
    points = min(int((end - begin) / grid) + 1, _MOST_POINTS)
    row = np.searchsorted(trial.send_time_s, begin + grid * np.arange(points) + 1e-9, "right") - 1
    command = trial.command_rad[np.maximum(row, 0)]
    rows, time = _samples(trial, live)
    place = np.round((time - begin) / grid).astype(np.int64)
    inside = (place >= 0) & (place < points)
    position = trial.position_rad[rows[inside]]
    number = np.bincount(place[inside], minlength=points).astype(np.float64)
    total = np.bincount(place[inside], position, points).astype(np.float64)
    return command.astype(np.float64), total, number


def _rest(trial: Trial) -> float:
    """Command before the trial; its first one where the header's is far away."""
    rest, first = trial.initial_command_rad, float(trial.command_rad[0])
    return rest if abs(rest - first) <= np.ptp(trial.command_rad) + 0.1 else first


def _low_pass(command: NDArray, pole_s: float, grid: float) -> NDArray[np.float64]:
    """Command behind two equal poles; before it, its first value."""
    if pole_s <= 0:
        return command
    from scipy.signal import lfilter

    keep = np.exp(-grid / pole_s)
    value = command - command[0]
    for _ in range(2):
        value = lfilter([1 - keep], [1, -keep], value)
    return value + command[0]


def _correlations(trial: Trial, live: bool, grid: float, count: int) -> NDArray[np.float64] | None:
    """Correlation of position and shifted command, shape (poles, lags); None without motion."""
    command, total, mask = _on_grid(trial, live, grid)
    if mask.sum() < 8 or np.ptp(command) < 1e-6:
        return None
    mean = total.sum() / mask.sum()
    y = total - mask * mean
    square = np.where(mask > 0, y**2 / np.maximum(mask, 1), 0.0)
    if square.sum() < 1e-12:
        return None
    before = round(LATEST_S / grid)  # rows of rest that precede the command
    ahead = count - 1 - before
    size = 1 << int(np.ceil(np.log2(len(command) + before + count)))
    # lag m (from -ahead to before) looks at command row i - m, stored at i - m + before
    there = np.ones(before + len(command))

    shift = before - np.arange(-ahead, before + 1)  # i - m + before - i

    def transform(a: NDArray) -> NDArray[np.complex128]:
        return np.fft.rfft(a, size)

    def correlate(a: NDArray, b: NDArray) -> NDArray[np.float64]:
        """Of transforms; the first is conjugate."""
        return np.fft.irfft(a * b, size)[shift]

    of_mask, of_y, of_square = (np.conj(transform(a)) for a in (mask, y, square))
    of_there = transform(there)
    n, sy, syy = (correlate(a, of_there) for a in (of_mask, of_y, of_square))
    rho = np.zeros((len(_POLES_S), count))
    own = np.concatenate([np.full(before, _rest(trial)), command])
    for k, pole in enumerate(_POLES_S):
        u = _low_pass(own, pole, grid) - command.mean()
        of_u = transform(u)
        su, suu, suy = (
            correlate(of_mask, of_u),
            correlate(of_mask, transform(u * u)),
            correlate(of_y, of_u),
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = suy - sy * su / n
            scale = np.sqrt(np.maximum((syy - sy**2 / n) * (suu - su**2 / n), 0.0))
            value = np.where(scale > 1e-12, covariance / scale, 0.0)
        rho[k] = np.where(n >= _OVERLAP * mask.sum(), value, 0.0)
    return np.clip(rho, -1.0, 1.0)


def _fitted(
    trial: Trial, live: bool, pole: float, lag: float, grid: float
) -> tuple[float, NDArray[np.float64]]:
    """Gain of a trial at one pole and lag, and what each new reading leaves."""
    command, _, _ = _on_grid(trial, live, grid)
    rows, time = _samples(trial, live)
    before = round(LATEST_S / grid)
    own = np.concatenate([np.full(before, _rest(trial)), command])
    past = trial.send_time_s[0] + grid * (np.arange(len(own)) - before)
    rows, time = rows[time <= past[-1]], time[time <= past[-1]]
    x, y = np.interp(time - lag, past, _low_pass(own, pole, grid)), trial.position_rad[rows]
    if len(rows) < 8 or np.var(x) < 1e-12:
        return float("nan"), np.zeros(0)
    gain = float(np.cov(x, y)[0, 1] / np.var(x, ddof=1))
    return gain, y - y.mean() - gain * (x - x.mean())


def _peak(score: NDArray, lags: NDArray) -> float:
    """Lag of the largest score, refined by a parabola through its top [s]."""
    k = int(np.argmax(score))
    if not 0 < k < len(score) - 1:
        return float(lags[k])
    left, top, right = score[k - 1 : k + 2]
    bend = left - 2 * top + right
    shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float(lags[k] + shift * (lags[1] - lags[0]))
