"""Whether a servo's registers make it follow a trajectory of its own instead of the command.

With a finite acceleration or goal speed a Feetech servo ramps its set-point: what is identified
then is the ramp, and no motor model explains it. `setup_findings` reads `ServoSetup` alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pupper_sysid.sysid.doctor.findings import CARE, Finding
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.recordings.servo_setup import ServoSetup

_COUNT_RAD = {"STS3215": math.tau / 4096, "SCS0009": math.radians(300) / 1024}
_ACCELERATION_UNIT = 100  # counts/s² per unit of the register
_FAST_ENOUGH = 250  # of the acceleration register, whose largest value is 254
_SERVO_RAD_S = 7.5  # no servo of this size follows a faster set-point


def setup_findings(setup: ServoSetup) -> list[Finding]:
    """Registers of `setup` that shape the motion, each with its cure."""
    found, registers = [], setup.registers
    count_rad = _COUNT_RAD.get(setup.model or "", _COUNT_RAD["STS3215"])
    acceleration = registers.get("acceleration", 0)
    if 0 < acceleration < _FAST_ENOUGH:
        limit = acceleration * _ACCELERATION_UNIT * count_rad
        found.append(_shaped("acceleration", acceleration, f"{limit:.1f} rad/s²", "0 or 254"))
    speed = registers.get("goal_speed", 0)
    if 0 < speed * count_rad < _SERVO_RAD_S:
        found.append(_shaped("goal_speed", speed, f"{speed * count_rad:.2f} rad/s", "0"))
    duration = registers.get("goal_time", 0)
    if duration > 0 and speed == 0:
        found.append(_shaped("goal_time", duration, f"{duration} ms for each command", "0"))
    return found


def register_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """`setup_findings` of all trials, each once."""
    return list(dict.fromkeys(f for trial in trials for f in setup_findings(trial.servo)))


def _shaped(register: str, value: int, limit: str, cure: str) -> Finding:
    return Finding(
        CARE,
        f"the servo's register {register} is {value} ({limit}): it then moves its set-point by "
        "itself, and what is measured is this trajectory, not the servo. Write "
        f"{cure} into {register} and record again.",
    )
