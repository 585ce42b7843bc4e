"""Two servos are compared at one P gain and by one definition of the armature."""

from __future__ import annotations

from pathlib import Path

import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.cards.compare import Comparison, compared, servo_of
from pupper_sysid.servo_models.cards.files import load_card

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


def test_the_gain_is_that_of_the_servo_whose_numbers_hold_at_no_other():
    for pair in ((LOOP, FIXED_16), (FIXED_16, LOOP)):
        found = compared(*pair)
        assert found.p_gain == 16.0 and {found.first.p_gain, found.second.p_gain} == {16.0}


def test_a_wanted_gain_is_that_of_both_or_refused(tmp_path):
    found = compared(LOOP, saved(tmp_path / "a.yaml"), p_gain=8)
    assert found.p_gain == 8.0 == found.first.p_gain == found.second.p_gain
    with pytest.raises(InputError, match="p_gain"):
        compared(LOOP, FIXED_16, p_gain=32)


def test_without_a_gain_on_one_side_the_stiffness_is_not_compared_and_the_rest_is():
    found = compared(LOOP, "paper", "LF_thigh")
    assert found.p_gain is None and "not stated" in found.notes[0]
    stiffness = difference(found, "stiffness")
    assert stiffness.ratio is None and stiffness.second is not None
    assert difference(found, "effort limit").ratio == pytest.approx(
        5.0 / load_card(LOOP).pd().effort_limit_nm.value
    )


def test_armatures_with_and_without_the_link_are_not_compared():
    found = compared(LOOP, "sts3215-12v")
    assert difference(found, "armature").ratio is None
    assert any("armatures differ" in note for note in found.notes)
    assert difference(compared(LOOP, "sts3215-bam-m1"), "armature").ratio is not None


def test_a_calibration_of_one_gain_refuses_another():
    with pytest.raises(InputError, match="holds at P gain not stated only"):
        servo_of("paper", "LF_hip", 16.0)
    assert load_calibration("paper").joint("LF_hip").holds_at.armature == "servo"
