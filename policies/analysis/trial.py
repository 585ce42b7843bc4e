"""Trials of a policy: what a walk comes to, with late, noisy, missing and stale observations too.

A `Trial` is task, servos, command and robots. Published tests of robustness are replays only. Here
they are done twice: in *replay* the policy is fed altered recordings, and its actions have no
effect; in *closed loop* the robot in the simulator acts on them. Replay shows how a network reacts,
closed loop whether it walks.

Directional compliance is speed, drift and arc of a walk in each direction. The published test has
no numbers. Here each direction is walked by robots with different servos, and motion off the
command is measured per metre (when turning, per turn), from two seconds on, in the frame of the
heading at that time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.interval import UNKNOWN, Interval, mean_of
from pupper_sysid.common.results import Result, internal
from pupper_sysid.policies.analysis.gait import (
    SETTLE_S,
    amplitude,
    correlation,
    frequency,
    jitter,
    steady,
)
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.rollouts import Rollout, collect, pooled_errors, replay
from pupper_sysid.policies.walks.together import (
    DIRECTIONS,
    Change,
    Condition,
    Disturb,
    evaluation_task,
)
from pupper_sysid.sim.robot.terrain import Terrain
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


EXTRA_DELAYS_MS = (0, 40, 80, 160, 240, 320, 400)
NOISE_SHARES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
HOLD_MS = (40, 80, 160, 320)
_REPLAYED = 11
CHANNELS = {
    name: PARTS[name]
    for name in ("joint_position_relative", "joint_velocity", "joint_effort", "last_action")
} | {"all joints": JOINTS}
"""Parts of the observation that are ablated."""


@dataclass(frozen=True, kw_only=True)
class DelayPoint(Outcome):
    """A walk with more delay; in replay without survival and tracking errors."""

    extra_delay_ms: float
    mode: Literal["replay", "fixed", "jittered"]


@dataclass(frozen=True, kw_only=True)
class AblationPoint(Outcome):
    """A walk (closed loop) with one channel of the observation altered."""

    channel: str
    kind: Literal["noise", "zero", "hold"]
    level: float
    """Noise: share of the channel's standard deviation; hold: ms; zero: 0."""
    sigma: float
    """Standard deviation of the noise in the channel's unit; NaN where units are mixed."""
    correlation: float
    """In replay, with the actions of the unaltered observation."""


@dataclass(frozen=True, kw_only=True)
class GroundPoint(Outcome):
    """A walk on one kind of ground."""

    ground: Terrain


def delay_curve(
    policy: Policy, trial: Trial, extra_ms: Sequence[float] = EXTRA_DELAYS_MS
) -> list[DelayPoint]:
    """Walks against more delay: in replay as published, and closed loop, fixed and jittered.

    A fixed delay is added to the servos' dead time; a jittered delay is of the joints' observation,
    since a servo cannot answer out of order.
    """
    step_ms = 1e3 * trial.task.control_step_s
    late = [extra for extra in extra_ms if extra]
    jitters = [
        jittered(JOINTS, round(extra / step_ms), rng)
        for extra, rng in zip(late, _generators(trial, len(late)), strict=True)
    ]
    plain, *walks = trial.walks(
        policy,
        [
            trial.condition(),
            *(trial.condition(extra_dead_time_s=extra / 1e3) for extra in late),
            *(trial.condition(change) for change in jitters),
        ],
    )
    altered = iter(zip(walks, walks[len(late) :], strict=False))
    walked = [next(altered) if extra else (plain, plain) for extra in extra_ms]
    replays = _replayed(policy, plain, [delayed(JOINTS, round(e / step_ms)) for e in extra_ms])
    points = []
    for extra, actions, (fixed, moving) in zip(extra_ms, replays, walked, strict=True):
        points += [
            DelayPoint(extra_delay_ms=extra, mode="replay", **gait_of_actions(plain, actions)),
            DelayPoint(extra_delay_ms=extra, mode="fixed", **outcome(fixed)),
            DelayPoint(extra_delay_ms=extra, mode="jittered", **outcome(moving)),
        ]
    return points


