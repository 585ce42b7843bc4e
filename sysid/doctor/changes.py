"""What happens within a recording to a servo that follows: hypotheses compared on one servo.

A linear servo (`explanations`) says what the pair of columns is. What a sound servo does beyond it,
a set-point that ramps, a motor that saturates, friction, a load, looks like a fault to whatever
compares its readings with a straight line. `fitted` fits a second-order servo with these limits by
Levenberg-Marquardt at a bounded cost: what happens in a part of a recording does not bend the
whole.

`comparisons` then fits it again with what may have come on top: a zero or a gain that moves at a
moment, a gain or a lag that drifts, a clamped goal, a stop, a while in which the joint leaves its
path. The best is named if the servo alone explains the readings much less: residuals that agree
with those beside them count as one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pupper_sysid.sysid.doctor.explanations import FILTERS, Explanation, Servo, explain
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, Finding
from pupper_sysid.sysid.feedback.staleness import staleness
from pupper_sysid.sysid.recordings.excitation import remembered
from pupper_sysid.sysid.recordings.recording import Trial

_MOST_READINGS, _GRID_S = 1500, 0.0025
_UNFILTERED_HZ = 15.0  # natural frequency of a servo that no low-pass explains better
_LONGEST_LAG_S = 0.5

(_NATURAL, _DAMPING, _SPEED, _RAMP, _FRICTION, _EFFORT, _MOTOR, _INTEGRAL,
 _BIAS, _LAG, _GROWTH, _LOW, _HIGH, _BOTTOM, _TOP) = range(15)  # fmt: skip
_LOGARITHMS = slice(0, 8)
_FAR = 1e6  # levels that nothing reaches [rad]
_LOWEST = np.array(
    [*np.log([2, 0.2, 0.05, 0.5, 1e-6, 0.01, 0.1, 1e-3]), -2, 0, -0.03, *[-_FAR] * 4]
)
_HIGHEST = np.array([*np.log([250, 4, 300, 2e4, 3, 20, 300, 30]), 2, 0.8, 0.03, *[_FAR] * 4])
_STEPS = np.array([0.03, 0.05, 0.1, 0.1, 0.15, 0.08, 0.1, 0.2, 0.02, 0.002, 2e-4, *[0.01] * 4])
"""Bounds of a servo's terms, and differences for their derivatives; of levels and the bias in units
of the command's range."""
_ALONE = tuple(range(_GROWTH))
_DRAWN, _DRAWN_FROM = 200, (
    (10, 90), (0.5, 1.3), (1.5, 6), (8, 80), (0.002, 0.04), (0.1, 1), (2, 12), (0.3, 5),
    (0.003, 0.08),
)  # fmt: skip
"""Servos tried, and ranges of their terms, the lag last; friction and effort of the range."""
_OF_A_KIND = 2
_REFINED, _HOPS, _TRIED, _WELL = 3, 3, 5, 0.02
_BOUND, _CRUDE = 0.25, 0.004  # of the position's mean deviation
EXPLAINED = 0.06
"""Of the position's mean deviation: a servo that leaves less explains nearly all."""
_OF_TRAVEL = 8.0  # readings in one motion over the range, as from rest to rest
_WELL_EXPLAINED = 0.008  # of the same: nothing is left that a change could explain
_FOLLOWS, _LITTLE = 0.12, 0.3  # of the same; of a friction
CLEAR_NATS = 20.0
"""Advantage of a fault over a servo without it: of 96 sound recordings drawn afresh (servos of six
kinds, six motions, 15 to 400 Hz, with and without polls) no change has as much."""
_SPLITS = 30
_EDGE_S, _EDGE_SHARE = 1.0, 0.125  # from either end: an integral settles at the beginning
_NO_GAIN, _OTHER_GAIN, _GAIN_DRIFT, _LAG_DRIFT_S, _EARLY_S = 0.1, 0.75, 0.2, 0.008, 0.02
_MOVED_RAD, _MOVED_SHARE = 0.03, 0.08  # the latter of the command's range
_GROWTHS = tuple(sign * size for size in (0.0015, 0.003, 0.006, 0.012) for sign in (-1, 1))
_SHIFTS_S = (-0.04, 0.0, 0.04)
_FEW_LEVELS = 4
_SERVOS, _LEVELS = 4, np.linspace(0.15, 0.95, 9)  # of the command's range
_DEEP, _BEYOND = 0.06, 0.03  # of the path's range; of the readings
_LEFT_S, _AGAIN_S, _MOST_LEFT, _TIMES_LEFT = 0.4, 0.3, 0.45, 4


