"""Torque anchor of a joint: given, of the recorded servo's data sheet, or the Mini Pupper's."""

from __future__ import annotations

import numpy as np
import pytest

from pupper_sysid.common.joints import STALL_TORQUE_NM, STALL_TORQUE_SOURCE
from pupper_sysid.sysid.identify.calibration_file import GIVEN_TORQUE, torque_anchors
from pupper_sysid.sysid.recordings.recording import Recording


def recorded(**servos) -> Recording:
    time = 0.02 * np.arange(60)
    swing = np.sin(6 * time)
    both = {"knee": swing, "wrist": swing}
    return Recording.from_arrays(time, both, both, metadata={"servos": servos})


def test_each_joint_has_the_stall_torque_of_its_own_servo():
    arm = recorded(knee={"model": "STS3215", "supply_voltage_v": 12.0})
    found = torque_anchors(["knee", "wrist"], [arm])
    # 30 kg·cm
    assert found["knee"][0] == pytest.approx(30 * 0.0980665) and "C018" in found["knee"][1]
    assert found["wrist"] == (STALL_TORQUE_NM, STALL_TORQUE_SOURCE)


def test_a_given_torque_is_that_of_all_joints():
    arm = recorded(knee={"model": "STS3215"})
    found = torque_anchors(["knee", "wrist"], [arm], 2.0)
    assert found == dict.fromkeys(("knee", "wrist"), (2.0, GIVEN_TORQUE))
