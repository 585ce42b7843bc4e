"""Servo cards: cited numbers follow from their sources, and files that are wrong are refused."""

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.data_sheet import data_sheet, recorded_stall_torque, stall_torque
from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.cards.card import ServoCard
from pupper_sysid.servo_models.cards.compare import Comparison, compared, servo_of
from pupper_sysid.servo_models.cards.files import (
    ACTUATORS,
    BamParameters,
    card_names,
    from_bam,
    load_card,
    to_bam,
)
from pupper_sysid.servo_models.cards.numbers import PositionLoop, TorquePD, stated
from pupper_sysid.servo_models.delayed_pd import DelayedPD
from pupper_sysid.servo_models.loaded_servo import LoadedServo
from support.package import ROOT
from support.refusals import assert_each_refused

SHIPPED = card_names()


def loop(**changed: float) -> PositionLoop:
    """A position loop with round numbers."""
    numbers = {
        "duty_per_rad": 0.1, "duty_limit": 0.9, "stall_torque_nm": 2.0,
        "back_emf_nm_s_per_rad": 0.4, "armature_kg_m2": 0.02, "friction_loss_nm": 0.05,
        "viscous_friction_nm_s_per_rad": 0.1,
    } | changed  # fmt: skip
    return PositionLoop.model_validate({"model": "position_loop"} | numbers)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_card_says_its_source_follows_from_it_and_survives_a_round_trip(
    name, tmp_path
):
    card = load_card(name)
    assert card.name == name
    assert card.source.url.startswith("https://") and card.source.licence
    if card.published:
        assert card.source.file and len(card.source.commit or "") == 40
        assert not card.data, "hashes are of our own data"
    card.save(tmp_path / "card.yaml")
    assert load_card(tmp_path / "card.yaml") == card
    source = card.as_published
    if "kt" in source:
        known = BamParameters.model_validate(source)
        assert from_bam(known, ACTUATORS[known.actuator]) == card.numbers
    if "-bam-" in name or "-kscale-" in name:  # it goes back to the parameter file it came from
        made = to_bam(card)
        assert made["model"] == source["model"] and made["actuator"] == source["actuator"]
        for key, value in source.items():
            if isinstance(value, float) and key not in ("q_offset", "score", "trial_number"):
                assert made[key] == pytest.approx(value, rel=1e-12), key


def test_a_position_loop_becomes_a_pd_by_the_formulas_of_its_module():
    # P 20, 0.1 duty per rad and P, 2 N·m at full duty: 0.1 * 20 * 2 = 4 N·m/rad, limit 0.9 * 2
    pd = loop().as_pd(p_gain=20)
    assert pd.stiffness_nm_per_rad.value == pytest.approx(4.0)
    assert pd.effort_limit_nm.value == pytest.approx(1.8)
    assert pd.parameters.back_emf == pytest.approx(0.5)  # 0.4 of the motor, 0.1 of the gears
    assert pd.parameters.damping == 0.0
    # (1.8 - 0.05) N·m are left for 0.5 N·m·s/rad
    assert pd.top_speed_rad_s == pytest.approx(3.5)
    # torques of a simulator are for one gain, and have no top speed without velocity terms
    with pytest.raises(InputError, match="only as they are"):
        load_card("sts3215-soarm100").pd(p_gain=32)
    bare = TorquePD(
        model="delayed_pd", stiffness_nm_per_rad=stated(10.0), friction_loss_nm=stated(0.0),
        armature_kg_m2=stated(0.01), effort_limit_nm=stated(1.0),
    )  # fmt: skip
    assert bare.top_speed_rad_s is None


@pytest.mark.parametrize(
    ("name", "stiffness", "effort_limit", "back_emf"),
    [
        # kt 1.2116, R 2.6762 at 7.4 V and P 32: 0.166 * 32 * 7.4 * kt / R = 17.8;
        # kt² / R + 0.0591 = 0.6077, which SO-ARM100 and Open Duck round to 0.60
        ("sts3215-bam-m1-early", 17.8, None, 0.6077), ("sts3215-soarm100-early", 17.8, None, None),
        # its README.md, M1: kp 23.458, force range 4.4457, damping 1.3843
        ("sts3215-kscale-m1", 23.458, 4.4457, 1.3843),
    ],
)  # fmt: skip
def test_numbers_are_those_that_their_authors_exported_and_that_everybody_copied(
    name, stiffness, effort_limit, back_emf
):
    pd = load_card(name).pd()
    assert pd.stiffness_nm_per_rad.value == pytest.approx(stiffness, rel=3e-3)
    if effort_limit is not None:
        assert pd.effort_limit_nm.value == pytest.approx(effort_limit, rel=2e-4)
    if back_emf is not None:
        assert pd.parameters.back_emf == pytest.approx(back_emf, rel=3e-4)


