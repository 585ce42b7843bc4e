"""K-Scale ktune logs: one actuator's chirp or step as JSON, angles in degrees.

    {"config": {"actuator_id": 41, "kp": 150.0, "kd": 8.0, …},
     "data": [{"time_since_start": 0.0006, "position": 0.05, "commanded_position": 0.0, …}, …]}

Each row has one time stamp, and the log does not say when in a turn the command was sent and the
position read: lag and dead time are in doubt by half a turn.
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
from pupper_sysid.sysid.recordings.importers.times import doubt_of_a_turn

LAYOUT = "ktune JSON"


def is_ktune(data: Any) -> bool:
    """Whether JSON `data` is such a log."""
    return (
        isinstance(data, dict)
        and isinstance(data.get("data"), list)
        and isinstance(data.get("config", {}), dict)
    )


def read_ktune(path: Path, data: dict[str, Any]) -> Log:
    """The log as rows of the joint `actuator_<id>`.

    Raises
    ------
    InputError
        If rows are missing or are no numbers.
    """
    entries, config = data["data"], data.get("config", {})
    if not entries:
        raise InputError(f"{path}: data is empty, so nothing was recorded. Record it again.")
    stamp = numbers(path, entries, "time_since_start", "data")
    command = np.deg2rad(numbers(path, entries, "commanded_position", "data"))
    position = np.deg2rad(numbers(path, entries, "position", "data", missing=True))
    (joint,) = joint_names(path, [f"actuator_{config.get('actuator_id', 0)}"])
    gains = {
        name: number(path, config[key], f"config.{key}")
        for name, key in (("p_gain", "kp"), ("d_gain", "kd"))
        if config.get(key) is not None
    }
    doubt, text = doubt_of_a_turn(stamp)
    metadata = {
        "imported_from": LAYOUT,
        "joints": [joint],
        "bus": {"read_time_doubt_s": doubt},
        "servos": {joint: gains},
    }
    gain = {"p_gain": gains["p_gain"]} if "p_gain" in gains else {}
    return Log(rows(joint, stamp, stamp, command, position, **gain), metadata, [text])
