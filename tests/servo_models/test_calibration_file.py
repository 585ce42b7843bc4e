"""Calibration files: what is written reads back, and the presets hold what was published."""

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pupper_sysid.common.border import described_fields
from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.common.strict_yaml import dump
from pupper_sysid.servo_models.calibration.calibration import PRESETS, Calibration, load_calibration
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


def test_the_file_explains_itself_and_an_ordinary_yaml_reader_sees_the_same_data(file):
    loaded, text = load_calibration(file), file.read_text()
    assert loaded.to_yaml() == text
    assert yaml.safe_load(text) == loaded.model_dump(mode="json", by_alias=True)
    lines = text.splitlines()
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
    text = path.read_text().replace("schema_version: 5", "schema_version: 1")
    for new, old in (
        ("dead_time_s:", "delay_s:"), ("candidate_models:", "ladder:"),
        ("raw_lag_s", "naive_lag_s"), ("rmse_raw_rad", "rmse_naive_rad"),
        ("rmse_free_run_raw_rad", "rmse_free_run_naive_rad"),
    ):  # fmt: skip
        text = text.replace(new, old)
    path.write_text(text)
    return path


def test_a_file_of_version_1_is_read_saved_in_the_present_one_and_its_faults_are_named_as_in_it(
    file, tmp_path
):
    loaded = load_calibration(version_1(file))
    assert loaded.joints == calibration().joints and loaded.schema_version == 5
    loaded.save(tmp_path / "again.yaml")
    assert " delay_s:" not in (tmp_path / "again.yaml").read_text()
    text = file.read_text().replace("delay_s: {value: 0.025,", "delay_s: {value: 25.0,")
    file.write_text(text)
    line = next(n for n, t in enumerate(text.splitlines(), 1) if "value: 25.0" in t)
    with pytest.raises(InputError, match=rf"line {line}: joints\.LF_hip\.actuator\.delay_s is not"):
        load_calibration(file)


def test_a_servo_in_a_file_of_version_4_is_read_and_its_faults_are_named_as_in_it(file):
    card = load_calibration("sts3215-bam-m6")
    card.save(file, force=True)
    text = file.read_text().replace("schema_version: 5", "schema_version: 4")
    file.write_text(text.replace("    servo:", "    under_load:"))
    assert load_calibration(file).joints == card.joints
    file.write_text(file.read_text().replace("known_load: true", "known_load: perhaps"))
    with pytest.raises(InputError, match=r"joints\.\w+\.under_load\.known_load"):
        load_calibration(file)


def test_errors_on_unseen_runs_of_a_version_3_file_have_their_own_names(file, tmp_path):
    """Version 3 had a mean absolute error over left-out runs among the RMS over frequencies."""
    card = load_calibration("sts3215-bam-m6")
    block = next(iter(card.joints.values())).servo
    assert block is not None
    calibration(LF_hip=joint_calibration(), LF_thigh=joint_calibration()).save(file, force=True)
    data = yaml.safe_load(file.read_text()) | {"schema_version": 3}
    loaded, free = data["joints"].values()
    for joint, servo in ((loaded, block.model_dump(mode="json")), (free, None)):
        joint["under_load"], _ = servo, joint.pop("servo")
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
    text = file.read_text().replace("schema_version: 5", "schema_version: 3")
    head = text[: text.index("\njoints:") + 1]

    def read(damage):
        file.write_text(head + damage + "\n")
        load_calibration(file)

    damages = (
        "joints: 3", "joints: {LF_hip: 3}", "joints: {LF_hip: {under_load: 1, scores: 2}}",
        "joints: {LF_hip: {under_load: 1, selection: {candidate_models: [3]}}}",
    )  # fmt: skip
    assert_each_refused([(damage, "joints") for damage in damages], read)


# ----- calibration files that cannot be trusted are refused in one sentence that says what to do


def assert_refused(path: Path, cases) -> None:
    """Each case is a change of the file's text, and words of the sentence that refuses it."""
    text = path.read_text()

    def read(change):
        content = change(text)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        load_calibration(path)

    assert_each_refused(cases, read, names=path)


def replaced(old: str, new: str):
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


def edited(*keys: str | int, value: object):
    """The change that makes `value` the entry at `keys`."""

    def change(text: str) -> str:
        data = yaml.safe_load(text)
        place = data
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        return dump(data)

    return change


