"""The arithmetic of calibrating joints, worked out by hand."""

import numpy as np

from pupper_sysid.hardware import joint_calibration as jc
from pupper_sysid.hardware.joint_map import load_joint_map
from support.refusals import assert_each_refused

DATE = "2026-11-21"
PRESET = load_joint_map("mini_pupper_2")


def travel_of(*counts, encoder=1024):
    """The travel of one joint that was read at these counts, each twice."""
    travel = jc.Travel(1, encoder)
    for count in np.repeat(counts, 2):
        travel.add(np.array([count]))
    return travel


def refusal(travel):
    return travel.refusals(("LF_hip",)).get("LF_hip", "")


def test_the_published_scales_differ_by_more_than_two_degrees_and_a_range_is_an_angle_of_servos():
    vendor, data_sheet = 550 / np.pi, 1024 / np.radians(300)
    assert not jc.scales_agree(data_sheet, vendor)  # 11.7 % apart
    assert jc.scales_agree(vendor * 92 / 90, vendor)
    assert "300 degrees" in (jc.known_scale_near(data_sheet * 0.99, 1024) or "")
    assert "550/pi" in (jc.known_scale_near(vendor * 1.01, 1024) or "")
    assert jc.known_scale_near(240.0, 1024) is None
    for scale, counts, plausible in (
        (326.0, 1024, True), (4096 / (2 * np.pi), 4096, True),  # 180 degrees, a turn
        (20.0, 1024, False), (0.0, 1024, False),
    ):  # fmt: skip
        assert jc.is_plausible_scale(scale, counts) == plausible


def test_one_reading_alone_is_no_end_of_the_travel_and_a_missing_one_leaves_it_as_it_is():
    travel = jc.Travel(1, 1024)
    for count in (500, 400, 400, 900, 410, 600, 600, 0, 590):
        travel.add(np.array([count]))
    assert (travel.low[0], travel.high[0]) == (400, 600)
    assert not travel.wrapped[0]
    travel = travel_of(400, -1, 600)
    assert (travel.low[0], travel.high[0], travel.now[0]) == (400, 600, 600)
    assert refusal(travel_of(-1, -1)) == "did not answer"
    # what ends with the encoder was not seen whole
    for counts, cut_off in (((0, 500), True), ((500, 1023), True), ((1, 1022), False)):
        assert travel_of(*counts).cut_off(("LF_hip",)) == ["LF_hip"] * cut_off


def test_measurements_that_make_no_map_are_refused():
    cases = [
        (jc.Measured({"LF_hip": 700}), "LF_hip: with its middle at count 1212"),
        # 612 - 300 counts are 1.78 rad, and a left hip ends at 0.425
        (jc.Measured({"LF_hip": 100}, {"LF_hip": (100, 300)}),
         "LF_hip: its limits in counts and its limits_rad have no"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda measured: jc.calibrated(PRESET.file, measured, DATE))


def test_too_small_a_travel_is_refused_and_one_over_the_encoders_end_until_it_is_forgotten():
    for encoder, least in ((1024, 40), (4096, 160)):
        middle = encoder // 2
        assert "did not move from count" in refusal(travel_of(middle, encoder=encoder))
        short = travel_of(middle, middle + least - 1, encoder=encoder)
        assert f"{least} are the least" in refusal(short)
        assert not refusal(travel_of(middle, middle + least, encoder=encoder))
    travel = travel_of(3900, 4080, 20, 300, encoder=4096)
    assert "horn must be mounted nearer to the middle" in refusal(travel)
    travel.forget(0)
    for count in (300, 300, 900, 900):
        travel.add(np.array([count]))
    assert not refusal(travel) and (travel.low[0], travel.high[0]) == (300, 900)


def test_a_mean_leaves_out_what_is_missing_and_tells_how_far_a_joint_strayed():
    mean, strayed = jc.mean_counts(np.array([[510, -1], [-1, -1], [514, -1]]))
    assert (mean[0], strayed[0]) == (512.0, 4.0) and np.isnan(mean[1])


def test_a_new_map_keeps_what_was_not_measured_and_says_who_says_what():
    measured = jc.Measured({"LF_hip": 20, "RF_hip": -7}, {"LF_hip": (430, 620)}, "LF_hip", 180.0)
    new = jc.calibrated(PRESET.file, measured, DATE).file
    hip, other, calf = (new.joints[j] for j in ("LF_hip", "RF_hip", "LB_calf"))
    before = PRESET.file.joints
    assert (hip.offset_counts, hip.limits_counts) == (20, (430, 620))
    assert hip.limits_rad == before["LF_hip"].limits_rad and hip.sign == before["LF_hip"].sign
    assert f"calibrate-joints {DATE}, offset measured, limits measured" in hip.source
    assert "counts_per_rad of mini_pupper_2 (measured on LF_hip: 180.0)" in hip.source
    # ends of a leg are where they were as seen from its middle: 416..586, 7 counts lower
    assert other.limits_counts == (409, 579) and "moved by the offset" in other.source
    assert calf == before["LB_calf"]
    assert new.name == f"mini_pupper_2, calibrated {DATE}"


def test_a_measured_scale_is_taken_by_all_joints_and_limits_stay_in_counts():
    measured = jc.Measured({"LF_hip": 0}, {}, "LF_hip", 195.0, use_scale=True)
    new = jc.calibrated(PRESET.file, measured, DATE).file
    assert {e.counts_per_rad for e in new.joints.values()} == {195.0}
    for joint, entry in new.joints.items():
        assert entry.limits_counts == PRESET.file.joints[joint].limits_counts
        assert "counts_per_rad measured on LF_hip" in entry.source


def test_a_middle_outside_the_travel_and_a_far_horn_are_doubted():
    # 100 counts are 33 degrees at 550/pi
    measured = jc.Measured({"LF_hip": 100, "LF_thigh": 0}, {"LF_hip": (300, 600)})
    outside, far = jc.doubts(jc.calibrated(PRESET.file, measured, DATE), measured.offset_counts)
    assert "LF_hip +100 (33°):" in far
    assert "its middle (count 612) lies outside its limits 300 to 600" in outside
    assert jc.doubts(PRESET, {"LF_hip": 0}) == []
