"""Calibration files that cannot be trusted are refused in one sentence that says what to do."""

from __future__ import annotations

import math
import time
from pathlib import Path

import pytest
import yaml

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.strict_yaml import dump
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from support.calibration_examples import calibration


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "calibrated.yaml"
    calibration().save(path)
    return path


def refusal(path: Path, old: str, new: str) -> str:
    """The sentence with which `path` is refused once `old` reads `new`."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_calibration(path)
    message = str(caught.value)
    assert str(path) in message, "a refusal names the file"
    assert message.endswith((".", ".)")), "a refusal is a sentence"
    return message


def edited(path: Path, *keys: str | int, value: object) -> str:
    """The sentence with which `path` is refused once the entry at `keys` is `value`."""
    data = yaml.safe_load(path.read_text())
    place = data
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    path.write_text(dump(data))
    with pytest.raises(InputError) as caught:
        load_calibration(path)
    message = str(caught.value)
    assert str(path) in message
    return message


HIP = ("joints", "LF_hip")


def test_a_missing_file_is_refused_and_a_misspelt_preset_is_recognised(tmp_path):
    with pytest.raises(InputError, match=r"does not exist.*Presets: paper, release"):
        load_calibration(tmp_path / "nothing.yaml")
    with pytest.raises(InputError, match="Did you mean the preset release"):
        load_calibration("relaese")
    with pytest.raises(InputError, match="Did you mean the servo card sts3215-bam-m6"):
        load_calibration("sts3215-bam-m66")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"# only a comment\n", "is empty"),
        (b"\x7fELF\x02\x01\x00\xff\xfe", "not a text file"),
        (b"a\x00b", "not valid YAML"),
        (b"- 1\n- 2\n", "is not a calibration"),
        (b"just text\n", "is not a calibration"),
        (b"robot: dog\n", "schema: pupper-calibration"),
        (b"schema: [unclosed\n", "not valid YAML: line"),
        (b"a: 1\n---\nb: 2\n", "several YAML documents"),
        (b"a: &x 1\nb: *x\n", "alias or anchor"),
        (b"a: !!python/object/apply:os.getcwd []\n", "YAML tag"),
        (b"a: !!float 1\n", "YAML tag"),
        (b"? [1, 2]\n: 3\n", "not a plain word"),
        (b"&x a: 3\n", "not a plain word"),
        (b"a:\n  b: 1\n  b: 2\n", "line 3, a.b stands in the file twice"),
        (b"[" * 1_000_000, "more than 20 levels of nesting"),
        (b"schema: pupper-calibration\n", "schema_version is null"),
        (b"schema: pupper-calibration\nschema_version: true\n", "schema_version is True"),
        (
            b"schema: pupper-calibration\nschema_version: 0\n",
            "schema_version is 0; this version reads 4",
        ),
        (b"schema: pupper-calibration\nschema_version: 5\nnew: 1\n", "newer version.*Upgrade"),
    ],
)
def test_what_is_no_calibration_is_refused_with_what_is_wrong(tmp_path, content, says):
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        load_calibration(path)
    assert str(path) in str(caught.value)


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match="is not a file"):
        load_calibration(tmp_path)


@pytest.mark.wall_clock
def test_ten_megabytes_of_aliases_are_refused_at_once(tmp_path):
    path = tmp_path / "bomb.yaml"
    path.write_text("a: &a [x, x]\nb: [" + "*a, " * 2_500_000 + "*a]\n")
    assert path.stat().st_size > 10_000_000
    start = time.perf_counter()
    with pytest.raises(InputError, match=r"at most 2\.0 MB are read"):
        load_calibration(path)
    assert time.perf_counter() - start < 1.0


@pytest.mark.wall_clock
def test_a_billion_laughs_are_refused_before_anything_unfolds(tmp_path):
    levels = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    levels += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 10)]
    path = tmp_path / "laughs.yaml"
    path.write_text("schema: pupper-calibration\nschema_version: 1\n" + "\n".join(levels))
    start = time.perf_counter()
    with pytest.raises(InputError, match=r"line 3 uses a YAML alias or anchor"):
        load_calibration(path)
    assert time.perf_counter() - start < 1.0


def test_an_unknown_key_is_refused_with_its_line_and_the_nearest_key(file):
    line = next(i for i, t in enumerate(file.read_text().splitlines(), 1) if "stiffness_nm" in t)
    message = refusal(file, "stiffness_nm_per_rad", "stifness_nm_per_rad")
    assert f"line {line}: joints.LF_hip.actuator.stifness_nm_per_rad" in message
    assert "Did you mean stiffness_nm_per_rad?" in message


def test_an_unknown_key_that_resembles_none_is_refused_with_the_list_of_keys(file):
    message = edited(file, *HIP, "feedback", "colour", value="red")
    assert "joints.LF_hip.feedback.colour is not a key" in message
    assert "poll_period_s, loss" in message


def test_an_unknown_key_inside_a_list_is_refused_with_its_place(file):
    message = edited(file, *HIP, "selection", "candidate_models", 1, "rmse_fresh", value=0.1)
    assert "joints.LF_hip.selection.candidate_models[1].rmse_fresh has no unit" in message
    assert "name it rmse_fresh_rad" in message


@pytest.mark.parametrize(
    ("part", "right", "wrong", "unit"),
    [
        ("actuator", "dead_time_s", "dead_time_ms", "in s"),
        ("actuator", "stiffness_nm_per_rad", "stiffness_nm_per_deg", "in N·m/rad"),
        ("actuator", "velocity_limit_rad_s", "velocity_limit_rpm", "in rad/s"),
        ("actuator", "effort_limit_nm", "effort_limit", "in N·m"),
        ("feedback", "quantum_rad", "quantum_deg", "in rad"),
    ],
)
def test_a_key_in_another_unit_is_refused_with_the_unit_of_this_file(
    file, part, right, wrong, unit
):
    message = refusal(file, f"  {right}:", f"  {wrong}:")
    assert f"joints.LF_hip.{part}.{wrong}" in message
    assert unit in message and f"name it {right}" in message


@pytest.mark.parametrize(
    ("part", "name", "value", "says"),
    [
        ("actuator", "dead_time_s", 25, "looks like milliseconds: write 0.025"),
        ("feedback", "poll_period_s", 26.85, "looks like milliseconds: write 0.02685"),
        ("feedback", "loss", 42, "looks like percent: write 0.42"),
        ("feedback", "quantum_rad", 0.33, "looks like degrees"),
        ("feedback", "offset_rad", 45, "looks like degrees: write 0.785398"),
        ("actuator", "effort_limit_nm", 350, "looks like N·mm: write 0.35"),
        ("actuator", "velocity_limit_rad_s", 2600, "looks like degrees per second"),
        ("actuator", "stiffness_nm_per_rad", -1, "-1 is outside the possible 0 to"),
        ("actuator", "armature_kg_m2", 0, "0 is outside the possible"),
        ("feedback", "loss", 1.0, "1 is outside the possible"),
    ],
)
def test_an_impossible_number_is_refused_with_what_it_probably_is(file, part, name, value, says):
    quantity = {"value": value, "identified": "yes"}
    message = edited(file, *HIP, part, name, value=quantity)
    assert f"joints.LF_hip.{part}.{name}" in message and says in message


def test_an_impossible_end_of_an_interval_is_refused(file):
    message = edited(file, *HIP, "actuator", "dead_time_s", "high", value=32)
    assert "joints.LF_hip.actuator.dead_time_s" in message and "milliseconds" in message


def test_a_bare_number_in_place_of_a_quantity_is_refused_with_the_form_to_write(file):
    message = edited(file, *HIP, "actuator", "dead_time_s", value=25)
    assert "bare number" in message and "milliseconds" in message and "{value: …" in message


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("11 N·m", "is the text '11 N·m'. Write the number only, in N·m/rad"),
        (math.nan, "is nan. Write a finite number, in N·m/rad"),
        (math.inf, "is inf. Write a finite number"),
        ("nan", "is nan. Write a finite number"),
        (None, "is null. Write a number, in N·m/rad"),
        (True, "is True. Write a number"),
        ([1.0], "Write a number"),
    ],
)
def test_a_value_that_is_no_finite_number_is_refused(file, value, says):
    message = edited(file, *HIP, "actuator", "stiffness_nm_per_rad", "value", value=value)
    assert "joints.LF_hip.actuator.stiffness_nm_per_rad.value" in message and says in message


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        (("actuator", "dead_time_s", "identified"), "maybe", "'yes', 'ratio only' or 'no'"),
        (("actuator", "dead_time_s", "identified"), True, "'yes', 'ratio only' or 'no'"),
        (("actuator", "dead_time_s", "low"), 0.5, "low must not exceed high"),
        (("actuator", "velocity_limit_rad_s", "why"), None, "`why` must give the reason"),
        (("actuator", "delay_steps_min"), 20, "swap them"),
        (("actuator", "delay_steps_min"), 10.5, "Write a whole number"),
        (("actuator", "delay_steps_min"), -1, "greater than or equal to 0"),
        (("actuator", "model"), "spring", "'delayed_pd'"),
        (("actuator", "scale", "anchor"), "guess", "'loaded recording'"),
        (("actuator",), None, "mapping of keys is expected"),
        (("actuator", "scale", "source"), 0.35, "Write text"),
        (("feedback",), [1, 2], "mapping of keys is expected"),
        (("scores", "rmse_free_run_held_rad"), -0.1, "greater than or equal to 0"),
        (("scores", "rmse_free_run_held_rad"), "13 mrad", "Write the number only, in rad"),
        (("warnings",), "one sentence", "Write a list"),
    ],
)
def test_an_entry_of_the_wrong_kind_is_refused(file, place, value, says):
    message = edited(file, *HIP, *place, value=value)
    assert f"joints.LF_hip.{place[0]}" in message and says in message


def test_a_missing_key_is_refused_with_what_it_means(file):
    message = refusal(file, "      delay_steps_min: 10\n", "")
    assert "joints.LF_hip.actuator.delay_steps_min is missing" in message
    assert "smallest dead time to train with" in message


def test_a_misspelt_joint_is_refused_with_the_nearest(file):
    message = refusal(file, "LF_hip:", "LF_hipp:")
    assert "LF_hipp is no joint; did you mean LF_hip" in message


def test_no_joints_at_all_are_refused(file):
    assert "joints" in edited(file, "joints", value={})


@pytest.mark.parametrize("created", ["yesterday", "2026-01-31T12:00:00", "2026-01-31T12:00+05:00"])
def test_a_time_of_making_that_is_not_utc_is_refused(file, created):
    assert "no time in UTC" in edited(file, "created", value=created)


def test_an_input_hash_that_is_none_is_refused(file):
    assert "inputs[0].sha256" in edited(file, "inputs", 0, "sha256", value="abc")


def test_a_refusal_is_one_line_without_terminal_codes_whatever_the_file_says(file):
    message = edited(file, *HIP, "a\n\x1b[31mb", value=1)
    assert message.isprintable()


def test_further_faults_are_counted(file):
    data = yaml.safe_load(file.read_text())
    for name in ("poll_period_s", "loss", "quantum_rad"):
        data["joints"]["LF_hip"]["feedback"][name]["value"] = "x"
    file.write_text(dump(data))
    with pytest.raises(InputError, match=r"2 more faults in this file"):
        load_calibration(file)
