"""A recording that was cut short goes on at its first unfinished trial, and says so."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.sysid.recordings.files import load
from support.command_line import refused

FREQUENCIES = "2,3,5"


@pytest.fixture(scope="module")
def complete(tmp_path_factory) -> Path:
    """A complete recording of three trials of one joint."""
    path = tmp_path_factory.mktemp("complete") / "a.csv"
    words = ("--joints", "LF_hip", "--freqs", FREQUENCIES, "--duration", "1")
    run("sweep", *words, "--out", str(path))
    return path


@pytest.fixture
def whole(complete, tmp_path) -> Path:
    """A copy of it."""
    return Path(shutil.copy(complete, tmp_path))


def run(*arguments: str) -> None:
    pupper_sysid.main(list(arguments))


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
    ("trial", "rows", "torn"), [(1, 30, "7.123,7.1"), (2, 10, "12"), (0, 0, "")]
)
def test_a_cut_recording_is_continued_to_its_end(complete, whole, trial, rows, torn):
    before = load(complete).table
    cut(whole, trial, rows, torn)
    text = whole.read_text()
    run("sweep", "--resume", str(whole))
    resumed = load(whole)
    assert resumed.metadata["completed"]["rows"] == len(resumed.table)
    assert [t.number for t in resumed.trials("LF_hip")] == [0, 1, 2]
    # rows of the interrupted trial stay in the file; each trial is there once, in full, and time
    # runs forward over the interruption
    assert whole.read_text().startswith(text.removesuffix(torn))
    per_trial = resumed.table.groupby("trial").size()
    assert (per_trial - before.groupby("trial").size()).abs().max() <= 1
    assert (np.diff(resumed.table["send_time_s"]) > 0).all()
    for number in range(trial):
        old, new = (
            table[table["trial"] == number].reset_index(drop=True)
            for table in (before, resumed.table)
        )
        assert old.equals(new), "what had been recorded was changed"
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


def test_a_finished_recording_is_not_continued(whole, capsys):
    before = whole.read_bytes()
    assert "nothing to continue" in refused(capsys, pupper_sysid, "sweep", "--resume", whole)
    assert whole.read_bytes() == before
    asked = load(whole).metadata["sweep"]  # the header holds all options of the sweep
    assert asked["frequencies_hz"] == [2, 3, 5] and asked["joints"] == ["LF_hip"]


def test_a_recording_killed_between_the_last_row_and_the_footer_only_gets_its_footer(whole):
    rows = len(load(whole).table)
    cut(whole, 9, 0)
    run("sweep", "--resume", str(whole))
    assert len(load(whole).table) == rows == load(whole).metadata["completed"]["rows"]


def test_what_cannot_be_continued_is_refused_in_a_sentence(tmp_path, capsys):
    path = tmp_path / "b.csv"
    for text, says in (
        ("time_s,x\n1,2\n", "not a recording of pupper-sysid"),
        ("# pupper-sysid recording\n# schema_version: 1\n", "does not hold its plan"),
        ('# pupper-sysid recording\n# sweep: {"bus": 3}\n', "sweep: bus is 3. Write text"),
    ):
        path.write_text(text)
        assert says in refused(capsys, pupper_sysid, "sweep", "--resume", path)
        assert path.read_text() == text


def test_a_played_file_that_has_changed_is_not_played_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = [f"{0.05 * k},{0.01 * (k % 5)}" for k in range(60)]
    Path("gait.csv").write_text("time_s,LF_hip\n" + "\n".join(rows) + "\n")
    play = ("sweep", "--playback", "gait.csv", "--joints", "LF_hip", "--out", "a.csv")
    run(*play)
    cut(Path("a.csv"), 0, 40)
    Path("gait.csv").write_text("time_s,LF_hip\n" + "\n".join(rows[:-1]) + "\n")
    capsys.readouterr()
    assert "another plan" in refused(capsys, pupper_sysid, "sweep", "--resume", "a.csv")
