"""Counts and angles: hand-worked numbers, the knee's push rod, limits, files with errors."""

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.joint_map import PRESETS, JointMap, joint_map_from, load_joint_map
from support.refusals import assert_each_refused

PUPPERS = [name for name in PRESETS if name != "bench_sts3215"]

K = 550 / np.pi
QUARTER = np.pi / 4
MULT = {
    "hip": {"RF": 1, "LF": 1, "RB": -1, "LB": -1},
    "thigh": {"RF": -1, "LF": 1, "RB": -1, "LB": 1},
    "calf": {"RF": -1, "LF": 1, "RB": -1, "LB": 1},
}
"""Of pos = 512 - k * mult * (angle - neutral), facts/hardware.md D2 (F R there is RF here)."""


@pytest.fixture(scope="module")
def pupper() -> JointMap:
    return load_joint_map("mini_pupper_2")


def standing() -> np.ndarray:
    return np.array([DEFAULT_POSE[j] for j in JOINT_NAMES])


def at(joint: str) -> int:
    return JOINT_NAMES.index(joint)


def both_coordinates() -> list[JointMap]:
    """Every preset of the robot, per joint and per servo."""
    return [m for name in PUPPERS for m in (load_joint_map(name), load_joint_map(name).per_servo())]


def test_every_preset_has_the_robots_joints_ids_and_documented_scale():
    for preset, frame, counts, scale in (
        ("mini_pupper_2", "proxy", 1024, 550 / np.pi),
        ("mini_pupper_2_300deg", "proxy", 1024, 1024 / np.radians(300)),
        ("mini_pupper_2_direct", "raw", 1024, 1024 / np.radians(300)),
        ("sts3215", "raw", 4096, 4096 / (2 * np.pi)),
    ):
        loaded = load_joint_map(preset)
        assert loaded.joint_names == JOINT_NAMES
        assert loaded.ids == (4, 5, 6, 1, 2, 3, 10, 11, 12, 7, 8, 9)
        assert (loaded.frame, loaded.file.counts) == (frame, counts)
        assert loaded.counts_per_rad() == pytest.approx(np.full(12, scale), rel=1e-12)


def test_the_standing_pose_is_the_rest_pose_and_the_centre_count_of_every_servo():
    for loaded in both_coordinates():
        counts = loaded.to_counts(standing())
        # the pose says 0.785 and 1.57 for 45 and 90 degrees: up to 0.0008 rad less
        off = np.abs(counts - loaded.file.counts / 2)
        assert (off <= 0.0008 * loaded.counts_per_rad()).all()
        if loaded.file.counts == 1024:
            assert loaded.clip_counts(counts).tolist() == [512] * 12
    for preset in PUPPERS:
        assert load_joint_map(preset).rest_pose() == pytest.approx(standing())


def test_counts_are_those_of_the_vendors_formula(pupper):
    # hips 0.2; thighs 0.3 beyond neutral; calves so that thigh + calf is 0.1 beyond neutral
    pose = np.tile([0.2, QUARTER + 0.3, -2 * QUARTER - 0.2], 4)
    found = dict(zip(JOINT_NAMES, pupper.to_counts(pose), strict=True))
    # worked out by hand with k = 175.0704: 0.2 k = 35.0141, 0.3 k = 52.5211, 0.1 k = 17.5070
    assert found == pytest.approx({
        "LF_hip": 476.9859, "LF_thigh": 459.4789, "LF_calf": 494.4930,
        "RF_hip": 476.9859, "RF_thigh": 564.5211, "RF_calf": 529.5070,
        "LB_hip": 547.0141, "LB_thigh": 459.4789, "LB_calf": 494.4930,
        "RB_hip": 547.0141, "RB_thigh": 564.5211, "RB_calf": 529.5070,
    }, abs=1e-4)  # fmt: skip
    for joint, count in found.items():
        leg, kind = joint.split("_")
        beyond = {"hip": 0.2, "thigh": 0.3, "calf": 0.1}[kind]
        assert count == pytest.approx(512 - K * MULT[kind][leg] * beyond, abs=1e-4)