def test_a_bam_parameter_file_is_read_as_a_card_and_a_wrong_one_names_its_fault(tmp_path):
    path, good = tmp_path / "servo.json", load_card("sts3215-bam-m4").as_published

    def read(data):
        path.write_text(json.dumps(data))
        return load_card(path)

    assert read(good).numbers == load_card("sts3215-bam-m4").numbers
    cases = [
        ({"model": "m1", "kt": 1.0, "R": 2.0, "actuator": "mx64"}, "armature is missing"),
        (good | {"actuator": "mx64"}, "actuator mx64 is not known here"),
        (good | {"armature": 2**63}, "servo.json: armature"),
        (good | {"kt": 0}, "servo.json: kt and R must be above 0"),
    ]
    assert_each_refused(cases, read)
    simulated = [(load_card("sts3215-open-duck"), "states torques of a simulator")]
    assert_each_refused(simulated, to_bam)


def test_cards_that_cannot_be_trusted_are_refused_in_a_sentence(tmp_path):
    path = tmp_path / "card.yaml"

    def read(change, name="sts3215-open-duck"):
        text = load_card(name).to_yaml()
        assert change[0] in text
        path.write_text(text.replace(*change, 1))
        load_card(path)

    cases = [
        (("licence:", "license:"), "is not a key of this file. Did you mean licence?"),
        (("stiffness_nm_per_rad: 13.37", "stiffness: 13.37"), "stiffness"),
        (("armature_kg_m2: 0.027", "armature_kg_m2: 27.0"), "looks like g·cm²"),
        (("schema_version: 1", "schema_version: 2"), "newer version"),
        (("default: servo", "default: knee"), "no specimen"),
        (("pupper-servo-card", "pupper-calibration"), "not a servo card"),
        (("commit: 20ce9d0f", "commit: 20ce9d"), "commit"),
    ]
    assert_each_refused(cases, read, names=path)
    cases = [(("p: 32.0, ", ""), "need gains.p and supply_v")]
    assert_each_refused(cases, lambda change: read(change, "sts3215-bam-m1"), names=path)
    assert_each_refused([("sts3215-bam-m11", "Did you mean sts3215-bam-m1")], load_card)


def test_a_card_is_a_calibration_for_any_joint_and_own_specimens_for_joints_of_that_name():
    card = load_card("sts3215-anchorbench")
    made = card.calibration()
    own = made.delayed_pd(["elbow_flex", "LF_hip"]).parameters
    np.testing.assert_allclose(own.stiffness, [14.715496, 47.782635])
    assert made.held_feedback("LF_hip").quantum_rad == pytest.approx(2 * math.pi / 4096)
    assert any("no dead time" in note for note in made.notes)


def test_a_number_with_an_interval_keeps_it(tmp_path):
    card = load_card("sts3215-open-duck")
    dead = {"value": 0.02, "low": 0.018, "high": 0.023, "identified": "yes"}
    data = card.model_dump(mode="json", by_alias=True, exclude_none=True)
    data["specimens"]["servo"]["dead_time_s"] = dead
    made = ServoCard.model_validate(data)
    made.save(tmp_path / "card.yaml")
    actuator = load_card(tmp_path / "card.yaml").calibration().joint("any").actuator
    assert (actuator.dead_time_s.low, actuator.dead_time_s.high) == (0.018, 0.023)
    assert (actuator.delay_steps_min, actuator.delay_steps_max) == (9, 12)


