"""One control step of the walking environment: its result, and what it is filled into meanwhile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.robot.robot_batch import FEET
from pupper_sysid.sim.walking.rewards import Step

Array = NDArray[np.float64]

_COLUMNS = {
    "linear_velocity": 3, "angular_velocity": 3, "gravity": 3, "position_relative": 12,
    "velocity": 12, "acceleration": 12, "torque": 12, "air_s": FEET, "contact_s": FEET,
    "last_air_s": FEET, "last_contact_s": FEET, "foot_height_m": FEET, "foot_speed_m_s": FEET,
    "stride_velocity": 3, "clock": 3,
}  # fmt: skip
_FLAGS = ("contact", "landed", "lifted")


@dataclass(frozen=True)
class StepResult:
    """What one step gave.

    Attributes
    ----------
    observation : ndarray of float32, shape (n, 60)
    privileged : ndarray of float32, shape (n, k)
        The truth, for a critic.
    reward : ndarray, shape (n,)
    done, timed_out : ndarray of bool, shape (n,)
        Episode over; over because its time was up.
    terms : dict of str to ndarray, shape (n,)
        Each reward term, weighted and times the control period.
    terminal : dict of str to ndarray
        `ids` of environments whose time was up, and their last `observation` and `privileged`.
    facts : Step
        What happened, before any new episode.
    """

    observation: NDArray[np.float32]
    privileged: NDArray[np.float32]
    reward: Array
    done: NDArray[np.bool_]
    timed_out: NDArray[np.bool_]
    terms: dict[str, Array]
    terminal: dict[str, NDArray]
    facts: Step


@dataclass(frozen=True)
class Unfinished:
    """A step that goes on: what was drawn for it, and arrays that parts of the robots fill in."""

    velocity_before: Array
    chances: Array
    noise: NDArray[np.float32] | None
    pushed: NDArray[np.intp]
    push: Array
    facts: dict[str, Any]
    terms: dict[str, Array]
    observation: NDArray[np.float32]
    privileged: NDArray[np.float32]
    fallen: NDArray[np.bool_]


def empty_facts(
    command: Array, action: Array, last_action: Array, earlier_action: Array
) -> dict[str, Any]:
    """Arrays of a `rewards.Step` that are to be filled in; the given ones are copied."""
    found: dict[str, Any] = {
        "command": command.copy(), "action": action.copy(), "last_action": last_action.copy(),
        "earlier_action": earlier_action.copy(),
    }  # fmt: skip
    found |= {name: np.empty((len(command), size)) for name, size in _COLUMNS.items()}
    return found | {name: np.empty((len(command), FEET), bool) for name in _FLAGS}