def test_a_calf_is_neither_read_nor_selected_without_its_thigh_unless_in_servo_coordinates(pupper):
    counts = np.full(12, 512.0)
    counts[at("LF_thigh")] = np.nan
    missing = np.isnan(pupper.to_angles(counts))
    assert np.flatnonzero(missing).tolist() == [at("LF_thigh"), at("LF_calf")]
    only = np.isnan(pupper.per_servo().to_angles(counts))
    assert np.flatnonzero(only).tolist() == [at("LF_thigh")]
    with pytest.raises(InputError, match="LF_calf hangs on LF_thigh by a push rod"):
        pupper.select(["LF_calf"])
    alone = pupper.per_servo().select(["LF_calf"])
    assert alone.ids == (6,)
    # the thigh is taken to stand at 45 degrees, so -90 degrees is the calf servo's centre
    assert alone.to_counts(np.array([-2 * QUARTER])) == pytest.approx([512.0])


def test_counts_are_rounded_to_the_nearest_and_held_within_the_servos_limits(pupper):
    counts = np.full(12, 512.0)
    counts[:4] = [511.6, 1e9, -1e9, 512.4]
    entry = pupper.file.joints
    assert pupper.clip_counts(counts)[:4].tolist() == [
        512, entry["LF_thigh"].limits_counts[1], entry["LF_calf"].limits_counts[0], 512,
    ]  # fmt: skip


# ---- limits ----


def test_joint_limits_are_the_narrower_of_counts_and_angles_and_couple_thigh_and_calf(pupper):
    limits = pupper.position_limits()
    # hip counts 438..608 are +74 and -96 from 512, against the angle's sign; angles -0.55..0.425
    assert limits.low_rad[at("LF_hip")] == pytest.approx(-96 / K)
    assert limits.high_rad[at("LF_hip")] == pytest.approx(74 / K)
    # thigh counts 230..586: +282 and -74 from 512; angles 0.36..2.4
    assert limits.low_rad[at("LF_thigh")] == pytest.approx(QUARTER - 74 / K)
    assert limits.high_rad[at("LF_thigh")] == pytest.approx(QUARTER + 282 / K)
    assert limits.low_rad[at("LF_calf")] == -2.18 and limits.high_rad[at("LF_calf")] == -0.22
    # a thigh far forward makes its calf fold
    pose = standing()
    pose[at("LF_thigh")], pose[at("LF_calf")] = 2.3, -0.3
    # the calf servo's count 206 is 306 from 512: absolute angle -45 degrees + 306 / k = 0.9625
    assert limits.clip(pose)[at("LF_calf")] == pytest.approx(-QUARTER + 306 / K - 2.3)
    assert limits.clip(pose)[at("LF_thigh")] == 2.3
    pose[at("LF_thigh")], pose[at("LF_calf")] = 2.0, -1.2
    assert limits.margin(pose)[at("LF_calf")] == pytest.approx(-QUARTER + 306 / K - 0.8)
    # in servo coordinates the absolute angle is the coordinate + 45 degrees
    pose[at("RF_thigh")], pose[at("RF_calf")] = 1.7, -2.0
    bent = pupper.per_servo().position_limits().clip(pose)[at("RF_calf")]
    assert bent == pytest.approx(-2.18 - QUARTER + 1.7)


def test_a_calf_without_its_thigh_has_the_bounds_it_has_while_the_thigh_rests(pupper):
    for joints in (["LF_calf"], ["LF_calf", "RF_thigh", "RF_calf"]):
        some = pupper.per_servo().select(joints)
        # servo: -45 - 45 degrees, -272 / k and +306 / k, i.e. -3.12..0.18; to the thigh: narrower
        assert some.position_limits().low_rad[0] == -2.18
        assert some.position_limits().high_rad[0] == -0.22
        assert some.zero_rad()[0] == pytest.approx(-2 * QUARTER)
        assert some.to_angles(np.full(len(joints), 512.0))[0] == pytest.approx(-2 * QUARTER)


def test_another_robot_with_the_same_names_rests_within_its_own_limits():
    def other(data: dict) -> None:
        data["linkage"] = "none"
        for entry in data["joints"].values():
            entry |= {"neutral_rad": 0.0, "limits_counts": (402, 622), "limits_rad": (-0.7, 0.7)}

    # ±110 counts are ±0.63 rad: neither 0.785 nor -1.57 is one of its angles
    assert joint_map_from(edited(other), "mine").rest_pose() == pytest.approx(np.zeros(12))


