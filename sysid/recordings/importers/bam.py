"""BAM and K-Scale logs: one servo, mostly with a pendulum, as JSON with `entries`.

    {"mass": 0.49, "length": 0.1, "arm_mass": 0, "kp": 100, "vin": 7.4, "motor": "xl330",
     "trajectory": "sin_sin", "entries": [{"timestamp": 0.0035, "position": 0.0,
     "goal_position": 0.0, "torque_enable": true, "input_volts": 7.3, …}, …]}

Angles in rad, 0 hangs, times in s. A turn of BAM's loop writes the goal, sleeps 1 ms and reads;
`timestamp` is the middle of the read. The XL330 is read register by register, the position first,
so its position is older than the stamp; other servos are read in one block.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.importers.log import (
    Log,
    joint_names,
    number,
    numbers,
    rows,
)

LAYOUT = "BAM JSON"

_SLEEP_S = 0.00106  # sleep(0.001) as Linux keeps it
_REGISTERS = {"xl330": 5}  # reads of one register each, the position first
_NUMBERS = ("mass", "length", "kp", "vin")


def is_bam(data: Any) -> bool:
    """Whether JSON `data` is such a log."""
    return isinstance(data, dict) and isinstance(data.get("entries"), list)


def read_bam(path: Path, data: dict[str, Any]) -> Log:
    """The log as rows; mass, length, gain and voltage go into the header.

    Raises
    ------
    InputError
        If entries are missing or are no numbers.
    """
    entries = data["entries"]
    if not entries:
        raise InputError(f"{path}: entries is empty, so nothing was recorded. Record it again.")
    stamp = numbers(path, entries, "timestamp", "entries")
    position = numbers(path, entries, "position", "entries", missing=True)
    command = numbers(path, entries, "goal_position", "entries")
    torque = numbers(path, entries, "torque_enable", "entries", missing=True)
    voltage = numbers(path, entries, "input_volts", "entries", missing=True)
    motor = str(data.get("motor") or "servo")
    known = {k: number(path, data[k], k) for k in _NUMBERS if data.get(k) is not None}
    (joint,) = joint_names(path, [motor])
    reads = next((n for m, n in _REGISTERS.items() if motor.lower().startswith(m)), 1)
    on = torque != 0  # a log without the entry had its torque on
    loop = float(np.median(np.diff(stamp)[on[1:]])) if on[1:].any() else 0.0
    each = max(loop - _SLEEP_S, 0.0) / (reads + 1)  # a write and the reads take about as long
    started = stamp - reads * each / 2
    optional: dict[str, Any] = {}
    if not on.all():
        optional["torque_enabled"] = on.astype(float)
    if np.isfinite(voltage).any():
        optional["voltage_v"] = voltage
    gain = known.get("kp")
    if gain is not None:
        optional["p_gain"] = gain
    metadata: dict[str, Any] = {
        "imported_from": LAYOUT,
        "joints": [joint],
        "readings": "live",
        "bus": {"read_time_doubt_s": each if reads > 1 else max(loop - _SLEEP_S, 0.0) / 2},
        "servos": {joint: {"model": motor}},
    }
    if gain is not None:
        metadata["servos"][joint]["p_gain"] = gain
    if known.get("vin", 0) > 0:
        metadata["servos"][joint]["supply_voltage_v"] = known["vin"]
    if "mass" in known and "length" in known:
        arm = number(path, data["arm_mass"], "arm_mass") if data.get("arm_mass") else 0.0
        metadata["loads"] = {
            joint: {"mass_kg": known["mass"], "length_m": known["length"], "arm_mass_kg": arm}
        }
    if isinstance(data.get("trajectory"), str):
        metadata["trajectory"] = data["trajectory"][:80]
    table = rows(
        joint, started - _SLEEP_S - each / 2, started + each / 2, command, position, **optional
    )
    return Log(table, metadata)
