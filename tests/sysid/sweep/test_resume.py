"""A recording that was cut short goes on at its first unfinished trial, and says so."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.cli.programs.pupper_sysid import main
from pupper_sysid.sysid.recordings.files import load

FREQUENCIES = "2,3,5"


@pytest.fixture
def whole(tmp_path, monkeypatch):
    """A complete recording of three trials of one joint."""
    monkeypatch.chdir(tmp_path)
    run("sweep", "--joints", "LF_hip", "--freqs", FREQUENCIES, "--duration", "1", "--out", "a.csv")
    return tmp_path / "a.csv"


def run(*arguments: str) -> None:
    main(list(arguments))


def cut(path, trial: int, rows: int, torn: str = "") -> None:
    """Leave `rows` rows of `trial` and nothing behind them."""
    kept, seen = [], 0
    for line in path.read_text().splitlines(keepends=True):
        if line[0] != "#" and line[0].isdigit():
            number = int(line.split(",")[2])
            seen += number == trial
            if number > trial or (number == trial and seen > rows):
                continue
        if line.startswith("# completed"):
            continue
        kept.append(line)
    path.write_text("".join(kept) + torn)


@pytest.mark.parametrize(
    ("trial", "rows", "torn"),
    [(1, 30, ""), (1, 30, "7.123,7.1"), (0, 5, ""), (2, 10, "12"), (0, 0, "")],
)
def test_a_cut_recording_is_continued_to_its_end(whole, trial, rows, torn):
    complete = load(whole).table
    cut(whole, trial, rows, torn)
    run("sweep", "--resume", str(whole))
    resumed = load(whole)
    assert resumed.metadata["completed"]["rows"] == len(resumed.table)
    trials = [t.number for t in resumed.trials("LF_hip")]
    assert trials == [0, 1, 2]
    # each trial is there once, in full, and time runs forward over the interruption
    per_trial = resumed.table.groupby("trial").size()
    assert (per_trial - complete.groupby("trial").size()).abs().max() <= 1
    assert (np.diff(resumed.table["send_time_s"]) > 0).all()
    for number in range(trial):
        before = complete[complete["trial"] == number].reset_index(drop=True)
        after = resumed.table[resumed.table["trial"] == number].reset_index(drop=True)
        assert before.equals(after), "what had been recorded was changed"
    if rows:
        assert any(f"trial {trial} was interrupted" in w for w in resumed.warnings)


@pytest.mark.parametrize("years", [-50, 50])
def test_a_clock_that_was_set_during_the_interruption_does_not_move_the_recording(whole, years):
    cut(whole, 1, 30)
    written = whole.stat().st_mtime + years * 365.25 * 86_400
    os.utime(whole, (written, written))
    run("sweep", "--resume", str(whole))
    times = load(whole).table["send_time_s"].to_numpy()
    assert (np.diff(times) > 0).all() and times[-1] - times[0] < 2 * 86_400


def test_rows_of_the_interrupted_trial_stay_in_the_file(whole):
    cut(whole, 1, 30)
    before = whole.read_text()
    run("sweep", "--resume", str(whole))
    assert whole.read_text().startswith(before)


def test_a_finished_recording_is_not_continued(whole, capsys):
    before = whole.read_bytes()
    with pytest.raises(SystemExit) as end:
        run("sweep", "--resume", str(whole))
    assert end.value.code == 2 and "nothing to continue" in capsys.readouterr().err
    assert whole.read_bytes() == before


def test_a_recording_killed_between_the_last_row_and_the_footer_only_gets_its_footer(whole):
    rows = len(load(whole).table)
    cut(whole, 9, 0)
    run("sweep", "--resume", str(whole))
    assert len(load(whole).table) == rows == load(whole).metadata["completed"]["rows"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time_s,x\n1,2\n", "not a recording of pupper-sysid"),
        ("# pupper-sysid recording\n# schema_version: 1\n", "does not hold its plan"),
        ("# pupper-sysid recording\n# sweep: {\"bus\": 3}\n", "sweep: bus is 3. Write text"),
    ],
)  # fmt: skip
def test_what_cannot_be_continued_is_refused_in_a_sentence(tmp_path, capsys, text, says):
    path = tmp_path / "b.csv"
    path.write_text(text)
    with pytest.raises(SystemExit) as end:
        run("sweep", "--resume", str(path))
    assert end.value.code == 2 and says in " ".join(capsys.readouterr().err.split())
    assert path.read_text() == text


def test_a_played_file_that_has_changed_is_not_played_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = [f"{0.05 * k},{0.01 * (k % 5)}" for k in range(60)]
    Path("gait.csv").write_text("time_s,LF_hip\n" + "\n".join(rows) + "\n")
    play = ("sweep", "--playback", "gait.csv", "--joints", "LF_hip", "--out", "a.csv")
    run(*play)
    cut(Path("a.csv"), 0, 40)
    Path("gait.csv").write_text("time_s,LF_hip\n" + "\n".join(rows[:-1]) + "\n")
    with pytest.raises(SystemExit) as end:
        run("sweep", "--resume", "a.csv")
    assert end.value.code == 2 and "another plan" in " ".join(capsys.readouterr().err.split())


def test_the_header_holds_all_that_was_asked_for(whole):
    asked = load(whole).metadata["sweep"]
    assert asked["frequencies_hz"] == [2, 3, 5] and asked["joints"] == ["LF_hip"]
    assert json.dumps(asked)
