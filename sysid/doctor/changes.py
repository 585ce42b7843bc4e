"""What happens within a recording to a servo that follows: hypotheses compared on one path.

A linear servo (`explanations`) says what the pair of columns is. What a sound servo does beyond it,
a set-point that ramps, a motor that saturates, friction, looks like a fault to whatever compares
its readings with a straight line. `follow` fits a second-order servo behind a set-point of limited
speed and acceleration, with an effort limit and Coulomb friction, by a bounded cost: what happens
in a part of a recording does not bend the whole.

`change_findings` then compares what may have come on top: a zero or a gain that moves at a moment,
a gain or a lag that drifts, a while in which the joint leaves its path. The best is named if it
leaves much less than the servo alone does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, minimize

from pupper_sysid.sysid.doctor.explanations import FILTERS, Explanation, Samples, Servo, explain
from pupper_sysid.sysid.doctor.findings import CARE, Finding
from pupper_sysid.sysid.feedback.staleness import staleness
from pupper_sysid.sysid.recordings.excitation import remembered
from pupper_sysid.sysid.recordings.recording import Trial

_MOST_READINGS, _GRID_S = 1500, 0.0025
_USUAL = ((50.0, 0.7, 0.02, 4.0, 25.0), (50.0, 0.7, 0.02, 100.0, 1e4))
"""Servos to begin with where the linear one says little: natural frequency [rad/s], damping ratio,
lag [s], speed [rad/s] and acceleration [rad/s²]."""
_UNFILTERED_HZ = 15.0  # natural frequency of a servo that no low-pass explains better
_LONGEST_LAG_S = 0.5
_EVALUATIONS, _POLISHED = 260, 0.03  # the latter of the position's mean deviation
_HIGHEST = np.array([5.5, 1.5, 0.8, 9.0, 12.0, 3.0, 6.0, 0.1])  # of the terms
_STEPS = np.array([0.4, -0.3, 0.012, -1.0, -1.0, 1.0, -1.0, 1.0])
_BOUND, _CRUDE, _WELL, _EXPLAINED, _FOLLOWS = (
    0.25,
    0.004,
    0.012,
    0.06,
    0.12,
)  # of the position's mean deviation
_LITTLE = 0.3  # of a friction
_WORTH, _FITTED = 0.95, 3  # costs that are worth a fit of its own, and how many are
_MUCH_LESS, _LESS_SIMPLE = 0.65, 0.04  # of what the servo alone leaves; for each simpler change
_SPLITS = 30
_EDGE_S = 1.0  # of a change, from either end
_OTHER_GAIN, _GAIN_DRIFT, _LAG_DRIFT_S, _CLOCK = 0.75, 0.2, 0.008, 0.03
_MOVED_RAD, _MOVED_SHARE = 0.03, 0.08  # the latter of the command's range
_GROWTHS = [sign * size for size in (0.001, 0.002, 0.004, 0.006, 0.009, 0.014) for sign in (-1, 1)]
_SHIFTS_S = (-0.06, -0.03, 0.0, 0.03, 0.06)
_LEFT_S, _AGAIN_S, _MOST_LEFT, _TIMES_LEFT = 0.3, 0.3, 0.45, 4


@dataclass(frozen=True)
class Regression:
    """Of the readings of a joint."""

    cost: float
    """Mean bounded error over the mean deviation, and what no model explains."""
    values: NDArray[np.float64]
    residuals_rad: NDArray[np.float64]


@dataclass(frozen=True)
class Follower:
    """A servo with limits, fitted."""

    terms: NDArray[np.float64]
    """Logarithms of natural frequency [rad/s] and damping ratio, lag [s], logarithms of speed
    [rad/s], acceleration [rad/s²], friction and effort limit [rad of command], growth of the lag
    per second."""
    path_rad: NDArray[np.float64]
    """The command as it is followed, at each reading."""
    regression: Regression
    """Of the position on the path, and on what a change adds."""


@dataclass(frozen=True)
class Followed:
    """Readings of a joint, thinned, and the servo with limits that predicts them."""

    trials: tuple[Trial, ...]
    step: float
    base: Explanation
    servo: Servo
    start_s: float
    scale: float
    """Mean distance of readings from the median of their trial [rad]."""
    time_s: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    starts: NDArray[np.int64]
    """First reading of each trial, and the end."""

    @property
    def explained(self) -> bool:
        """Whether a servo with limits explains nearly all."""
        return self.fit.regression.cost < _EXPLAINED

    @property
    def unexplained(self) -> float:
        """Share of the variance of all readings that it leaves."""
        parts = np.split(self.position_rad, self.starts[1:-1])
        about = np.concatenate([p - p.mean() for p in parts])
        rest = np.split(self.fit.regression.residuals_rad, self.starts[1:-1])
        left = np.concatenate([r - r.mean() for r in rest])
        return float(left @ left / max(about @ about, 1e-18))

    @cached_property
    def fit(self) -> Follower:
        """The servo that explains most readings, from one that is linear and one that ramps."""
        reach = max(float(np.ptp(s.command_rad)) for s in self.base.samples)
        hz, damping = FILTERS[self.servo.filter]
        natural = 2 * np.pi * (hz or _UNFILTERED_HZ)
        fast = natural * reach
        lag = max(self.servo.lag_s, 0.0)
        begins = [(natural, damping, lag, 2 * fast, 4 * natural * fast),
                  (natural, damping, lag, 0.15 * fast, 0.2 * natural * fast), *_USUAL]  # fmt: skip
        best: Follower | None = None
        for begin in begins:
            if begin in _USUAL and best and best.regression.cost < _EXPLAINED:
                break
            terms = np.log([begin[0], begin[1], 1.0, *begin[3:], 0.004 * reach, reach, 1.0])
            terms[2] = begin[2]
            fit = follow(self, terms)
            if best is None or fit.regression.cost < best.regression.cost:
                best = fit
        assert best is not None
        more = follow(self, best.terms) if best.regression.cost > _POLISHED else best
        return min(best, more, key=lambda fit: fit.regression.cost)

    @cached_property
    def disturbed(self) -> float:
        """Cost of the fit beyond what readings of unknown age explain."""
        gaps = np.concatenate([np.diff(t.send_time_s) for t in self.trials])
        age = 0.25 * float(np.median(gaps)) * (staleness(self.trials).kind != "live")
        rate = np.abs(
            np.gradient(self.fit.path_rad, self.time_s + 1e-9 * np.arange(len(self.time_s)))
        )
        return self.fit.regression.cost - age * float(np.median(rate)) / self.scale

    @cached_property
    def friction_rad(self) -> float:
        """Error of the command that friction holds against; 0 where a servo needs none."""
        friction = float(np.exp(self.fit.terms[5]))
        highest = _HIGHEST.copy()
        highest[5] = np.log(_LITTLE * friction)
        terms = np.minimum(self.fit.terms, highest)
        without = follow(self, terms, highest=highest).regression.cost
        return friction if self.fit.regression.cost < _MUCH_LESS * without else 0.0

    @cached_property
    def changes(self) -> list[Finding]:
        """The change that explains most of what the servo alone leaves, if any does."""
        return _compared(self)

    def path(self, terms: NDArray) -> NDArray[np.float64]:
        """The command as a servo follows it, at each reading [rad of command]."""
        return np.concatenate([
            follower_path(s, terms, t, self.start_s)
            for s, t in zip(self.base.samples, np.split(self.time_s, self.starts[1:-1]),
                            strict=True)
        ])  # fmt: skip

    def regressed(self, *columns: NDArray) -> Regression:
        """Position by columns and a constant per trial, at the least bounded cost."""
        floor = 0.01 * self.scale + 0.25 * self.step
        cost, values, rest = _regression(
            np.column_stack(columns), self.position_rad, self.starts, _BOUND * self.scale, floor
        )
        return Regression(cost / self.scale + _CRUDE + 0.05 * self.step / self.scale, values, rest)


@remembered(8)
def followed(trials: Sequence[Trial], step: float) -> Followed | None:
    """Readings of one joint, to be followed by the best servo; None where too little moves."""
    base = explain(trials, step)
    if base is None:
        return None
    causal = (base.lags_s >= -0.5 * base.grid_s) & (base.lags_s <= _LONGEST_LAG_S)
    servo = base.best(1.0, np.broadcast_to(causal, base.total_s.shape))
    every = max(1, sum(len(s.time_s) for s in base.samples) // _MOST_READINGS)
    times = [s.time_s[::every] for s in base.samples]
    position = [s.position_rad[::every] for s in base.samples]
    away = np.concatenate([np.abs(p - np.median(p)) for p in position])
    return Followed(
        tuple(trials), step, base, servo, float(trials[0].send_time_s[0]),
        max(float(away.mean()), 1e-9), np.concatenate(times), np.concatenate(position),
        np.cumsum([0, *map(len, times)]),
    )  # fmt: skip


def follower_path(
    samples: Samples, terms: NDArray, time_s: NDArray, start_s: float
) -> NDArray[np.float64]:
    """Path of a servo with the `terms` of a `Follower`, at times of one trial."""
    natural, damping, _, *limits, _ = np.exp(terms)
    every = max(1, int(_GRID_S / samples.grid_s))
    grid = samples.grid_s * every
    out = _follow(samples.command_rad[::every], samples.rest_rad, grid, natural, damping, *limits)
    clock = samples.start_s + grid * np.arange(len(out))
    return np.interp(time_s - terms[2] - terms[7] * (time_s - start_s), clock, out)


def follow(
    joint: Followed, begin: NDArray, change: _Change | None = None, highest: NDArray = _HIGHEST
) -> Follower:
    """Fit a servo with limits, by itself or with a change on top of it."""
    drift = float(begin[7])

    def fitted(terms: NDArray) -> Follower:
        terms = np.minimum(terms if drift else np.append(terms, 0.0), highest)
        path = joint.path(terms)
        more = change.columns(path) if change else []
        return Follower(terms, path, joint.regressed(path, *more))

    def cost(terms: NDArray) -> float:
        beyond = np.sum(np.maximum(terms - highest[: len(terms)], 0.0)) + max(-1.5 - terms[1], 0)
        early = 0.0 if drift else 20 * max(-terms[2], 0.0)
        found = fitted(terms).regression
        return found.cost + beyond + early + (found.values[0] <= 0)

    begin = begin if drift else begin[:7]
    simplex = np.vstack([begin, begin + np.diag(_STEPS[: len(begin)])])
    if drift:
        middle = float(np.mean(joint.time_s)) - joint.start_s
        simplex[-1, [2, 7]] = begin[[2, 7]] + np.array([middle, -1.0]) * 0.7 * drift
    result: OptimizeResult = minimize(
        cost, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": _EVALUATIONS, "fatol": 5e-5, "xatol": 1e-4},
    )  # fmt: skip
    return fitted(result["x"])


@njit(cache=True)
def _follow(command, rest, grid, natural, damping, speed, acceleration, friction, effort):
    """Path of a servo from rest, at each point of the grid."""
    parts = max(1, int(np.ceil(grid * natural / 0.3)))
    step = grid / parts
    goal = place = rest
    rate = velocity = 0.0
    hold, most_force = natural * natural * friction, natural * natural * effort
    out = np.empty(len(command))
    for k in range(len(command)):
        for _ in range(parts):
            away = command[k] - goal
            wanted = min(speed, np.sqrt(2 * acceleration * abs(away)))
            wanted = wanted if away > 0 else -wanted
            most = acceleration * step
            rate += min(max(wanted - rate, -most), most)
            goal += rate * step
            if (command[k] - goal) * away <= 0:
                goal = command[k]
                if abs(rate) <= 2 * most:
                    rate = 0.0
            force = natural * natural * (goal - place)
            force = min(max(force, -most_force), most_force) - 2 * damping * natural * velocity
            if velocity == 0.0 and abs(force) <= hold:
                continue
            way = np.sign(velocity) if velocity != 0.0 else np.sign(force)
            after = velocity + step * (force - way * hold)
            velocity = 0.0 if velocity != 0.0 and after * velocity < 0 else after
            place += step * velocity
        out[k] = place
    return out


@njit(cache=True)
def _regression(design, position, starts, bound, floor):
    """Mean cost, values and residuals of a regression whose errors cost no more than `bound`."""
    count, columns = design.shape
    weight, rest = np.ones(count), np.zeros(count)
    values = np.zeros(columns)
    x, y = design.copy(), position.copy()
    for _ in range(6):
        for trial in range(len(starts) - 1):
            a, b = starts[trial], starts[trial + 1]
            total = weight[a:b].sum()
            for c in range(columns):
                x[a:b, c] = design[a:b, c] - (weight[a:b] * design[a:b, c]).sum() / total
            y[a:b] = position[a:b] - (weight[a:b] * position[a:b]).sum() / total
        gram, right = np.zeros((columns, columns)), np.zeros(columns)
        for k in range(count):
            for c in range(columns):
                right[c] += weight[k] * x[k, c] * y[k]
                for d in range(columns):
                    gram[c, d] += weight[k] * x[k, c] * x[k, d]
        for c in range(columns):
            gram[c, c] += 1e-12 + 1e-9 * gram[c, c]
        values = np.linalg.solve(gram, right)
        for k in range(count):
            rest[k] = y[k]
            for c in range(columns):
                rest[k] -= values[c] * x[k, c]
            size = abs(rest[k])
            weight[k] = (bound / (size + bound)) ** 2 / max(size, floor)
    size = np.abs(rest)
    return np.mean(bound * size / (size + bound)), values, rest


# ----- hypotheses
@dataclass(frozen=True)
class _Change:
    """A hypothesis, screened on the servo's path alone."""

    cost: float
    columns: Callable[[NDArray], list[NDArray]]
    """What it adds to the path of a servo, from that path."""
    finding: Callable[[Followed, Follower], Finding | None]
    """What it is when the servo was fitted again with it; None where it is too small to matter."""
    begin: NDArray[np.float64] | None = None
    """Terms to begin with, if not those of the servo alone."""
    rows: NDArray[np.bool_] | None = None
    """Of the readings that it leaves."""


