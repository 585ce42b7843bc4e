"""Recordings: what is written is read back, and what cannot be used is refused in a sentence."""

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from common.errors import FileExistsRefusal, InputError, PupperError
from sysid.recording import RecordingWriter, load, newest_recording
from sysid.recording_table import REQUIRED_COLUMNS

HEADER = "send_time_s,read_time_s,trial,joint,frequency_hz,command_rad,position_rad"


def rows(count=40, joint="LF_hip", trial=0):
    """Lines of a plausible recording."""
    return [
        f"{0.019 * k:.6f},{0.019 * k + 0.0005:.6f},{trial},{joint},1.0,"
        f"{0.3 * np.sin(0.12 * k):.6f},{0.3 * np.sin(0.12 * (k - 3)):.6f}"
        for k in range(count)
    ]


def write(tmp_path, lines, header=HEADER, top=("# pupper-sysid recording", "# schema_version: 1")):
    path = tmp_path / "log.csv"
    path.write_text("\n".join([*top, header, *lines, '# completed: {"rows": 1}', ""]))
    return path


def test_what_the_writer_writes_load_reads_back(tmp_path):
    path = tmp_path / "out" / "a.csv"
    with RecordingWriter(path, {"start_pose_rad": {"LF_hip": 0.5}, "seed": 3}) as writer:
        for k in range(30):
            writer.append(
                {"send_time_s": 0.02 * k, "read_time_s": 0.02 * k + 0.001, "trial": 0,
                 "joint": "LF_hip", "frequency_hz": 2.0, "command_rad": 0.01 * k,
                 "position_rad": float("nan") if k == 5 else 0.02 * k, "position_count": 512 + k}
            )  # fmt: skip
        writer.close({"rows": 30})
    recording = load(path)
    (trial,) = recording.trials("LF_hip")
    np.testing.assert_allclose(trial.command_rad, 0.01 * np.arange(30))
    assert np.isnan(trial.position_rad[5]) and trial.position_count[7] == 519
    assert trial.initial_command_rad == 0.5 and recording.metadata["seed"] == 3
    assert recording.metadata["completed"] == {"rows": 30}


def test_rows_are_on_disk_before_the_next_is_appended(tmp_path):
    path = tmp_path / "a.csv"
    writer = RecordingWriter(path, {})
    row = dict(zip(HEADER.split(","), [0.0, 0.1, 0, "LF_hip", 1.0, 0.2, 0.3], strict=True))
    writer.append(row)
    assert path.read_text().count("LF_hip") == 1
    writer.close()


def test_an_existing_file_is_kept_without_force(tmp_path):
    path = write(tmp_path, rows())
    before = path.read_bytes()
    with pytest.raises(FileExistsRefusal, match="--force"):
        RecordingWriter(path, {})
    assert path.read_bytes() == before


def test_a_file_cut_in_the_middle_of_a_line_loads_without_that_line(tmp_path):
    path = tmp_path / "cut.csv"
    path.write_text("\n".join(["# pupper-sysid recording", HEADER, *rows(40)])[:-30])
    recording = load(path)
    assert len(recording.table) == 39
    assert any("cut short" in w for w in recording.warnings)
    assert any("not recorded to its end" in w for w in recording.warnings)


def changed(index, column, text):
    """Rows with one cell replaced."""
    lines = rows()
    cells = lines[index].split(",")
    cells[HEADER.split(",").index(column)] = text
    lines[index] = ",".join(cells)
    return lines


# fmt: off
def without_last_cell(lines):
    """Lines whose last cell is empty."""
    return [line.rsplit(",", 1)[0] + "," for line in lines]


def times(scale):
    """Rows whose send and read times are in another unit."""
    cells = [line.split(",", 2) for line in rows()]
    return [f"{scale * float(a):.3f},{scale * float(b):.3f},{rest}" for a, b, rest in cells]


