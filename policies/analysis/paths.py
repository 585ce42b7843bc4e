"""Directional compliance: speed, drift and arc of a walk in each direction.

The published test has no numbers. Here each direction is walked by robots with servos of their own,
and motion off the command is measured per metre (when turning, per turn), from two seconds on, in
the frame of the heading at that time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result, internal
from pupper_sysid.policies.analysis.gait import SETTLE_S
from pupper_sysid.policies.analysis.rhythm import UNKNOWN, mean_of
from pupper_sysid.policies.analysis.trial import Trial
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.conditions import DIRECTIONS
from pupper_sysid.policies.walks.rollouts import Rollout

Array = NDArray[np.float64]

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
            # a fallen robot has share 0; of one that is up, nothing is known yet
            "share": UNKNOWN if len(robots) else mean_of(shares),
            "drift": UNKNOWN, "arc_rad_m": UNKNOWN, "wander_m": UNKNOWN, "path": np.zeros((0, 2)),
        }  # fmt: skip
    place = _from_start(walked.position[start:, robots])
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


def _from_start(position: Array) -> Array:
    """Places and headings (steps, n, 3) in the frame of the first of them."""
    away = position - position[0]
    c, s = np.cos(position[0, :, 2]), np.sin(position[0, :, 2])
    x, y = away[..., 0], away[..., 1]
    return np.stack([c * x + s * y, c * y - s * x, away[..., 2]], axis=-1)
