"""Recordings: what is written is read back, and what cannot be used is refused in a sentence."""

import json
import threading
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.sysid.recordings.files import RecordingWriter, load, newest_recording
from pupper_sysid.sysid.recordings.recording import Recording, Truncation
from support.refusals import assert_each_refused

HEADER = "send_time_s,read_time_s,trial,joint,frequency_hz,command_rad,position_rad"


def rows(count=40, joint="LF_hip", trial=0):
    """Lines of a plausible recording."""
    return [
        f"{0.019 * k:.6f},{0.019 * k + 0.0005:.6f},{trial},{joint},1.0,"
        f"{0.3 * np.sin(0.12 * k):.6f},{0.3 * np.sin(0.12 * (k - 3)):.6f}"
        for k in range(count)
    ]


MARK = "# pupper-sysid recording"
TOP = (MARK, "# schema_version: 1")


def text_of(lines, header=HEADER, top=TOP) -> str:
    return "\n".join([*top, header, *lines, '# completed: {"rows": 1}', ""])


def write(tmp_path, lines, header=HEADER, top=TOP):
    path = tmp_path / "log.csv"
    path.write_text(text_of(lines, header, top))
    return path


def test_a_full_disk_is_said_in_a_sentence_and_leaves_no_thread(tmp_path, monkeypatch):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    before = threading.active_count()
    opened = Path.open
    monkeypatch.setattr(
        Path,
        "open",
        lambda path, *how, **more: opened(
            Path("/dev/full") if path.name == "a.csv" else path, *how, **more
        ),
    )
    with pytest.raises(InputError, match="No space left"):
        RecordingWriter(tmp_path / "a.csv", {})
    assert threading.active_count() == before


def test_rows_are_on_disk_before_the_next_is_appended(tmp_path):
    path = tmp_path / "a.csv"
    writer = RecordingWriter(path, {})
    row = dict(zip(HEADER.split(","), [0.0, 0.1, 0, "LF_hip", 1.0, 0.2, 0.3], strict=True))
    writer.append(row)
    assert path.read_text().count("LF_hip") == 1
    writer.close()


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


def headed(line: str) -> str:
    return text_of(rows(), top=(MARK, line))


def bus(**entry) -> str:
    return headed(f"# bus: {json.dumps(entry)}")


# fmt: off
BAD = [
    ("", "is empty"), ("  \n ", "is empty"), (b"\x00\x01\x02PNG", "not a text file"),
    (b"\xff\xfe\xfa\xfb" * 50, "not a text file"), ("hello world\n", "no rows"),
    (text_of([]), "no rows"),
    (text_of(rows(), HEADER.replace(",position_rad", ",x")), "position_rad is missing"),
    (text_of(rows(), HEADER.replace("command_rad", "comand_rad")), "Was 'comand_rad' meant"),
    (text_of(rows(), HEADER.replace("read_time_s", "send_time_s")), "two columns"),
    (text_of(changed(3, "position_rad", "hello")), "line 7, column position_rad: 'hello' is not a"),
    *((text_of(changed(3, "position_rad", digits)), "line 7, column position_rad: '")
      for digits in ("0_1", "٠", "０.１", "1e-0_1")),
    (text_of(changed(3, "command_rad", "inf")), "infinite"),
    (text_of(rows(1)), "1 usable rows"),
    (text_of([r.rsplit(",", 1)[0] + "," for r in rows()]), "bus never answered"),
    (text_of(changed(25, "send_time_s", "0.0101")), "runs backwards"),
    (text_of(changed(8, "position_rad", "45.0")), "looks like degrees"),
    (text_of([*rows()[:10], "0.5,0.5,0", *rows()[11:]]), "same number of values"),
    (text_of(rows(joint="LF_hipp")), "did you mean LF_hip"),
    (text_of(changed(3, "position_rad", '"0.1')), "line 7"),
    (text_of(changed(30, "frequency_hz", "2.0")), "its own trial number"),
    (text_of([*rows(trial="0.25"), *rows(trial="0.75")]),
     "column trial: trials are counted by whole numbers"),
    *((text_of([*rows(), f"# resumed: {entry}", *rows(trial=1)]), "line 44: resumed names no trial")
      for entry in ('{"trial": Infinity}', '{"trial": 1e400}', '{"trial": 0.5}', '{"trial": true}',
                    '{"trial": "0"}', '{"trial": 10000000000}', "[0]", "null", "0")),
    ("time_s,loop,LF_hip_position_rad\n" + "0.1,0,0.1\n" * 40,
     "column LF_hip_command_rad is missing"),
    (headed("# schema_version: 2"), "newer"), (headed("# seed: __import__('os')"), "not JSON"),
    *((headed(f"# readings: {value}"), "header: readings") for value in ('"direct"', "true", "7")),
    (bus(command_quantum_rad="wide"), "header: bus.command_quantum_rad"),
    (bus(command_quantum_rad={"LF_hip": [1]}), "header: bus.command_quantum_rad"),
    (bus(command_rounding={"LF_hip": "sideways"}), "header: bus.command_rounding.LF_hip"),
    (bus(count_zero_rad={"LF_hip": "0"}), "header: bus.count_zero_rad.LF_hip"),
    (bus(read_time_doubt_s=-1), "header: bus.read_time_doubt_s"),
    (bus(speed_limit_rad_s="fast"), "header: bus.speed_limit_rad_s"),
    (bus(kind=7), "header: bus.kind"),
]
# fmt: on


