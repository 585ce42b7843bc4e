"""The orbit of a gait, and what keeps its rhythm going.

A gait is a limit cycle: along their largest directions of variance, actions and hidden states of a
policy go round one closed curve. `principal_components` finds these directions for several
conditions together (no delay, more delay …), so that their orbits share axes; `closure` measures
how well an orbit returns to itself after a period, `area_ratio` how much of its area is left.
`orbits` does all of it for a policy with late joints. Variance explained means little without the
closure: three components also explain all of the noise in three dimensions.

A rhythm made inside the network goes on when its inputs are frozen. An oscillator with its own time
takes a push as a jump in phase, which it keeps; a rhythm driven from outside returns to its former
phase. A rhythm counted in the network's own steps speeds up with the control rate; one set by the
body does not. `autonomy` tests all three.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pupper_sysid.common.interval import mean_of
from pupper_sysid.common.results import Result, internal
from pupper_sysid.policies.analysis.gait import SETTLE_S, sine_frequency
from pupper_sysid.policies.analysis.trial import (
    JOINTS,
    NAN,
    STILL_RAD,
    Outcome,
    Trial,
    applied,
    delayed,
    gait_of_actions,
    moving_frequency,
    outcome,
    still,
    walking,
)
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.rollouts import Rollout, heading, replay
from pupper_sysid.policies.walks.together import Disturb
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.step import OBSERVATION_PARTS

Array = NDArray[np.float64]

DELAYS_MS = (0.0, 160.0, 320.0)
"""Of the published orbits."""


@dataclass(frozen=True)
class PrincipalComponents:
    """Directions of largest variance of states with d numbers."""

    mean: Array
    """Shape (d,)."""
    axes: Array
    """Orthonormal, largest variance first; the largest number of each is positive; shape (k, d)."""
    variance: Array
    """Along all d directions, largest first; shape (d,)."""

    @property
    def explained(self) -> Array:
        """Share of the variance along each axis, shape (k,)."""
        return self.variance[: len(self.axes)] / self.variance.sum()

    @property
    def participation_ratio(self) -> float:
        """Number of directions that the variance is spread over, 1 to d: (Σ λ)² / Σ λ²."""
        return float(self.variance.sum() ** 2 / (self.variance**2).sum())

    def orbit(self, states: NDArray[np.floating]) -> Array:
        """States (..., d) along the axes, shape (..., k)."""
        return (np.asarray(states, float) - self.mean) @ self.axes.T


def principal_components(
    conditions: Sequence[NDArray[np.floating]], count: int
) -> PrincipalComponents:
    """Principal components of several conditions together.

    States are centred on their common mean and not standardised: all of them have one unit, and a
    joint that hardly moves should count little. Every state counts the same, so conditions count
    by their lengths.

    Conditions are actions or hidden states of shape (..., d), for example (steps, robots, d);
    `count` axes are kept.
    """
    states = np.concatenate([np.asarray(c, float).reshape(-1, np.shape(c)[-1]) for c in conditions])
    mean = states.mean(axis=0)
    # of the small d × d matrix: states are many
    variance, axes = np.linalg.eigh((states - mean).T @ (states - mean) / len(states))
    variance, axes = np.clip(variance[::-1], 0.0, None), axes.T[::-1][:count]
    # the sign of an axis is arbitrary: fix it, or figures would flip between machines
    largest = np.abs(axes).argmax(axis=1)
    axes = axes * np.sign(axes[np.arange(count), largest])[:, None]
    return PrincipalComponents(mean, axes, variance)


def closure(orbit: NDArray[np.floating], step_s: float, frequency_hz: float) -> float:
    """Distance of an orbit from itself one period later: 0 closed, 1 as far as unrelated points.

    Root mean square distance between points one period apart, over the one between two points
    drawn at random from the orbit (√2 times its RMS radius). Between samples the orbit is
    interpolated by a cubic spline, since a period is no whole number of steps. NaN of an orbit that
    is shorter than two periods, or stays at one point.

    The orbit is of one robot, shape (steps, k) in any number of dimensions; the frequency is its
    gait's.
    """
    orbit = np.asarray(orbit, float)
    time = step_s * np.arange(len(orbit))
    period = 1.0 / frequency_hz
    radius2 = ((orbit - orbit.mean(axis=0)) ** 2).sum(axis=1).mean()
    if not time[-1] >= 2 * period or not radius2 > 0:
        return NAN
    before = time + period <= time[-1]
    later = CubicSpline(time, orbit)(time[before] + period)
    away2 = ((later - orbit[before]) ** 2).sum(axis=1).mean()
    return float(np.sqrt(away2 / (2 * radius2)))


def area(orbit: NDArray[np.floating]) -> float:
    """Area of the ellipse with the covariance of an orbit in the plane.

    A half axis a has the variance a²/2. Noise makes a band look rounder than it is; `closure`
    distinguishes noise from an orbit.

    Orbits have the shape (steps, 2), or (steps, n, 2) of n robots, each about its own centre.
    """
    orbit = np.asarray(orbit, float)
    away = (orbit - orbit.mean(axis=0)).reshape(-1, 2)
    minor, major = np.sqrt(2 * np.clip(np.linalg.eigvalsh(away.T @ away / len(away)), 0.0, None))
    return float(np.pi * float(major) * float(minor))


def area_ratio(orbit: NDArray[np.floating], reference: NDArray[np.floating]) -> float:
    """Area of an orbit over that of `reference`, on the same axes; NaN if that encloses none.

    Both as `area` takes them.
    """
    before = area(reference)
    return area(orbit) / before if before > 0 else NAN


@dataclass(frozen=True, kw_only=True)
class Orbits(Result):
    """Orbits of actions or hidden states of one robot, one per delay, on common axes."""

    states: list[Array] = internal()
    """Shape (steps, k) each; actions in rad."""
    orbits: list[Array] = internal()
    """Shape (steps, 3) each."""
    explained: list[float]
    """Shares of variance."""
    explained_3: float
    participation_ratio: float
    closure: list[float]
    """NaN where the orbit stands still."""
    area_ratio: list[float]
    """To no delay."""


def orbits(
    policy: Policy, trial: Trial, delays_ms: Sequence[float] = DELAYS_MS
) -> dict[str, Orbits]:
    """Orbits of `actions` and `hidden` states in replay with late joints.

    Of the first robot that walked long enough; empty if none walked and moved.
    """
    plain = trial.walk(policy)
    moving = walking(plain)
    if not moving:
        return {}
    robot, now = next(iter(moving.items()))
    acted, hidden_states = [], []
    for delay in delays_ms:
        change = delayed(JOINTS, round(delay / 1e3 / plain.step_s))
        actions, hidden = replay(policy, applied(change, plain.observation))
        acted.append(plain.action_scale * actions[now, robot].astype(float))
        hidden_states.append(hidden[now, robot].astype(float))
    rate = moving_frequency(acted[0], plain.step_s)
    by_kind = {}
    for name, conditions in (("actions", acted), ("hidden", hidden_states)):
        axes = principal_components(conditions, 3)
        paths = [axes.orbit(c) for c in conditions]
        by_kind[name] = Orbits(
            states=conditions, orbits=paths, explained=axes.explained.tolist(),
            explained_3=float(axes.explained[:3].sum()),
            participation_ratio=float(axes.participation_ratio),
            closure=[closure(path, plain.step_s, rate) for path in paths],
            area_ratio=[area_ratio(path[:, :2], paths[0][:, :2]) for path in paths],
        )  # fmt: skip
    return by_kind


PUSH_M_S = 0.2
"""Sideways speed that a push gives the trunk: the largest of the training."""
NUDGE_M_S = 0.01
"""A push for comparison, too small to matter."""
RATES_HZ = (25.0, 31.25, 50.0, 71.43, 100.0)
_PUSH_S = 4.0
_PUSHES = 4  # spread over one period
_RATES_SHARE = 0.4  # of the time of all tests
_EARLY_S, _LATE_S = (1.0, 3.0), (3.0, 5.0)  # after the push
_LAST_ACTION = OBSERVATION_PARTS["last_action"]


@dataclass(frozen=True, kw_only=True)
class FrozenTest(Result):
    """Actions in replay with part of the observation frozen; NaN if no robot walked."""

    test: str
    share: float
    """Of the amplitude with nothing frozen."""
    frequency_hz: float
    amplitude_rad: float
    jitter_rad: float


@dataclass(frozen=True, kw_only=True)
class PushTest(Result):
    """Phase shifts that a push leaves."""

    push_m_s: float
    survival: float
    shift_early: float
    """Mean size of the phase shift 1–3 s after the push [cycles]."""
    shift_late: float
    """Mean size of the phase shift 3–5 s after the push [cycles]."""
    kept: float
    """Slope of the late shifts on the early ones: 1 is kept, 0 returns."""
    phases: tuple[float, ...]
    """At each push [cycles]."""
    shifts: tuple[float, ...]
    """Late shift after each push [cycles]."""


@dataclass(frozen=True, kw_only=True)
class RatePoint(Outcome):
    """A walk at another control rate."""

    rate_hz: float
    cycles_per_step: float


@dataclass(frozen=True, kw_only=True)
class Autonomy(Result):
    """All tests of one policy."""

    frozen: tuple[FrozenTest, ...]
    push: tuple[PushTest, ...]
    """Empty if no robot walks to the end."""
    rate: tuple[RatePoint, ...]
    rate_exponent: float
    """See `rate_exponent`."""


def autonomy(policy: Policy, trial: Trial) -> Autonomy:
    """Run all tests of a policy."""
    # first, since the walk with nothing altered is among them
    rate = rate_response(policy, trial)
    return Autonomy(
        frozen=frozen(policy, trial), push=push_response(policy, trial), rate=rate,
        rate_exponent=rate_exponent(rate),
    )  # fmt: skip


def frozen(policy: Policy, trial: Trial) -> tuple[FrozenTest, ...]:
    """Rhythm without inputs, in replay, from two seconds on.

    A rhythm that goes on with all inputs frozen is made inside the network; one that needs its own
    last action is made by the loop through the action; one that stops needs the joints.
    """
    plain = trial.walk(policy)
    start = round(SETTLE_S / plain.step_s)
    last = _LAST_ACTION
    before = gait_of_actions(plain, plain.action)["amplitude_rad"]
    tests = {
        "nothing frozen": (None, False),
        "senses frozen, its own last action": (slice(0, last.start), True),
        "senses and last action frozen": (slice(0, last.stop), False),
        "last action frozen, senses recorded": (last, False),
    }
    results = []
    for name, (part, feeds_back) in tests.items():
        gait = gait_of_actions(plain, _driven(policy, plain, part, feeds_back, start))
        share = gait["amplitude_rad"] / before if before > STILL_RAD else NAN
        results.append(FrozenTest(test=name, share=share, **gait))
    return tuple(results)


def push_response(policy: Policy, trial: Trial) -> tuple[PushTest, ...]:
    """Phase shifts after sideways pushes, for a nudge and for a push.

    Each robot walks twice, with and without the push; pushes come at times spread over a period.
    The shift is between the sines of the two walks' actions. Empty if no robot walks to the end.
    """
    seconds = _PUSH_S + _LATE_S[1] + 1.0
    if trial.seconds != seconds:
        trial = replace(trial, seconds=seconds)
    (plain,) = trial.walks(policy, [trial.condition()], (_RATES_SHARE, _RATES_SHARE))
    step_s = plain.step_s
    begin = round(_PUSH_S / step_s)
    settled = plain.action_rad[round(SETTLE_S / step_s) :]
    robots = [i for i in np.flatnonzero(plain.alive[-1]).tolist() if not still(settled[:, i])]
    if not robots:
        return ()
    rates = {i: sine_frequency(settled[:, i], step_s) for i in robots}
    period = 1 / float(np.median(list(rates.values())))
    results = []
    times = [begin + round(k * period / _PUSHES / step_s) for k in range(_PUSHES)]
    speeds = (NUDGE_M_S, PUSH_M_S)
    conditions = [trial.condition(None, _pusher(at, speed)) for speed in speeds for at in times]
    walks = iter(trial.walks(policy, conditions, (_RATES_SHARE, 1.0)))
    for speed in speeds:
        shifts, phases, survived = [], [], []
        for at, pushed in zip(times, walks, strict=False):
            survived.append(pushed.alive[-1][robots].mean())
            walking = [i for i in robots if pushed.alive[-1, i]]
            shifts += [
                [_shift(plain, pushed, at, w, i, rates[i]) for w in (_EARLY_S, _LATE_S)]
                for i in walking
            ]
            phases += [_phase(plain, at, i, rates[i]) for i in walking]
        early, late = np.array(shifts).reshape(-1, 2).T
        results.append(PushTest(
            push_m_s=speed, survival=float(np.mean(survived)),
            shift_early=mean_of(np.abs(early)).value, shift_late=mean_of(np.abs(late)).value,
            kept=float(early @ late / (early @ early)) if early.any() else NAN,
            phases=tuple(phases), shifts=tuple(late.tolist()),
        ))  # fmt: skip
    return tuple(results)


def rate_response(policy: Policy, trial: Trial) -> tuple[RatePoint, ...]:
    """Walks at control rates below and above that of the training."""
    physics_s = trial.condition().task.physics_step_s
    steps_s = [round(1 / rate / physics_s) * physics_s for rate in RATES_HZ]
    conditions = [trial.condition(control_step_s=step_s) for step_s in steps_s]
    walks = map(outcome, trial.walks(policy, conditions, (0.0, _RATES_SHARE)))
    return tuple(
        RatePoint(rate_hz=1 / step_s, cycles_per_step=walked["frequency_hz"] * step_s, **walked)
        for step_s, walked in zip(steps_s, walks, strict=True)
    )


def rate_exponent(rows: Sequence[RatePoint]) -> float:
    """Exponent of the gait's frequency over the control rate: 1 counted in steps, 0 in seconds."""
    known = [r for r in rows if np.isfinite(r.frequency_hz) and r.survival > 0.5]
    if len(known) < 2:
        return NAN
    rates, gaits = np.log([r.rate_hz for r in known]), np.log([r.frequency_hz for r in known])
    return float(np.polyfit(rates, gaits, 1)[0])


