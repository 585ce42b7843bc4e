"""Fits under load as servo cards: what sets the scale of torques, and what stays open."""

import io
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.card_of_fits import to_card, to_drive_card
from pupper_sysid.common.errors import FileExistsRefusal
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.calibration.parts import Scores
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.cards.card import Source
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.cards.numbers import LoadedLoop, TorquePD
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.fit.results import LoadedFit, StructureFit
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report.tables import CALIBRATION_COLUMNS, tidy_table
from support.refusals import assert_each_refused

SOURCE = Source(title="a bench", url="https://example.org/bench", licence="MIT")
PER_INERTIA = {
    "dead_time_s": 0.01, "duty_per_rad": 0.2, "stall_torque": 100.0, "back_emf": 25.0,
    "friction_loss": 4.0, "stiffness_nm_per_rad": 320.0, "no_load_speed_rad_s": 4.0,
}  # fmt: skip


def fit() -> LoadedFit:
    """A joint whose load is unknown: torques per inertia, intervals of ±10 %."""
    time = 0.02 * np.arange(40)
    recording = Recording.from_arrays(
        time, {"j": np.sin(time)}, {"j": np.sin(time)}, metadata={"readings": "live"}
    )
    lattice = find_poll_lattice(recording.trials("j"), np.random.default_rng(0))
    names = ("duty_per_rad", "stall_torque", "back_emf", "friction_loss", "dead_time_s")
    servo = LoadedServoParameters(
        duty_s_per_rad=0.0, armature=1.0, **{n: PER_INERTIA[n] for n in names}
    )
    return LoadedFit(
        joint="j", structure="base", known_load=False, p_gain=16.0, p_gains=(16.0,),
        loads=((0.0, 0.0),), reference_voltage_v=float("nan"),
        numbers={n: Interval(v, 0.9 * v, 1.1 * v) for n, v in PER_INERTIA.items()},
        undecided={"friction_loss": "it cannot be distinguished from none"},
        structures=(StructureFit(
            name="base", parameters={}, mae_rad=0.002, rmse_rad=0.003,
            mae_unseen_rad=float("nan"), nats=0.0,
        ),),
        folds=(), mae_by_run_rad={}, motor_torque_nm=1.0, temperature=1.0, lattice=lattice,
        servo=servo, runs=(),
    )  # fmt: skip


def test_the_stall_torque_of_the_data_sheet_sets_the_scale_where_the_load_is_unknown():
    def made(fits, **more):
        return to_card("mine", "Feetech STS3215", fits, [], SOURCE, "an arm", **more)

    card = made({"j": fit()}, supply_v=12.0)
    numbers = card.numbers
    assert isinstance(numbers, LoadedLoop)
    stall = 30 * 0.0980665  # kg·cm of its data sheet
    assert numbers.stall_torque_nm.value == pytest.approx(stall)
    # torques are per inertia in the fit, so the inertia is the scale
    assert numbers.armature_kg_m2.value == pytest.approx(stall / 100.0)
    assert numbers.armature_kg_m2.identified == "no"
    assert numbers.back_emf_nm_s_per_rad.value == pytest.approx(25.0 * stall / 100.0)
    assert numbers.duty_per_rad.value == 0.2  # no torque: no scale
    assert card.gains.p == 16.0 and not card.published
    assert_each_refused([({}, "needs a fit"), ({"j": fit()}, "no supply voltage")], made)


def test_gains_in_newton_metres_set_the_scale_of_a_drive(tmp_path):
    card = to_drive_card(
        "drive", "RobStride 04", {"j": fit()}, {"j": (150.0, 60.0)}, [], SOURCE, "a leg"
    )
    numbers = card.numbers
    assert isinstance(numbers, TorquePD)
    assert numbers.stiffness_nm_per_rad.value == 150.0
    assert numbers.armature_kg_m2.value == pytest.approx(150.0 / 320.0)
    damping = numbers.damping_nm_s_per_rad
    assert damping is not None and damping.value == pytest.approx(25.0 * 150.0 / 320.0)
    assert damping.low == pytest.approx(0.9 * damping.value) and damping.identified == "yes"
    assert numbers.friction_loss_nm.why == "it cannot be distinguished from none"
    assert numbers.effort_limit_nm.value == 60.0 and numbers.effort_limit_nm.identified == "no"