def test_a_data_sheet_is_found_by_model_number_and_scaled_with_the_voltage():
    # 30 kg·cm at 12 V
    assert stall_torque(777, 12.0)[0] == pytest.approx(30 * 0.0980665)
    assert stall_torque("Feetech STS3215", 11.0)[0] == pytest.approx(30 * 0.0980665 * 11 / 12)
    torque, source = stall_torque(777)
    assert torque == pytest.approx(19.5 * 0.0980665)
    assert "supply voltage is not recorded" in source
    assert data_sheet("dynamixel xl330_m288") is data_sheet(1200)
    header = [{}, {"model": "STS3215"}, {"model": "STS3215", "supply_voltage_v": 12.0}]
    assert recorded_stall_torque(header) == stall_torque("STS3215", 12.0)
    assert recorded_stall_torque([{"model": "unknown"}]) is None
    with pytest.raises(InputError, match="No data sheet of the servo MG90S"):
        stall_torque("MG90S")


def test_a_card_moves_alike_as_loaded_servo_and_as_pd_where_it_has_no_more_friction():
    # M1 with a duty limit and without a set-point limit: nothing is left out in either form
    card = load_card("sts3215-bam-m1-early")
    parameters, gain = card.loaded()
    time_s = np.arange(1500) * 0.002
    commands = 0.8 * np.sin(2 * np.pi * 2.0 * time_s) + 0.9 * (time_s > 1.5)
    loaded, pd = LoadedServo(parameters, gain), DelayedPD(card.pd().parameters)
    loaded.reset(0.0)
    pd.reset(0.0)
    np.testing.assert_allclose(loaded.rollout(commands), pd.rollout(commands), atol=2e-3)


def test_a_pd_in_torque_is_the_same_servo_as_a_loaded_one():
    card = load_card("sts3215-anchorbench")
    parameters, gain = card.loaded("elbow_flex")
    assert gain == 1.0
    back = parameters.delayed_pd(gain).arrays()
    for name, value in card.pd("elbow_flex").parameters.arrays().items():
        if name != "velocity_limit":
            assert back[name] == pytest.approx(value), name


def test_half_of_bams_stribeck_friction_is_left_at_the_speed_of_the_loaded_servo():
    card = load_card("sts3215-bam-m6")
    parameters, _ = card.loaded()
    numbers = card.as_published
    slow, alpha = float(numbers["dtheta_stribeck"]), float(numbers["alpha"])
    share = math.exp(-((float(parameters.stribeck_speed) / slow) ** alpha))
    assert share == pytest.approx(0.5)
    # with the torque off only the gears' viscous friction brakes
    viscous = parameters.off_brake * parameters.back_emf
    assert viscous == pytest.approx(numbers["friction_viscous"])


def test_a_fit_under_load_is_a_card_with_the_parameters_of_the_loaded_servo(tmp_path):
    card = load_card("sts3215-bam-m1")
    data = card.model_dump(mode="json", by_alias=True, exclude_none=True)
    stall = {"value": 2.0, "low": 1.9, "high": 2.1, "identified": "yes"}
    data["specimens"]["servo"] = {
        "model": "loaded_servo", "duty_per_rad": 0.1, "stall_torque_nm": stall,
        "back_emf_nm_s_per_rad": 0.4, "armature_kg_m2": 0.02, "friction_loss_nm": 0.05,
        "torque_limit_nm": 1.5, "load_friction_motor": 0.2, "dead_time_s": 0.01,
    }  # fmt: skip
    ServoCard.model_validate(data).save(tmp_path / "mine.yaml")
    mine = load_card(tmp_path / "mine.yaml")
    parameters, gain = mine.loaded()
    assert gain == 32 and parameters.torque_limit == 1.5 and parameters.load_friction_motor == 0.2
    # 0.1 * 32 * 2 N·m/rad, limited by the current
    pd = mine.pd()
    assert pd.stiffness_nm_per_rad.value == pytest.approx(6.4)
    assert pd.effort_limit_nm.value == 1.5
    expected = parameters.delayed_pd(32).arrays()
    for name, value in pd.parameters.arrays().items():
        if name != "velocity_limit":  # 1000 stands for none
            assert value == pytest.approx(expected[name]), name
    assert any("load-dependent friction" in note for note in mine.calibration().notes)


