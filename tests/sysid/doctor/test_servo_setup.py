"""Registers that make a servo follow a trajectory of its own are named, with their limit."""

import numpy as np
import pandas as pd

from pupper_sysid.sysid.doctor.checks import register_findings, setup_findings
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.recordings.servo_setup import ServoSetup


def of(**registers: int) -> list[str]:
    return [f.text for f in setup_findings(ServoSetup(model="STS3215", registers=registers))]


def test_registers_that_leave_the_command_as_it_is_are_not_named():
    assert of(acceleration=0, goal_speed=0) == [] == setup_findings(ServoSetup())
    # 5000 counts/s are 7.7 rad/s, more than the servo does
    assert of(goal_speed=5000) == []


def test_a_ramp_is_named_with_its_limit_in_radians():
    (text,) = of(acceleration=50)
    assert f"{50 * 100 * 2 * np.pi / 4096:.1f} rad/s²" in text and "Write 0 into" in text
    (text,) = of(goal_speed=1500)
    assert f"{1500 * 2 * np.pi / 4096:.2f} rad/s" in text
    assert len(of(acceleration=20, goal_speed=400)) == 2
    assert "ms for each command" in of(goal_time=100)[0]


def test_the_largest_acceleration_that_lerobot_writes_counts_in_fast_motion_only():
    setup = ServoSetup(model="STS3215", registers={"acceleration": 254})
    assert setup_findings(setup, 0.1) == []
    (found,) = setup_findings(setup, 1.5)
    assert "39.0 rad/s², a lag of up to 19 ms at 1.5 rad/s" in found.text


def test_the_limits_that_a_header_states_are_named_by_the_registers_of_its_servo():
    registers = {"profile_velocity": 100, "profile_acceleration": 20}
    stated = {"set_point_speed_rad_s": 2.4, "set_point_acceleration_rad_s2": 7.5}
    setup = ServoSetup(model="XL330-M288", registers=registers, **stated)
    texts = [found.text for found in setup_findings(setup, 1.5)]
    assert "profile_acceleration" in texts[0] and "7.5 rad/s²" in texts[0]
    assert "profile_velocity" in texts[1] and "2.40 rad/s" in texts[1]
    timed = ServoSetup(model="XL330-M288", registers=registers, set_point_duration_s=0.1)
    (found,) = setup_findings(timed, 1.5)
    assert "profile_velocity is 100 (100 ms for each command)" in found.text
    assert timed.set_point_acceleration_rad_s2 is None, (
        "a ramp, but not one of limited acceleration"
    )
    unlimited = ServoSetup(model="XL330-M288", registers=dict.fromkeys(registers, 0))
    assert setup_findings(unlimited, 1.5) == []
    assert unlimited.set_point_acceleration_rad_s2 == np.inf


def test_the_speed_is_that_of_the_recorded_motion():
    time = 0.02 * np.arange(500)
    for amplitude, named in ((0.01, False), (0.5, True)):
        position = amplitude * np.sin(2 * np.pi * 0.7 * time)
        table = pd.DataFrame({
            "send_time_s": time, "read_time_s": time + 0.002, "command_rad": position,
            "position_rad": position, "joint": "wrist", "trial": 0, "frequency_hz": np.nan,
        })  # fmt: skip
        servos = {"wrist": {"model": "STS3215", "registers": {"acceleration": 254}}}
        header = {"readings": "live", "servos": servos, "joints": ["wrist"]}
        recording = Recording.from_frame(table, metadata=header, name="wrist")
        assert bool(register_findings(recording.trials("wrist"), 0.0)) is named
