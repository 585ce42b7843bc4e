"""Export: the tables hold every number of their source, and spreadsheets and pandas read them."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import FileExistsRefusal
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.calibration.parts import Scores
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.sysid.export.servo_card import CALIBRATION_COLUMNS, to_csv
from pupper_sysid.sysid.recordings.files import load

QUANTITIES_PER_JOINT = 9 + 5 + 5
"""Of the actuator, of its ratios to the armature, of the feedback."""

PLAIN_NUMBERS = {"delay_steps_min", "delay_steps_max", "physics_step_s", "value_nm"}


def table_of(text: str) -> pd.DataFrame:
    return pd.read_csv(io.StringIO(text), comment="#")


def with_one_measurement() -> Calibration:
    """The preset `paper`, but for one delay with an interval and one score."""
    paper = load_calibration("paper")
    hip = paper.joints["LF_hip"]
    delay = Quantity(
        value=0.1 + 0.2, low=0.25, high=0.31, identified="yes", why='known, # and "quoted"'
    )
    measured = hip.model_copy(
        update={
            "actuator": hip.actuator.model_copy(update={"dead_time_s": delay}),
            "scores": Scores(rmse_free_run_held_rad=0.0136),
        }
    )
    return paper.model_copy(update={"joints": {**paper.joints, "LF_hip": measured}})


def test_a_calibration_becomes_one_row_per_joint_and_quantity_with_its_unit():
    table = table_of(to_csv(load_calibration("paper")))
    assert tuple(table.columns) == CALIBRATION_COLUMNS
    assert not table.duplicated(["joint", "part", "quantity"]).any()
    quantities = table[table.identified.notna()]
    assert quantities.groupby("joint", sort=False).size().to_dict() == dict.fromkeys(
        JOINT_NAMES, QUANTITIES_PER_JOINT
    )
    assert set(table[table.identified.isna()].quantity) == PLAIN_NUMBERS
    # the same quantity over and not over the armature are kept apart
    table = table_of(to_csv(load_calibration("release"))).set_index(["joint", "part", "quantity"])
    assert table.loc[("RB_calf", "actuator", "stiffness_nm_per_rad"), "unit"] == "N·m/rad"
    ratio = table.loc[("RB_calf", "ratios_to_armature", "stiffness")]
    assert (ratio["value"], ratio["unit"]) == (80.0 / 0.005, "1/s²")


def test_a_number_keeps_its_value_interval_and_reason_exactly():
    table = table_of(to_csv(with_one_measurement()))
    row = table[(table.joint == "LF_hip") & (table.quantity == "dead_time_s")].iloc[0].to_dict()
    assert row == {
        "joint": "LF_hip", "part": "actuator", "quantity": "dead_time_s", "unit": "s",
        "value": 0.1 + 0.2, "low": 0.25, "high": 0.31, "identified": "yes",
        "why": 'known, # and "quoted"',
    }  # fmt: skip
    score = table[table.part == "scores"].iloc[0]
    assert score[["quantity", "unit", "value"]].to_list() == [
        "rmse_free_run_held_rad",
        "rad",
        0.0136,
    ]


def test_the_table_of_a_calibration_says_where_it_comes_from():
    paper = load_calibration("paper")
    lines = [line[2:] for line in to_csv(paper).splitlines() if line.startswith("# ")]
    assert lines[0] == "pupper-sysid calibration table"
    said = {key: json.loads(value) for key, _, value in (s.partition(": ") for s in lines[1:])}
    assert said["schema"] == "pupper-calibration" and said["schema_version"] == 4
    assert said["created"] == paper.created and said["units"] == paper.units
    assert said["notes"] == list(paper.notes)


def test_a_table_is_written_only_where_nothing_stands_unless_forced(tmp_path: Path):
    path = tmp_path / "table.csv"
    path.write_text("mine")
    with pytest.raises(FileExistsRefusal, match="force=True"):
        to_csv(load_calibration("paper"), path)
    assert path.read_text() == "mine"
    text = to_csv(load_calibration("paper"), path, force=True)
    assert path.read_text() == text


def sweep_file(folder: Path) -> Path:
    """Two frequencies of the thigh in the single-joint layout: relative angles, times restart."""
    rows = ["time_s,phase,amp_rad,freq_hz,motor_idx,signal,command_rad,actual_rad"]
    for frequency in (1.0, 2.0):
        for i in range(120):
            time = 0.019 * i
            phase = 2 * np.pi * frequency * time
            command = 0.3 * np.sin(phase)
            actual = 0.3 * np.sin(phase - 0.2)
            rows.append(f"{time},{phase},0.3,{frequency},1,sine,{command},{actual}")
    path = folder / "sweep.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_an_exported_recording_reads_back_as_the_same_recording(tmp_path: Path):
    source = sweep_file(tmp_path)
    imported, before = load(source), source.read_bytes()
    table = table_of(to_csv(imported))
    assert set(table.joint) == {"LF_thigh"} and set(table.frequency_hz) == {1.0, 2.0}
    assert len(table) == 240 and (np.diff(table.send_time_s) > 0).all()
    path = tmp_path / "exported.csv"
    to_csv(imported, path)
    with pytest.raises(FileExistsRefusal):
        to_csv(imported, source)
    assert source.read_bytes() == before
    again = load(path)
    # whole numbers may come back as floats; their values must not change
    pd.testing.assert_frame_equal(again.table, imported.table, check_dtype=False, check_exact=True)
    assert again.warnings == imported.warnings, "an export does not look like a cut recording"
    assert again.metadata["exported_from"] == {"name": imported.name, "sha256": imported.sha256}
    assert {k: again.metadata[k] for k in imported.metadata} == imported.metadata


def test_a_recording_that_was_cut_short_still_says_so_after_its_export(tmp_path: Path):
    cut = tmp_path / "cut.csv"
    to_csv(load(sweep_file(tmp_path)), cut)
    text = cut.read_text().replace('# imported_from: "single-joint sweep"\n', "")
    cut.write_text(text[: text.index("# completed")].rstrip("\n")[:-4])
    exported = tmp_path / "exported.csv"
    to_csv(load(cut), exported)
    again = load(exported)
    assert len(again.table) == 239
    assert any("not recorded to its end" in warning for warning in again.warnings)
    said = again.metadata["warnings_when_exported"]
    assert any("cut short" in warning for warning in said)
