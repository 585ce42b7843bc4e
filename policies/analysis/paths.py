"""Where a policy goes when it is told to go somewhere: path, drift and arc, per direction.

The published test of directional compliance has no numbers. Here each direction is walked by
robots with servos of their own, and what is not along the command is measured per metre (or, when
turning, per turn), from two seconds on, in the frame of the heading that the robot has then.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.policies.analysis.evaluation import DIRECTIONS
from pupper_sysid.policies.analysis.gait import SETTLE_S
from pupper_sysid.policies.analysis.rhythm import mean_of
from pupper_sysid.policies.analysis.robustness import Trial
from pupper_sysid.policies.analysis.rollouts import Rollout
from pupper_sysid.policies.network.policy_file import Policy

Array = NDArray[np.float64]

_SHORTEST_M, _SMALLEST_TURN_RAD = 0.05, 0.2  # of less, nothing per metre or turn can be said


def compliance(policy: Policy, trial: Trial) -> list[dict[str, Any]]:
    """How each direction is followed.

    Returns
    -------
    list of dict
        `direction`, `command`, `survival`; as (value, low, high) over robots: `share` (speed along
        the command over the speed asked for; 0 of a robot that fell), and over those that stayed
        up: `drift` (across the command, metres per metre, to
        the left of it positive; NaN for turns), `arc_rad_m` (change of heading per metre; NaN for
        turns), `wander_m` (distance that the trunk's mean place moves per turn; NaN for straight
        ones); and `path`, places [m] of the first robot that stayed up, shape (steps, 2).
    """
    found = []
    for name, command in DIRECTIONS.items():
        if not any(command):
            continue
        walked = replace(trial, command=command).walk(policy)
        found.append(
            {"direction": name, "command": command, "survival": float(walked.alive[-1].mean())}
            | _measured(walked)
        )
    return found


def _measured(walked: Rollout) -> dict[str, Any]:
    """Share, drift, arc and wander of one direction."""
    start = round(SETTLE_S / walked.step_s)
    robots = np.flatnonzero(walked.alive[-1])
    command = np.array(walked.command)
    everyone = np.zeros(walked.alive.shape[1])
    if not len(robots) or len(walked.position) <= start + 1:
        nothing = mean_of(np.zeros(0))
        return {
            # one that is not up goes nowhere; of one that is, nothing is known yet
            "share": nothing if len(robots) else mean_of(everyone),
            "drift": nothing, "arc_rad_m": nothing, "wander_m": nothing, "path": np.zeros((0, 2)),
        }  # fmt: skip
    place = _from_start(walked.position[start:, robots])
    seconds = walked.step_s * (len(place) - 1)
    asked = float(np.linalg.norm(command))
    turning = not command[:2].any()
    if turning:
        turned = place[-1, :, 2] * np.sign(command[2])
        share = turned / seconds / asked
        turns = np.where(turned > _SMALLEST_TURN_RAD, turned / (2 * np.pi), np.nan)
        wander = np.linalg.norm(place[-1, :, :2], axis=-1) / turns
        drift = arc = np.full(len(robots), np.nan)
    else:
        along = command[:2] / asked
        across = np.array([-along[1], along[0]])
        went = place[-1, :, :2] @ along
        share = went / seconds / asked
        metres = np.where(went > _SHORTEST_M, went, np.nan)
        drift, arc = place[-1, :, :2] @ across / metres, place[-1, :, 2] / metres
        wander = np.full(len(robots), np.nan)
    everyone[robots] = share
    measures = {"share": everyone, "drift": drift, "arc_rad_m": arc, "wander_m": wander}
    return {k: mean_of(v) for k, v in measures.items()} | {"path": place[:, 0, :2]}


def _from_start(position: Array) -> Array:
    """Places and headings (steps, n, 3) as seen from the first of them."""
    away = position - position[0]
    c, s = np.cos(position[0, :, 2]), np.sin(position[0, :, 2])
    x, y = away[..., 0], away[..., 1]
    return np.stack([c * x + s * y, c * y - s * x, away[..., 2]], axis=-1)