# the header stands on line 3, so that rows()[k] stands on line k + 4
BAD = {
    "no rows": ([], HEADER, "no rows"),
    "missing column": (rows(), HEADER.replace(",position_rad", ",x"), "position_rad is missing"),
    "renamed column": (rows(), HEADER.replace("command", "comand"), "Was 'comand_rad' meant"),
    "text in a number": (changed(3, "position_rad", "hello"), HEADER, "line 7, .*'hello' is not a"),
    "digits with underscore": (changed(3, "command_rad", "0_1"), HEADER, "line 7, .*not a number"),
    "infinite": (changed(3, "command_rad", "inf"), HEADER, "line 7, .*infinite"),
    "one row": (rows(1), HEADER, "1 usable rows"),
    "trials of one row": ([rows(trial=k)[k] for k in range(40)], HEADER, "40 usable rows"),
    "no position at all": (without_last_cell(rows()), HEADER, "bus never answered"),
    "no time at all": (["," + r.split(",", 1)[1] for r in rows()], HEADER, "column send_time_s"),
    "times backwards": (changed(25, "send_time_s", "0.0101"), HEADER, "line 29, .*runs backwards"),
    "clock standing still": ([f"{k},7,0,LF_hip,,0,0" for k in range(9)], HEADER, "stands still"),
    "milliseconds": (times(1000), HEADER, "looks like milliseconds"),
    "one wild time": (changed(39, "send_time_s", "1e300"), HEADER, "wrong time stamp"),
    "degrees": (changed(8, "position_rad", "45.0"), HEADER, "line 12, .*looks like degrees"),
    "degrees in the command": (changed(8, "command_rad", "-30"), HEADER, "looks like degrees"),
    "another length": ([*rows()[:10], "0.5,0.5,0", *rows()[11:]], HEADER, "line 14: 3 cells where"),
    "quote left open": (changed(3, "joint", '"LF_hip'), HEADER, "line 7: 4 cells where"),
    "endless cell": (changed(3, "joint", "9" * 200_000), HEADER, "line 7: field larger"),
    "semicolons": ([r.replace(",", ";") for r in rows()], HEADER.replace(",", ";"), "by ';', not"),
    "unknown joint": (rows(joint="LF_hipp"), HEADER, "line 4, .*did you mean LF_hip"),
    "column twice": (rows(), HEADER.replace("read_time_s", "send_time_s"), "stands twice"),
    "half a trial": (changed(3, "trial", "0.5"), HEADER, "line 7, .*0.5 is not a whole"),
    "two tones in one trial": (changed(3, "frequency_hz", "2"), HEADER, "line 7, .*changes within"),
    "tone of no frequency": (changed(3, "frequency_hz", "0"), HEADER, "line 7, .*is positive"),
    "huge count": ([r + ",1e300" for r in rows()], HEADER + ",position_count", "not a whole"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_in_a_sentence_that_names_the_file(tmp_path, case):
    lines, header, said = BAD[case]
    path = write(tmp_path, lines, header)
    with pytest.raises(InputError, match=said) as refusal:
        load(path)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"  \n ", "is empty"),
        (b"\x00\x01\x02PNG", "not a text file"),
        (b"\xff\xfe\xfa\xfb" * 50, "not a text file"),
        (b"hello world\n", "no rows"),
    ],
)
def test_files_that_are_no_recording_are_refused(tmp_path, content, said):
    path = tmp_path / "x.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        load(path)


BAD_HEADERS = {
    "newer": ("schema_version: 2", "newer pupper-sysid.*Upgrade"),
    "version as text": ('schema_version: "1"', "schema_version: Input should be a valid integer"),
    "start pose of no number": ('start_pose_rad: {"LF_hip": NaN}', "start_pose_rad.LF_hip"),
    "start pose in degrees": ('start_pose_rad: {"LF_hip": 45}', "looks like degrees"),
    "negative quantum": ('bus: {"command_quantum_rad": -0.1}', "bus.command_quantum_rad"),
    "unknown rounding": ('bus: {"command_rounding": {"LF_hip": "left"}}', "'up' or 'down'"),
    "no JSON": ("seed: __import__('os')", "line 2: the value of 'seed' is not JSON"),
    "too deep": ("seed: " + "[" * 100_000, "line 2: .*not JSON"),
}


@pytest.mark.parametrize("case", BAD_HEADERS)
def test_a_header_that_cannot_be_meant_is_refused(tmp_path, case):
    line, said = BAD_HEADERS[case]
    path = write(tmp_path, rows(), top=("# pupper-sysid recording", f"# {line}"))
    with pytest.raises(InputError, match=said) as refusal:
        load(path)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_file_too_large_for_memory_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "large.csv"
    path.touch()
    os.truncate(path, 500_000_001)  # sparse: takes no room
    with pytest.raises(InputError, match="more than 500 MB"):
        load(path)


def test_the_truth_beside_a_recording_is_not_taken_for_one(tmp_path):
    (tmp_path / "a.truth.csv").write_text("x")
    with pytest.raises(InputError, match="truth"):
        load(tmp_path / "a.truth.csv")
    with pytest.raises(InputError, match="pupper-sysid sweep"):
        newest_recording(tmp_path)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load(tmp_path / "nothing.csv")