def test_the_drives_measured_damping_agrees_with_the_gain_that_was_set():
    for name in ("robstride-02", "robstride-03", "robstride-04"):
        card = load_card(name)
        for specimen, numbers in card.specimens.items():
            (note,) = (n for n in card.notes if n.startswith(f"{specimen}:"))
            set_gain = float(note.split("D gain ")[1].split()[0])
            assert isinstance(numbers, TorquePD) and numbers.damping_nm_s_per_rad is not None
            assert numbers.damping_nm_s_per_rad.value == pytest.approx(set_gain, rel=0.25)


# ----- export: the tables hold every number of their source, and spreadsheets and pandas read them

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


def test_a_number_keeps_its_value_interval_and_reason_exactly():
    table = table_of(tidy_table(with_one_measurement()))
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


def test_a_calibration_becomes_one_row_per_joint_and_quantity_with_its_unit_and_source():
    paper = load_calibration("paper")
    table = table_of(tidy_table(paper))
    assert tuple(table.columns) == CALIBRATION_COLUMNS
    assert not table.duplicated(["joint", "part", "quantity"]).any()
    quantities = table[table.identified.notna()]
    assert quantities.groupby("joint", sort=False).size().to_dict() == dict.fromkeys(
        JOINT_NAMES, QUANTITIES_PER_JOINT
    )
    assert set(table[table.identified.isna()].quantity) == PLAIN_NUMBERS
    lines = [line[2:] for line in tidy_table(paper).splitlines() if line.startswith("# ")]
    assert lines[0] == "pupper-sysid calibration table"
    said = {key: json.loads(value) for key, _, value in (s.partition(": ") for s in lines[1:])}
    assert said["schema"] == "pupper-calibration" and said["schema_version"] == 5
    assert said["created"] == paper.created and said["units"] == paper.units
    assert said["notes"] == list(paper.notes)
    # the same quantity over and not over the armature are kept apart
    table = table_of(tidy_table(load_calibration("release"))).set_index(
        ["joint", "part", "quantity"]
    )
    assert table.loc[("RB_calf", "actuator", "stiffness_nm_per_rad"), "unit"] == "N·m/rad"
    ratio = table.loc[("RB_calf", "ratios_to_armature", "stiffness")]
    assert (ratio["value"], ratio["unit"]) == (80.0 / 0.005, "1/s²")


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
    table = table_of(tidy_table(imported))
    assert set(table.joint) == {"LF_thigh"} and set(table.frequency_hz) == {1.0, 2.0}
    assert len(table) == 240 and (np.diff(table.send_time_s) > 0).all()
    path = tmp_path / "exported.csv"
    tidy_table(imported, path)
    with pytest.raises(FileExistsRefusal):
        tidy_table(imported, source)
    assert source.read_bytes() == before
    again = load(path)
    # whole numbers may come back as floats; their values must not change
    pd.testing.assert_frame_equal(again.table, imported.table, check_dtype=False, check_exact=True)
    assert again.warnings == imported.warnings, "an export does not look like a cut recording"
    assert again.metadata["exported_from"] == {"name": imported.name, "sha256": imported.sha256}
    assert {k: again.metadata[k] for k in imported.metadata} == imported.metadata


def test_a_recording_that_was_cut_short_still_says_so_after_its_export(tmp_path: Path):
    cut = tmp_path / "cut.csv"
    tidy_table(load(sweep_file(tmp_path)), cut)
    text = cut.read_text().replace('# imported_from: "single-joint sweep"\n', "")
    cut.write_text(text[: text.index("# completed")].rstrip("\n")[:-4])
    exported = tmp_path / "exported.csv"
    tidy_table(load(cut), exported)
    again = load(exported)
    assert len(again.table) == 239
    assert any("not recorded to its end" in warning for warning in again.warnings)
    said = again.metadata["warnings_when_exported"]
    assert any("cut short" in warning for warning in said)