def test_bad_input_is_refused_in_a_sentence_that_names_the_file(tmp_path):
    path = tmp_path / "log.csv"

    def read(content):
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        load(path)

    assert_each_refused(BAD, read, names=path)
    (tmp_path / "a.truth.csv").write_text("x")
    others = [("a.truth.csv", "truth"), ("nothing.csv", "does not exist")]
    assert_each_refused(others, lambda name: load(tmp_path / name), names=tmp_path)
    path.unlink()
    assert_each_refused([(tmp_path, "pupper-sysid sweep")], newest_recording)


def test_trials_that_were_resumed_or_hardly_begun_and_missing_readings_are_said(tmp_path):
    path = write(tmp_path, [*rows(), *rows(30, trial=1), '# resumed: {"trial": 1}',
                            *rows(25, trial=1)])  # fmt: skip
    recording = load(path)
    assert [len(t.send_time_s) for t in recording.trials("LF_hip")] == [40, 25]
    assert sum("trial 1 was interrupted" in w for w in recording.warnings) == 1
    recording = load(write(tmp_path, [*rows(), "2.0,2.0005,1,LF_hip,2.0,0.0,0.0"]))
    assert len(recording.trials("LF_hip")) == 1
    assert any("trial 1 of LF_hip is too short" in w for w in recording.warnings)
    recording = load(write(tmp_path, changed(3, "position_rad", "")))
    assert any("missing" in w for w in recording.warnings)
    assert np.isnan(recording.trials("LF_hip")[0].position_rad[3])


def test_very_many_trials_are_answered_at_once(tmp_path):
    sweep = ["time_s,phase,amp_rad,freq_hz,motor_idx,signal,command_rad,actual_rad"]
    sweep += [f"{k},0,0.3,{k},1,0,0.1,0.1" for k in range(60_000)]
    each, pairs = (
        text_of([f"{k},{k}.001,{k // n},LF_hip,1.0,0.1,0.1" for k in range(60_000)]) for n in (1, 2)
    )
    for content, says in (
        (each, "trials; at most 50,000"), (pairs, "0 usable rows"),
        ("\n".join([*sweep, ""]), "trials"),
    ):  # fmt: skip
        (tmp_path / "log.csv").write_text(content)
        started = time.process_time()
        assert_each_refused([(tmp_path / "log.csv", says)], load)
        assert time.process_time() - started < 4


def test_the_hash_is_that_of_the_bytes_and_in_memory_that_of_the_numbers(tmp_path):
    path = write(tmp_path, rows(), top=())
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())  # as spreadsheets save UTF-8
    recording = load(path)
    assert recording.sha256 == sha256(path)
    # a table that this program did not write has no end to miss
    assert recording.warnings == ()
    assert from_arrays().sha256 == from_arrays(name="other").sha256
    moved = {"LF_hip": POSITION + 1e-6, "RB_calf": -POSITION}
    assert from_arrays().sha256 != from_arrays(position_rad=moved).sha256


def test_the_header_says_whether_readings_are_live_and_how_commands_were_cut(tmp_path):
    for readings in ("live", "polled"):
        top = (MARK, f'# readings: "{readings}"')
        recording = load(write(tmp_path, rows(), top=top))
        assert {t.readings for t in recording.trials("LF_hip")} == {readings}
        recording.save(tmp_path / "again.csv", force=True)
        assert load(tmp_path / "again.csv").trials("LF_hip")[0].readings == readings
    cuts = {"command_quantum_rad": {"LF_hip": 0.0057}, "command_rounding": {"LF_hip": "up"}}
    top = (MARK, f"# bus: {json.dumps(cuts | {'kind': 'feetech'})}")
    (cut,) = load(write(tmp_path, rows(), top=top)).trials("LF_hip")
    assert cut.truncation == Truncation(0.0057, "up") and cut.readings is None


def test_the_sweep_layout_is_recognised_by_its_columns(tmp_path):
    path = tmp_path / "sweep.csv"
    lines = ["time_s,phase,amp_rad,freq_hz,motor_idx,signal,command_rad,actual_rad"]
    for f in (1.0, 2.0):
        lines += [f"{0.02 * k},0,0.3,{f},1,0,{0.01 * k},{0.005 * k}" for k in range(30)]
    path.write_text("\n".join(lines) + "\n")
    recording = load(path)
    first, second = recording.trials("LF_thigh")
    assert recording.joints == ["LF_thigh"] and second.frequency_hz == 2.0
    # 0.02 · 29 s of tone, then half a second of pause
    assert second.send_time_s[0] == pytest.approx(0.58 + 0.5)
    assert first.command_rad[10] == pytest.approx(0.785 + 0.1)  # absolute: standing pose added
    assert first.initial_command_rad == 0.785
    assert recording.metadata["bus"]["command_rounding"]["LF_thigh"] == "up"


