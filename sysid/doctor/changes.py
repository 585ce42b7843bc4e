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
from functools import cached_property, partial
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d
from scipy.optimize import nnls

from pupper_sysid.common.tones import least_squares
from pupper_sysid.servo_models import kernel
from pupper_sysid.sysid.doctor.explanations import FILTERS, Explanation, Servo, explain
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, Finding, rivalled
from pupper_sysid.sysid.recordings.excitation import named_tones, remembered
from pupper_sysid.sysid.recordings.recording import Trial

_MOST_READINGS, _STEP_S = 1500, 0.005
_UNFILTERED_HZ = 15.0  # natural frequency of a servo that no low-pass explains better
_LONGEST_LAG_S = 0.5

(_NATURAL, _DAMPING, _SPEED, _RAMP, _FRICTION, _EFFORT, _BACK_EMF, _INTEGRAL, _PLAY,
 _LAG, _LOAD, _GROWTH, _LOW, _HIGH, _BOTTOM, _TOP) = range(16)  # fmt: skip
_LOGARITHMS = slice(0, 9)
_HANGING = kernel.COLUMNS.index("hanging_rad")
_FAR = 1e6  # levels that nothing reaches [rad]
_DAMPED = np.array([0.2, 1.0, 5.0, 25.0, 125.0])  # times the damping before, tried abreast
_NO_LOAD, _SMALL_STEP = np.zeros(3), 0.2  # of the differences for derivatives
_NO_INTEGRAL, _NO_PLAY, _LONG_S = 0.01, 1e-3, 20.0  # [1/s], [rad], and before the recording
_LOWEST = np.array(
    [*np.log([2, 0.2, 0.05, 0.5, 1e-6, 0.002, 0.01, 1e-3, 1e-4]), 0, -0.3, -0.03, *[-_FAR] * 4]
)
_HIGHEST = np.array([*np.log([250, 4, 300, 2e4, 3, 20, 30, 30, 0.3]), 0.8, 0.3, 0.03, *[_FAR] * 4])
_STEPS = np.array([0.03, 0.05, 0.1, 0.1, 0.15, 0.08, 0.2, 0.2, 0.3, 0.002, 0.01, 2e-4, *[0.01] * 4])
"""Bounds of a servo's terms, and differences for their derivatives; of levels in units of the
command's range."""
_ALONE = tuple(range(_GROWTH))
_DRAWN, _DRAWN_FROM = 200, (
    (10, 90), (0.5, 1.3), (1.5, 6), (8, 80), (0.002, 0.04), (0.1, 1), (0.3, 10), (0.3, 5),
    (0.003, 0.08),
)  # fmt: skip
"""Servos tried, and ranges of their terms, the lag last; friction and effort of the range."""
_OF_A_KIND = 2
_REFINED, _HOPS, _WELL = 3, 3, 0.02
_ACCELERATION_OVER_S = 0.02  # a quantisation step of 1.5 mrad is 4 rad/s² then
_CRUDE = 0.004  # of the position's mean deviation
EXPLAINED = 0.06
"""Of the position's mean deviation: a servo that leaves less explains nearly all."""
_FOLLOWS, _LITTLE = 0.12, 0.3  # of the same; of a friction
CLEAR_NATS = 15.0
"""Advantage of a fault over a servo without it, beyond what its numbers cost."""
_GOOD_PART = 0.3  # of what the servo alone leaves and a change could explain
_SPLITS, _WHILES, _CELLS = 30, 14, 128
_FEWEST_PARTS = 8
_OF_TRAVEL = 2 * 4.0
"""Independent readings of one motion over the range: a servo settles within four of its time
constants, and does so twice, when it starts and when it stops."""
_EDGE_S, _EDGE_SHARE = 1.0, 0.125  # from either end: an integral settles at the beginning
_NO_GAIN, _OTHER_GAIN, _GAIN_DRIFT = 0.1, 0.75, 0.2
_LAG_DRIFT_S, _EARLY_S = 0.008, 0.02
_MOVED_RAD, _MOVED_SHARE = 0.03, 0.08  # the latter of the command's range
_GROWTHS = tuple(sign * size for size in (0.0015, 0.003, 0.006, 0.012) for sign in (-1, 1))
_LATER_S, _PER_GROWTH = (-0.06, -0.025, 0.025, 0.06), 0.1  # growth [1] of a lag by as many seconds
_FEW_LEVELS = 4
_SERVOS, _LEVELS = 4, np.linspace(0.15, 0.95, 9)  # of the command's range
_DEEP, _BEYOND = 0.06, 0.03  # of the path's range; of the readings
_UNSURE = 4.0  # errors that a servo as good as the fit may have: no while away from its path
_STROKES, _EXPLAINED_THERE = 4.0, 0.25  # over the range of a while; of what is left there
_MOST_LEFT, _TIMES_LARGER, _ROUNDS = 0.45, 5.0, 4


