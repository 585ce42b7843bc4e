"""Limits and numbers of the command line, closed streams and full disks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pupper_sysid.cli.programs import pupper_deploy, pupper_sysid, pupper_train
from support.command_line import refused

SWEEP = Path(__file__).parents[2] / "data/samples/sweep.csv"
COMMANDS = Path(__file__).parents[2] / "data/samples/walk_commands.csv"


def wide(folder: Path, columns: int) -> Path:
    path = folder / "wide.csv"
    path.write_text(
        ",".join(f"c{k}" for k in range(columns)) + "\n" + ",".join(["1"] * columns) + "\n"
    )
    return path


def test_a_file_beyond_a_limit_names_the_option_that_reads_it(capsys, tmp_path):
    path = wide(tmp_path, 3000)
    said = refused(capsys, pupper_sysid, "import", path)
    assert "has 3,000 columns; at most 2,000 columns are read" in said
    assert said.endswith("raise the limits of reading with --read-limit 2.")


@pytest.mark.slow
def test_a_raised_limit_reads_the_file(capsys, tmp_path):
    for words in (("--read-limit", "2"), ("--read-limit=2",)):
        said = refused(capsys, pupper_sysid, "import", wide(tmp_path, 3000), *words)
        assert "columns are read" not in said


def test_the_limit_of_reading_is_a_number_from_1_to_1000(capsys):
    for value in ("0", "0.5", "1001", "nan", "inf", "x", "4_1", "٣", ""):
        words = ("doctor", SWEEP, "--read-limit", value)
        assert "--read-limit" in refused(capsys, pupper_sysid, *words), value
    assert "--read-limit" in refused(capsys, pupper_sysid, "doctor", SWEEP, "--read-limit=0")
    assert "--read-limit needs a number" in refused(
        capsys, pupper_sysid, "doctor", SWEEP, "--read-limit"
    )


def test_numbers_of_options_are_numerals_in_ascii(capsys):
    for number in ("4_1", "٤١", "１０", "0x10", "1e", "4,1"):
        for option in ("--rate", "--seed"):  # of a number with a fraction, and a whole one
            said = refused(capsys, pupper_sysid, "sweep", option, number)
            assert "is not a" in said, (option, number)


def test_a_sweep_that_cannot_be_meant_is_refused_before_it_begins(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for words, says in (
        (("--duration", "1e12"), "--duration is 1e+12 s; it must be from 0.1 to 86400 s"),
        (("--duration", "nan"), "--duration is nan"),
        (("--rate", "1e12"), "--rate is 1e+12 Hz; it must be from 1 to 1000 Hz"),
        (("--rate", "1e-12"), "--rate is 1e-12 Hz"),
        (("--freqs", "0.001"), "at least 0.01 Hz"),
        (("--playback", str(COMMANDS), "--loops", "1000000000000"), "from 1 to 1000"),
        (("--duration", "86400", "--rate", "1000"), "rows; at most 5,000,000"),
        (("--until", ""), "--until is empty"),
        (("--joints", ""), "--joints is empty"),
        (("--playback", "/dev/zero"), "/dev/zero is not a file"),
    ):
        assert says in refused(capsys, pupper_sysid, "sweep", *words), words
    assert not list(tmp_path.iterdir())


def test_ids_of_an_emulated_line_are_those_of_its_servos(capsys):
    for ids in ("1-999999999999", "5-1", "٣", "", "1,", "0"):
        words = ("emulate", "feetech", "--ids", ids)
        assert "--ids" in refused(capsys, pupper_sysid, *words), ids


def test_a_training_that_cannot_be_meant_is_refused(capsys):
    for option, value in (("--environments", "9" * 30), ("--minutes", "nan")):
        said = refused(capsys, pupper_train, "--actuator", "paper", option, value)
        assert f"{option.removeprefix('--')} is" in said


@pytest.mark.skipif(sys.platform == "win32", reason="streams are closed by a shell")
def test_a_program_whose_streams_are_closed_ends_as_ever(tmp_path):
    for words, closed, expected in (
        (["sweep", "--help"], (0, 1, 2), 0),
        (["servo", "list"], (1,), 0),
        (["nonsense"], (2,), 2),
    ):

        def close(streams=closed) -> None:
            for stream in streams:
                os.close(stream)

        ended = command(words, cwd=tmp_path, preexec_fn=close)
        assert ended.returncode == expected, (words, closed)


def command(words, **how):
    program = "from pupper_sysid.cli.programs.pupper_sysid import main; main()"
    return subprocess.run([sys.executable, "-c", program, *words], check=False, **how)


def test_a_script_or_log_that_never_ends_is_refused_at_once(capsys):
    for option in ("--playback", "--replay"):
        words = ["data/samples/policies/mlp"] if option == "--replay" else []
        assert "is not a file" in refused(capsys, pupper_deploy, *words, option, "/dev/zero")


def test_an_emulated_line_that_cannot_be_is_refused(capsys):
    for words, says in (
        (("--baud", "0"), "--baud 0: choose"),
        (("--load", "none", "--backlash", "1e9"), "--backlash is 1e+09 degrees; it must be from 0"),
        (("--load", "none", "--backlash", "-1"), "--backlash is -1 degrees"),
    ):
        assert says in refused(capsys, pupper_sysid, "emulate", "feetech", *words), words
