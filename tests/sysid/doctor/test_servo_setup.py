"""Registers that make a servo follow a trajectory of its own are named, with their limit."""

import numpy as np
import pytest

from pupper_sysid.sysid.doctor.servo_setup import setup_findings
from pupper_sysid.sysid.recordings.servo_setup import ServoSetup


def of(**registers: int) -> list[str]:
    return [f.text for f in setup_findings(ServoSetup(model="STS3215", registers=registers))]


@pytest.mark.parametrize("acceleration", [0, 254])
def test_registers_that_leave_the_command_as_it_is_are_not_named(acceleration):
    assert of(acceleration=acceleration, goal_speed=0) == [] == setup_findings(ServoSetup())
    # 5000 counts/s are 7.7 rad/s, more than the servo does
    assert of(goal_speed=5000) == []


def test_a_ramp_is_named_with_its_limit_in_radians():
    (text,) = of(acceleration=50)
    assert f"{50 * 100 * 2 * np.pi / 4096:.1f} rad/s²" in text and "Write 0 or 254" in text
    (text,) = of(goal_speed=1500)
    assert f"{1500 * 2 * np.pi / 4096:.2f} rad/s" in text
    assert len(of(acceleration=20, goal_speed=400)) == 2
    assert "ms for each command" in of(goal_time=100)[0]
