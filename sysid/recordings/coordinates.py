"""Knees in servo coordinates: the calf's servo of a parallel linkage turns the calf and the thigh.

In joint coordinates (`hardware.joint_map`) a calf's angle is relative to its thigh, but its servo
holds thigh + calf, and a servo model is one of the servo. `in_servo_coordinates` adds command and
reading of the thigh, which the bus had subtracted, so that commands and readings of a calf are its
servo's, with the thigh at its neutral. It does so where the header says `coordinates: joint` and
the joint map has the linkage; recordings of this project's commands are in servo coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.hardware.joint_map import PRESETS, load_joint_map

if TYPE_CHECKING:
    from pupper_sysid.sysid.recordings.recording import Trial


def in_servo_coordinates(
    trials: Mapping[str, list[Trial]], bus: Mapping[str, Any]
) -> dict[str, list[Trial]]:
    """Trials by joint, each calf on a linkage as its servo moves it.

    Parameters
    ----------
    trials : mapping of joint to list of Trial
    bus : mapping
        Entry of the recording's header: `coordinates`, and `linkage` or the name of a joint map.

    Returns
    -------
    dict of joint to list of Trial
        A calf that was recorded without its thigh stays as it is: a thigh that does not move
        changes its offset only. Rows without one of the thigh at the same time are left out.
    """
    if bus.get("coordinates") != "joint":
        return dict(trials)
    preset = load_joint_map(bus["joint_map"]).file if bus.get("joint_map") in PRESETS else None
    linkage = bus.get("linkage", preset.linkage if preset else "none")
    if linkage == "none":
        return dict(trials)
    found = dict(trials)
    for joint, own in trials.items():
        thigh = joint.replace("calf", "thigh")
        if joint.endswith("_calf") and thigh in trials:
            known = preset.joints[thigh].neutral_rad if preset else DEFAULT_POSE.get(thigh, 0.0)
            partners = {trial.number: trial for trial in trials[thigh]}
            found[joint] = [
                _joined(t, partners[t.number], known) if t.number in partners else t for t in own
            ]
    return found


def _joined(calf: Trial, thigh: Trial, neutral: float) -> Trial:
    """The calf's trial in servo coordinates."""
    _, own, other = np.intersect1d(calf.send_time_s, thigh.send_time_s, return_indices=True)
    count = calf.position_count
    return replace(
        calf,
        send_time_s=calf.send_time_s[own],
        read_time_s=calf.read_time_s[own],
        command_rad=calf.command_rad[own] + thigh.command_rad[other] - neutral,
        position_rad=calf.position_rad[own] + thigh.position_rad[other] - neutral,
        position_count=None if count is None else count[own],
        torque_enabled=None if calf.torque_enabled is None else calf.torque_enabled[own],
        voltage_v=None if calf.voltage_v is None else calf.voltage_v[own],
        initial_command_rad=calf.initial_command_rad + thigh.initial_command_rad - neutral,
    )
