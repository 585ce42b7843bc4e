"""Whether a servo's registers make it follow a trajectory of its own instead of the command.

With a finite acceleration or goal speed a Feetech servo ramps its set-point: what is identified
then is the ramp, and no motor model explains it. `setup_findings` reads `ServoSetup` alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pupper_sysid.sysid.doctor.findings import CARE, Finding
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.recordings.servo_setup import ServoSetup

_COUNT_RAD = {"STS3215": math.tau / 4096, "SCS0009": math.radians(300) / 1024}
_LEAST_LAG_S = 0.002
_SERVO_RAD_S = 7.5  # no servo of this size follows a faster set-point
_OVER_S = 0.1


def setup_findings(setup: ServoSetup, speed_rad_s: float = _SERVO_RAD_S) -> list[Finding]:
    """Registers of `setup` that shape the motion, each with its cure.

    A set-point that must be able to stop on the command follows a speed v at a distance of v² over
    twice its acceleration limit, which is a lag of v over twice the limit.

    Parameters
    ----------
    setup : ServoSetup
    speed_rad_s : float
        Speed of the fast parts of the motion [rad/s].
    """
    found, registers = [], setup.registers
    count_rad = _COUNT_RAD.get(setup.model or "", _COUNT_RAD["STS3215"])
    limit = setup.set_point_acceleration_rad_s2
    if limit is not None and (lag_s := speed_rad_s / (2 * limit)) > _LEAST_LAG_S:
        said = f"{limit:.1f} rad/s², a lag of up to {1e3 * lag_s:.0f} ms at {speed_rad_s:.1f} rad/s"
        found.append(_shaped("acceleration", registers["acceleration"], said, "0"))
    speed = registers.get("goal_speed", 0)
    if 0 < speed * count_rad < _SERVO_RAD_S:
        found.append(_shaped("goal_speed", speed, f"{speed * count_rad:.2f} rad/s", "0"))
    duration = registers.get("goal_time", 0)
    if duration > 0 and speed == 0:
        found.append(_shaped("goal_time", duration, f"{duration} ms for each command", "0"))
    return found


def register_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """`setup_findings` of all trials, each once."""
    speed = max((_speed(trial) for trial in trials), default=0.0)
    return list(dict.fromkeys(f for trial in trials for f in setup_findings(trial.servo, speed)))


def _speed(trial: Trial) -> float:
    """Speed of the fast parts of a trial [rad/s], from readings a tenth of a second apart."""
    read = np.isfinite(trial.position_rad) & np.isfinite(trial.read_time_s)
    time, position = trial.read_time_s[read], trial.position_rad[read]
    if len(time) < 2 or time[-1] - time[0] < _OVER_S:
        return 0.0
    grid = np.arange(time[0], time[-1], _OVER_S)
    return float(np.percentile(np.abs(np.diff(np.interp(grid, time, position))), 95) / _OVER_S)


def _shaped(register: str, value: int, limit: str, cure: str) -> Finding:
    return Finding(
        "own_trajectory", CARE, {"register": register, "value": value, "limit": limit, "cure": cure}
    )