def _compared(joint: Followed) -> list[Finding]:
    alone = joint.fit.regression.cost
    if alone < _WELL:
        return []
    tried = [c for change in CHANGES if (c := change(joint)) and c.cost < _WORTH * alone]
    best: tuple[float, Finding] | None = None
    for change in sorted(tried, key=lambda c: c.cost)[:_FITTED]:
        part = joint if change.rows is None else _without(joint, ~change.rows)
        begin = joint.fit.terms if change.begin is None else change.begin
        fit = follow(part, begin, change)
        if change.begin is not None:  # of another servo
            fit = follow(part, fit.terms)
        alone = min(alone, joint.regressed(joint.path(np.append(fit.terms[:7], 0.0))).cost)
        found = change.finding(part, fit)
        cost = fit.regression.cost * (1 + _LESS_SIMPLE * tried.index(change))
        if found and fit.regression.cost < _FOLLOWS and (best is None or cost < best[0]):
            best = cost, found
    return [best[1]] if best and best[0] < _MUCH_LESS * alone else []


def _without(joint: Followed, rows: NDArray[np.bool_]) -> Followed:
    """The readings but for some."""
    keep = ~rows
    counts = [
        int(keep[a:b].sum()) for a, b in zip(joint.starts[:-1], joint.starts[1:], strict=True)
    ]
    samples = tuple(s for s, n in zip(joint.base.samples, counts, strict=True) if n)
    return replace(
        joint, base=replace(joint.base, samples=samples), time_s=joint.time_s[keep],
        position_rad=joint.position_rad[keep], starts=np.cumsum([0, *(n for n in counts if n)]),
    )  # fmt: skip


