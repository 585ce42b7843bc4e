"""What the system refuses is the user's to mend: one sentence, exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pupper_sysid.cli.programs import pupper_deploy, pupper_sysid, pupper_train
from support.command_line import refused

MLP = Path(__file__).parents[2] / "data/samples/policies/mlp"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_behind_the_output_is_said_in_a_sentence():
    program = "from pupper_sysid.cli.programs.pupper_sysid import main; main()"
    for words in (["sweep", "--help"], ["servo", "list"]):
        with open("/dev/full", "w") as full:
            ended = subprocess.run(
                [sys.executable, "-c", program, *words],
                stdout=full, stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
        assert ended.returncode == 2
        assert ended.stderr == (
            "error: standard output: No space left on device. Make room, or choose another file or "
            "folder.\n"
        ), words


@pytest.mark.skipif(not os.path.exists("/proc"), reason="needs a folder that cannot be written")
def test_a_home_that_cannot_be_written_is_said_in_a_sentence(capsys, monkeypatch):
    monkeypatch.setenv("HOME", "/proc")
    monkeypatch.setenv("SHELL", "/bin/bash")
    assert "cannot be made" in refused(capsys, pupper_sysid, "--install-completion")


def test_a_name_is_one_folder(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for program, first in ((pupper_deploy, [MLP]), (pupper_train, ["--actuator", "paper"])):
        for name in ("../../x", "a/b", "", ".x", "a\x1b[31m", "a" * 300, "x\n"):
            said = refused(capsys, program, *first, "--name", name)
            assert "--name" in said and "\x1b" not in said, name
    assert not list(tmp_path.iterdir())
