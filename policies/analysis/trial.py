"""A trial of a policy: task, servos, command and robots, and what a walk in it comes to.

Perturbations of observations (delay, noise, zeros, staleness) are a `Change` of a condition, or
alter a recorded sequence for `replay`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.interval import mean_of
from pupper_sysid.common.results import Result
from pupper_sysid.policies.analysis.gait import amplitude, frequency, jitter, steady
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.rollouts import Rollout, collect, pooled_errors
from pupper_sysid.policies.walks.together import Change, Condition, Disturb, evaluation_task
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.servo_ranges import ServoRanges
from pupper_sysid.sim.walking.step import OBSERVATION_PARTS as PARTS

Array = NDArray[np.float64]
NAN = float("nan")
STILL_RAD = 1e-3
"""Smaller deviations move no servo by a count [rad]."""


@dataclass(frozen=True)
class Trial:
    """Task, servos, command, number of robots and duration in which a policy is tried."""

    task: Walking
    servos: ServoRanges
    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    robots: int = 16
    seconds: float = 10.0
    seed: int = 0
    threads: int = 0
    progress: Callable[[float], None] = field(
        default_factory=lambda: lambda share: None, compare=False
    )
    """Called with the share of an analysis that is done."""
    _plain: list[tuple[Policy, Rollout]] = field(
        init=False, repr=False, compare=False, default_factory=list
    )

    def condition(
        self,
        change: Change | None = None,
        disturb: Disturb | None = None,
        extra_dead_time_s: float = 0.0,
        **different: Any,
    ) -> Condition:
        """What these robots walk under, perhaps altered.

        `different` are fields of the task, and `command`.
        """
        command = different.pop("command", self.command)
        task = evaluation_task(replace(self.task, **different))
        return Condition(task, self.robots, command, extra_dead_time_s, change, disturb)

    def walk(self, policy: Policy) -> Rollout:
        """One rollout, with nothing altered."""
        return self.walks(policy, [self.condition()])[0]

    def walks(
        self,
        policy: Policy,
        conditions: Sequence[Condition],
        part: tuple[float, float] = (0.0, 1.0),
    ) -> list[Rollout]:
        """Rollouts under several conditions at once.

        The one with nothing altered is kept per policy: most analyses begin with it. Altered ones
        have no observations and hidden states if there are several.

        `part` are the shares of the analysis that are done before and after.
        """
        plain = self.condition()
        known = next((r for p, r in self._plain if p is policy), None)
        new = [c for c in conditions if known is None or c != plain]
        start, end = part
        new_rollouts = collect(
            policy, self.servos, new, self.seconds, self.seed, self.threads,
            lambda share: self.progress(start + share * (end - start)), len(conditions) > 1,
        ) if new else []  # fmt: skip
        walked = iter(new_rollouts)
        rollouts = [known if known and c == plain else next(walked) for c in conditions]
        if known is None and plain in conditions:
            self._plain.append((policy, rollouts[list(conditions).index(plain)]))
        return rollouts


@dataclass(frozen=True, kw_only=True)
class Outcome(Result):
    """Survival, tracking errors and gait of a walk; NaN where there is none.

    In the errors, a robot that fell stands still until the end of the walk.
    """

    survival: float = NAN
    """Share of robots that did not fall."""
    mae_vx_m_s: float = NAN
    mae_vy_m_s: float = NAN
    mae_yaw_rad_s: float = NAN
    frequency_hz: float = NAN
    """Of the actions, mean over robots that walked long enough."""
    amplitude_rad: float = NAN
    jitter_rad: float = NAN


def outcome(rollout: Rollout) -> dict[str, float]:
    """Values of an `Outcome` by field; those of the gait are NaN if no robot walked long enough."""
    walked = [rollout.action_rad[now, i] for i, now in walking(rollout).items()]
    errors = pooled_errors(
        rollout.velocity, np.array(rollout.command), rollout.alive, rollout.fell,
        rollout.whole_steps,
    )  # fmt: skip
    survival = 1.0 - float(rollout.fell.mean())
    return {"survival": survival, **errors, **_gait_of(walked, rollout.step_s)}


def gait_of_actions(plain: Rollout, actions: NDArray[np.floating]) -> dict[str, float]:
    """Frequency, amplitude and jitter of replayed actions, once settled.

    Means over the robots whose recording is of a walk, up to their fall; NaN if there is none (for
    the frequency: none that moves in the replay).
    """
    radians = plain.action_scale * actions.astype(float)
    return _gait_of([radians[now, i] for i, now in steady(plain).items()], plain.step_s)


def _gait_of(walked: Sequence[Array], step_s: float) -> dict[str, float]:
    """Means over robots, whose actions [rad] have the shape (steps, 12)."""
    return {
        "frequency_hz": mean([moving_frequency(x, step_s) for x in walked]),
        "amplitude_rad": mean([float(amplitude(x)[0].mean()) for x in walked]),
        "jitter_rad": mean([jitter(x) for x in walked]),
    }


def walking(rollout: Rollout) -> dict[int, slice]:
    """The steady steps of each robot that walked long enough and moved."""
    return {i: n for i, n in steady(rollout).items() if not still(rollout.action_rad[n, i])}


def still(signal: Array) -> bool:
    """Whether no joint moves, at whatever angle it stands."""
    return bool(signal.std(axis=0).max() < STILL_RAD)


def moving_frequency(signal: Array, step_s: float) -> float:
    """Frequency of a signal [Hz]; NaN if it stands still."""
    return NAN if still(signal) else frequency(signal, step_s).value


def mean(values: Sequence[float]) -> float:
    """Mean of the finite values, NaN if there are none."""
    return mean_of(np.array(values, float)).value


Observations = NDArray[np.float32]

JOINTS = slice(PARTS["joint_position_relative"].start, PARTS["joint_effort"].stop)
"""All that comes from the servos: positions, velocities, efforts (12:48)."""


def delayed(part: slice, steps: int) -> Change:
    """Delay a part by a number of control steps."""
    past: list[Observations] = []

    def value(step: int, now: Observations) -> Observations:
        past.append(now)
        del past[: -steps - 1]
        return past[0]

    return _altered(part, value)


def jittered(part: slice, mean_steps: int, rng: np.random.Generator) -> Change:
    """Delay a part by a lag that wanders between 0 and twice its mean, never back in time.

    The lag grows by at most one step per step, or an older value would follow a newer one.
    """
    past: list[Observations] = []
    lag = np.zeros(0, int)

    def value(step: int, now: Observations) -> Observations:
        nonlocal lag
        if not len(lag):
            lag = np.full(len(now), mean_steps)
        past.insert(0, now)
        del past[2 * mean_steps + 1 :]
        drawn = rng.integers(0, 2 * mean_steps + 1, len(lag))
        lag = np.minimum(np.minimum(drawn, lag + 1), len(past) - 1)
        return np.stack(past)[lag, np.arange(len(lag))]

    return _altered(part, value)


def noisy(part: slice, sigma: NDArray[np.floating], rng: np.random.Generator) -> Change:
    """Add white noise with a standard deviation per number of the part, in its own unit."""
    size = np.asarray(sigma, np.float32)
    return _altered(part, lambda _, now: now + size * rng.standard_normal(now.shape, np.float32))


def zeroed(part: slice) -> Change:
    """Set a part to zero."""
    return _altered(part, lambda _, now: np.zeros_like(now))


def held(part: slice, steps: int) -> Change:
    """Refresh a part only every `steps` control steps: staleness, as slow polls cause it."""
    latest: list[Observations] = []

    def value(step: int, now: Observations) -> Observations:
        if step % steps == 0:
            latest[:] = [now]
        return latest[0]

    return _altered(part, value)


def _altered(part: slice, value: Callable[[int, Observations], NDArray[np.floating]]) -> Change:
    """Replace a part by a function of the step and of a copy of the part."""

    def change(step: int, observation: Observations) -> Observations:
        observation[:, part] = value(step, observation[:, part].copy())
        return observation

    return change


def applied(change: Change, observations: Observations) -> Observations:
    """A recorded sequence of observations, shape (steps, n, 60), with the change applied."""
    return np.stack([change(i, seen.copy()) for i, seen in enumerate(observations)]).astype(
        np.float32
    )
