"""What the documentation says is what happens: examples run, pages build without a warning."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from support import docs_conf
from support.command_line import run_program

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
EXAMPLES = {
    path: [
        shlex.split(line[2:])
        for block in re.findall(r"```console\n(.*?)```", path.read_text(), re.DOTALL)
        for line in block.splitlines()
        if line.startswith("$ ")
    ]
    for path in sorted(DOCS.rglob("*.md"))
    if "```console" in path.read_text()
}


@pytest.mark.parametrize("page", EXAMPLES, ids=lambda p: p.stem)
def test_every_example_of_a_page_runs_in_an_empty_folder(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words in EXAMPLES[page]:
        module = importlib.import_module(f"pupper_sysid.cli.programs.{words[0].replace('-', '_')}")
        code, _, err = run_program(capsys, module, *words[1:])
        assert code == 0, f"{shlex.join(words)}: {err}"
    if page.stem == "tutorial":
        made = ("calibrated.yaml", "report/report.html", "calibrated_isaaclab.py", "servo")
        assert all((tmp_path / name).exists() for name in made)


def test_the_tutorial_is_among_the_examples():
    assert len(EXAMPLES[DOCS / "tutorial.md"]) == 9


def test_the_pages_build_without_a_warning_and_name_every_command(tmp_path):
    pytest.importorskip("sphinx")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", DOCS, tmp_path],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    commands = (tmp_path / "commands.html").read_text()
    for name in ("pupper-sysid sweep", "pupper-sysid export", "pupper-train", "pupper-analyze"):
        assert name in commands


def test_a_commands_own_commands_are_on_the_page_of_all_commands():
    known = docs_conf.subcommands("pupper_sysid")
    assert {"emulate", "emulate esp32", "emulate feetech", "sweep"} <= set(known)
    assert docs_conf.subcommands("pupper_play") == []


def test_pages_name_commands_and_options_that_exist():
    """Also those that need a robot, and so cannot be run here."""
    for path in [*DOCS.rglob("*.md"), ROOT / "README.md"]:
        if path.name == "commands.md":
            continue
        for line in re.findall(r"^(?:\$ )?(pupper-[a-z]+ .*)$", path.read_text(), re.MULTILINE):
            words = shlex.split(line, comments=True)
            known = docs_conf.subcommands(words[0].replace("-", "_"))
            if known and words[1:] and not words[1].startswith("-"):
                assert words[1] in known, f"{path.name}: {line}"