@dataclass(frozen=True)
class Follower:
    """A servo with limits, fitted."""

    terms: NDArray[np.float64]
    """Logarithms of natural frequency [rad/s], damping ratio, speed [rad/s] and acceleration
    [rad/s²] of the set-point, friction and effort limit [rad of command], damping beyond the
    effort limit over that within, integral gain [1/s], play [rad]; lag [s], load [of the
    command's range] and growth of the lag per second; lowest and highest goal and place [rad of
    command]."""
    path_rad: NDArray[np.float64]
    """The command as it is followed, at each reading."""
    cost: float
    """Mean bounded error over the mean deviation, and what no model explains."""
    values: NDArray[np.float64]
    """Of the regression of the position on the path, and on what a change adds."""
    residuals_rad: NDArray[np.float64]

    @property
    def readings(self) -> float:
        """Readings that the motion makes independent.

        A joint at rest has been read once however often it is: motion over the range gives some.
        """
        travel = np.sum(np.abs(np.diff(self.path_rad))) / (np.ptp(self.path_rad) + 1e-12)
        return min(len(self.path_rad), _OF_TRAVEL * float(travel))

    @property
    def independent(self) -> float:
        """Residuals that count as independent, by `_independent_share` and by the motion."""
        count = len(self.residuals_rad) * _independent_share(self.residuals_rad)
        return min(count, self.readings)

    @property
    def settles_s(self) -> float:
        """Time after which it is within 2 % of a command [s]: four time constants, and its lag."""
        natural, damping = np.exp(self.terms[[_NATURAL, _DAMPING]])
        slow = damping - np.sqrt(max(damping * damping - 1, 0.0))
        return float(4 / (natural * slow) + self.terms[_LAG])

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
    later: NDArray[np.float64]
    """What the lag's growth goes with: time since the start [s]."""
    bound: float = 0.25
    """Largest cost of an error, of the position's mean deviation."""

    @property
    def share(self) -> NDArray[np.float64]:
        """Time over the recording, from about -0.5 to 0.5."""
        return (self.time_s - self.time_s.mean()) / max(float(np.ptp(self.time_s)), 1e-9)

    @property
    def explained(self) -> bool:
        """Whether a servo with limits explains nearly all that limits let a fit explain."""
        return self.fit.cost - self.unsure < EXPLAINED

    @property
    def unexplained(self) -> float:
        """Share of the variance of all readings that it leaves."""
        return self.fit.unexplained(self)

    @cached_property
    def screen(self) -> list[Follower]:
        """The linear servo, and the best of many drawn from what servos are."""
        hz, damping = FILTERS[self.servo.filter]
        natural, lag = 2 * np.pi * (hz or _UNFILTERED_HZ), max(self.servo.lag_s, 0.0)
        linear = [natural, damping, 300.0, 2e4, 0.004 * self.reach, 20.0, 1.0, 0.01, 1e-3, lag]
        servos = []
        for kind in (np.array([linear]), *_drawn(self.reach)):
            servos += sorted(self.followers(_servos(kind)), key=_cost)[:_OF_A_KIND]
        return servos

    @cached_property
    def fit(self) -> Follower:
        """The servo that explains most readings: the best of the screen, refined."""
        best: Sequence[Follower] = self.screen
        for count, rounds in ((_REFINED, 4), (1, 20)):
            best = sorted((fitted(self, f, rounds=rounds) for f in best), key=_cost)[:count]
        return self.hopped(best[0])

    def hopped(
        self, fit: Follower, columns: Columns | None = None, free: Sequence[int] = _ALONE
    ) -> Follower:
        """The same servo with another kind of limit, if better: the way to it may lead uphill.

        A limit that the path does not reach has no derivative, and begins a little within it.
        """
        for _ in range(_HOPS):
            if fit.cost < _WELL:
                break
            effort = min(0.3 * self.reach, 0.5 * float(np.exp(fit.terms[_EFFORT])))
            seen = self.acceleration_rad_s2 * float(np.exp(-2 * fit.terms[_NATURAL]))
            speed, ramp = (float(np.max(np.abs(x))) + 1e-9 for x in self.rates(fit.path_rad))
            changes = (
                {_INTEGRAL: 1.5}, {_INTEGRAL: 0.01}, {_EFFORT: effort, _BACK_EMF: 1.0},
                {_EFFORT: 3 * effort, _BACK_EMF: 5.0}, {_EFFORT: seen, _BACK_EMF: 0.01},
                {_SPEED: 0.9 * speed},
                {_SPEED: 0.9 * speed, _RAMP: 0.5 * ramp, _EFFORT: 20.0},
                {_SPEED: 300.0, _RAMP: 2e4},
                {_FRICTION: 0.05 * self.reach}, {_FRICTION: 0.004 * self.reach},
            )  # fmt: skip
            terms = np.tile(fit.terms, (len(changes), 1))
            for row, change in zip(terms, changes, strict=True):
                row[list(change)] = np.log(list(change.values()))
            begins = self.followers(terms, columns)
            better = min((fitted(self, f, columns, free, rounds=5) for f in begins), key=_cost)
            if better.cost > 0.97 * fit.cost:
                break
            fit = fitted(self, better, columns, free, rounds=15)
        return fit

    @cached_property
    def acceleration_rad_s2(self) -> float:
        """Acceleration that the readings reach: about the limit of a servo that is often at it."""
        reached = [np.zeros(1)]
        for a, b in zip(self.starts[:-1], self.starts[1:], strict=True):
            grid = np.arange(float(self.time_s[a]), float(self.time_s[b - 1]), _ACCELERATION_OVER_S)
            position = np.interp(grid, self.time_s[a:b], self.position_rad[a:b])
            reached.append(np.abs(np.diff(position, 2)) / _ACCELERATION_OVER_S**2)
        return float(np.quantile(np.concatenate(reached), 0.95)) + 1e-9

    def rates(self, path: NDArray) -> NDArray[np.float64]:
        """First and second derivative of a path, shape (2, readings)."""
        rates = np.zeros((2, len(path)))
        for a, b in zip(self.starts[:-1], self.starts[1:], strict=True):
            time = self.time_s[a:b] + 1e-9 * np.arange(b - a)
            if b - a > 2:
                rates[0, a:b] = np.gradient(path[a:b], time)
                rates[1, a:b] = np.gradient(rates[0, a:b], time)
        return rates

    @cached_property
    def unsure_rad(self) -> NDArray[np.float64]:
        """Error that a servo as good as the fit may have, at each reading [rad].

        Where a small change of a limit ends in another motion, such as that of a profile far above
        its acceleration, no fit comes nearer. There, paths are not straight in their terms: the
        second differences of the fit's.
        """
        step = _SMALL_STEP * steps_of(self)
        inside = (self.fit.terms - step > _LOWEST) & (self.fit.terms + step < _HIGHEST)
        changes = (np.eye(len(step)) * step)[[k for k in _ALONE if inside[k]]]
        paths = self.paths(np.concatenate([self.fit.terms + changes, self.fit.terms - changes]))
        bends = paths.reshape(2, len(changes), -1).sum(axis=0) - 2 * self.fit.path_rad
        return abs(float(self.fit.values[0])) * np.sqrt(np.sum(bends**2, axis=0))

    @cached_property
    def unsure(self) -> float:
        """The same as a cost."""
        return self.cost_of(self.unsure_rad)

    def cost_of(self, errors: NDArray[np.float64] | np.float64) -> float:
        """Mean bounded error over the mean deviation."""
        share = np.abs(errors) / self.scale
        return float(np.mean(self.bound * share / (share + self.bound)))

    @property
    def noise(self) -> float:
        """Cost of what differs from reading to reading alone: noise, and readings of any age."""
        return self.cost_of(np.diff(self.fit.residuals_rad) / np.sqrt(2))

    @property
    def explainable(self) -> float:
        """Nats that a change would have which leaves the noise alone."""
        usual = np.median(np.abs(np.diff(self.fit.residuals_rad)))  # of Gaussian ones, not of edges
        least = _CRUDE + self.cost_of(0.8 / 0.67 / np.sqrt(2) * usual) + self.unsure
        return self.fit.readings * float(np.log((self.fit.cost + self.unsure) / least))

    @property
    def disturbed(self) -> float:
        """Cost of the fit beyond its noise and what it is unsure of."""
        return self.fit.cost - self.noise - self.unsure

    @cached_property
    def friction_rad(self) -> float:
        """Error of the command that friction and play hold; 0 where a servo needs none."""
        if self.fit.cost > _FOLLOWS:
            return 0.0
        terms = self.fit.terms.copy()
        terms[[_FRICTION, _PLAY]] += np.log(_LITTLE)
        free = [k for k in _ALONE if k not in (_FRICTION, _PLAY)]
        without = fitted(self, self.follower(terms), free=free)
        nats = self.fit.independent * np.log(without.cost / self.fit.cost)
        friction, play = np.exp(self.fit.terms[[_FRICTION, _PLAY]])
        return float(friction + play / 2) if nats > CLEAR_NATS else 0.0

    @cached_property
    def changed(self) -> Compared | None:
        """The change that explains most of what the servo alone leaves, if one clearly does.

        Whiles away from the path have no cause yet: the change that explains most of them is one.
        """
        nats, whiles, fit = self.away
        most = self.fit.cost - _GOOD_PART * (self.fit.cost - self.noise - _CRUDE)
        least = CLEAR_NATS if nats < CLEAR_NATS else 0.0  # they show that there is one
        clear = [c for c in self.compared if c.finding and c.nats > least and c.fit.cost < most]
        count = min((c.fit.independent for c in clear), default=1.0)  # of one judge of them all
        cost = 0.5 * np.log(len(self.time_s)) / count
        ranked = sorted(clear, key=lambda c: np.log(c.fit.cost) + cost * c.values)
        if nats >= CLEAR_NATS:
            left = 0.5 * nats if ranked and ranked[0].nats > CLEAR_NATS else CLEAR_NATS
            if not ranked or whiles_away(self, ranked[0].fit)[0] > left:
                return Compared(nats, 0, self.fit, left_path(self, fit, whiles))
        return ranked[0] if ranked else None

    @cached_property
    def compared(self) -> list[Compared]:
        """All changes, where there is something to explain."""
        return comparisons(self) if self.explainable > CLEAR_NATS else []

    def rivalled(self, finding: Finding, nats: float = CLEAR_NATS) -> Finding:
        """A finding of an advantage, with the change that explains nearly as much."""
        near = [(c.nats, c.finding.code) for c in self.compared if c.finding
                and c.finding.code != finding.code and c.nats > nats - CLEAR_NATS]  # fmt: skip
        return rivalled(finding, max(near, default=(0.0, ""))[1])

    @cached_property
    def away(self) -> tuple[float, list[tuple[int, int]], Follower]:
        """Whiles away from the path of the servo that explains the rest: nats, rows, servo."""
        fit, (nats, whiles) = self.fit, whiles_away(self, self.fit)
        servos = sorted(self.screen, key=_cost)[:_REFINED]
        for _ in range(2):
            if not whiles:
                return nats, whiles, fit
            inside = np.any([_within(self, *w) for w in whiles], axis=0)
            position = np.where(inside, self.position_rad - fit.residuals_rad, self.position_rad)
            rest = replace(self, position_rad=position)
            fit = min((fitted(rest, f) for f in (fit, *servos)), key=_cost)
            fit = replace(fit, residuals_rad=fit.residuals_rad + self.position_rad - position)
            nats, whiles = whiles_away(self, fit)
        # the bounded cost may have given them up for a little elsewhere
        wide = replace(self, bound=1.0)
        wides = (fitted(wide, f, rounds=20) for f in (self.fit, *servos))
        other = wide.hopped(min(wides, key=_cost))
        return min((nats, whiles, fit), (*whiles_away(self, other), other), key=lambda w: w[0])

    @property
    def changes(self) -> list[Finding]:
        """Its finding, with the runner-up that is nearly as good."""
        best = self.changed
        found = best.finding if best else None
        return [self.rivalled(found, max(best.nats, CLEAR_NATS))] if best and found else []

    @cached_property
    def _inputs(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64], float, float]]:
        """Mean command of each step and that at its end, the step and the start, of each trial.

        A rest as long as the longest lag comes first.
        """
        inputs = []
        for s in self.base.samples:
            every = max(1, int(_STEP_S / s.grid_s))
            command = s.command_rad[: len(s.command_rad) // every * every].reshape(-1, every)
            rest = np.full(_rest_steps(every * s.grid_s), s.rest_rad)
            inputs.append((
                np.concatenate([rest, command.mean(axis=1)]),
                np.concatenate([rest, command[:, -1]]), every * s.grid_s, s.start_s,
            ))  # fmt: skip
        return inputs

    def path(self, terms: NDArray) -> NDArray[np.float64]:
        """The command as a servo follows it, at each reading [rad of command]."""
        return self.paths(terms[None])[0]

    def paths(self, terms: NDArray) -> NDArray[np.float64]:
        """The same of several servos, shape (servos, readings), by the kernel of the fits."""
        paths, unlike = np.empty((len(terms), len(self.time_s))), np.ones(len(terms), bool)
        while unlike.any():  # servos abreast have one command, and are read at one time
            growth, low, high = terms[np.argmax(unlike), _GROWTH : _HIGH + 1]
            abreast = (terms[:, _GROWTH : _HIGH + 1] == (growth, low, high)).all(axis=1)
            unlike &= ~abreast
            servos, late = _columns(terms[abreast], self.reach), self.time_s - growth * self.later
            servos[:, _HANGING] = self.base.samples[0].rest_rad - np.pi / 2  # held level
            for (mean, end, step, start), a, b in zip(
                self._inputs, self.starts[:-1], self.starts[1:], strict=True
            ):
                mean, end = np.clip(mean, low, high), np.clip(end, low, high)
                paths[abreast, a:b] = kernel.residuals(
                    kernel.SERVO, servos, terms[abreast, _LAG] / step, mean[None],
                    kernel.edges_of(mean, end), 1.0, _NO_LOAD, mean[0], _rest_steps(step), step,
                    step=np.clip((late[a:b] - start) / step, 0.0, len(mean) - _rest_steps(step)),
                    reading=np.zeros(b - a),
                ) - servos[:, kernel.OFFSET, None]  # fmt: skip
        return np.clip(paths, terms[:, _BOTTOM, None], terms[:, _TOP, None])

    def path_of_trial(self, number: int) -> NDArray[np.float64]:
        """The same of the fit, at all readings of a trial."""
        sample = self.base.samples[number]
        base = replace(self.base, samples=(sample,))
        ends = np.array([0, len(sample.time_s)])
        time = sample.time_s
        later = time - self.start_s
        return replace(self, base=base, time_s=time, starts=ends, later=later).path(self.fit.terms)

    def follower(self, terms: NDArray, columns: Columns | None = None) -> Follower:
        """Regress the position on the path, what is added to it, and a constant per trial."""
        return self.regressed(terms, self.path(terms), columns)

    def followers(self, terms: NDArray, columns: Columns | None = None) -> list[Follower]:
        """Several servos, inside their bounds."""
        terms = np.clip(terms, _LOWEST, _HIGHEST)
        paths = self.paths(terms)
        return [self.regressed(t, p, columns) for t, p in zip(terms, paths, strict=True)]

    def regressed(self, terms: NDArray, path: NDArray, columns: Columns | None) -> Follower:
        """The same of a path that is known."""
        design = np.column_stack([path, *(columns(path) if columns else ())])
        floor = 0.01 * self.scale + 0.25 * self.step
        cost, values, rest = _regression(
            design, self.position_rad, self.starts, self.bound * self.scale, floor
        )
        cost = cost / self.scale + _CRUDE + 0.05 * self.step / self.scale
        return Follower(terms, path, cost, np.asarray(values, np.float64), rest)


Columns = Callable[[NDArray], Sequence[NDArray] | NDArray]
"""What a change adds to the path of a servo, from that path."""


@remembered(8)
def followed(trials: Sequence[Trial], step: float) -> Followed | None:
    """Readings of one joint, to be followed by the best servo; None where too little moves."""
    base = explain(trials, step)
    if base is None:
        return None
    causal = (base.lags_s >= -0.5 * base.grid_s) & (base.lags_s <= _LONGEST_LAG_S)
    servo = base.best(1.0, np.broadcast_to(causal, base.total_s.shape))
    every = -(-sum(len(s.time_s) for s in base.samples) // _MOST_READINGS)
    times = [s.time_s[::every] for s in base.samples]
    position = [s.position_rad[::every] for s in base.samples]
    away = np.concatenate([np.abs(p - np.median(p)) for p in position])
    reach = max(float(np.ptp(s.command_rad)) for s in base.samples)
    return Followed(
        tuple(trials), step, base, servo, float(trials[0].send_time_s[0]),
        max(float(away.mean()), 1e-9), reach, np.concatenate(times), np.concatenate(position),
        np.cumsum([0, *map(len, times)]), np.concatenate(times) - trials[0].send_time_s[0],
    )  # fmt: skip


def _drawn(reach: float) -> list[NDArray[np.float64]]:
    """Terms of servos with the lag last: ramped, weak, held by friction, and with none of these."""
    u = np.random.default_rng(0).random((_DRAWN, 10))
    low, high = np.array(_DRAWN_FROM).T
    terms = np.exp(np.log(low) + u[:, :9] * np.log(high / low))
    terms[:, [_FRICTION, _EFFORT]] *= reach
    kind = np.minimum((5 * u[:, 9]).astype(int), 3)
    terms[kind != 3, _SPEED : _RAMP + 1] = 300.0, 2e4  # two in five ramp
    terms[kind != 1, _EFFORT] = 20.0
    terms[kind == 2, _FRICTION] *= 10
    terms[u[:, 0] * 7 % 1 < 0.7, _INTEGRAL] = 0.01
    terms = np.insert(terms, _PLAY, _NO_PLAY, axis=1)
    return [terms[kind == k] for k in range(4)]


def _independent_share(values: NDArray[np.float64], some_apart: bool = False) -> float:
    """Share of values that are independent, by what their means over longer parts still vary.

    `some_apart`: a part of the values is not of the others' kind, and the median leaves it out.
    """

    def variance(x: NDArray) -> float:
        away = (x - np.median(x)) ** 2 if some_apart else (x - x.mean()) ** 2
        return float(np.median(away) / 0.455 if some_apart else away.mean()) + 1e-18

    count, spread, shares, m = len(values), variance(values), [1.0], 4
    if some_apart:
        spread = (float(np.median(values)) / np.log(2)) ** 2  # of exponential values
    while _FEWEST_PARTS * (4 if some_apart else 1) * m <= count:
        shares.append(spread / (m * variance(values[: count // m * m].reshape(-1, m).mean(axis=1))))
        m *= 2
    return min(shares)


def likely_spread(
    size: NDArray, usual: float, causes: Sequence[NDArray], rows: NDArray | slice = slice(None)
) -> NDArray[np.float64]:
    """Mean of exponential sizes as a sum of positive shares of 1 and `causes`, by some `rows`."""
    design = np.column_stack([np.ones_like(size), *causes])
    design = design / np.maximum(design[rows].mean(axis=0), 1e-12)
    spread = np.full_like(size, usual)
    for _ in range(3):
        weighted = design[rows] / spread[rows, None]
        spread = np.maximum(design @ nnls(weighted, size[rows] / spread[rows])[0], 0.3 * usual)
    return spread


def _rest_steps(step_s: float) -> int:
    return int(_HIGHEST[_LAG] / step_s) + 4


def _servos(numbers: NDArray) -> NDArray[np.float64]:
    """Terms of servos without levels from their limits and lags."""
    others = np.tile([0.0, 0.0, -_FAR, _FAR, -_FAR, _FAR], (len(numbers), 1))
    return np.column_stack([np.log(numbers[:, :-1]), numbers[:, -1], others])


def _columns(terms: NDArray, reach: float) -> NDArray[np.float64]:
    """Servos as the kernel has them, of an inertia of 1.

    Torque that a current loop holds until the voltage runs out has less damping within the limit
    than the back-EMF beyond: that of the loop is negative there.
    """
    limits = np.exp(terms[:, _LOGARITHMS].T)
    natural, damping, speed, ramp, friction, effort, share, integral, play = limits
    square, brakes = natural**2, 2 * damping * natural
    integral = np.maximum(integral - _NO_INTEGRAL, 0.0)
    load = reach * terms[:, _LOAD] / (1 + _LONG_S * integral)  # an integral holds it since long
    servos = np.tile(kernel.ABSENT, (len(terms), 1))
    for name, value in {
        "stiffness": square, "damping": brakes * (1 - share), "effort_limit": square * effort,
        "back_emf": brakes * share, "friction_loss": square * friction,
        "velocity_limit": np.where(terms[:, _SPEED] < _HIGHEST[_SPEED], speed, np.inf),
        "acceleration_limit": np.where(terms[:, _RAMP] < _HIGHEST[_RAMP], ramp, np.inf),
        "integral_per_s": integral,
        "backlash_rad": np.maximum(play - _NO_PLAY, 0.0), "gravity_nm": square * load,
        "offset_rad": np.clip(load, -effort, effort),  # it rests where its load lets it sag to
    }.items():  # fmt: skip
        servos[:, kernel.COLUMNS.index(name)] = value
    return servos


def steps_of(joint: Followed) -> NDArray[np.float64]:
    """Differences for derivatives."""
    return np.where(np.arange(len(_STEPS)) < _LOW, 1.0, joint.reach) * _STEPS


def _cost(fit: Follower) -> float:
    return fit.cost if fit.values[0] > 0 else np.inf


def fitted(
    joint: Followed, begin: Follower, columns: Columns | None = None,
    free: Sequence[int] = _ALONE, rounds: int = 12,
) -> Follower:  # fmt: skip
    """Fit the `free` terms of a servo by Levenberg-Marquardt, reweighted for the bounded cost."""
    best, damping = joint.follower(begin.terms, columns), 0.03
    free = [k for k in free if k < _LOW or abs(begin.terms[k]) < _FAR]  # levels that are set
    bound, floor = joint.bound * joint.scale, 0.01 * joint.scale + 0.25 * joint.step
    steps = steps_of(joint)
    terms_free = np.array(free)
    for _ in range(rounds):
        size = np.abs(best.residuals_rad)
        weight = (bound / (size + bound)) ** 2 / np.maximum(size, floor)
        step = np.where(best.terms + steps <= _HIGHEST, steps, -steps)[terms_free]
        moved = best.terms + np.eye(len(steps))[terms_free] * step[:, None]
        slopes = (joint.paths(moved) - best.path_rad) * (best.values[0] / step)[:, None]
        more = columns(best.path_rad) if columns else ()
        design = np.column_stack([*slopes, best.path_rad, *more])
        rest = best.residuals_rad.copy()
        for a, b in zip(joint.starts[:-1], joint.starts[1:], strict=True):
            share = weight[a:b] / weight[a:b].sum()
            design[a:b] -= share @ design[a:b]
            rest[a:b] -= share @ rest[a:b]
        gram = design.T @ (weight[:, None] * design)
        right = design.T @ (weight * rest)
        size, before = np.diag(gram) + 1e-9 * np.trace(gram) / len(gram) + 1e-12, best.cost
        held = np.full((len(_DAMPED), len(gram)), 1e-9)
        held[:, : len(free)] = damping * _DAMPED[:, None]
        ways = np.linalg.solve(gram + held[:, None] * np.diag(size), right[:, None])
        ways = np.clip(ways[:, : len(free), 0], -8 * steps[terms_free], 8 * steps[terms_free])
        terms = np.tile(best.terms, (len(ways), 1))
        terms[:, terms_free] += ways
        tried = joint.followers(terms, columns)
        at = int(np.argmin([_cost(f) for f in tried]))
        damping = float(np.clip(damping * _DAMPED[at], 1e-4, 1e4))
        best = tried[at] if _cost(tried[at]) < best.cost else best
        if best.cost > 0.999 * before:
            break
    return best


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
    """Servos to begin with; else the fit, and that of the screen that it makes best."""
    finding: Callable[[Follower], Finding | None]
    """What it is once it is fitted; None where it is too small to matter."""
    columns: Columns | None = None
    free: Sequence[int] = ()
    """Terms of the servo that it adds."""
    values: float = 1
    """How many numbers it adds."""
    joint: Followed | None = None
    """The readings with times of their own."""
    usual: Columns | None = None
    """What of a sound servo looks like it."""


@dataclass(frozen=True)
class Compared:
    """A change against the servo alone."""

    nats: float
    """Advantage of the change."""
    values: float
    """How many numbers it adds."""
    fit: Follower
    finding: Finding | None


def comparisons(joint: Followed) -> list[Compared]:
    """Every change, fitted."""
    # a load that is known sags and swings as its fit finds, and this servo does not
    loaded = any(t.load is not None for t in joint.trials)
    plain = joint.fit.cost

    def compared(tried: _Change, fit: Follower, usual: float = np.inf) -> Compared:
        more = (min(plain, usual) + joint.unsure) / (fit.cost + joint.unsure)
        nats = fit.independent * np.log(more) - 0.5 * tried.values * np.log(len(joint.time_s))
        return Compared(float(nats), tried.values, fit, tried.finding(fit))

    fits = []
    for change in (_lag_drifts, _lag_changes) if loaded else CHANGES:
        if tried := change(joint):
            part, free = tried.joint or joint, (*_ALONE, *tried.free)
            begins = tried.begins or (joint.fit, min(
                (joint.regressed(f.terms, f.path_rad, tried.columns) for f in joint.screen),
                key=_cost,
            ))  # fmt: skip
            fit, usual = min((fitted(part, b, tried.columns, free) for b in begins), key=_cost), []
            if compared(tried, fit).nats > 0:  # its servo may explain as much without the change
                alone = fit.terms.copy()
                alone[_GROWTH:] = joint.fit.terms[_GROWTH:]
                begins = joint.fit, joint.follower(alone)
                plain = min(plain, fitted(joint, begins[1], rounds=8).cost)
                usual = [fitted(joint, b, tried.usual).cost for b in begins] if tried.usual else []
            fits.append((tried, fit, min(usual, default=np.inf)))
    found = []
    for tried, fit, usual in fits:
        one = compared(tried, fit, usual)
        if one.finding and 0 < one.nats < CLEAR_NATS:  # as well as the servo alone is fitted
            fit = (tried.joint or joint).hopped(fit, tried.columns, (*_ALONE, *tried.free))
            one = compared(tried, fit, usual)
        found.append(one)
    return found


def _split(
    joint: Followed, columns: Callable[[int, int], Columns], ends: Callable[[int], int]
) -> tuple[int, int, Follower] | None:
    """First reading and end of the change that explains most, and the servo that it begins with.

    It lasts to the one that `ends` names. A servo that explains both parts alike has become another
    one: those of the screen are tried as well, and the moments are found again for the one that the
    change makes best.
    """
    edge = max(_EDGE_S, _EDGE_SHARE * float(np.ptp(joint.time_s)))
    low, high = joint.time_s[0] + edge, joint.time_s[-1] - edge
    # between trials several moments have one reading
    moments = np.unique(np.searchsorted(joint.time_s, np.linspace(low, high, _SPLITS))).tolist()
    windows = [(k, ends(k)) for k in moments if low < high and ends(k) - k > 2]
    if not windows:
        return None
    (first, end), begin, others = windows[0], joint.fit, joint.screen
    around = len(joint.time_s) * (high - low) / np.ptp(joint.time_s) / len(moments)
    for _ in range(2):
        tried = [
            (_cost(joint.regressed(f.terms, f.path_rad, columns(*w))), w)
            for f in (begin, *others) for w in windows
        ]  # fmt: skip
        (first, end), others = min(tried)[1], ()
        servos = [joint.regressed(f.terms, f.path_rad, columns(first, end)) for f in joint.screen]
        best = [begin, *sorted(servos, key=_cost)[:2]]
        begin = min((fitted(joint, f, columns(first, end), rounds=4) for f in best), key=_cost)
        near = (first + np.linspace(-around, around, 21).astype(int)).tolist()
        windows = [(k, end) for k in near if 2 < k < end - 2 and ends(k) == end] or [(first, end)]
    return first, end, begin


def _end(joint: Followed, at: int) -> int:
    """End of the trial of a reading."""
    return int(joint.starts[min(np.searchsorted(joint.starts, at, "right"), len(joint.starts) - 1)])


def _within(joint: Followed, first: int, end: int) -> NDArray[np.float64]:
    """1 for the readings from `first` up to `end`."""
    row = np.arange(len(joint.time_s))
    return ((row >= first) & (row < end)).astype(np.float64)


def _zero_moves(joint: Followed) -> _Change | None:
    """A zero that moves at a moment."""
    best = _split(joint, lambda a, b: lambda path: [_within(joint, a, b)], partial(_end, joint))
    if best is None:
        return None
    first, end, begin = best

    def finding(fit: Follower) -> Finding | None:
        moved = abs(float(fit.values[1]))
        values = {"offset_rad": moved, "time_s": float(joint.time_s[first]) - joint.start_s}
        return Finding("zero_moves", CARE, values) if _moves(joint, moved) else None

    return _Change([begin], finding, lambda path: [_within(joint, first, end)], values=2)


def _moves(joint: Followed, moved: float) -> bool:
    """Whether a zero moves by more than where friction and play let a joint rest."""
    return moved > max(_MOVED_SHARE * joint.reach, 2 * joint.friction_rad)


def _zero_drifts(joint: Followed) -> _Change | None:
    """A zero that moves steadily."""

    def finding(fit: Follower) -> Finding | None:
        moved = float(fit.values[1])
        values = {"offset_rad": moved}
        return Finding("zero_drifts", CARE, values) if _moves(joint, abs(moved)) else None

    return _Change((), finding, lambda path: [joint.share])


def _gain_changes(joint: Followed) -> _Change | None:
    """A gain that changes at a moment, about any place."""

    def columns(first: int, end: int) -> Columns:
        inside = _within(joint, first, end)
        return lambda path: [path * inside, inside]

    best = _split(joint, columns, lambda k: len(joint.time_s))
    if best is None:
        return None
    first, end, begin = best

    def finding(fit: Follower) -> Finding | None:
        before, more = map(float, fit.values[:2])
        return _other_gain(joint.time_s[[first, end - 1]] - joint.start_s, before, before + more)

    return _Change([begin], finding, columns(first, end), values=3)


def _other_gain(times: NDArray, before: float, after: float) -> Finding | None:
    """A gain of another size or sign from one time to another, or a joint that does not follow."""
    low, high = sorted((before, after))
    begin, end = map(float, times)
    values = {"time_s": begin, "until_s": end, "before": before, "after": after}
    if -high / _OTHER_GAIN < low < -_OTHER_GAIN * high:
        return Finding("sign_changed", REFUSE, values)
    if low > _NO_GAIN * high:
        return Finding("gain_changed", CARE, values) if low < _OTHER_GAIN * high else None
    begin, end = (begin, end) if after == low else (0.0, begin)
    return Finding("left_path", CARE, {"times": 1, "longest_s": end - begin, "time_s": begin})


def _gain_drifts(joint: Followed) -> _Change | None:
    """A gain that grows or shrinks steadily."""

    def finding(fit: Follower) -> Finding | None:
        change = float(fit.values[1] / max(fit.values[0], 1e-9))
        values = {"percent": 100 * change}
        return None if abs(change) < _GAIN_DRIFT else Finding("gain_drifts", CARE, values)

    return _Change((), finding, lambda path: [path * joint.share, joint.share], values=2)


def _lag_drifts(joint: Followed) -> _Change | None:
    """A lag that grows steadily: clocks that drift apart."""
    # a servo without a drift may have become another one for it
    servos = [joint.fit, *sorted(joint.screen, key=_cost)]
    middle = float(np.mean(joint.later))
    tried = []
    for growth, late, servo in product(_GROWTHS, (-0.04, 0.0, 0.04, None), servos):
        moved = servo.terms.copy()
        # about the middle, or from clocks that are together at the start
        moved[[_LAG, _GROWTH]] += 0.0 if late is None else late - growth * middle, growth
        tried.append(moved)

    def finding(fit: Follower) -> Finding | None:
        growth = float(fit.terms[_GROWTH])
        if abs(growth) * np.ptp(joint.time_s) < _LAG_DRIFT_S:
            return None
        lags = fit.terms[_LAG] + growth * joint.later
        verdict = REFUSE if lags.min() < -_EARLY_S else CARE  # early is what no servo is
        return Finding("lag_drifts", verdict, {"drift_ms": 1e3 * growth, "percent": 100 * growth})

    begins = sorted(joint.followers(np.array(tried)), key=_cost)[:2]
    return _Change(begins, finding, free=(_GROWTH,), usual=_shifted(joint))


def _lag_changes(joint: Followed) -> _Change | None:
    """A lag that changes at a moment."""
    edge = _EDGE_SHARE * float(np.ptp(joint.time_s))
    moments = np.linspace(joint.time_s[0] + edge, joint.time_s[-1] - edge, _WHILES)
    tried = []
    for moment in moments:
        later = replace(joint, later=(joint.time_s > moment) / _PER_GROWTH)
        for size in _LATER_S:
            moved = joint.fit.terms.copy()
            moved[[_LAG, _GROWTH]] += -size / 2, size * _PER_GROWTH
            tried.append((later.follower(np.clip(moved, _LOWEST, _HIGHEST)).cost, moment, moved))
    _, moment, moved = min(tried, key=lambda t: t[0])
    around = np.linspace(-1, 1, 9) * (moments[1] - moments[0])
    joints = [replace(joint, later=(joint.time_s > moment + d) / _PER_GROWTH) for d in around]
    later = min(joints, key=lambda j: j.follower(moved).cost)

    def finding(fit: Follower) -> Finding | None:
        more = float(fit.terms[_GROWTH]) / _PER_GROWTH
        if abs(more) < _LAG_DRIFT_S:
            return None
        at = float(joint.time_s[np.argmax(later.later > 0)]) - joint.start_s
        return Finding("lag_changed", CARE, {"more_ms": 1e3 * more, "time_s": at})

    return _Change([later.follower(moved)], finding, free=(_GROWTH,), values=2, joint=later,
                   usual=_shifted(joint))  # fmt: skip


def _shifted(joint: Followed) -> Columns:
    """What a constant shift in time adds, such as that of a position before its command."""
    return lambda path: joint.rates(path)[:1]


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
    servos = (joint.fit, *sorted(joint.screen, key=_cost)[:_SERVOS])
    for low_side, high_side in ((_LOW, _HIGH), (_BOTTOM, _TOP)):
        for sides in ([(low_side,), (high_side,)], [(low_side, high_side)]):
            tried = []
            for servo, terms, share in product(servos, sides, _LEVELS):
                moved = servo.terms.copy()
                moved[list(terms)] = [level(k, share) for k in terms]
                tried.append(moved)
            begins.append(min(joint.followers(np.array(tried)), key=_cost))

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
            deep = depth > max(_DEEP * np.ptp(path), 2 * joint.friction_rad)  # it rests within
            if deep and share > max(_BEYOND, best[0] if best else 0.0):
                best = share, float(np.median(joint.position_rad[beyond]))
        if best is None:
            return None
        return Finding("clipped", CARE, {"level_rad": best[1], "percent": 100 * best[0]})

    return _Change(begins, finding, free=range(_LOW, _TOP + 1), values=2)


def left_path(joint: Followed, fit: Follower, whiles: Sequence[tuple[int, int]]) -> Finding:
    """Whiles in which the joint is elsewhere: by another gain, at rest, or anywhere."""
    a, b = max(whiles, key=lambda w: joint.time_s[w[1] - 1] - joint.time_s[w[0]])
    longest = float(joint.time_s[b - 1] - joint.time_s[a])
    middle = joint.position_rad[a + (b - a) // 6 : b - (b - a) // 6]
    if np.ptp(middle) <= max(1.5 * joint.step, 0.02 * joint.scale):
        places = [np.median(joint.position_rad[a:b]) for a, b in whiles]
        values = {"trials": 1, "of": len(joint.trials)}
        if len(whiles) > 1 and np.ptp(places) < _MOVED_SHARE * joint.reach:  # in its way
            share = sum(b - a for a, b in whiles) / len(joint.time_s)
            return Finding("pinned", CARE, {**values, "percent": 100 * share})
        return Finding("frozen", CARE, {**values, "longest_s": longest})
    if found := _follows_there(joint, fit, whiles):
        return found
    values = {"times": len(whiles), "longest_s": longest,
              "time_s": float(joint.time_s[whiles[0][0]]) - joint.start_s}  # fmt: skip
    return Finding("left_path", CARE, values)


def _follows_there(
    joint: Followed, fit: Follower, whiles: Sequence[tuple[int, int]]
) -> Finding | None:
    """Another gain by which the joint follows its path in some whiles."""
    inside = np.any([_within(joint, *w) for w in whiles], axis=0)
    path, away = fit.path_rad[inside], fit.residuals_rad[inside]
    travel = sum(float(np.abs(np.diff(fit.path_rad[a:b])).sum()) for a, b in whiles)
    if travel < _STROKES * np.ptp(path):
        return None  # two numbers explain as many strokes
    design = np.column_stack([path, np.ones_like(path)])
    values = least_squares(design, away)
    left = np.quantile(np.abs(away - design @ values), 0.75)
    if left > _EXPLAINED_THERE * np.quantile(np.abs(away), 0.75):
        return None
    before = float(fit.values[0])
    times = joint.time_s[[whiles[0][0], whiles[-1][1] - 1]] - joint.start_s
    return _other_gain(times, before, before + float(values[0]))


def whiles_away(joint: Followed, fit: Follower) -> tuple[float, list[tuple[int, int]]]:
    """Whiles whose residuals are larger than those of the same motion elsewhere: nats, rows.

    Errors of a sound servo are of its noise, its speed and its force, its state before the first
    motion, its tone and what the fit is unsure of: their mean is a sum of positive shares of these,
    and they are exponential about it. In a while with a mean `times` as large, a reading of size x
    is likelier by x (1 - 1 / times) - log times. The share of independent readings is what the
    means of parts of the rest show. Whiles count that hold most of what the servo leaves, and are
    as far away as a zero that matters.
    """
    count, dt = len(joint.time_s), float(np.median(np.diff(joint.time_s)))
    width = max(3, 1 + 2 * round(min(fit.settles_s, 1.0) / max(dt, 1e-4)))
    shapes, rates, inner = [], joint.rates(fit.path_rad), np.ones(count, bool)
    for a, b in zip(joint.starts[:-1], joint.starts[1:], strict=True):
        ways = np.ptp(fit.path_rad[a:b]) / (np.max(np.abs(rates[0, a:b])) + 1e-9)
        inner[a:b] = joint.time_s[a:b] - joint.time_s[a] > fit.settles_s + ways
        away = np.abs(fit.path_rad[a:b] - fit.path_rad[a]) > 0.01 * joint.reach
        since = joint.time_s[a:b] - joint.time_s[a + np.argmax(away)]
        around = maximum_filter1d(np.abs(rates[:, a:b]), min(width, 2 * (b - a) - 1))
        shapes.append([*around, 1.0 * (np.abs(since) < _EDGE_S)])
    tones = np.searchsorted([t.send_time_s[0] for t in named_tones(joint.trials)], joint.time_s)
    causes = [*(1.0 * (tones == n) for n in np.unique(tones)[1:]), joint.unsure_rad]
    causes += list(np.concatenate(shapes, axis=1))
    size = np.abs(fit.residuals_rad) + joint.step / 4 + 1e-9
    edges = np.unique(np.linspace(0, count, _CELLS + 1).astype(int))
    cells, times, inside = np.diff(edges), _TIMES_LARGER, np.zeros(count, bool)
    scaled, gains, larger, share = size, np.zeros(len(cells)), np.zeros(len(cells), bool), 1.0
    for _ in range(_ROUNDS):
        usual = float(np.median(size[~inside]))
        scaled = np.minimum(size, 20 * usual)
        scaled = scaled / likely_spread(scaled, usual, causes, ~inside)
        share = _independent_share(scaled[~inside], True)
        mean = np.add.reduceat(scaled, edges[:-1]) / cells
        gains = share * cells * (mean * (1 - 1 / times) - np.log(times))
        gains[~np.logical_or.reduceat(inner, edges[:-1])] = 0.0  # in any motion, before a trial
        larger = _segments(gains, np.log(count))
        inside = np.repeat(larger, cells)
        if not larger.any() or inside.mean() > _MOST_LEFT:
            return 0.0, []
        times = max(float(scaled[inside].mean()), 2.0)
    small = size[inside].sum() < 0.5 * size.sum()  # of all that the servo leaves
    small |= size[inside].sum() < _UNSURE * joint.unsure_rad[inside].sum()
    if small or np.quantile(size[inside], 0.9) < max(_MOVED_RAD, _MOVED_SHARE * joint.reach):
        return 0.0, []
    nats = float(gains[larger].sum()) / share * min(share, _independent_share(scaled[~inside]))
    flips = np.flatnonzero(np.diff(np.concatenate([[0], larger, [0]])))
    whiles = [(int(edges[a]), int(edges[b])) for a, b in flips.reshape(-1, 2)]
    return nats - len(whiles) * float(np.log(count)), whiles


def _segments(gains: NDArray[np.float64], cost: float) -> NDArray[np.bool_]:
    """Segments of the largest sum of gains, each of which costs something."""
    outside, inside = 0.0, -np.inf
    came = np.zeros((len(gains), 2), bool)  # whether from inside, to outside and to inside
    for k, gain in enumerate(gains):
        came[k] = inside > outside, inside > outside - cost
        outside, inside = max(outside, inside), gain + max(inside, outside - cost)
    states, state = np.zeros(len(gains), bool), inside > outside
    for k in reversed(range(len(gains))):
        states[k] = state
        state = came[k, int(state)]
    return states


CHANGES: tuple[Callable[[Followed], _Change | None], ...] = (
    _zero_moves, _zero_drifts, _lag_drifts, _lag_changes, _gain_drifts, _gain_changes, _clipped,
)  # fmt: skip
