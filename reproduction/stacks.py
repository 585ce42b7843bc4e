"""Deployment stacks side by side: the same emulated robots, walked by the same policy.

Each stack walks the same robots under the same commands. A servo model is one robot's, and walks
only that one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.policies.analysis.rhythm import mean_of
from pupper_sysid.policies.deploy.emulated_walk import walk_once
from pupper_sysid.policies.deploy.stacks import Stack
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.tracking import ERRORS


@dataclass(frozen=True)
class Walker:
    """One robot for one round of walks: its seed, its servo model, and the seed of the noise."""

    seed: int
    servo: Path | None = None
    noise: int = 0


def compare_stacks(
    policy: Policy,
    stacks: Mapping[str, Stack],
    walkers: Sequence[Walker],
    commands: Sequence[tuple[float, float, float]],
    seconds: float,
    actuator: str,
    progress: Callable[[str], None] = lambda what: None,
) -> list[dict[str, Any]]:
    """Walk each robot with each stack.

    Parameters
    ----------
    policy : Policy
    stacks : dict of str to Stack
    walkers : sequence of Walker
    commands : sequence of (float, float, float)
        One after the other, a walk each; a walker's errors are means over them.
    seconds : float
        Of each walk.
    actuator : str
    progress : callable
        Called with the name of the next walk.

    Returns
    -------
    list of dict
        `stack`, `falls` (share of walks), `mae_vx_m_s`, `mae_vy_m_s`, `mae_yaw_rad_s` as Interval
        over walkers, and from the second stack on `less_...`: this stack's error less the first
        one's, walker by walker.
    """
    found: list[dict[str, Any]] = []
    first: np.ndarray | None = None
    for name, stack in stacks.items():
        errors, falls = [], []
        for walker in walkers:
            progress(f"{name}, robot {walker.seed}, round {walker.noise}")
            servo = walker.servo if stack.observer == "servo-model" else None
            each = []
            for command in commands:
                outcome, score = walk_once(
                    policy, stack, command, seconds, walker.seed, actuator, servo,
                    noise=walker.noise,
                )  # fmt: skip
                falls.append(outcome.fell)
                summary = score.summary()
                each.append([summary[key] for key in ERRORS])
            errors.append(np.mean(np.array(each, float), axis=0))
        table = np.array(errors)
        row: dict[str, Any] = {"stack": name, "falls": float(np.mean(falls))}
        row |= _means("", table)
        if first is not None:
            row |= _means("less_", table - first)
        first = table if first is None else first
        found.append(row)
    return found


def _means(prefix: str, table: np.ndarray) -> dict[str, Any]:
    """A mean over walkers per error."""
    named = zip(ERRORS, table.T, strict=True)
    return {prefix + key: mean_of(column) for key, column in named}