@pytest.mark.parametrize("name", ["sts3215-bam-m6", "xl330-m288"])
def test_a_card_of_a_position_loop_is_a_calibration_at_any_gain_and_load(name):
    card = load_card(name)
    joint = card.calibration().joint("any")
    assert joint.servo is not None
    own, gain = card.loaded()
    made = joint.servo.parameters(float(own.dead_time_s)).arrays()
    for field, value in own.arrays().items():
        if field != "stribeck_speed" or made["stribeck_friction"] > 0:
            assert made[field] == pytest.approx(value), field
    assert joint.servo.p_gain == gain
    twice = joint.at_p_gain(2 * gain)
    stiffness = twice.actuator.stiffness_nm_per_rad.value
    assert stiffness == pytest.approx(card.pd(p_gain=2 * gain).parameters.stiffness)
    assert load_card("sts3215-open-duck").calibration().joint("any").servo is None


# ----- two servos are compared at one P gain and by one definition of the armature

LOOP, FIXED_16, NO_GAIN = "sts3215-bam-m6", "sts3215-soarm100", "sts3215-open-duck"


def difference(found: Comparison, quantity: str):
    return next(d for d in found.differences if d.quantity == quantity)


def saved(path: Path, p_gain: float | None = None) -> str:
    """The card `LOOP` as a calibration file, at another gain."""
    made = load_card(LOOP).calibration()
    if p_gain is not None:
        made = made.at_p_gain(p_gain)
    Calibration(**{name: getattr(made, name) for name in ("robot", "created")},
                joints=made.joints).save(path)  # fmt: skip
    return str(path)


def test_a_servo_equals_itself_whatever_gain_its_file_was_written_at(tmp_path):
    at_16 = saved(tmp_path / "a.yaml", 16.0)
    found = compared(at_16, LOOP)
    assert found.p_gain == 16.0 == found.second.p_gain
    assert difference(found, "stiffness").ratio == pytest.approx(1.0)
    assert any("P gain 16" in note for note in found.notes)
    assert difference(compared(LOOP, at_16), "stiffness").ratio == pytest.approx(1.0)


def test_the_gain_is_the_wanted_one_or_that_of_the_servo_whose_numbers_hold_at_no_other():
    for pair in ((LOOP, FIXED_16), (FIXED_16, LOOP)):
        found = compared(*pair)
        assert found.p_gain == 16.0 and {found.first.p_gain, found.second.p_gain} == {16.0}
    found = compared(LOOP, "sts3215-bam-m1", p_gain=8)
    assert found.p_gain == 8.0 == found.first.p_gain == found.second.p_gain
    cases = [
        (lambda: compared(LOOP, FIXED_16, p_gain=32), "p_gain"),
        (lambda: servo_of("paper", "LF_hip", 16.0), "P gain not stated only"),
    ]
    assert_each_refused(cases, lambda ask: ask())


def test_what_is_of_another_gain_or_holds_the_link_is_not_compared_and_the_rest_is():
    found = compared(LOOP, "paper", "LF_thigh")
    assert found.p_gain is None and "not stated" in found.notes[0]
    stiffness = difference(found, "stiffness")
    assert stiffness.ratio is None and stiffness.second is not None
    assert difference(found, "effort limit").ratio == pytest.approx(
        5.0 / load_card(LOOP).pd().effort_limit_nm.value
    )
    found = compared(LOOP, "sts3215-12v")
    assert difference(found, "armature").ratio is None
    assert any("armatures differ" in note for note in found.notes)
    assert difference(compared(LOOP, "sts3215-bam-m1"), "armature").ratio is not None


# ----- the page on STS3215 models shows what its benchmark printed, of the cards as they are

FOUND = json.loads((ROOT / "benchmarks" / "which_sts3215.json").read_text())
PAGE = (ROOT / "docs" / "which_sts3215.md").read_text()


def test_the_tables_of_the_page_are_those_that_the_benchmark_printed():
    for name, lines in FOUND["tables"].items():
        block = PAGE.split(f"<!-- table {name} -->")[1].split("<!-- end -->")[0]
        assert block.strip().splitlines() == lines, name


def test_the_cards_are_those_that_were_scored_and_ours_was_not_fitted_to_that_motion():
    for name, expected in FOUND["cards"].items():
        numbers = load_card(name).model_dump(mode="json")["specimens"]
        found = hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()
        assert found == expected, f"{name}: run benchmarks/which_sts3215.py again"
    ours = {f.sha256 for f in load_card("sts3215-12v").data}
    assert FOUND["recordings"]["frequency_sweep"] not in ours
    assert FOUND["recordings"]["chirp_sweep"] in ours