def content(data: bytes):
    return lambda text: data


HIP = ("joints", "LF_hip")


def test_what_is_no_calibration_is_refused_with_what_is_wrong(file, tmp_path):
    head = b"schema: pupper-calibration\n"
    contents = [
        (b"", "is empty"), (b"# only a comment\n", "is empty"),
        (b"\x7fELF\x02\x01\x00\xff\xfe", "not a text file"), (b"a\x00b", "not valid YAML"),
        (b"- 1\n- 2\n", "is not a calibration"), (b"just text\n", "is not a calibration"),
        (b"robot: dog\n", "schema: pupper-calibration"),
        (b"schema: [unclosed\n", "not valid YAML: line"),
        (b"a: 1\n---\nb: 2\n", "several YAML documents"), (b"a: &x 1\nb: *x\n", "alias or anchor"),
        (b"a: !!python/object/apply:os.getcwd []\n", "YAML tag"), (b"a: !!float 1\n", "YAML tag"),
        (b"? [1, 2]\n: 3\n", "not a plain word"), (b"&x a: 3\n", "not a plain word"),
        (b"a:\n  b: 1\n  b: 2\n", "line 3, a.b stands in the file twice"),
        (b"[" * 1_000_000, "more than 20 levels of nesting"), (head, "schema_version is null"),
        (head + b"schema_version: true\n", "schema_version is True"),
        (head + b"schema_version: 0\n", "schema_version is 0; this version reads 5"),
        (head + b"schema_version: 6\nnew: 1\n", "newer version"),
        (head + b"schema_version: 6\nnew: 1\n", "Upgrade"),
    ]  # fmt: skip
    assert_refused(file, [(content(data), says) for data, says in contents])
    names = [
        (tmp_path, "is not a file"), (tmp_path / "nothing.yaml", "does not exist"),
        (tmp_path / "nothing.yaml", "Presets: paper, release"),
        ("relaese", "Did you mean the preset release"),
        ("sts3215-bam-m66", "Did you mean the servo card sts3215-bam-m6"),
    ]  # fmt: skip
    assert_each_refused(names, load_calibration)


def test_keys_that_are_unknown_missing_or_in_another_unit_are_refused_with_the_right_one(file):
    lines = file.read_text().splitlines()
    line = next(i for i, t in enumerate(lines, 1) if "stiffness_nm" in t)
    misspelt = replaced("stiffness_nm_per_rad", "stifness_nm_per_rad")
    unitless = edited(*HIP, "selection", "candidate_models", 1, "rmse_fresh", value=0.1)
    milliseconds = replaced("  dead_time_s:", "  dead_time_ms:")
    cases = [
        (misspelt, f"line {line}: joints.LF_hip.actuator.stifness_nm_per_rad"),
        (misspelt, "Did you mean stiffness_nm_per_rad?"),
        (unitless, "joints.LF_hip.selection.candidate_models[1].rmse_fresh has no unit"),
        (unitless, "name it rmse_fresh_rad"), (milliseconds, "this file holds it in s"),
        (replaced("      delay_steps_min: 10\n", ""), "smallest dead time to train with"),
        (replaced("LF_hip:", "LF_hipp:"), "LF_hipp is no joint; did you mean LF_hip"),
        (edited("joints", value={}), "joints"),
        (edited("inputs", 0, "sha256", value="abc"), "inputs[0].sha256"),
        *((edited("created", value=when), "no time in UTC")
          for when in ("yesterday", "2026-01-31T12:00:00", "2026-01-31T12:00+05:00")),
    ]  # fmt: skip
    assert_refused(file, cases)


