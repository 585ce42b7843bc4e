"""What happens within a recording to a servo that follows: hypotheses compared on one servo.

A linear servo (`explanations`) says what the pair of columns is. What a sound servo does beyond it,
a set-point that ramps, a motor that saturates, friction, a load, looks like a fault to whatever
compares its readings with a straight line. `Followed.fit` is a second-order servo with these
limits, by Levenberg-Marquardt at a bounded cost: what happens in a part of a recording does not
bend the whole.

`comparisons` fits it again with one number of it that changes, a zero, a gain, a torque or a
lag, steadily, from a moment on or for a while, or with levels at which it ends. One rule judges
all of them, the difference of log-likelihoods (n log of the ratio of mean errors, n independent
residuals of the best fit) less half the logarithm of the readings for each number that the change
adds (Schwarz, 1978).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise, product

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pupper_sysid.servo_models import kernel
from pupper_sysid.sysid.doctor.explanations import FILTERS, Explanation, Servo, explain
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, Finding, rivalled
from pupper_sysid.sysid.recordings.excitation import remembered
from pupper_sysid.sysid.recordings.recording import Trial

_MOST_READINGS, _STEP_S = 1500, 0.005
_UNFILTERED_HZ = 15.0  # natural frequency of a servo that no low-pass explains better
_LONGEST_LAG_S = 0.5

(_NATURAL, _DAMPING, _SPEED, _RAMP, _FRICTION, _EFFORT, _BACK_EMF, _INTEGRAL, _PLAY,
 _LAG, _LOAD, _GROWTH, _FADE, _LOW, _HIGH, _BOTTOM, _TOP) = range(17)  # fmt: skip
_LOGARITHMS = slice(0, 9)
_HANGING = kernel.COLUMNS.index("hanging_rad")
_FAR = 1e6  # levels that nothing reaches [rad]
_DAMPED = np.array([0.2, 1.0, 5.0, 25.0, 125.0])  # times the damping before, tried abreast
_NO_LOAD, _SMALL_STEP = np.zeros(3), 0.2  # of the differences for derivatives
_NO_INTEGRAL, _NO_PLAY, _LONG_S = 0.01, 1e-3, 20.0  # [1/s], [rad], and before the recording
_EARLY_S = 0.02  # that stamps may be early
_LOWEST = np.array([
    *np.log([2, 0.2, 0.05, 0.5, 1e-6, 0.002, 0.01, 1e-3, 1e-4]), -_EARLY_S, -0.3, -0.3,
    np.log(0.1), *[-_FAR] * 4,
])  # fmt: skip
_HIGHEST = np.array([*np.log([250, 4, 300, 2e4, 3, 20, 30, 30, 0.3]), 0.8, 0.3, 0.3, np.log(10.0),
                    *[_FAR] * 4])  # fmt: skip
_STEPS = np.array([0.03, 0.05, 0.1, 0.1, 0.15, 0.08, 0.2, 0.2, 0.3, 2e-3, 0.01, 2e-3, 0.05,
                   *[0.01] * 4])  # fmt: skip
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
_CRUDE = 0.004  # of the position's mean deviation
EXPLAINED = 0.06
"""Of the position's mean deviation: a servo that leaves less explains nearly all."""
_FOLLOWS, _LITTLE = 0.12, 0.3  # of the same; of a friction
CLEAR_NATS = 15.0
"""Advantage of a fault over a servo without it, beyond what its numbers cost."""
_SPLITS = 24
_FEWEST_PARTS = 8
_OF_TRAVEL = 2 * 4.0
"""Independent readings of one motion over the range: a servo settles within four of its time
constants, and does so twice, when it starts and when it stops."""
_EDGE_SHARE = 0.125  # of the readings, from either end: an integral settles at the beginning
_NO_GAIN, _FEW_READINGS = 0.1, 2
_STAYS_S, _MOST_STAYS = 0.3, 0.45  # of the readings
_ELSEWHERE = 0.2  # of the variance, that a servo leaves
_MATTERS = 0.1  # of the mean deviation: a smaller change hardly alters what is measured
_GROWS: dict[str, tuple[int, tuple[float, ...]]] = {
    "lag": (_GROWTH, (-0.06, -0.02, 0.02, 0.06)),
    "torque": (_FADE, (-0.6, -0.3, 0.3)),
}
"""Terms by which a servo becomes another one, and what is tried [s; logarithm]."""
_OF_TORQUE = np.array([0.5, -0.5, -1.0])
"""Logarithms of natural frequency, damping ratio and friction in units of the command, as that of
the torque grows: damping and friction stay."""
_SERVOS, _LEVELS = 4, np.linspace(0.15, 0.95, 9)  # of the command's range


