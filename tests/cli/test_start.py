"""A program answers at once: what costs time is imported by the command that needs it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from pupper_sysid.cli.dispatch import overview, words
from pupper_sysid.cli.programs import pupper_analyze, pupper_sysid
from support.command_line import refused, run

PROGRAMS = (
    "pupper_sysid", "pupper_train", "pupper_play", "pupper_eval", "pupper_deploy", "pupper_analyze",
)  # fmt: skip
SLOW = ("torch", "rsl_rl", "matplotlib", "pandas", "scipy", "control", "mujoco", "numba", "sklearn")


def imported(code: str) -> set[str]:
    """Slow libraries that a fresh interpreter has imported after `code`."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}\nprint('AFTER', *sys.modules)"],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return set(SLOW) & set(done.stdout.rpartition("AFTER ")[2].split())


def test_help_and_version_of_every_command_import_no_slow_library():
    commands = {
        "pupper_sysid": words(pupper_sysid.COMMANDS),
        "pupper_analyze": words(pupper_analyze.COMMANDS),
    }
    code = f"""
from contextlib import suppress
from importlib import import_module
commands = {commands!r}
for program in {PROGRAMS!r}:
    main = import_module("pupper_sysid.cli.programs." + program).main
    for words in ("", *commands.get(program, ())):
        for option in ("--help", "--version"):
            with suppress(SystemExit):
                main([*words.split(), option])
"""
    assert imported(code) == set()


def test_the_package_itself_imports_nothing_slow():
    assert imported("import pupper_sysid") == set()


@pytest.mark.parametrize("program", [pupper_sysid, pupper_analyze])
def test_the_overview_fits_a_screen_of_24_times_80(program):
    lines = overview("pupper-analyze", program.DESCRIPTION, program.COMMANDS).splitlines()
    assert len(lines) < 24 and max(map(len, lines)) <= 80
    assert all(any(f" {word} " in line for line in lines) for word in program.COMMANDS)


def test_commands_are_grouped_as_their_folders():
    for command in pupper_sysid.COMMANDS.values():
        assert command.where.startswith(f"{command.group}.")
    groups = dict.fromkeys(c.group for c in pupper_sysid.COMMANDS.values())
    assert list(groups) == ["robot", "recording", "model", "use"]


@pytest.mark.parametrize("arguments", [(), ("-h",), ("--help",)])
def test_the_overview_is_what_help_prints(capsys, arguments):
    code, out, _ = run(capsys, *arguments)
    assert code == 0 and "calibrate-joints" in out


def test_a_misspelt_command_is_answered_with_the_nearest(capsys):
    assert "Did you mean `pupper-sysid calibrate`" in refused(capsys, pupper_sysid, "calibarte")
    assert "Did you mean" not in refused(capsys, pupper_sysid, "xyz")


def test_help_of_emulate_names_both_robots_and_not_python(capsys):
    code, out, _ = run(capsys, "emulate", "--help")
    assert code == 0 and "esp32" in out and "feetech" in out and "Union" not in out
