"""Robustness of a walk to late, noisy, missing and stale observations, and to other ground.

Published tests of this kind are replays only. Here they are done twice: in *replay* the policy is
fed altered recordings, and its actions have no effect; in *closed loop* the robot in the simulator
acts on them. Replay shows how a network reacts, closed loop whether it walks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.policies.analysis import perturbations
from pupper_sysid.policies.analysis.gait import correlation, steady
from pupper_sysid.policies.analysis.perturbations import JOINTS
from pupper_sysid.policies.analysis.rollouts import Change, Rollout, replay
from pupper_sysid.policies.analysis.trial import (
    NAN,
    Outcome,
    Trial,
    gait_of_actions,
    mean,
    outcome,
    walking,
)
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.sim.robot.terrain import Terrain
from pupper_sysid.sim.walking.observation import OBSERVATION_PARTS as PARTS

EXTRA_DELAYS_MS = (0, 40, 80, 160, 240, 320, 400)
NOISE_SHARES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
HOLD_MS = (40, 80, 160, 320)
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
    rng = np.random.default_rng(trial.seed)
    plain = trial.walk(policy)
    found = []
    for extra in extra_ms:
        steps = round(extra / step_ms)
        seen = perturbations.applied(perturbations.delayed(JOINTS, steps), plain.observation)
        actions, _ = replay(policy, seen)
        later = replace(trial, servos=trial.servos.later(extra / 1e3))
        fixed = plain if extra == 0 else later.walk(policy)
        change = perturbations.jittered(JOINTS, steps, rng)
        moving = plain if extra == 0 else trial.walk(policy, change)
        found += [
            DelayPoint(extra_delay_ms=extra, mode="replay", **gait_of_actions(plain, actions)),
            DelayPoint(extra_delay_ms=extra, mode="fixed", **outcome(fixed)),
            DelayPoint(extra_delay_ms=extra, mode="jittered", **outcome(moving)),
        ]
    return found


def ablation(
    policy: Policy, trial: Trial, channels: Sequence[str] = tuple(CHANNELS)
) -> list[AblationPoint]:
    """Noise, zeros and staleness on what comes from the servos, by channel and jointly.

    Noise is in shares of a channel's own standard deviation while walking. Its points are NaN if no
    robot walked long enough to know that deviation.
    """
    rng = np.random.default_rng(trial.seed)
    plain = trial.walk(policy)
    walked = steady(plain)
    found = []
    for name in channels:
        part = CHANNELS[name]
        spread = np.full(part.stop - part.start, np.nan)
        if walked:
            shown = [plain.observation[now, i, part] for i, now in walked.items()]
            spread = np.concatenate(shown).std(axis=0)
        sigma = float(spread.mean()) if name != "all joints" else NAN
        cases: list[tuple[Literal["noise", "zero", "hold"], float, float, Callable[[], Change]]] = [
            ("noise", share, share * sigma, partial(perturbations.noisy, part, share * spread, rng))
            for share in NOISE_SHARES
        ]
        cases.append(("zero", 0.0, NAN, partial(perturbations.zeroed, part)))
        for ms in HOLD_MS:
            steps = max(round(ms / 1e3 / plain.step_s), 1)
            cases.append(("hold", ms, NAN, partial(perturbations.held, part, steps)))
        for kind, level, size, change in cases:
            row: dict[str, Any] = {"channel": name, "kind": kind, "level": level, "sigma": size}
            if kind == "noise" and not walked:
                found.append(AblationPoint(**row, correlation=NAN))
                continue
            closed_loop: dict[str, Any] = outcome(trial.walk(policy, change()))
            actions, _ = replay(policy, perturbations.applied(change(), plain.observation))
            found.append(
                AblationPoint(**row, correlation=_agreement(plain, actions), **closed_loop)
            )
    return found


def terrain(policy: Policy, trial: Trial) -> list[GroundPoint]:
    """Survival, tracking and gait on every kind of ground."""
    return [
        GroundPoint(
            ground=kind,
            **outcome(replace(trial, task=replace(trial.task, terrain=kind)).walk(policy)),
        )
        for kind in get_args(Terrain)
    ]


def _agreement(plain: Rollout, altered: NDArray[np.floating]) -> float:
    """Gait correlation of replayed actions with the walk's, mean over walking robots."""
    return mean(
        [correlation(plain.action[now, i], altered[now, i])
         for i, now in walking(plain).items()]
    )  # fmt: skip