def test_the_playback_layout_has_a_trial_per_loop(tmp_path):
    path = tmp_path / "playback.csv"
    lines = ["global_step,loop,csv_step,time_s,LF_hip_command_rad,LF_hip_position_rad"]
    lines += [f"{k},{k // 30},{k % 30},{0.04 * k},{0.1 * np.sin(k)},0.1" for k in range(90)]
    path.write_text("\n".join(lines) + "\n")
    recording = load(path)
    assert [t.number for t in recording.trials("LF_hip")] == [0, 1, 2]
    assert np.isnan(recording.trials("LF_hip")[0].frequency_hz)


# ------------------------------------------------------------------------------- from memory

TIME = 0.02 * np.arange(60)
COMMAND, POSITION = 0.3 * np.sin(6 * TIME), 0.3 * np.sin(6 * (TIME - 0.04))


def from_arrays(**changes) -> Recording:
    given = {
        "send_time_s": TIME, "command_rad": {"LF_hip": COMMAND, "RB_calf": -COMMAND},
        "position_rad": {"LF_hip": POSITION, "RB_calf": -POSITION},
    }  # fmt: skip
    return Recording.from_arrays(**(given | changes))


def test_a_recording_from_arrays_has_each_joints_own_values():
    recording = from_arrays(
        read_time_s=TIME + 0.003, trial=np.repeat([0, 1], 30), frequency_hz=np.repeat([1.0, 2], 30),
        metadata={"start_pose_rad": {"RB_calf": -0.1}},
    )  # fmt: skip
    assert recording.joints == ["LF_hip", "RB_calf"] and recording.warnings == ()
    first, second = recording.trials("RB_calf")
    np.testing.assert_array_equal(second.command_rad, -COMMAND[30:])
    np.testing.assert_array_equal(second.position_rad, -POSITION[30:])
    np.testing.assert_array_equal(second.read_time_s, TIME[30:] + 0.003)
    assert (first.frequency_hz, second.frequency_hz) == (1.0, 2.0)
    assert first.initial_command_rad == -0.1


def test_without_read_times_reading_follows_sending_and_the_metadata_say_so():
    recording = from_arrays()
    (trial,) = recording.trials("LF_hip")
    np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, 0.0005)
    assert recording.metadata["read_after_send_s"] == 0.0005
    assert np.isnan(trial.frequency_hz) and trial.number == 0


def test_what_is_saved_is_read_back_and_nothing_is_overwritten(tmp_path):
    made = from_arrays(frequency_hz=2.0, metadata={"robot": "mine"})
    made.save(tmp_path / "a.csv")
    again = load(str(tmp_path / "a.csv"))
    pd.testing.assert_frame_equal(again.to_frame(), made.to_frame(), check_dtype=False)
    assert again.metadata["robot"] == "mine" and again.warnings == ()
    assert again.metadata["exported_from"]["sha256"] == made.sha256
    with pytest.raises(FileExistsRefusal):
        made.save(tmp_path / "a.csv")
    pd.testing.assert_frame_equal(Recording.from_frame(again.to_frame()).table, again.table)


def test_arrays_are_refused_for_the_same_reasons_as_files():
    def angles(joint, scale=1.0):
        return {"command_rad": {joint: scale * COMMAND}, "position_rad": {joint: scale * POSITION}}

    cases = [
        ({"send_time_s": TIME[::-1]}, "arrays, column send_time_s: time runs backwards"),
        ({"send_time_s": TIME[:-1]}, "LF_hip: command_rad has shape (60,), send_time_s (59"),
        ({"position_rad": {"LF_hip": POSITION}}, "position_rad has LF_hip; they must be the same"),
        ({"command_rad": {}, "position_rad": {}}, "at least one"),
        ({"frequency_hz": np.linspace(1, 2, 60)}, "Give each frequency its own trial"),
        ({"read_time_s": np.full(60, np.inf)}, "column read_time_s: a value is infinite"),
        ({"trial": ["a"] * 60}, "column trial: its values are not numbers"),
        ({"metadata": {"bus": {"speed_limit_rad_s": -1.0}}}, "bus.speed_limit_rad_s"),
        (angles("LF_hipp"), "did you mean LF_hip"), (angles("LF_hip", 60), "looks like degrees"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda changes: from_arrays(**changes))
    unread = from_arrays().table.drop(columns="position_rad")
    cases = [(unread, "mine: column position_rad is missing")]
    assert_each_refused(cases, lambda table: Recording.from_frame(table, name="mine"))