@dataclass(frozen=True)
class Follower:
    """A servo with limits, fitted."""

    terms: NDArray[np.float64]
    """Logarithms of natural frequency [rad/s], damping ratio, speed [rad/s] and acceleration
    [rad/s²] of the set-point, friction and effort limit [rad of command], speed of the motor
    [rad/s] and integral gain [1/s]; a constant load [ranges of the command], lag [s] and its growth
    per second; lowest and highest goal and place [rad of command]."""
    path_rad: NDArray[np.float64]
    """The command as it is followed, at each reading."""
    cost: float
    """Mean bounded error over the mean deviation, and what no model explains."""
    values: NDArray[np.float64]
    """Of the regression of the position on the path, and on what a change adds."""
    residuals_rad: NDArray[np.float64]

    @property
    def independent(self) -> float:
        """Residuals that count as independent, by what their means over longer parts still vary.

        A joint at rest has been read once however often it is: motion over the range gives some.
        """
        r, count = self.residuals_rad, len(self.residuals_rad)
        lengths = [m for m in (4, 8, 16, 32, 64) if m * 8 <= count]
        means = [r[: count // m * m].reshape(-1, m).mean(axis=1) for m in lengths]
        spread = float(np.var(r)) + 1e-18
        shares = [
            spread / (m * float(np.var(b)) + 1e-18) for m, b in zip(lengths, means, strict=True)
        ]
        travel = np.sum(np.abs(np.diff(self.path_rad))) / (np.ptp(self.path_rad) + 1e-12)
        return min(count * min([1.0, *shares]), _OF_TRAVEL * float(travel))

    def unexplained(self, joint: Followed) -> float:
        """Share of the variance of the readings."""
        parts = np.split(joint.position_rad, joint.starts[1:-1])
        about = np.concatenate([p - p.mean() for p in parts])
        left = self.residuals_rad - self.residuals_rad.mean()
        return float(np.mean(left**2) / max(np.mean(about**2), 1e-18))


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
    reach: float
    """Range of the command [rad]."""
    time_s: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    starts: NDArray[np.int64]
    """First reading of each trial, and the end."""

    @property
    def explained(self) -> bool:
        """Whether a servo with limits explains nearly all."""
        return self.fit.cost < EXPLAINED

    @property
    def unexplained(self) -> float:
        """Share of the variance of all readings that it leaves."""
        return self.fit.unexplained(self)

    @cached_property
    def screen(self) -> list[Follower]:
        """The linear servo, and the best of many drawn from what servos are."""
        hz, damping = FILTERS[self.servo.filter]
        natural, lag = 2 * np.pi * (hz or _UNFILTERED_HZ), max(self.servo.lag_s, 0.0)
        linear = [natural, damping, 300.0, 2e4, 0.004 * self.reach, 20.0, 300.0, 0.01, lag]
        servos = []
        for kind in ([linear], *_drawn(self.reach)):
            tried = []
            for *logarithms, late in kind:
                terms = [*np.log(logarithms), 0.0, late, 0.0, -_FAR, _FAR, -_FAR, _FAR]
                tried.append(self.follower(np.clip(terms, _LOWEST, _HIGHEST)))
            servos += sorted(tried, key=_cost)[:_OF_A_KIND]
        return servos

    @cached_property
    def fit(self) -> Follower:
        """The servo that explains most readings: the best of the screen, refined."""
        best: Sequence[Follower] = self.screen
        for count, rounds in ((_REFINED, 4), (1, 20)):
            best = sorted((fitted(self, f, rounds=rounds) for f in best), key=_cost)[:count]
        fit = best[0]
        for _ in range(_HOPS):
            if fit.cost < _WELL:
                break
            tried = [fitted(self, f, rounds=5) for f in self._varied(fit)]
            better = min(tried, key=_cost)
            if better.cost > 0.97 * fit.cost:
                break
            fit = fitted(self, better, rounds=15)
        return fit

    def _varied(self, fit: Follower) -> list[Follower]:
        """The same servo with another kind of limit: the way to it may lead uphill."""
        fast = np.exp(fit.terms[_NATURAL]) * self.reach
        effort = min(0.3 * self.reach, 0.5 * float(np.exp(fit.terms[_EFFORT])))
        servos = []
        for change in (
            {_INTEGRAL: 1.5}, {_INTEGRAL: 0.01, _BIAS: 0.0}, {_EFFORT: effort, _MOTOR: fast},
            {_EFFORT: 20.0, _MOTOR: 2 * fast}, {_SPEED: 5.0, _RAMP: 25.0},
            {_SPEED: 300.0, _RAMP: 2e4}, {_FRICTION: 0.05 * self.reach},
            {_FRICTION: 0.004 * self.reach},
        ):  # fmt: skip
            terms = fit.terms.copy()
            for k, value in change.items():
                terms[k] = value if k == _BIAS else np.log(value)
            servos.append(self.follower(np.clip(terms, _LOWEST, _HIGHEST)))
        return sorted(servos, key=_cost)[:_TRIED]

    @cached_property
    def disturbed(self) -> float:
        """Cost of the fit beyond what readings of unknown age explain."""
        gaps = np.concatenate([np.diff(t.send_time_s) for t in self.trials])
        age = 0.25 * float(np.median(gaps)) * (staleness(self.trials).kind != "live")
        rate = np.abs(
            np.gradient(self.fit.path_rad, self.time_s + 1e-9 * np.arange(len(self.time_s)))
        )
        return self.fit.cost - age * float(np.median(rate)) / self.scale

    @cached_property
    def friction_rad(self) -> float:
        """Error of the command that friction holds against; 0 where a servo needs none."""
        if self.fit.cost > _FOLLOWS:
            return 0.0
        terms = self.fit.terms.copy()
        terms[_FRICTION] += np.log(_LITTLE)
        free = [k for k in _ALONE if k != _FRICTION]
        without = fitted(self, self.follower(terms), free=free)
        nats = self.fit.independent * np.log(without.cost / self.fit.cost)
        return float(np.exp(self.fit.terms[_FRICTION])) if nats > CLEAR_NATS else 0.0

    @cached_property
    def changed(self) -> Compared | None:
        """The change that explains most of what the servo alone leaves, if one clearly does."""
        if self.fit.cost < _WELL_EXPLAINED:
            return None
        best = max((c for c in comparisons(self) if c.finding), key=lambda c: c.nats, default=None)
        return best if best and best.nats > CLEAR_NATS else None

    @property
    def changes(self) -> list[Finding]:
        """Its finding."""
        return [self.changed.finding] if self.changed and self.changed.finding else []

    @cached_property
    def _inputs(self) -> list[tuple[NDArray[np.float64], float, float, float]]:
        """Command, its rest, and the grid and the start of its time, of each trial."""
        inputs = []
        for s in self.base.samples:
            every = max(1, int(_GRID_S / s.grid_s))
            command = np.ascontiguousarray(s.command_rad[::every])
            inputs.append((command, s.rest_rad, s.grid_s * every, s.start_s))
        return inputs

    def path(self, terms: NDArray) -> NDArray[np.float64]:
        """The command as a servo follows it, at each reading [rad of command]."""
        terms = terms.copy()
        terms[_LOGARITHMS] = np.exp(terms[_LOGARITHMS])
        terms[_BIAS] *= self.reach
        path, middle = np.empty_like(self.time_s), self.start_s
        for inputs, a, b in zip(self._inputs, self.starts[:-1], self.starts[1:], strict=True):
            late = self.time_s[a:b] - terms[_LAG] - terms[_GROWTH] * (self.time_s[a:b] - middle)
            _follow(*inputs, terms, late, path[a:b])
        return path

    def path_of_trial(self, number: int) -> NDArray[np.float64]:
        """The same of the fit, at all readings of a trial."""
        sample = self.base.samples[number]
        base = replace(self.base, samples=(sample,))
        ends = np.array([0, len(sample.time_s)])
        return replace(self, base=base, time_s=sample.time_s, starts=ends).path(self.fit.terms)

    def follower(self, terms: NDArray, columns: Columns | None = None) -> Follower:
        """Regress the position on the path, what is added to it, and a constant per trial."""
        return self.regressed(terms, self.path(terms), columns)

    def regressed(self, terms: NDArray, path: NDArray, columns: Columns | None) -> Follower:
        """The same of a path that is known."""
        design = np.column_stack([path, *(columns(path) if columns else ())])
        floor = 0.01 * self.scale + 0.25 * self.step
        cost, values, rest = _regression(
            design, self.position_rad, self.starts, _BOUND * self.scale, floor
        )
        cost = cost / self.scale + _CRUDE + 0.05 * self.step / self.scale
        return Follower(terms, path, cost, np.asarray(values, np.float64), rest)


Columns = Callable[[NDArray], Sequence[NDArray]]
"""What a change adds to the path of a servo, from that path."""


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
    reach = max(float(np.ptp(s.command_rad)) for s in base.samples)
    return Followed(
        tuple(trials), step, base, servo, float(trials[0].send_time_s[0]),
        max(float(away.mean()), 1e-9), reach, np.concatenate(times), np.concatenate(position),
        np.cumsum([0, *map(len, times)]),
    )  # fmt: skip


def _drawn(reach: float) -> list[NDArray[np.float64]]:
    """Terms of servos with the lag last: ramped, weak, held by friction, and with none of these."""
    u = np.random.default_rng(0).random((_DRAWN, 10))
    low, high = np.array(_DRAWN_FROM).T
    terms = np.exp(np.log(low) + u[:, :9] * np.log(high / low))
    terms[:, [_FRICTION, _EFFORT]] *= reach
    kind = np.minimum((5 * u[:, 9]).astype(int), 3)
    terms[kind != 3, _SPEED : _RAMP + 1] = 300.0, 2e4  # two in five ramp
    terms[kind != 1, _EFFORT], terms[kind != 1, _MOTOR] = 20.0, 300.0
    terms[kind == 2, _FRICTION] *= 10
    terms[u[:, 0] * 7 % 1 < 0.7, _INTEGRAL] = 0.01
    return [terms[kind == k] for k in range(4)]


def _cost(fit: Follower) -> float:
    return fit.cost if fit.values[0] > 0 else np.inf


def fitted(
    joint: Followed, begin: Follower, columns: Columns | None = None,
    free: Sequence[int] = _ALONE, rounds: int = 12,
) -> Follower:  # fmt: skip
    """Fit the `free` terms of a servo by Levenberg-Marquardt, reweighted for the bounded cost."""
    best, damping = joint.follower(begin.terms, columns), 0.03
    free = [k for k in free if k < _LOW or abs(begin.terms[k]) < _FAR]  # levels that are set
    bound, floor = _BOUND * joint.scale, 0.01 * joint.scale + 0.25 * joint.step
    steps = _STEPS.copy()
    steps[_LOW:] *= joint.reach
    terms_free = np.array(free)
    for _ in range(rounds):
        size = np.abs(best.residuals_rad)
        weight = (bound / (size + bound)) ** 2 / np.maximum(size, floor)
        slopes = []
        for k in free:
            moved = best.terms.copy()
            step = steps[k] if moved[k] + steps[k] <= _HIGHEST[k] else -steps[k]
            moved[k] += step
            slopes.append((joint.path(moved) - best.path_rad) * (best.values[0] / step))
        more = columns(best.path_rad) if columns else ()
        design = np.column_stack([*slopes, best.path_rad, *more])
        rest = best.residuals_rad.copy()
        for a, b in zip(joint.starts[:-1], joint.starts[1:], strict=True):
            share = weight[a:b] / weight[a:b].sum()
            design[a:b] -= share @ design[a:b]
            rest[a:b] -= share @ rest[a:b]
        gram = design.T @ (weight[:, None] * design)
        right = design.T @ (weight * rest)
        size, before = np.diag(gram) + 1e-9 * np.trace(gram) / len(gram), best.cost
        for _ in range(4):
            held = np.where(np.arange(len(gram)) < len(free), damping, 1e-9) * size
            way = np.linalg.lstsq(gram + np.diag(held), right, rcond=None)[0][: len(free)]
            way = np.clip(way, -8 * steps[terms_free], 8 * steps[terms_free])
            terms = best.terms.copy()
            terms[terms_free] += way
            tried = joint.follower(np.clip(terms, _LOWEST, _HIGHEST), columns)
            if tried.values[0] > 0 and tried.cost < best.cost:
                best, damping = tried, max(damping / 4, 1e-4)
                break
            damping *= 5
        if best.cost > 0.999 * before:
            break
    return best


@njit(cache=True)
def _follow(command, rest, grid, start, terms, time, out):
    """Path of a servo from rest, at times."""
    natural, damping, speed, ramp, friction, effort, motor, integral, bias = terms[:9]
    low, high, bottom, top = terms[11:15]
    parts = max(1, int(np.ceil(grid * natural / 0.3)))
    step, square = grid / parts, natural * natural
    goal = min(max(rest, low), high)
    place = min(max(goal, bottom), top)
    rate = velocity = 0.0
    load = hand = (
        bias * square
    )  # the integral, or a hand before the first command, carries the load
    if integral < 0.01:
        hand = 0.0
    hold, most_force, most = square * friction, square * effort, ramp * step
    places = np.empty(len(command))
    for k in range(len(command)):
        wished = min(max(command[k], low), high)
        for _ in range(parts):
            away = wished - goal
            if away != 0.0 or rate != 0.0:
                wanted = min(speed, np.sqrt(2 * ramp * abs(away)))
                wanted = wanted if away > 0 else -wanted
                rate += min(max(wanted - rate, -most), most)
                goal += rate * step
                if (wished - goal) * away <= 0:
                    goal = wished
                    if abs(rate) <= 2 * most:
                        rate = 0.0
            force = square * (goal - place) + hand
            if abs(force) < most_force:
                hand += integral * square * (goal - place) * step
            force = min(max(force, -most_force), most_force) - 2 * damping * natural * velocity
            if force * velocity > 0:
                moving = most_force * max(1 - abs(velocity) / motor, 0.0)
                force = min(max(force, -moving), moving)
            force -= load
            if velocity == 0.0 and abs(force) <= hold:
                continue
            way = np.sign(velocity) if velocity != 0.0 else np.sign(force)
            after = velocity + step * (force - way * hold)
            velocity = 0.0 if velocity != 0.0 and after * velocity < 0 else after
            place += step * velocity
            if place < bottom:
                place, velocity = bottom, 0.0
            elif place > top:
                place, velocity = top, 0.0
        places[k] = place
    for k in range(len(time)):
        x = (time[k] - start) / grid
        n = int(min(max(np.floor(x), 0), len(places) - 2))
        out[k] = places[n] + min(max(x - n, 0.0), 1.0) * (places[n + 1] - places[n])


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
    """A hypothesis, and how it is fitted."""

    begins: Sequence[Follower]
    """Servos to begin with."""
    finding: Callable[[Follower], Finding | None]
    """What it is once it is fitted; None where it is too small to matter."""
    columns: Columns | None = None
    free: Sequence[int] = ()
    """Terms of the servo that it adds."""
    without: NDArray[np.bool_] | None = None
    """Readings that it leaves out."""
    values: float = 1
    """How many numbers it adds."""
    usual: Columns | None = None
    """What of a sound servo looks like it."""


@dataclass(frozen=True)
class Compared:
    """A change against the servo alone."""

    nats: float
    """Advantage of the change."""
    alone: float
    fit: Follower
    finding: Finding | None


def comparisons(joint: Followed) -> list[Compared]:
    """Every change, fitted."""
    # a load that is known sags and swings as its fit finds, and this servo does not
    loaded = any(t.load is not None for t in joint.trials)
    found = []
    for change in (_lag_drifts, _leaves_path) if loaded else CHANGES:
        if tried := change(joint):
            part = joint if tried.without is None else _without(joint, tried.without)
            fits = [fitted(part, b, tried.columns, (*_ALONE, *tried.free)) for b in tried.begins]
            fit = min(fits, key=_cost)
            alone = fit.terms.copy()
            alone[_GROWTH:] = joint.fit.terms[_GROWTH:]
            plain = min(joint.fit.cost, fitted(joint, joint.follower(alone), rounds=8).cost)
            if tried.usual:
                begins = joint.fit, joint.follower(alone)
                plain = min(plain, *(fitted(joint, b, tried.usual).cost for b in begins))
            values = tried.values
            if tried.without is not None:  # a number for each independent reading that is left out
                values = fit.independent * tried.without.mean()
            nats = fit.independent * np.log(plain / fit.cost)
            nats -= 0.5 * values * np.log(len(joint.time_s))
            found.append(Compared(float(nats), plain, fit, tried.finding(fit)))
    return found


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


def _split(joint: Followed, columns: Callable[[int], Columns]) -> tuple[int, Follower] | None:
    """Reading of a change that explains most, and the servo that it begins with.

    A servo that explains both parts alike has become another one: those of the screen are tried as
    well, and the moment is found again for the one that the change makes best.
    """
    edge = max(_EDGE_S, _EDGE_SHARE * float(np.ptp(joint.time_s)))
    low, high = joint.time_s[0] + edge, joint.time_s[-1] - edge
    if low >= high:
        return None
    moments = np.searchsorted(joint.time_s, np.linspace(low, high, _SPLITS)).tolist()
    begin = joint.fit
    for spread in (1.0, 0.1):
        tried = []
        for k in moments:
            tried.append((joint.regressed(begin.terms, begin.path_rad, columns(k)).cost, k))
        at = min(tried)[1]
        servos = [joint.regressed(f.terms, f.path_rad, columns(at)) for f in joint.screen]
        best = [begin, *sorted(servos, key=_cost)[:2]]
        begin = min((fitted(joint, f, columns(at), rounds=4) for f in best), key=_cost)
        around = 2 * spread * len(joint.time_s) / _SPLITS
        near = np.unique(np.linspace(at - around, at + around, 21).astype(int))
        trial = np.searchsorted(joint.starts, at, "right")
        low, high = joint.starts[trial - 1] + 2, joint.starts[trial] - 2
        moments = near[(near > low) & (near < high)].tolist() or [at]
    return at, begin


def _after(joint: Followed, at: int) -> NDArray[np.float64]:
    """1 for the readings from `at` on in its trial."""
    end = joint.starts[np.searchsorted(joint.starts, at, "right")]
    row = np.arange(len(joint.time_s))
    return ((row >= at) & (row < end)).astype(np.float64)


def _zero_moves(joint: Followed) -> _Change | None:
    """A zero that moves at a moment."""
    best = _split(joint, lambda k: lambda path: [_after(joint, k)])
    if best is None:
        return None
    at, begin = best

    def finding(fit: Follower) -> Finding | None:
        moved = abs(float(fit.values[1]))
        values = {"offset_rad": moved, "time_s": float(joint.time_s[at]) - joint.start_s}
        friction = 2 * float(np.exp(fit.terms[_FRICTION]))  # within it a joint rests anywhere
        small = moved < max(_MOVED_RAD, _MOVED_SHARE * joint.reach, friction)
        return None if small else Finding("zero_moves", CARE, values)

    return _Change([begin], finding, lambda path: [_after(joint, at)], values=2)


def _gain_changes(joint: Followed) -> _Change | None:
    """A gain that changes at a moment, about any place."""
    row = np.arange(len(joint.time_s))

    def columns(k: int) -> Columns:
        return lambda path: [path * (row >= k), _after(joint, k)]

    best = _split(joint, columns)
    if best is None:
        return None
    at, begin = best

    def finding(fit: Follower) -> Finding | None:
        before, more = map(float, fit.values[:2])
        low, high = sorted((before, before + more))
        values = {"time_s": float(joint.time_s[at]) - joint.start_s, "before": before,
                  "after": before + more}  # fmt: skip
        usual = _NO_GAIN * high < low < _OTHER_GAIN * high  # a joint without a gain is held or dead
        return Finding("gain_changed", CARE, values) if usual else None

    return _Change([begin], finding, columns(at), values=3)


def _gain_drifts(joint: Followed) -> _Change | None:
    """A gain that grows or shrinks steadily."""
    share = (joint.time_s - joint.time_s.mean()) / max(float(np.ptp(joint.time_s)), 1e-9)

    def finding(fit: Follower) -> Finding | None:
        change = float(fit.values[1] / max(fit.values[0], 1e-9))
        values = {"percent": 100 * change}
        return None if abs(change) < _GAIN_DRIFT else Finding("gain_drifts", CARE, values)

    def columns(path: NDArray) -> list[NDArray]:
        return [path * share, share]

    servos = [joint.regressed(f.terms, f.path_rad, columns) for f in joint.screen]
    return _Change([joint.fit, min(servos, key=_cost)], finding, columns, values=2)


def _lag_drifts(joint: Followed) -> _Change | None:
    """A lag that grows steadily: clocks that drift apart."""
    # a servo without a drift may have become another one for it
    servos = [joint.fit, *sorted(joint.screen, key=_cost)[:3]]
    middle = float(np.mean(joint.time_s)) - joint.start_s
    tried = []
    for growth, shift, servo in product(_GROWTHS, _SHIFTS_S, servos):
        moved = servo.terms.copy()
        moved[[_LAG, _GROWTH]] += shift - growth * middle, growth
        tried.append(joint.follower(moved))

    def finding(fit: Follower) -> Finding | None:
        growth = float(fit.terms[_GROWTH])
        if abs(growth) * np.ptp(joint.time_s) < _LAG_DRIFT_S:
            return None
        lags = fit.terms[_LAG] + growth * (joint.time_s - joint.start_s)
        verdict = REFUSE if lags.min() < -_EARLY_S else CARE  # early is what no servo is
        return Finding("lag_drifts", verdict, {"drift_ms": 1e3 * growth, "percent": 100 * growth})

    return _Change(sorted(tried, key=_cost)[:2], finding, free=(_GROWTH,))


def _clipped(joint: Followed) -> _Change | None:
    """A goal that is clamped, or a motion that ends at a stop, above, below or both."""
    command = np.concatenate([s.command_rad for s in joint.base.samples])
    low, high = float(command.min()), float(command.max())
    rows = np.sort(np.bincount(((command - low) / (0.02 * joint.reach + 1e-12)).astype(int)))
    if rows[-_FEW_LEVELS:].sum() > 0.9 * len(command):
        return None  # clamped, a command of few levels is one of others

    def level(term: int, share: float) -> float:
        return low + share * (high - low) if term in (_HIGH, _TOP) else high - share * (high - low)

    begins: list[Follower] = []
    for sides in ([(k,) for k in range(_LOW, _TOP + 1)], [(_LOW, _HIGH), (_BOTTOM, _TOP)]):
        tried = []
        for servo in (joint.fit, *sorted(joint.screen, key=_cost)[:_SERVOS]):
            for terms, share in product(sides, _LEVELS):
                moved = servo.terms.copy()
                moved[list(terms)] = [level(k, share) for k in terms]
                tried.append(joint.follower(moved))
        begins += sorted(tried, key=_cost)[:2]

    def finding(fit: Follower) -> Finding | None:
        plain = fit.terms.copy()
        plain[_LOW:] = joint.fit.terms[_LOW:]
        path = joint.path(plain)
        best: tuple[float, float] | None = None
        for k in np.flatnonzero(np.abs(fit.terms[_LOW:]) < _FAR) + _LOW:
            over = k in (_HIGH, _TOP)
            beyond = path > fit.terms[k] if over else path < fit.terms[k]
            depth = path.max() - fit.terms[k] if over else fit.terms[k] - path.min()
            share = float(beyond.mean())
            if depth > _DEEP * np.ptp(path) and share > max(_BEYOND, best[0] if best else 0.0):
                best = share, float(np.median(joint.position_rad[beyond]))
        if best is None:
            return None
        return Finding("clipped", CARE, {"level_rad": best[1], "percent": 100 * best[0]})

    def curve(path: NDArray) -> list[NDArray]:
        """As of gravity, or of a bent potentiometer."""
        about = (path - np.median(path)) / joint.reach
        return [about**2, about**3]

    return _Change(begins, finding, free=range(_LOW, _TOP + 1), values=2, usual=curve)


def _leaves_path(joint: Followed) -> _Change | None:
    """Some whiles in which the joint is elsewhere; where it rests, it does not answer."""
    rest = joint.fit.residuals_rad
    size = np.abs(rest)
    away = size > max(_BOUND * joint.scale, 4 * float(np.median(size)), 4 * joint.step)
    whiles: list[tuple[int, int]] = []
    for a, b in zip(joint.starts[:-1], joint.starts[1:], strict=True):
        rows = a + np.flatnonzero(away[a:b])
        cuts = np.flatnonzero(np.diff(joint.time_s[rows]) > _AGAIN_S)
        for part in np.split(rows, cuts + 1):
            long = len(part) > 3 and joint.time_s[part[-1]] - joint.time_s[part[0]] > _LEFT_S
            # beside its path at rest a joint is held by friction
            if long and np.ptp(rest[part]) > 2 * _BOUND * joint.scale and part[-1] < b - 4:
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
    return _Change([joint.fit], lambda fit: found, without=out, values=2 * len(whiles))


CHANGES: tuple[Callable[[Followed], _Change | None], ...] = (
    _zero_moves, _lag_drifts, _gain_drifts, _gain_changes, _clipped, _leaves_path,
)  # fmt: skip