def _driven(
    policy: Policy, plain: Rollout, part: slice | None, own_action: bool, start: int
) -> Array:
    """Actions of a policy on a recording with a part of the observation frozen from `start` on.

    With `own_action` the last action is that of this run, else the recorded (or frozen) one.
    """
    player = copy(policy)
    seen = plain.observation
    player.reset(seen[0, :, _LAST_ACTION])
    last, actions = seen[0, :, _LAST_ACTION], []
    for step, observation in enumerate(seen):
        altered = observation.copy()
        if part is not None and step >= start:
            altered[:, part] = seen[start, :, part]
        if own_action:
            altered[:, _LAST_ACTION] = last
        last = player.act(altered)
        actions.append(last)
    return np.stack(actions)


def _pusher(at: int, speed: float) -> Disturb:
    """One push of each trunk to the left."""

    def disturb(step: int, env: PupperEnv, robots: NDArray[np.intp]) -> None:
        if step != at:
            return
        velocity = env.robots.qvel[robots, :2]
        angle = heading(env.robots.qpos[robots])
        velocity += speed * np.column_stack([-np.sin(angle), np.cos(angle)])
        env.robots.push(robots, velocity)

    return disturb


def _shift(
    plain: Rollout, pushed: Rollout, at: int, window_s: tuple[float, float], robot: int, rate: float
) -> float:
    """Phase of the pushed walk ahead of the plain one [cycles], -0.5 to 0.5."""
    begin, end = (at + round(s / plain.step_s) for s in window_s)
    end = min(end, len(plain.action))  # the last pushes of a slow gait come late
    carrier = _carrier(rate, begin, end, plain.step_s)
    before, after = (r.action_rad[begin:end, robot] for r in (plain, pushed))
    phasor, pushed_phasor = (carrier @ (x - x.mean(axis=0)) for x in (before, after))
    return float(np.angle(np.vdot(phasor, pushed_phasor)) / (2 * np.pi))


def _phase(plain: Rollout, at: int, robot: int, rate: float) -> float:
    """Phase of the LF thigh's action at the push [cycles], 0 to 1."""
    begin = at - round(SETTLE_S / plain.step_s)
    thigh = plain.action_rad[begin:at, robot, 1]
    turned = np.angle(_carrier(rate, begin, at, plain.step_s) @ (thigh - thigh.mean()))
    return float((turned / (2 * np.pi) + rate * at * plain.step_s) % 1.0)


def _carrier(rate: float, begin: int, end: int, step_s: float) -> NDArray[np.complex128]:
    return np.exp(-2j * np.pi * rate * step_s * np.arange(begin, end))