def _split(
    joint: Followed, columns: Callable[[int, NDArray], list[NDArray]]
) -> tuple[float, int] | None:
    """Cost and reading of a change that explains most, a while from either end of its trial."""
    each, path = max(_SPLITS // (len(joint.starts) - 1), 3), joint.fit.path_rad
    tried: list[tuple[float, int]] = []
    for a, b in zip(joint.starts[:-1], joint.starts[1:], strict=True):
        time = joint.time_s[a:b]
        low, high = time[0] + _EDGE_S, time[-1] - _EDGE_S
        if low < high:
            for k in a + np.searchsorted(time, np.linspace(low, high, each)):
                tried.append((joint.regressed(path, *columns(int(k), path)).cost, int(k)))
    return min(tried, default=None)


def _after(joint: Followed, at: int) -> NDArray[np.float64]:
    """1 for the readings from `at` on in its trial."""
    end = joint.starts[np.searchsorted(joint.starts, at, "right")]
    row = np.arange(len(joint.time_s))
    return ((row >= at) & (row < end)).astype(np.float64)


def _zero_moves(joint: Followed) -> _Change | None:
    """A zero that moves at a moment; under a load that is known gravity moves it."""

    def columns(k: int, path: NDArray) -> list[NDArray]:
        return [_after(joint, k)]

    best = None if any(t.load is not None for t in joint.trials) else _split(joint, columns)
    if best is None:
        return None
    at = best[1]

    def finding(joint: Followed, fit: Follower) -> Finding | None:
        moved = abs(float(fit.regression.values[1]))
        reach = max(float(np.ptp(s.command_rad)) for s in joint.base.samples)
        values = {"offset_rad": moved, "time_s": float(joint.time_s[at]) - joint.start_s}
        small = moved < max(_MOVED_RAD, _MOVED_SHARE * reach)
        return None if small else Finding("zero_moves", CARE, values)

    return _Change(best[0], partial(columns, at), finding)


def _gain_changes(joint: Followed) -> _Change | None:
    """A gain that changes at a moment, about any place."""
    row = np.arange(len(joint.time_s))

    def columns(k: int, path: NDArray) -> list[NDArray]:
        return [path * (row >= k), _after(joint, k)]

    best = _split(joint, columns)
    if best is None:
        return None
    at = best[1]

    def finding(joint: Followed, fit: Follower) -> Finding | None:
        before, more = map(float, fit.regression.values[:2])
        low, high = sorted((before, before + more))
        values = {"time_s": float(joint.time_s[at]) - joint.start_s, "before": before,
                  "after": before + more}  # fmt: skip
        return None if low > _OTHER_GAIN * high else Finding("gain_changed", CARE, values)

    return _Change(best[0], partial(columns, at), finding)


def _gain_drifts(joint: Followed) -> _Change | None:
    """A gain that grows or shrinks steadily."""
    share = (joint.time_s - joint.time_s.mean()) / max(float(np.ptp(joint.time_s)), 1e-9)

    def columns(path: NDArray) -> list[NDArray]:
        return [path * share, share]

    def finding(joint: Followed, fit: Follower) -> Finding | None:
        change = float(fit.regression.values[1] / max(fit.regression.values[0], 1e-9))
        values = {"percent": 100 * change}
        return None if abs(change) < _GAIN_DRIFT else Finding("gain_drifts", CARE, values)

    path = joint.fit.path_rad
    return _Change(joint.regressed(path, *columns(path)).cost, columns, finding)


def _lag_drifts(joint: Followed) -> _Change | None:
    """A lag that grows steadily: clocks that drift apart."""
    usual = joint.fit.terms.copy()
    usual[:2] = np.log(_USUAL[0][:2])  # a servo without a drift may have become too fast for it
    middle = float(np.mean(joint.time_s)) - joint.start_s
    tried = []
    for growth, shift in product(_GROWTHS, _SHIFTS_S):
        for terms in (joint.fit.terms.copy(), usual.copy()):
            terms[[2, 7]] += shift - growth * middle, growth
            tried.append((joint.regressed(joint.path(terms)).cost, tuple(terms)))
    least, begin = min(tried)

    def finding(joint: Followed, fit: Follower) -> Finding | None:
        growth = float(fit.terms[7])
        if abs(growth) * np.ptp(joint.time_s) < _LAG_DRIFT_S or abs(growth) > _CLOCK:
            return None
        return Finding("lag_drifts", CARE, {"drift_ms": 1e3 * growth, "percent": 100 * growth})

    # with another servo it explains more: always worth a fit
    cost = min(least, 0.9 * joint.fit.regression.cost)
    return _Change(cost, lambda path: [], finding, np.array(begin))


def _leaves_path(joint: Followed) -> _Change | None:
    """Some whiles in which the joint is elsewhere; where it rests, it does not answer."""
    rest = joint.fit.regression.residuals_rad
    size = np.abs(rest)
    away = size > max(_BOUND * joint.scale, 4 * float(np.median(size)), 4 * joint.step)
    whiles: list[tuple[int, int]] = []
    for a, b in zip(joint.starts[:-1], joint.starts[1:], strict=True):
        rows = a + np.flatnonzero(away[a:b])
        cuts = np.flatnonzero(np.diff(joint.time_s[rows]) > _AGAIN_S)
        for part in np.split(rows, cuts + 1):
            long = len(part) > 3 and joint.time_s[part[-1]] - joint.time_s[part[0]] > _LEFT_S
            # beside its path at rest a joint is held by friction
            if long and np.ptp(rest[part]) > 2 * _BOUND * joint.scale:
                whiles.append((part[0], part[-1] + 1))
    out = np.zeros(len(size), bool)
    for a, b in whiles:
        out[a:b] = True
    if not whiles or len(whiles) > _TIMES_LEFT or out.mean() > _MOST_LEFT:
        return None
    a, b = max(whiles, key=lambda w: joint.time_s[w[1] - 1] - joint.time_s[w[0]])
    longest = float(joint.time_s[b - 1] - joint.time_s[a])
    middle = joint.position_rad[a + (b - a) // 6 : b - (b - a) // 6]
    if np.ptp(middle) <= max(1.5 * joint.step, 0.02 * joint.scale):
        values = {"trials": len(whiles), "of": len(joint.trials), "longest_s": longest}
        found = Finding("frozen", CARE, values)
    else:
        values = {"times": len(whiles), "longest_s": longest,
                  "time_s": float(joint.time_s[whiles[0][0]]) - joint.start_s}  # fmt: skip
        found = Finding("left_path", CARE, values)
    path = joint.fit.path_rad[~out]
    cost = _without(joint, out).regressed(path).cost
    return _Change(cost, lambda path: [], lambda joint, fit: found, rows=~out)


CHANGES: tuple[Callable[[Followed], _Change | None], ...] = (
    _zero_moves, _lag_drifts, _gain_drifts, _gain_changes, _leaves_path,
)  # fmt: skip
