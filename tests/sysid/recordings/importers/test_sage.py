"""SAGE folders: lists in cells, microseconds, and one time stamp for a whole turn."""

import ast

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.files import load
from support.real_recordings import real_folder
from support.refusals import assert_each_refused

SO101 = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")


def folder(tmp_path, joints=SO101, count=60, stamps=None, late_us=0.0):
    """A folder in which joint k is commanded k + 0.001 n and read 0.01 behind."""
    stamps = 20000.0 * np.arange(count) if stamps is None else stamps
    for name, kind, behind, shift in (
        ("control", "CONTROL", 0.0, 0.0), ("state_motor", "STATE_MOTOR", 0.01, late_us),
    ):  # fmt: skip
        lines = ["type,timestamp,positions" + (",velocities,torques" if behind else "")]
        for n, stamp in enumerate(stamps):
            cells = [0.1 * k + 0.001 * n - behind for k in range(len(joints))]
            rest = ',"[]","[]"' if behind else ""
            lines.append(f'{kind},{stamp + shift},"{cells}"{rest}')
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "joint_list.txt").write_text("\n".join(joints) + "\n")
    return tmp_path


def test_joint_after_joint_is_written_and_then_read(tmp_path):
    """Six writes of 0.75 ms, then three reads for each joint, the position first."""
    recording = load(folder(tmp_path))
    for k, joint in enumerate(SO101[:5]):
        (trial,) = recording.trials(joint)
        between = (6 + 3 * k - k) * 0.00075
        np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, between, atol=1e-9)
        np.testing.assert_allclose(np.diff(trial.send_time_s), 0.02)
        assert trial.read_time_doubt_s == 0.0015 and trial.servo.p_gain == 16


def test_another_robots_stamp_is_in_doubt_by_half_a_turn_and_two_clocks_are_joined(tmp_path):
    recording = load(folder(tmp_path, ("hip_yaw", "knee")))
    (trial,) = recording.trials("knee")
    assert trial.read_time_doubt_s == pytest.approx(0.01) and trial.servo.model is None
    np.testing.assert_array_equal(trial.read_time_s, trial.send_time_s)
    assert any("one time stamp" in text for text in recording.warnings)
    # by the command in force
    (trial,) = load(folder(tmp_path, ("hip_yaw", "knee"), late_us=3000.0)).trials("knee")
    np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, 0.003)
    np.testing.assert_allclose(trial.command_rad - trial.position_rad, 0.01)


def test_a_file_that_is_missing_or_a_torn_cell_is_named(tmp_path):
    broken = folder(tmp_path)
    text = (broken / "control.csv").read_text()
    (broken / "control.csv").write_text(text.replace("[0.003,", "[0.003; ", 1))
    with pytest.raises(InputError, match=r"control.csv, line 5: .* a list of 6 numbers"):
        load(broken)
    (broken / "control.csv").write_text(text.replace("timestamp", "stamp"))
    with pytest.raises(InputError, match="column timestamp is missing"):
        load(broken)
    (broken / "joint_list.txt").unlink()
    with pytest.raises(InputError, match=r"joint_list.txt does not exist"):
        load(broken)


def test_impossible_column_names_are_answered_in_a_sentence(tmp_path):
    broken = folder(tmp_path)
    text = (broken / "control.csv").read_text()

    def read(start):
        (broken / "control.csv").write_text(start + text, newline="")
        try:
            load(broken)
        except InputError as refused:
            assert len(str(refused)) < 1000
            raise

    cases = [("x" * 99_000 + ",", "the name of a column has 99,000 characters"),
             ("{}," * 50_000, "50,003 columns"),
             ("a\rb,", "timestamp, positions is missing")]  # fmt: skip
    assert_each_refused(cases, read, names="control.csv")


def test_a_motion_of_the_so101_is_read_in_radians():
    path = real_folder("sage_so101/step_response")
    recording = load(path)
    assert set(recording.joints) == set(SO101)
    state = pd.read_csv(path / "state_motor.csv")
    wanted = np.array([ast.literal_eval(cell) for cell in state["positions"]])
    for k, joint in enumerate(SO101):
        (trial,) = recording.trials(joint)
        assert len(trial.send_time_s) == 6000
        scale = 1.0 if k < 5 else np.median(trial.position_rad / wanted[:, 5])
        np.testing.assert_allclose(trial.position_rad, scale * wanted[:, k], rtol=1e-12)
        counts = np.diff(trial.position_rad) * 4096 / (2 * np.pi)
        np.testing.assert_allclose(counts, np.round(counts), atol=0.02)
    assert any("Jaw is logged as a share" in text for text in recording.warnings)