def test_rows_without_a_reading_are_kept_and_said(tmp_path):
    recording = load(write(tmp_path, changed(3, "position_rad", "")))
    assert any("missing" in w for w in recording.warnings)
    assert np.isnan(recording.trials("LF_hip")[0].position_rad[3])


def test_a_repeated_time_stamp_costs_one_row_and_is_said(tmp_path):
    lines = rows()
    recording = load(write(tmp_path, [*lines[:11], *lines[10:]]))
    assert len(recording.table) == 40
    assert recording.warnings == ("1 rows with a repeated time stamp were left out.",)


def test_a_joint_that_had_just_begun_when_the_sweep_was_killed_does_not_spoil_the_others(tmp_path):
    recording = load(write(tmp_path, [*rows(), *rows(2, "LF_calf", 1), *rows(9, "RF_hip", 2)]))
    assert recording.joints == ["LF_hip"] and len(recording.table) == 40
    assert any("trial 1 of LF_calf has only 2 rows and was left out" in w for w in recording.warnings)
    assert any("RF_hip has only 9 rows and was left out" in w for w in recording.warnings)


def test_a_joint_that_never_answered_is_named_and_the_others_are_used(tmp_path):
    silent = without_last_cell(rows(40, "LF_thigh", 1))
    recording = load(write(tmp_path, [*rows(), *silent]))
    assert "LF_thigh has no position at all." in recording.warnings
    assert np.isfinite(recording.trials("LF_hip")[0].position_rad).all()


@pytest.mark.parametrize("footer", ['# completed: {"ro', "# completed", "#"])
def test_a_footer_cut_short_costs_no_row(tmp_path, footer):
    path = tmp_path / "cut.csv"
    path.write_text("\n".join(["# pupper-sysid recording", HEADER, *rows(), footer]))
    recording = load(path)
    assert len(recording.table) == 40
    assert recording.warnings == ("it was not recorded to its end; what is there is used.",)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_of_any_editor_and_a_lost_last_one_change_nothing(tmp_path, end):
    whole = load(write(tmp_path, rows()))
    path = tmp_path / "edited.csv"
    path.write_bytes(end.join((tmp_path / "log.csv").read_text().split("\n")).encode().rstrip())
    edited = load(path)
    assert edited.table.equals(whole.table) and edited.warnings == ()


def test_the_hash_is_that_of_the_file_even_behind_a_byte_order_mark(tmp_path):
    path = write(tmp_path, rows())
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load(path).sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_columns_of_the_users_own_are_left_alone(tmp_path):
    recording = load(write(tmp_path, [r + ",windy" for r in rows()], HEADER + ",note"))
    assert list(recording.table.columns) == list(REQUIRED_COLUMNS)


def test_what_only_the_doctor_can_judge_still_loads(tmp_path):
    constant = [r.rsplit(",", 1)[0] + ",0.1" for r in rows()]
    swapped = [",".join([*r.split(",")[:5], r.split(",")[6], r.split(",")[5]]) for r in rows()]
    for lines in (constant, swapped):
        assert load(write(tmp_path, lines)).warnings == ()


def test_trials_come_in_time_order_whatever_their_numbers_and_are_made_once(tmp_path):
    late = [f"{9 + 0.019 * k:.4f},{9.001 + 0.019 * k:.4f},3,LF_hip,,0,0" for k in range(40)]
    recording = load(write(tmp_path, [*late, *rows(trial=7)]))
    assert [t.number for t in recording.trials("LF_hip")] == [7, 3]
    assert recording.trials("LF_hip")[0] is recording.trials("LF_hip")[0]
    assert recording.trials("RB_calf") == []
    assert recording.loop_period_s == pytest.approx(0.019)


def test_the_first_command_stands_in_for_a_start_pose_that_is_not_known(tmp_path):
    lines = changed(0, "command_rad", "0.25")
    assert load(write(tmp_path, lines)).trials("LF_hip")[0].initial_command_rad == 0.25


def test_the_newest_recording_is_the_one_written_last_and_never_a_truth(tmp_path):
    for age, name in ((30, "old.csv"), (20, "new.csv"), (10, "new.truth.csv")):
        (tmp_path / name).write_text("x")
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    assert newest_recording(tmp_path).name == "new.csv"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full disk to offer")
def test_a_full_disk_is_said_in_a_sentence():
    with pytest.raises(PupperError, match="/dev/full cannot be written: No space left"):
        RecordingWriter(Path("/dev/full"), {}, force=True)