def test_numbers_that_cannot_be_are_refused_with_what_they_probably_are(file):
    dead_time, stiffness = (*HIP, "actuator", "dead_time_s"), "stiffness_nm_per_rad"
    bare = edited(*dead_time, value=25)
    cases = [(bare, "bare number"), (bare, "milliseconds"), (bare, "{value: …"),
             (edited(*dead_time, "high", value=32), "milliseconds")]  # fmt: skip
    for part, name, value, says in (
        ("actuator", "dead_time_s", 25, "looks like milliseconds: write 0.025"),
        ("feedback", "poll_period_s", 26.85, "looks like milliseconds: write 0.02685"),
        ("feedback", "loss", 42, "looks like percent: write 0.42"),
        ("feedback", "quantum_rad", 0.33, "looks like degrees"),
        ("feedback", "offset_rad", 45, "looks like degrees: write 0.785398"),
        ("actuator", "effort_limit_nm", 350, "looks like N·mm: write 0.35"),
        ("actuator", "velocity_limit_rad_s", 2600, "looks like degrees per second"),
        ("actuator", stiffness, -1, "-1 is outside the possible 0 to"),
        ("actuator", "armature_kg_m2", 0, "0 is outside the possible"),
        ("feedback", "loss", 1.0, "1 is outside the possible"),
    ):
        change = edited(*HIP, part, name, value={"value": value, "identified": "yes"})
        cases += [(change, f"joints.LF_hip.{part}.{name}"), (change, says)]
    for value, says in (
        ("11 N·m", "is the text '11 N·m'. Write the number only, in N·m/rad"),
        (math.nan, "is nan. Write a finite number, in N·m/rad"),
        (math.inf, "is inf. Write a finite number"), ("nan", "is nan. Write a finite number"),
        (None, "is null. Write a number, in N·m/rad"), (True, "is True. Write a number"),
        ([1.0], "Write a number"),
    ):  # fmt: skip
        change = edited(*HIP, "actuator", stiffness, "value", value=value)
        cases += [(change, f"joints.LF_hip.actuator.{stiffness}.value"), (change, says)]
    assert_refused(file, cases)


def test_an_entry_of_the_wrong_kind_is_refused(file):
    cases = []
    for place, value, says in (
        (("actuator", "dead_time_s", "identified"), "maybe", "'yes', 'ratio only' or 'no'"),
        (("actuator", "dead_time_s", "identified"), True, "'yes', 'ratio only' or 'no'"),
        (("actuator", "dead_time_s", "low"), 0.5, "low must not exceed high"),
        (("actuator", "velocity_limit_rad_s", "why"), None, "`why` must give the reason"),
        (("actuator", "delay_steps_min"), 20, "swap them"),
        (("actuator", "delay_steps_min"), -1, "greater than or equal to 0"),
        (("actuator", "scale", "anchor"), "guess", "'loaded recording'"),
        (("feedback", "loss"), "much", "Write"),
        (("feedback", "loss"), True, "Write"),
        (("scores", "rmse_free_run_held_rad"), -0.1, "greater than or equal to 0"),
    ):
        change = edited(*HIP, *place, value=value)
        cases += [(change, f"joints.LF_hip.{place[0]}"), (change, says)]
    assert_refused(file, cases)


# ----- calibration files under hypothesis: round trips, any text and any numbers

TEXT = st.text(max_size=20)
SMALL = st.floats(0, 0.05)


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("calibration") / "calibrated.yaml"


@st.composite
def quantities(draw) -> Quantity:
    low, value, high = sorted(draw(st.tuples(SMALL, SMALL, SMALL)))
    identified = draw(st.sampled_from(["yes", "ratio only", "no"]))
    why = draw(st.text(min_size=1, max_size=20))
    if identified == "no" and draw(st.booleans()):
        return Quantity(value=value, identified="no", why=why)
    return Quantity(value=value, low=low, high=high, identified=identified, why=why)


@st.composite
def calibrations(draw) -> Calibration:
    joints = {}
    for name in draw(st.lists(st.sampled_from(JOINT_NAMES), min_size=1, max_size=3, unique=True)):
        plain = joint_calibration(draw(st.floats(0, 1e5)))
        feedback = {key: draw(quantities()) for key in ("poll_period_s", "loss", "offset_rad")}
        joints[name] = plain.model_copy(
            update={
                "actuator": plain.actuator.model_copy(update={"dead_time_s": draw(quantities())}),
                "feedback": plain.feedback.model_copy(update=feedback),
                "warnings": tuple(draw(st.lists(TEXT, max_size=2))),
            }
        )
    made = calibration(**joints)
    return made.model_copy(
        update={"robot": draw(TEXT), "notes": tuple(draw(st.lists(TEXT, max_size=2)))}
    )


@settings(max_examples=25)
@given(calibrations())
def test_any_calibration_that_is_saved_reads_back(path, made):
    made.save(path, force=True)
    found = load_calibration(path)
    assert found.model_dump() == made.model_dump() | {"joints": found.model_dump()["joints"]}
    assert found.joints == made.joints
