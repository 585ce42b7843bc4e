"""Messages of the library name arguments; at the command line they name its options."""

from __future__ import annotations

import ast
import re
from contextvars import copy_context
from dataclasses import dataclass, field
from typing import Annotated

import pytest
import tyro

from pupper_sysid.cli.flags import remember, spell
from support.package import FOLDERS, ROOT


@dataclass
class Learner:
    """A group of options."""

    learning_rate: float = 1.0


@dataclass
class Run:
    """Options without a prefix of their own."""

    learner: Learner = field(default_factory=Learner)


@dataclass
class Options:
    """A command's."""

    recordings: tyro.conf.Positional[tuple[str, ...]] = ()
    run: Annotated[Run, tyro.conf.arg(name="")] = field(default_factory=Run)
    stall_torque: float = 1.0
    preset: str = ""
    force: bool = False
    jobs: int = 1


def spelled(text):
    def there():
        remember(Options())
        return spell(text)

    return copy_context().run(there)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("`stall_torque` is 0.", "--stall-torque is 0."),
        ("`stall_torque_nm` is 0.", "--stall-torque is 0."),
        ("`workers` is 0.", "--jobs is 0."),
        ("Add `force=True`.", "Add --force."),
        ("`preset='paper'` has an mlp.", "--preset paper has an mlp."),
        ("Lower `learning_rate`.", "Lower --learner.learning-rate."),
        ("`recordings` is empty, `position_rad`, `walk.csv`, `pupper-sysid doctor`", None),
        ("preset and force are words", None),
    ],
)
def test_arguments_become_the_options_of_the_running_command(text, expected):
    assert spelled(text) == (expected or text)


def test_without_a_command_a_message_stays_as_the_library_wrote_it():
    assert spell("`force=True`") == "`force=True`"


OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def options_in_strings(path):
    """Options in the strings of a module, but for docstrings and whole lines to type."""
    tree = ast.parse(path.read_text())
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            command = re.search(r"pupper-|pip install", node.value)
            if id(node) not in docstrings and not command:
                yield from OPTION.findall(node.value)


def test_no_message_of_the_library_names_an_option():
    library = (ROOT / room for room in FOLDERS.values() if room != "cli")
    found = {
        path.relative_to(ROOT).as_posix(): options
        for folder in library
        for path in folder.rglob("*.py")
        if OPTION.search(path.read_text()) and (options := list(options_in_strings(path)))
    }
    assert found == {}


def test_an_option_in_a_message_would_be_found(tmp_path):
    path = tmp_path / "module.py"
    path.write_text('"""A --doc."""\nraise ValueError(f"--jobs is {jobs}; `--out x` is not")\n')
    assert list(options_in_strings(path)) == ["--jobs", "--out"]
