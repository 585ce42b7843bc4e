"""Numbers of options are checked before any work: nothing is read, fitted or written for them."""

from __future__ import annotations

from pathlib import Path

import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.joints import STALL_TORQUES_NM
from pupper_sysid.servo_models.calibration.parts import Actuator
from pupper_sysid.servo_models.calibration.quantity import PlausibleRange
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fleet.calibration import Settings
from pupper_sysid.sysid.plan.proposal import plan_from_recordings
from pupper_sysid.sysid.report.report import write_report
from pupper_sysid.sysid.servo_fit.fit import Split
from support.command_line import refused

SAMPLES = Path(__file__).resolve().parents[2] / "data/samples"
NOT_THERE = "no_such_recording.csv"
OUTSIDE = {
    ("calibrate", NOT_THERE, "--stall-torque"): ["1e308", "-1", "1e-9", "nan", "inf"],
    ("calibrate", NOT_THERE, "--jobs"): ["0", "-2", "9" * 30],
    ("calibrate", NOT_THERE, "--seed"): ["-1", "9" * 30],
    ("fit-servo", NOT_THERE, "--jobs"): ["0", "9" * 30],
    ("fit-servo", NOT_THERE, "--test-after", "1", "--train-before"): ["nan", "-1", "1e308"],
    ("fit-servo", NOT_THERE, "--train-before", "1", "--test-after"): ["inf"],
    ("fit-servo", NOT_THERE, "--seed"): ["9" * 30],
    ("compare", NOT_THERE, "--models", "paper", "--seed"): ["9" * 30],
    ("report", NOT_THERE, "--seed"): ["9" * 30],
    ("export", NOT_THERE, "--gain"): ["0", "-16", "nan", "1e308"],
    ("export", NOT_THERE, "--physics-step"): ["0", "nan", "1", "1e308"],
    ("servo", "diff", "paper", "release", "--gain"): ["1e308"],
    ("plan", NOT_THERE, "--seconds"): ["0", "nan", "1e308"],
    ("plan", NOT_THERE, "--rate"): ["0", "inf"],
}


@pytest.mark.parametrize(
    ("words", "values"), OUTSIDE.items(), ids=[f"{w[0]} {w[-1]}" for w in OUTSIDE]
)
def test_a_number_out_of_range_is_refused_before_the_recording_is_read(
    capsys, monkeypatch, tmp_path, words, values
):
    monkeypatch.chdir(tmp_path)
    for value in values:
        said = refused(capsys, pupper_sysid, *words, value)
        assert said.startswith(f"error: {words[-1]} is ")
        assert "it must be " in said and NOT_THERE not in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("torque", [0.0, 1e308, float("nan"), 101.0])
def test_python_refuses_a_stall_torque_that_no_servo_has_before_it_fits(torque):
    nothing = object()  # is not touched
    with pytest.raises(InputError, match="stall_torque_nm"):
        calibrate(nothing, stall_torque_nm=torque)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="stall_torque_nm"):
        Settings(stall_torque_nm=torque)


def test_every_stall_torque_that_is_taken_is_one_that_a_calibration_file_holds():
    (check,) = Actuator.model_fields["effort_limit_nm"].metadata
    span = check.func
    assert isinstance(span, PlausibleRange)
    assert not any(span.problem(torque) for torque in STALL_TORQUES_NM)


def test_python_refuses_a_plan_s_seconds_before_it_fits():
    with pytest.raises(InputError, match="seconds"):
        plan_from_recordings([object()], ["knee"], seconds=1e9)  # pyright: ignore


@pytest.mark.parametrize("gain", [0.0, -1.0, float("nan"), float("inf"), 1e308])
def test_a_card_at_a_gain_that_no_register_holds_is_refused(gain):
    with pytest.raises(InputError, match="p_gain"):
        load_card("sts3215-bam-m1").pd(p_gain=gain)


@pytest.mark.parametrize("loops", [[10**30], [-(10**30)]])
def test_loops_are_numbers_that_a_trial_can_have(loops):
    with pytest.raises(InputError, match="loops"):
        Split.by_trials([0], loops)


def test_a_split_in_time_ends_within_the_recording():
    with pytest.raises(InputError, match="test_after"):
        Split.by_time(1.0, float("inf"))


def test_a_report_names_a_servo_model_that_is_missing_before_it_calibrates(tmp_path):
    from pupper_sysid.sysid.recordings.files import load

    recording = load(SAMPLES / "sweep.csv")
    with pytest.raises(InputError, match=r"`servo` is no_such_model"):
        write_report(recording, tmp_path / "page", models=["no_such_model"])
    assert not list(tmp_path.iterdir())


def test_a_range_includes_its_ends_and_no_other_number():
    refuse_outside("x", 1.0, 1.0, 2.0)
    refuse_outside("x", 2.0, 1.0, 2.0)
    for value in (float("nan"), 0.999, float("inf")):
        with pytest.raises(InputError, match=r"x is .*; it must be from 1 to 2\."):
            refuse_outside("x", value, 1.0, 2.0)
