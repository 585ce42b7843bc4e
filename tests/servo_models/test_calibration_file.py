"""Calibration files: what is written reads back, and the presets hold what was published."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from pupper_sysid.common.border import described_fields
from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.common.strict_yaml import dump
from pupper_sysid.servo_models.calibration.calibration import PRESETS, load_calibration
from pupper_sysid.servo_models.calibration.parts import (
    Actuator,
    CandidateModel,
    Feedback,
    Lag,
    RatiosToArmature,
    Scale,
    Scores,
)
from pupper_sysid.servo_models.calibration.quantity import Quantity, unit_of
from support.calibration_examples import calibration, joint_calibration
from support.refusals import assert_each_refused


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "calibrated.yaml"
    calibration().save(path)
    return path


def test_what_is_saved_reads_back_exactly(file):
    saved = calibration()
    loaded = load_calibration(file)
    assert loaded.joints == saved.joints
    assert (loaded.inputs, loaded.notes, loaded.seed) == (saved.inputs, saved.notes, saved.seed)
    assert loaded.to_yaml() == file.read_text()


def test_the_file_explains_itself_and_an_ordinary_yaml_reader_sees_the_same_data(file):
    assert yaml.safe_load(file.read_text()) == load_calibration(file).model_dump(
        mode="json", by_alias=True
    )
    lines = file.read_text().splitlines()
    assert lines[0].startswith("# Calibration") and any("interval" in line for line in lines[:12])
    (delay,) = [line for line in lines if line.strip().startswith("dead_time_s:")]
    assert "value: 0.025" in delay and "identified:" in delay


def test_saving_refuses_to_overwrite_without_force(file):
    before = file.read_text()
    other = calibration(RB_calf=joint_calibration())
    with pytest.raises(FileExistsRefusal, match="force=True"):
        other.save(file)
    assert file.read_text() == before
    other.save(file, force=True)
    assert load_calibration(file).joint_names == ("RB_calf",)


def test_handwritten_words_and_numbers_mean_what_they_say(file):
    text = file.read_text()
    text = text.replace("identified: 'yes'", "identified: yes").replace("0.025,", "25e-3,")
    file.write_text(text)
    assert load_calibration(file).joints == calibration().joints


def test_numpy_numbers_are_stored_as_plain_numbers_and_cannot_be_changed():
    number = Quantity(value=np.float64(0.5), low=np.float64(0.25), identified="yes")
    assert type(number.value) is float and type(number.low) is float
    with pytest.raises(ValidationError, match="frozen"):
        calibration().joints["LF_hip"].actuator.dead_time_s.value = 0.0  # pyright: ignore


def test_joints_are_in_the_one_joint_order_and_models_in_the_one_asked_for():
    both = calibration(LF_thigh=joint_calibration(12.0), LF_hip=joint_calibration(11.0))
    assert both.joint_names == ("LF_hip", "LF_thigh")
    model = both.delayed_pd(["LF_thigh", "LF_hip"], time_step_s=0.001)
    assert model.time_step_s == 0.001
    np.testing.assert_array_equal(model.parameters.stiffness, [12.0, 11.0])
    assert both.delayed_pd(["LF_thigh"]).batch == (1,)


def test_every_number_reaches_the_models_it_is_for():
    hip = calibration()
    parameters = hip.delayed_pd().parameters
    assert [np.asarray(v).tolist() for v in vars(parameters).values()] == [
        [11.0], [0.1], [0.2], [1.1e-5], [0.35], [7.6], [0.025], [0.0],
    ]  # fmt: skip
    feedback = hip.held_feedback("LF_hip")
    assert asdict(feedback) == {
        "poll_period_s": 0.02685, "loss": 0.42, "quantum_rad": math.pi / 550, "offset_rad": 0.0,
    }  # fmt: skip
    assert hip.joint("LF_hip").feedback.offset_rad.value == -0.1  # of its recording, not the servo


def test_asking_for_a_joint_that_was_not_calibrated_says_which_were():
    for ask in (calibration().held_feedback, lambda name: calibration().delayed_pd([name])):
        with pytest.raises(InputError, match=r"no joint RB_calf.*LF_hip"):
            ask("RB_calf")
    with pytest.raises(InputError, match="at least one"):
        calibration().delayed_pd([])


# Numbers of the paper's text and of its authors' released training configuration.
PUBLISHED = {
    "paper": [70.0, 1.2, 0.03, 0.005, 5.0, 10.5, 0.076, 0.0, 0.0],
    "release": [80.0, 2.5, 0.03, 0.005, 0.7, 15.0, 0.057, 0.0, 0.0],
}
PUBLISHED_STEPS = {"paper": (33, 43), "release": (26, 31)}


@pytest.mark.parametrize("name", PRESETS)
def test_presets_hold_the_published_numbers_for_all_joints_and_call_none_a_measurement(name):
    preset = load_calibration(name)
    assert preset.joint_names == JOINT_NAMES
    for joint in preset.joints.values():
        actuator = joint.actuator
        assert (actuator.delay_steps_min, actuator.delay_steps_max) == PUBLISHED_STEPS[name]
        quantities = [q for _, q in actuator if isinstance(q, Quantity)]
        assert [q.value for q in quantities] == PUBLISHED[name]
        for ratio, quantity in zip(
            ("stiffness_nm_per_rad", "damping_nm_s_per_rad", "friction_loss_nm",
             "effort_limit_nm", "back_emf_nm_s_per_rad"),
            (q for q in dict(actuator.ratios_to_armature).values() if q is not None),
            strict=True,
        ):  # fmt: skip
            assert quantity.value == pytest.approx(getattr(actuator, ratio).value / 0.005)
        for q in (*quantities, *dict(joint.feedback).values()):
            assert q.identified == "no" and q.low is None and q.high is None
        assert all("not a measurement" in str(q.why) for q in quantities if q.value)
        assert joint.lag == Lag() and joint.scores == Scores()
    assert asdict(preset.held_feedback("LF_hip")) == dict.fromkeys(
        ("poll_period_s", "loss", "quantum_rad", "offset_rad"), 0.0
    )


def test_every_quantity_of_a_calibration_has_a_unit_and_a_description():
    for part in (Actuator, Feedback, Lag, Scores, RatiosToArmature, Scale, CandidateModel):
        for name, field in described_fields(part).items():
            assert field.description, f"{part.__name__}.{name} is not documented"
            if "Quantity" in str(field.annotation) or "float" in str(field.annotation):
                assert unit_of(name) or name == "parameters", f"{part.__name__}.{name}: no unit"


def version_1(path: Path) -> Path:
    """The file at `path` with the keys that it had in version 1."""
    text = path.read_text().replace("schema_version: 4", "schema_version: 1")
    for new, old in (
        ("dead_time_s:", "delay_s:"), ("candidate_models:", "ladder:"),
        ("raw_lag_s", "naive_lag_s"), ("rmse_raw_rad", "rmse_naive_rad"),
        ("rmse_free_run_raw_rad", "rmse_free_run_naive_rad"),
    ):  # fmt: skip
        text = text.replace(new, old)
    path.write_text(text)
    return path


def test_a_file_of_version_1_is_read_and_saved_in_the_present_version(file, tmp_path):
    loaded = load_calibration(version_1(file))
    assert loaded.joints == calibration().joints and loaded.schema_version == 4
    loaded.save(tmp_path / "again.yaml")
    assert " delay_s:" not in (tmp_path / "again.yaml").read_text()
    assert load_calibration("data/samples/calibrated.yaml").joint_names[0] == "LF_hip"


def test_faults_of_a_version_1_file_are_named_in_its_own_words_and_lines(file):
    text = version_1(file).read_text().replace("delay_s: {value: 0.025,", "delay_s: {value: 25.0,")
    file.write_text(text)
    line = next(n for n, t in enumerate(text.splitlines(), 1) if "value: 25.0" in t)
    with pytest.raises(InputError, match=rf"line {line}: joints\.LF_hip\.actuator\.delay_s is not"):
        load_calibration(file)


def test_errors_on_unseen_runs_of_a_version_3_file_have_their_own_names(file, tmp_path):
    """Version 3 had a mean absolute error over left-out runs among the RMS over frequencies."""
    card = load_calibration("sts3215-bam-m6")
    block = next(iter(card.joints.values())).under_load
    assert block is not None
    calibration(LF_hip=joint_calibration(), LF_thigh=joint_calibration()).save(file, force=True)
    data = yaml.safe_load(file.read_text()) | {"schema_version": 3}
    loaded, free = data["joints"].values()
    for joint, under_load in ((loaded, block.model_dump(mode="json")), (free, None)):
        joint["under_load"] = under_load
        for own in (joint["scores"], *joint["selection"]["candidate_models"]):
            own.pop("rmse_unseen_runs_rad", own.pop("mae_unseen_runs_rad", None))
            own["rmse_leave_one_frequency_out_rad"] = 0.012
    old = tmp_path / "old.yaml"
    old.write_text(dump(data))
    first, second = load_calibration(old).joints.values()
    for joint, seen in ((first, (None, 0.012, None, 0.012)), (second, (0.012, None, 0.012, None))):
        scores, model = joint.scores, joint.selection.candidate_models[0]
        assert seen == (
            scores.rmse_leave_one_frequency_out_rad, scores.rmse_unseen_runs_rad,
            model.rmse_leave_one_frequency_out_rad, model.mae_unseen_runs_rad,
        )  # fmt: skip
    load_calibration(old).save(tmp_path / "new.yaml")
    assert load_calibration(tmp_path / "new.yaml").joints == load_calibration(old).joints


def test_a_damaged_version_3_file_is_refused_like_any_other(file):
    text = file.read_text().replace("schema_version: 4", "schema_version: 3")
    head = text[: text.index("\njoints:") + 1]

    def read(damage):
        file.write_text(head + damage + "\n")
        load_calibration(file)

    damages = (
        "joints: 3", "joints: {LF_hip: 3}", "joints: {LF_hip: {under_load: 1, scores: 2}}",
        "joints: {LF_hip: {under_load: 1, selection: {candidate_models: [3]}}}",
    )  # fmt: skip
    assert_each_refused([(damage, "joints") for damage in damages], read)