def ablation(
    policy: Policy, trial: Trial, channels: Sequence[str] = tuple(CHANNELS)
) -> list[AblationPoint]:
    """Noise, zeros and staleness on what comes from the servos, by channel and jointly.

    Noise is in shares of a channel's own standard deviation while walking. Its points are NaN if no
    robot walked long enough to know that deviation.
    """
    (plain,) = trial.walks(policy, [trial.condition()], (0.0, 0.02))
    rows: list[dict[str, Any]] = []
    changes: list[Callable[[np.random.Generator], Change]] = []
    for name in channels:
        part = CHANNELS[name]
        walked = [plain.observation[now, i, part] for i, now in steady(plain).items()]
        unknown = np.full(part.stop - part.start, np.nan)
        spread = np.concatenate(walked).std(axis=0) if walked else unknown
        sigma = float(spread.mean()) if name != "all joints" else NAN
        for share in NOISE_SHARES:
            rows.append({"kind": "noise", "level": share, "sigma": share * sigma})
            changes.append(partial(noisy, part, share * spread))
        rows.append({"kind": "zero", "level": 0.0, "sigma": NAN})
        changes.append(lambda rng, part=part: zeroed(part))
        for ms in HOLD_MS:
            steps = max(round(ms / 1e3 / plain.step_s), 1)
            rows.append({"kind": "hold", "level": ms, "sigma": NAN})
            changes.append(lambda rng, part=part, steps=steps: held(part, steps))
    channel = [name for name in channels for _ in range(len(rows) // len(channels))]
    known = [i for i, row in enumerate(rows) if row["kind"] != "noise" or steady(plain)]
    # a change keeps a memory: one for the walk, one for the replay
    altered, replayed = (
        [changes[i](rng) for i, rng in zip(known, rngs, strict=True)]
        for rngs in (_generators(trial, len(known), k) for k in (0, 1))
    )
    walks = trial.walks(policy, [trial.condition(change) for change in altered], (0.02, 1.0))
    outcomes: dict[int, dict[str, Any]] = dict(zip(known, map(outcome, walks), strict=True))
    agreements = dict(zip(known, _agreements(policy, plain, replayed), strict=True))
    return [
        AblationPoint(
            channel=name, **row, correlation=agreements.get(i, NAN), **outcomes.get(i, {})
        )
        for i, (name, row) in enumerate(zip(channel, rows, strict=True))
    ]


def terrain(policy: Policy, trial: Trial) -> list[GroundPoint]:
    """Survival, tracking and gait on every kind of ground."""
    kinds = get_args(Terrain)
    walks = trial.walks(policy, [trial.condition(terrain=kind) for kind in kinds])
    return [
        GroundPoint(ground=kind, **outcome(walked))
        for kind, walked in zip(kinds, walks, strict=True)
    ]


def _generators(trial: Trial, count: int, which: int = 0) -> list[np.random.Generator]:
    """One for each condition: conditions may run side by side."""
    return np.random.default_rng([trial.seed, which]).spawn(count)


def _replayed(
    policy: Policy, plain: Rollout, changes: Sequence[Change]
) -> list[NDArray[np.float32]]:
    """Actions on the walk's observations, each changed in its way; all at once."""
    seen = [applied(change, plain.observation) for change in changes]
    actions, _ = replay(policy, np.concatenate(seen, axis=1))
    return np.split(actions, len(changes), axis=1)


def _agreements(policy: Policy, plain: Rollout, changes: Sequence[Change]) -> list[float]:
    """Gait correlation of replayed actions with the walk's, mean over walking robots."""
    agreements = []
    for start in range(0, len(changes), _REPLAYED):  # a few at a time, to limit memory
        for altered in _replayed(policy, plain, changes[start : start + _REPLAYED]):
            alike = [
                correlation(plain.action[now, i], altered[now, i])
                for i, now in walking(plain).items()
            ]
            agreements.append(mean(alike))
    return agreements


_SHORTEST_M, _SMALLEST_TURN_RAD = 0.05, 0.2  # less motion gives no value per metre or turn


@dataclass(frozen=True, kw_only=True)
class DirectionWalk(Result):
    """Walks in one direction; intervals over robots."""

    direction: str
    command: tuple[float, float, float]
    survival: float
    share: Interval
    """Speed along the command over the commanded speed; 0 of a robot that fell."""
    drift: Interval
    """Motion to the left of the command, metres per metre, of robots that stayed up; NaN for
    turns."""
    arc_rad_m: Interval
    """Change of heading per metre, of robots that stayed up; NaN for turns."""
    wander_m: Interval
    """Displacement of the trunk per turn, of robots that stayed up; NaN for straight walks."""
    path: Array = internal()
    """Places of the first robot that stayed up [m], shape (steps, 2)."""


def compliance(policy: Policy, trial: Trial) -> list[DirectionWalk]:
    """Walk in every direction of `evaluation.DIRECTIONS` that moves."""
    moving = {name: command for name, command in DIRECTIONS.items() if any(command)}
    walks = trial.walks(policy, [trial.condition(command=c) for c in moving.values()])
    return [
        DirectionWalk(
            direction=name, command=walked.command, survival=1.0 - float(walked.fell.mean()),
            **_measured(walked),
        )
        for name, walked in zip(moving, walks, strict=True)
    ]  # fmt: skip


def _measured(walked: Rollout) -> dict[str, Any]:
    """Share, drift, arc, wander and path of one direction."""
    start = round(SETTLE_S / walked.step_s)
    robots = np.flatnonzero(walked.alive[-1])
    command = np.array(walked.command)
    shares = np.zeros(walked.alive.shape[1])
    if not len(robots) or len(walked.position) <= start + 1:
        return {
            # a fallen robot has share 0; a walk so short gives none of one that is up
            "share": UNKNOWN if len(robots) else mean_of(shares),
            "drift": UNKNOWN, "arc_rad_m": UNKNOWN, "wander_m": UNKNOWN, "path": np.zeros((0, 2)),
        }  # fmt: skip
    away = walked.position[start:, robots] - walked.position[start, robots]
    c, s = np.cos(walked.position[start, robots, 2]), np.sin(walked.position[start, robots, 2])
    x, y = away[..., 0], away[..., 1]
    place = np.stack([c * x + s * y, c * y - s * x, away[..., 2]], axis=-1)  # as it stood then
    seconds = walked.step_s * (len(place) - 1)
    speed = float(np.linalg.norm(command))
    nothing = np.full(len(robots), np.nan)
    if not command[:2].any():
        turned = place[-1, :, 2] * np.sign(command[2])
        shares[robots] = turned / seconds / speed
        turns = np.where(turned > _SMALLEST_TURN_RAD, turned / (2 * np.pi), np.nan)
        drift, arc, wander = nothing, nothing, np.linalg.norm(place[-1, :, :2], axis=-1) / turns
    else:
        along = command[:2] / speed
        across = np.array([-along[1], along[0]])
        went = place[-1, :, :2] @ along
        shares[robots] = went / seconds / speed
        metres = np.where(went > _SHORTEST_M, went, np.nan)
        drift, arc = place[-1, :, :2] @ across / metres, place[-1, :, 2] / metres
        wander = nothing
    measures = {"share": shares, "drift": drift, "arc_rad_m": arc, "wander_m": wander}
    return {k: mean_of(v) for k, v in measures.items()} | {"path": place[:, 0, :2]}
