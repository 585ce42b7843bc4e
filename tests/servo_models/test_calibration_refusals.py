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
from support.refusals import assert_each_refused


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "calibrated.yaml"
    calibration().save(path)
    return path


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
        (head + b"schema_version: 0\n", "schema_version is 0; this version reads 4"),
        (head + b"schema_version: 5\nnew: 1\n", "newer version"),
        (head + b"schema_version: 5\nnew: 1\n", "Upgrade"),
    ]  # fmt: skip
    assert_refused(file, [(content(data), says) for data, says in contents])
    names = [
        (tmp_path, "is not a file"), (tmp_path / "nothing.yaml", "does not exist"),
        (tmp_path / "nothing.yaml", "Presets: paper, release"),
        ("relaese", "Did you mean the preset release"),
        ("sts3215-bam-m66", "Did you mean the servo card sts3215-bam-m6"),
    ]  # fmt: skip
    assert_each_refused(names, load_calibration)


def test_aliases_are_refused_before_anything_unfolds(tmp_path):
    levels = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    levels += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 10)]
    head = "schema: pupper-calibration\nschema_version: 1\n"
    (tmp_path / "laughs.yaml").write_text(head + "\n".join(levels))
    (tmp_path / "bomb.yaml").write_text("a: &a [x, x]\nb: [" + "*a, " * 2_500_000 + "*a]\n")
    assert (tmp_path / "bomb.yaml").stat().st_size > 10_000_000
    cases = [("bomb.yaml", "at most 2.0 MB are read"),
             ("laughs.yaml", "line 3 uses a YAML alias or anchor")]  # fmt: skip
    start = time.process_time()
    assert_each_refused(cases, lambda name: load_calibration(tmp_path / name))
    assert time.process_time() - start < 2.0


def test_keys_that_are_unknown_missing_or_in_another_unit_are_refused_with_the_right_one(file):
    lines = file.read_text().splitlines()
    line = next(i for i, t in enumerate(lines, 1) if "stiffness_nm" in t)
    misspelt = replaced("stiffness_nm_per_rad", "stifness_nm_per_rad")
    colour = edited(*HIP, "feedback", "colour", value="red")
    unitless = edited(*HIP, "selection", "candidate_models", 1, "rmse_fresh", value=0.1)
    missing = replaced("      delay_steps_min: 10\n", "")
    cases = [
        (misspelt, f"line {line}: joints.LF_hip.actuator.stifness_nm_per_rad"),
        (misspelt, "Did you mean stiffness_nm_per_rad?"),
        (colour, "joints.LF_hip.feedback.colour is not a key"), (colour, "poll_period_s, loss"),
        (unitless, "joints.LF_hip.selection.candidate_models[1].rmse_fresh has no unit"),
        (unitless, "name it rmse_fresh_rad"),
        (missing, "joints.LF_hip.actuator.delay_steps_min is missing"),
        (missing, "smallest dead time to train with"),
        (replaced("LF_hip:", "LF_hipp:"), "LF_hipp is no joint; did you mean LF_hip"),
        (edited("joints", value={}), "joints"),
        (edited("inputs", 0, "sha256", value="abc"), "inputs[0].sha256"),
        *((edited("created", value=when), "no time in UTC")
          for when in ("yesterday", "2026-01-31T12:00:00", "2026-01-31T12:00+05:00")),
    ]  # fmt: skip
    for part, right, wrong, unit in (
        ("actuator", "dead_time_s", "dead_time_ms", "in s"),
        ("actuator", "stiffness_nm_per_rad", "stiffness_nm_per_deg", "in N·m/rad"),
        ("actuator", "velocity_limit_rad_s", "velocity_limit_rpm", "in rad/s"),
        ("actuator", "effort_limit_nm", "effort_limit", "in N·m"),
        ("feedback", "quantum_rad", "quantum_deg", "in rad"),
    ):
        change = replaced(f"  {right}:", f"  {wrong}:")
        cases += [
            (change, f"joints.LF_hip.{part}.{wrong}"), (change, f"name it {right}"), (change, unit)
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
    ):
        change = edited(*HIP, *place, value=value)
        cases += [(change, f"joints.LF_hip.{place[0]}"), (change, says)]
    assert_refused(file, cases)


def test_a_refusal_is_one_printable_line_and_counts_further_faults(file):
    data = yaml.safe_load(file.read_text())
    hip = data["joints"]["LF_hip"]
    hip["a\n\x1b[31mb"] = 1
    for name in ("loss", "quantum_rad"):
        hip["feedback"][name]["value"] = "x"
    file.write_text(dump(data))
    with pytest.raises(InputError, match=r"2 more faults in this file") as refused:
        load_calibration(file)
    assert str(refused.value).isprintable()
