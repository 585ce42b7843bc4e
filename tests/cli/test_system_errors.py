"""What the system refuses is the user's to mend: one sentence, exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pupper_sysid.cli.programs import pupper_deploy, pupper_sysid, pupper_train
from support.command_line import refused

SWEEP = Path(__file__).parents[2] / "data/samples/sweep.csv"
MLP = Path(__file__).parents[2] / "data/samples/policies/mlp"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("words", [["--version"], ["--help"], ["doctor", str(SWEEP), "--json"]])
def test_a_full_disk_behind_the_output_is_said_in_a_sentence(words):
    program = "from pupper_sysid.cli.programs.pupper_sysid import main; main()"
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            [sys.executable, "-c", program, *words], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert ended.returncode == 2
    assert ended.stderr == (
        "error: standard output: No space left on device. Make room, or choose another file or "
        "folder.\n"
    )


@pytest.mark.skipif(not os.path.exists("/proc"), reason="needs a folder that cannot be written")
def test_a_home_that_cannot_be_written_is_said_in_a_sentence(capsys, monkeypatch):
    monkeypatch.setenv("HOME", "/proc")
    monkeypatch.setenv("SHELL", "/bin/bash")
    assert "cannot be made" in refused(capsys, pupper_sysid, "--install-completion")


@pytest.mark.parametrize("name", ["../../x", "a/b", "", ".x", "a\x1b[31m", "a" * 300, "x\n"])
@pytest.mark.parametrize("program", [pupper_deploy, pupper_train])
def test_a_name_is_one_folder(capsys, monkeypatch, tmp_path, program, name):
    monkeypatch.chdir(tmp_path)
    first = [str(MLP)] if program is pupper_deploy else ["--actuator", "paper"]
    said = refused(capsys, program, *first, "--name", name)
    assert "--name" in said and "\x1b" not in said
    assert not list(tmp_path.iterdir())
