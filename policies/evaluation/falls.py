"""Falls, and what came before them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result
from pupper_sysid.policies.walks.conditions import Condition, Walker
from pupper_sysid.sim.walking.observation import FALLEN_TILT

Array = NDArray[np.float64]

BEFORE_S = 0.2
"""How long before a fall the tilt is taken [s]."""

Direction = Literal["forward", "backward", "left", "right"]


@dataclass(frozen=True, kw_only=True)
class Fall(Result):
    """One fall."""

    row: str
    """Name of the condition."""
    walker: Walker
    episode: int
    time_s: float
    """Since the start of the episode."""
    tilt_before_deg: float
    """Between the trunk and the ground, 0.2 s before the fall."""
    tilt_deg: float
    """At the fall."""
    toward: Direction
    """To which side the trunk tilts at the fall."""
    tipped: bool
    """Whether it tipped over; otherwise trunk, hips or thighs touched the ground."""
    command: tuple[float, float, float]
    """Forward and sideways speed [m/s], turn rate [rad/s], at the fall."""
    since_push_s: float | None
    """Time since the last push; null without one."""


def falls_of(
    row: str, condition: Condition, fell: NDArray[np.bool_], alive: NDArray[np.bool_],
    gravity: Array, command: Array,
) -> list[Fall]:  # fmt: skip
    """Falls of the robots of a condition.

    Parameters
    ----------
    row : str
    condition : Condition
    fell : ndarray of bool, shape (n,)
    alive : ndarray of bool, shape (steps, n)
    gravity : ndarray, shape (steps, n, 3)
        The ground's normal, downwards, in the trunk's frame.
    command : ndarray, shape (steps, n, 3)
    """
    step_s = condition.task.control_step_s
    before = round(BEFORE_S / step_s)
    found = []
    for i in np.flatnonzero(fell).tolist():
        at = int(alive[:, i].sum())
        x, y, down = gravity[at, i]
        time_s = (at + 1) * step_s
        found.append(
            Fall(
                row=row, walker=condition.walker, episode=i, time_s=time_s,
                tilt_before_deg=_tilt_deg(gravity[max(at - before, 0), i]),
                tilt_deg=_tilt_deg(gravity[at, i]), toward=_toward(float(x), float(y)),
                tipped=bool(down > -FALLEN_TILT), command=tuple(command[at, i].tolist()),
                since_push_s=condition.handicap.since_push_s(time_s),
            )
        )  # fmt: skip
    return found


def _tilt_deg(gravity: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(-gravity[2], -1.0, 1.0))))


def _toward(x: float, y: float) -> Direction:
    """Side of gravity in the trunk's frame, which is that to which it tilts."""
    if abs(x) >= abs(y):
        return "forward" if x > 0 else "backward"
    return "left" if y > 0 else "right"


@dataclass(frozen=True, kw_only=True)
class FallsOfRow(Result):
    """Falls of one walker under one condition, in short."""

    row: str
    walker: Walker
    falls: int
    time_s: float
    """Median."""
    tilt_before_deg: float
    """Median."""
    toward: Direction
    """Most frequent."""
    tipped: int
    after_push: int
    """Within 1 s of a push."""


def in_short(falls: Sequence[Fall]) -> list[FallsOfRow]:
    """Falls by condition and walker, in their order."""
    groups: dict[tuple[str, Walker], list[Fall]] = {}
    for fall in falls:
        groups.setdefault((fall.row, fall.walker), []).append(fall)
    found = []
    for (row, walker), own in groups.items():
        sides: list[Direction] = [fall.toward for fall in own]
        pushed = [f.since_push_s for f in own if f.since_push_s is not None]
        found.append(
            FallsOfRow(
                row=row, walker=walker, falls=len(own),
                time_s=float(np.median([f.time_s for f in own])),
                tilt_before_deg=float(np.median([f.tilt_before_deg for f in own])),
                toward=max(sides, key=lambda side: sides.count(side)),
                tipped=sum(f.tipped for f in own),
                after_push=sum(since <= 1.0 for since in pushed),
            )
        )  # fmt: skip
    return found
