"""What `--actuator` means: intervals of twelve servos, from a calibration, a preset or nothing."""

import math

import numpy as np
import pytest

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_ranges
from support.calibration_examples import calibration, joint_calibration

TORQUES = ("stiffness", "damping", "friction_loss", "armature", "effort_limit")


def ranges_of(tmp_path, found: Calibration | None = None, **options) -> ServoRanges:
    path = tmp_path / "calibrated.yaml"
    (found or calibration()).save(path, force=True)
    return servo_ranges(path, **options)


def test_an_interval_of_the_calibration_is_the_range_and_a_number_without_one_is_itself(tmp_path):
    ranges = ranges_of(tmp_path)
    # calibration_examples: delay 0.025 ± 10 %, identified
    assert ranges.low["dead_time_s"][0] == pytest.approx(0.0225)
    assert ranges.value["dead_time_s"][0] == 0.025
    assert ranges.high["dead_time_s"][0] == pytest.approx(0.0275)
    assert ranges.longest_dead_time_s == pytest.approx(0.0275)
    for field, value in (("stiffness", 11.0), ("effort_limit", 0.35), ("velocity_limit", 7.6)):
        for end in (ranges.low, ranges.value, ranges.high):
            np.testing.assert_array_equal(end[field], value)


def test_presets_delays_are_their_whole_physics_steps():
    # facts/paper.md 2: 76 ms as 33 to 43 steps of 2 ms; released: 26 to 31 steps
    for preset, steps, stiffness, effort in (
        ("paper", (33, 43), 70.0, 5.0), ("release", (26, 31), 80.0, 0.7),
    ):  # fmt: skip
        ranges = servo_ranges(preset)
        np.testing.assert_allclose(ranges.low["dead_time_s"], steps[0] * 0.002)
        np.testing.assert_allclose(ranges.high["dead_time_s"], steps[1] * 0.002)
        np.testing.assert_array_equal(ranges.value["stiffness"], stiffness)
        np.testing.assert_array_equal(ranges.high["effort_limit"], effort)
        assert ranges.fallbacks == {}
        assert set(ranges.feedback) == {HeldFeedback()}


def test_joints_without_a_calibration_fall_back_on_their_kind_then_their_leg_then_any(tmp_path):
    joints = {
        "LF_hip": joint_calibration(5.0),
        "RB_thigh": joint_calibration(6.0),
        "LF_calf": joint_calibration(7.0),
    }
    ranges = ranges_of(tmp_path, calibration(**joints))
    expected = {"hip": 5.0, "thigh": 6.0, "calf": 7.0}
    for name, stiffness in zip(JOINT_NAMES, ranges.value["stiffness"], strict=True):
        assert stiffness == expected[name.split("_")[1]]
    nearest = {"hip": "LF_hip", "thigh": "RB_thigh", "calf": "LF_calf"}
    assert ranges.fallbacks == {
        name: nearest[name.split("_")[1]] for name in JOINT_NAMES if name not in joints
    }
    del joints["LF_calf"]
    fallbacks = ranges_of(tmp_path, calibration(**joints)).fallbacks
    assert (fallbacks["LF_calf"], fallbacks["RB_calf"]) == ("LF_hip", "RB_thigh")
    bench = ranges_of(tmp_path, calibration(bench=joint_calibration(5.0)))
    assert bench.fallbacks == dict.fromkeys(JOINT_NAMES, "bench")


def test_feedback_comes_with_the_calibration_and_can_be_exchanged(tmp_path):
    held = ranges_of(tmp_path).feedback
    expected = HeldFeedback(0.02685, 0.42, math.pi / 550, 0.0)  # an offset is of its recording
    assert held == (expected,) * 12
    path = tmp_path / "calibrated.yaml"
    assert servo_ranges(path, feedback="ideal").feedback == (HeldFeedback(),) * 12
    assert servo_ranges("paper", feedback=path).feedback == (expected,) * 12
    np.testing.assert_array_equal(servo_ranges("paper", feedback=path).value["stiffness"], 70.0)


def test_later_moves_every_delay_and_nothing_else_and_none_becomes_negative():
    for actuator in ("paper", "ideal"):
        before = servo_ranges(actuator)
        after = before.later(0.04)
        for name in ("low", "value", "high"):
            old, new = getattr(before, name), getattr(after, name)
            np.testing.assert_allclose(new["dead_time_s"], old["dead_time_s"] + 0.04)
            for field in old.keys() - {"dead_time_s"}:
                np.testing.assert_array_equal(new[field], old[field])
        assert after.longest_dead_time_s == pytest.approx(before.longest_dead_time_s + 0.04)
        assert servo_ranges(actuator).longest_dead_time_s == before.longest_dead_time_s
    ranges = servo_ranges("paper").later(-1.0)
    assert not ranges.low["dead_time_s"].any() and not ranges.high["dead_time_s"].any()


def test_drawn_numbers_fill_their_intervals_and_never_leave_them():
    ranges = servo_ranges("data/samples/calibrated.yaml")
    drawn = ranges.draw(500, (1.0, 1.0), np.random.default_rng(0))
    for field, values in drawn.items():
        low, high = ranges.low[field], ranges.high[field]
        assert values.shape == (500, 12)
        assert (values >= low).all() and (values <= high).all(), field
        # of 500 uniform numbers the extremes are within 3 % of the ends but for e⁻¹⁵ of times
        assert (np.ptp(values, axis=0) >= 0.94 * (high - low)).all(), field


def test_the_torque_scale_is_one_factor_per_robot_on_all_torques_and_the_armature():
    ranges = servo_ranges("paper")
    drawn = ranges.draw(200, (0.5, 2.0), np.random.default_rng(0))
    factor = drawn["stiffness"] / 70.0
    np.testing.assert_allclose(factor, np.broadcast_to(factor[:, :1], factor.shape))
    assert 0.5 <= factor.min() < 0.6 and 1.9 < factor.max() <= 2.0
    for field in TORQUES:
        np.testing.assert_allclose(drawn[field], factor * ranges.value[field], err_msg=field)
    np.testing.assert_array_equal(drawn["velocity_limit"], 10.5)
    assert drawn["dead_time_s"].max() <= 0.086
    # drawing leaves the ranges as they were
    np.testing.assert_array_equal(ranges.value["stiffness"], 70.0)
    np.testing.assert_array_equal(ranges.high["armature"], 0.005)