# ---- files ----


def edited(change) -> dict:
    data = load_joint_map("mini_pupper_2").file.model_dump(by_alias=True)
    change(data)
    return data


def put(joint: str, **fields):
    return lambda data: data["joints"][joint].update(fields)


BAD_MAPS = (
    (lambda d: d["joints"].update(LF_knee=d["joints"].pop("LF_calf")), "LF_knee is no joint"),
    (put("LF_hip", id=5), "LF_thigh and LF_hip have the same id 5"),
    (put("LF_hip", limits_counts=(608, 438)), "LF_hip is not usable: limits_counts"),
    (put("LF_hip", limits_rad=(0.5, 0.5)), "LF_hip is not usable: limits_rad is [0.5"),
    (put("LF_hip", offset_counts=300), "LF_hip: its limits in counts and its limits_rad"),
    (put("LF_hip", limits_counts=(438, 1024)), "LF_hip: limits_counts [438, 1024]"),
    (put("LF_hip", limits_rad=(-np.inf, 1.0)), "joints.LF_hip.limits_rad[0] is -inf"),
    (put("LF_hip", counts_per_rad=1750.0), "LF_hip: counts_per_rad is 1750"),
    (put("LF_hip", counts_per_rad=17.5), "LF_hip: counts_per_rad is 17.5"),
    (put("LF_hip", sign=0), "joints.LF_hip.sign is 0. Write 1 or -1"),
    (put("LF_hip", id=254), "joints.LF_hip.id is 254"),
    (lambda d: d.update(joints={}), "joints is {}"),
    (lambda d: d.update(counts=2048), "counts is 2048. Write 1024 or 4096"),
    (lambda d: d.update(schema="pupper-sysid calibration"), "is no joint map"),
    (lambda d: d.pop("schema"), "is no joint map"),
    (lambda d: d.update(schema_version=2), "newer version of pupper-sysid (schema_version 2"),
)


def test_a_bad_map_is_refused_with_the_place():
    assert_each_refused(
        BAD_MAPS, lambda change: joint_map_from(edited(change), "mine"), names="mine"
    )
    others = [(data, "is no joint map") for data in (None, [], "text", 3)]
    assert_each_refused(others, lambda data: joint_map_from(data, "mine"), names="mine")


def test_a_bad_line_in_a_file_is_named_with_its_number(tmp_path, pupper):
    path = tmp_path / "joints.yaml"
    pupper.save(path)
    lines = path.read_text().splitlines()
    number = next(n for n, line in enumerate(lines) if "neutral_rad" in line and n > 12)
    lines[number] = lines[number].replace(lines[number].split("neutral_rad: ")[1], ".nan")
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=rf"joints.yaml, line {number + 1}: joints\.\w+\.neutral"):
        load_joint_map(path)


def test_a_named_servo_s_scale_is_held_to_its_data_sheet():
    """652 counts per radian are 4,096 a turn; 900 is within the bounds of an unknown servo only."""
    data = load_joint_map("sts3215").file.model_dump(by_alias=True)

    def scaled(counts_per_rad: float, servo: str | None):
        hip = data["joints"]["LF_hip"] | {"counts_per_rad": counts_per_rad}
        return data | {"servo": servo, "joints": data["joints"] | {"LF_hip": hip}}

    for servo in ("STS3215", None):
        with pytest.raises(InputError, match="LF_hip: counts_per_rad is 6519"):
            joint_map_from(scaled(6519.0, servo), "mine")
    with pytest.raises(InputError, match="is 900, but the STS3215 has 651.9"):
        joint_map_from(scaled(900.0, "STS3215"), "mine")
    joint_map_from(scaled(900.0, None), "mine")


def test_offsets_shift_the_counts_and_the_limits_stay():
    shifted = joint_map_from(edited(put("LF_hip", offset_counts=30)), "mine")
    assert shifted.to_counts(standing())[at("LF_hip")] == pytest.approx(542.0)
    # counts 438..608 are now -104 and +66 from the zero at 542
    assert shifted.position_limits().low_rad[at("LF_hip")] == pytest.approx(-66 / K)
    assert shifted.position_limits().high_rad[at("LF_hip")] == pytest.approx(0.425)