@dataclass(frozen=True)
class Follower:
    """A servo with limits, fitted."""

    terms: NDArray[np.float64]
    """Logarithms of natural frequency [rad/s], damping ratio, speed [rad/s] and acceleration
    [rad/s²] of the set-point, friction and effort limit [rad of command], damping beyond the
    effort limit over that within, integral gain [1/s], play [rad]; lag [s], load [of the
    command's range] and growth of the lag [s]; logarithm by which its torque grows; lowest and
    highest goal and place [rad of command]."""
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

    def unexplained(self, joint: Followed) -> float:
        """Share of the variance of the readings."""
        parts = np.split(joint.position_rad, joint.starts[1:-1])
        about = np.concatenate([p - p.mean() for p in parts])
        residuals = self.residuals_rad - self.residuals_rad.mean()
        return float(np.mean(residuals**2) / max(np.mean(about**2), 1e-18))


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
    """What the growth of the lag and of the torque goes with, from 0 to 1."""
    bound: float = 0.25
    """Largest cost of an error, of the position's mean deviation."""

    @property
    def explained(self) -> bool:
        """Whether a servo with limits explains nearly all that limits let a fit explain.

        Doubt about limits excuses a part of the motion, not most of it.
        """
        return self.fit.cost - self.unsure < EXPLAINED and self.unexplained < 0.5

    @property
    def unexplained(self) -> float:
        """Share of the variance of all readings that it leaves."""
        return self.fit.unexplained(self)

    @cached_property
    def screen(self) -> list[Follower]:
        """The linear servo, and the best of many drawn from what servos are."""
        hz, damping = FILTERS[self.servo.filter]
        natural, lag = 2 * np.pi * (hz or _UNFILTERED_HZ), self.servo.lag_s
        linear = [natural, damping, 300.0, 2e4, 0.004 * self.reach, 20.0, 1.0, 0.01, 1e-3, lag]
        servos = []
        for kind in (np.array([linear]), *_drawn(self.reach)):
            servos += sorted(self.followers(_servos(kind)), key=_cost)[:_OF_A_KIND]
        return servos

    @cached_property
    def fit(self) -> Follower:
        """The servo that explains most readings: the best of the screen, refined."""
        return self.hopped(fitted(self, self.screen, (4, 20)))

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
            time = np.maximum(np.diff(self.time_s), 1e-4)
            rate = np.diff(fit.path_rad) / time
            # nearly the fastest, of few rows between trials
            speed, ramp = (
                float(np.quantile(np.abs(x), 0.99)) + 1e-9 for x in (rate, np.diff(rate) / time[1:])
            )
            seen = 0.5 * ramp * float(np.exp(-2 * fit.terms[_NATURAL]))
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
            better = fitted(self, self.followers(terms, columns), (2, 3), columns, free)
            if better.cost > 0.97 * fit.cost:
                break
            fit = fitted(self, [better], (15,), columns, free)
        return fit

    @cached_property
    def unsure(self) -> float:
        """Cost of the error that a servo as good as the fit may have.

        Where a small change of a limit ends in another motion, such as that of a profile far above
        its acceleration, no fit comes nearer. There, paths are not straight in their terms: the
        second differences of the fit's.
        """
        step = _SMALL_STEP * steps_of(self)
        inside = (self.fit.terms - step > _LOWEST) & (self.fit.terms + step < _HIGHEST)
        changes = (np.eye(len(step)) * step)[[k for k in _ALONE if inside[k]]]
        paths = self.paths(np.concatenate([self.fit.terms + changes, self.fit.terms - changes]))
        bends = paths.reshape(2, len(changes), -1).sum(axis=0) - 2 * self.fit.path_rad
        return self.cost_of(self.fit.values[0] * np.sqrt(np.sum(bends**2, axis=0)))

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

    @cached_property
    def stays(self) -> list[tuple[int, int]]:
        """First reading and end of each time that it stays where it is while its path goes on."""
        usual = float(np.median(np.abs(np.diff(self.fit.residuals_rad))))
        alike = max(1.5 * self.step, 0.02 * self.scale) + 3 * usual
        stays = []
        for first, end in pairwise(self.starts.tolist()):
            a = first
            while a < end:
                away = np.abs(self.position_rad[a:end] - self.position_rad[a]) > alike
                b = a + int(np.argmax(away)) if away.any() else end
                path = self.fit.path_rad[a:b]
                if self.time_s[b - 1] - self.time_s[a] > _STAYS_S and np.ptp(path) > self.scale:
                    stays.append((a, b))
                    a = b
                a += 1
        return stays

    @cached_property
    def stays_often(self) -> Finding | None:
        """That it stays where it is several times, and is a servo otherwise.

        What stays most of the time moves by itself.
        """
        share = sum(b - a for a, b in self.stays) / len(self.time_s)
        if len(self.stays) < 2 or share > _MOST_STAYS:
            return None
        if _STAYS.fitted(self, lambda *_: False)[1].unexplained(self) > _ELSEWHERE:
            return None
        time = self.time_s - self.start_s
        lasts = max(float(time[b - 1] - time[a]) for a, b in self.stays)
        values = {"times": len(self.stays), "longest_s": lasts,
                  "time_s": float(time[self.stays[0][0]])}  # fmt: skip
        return Finding("left_path", CARE, values)

    @cached_property
    def friction_rad(self) -> float:
        """Error of the command that friction and play hold; 0 where a servo needs none."""
        if self.fit.cost > _FOLLOWS:
            return 0.0
        terms = self.fit.terms.copy()
        terms[[_FRICTION, _PLAY]] += np.log(_LITTLE)
        free = [k for k in _ALONE if k not in (_FRICTION, _PLAY)]
        without = fitted(self, [self.follower(terms)], free=free)
        nats = self.fit.independent * np.log(without.cost / self.fit.cost)
        friction, play = np.exp(self.fit.terms[[_FRICTION, _PLAY]])
        return float(friction + play / 2) if nats > CLEAR_NATS else 0.0

    @cached_property
    def compared(self) -> list[Compared]:
        """All changes that matter, the likeliest first, where there is something to explain."""
        every = comparisons(self) if self.explainable > CLEAR_NATS else []
        matter = [c for c in every if c.moved > _MATTERS]
        return sorted(matter, key=lambda c: -c.nats)

    @property
    def changed(self) -> Compared | None:
        """The likeliest change, if it clearly explains more than the servo alone."""
        return next((c for c in self.compared if c.nats > CLEAR_NATS), None)

    def rivalled(self, finding: Finding, nats: float = CLEAR_NATS) -> Finding:
        """A finding of an advantage, with the likeliest other change that is nearly as good."""
        near = (c.finding.code for c in self.compared if c.nats > nats - CLEAR_NATS)
        return rivalled(finding, next((code for code in near if code != finding.code), ""))

    @property
    def changes(self) -> list[Finding]:
        """Its finding, with the runner-up that is nearly as good."""
        best = self.changed
        return [self.rivalled(best.finding, best.nats)] if best else []

    @cached_property
    def _inputs(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64], float, float]]:
        """Commands of each trial, as nearly all servos take them: see `_clamped`."""
        return self._clamped(-_FAR, _FAR)

    def _clamped(
        self, low: float, high: float
    ) -> list[tuple[NDArray[np.float64], NDArray[np.float64], float, float]]:
        """Mean command of each step and its edges, the step and the start, of each trial.

        A rest as long as the longest lag comes first.
        """
        inputs = []
        for s in self.base.samples:
            every = max(1, int(_STEP_S / s.grid_s))
            command = s.command_rad[: len(s.command_rad) // every * every].reshape(-1, every)
            step = every * s.grid_s
            rest = np.full(_rest_steps(step), s.rest_rad)
            after = np.full(int(_EARLY_S / step) + 1, command[-1, -1])
            mean, end = (
                np.clip(np.concatenate([rest, x, after]), low, high)
                for x in (command.mean(axis=1), command[:, -1])
            )
            inputs.append((mean, kernel.edges_of(mean, end), step, s.start_s))
        return inputs

    def path(self, terms: NDArray) -> NDArray[np.float64]:
        """The command as a servo follows it, at each reading [rad of command]."""
        return self.paths(terms[None])[0]

    def paths(self, terms: NDArray) -> NDArray[np.float64]:
        """The same of several servos, shape (servos, readings).

        One whose torque changes turns into another one, far more slowly than it moves.
        """
        fades = terms[:, _FADE] != 0
        if not fades.any():
            return self._steady(terms)
        fade = terms[fades, _FADE, None]
        faded = terms[fades]
        faded[:, [_NATURAL, _DAMPING, _FRICTION]] += fade * _OF_TORQUE
        faded[:, _LOAD] *= np.exp(-fade[:, 0])
        paths, ends = np.split(self._steady(np.concatenate([terms, faded])), [len(terms)])
        paths[fades] += self.later * (ends - paths[fades])
        return paths

    def _steady(self, terms: NDArray) -> NDArray[np.float64]:
        """The same of servos that stay what they are, by the kernel of the fits."""
        paths, unlike = np.empty((len(terms), len(self.time_s))), np.ones(len(terms), bool)
        while unlike.any():  # servos abreast have one command
            low, high = terms[np.argmax(unlike), _LOW : _HIGH + 1]
            abreast = (terms[:, _LOW : _HIGH + 1] == (low, high)).all(axis=1)
            unlike &= ~abreast
            servos = _columns(terms[abreast], self.reach)
            late = self.time_s + _EARLY_S - terms[abreast, _GROWTH, None] * self.later
            servos[:, _HANGING] = self.base.samples[0].rest_rad - np.pi / 2  # held level
            free = (low, high) == (-_FAR, _FAR)
            inputs = self._inputs if free else self._clamped(low, high)
            for (mean, edges, step, start), a, b in zip(
                inputs, self.starts[:-1], self.starts[1:], strict=True
            ):
                track = kernel.positions(
                    kernel.SERVO, servos, (terms[abreast, _LAG] + _EARLY_S) / step, mean[None],
                    edges, 1.0, _NO_LOAD, mean[0], _rest_steps(step), step,
                ) - servos[:, kernel.OFFSET]  # fmt: skip
                paths[abreast, a:b] = _read(track, (late[:, a:b] - start) / step)
        return np.clip(paths, terms[:, _BOTTOM, None], terms[:, _TOP, None])

    def path_of_trial(self, number: int) -> NDArray[np.float64]:
        """The same of the fit, at all readings of a trial."""
        sample = self.base.samples[number]
        base = replace(self.base, samples=(sample,))
        ends = np.array([0, len(sample.time_s)])
        time = sample.time_s
        part = replace(self, base=base, time_s=time, starts=ends, later=np.zeros(len(time)))
        return part.path(self.fit.terms)

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
        design = np.stack([path, *(columns(path) if columns else ())])
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
    servo = base.best(1.0, base.causal(_LONGEST_LAG_S))
    every = -(-sum(len(s.time_s) for s in base.samples) // _MOST_READINGS)
    times = [s.time_s[::every] for s in base.samples]
    position = [s.position_rad[::every] for s in base.samples]
    away = np.concatenate([np.abs(p - np.median(p)) for p in position])
    reach = max(float(np.ptp(s.command_rad)) for s in base.samples)
    return Followed(
        tuple(trials), step, base, servo, float(trials[0].send_time_s[0]),
        max(float(away.mean()), 1e-9), reach, np.concatenate(times), np.concatenate(position),
        np.cumsum([0, *map(len, times)]), np.zeros(sum(map(len, times))),
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


def _independent_share(values: NDArray[np.float64]) -> float:
    """Share of values that are independent, by what their means over longer parts still vary."""
    count, spread, shares, m = len(values), float(np.var(values)) + 1e-18, [1.0], 4
    while _FEWEST_PARTS * m <= count:
        means = values[: count // m * m].reshape(-1, m).mean(axis=1)
        shares.append(spread / (m * (float(np.var(means)) + 1e-18)))
        m *= 2
    return min(shares)


def _rest_steps(step_s: float) -> int:
    return int((_HIGHEST[_LAG] + _EARLY_S) / step_s) + 4


def _servos(numbers: NDArray) -> NDArray[np.float64]:
    """Terms of servos without levels from their limits and lags."""
    others = np.tile([0.0, 0.0, 0.0, -_FAR, _FAR, -_FAR, _FAR], (len(numbers), 1))
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
    joint: Followed, begins: Sequence[Follower], rounds: Sequence[int] = (12,),
    columns: Columns | None = None, free: Sequence[int] = _ALONE,
) -> Follower:  # fmt: skip
    """The best of several servos whose `free` terms are fitted: the few best of a stage go on."""
    best = joint.followers(np.array([f.terms for f in begins]), columns)
    for stage, count in enumerate(rounds):
        best = sorted(best, key=_cost)[:_REFINED] if stage else best
        best = _fitted_abreast(joint, best, count, columns, free)
    return min(best, key=_cost)


def _fitted_abreast(
    joint: Followed, begins: Sequence[Follower], rounds: int, columns: Columns | None,
    terms_free: Sequence[int],
) -> list[Follower]:  # fmt: skip
    """Servos by Levenberg-Marquardt, reweighted for the bounded cost."""
    best, dampings, moving = list(begins), [0.03] * len(begins), list(range(len(begins)))
    bound, floor = joint.bound * joint.scale, 0.01 * joint.scale + 0.25 * joint.step
    steps, several = steps_of(joint), len(_DAMPED)
    for _ in range(rounds):
        frees = [[k for k in terms_free if _acts(best[n].terms, k)] for n in moving]
        signs = [np.where(best[n].terms + steps <= _HIGHEST, steps, -steps) for n in moving]
        moved = [
            best[n].terms + np.diag(s)[f] for n, s, f in zip(moving, signs, frees, strict=True)
        ]
        paths = np.split(
            joint.paths(np.concatenate(moved)), np.cumsum([len(m) for m in moved])[:-1]
        )
        terms = []
        for n, path, free, step in zip(moving, paths, frees, signs, strict=True):
            size = np.abs(best[n].residuals_rad)
            weight = (bound / (size + bound)) ** 2 / np.maximum(size, floor)
            slopes = (path - best[n].path_rad) * (best[n].values[0] / step[free])[:, None]
            more = columns(best[n].path_rad) if columns else ()
            design = np.stack([*slopes, best[n].path_rad, *more, best[n].residuals_rad])
            for a, b in zip(joint.starts[:-1], joint.starts[1:], strict=True):
                design[:, a:b] -= (design[:, a:b] @ weight[a:b] / weight[a:b].sum())[:, None]
            gram = (design * weight) @ design.T
            gram, right = gram[:-1, :-1], gram[:-1, -1]
            size = np.diag(gram) + 1e-9 * np.trace(gram) / len(gram) + 1e-12
            held = np.full((several, len(gram)), 1e-9)
            held[:, : len(free)] = dampings[n] * _DAMPED[:, None]
            ways = np.linalg.solve(gram + held[:, None] * np.diag(size), right[:, None])
            each = np.tile(best[n].terms, (several, 1))
            each[:, free] += np.clip(ways[:, : len(free), 0], -8 * steps[free], 8 * steps[free])
            terms.append(each)
        tried, goes_on = joint.followers(np.concatenate(terms), columns), []
        for place, n in enumerate(moving):
            ways = tried[several * place : several * (place + 1)]
            at, before = int(np.argmin([_cost(f) for f in ways])), best[n].cost
            dampings[n] = float(np.clip(dampings[n] * _DAMPED[at], 1e-4, 1e4))
            best[n] = min(best[n], ways[at], key=_cost)
            goes_on += [n] if best[n].cost <= 0.999 * before else []
        if not (moving := goes_on):
            break
    return best


def _acts(terms: NDArray, number: int) -> bool:
    """Whether a term is one that the servo has: no speed, ramp or level that nothing reaches."""
    if number in (_SPEED, _RAMP):
        return bool(terms[number] < _HIGHEST[number])
    return number < _LOW or abs(terms[number]) < _FAR


@njit(cache=True, error_model="numpy")
def _read(track, moments):
    """Positions of each servo (steps, servos) at its moments (servos, readings) [steps].

    On the parabola of the accelerations before and after a step.
    """
    steps = len(track) - 1
    out = np.empty(moments.shape)
    for i in range(len(moments)):
        for n in range(moments.shape[1]):
            moment = min(max(moments[i, n], 0.0), float(steps))
            row = min(int(moment), steps - 1)
            part = moment - row
            bent = 0.25 * part * (1.0 - part)
            before, after = track[max(row - 1, 0), i], track[min(row + 2, steps), i]
            near = (1.0 - part + bent) * track[row, i] + (part + bent) * track[row + 1, i]
            out[i, n] = near - bent * (before + after)
    return out


@njit(cache=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _regression(design, position, starts, bound, floor):
    """Mean cost, values and residuals of a regression whose errors cost no more than `bound`."""
    # sums in loops: without arrays in between they take half the time
    last, count = design.shape
    x, gram = np.empty((last + 1, count)), np.empty((last + 1, last + 1))
    weight, values, rest = np.ones(count), np.empty(last), np.empty(count)
    cost = 0.0
    for _ in range(6):
        for trial in range(len(starts) - 1):
            a, b = starts[trial], starts[trial + 1]
            total = 0.0
            for k in range(a, b):
                total += weight[k]
            for c in range(last + 1):
                row = design[c] if c < last else position
                mean = 0.0
                for k in range(a, b):
                    mean += weight[k] * row[k]
                for k in range(a, b):
                    x[c, k] = row[k] - mean / total
        for c in range(last + 1):
            for d in range(min(c + 1, last)):
                gram[c, d] = 0.0
                for k in range(count):
                    gram[c, d] += weight[k] * x[c, k] * x[d, k]
                gram[d, c] = gram[c, d]
        for c in range(last):
            gram[c, c] += 1e-12 + 1e-9 * gram[c, c]
        # elimination by hand: to compile LAPACK's solver takes ten seconds
        for c in range(last):
            for d in range(c + 1, last):
                share = gram[d, c] / gram[c, c]
                for e in range(c, last):
                    gram[d, e] -= share * gram[c, e]
                gram[last, d] -= share * gram[last, c]
        for c in range(last - 1, -1, -1):
            values[c] = gram[last, c]
            for d in range(c + 1, last):
                values[c] -= gram[c, d] * values[d]
            values[c] /= gram[c, c]
        for k in range(count):
            rest[k] = x[last, k]
        for c in range(last):
            for k in range(count):
                rest[k] -= values[c] * x[c, k]
        cost = 0.0
        for k in range(count):
            size = abs(rest[k])
            cost += bound * size / (size + bound)
            weight[k] = (bound / (size + bound)) ** 2 / max(size, floor)
    return cost / count, values, rest


# ----- hypotheses
Span = tuple[int, int] | None
"""First reading and end of a change; None where it goes steadily through the recording."""


@dataclass(frozen=True)
class Compared:
    """A change against the servo alone."""

    fit: Follower
    nats: float
    """Advantage over the servo alone, less what its numbers cost."""
    moved: float
    """Mean of what it adds to the readings, over their mean deviation."""
    finding: Finding


@dataclass(frozen=True)
class _Change:
    """How a number of the servo changes."""

    number: str
    """Which: its zero, gain, lag or torque, or the levels at which it ends."""
    moments: int
    """0 where it changes steadily, 1 from a moment on, 2 for a while."""

    def values(self, joint: Followed) -> int:
        """How many numbers that takes: another gain is one about any place."""
        return self.moments + (1 if self.number in ("zero", *_GROWS) else 2)

    def spans(self, joint: Followed) -> list[Span]:
        """Where it may change."""
        edges, count = _edges(joint), len(joint.time_s)
        whiles = combinations(edges[::2], 2)
        several: list[list[Span]] = [[None], [(k, count) for k in edges], [*whiles]]
        return several[self.moments]

    def columns(self, joint: Followed, span: Span) -> Columns:
        """What it adds to the path of the servo."""
        profile = _profile(joint, span)
        if self.number == "gain":
            return lambda path: [path * profile, profile]  # about any place
        return lambda path: [profile] if self.number == "zero" else ()

    def begins(self, joint: Followed, servos: Sequence[Follower], span: Span) -> list[Follower]:
        """Servos with the change, before they are fitted."""
        if self.number not in _GROWS:
            columns = self.columns(joint, span)
            return [joint.regressed(s.terms, s.path_rad, columns) for s in servos]
        profile, tried = _profile(joint, span), []
        term, grown = _GROWS[self.number]
        for later, servo in product(grown, servos):
            terms = servo.terms.copy()
            before = -later * float(profile.mean())
            if self.number == "lag":
                terms[_LAG] += before
            else:
                terms[[_NATURAL, _DAMPING, _FRICTION]] += before * _OF_TORQUE
            terms[term] += later
            tried.append(terms)
        return replace(joint, later=profile).followers(np.array(tried))

    def screened(self, joint: Followed) -> tuple[Span, list[Follower]]:
        """The span that explains most, and servos with the change, the best first.

        A servo that explains both parts alike has become another one: some of the screen are tried
        as well.
        """
        servos = (joint.fit, *sorted(joint.screen, key=_cost)[:_SERVOS])
        tried = [(s, f) for s in self.spans(joint) for f in self.begins(joint, servos, s)]
        span = min(tried, key=lambda t: _cost(t[1]))[0]
        return span, sorted((f for s, f in tried if s == span), key=_cost)[:_REFINED]

    def fitted(
        self, joint: Followed, worth: Callable[[_Change, Follower], bool]
    ) -> tuple[Span, Follower]:
        """The servo with the change, and where it is `worth` it the span found again for it."""
        span, begins = self.screened(joint)
        best = self.refined(joint, begins, span, (3, 3))
        width = float(max(self.moments, 1))  # edges that were tried lie so far apart
        stages = ((width, 4), (width / 7, 8), (width / 49, 4))
        for width, rounds in stages if worth(self, best) else ():
            near, servos = _near(joint, span, width), (best, begins[0])
            tried = [(s, f) for s in near for f in self.begins(joint, servos, s)]
            span, best = min([(span, best), *tried], key=lambda t: _cost(t[1]))
            best = self.refined(joint, [best], span, (rounds,))
        return span, best

    def refined(
        self, joint: Followed, begins: Sequence[Follower], span: Span, rounds: Sequence[int]
    ) -> Follower:
        """The best servo with the change, fitted."""
        free = (*_ALONE, *range(_LOW, _TOP + 1))
        if self.number in _GROWS:
            joint = replace(joint, later=_profile(joint, span))
            free = (*_ALONE, _GROWS[self.number][0])
        return fitted(joint, begins, rounds, self.columns(joint, span), free)


def _profile(joint: Followed, span: Span) -> NDArray[np.float64]:
    """From 0 to 1: share of the readings before, or whether a reading is within."""
    row = np.arange(len(joint.time_s))
    if span is None:
        return row / len(row)
    return ((row >= span[0]) & (row < span[1])).astype(np.float64)


def _edges(joint: Followed) -> list[int]:
    """Readings at which a change may begin or end: at either end a servo settles."""
    count = len(joint.time_s)
    rows = np.linspace(_EDGE_SHARE * count, (1 - _EDGE_SHARE) * count, _SPLITS)
    return np.unique(rows.astype(int)).tolist()


def _near(joint: Followed, span: Span, width: float) -> list[Span]:
    """Spans whose ends lie within a part of the distance of those that were tried first."""
    if span is None:
        return [None]
    edges, count = _edges(joint), len(joint.time_s)
    around = width * np.linspace(-1, 1, 15) * max(np.diff(edges), default=1)
    firsts, ends = ((row + around).astype(int).tolist() for row in span)
    ends = ends if span[1] < count else [count]
    spans = [(a, b) for a, b in product(firsts, ends) if 2 < a < b - 2 <= count - 2]
    return [*spans] or [span]


class _Levels(_Change):
    """A goal that is clamped, or a motion that ends at a stop, above, below or both."""

    def screened(self, joint: Followed) -> tuple[Span, list[Follower]]:
        """Servos with the levels of each side that explain most."""
        command = np.concatenate([s.command_rad for s in joint.base.samples])
        low, high = float(command.min()), float(command.max())
        servos = (joint.fit, *sorted(joint.screen, key=_cost)[:_SERVOS])
        begins = []
        for sides in ((_LOW,), (_HIGH,), (_LOW, _HIGH), (_BOTTOM,), (_TOP,), (_BOTTOM, _TOP)):
            tried = []
            for servo, share in product(servos, _LEVELS):
                terms = servo.terms.copy()
                depth = share * (high - low)
                terms[[*sides]] = [low + depth if k in (_HIGH, _TOP) else high - depth
                                   for k in sides]  # fmt: skip
                tried.append(terms)
            begins.append(min(joint.followers(np.array(tried)), key=_cost))
        return None, sorted(begins, key=_cost)[:_REFINED]


class _Stays(_Change):
    """A joint that stays where it is for a while, several times, and its command goes on."""

    def values(self, joint: Followed) -> int:
        """A place for each time, and that it does not follow; its readings tell begin and end."""
        return 2 * len(joint.stays)

    def columns(self, joint: Followed, span: Span) -> Columns:
        """What each adds to the path of the servo."""
        inside = [_profile(joint, stay) for stay in joint.stays]
        return lambda path: [column for here in inside for column in (path * here, here)]

    def fitted(
        self, joint: Followed, worth: Callable[[_Change, Follower], bool]
    ) -> tuple[Span, Follower]:
        """The servo of the other times."""
        servos = (joint.fit, *sorted(joint.screen, key=_cost)[:_SERVOS])
        return None, fitted(joint, servos, (3, 8), self.columns(joint, None))


_STAYS = _Stays("stays", 0)
CHANGES = (
    *(_Change(number, moments) for number in ("zero", "gain", "torque", "lag")
      for moments in (0, 1)),
    _Change("gain", 2), _Levels("levels", 0), _STAYS,
)  # fmt: skip
"""What may change, and how: a new one is a row here and its words in `_finding`."""


def comparisons(joint: Followed) -> list[Compared]:
    """Every change, fitted.

    A load that is known sags and swings as its fit finds, and this servo does not: of such a joint
    the lag alone is compared.
    """
    loaded = any(t.load is not None for t in joint.trials)
    changes = [c for c in CHANGES if c.number == "lag" or not loaded]
    changes = [c for c in changes if c.number != "stays" or joint.stays_often]

    def nats(change: _Change, plain: float, fit: Follower, count: float) -> float:
        more = (plain + joint.unsure) / (fit.cost + joint.unsure)
        return count * float(np.log(more)) - 0.5 * change.values(joint) * np.log(len(joint.time_s))

    plain = joint.fit.cost

    def worth(change: _Change, fit: Follower) -> bool:
        return nats(change, plain, fit, joint.fit.readings) > 0  # if all were independent

    fits = [(change, *change.fitted(joint, worth)) for change in changes]
    alone = np.array([f.terms for f in sorted((f for *_, f in fits), key=_cost)[:_REFINED]])
    alone[:, _GROWTH:] = joint.fit.terms[_GROWTH:]  # its servo may explain as much by itself
    plain = min(plain, fitted(joint, joint.followers(alone)).cost)
    # the residuals of the best tell how many readings are independent
    count = min((joint.fit, *(fit for *_, fit in fits)), key=_cost).independent
    compared = []
    for change, span, fit in fits:
        without = fit.terms.copy()
        without[_GROWTH:] = joint.fit.terms[_GROWTH:]
        added = joint.position_rad - fit.residuals_rad - fit.values[0] * joint.path(without)
        moved = np.concatenate([x - x.mean() for x in np.split(added, joint.starts[1:-1])])
        moved = float(np.mean(np.abs(moved))) / joint.scale
        if finding := _finding(joint, change.number, span, fit):
            compared.append(Compared(fit, nats(change, plain, fit, count), moved, finding))
    return compared


def _finding(joint: Followed, number: str, span: Span, fit: Follower) -> Finding | None:
    """The words of a change."""
    seconds = float(np.ptp(joint.time_s))
    begin, end = (0, len(joint.time_s)) if span is None else span
    time = joint.time_s - joint.start_s
    # one reading before the next trial tells nothing
    next_trial = int(joint.starts[np.argmin(np.abs(joint.starts - begin))])
    begin = next_trial if 0 < next_trial - begin <= _FEW_READINGS < end - next_trial else begin
    since, until = float(time[begin]), float(time[end - 1])
    if number == "zero":
        moved = float(fit.values[1])
        if span is None:
            return Finding("zero_drifts", CARE, {"offset_rad": moved})
        return Finding("zero_moves", CARE, {"offset_rad": abs(moved), "time_s": since})
    if number == "lag":
        later = float(fit.terms[_GROWTH])
        if span is not None:
            return Finding("lag_changed", CARE, {"more_ms": 1e3 * later, "time_s": since})
        # early is what no servo is
        verdict = REFUSE if fit.terms[_LAG] + min(later, 0.0) < -_EARLY_S else CARE
        values = {"drift_ms": 1e3 * later / seconds, "percent": 100 * later / seconds}
        return Finding("lag_drifts", verdict, values)
    if number == "torque":
        grown = float(np.exp(fit.terms[_FADE]))
        before_hz = float(np.exp(fit.terms[_NATURAL])) / (2 * np.pi)
        values = {"percent": 100 * (grown - 1), "before_hz": before_hz,
                  "after_hz": before_hz * np.sqrt(grown)}  # fmt: skip
        if span is None:
            return Finding("torque_fades", CARE, values)
        return Finding("torque_changed", CARE, values | {"time_s": since})
    if number == "stays":
        begins, lasts = zip(
            *((time[a], time[b - 1] - time[a]) for a, b in joint.stays), strict=True
        )
        values = {"times": len(lasts), "longest_s": max(lasts), "time_s": begins[0]}
        return Finding("left_path", CARE, values)
    if number == "levels":
        without = fit.terms.copy()
        without[_LOW:] = joint.fit.terms[_LOW:]
        path, levels = joint.path(without), fit.terms[_LOW:]
        low, high = max(levels[[0, 2]]), min(levels[[1, 3]])
        beyond = max(path < low, path > high, key=np.mean)
        if not beyond.any():
            return None
        values = {"level_rad": float(np.median(joint.position_rad[beyond])),
                  "percent": 100 * float(beyond.mean())}  # fmt: skip
        return Finding("clipped", CARE, values)
    before, after = float(fit.values[0]), float(fit.values[:2].sum())
    if span is None:
        values = {"before": before, "after": after, "percent": 100 * (after / before - 1)}
        return Finding("gain_drifts", CARE, values)
    values = {"time_s": since, "until_s": until, "before": before, "after": after}
    if after < -_NO_GAIN * before:
        return Finding("sign_changed", REFUSE, values)
    if _NO_GAIN * before < after < before / _NO_GAIN:
        return Finding("gain_changed", CARE, values)
    if after > before:  # it does not follow before
        begin, end, since, until = 0, begin, 0.0, since
    there = joint.position_rad[begin + (end - begin) // 6 : end - (end - begin) // 6]
    if np.ptp(there) <= max(1.5 * joint.step, 0.02 * joint.scale):
        values = {"trials": 1, "of": len(joint.trials), "longest_s": until - since}
        return Finding("frozen", CARE, values)
    return Finding("left_path", CARE, {"times": 1, "longest_s": until - since, "time_s": since})
