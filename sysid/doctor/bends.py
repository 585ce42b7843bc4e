"""A joint that its friction holds, or that stays at an end of its motion.

`held_findings` looks at the servo with limits that explains the readings (`changes`): its friction
is a fault where the joint rests through a large part of the command's range. Where no servo
explains them, readings that dwell at an extreme of their trial tell of something in the way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.doctor.changes import followed
from pupper_sysid.sysid.doctor.findings import CARE, Finding
from pupper_sysid.sysid.recordings.recording import Trial

_HELD = 0.4  # of the command's range, to and fro
_REST_TRAVEL = 0.15  # of the command's range, during one rest
_FEWEST_RESTS = 2
_PINNED, _ENOUGH_TRIALS = (0.10, 0.20), 3  # share of readings at an extreme, beyond the command's


def held_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Friction that holds the joint, or motion that something in its way ends."""
    joint = None if any(t.load is not None for t in trials) else followed(trials, step)
    if joint is None:
        return []  # a known load sags, and its friction is fitted
    travel = 0.0 if joint.changes else 2 * joint.friction_rad  # a stop holds as well
    if travel > _HELD * joint.reach:
        rests = [r for t in trials for r in _rests(t, step)]
        if len(rests) >= _FEWEST_RESTS:
            values = {"longest_s": max(rests), "travel_rad": travel}
            return [Finding("held_by_friction", CARE, values)]
    return [] if joint.explained or joint.changes else _pinned(trials, step)


def _rests(trial: Trial, step: float) -> list[float]:
    """Times for which the reading stays and the command moves by much of its range [s]."""
    seen = np.isfinite(trial.position_rad)
    value, time = trial.position_rad[seen], trial.read_time_s[seen]
    command, found, first = trial.command_rad[seen], [], 0
    near = max(1.5 * step, 0.01 * float(np.ptp(value))) if len(value) else 0.0
    least = _REST_TRAVEL * float(np.ptp(trial.command_rad))
    for k in range(1, len(value) + 1):
        if k < len(value) and abs(value[k] - value[first]) <= near:
            continue
        if k - first > 3 and first > 0 and np.ptp(command[first:k]) > least:
            found.append(float(time[k - 1] - time[first]))
        first = k
    return found


def _pinned(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Readings that stay at an extreme of their trial, in every trial or by much.

    Something stands in the way in a part of the recording, such as an object in a gripper, where
    no level explains the whole.
    """
    excess = [_dwell(t, step) for t in trials]
    pinned = [e for e in excess if e > _PINNED[0]]
    often = 2 * len(pinned) > len(excess) >= _ENOUGH_TRIALS
    if not pinned or (max(excess) < _PINNED[1] and not often):
        return []
    values = {"trials": len(pinned), "of": len(trials), "percent": 100 * max(pinned)}
    return [Finding("pinned", CARE, values)]


def _dwell(trial: Trial, step: float) -> float:
    """Share of readings at an extreme of the trial, beyond the share of the command at its own."""
    position = trial.position_rad[np.isfinite(trial.position_rad)]
    if len(position) < 20 or np.ptp(position) < 10 * max(step, 1e-6):
        return 0.0
    near = max(1.5 * step, 0.01 * float(np.ptp(position)))

    def shares(value: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([np.mean(value < value.min() + near), np.mean(value > value.max() - near)])

    return float(np.max(shares(position) - shares(trial.command_rad)))
