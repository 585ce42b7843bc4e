"""Help of every command: one screen, options by their types, everything behind `--help-all`."""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass
from typing import Literal

import pytest

from pupper_sysid.cli.dispatch import words
from pupper_sysid.cli.help_page import SCREEN_LINES
from pupper_sysid.cli.programs import pupper_analyze, pupper_sysid
from pupper_sysid.cli.user_errors import parse
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import select_joints
from support.command_line import run_program

COMMANDS = [
    *(("pupper_sysid", *each.split()) for each in words(pupper_sysid.COMMANDS)),
    *(("pupper_analyze", each) for each in words(pupper_analyze.COMMANDS)),
    *((name,) for name in ("pupper_train", "pupper_play", "pupper_eval", "pupper_deploy")),
]


@pytest.fixture(autouse=True)
def of_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def shown(capsys, command, option: str) -> str:
    module = importlib.import_module(f"pupper_sysid.cli.programs.{command[0]}")
    code, out, err = run_program(capsys, module, *command[1:], option)
    assert code == 0, err
    return out


def options(page: str) -> set[str]:
    return set(re.findall(r"^  (?:-h, )?(--[a-z][\w.-]*)", page, re.MULTILINE))


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_is_one_screen_and_leaves_out_only_groups_and_later_sentences(command, capsys):
    page, everything = shown(capsys, command, "--help"), shown(capsys, command, "--help-all")
    assert len(page.splitlines()) <= SCREEN_LINES
    assert max(map(len, page.splitlines())) <= 80
    assert not re.search(r"None|%%|TYRO|\[\[|default: \)", page)
    left_out = options(everything) - options(page)
    assert all("." in name for name in left_out)
    if page != everything:
        assert f"{' '.join(command).replace('_', '-')} --help-all" in " ".join(page.split())
    for group in {name.split(".")[0] for name in left_out}:
        assert f"{group}.*" in page


def test_all_settings_of_a_training_are_behind_help_all(capsys):
    everything = options(shown(capsys, ("pupper_train",), "--help-all"))
    assert {"--task.rewards.progress", "--learner.learning-rate", "--actuator"} <= everything
    assert len(everything) > 150


@dataclass
class Optional:
    """Options that have no value by default, or one."""

    amplitude: float | None = 0.3
    kind: Literal["sine", "chirp"] | None = None


def test_an_optional_value_is_read_as_its_type_or_as_none():
    assert parse(Optional, [], "x") == Optional(0.3, None)
    read = parse(Optional, ["--amplitude", "None", "--kind", "chirp"], "x")
    assert read == Optional(None, "chirp")
    for wrong in (["--amplitude", "4_1"], ["--kind", "square"]):
        with pytest.raises(SystemExit):
            parse(Optional, wrong, "x")


def test_what_was_typed_is_never_proposed():
    """A kind, a leg or a joint of the robot that a recording does not have."""
    for word in ("thigh", "RB", "RB_calf"):
        with pytest.raises(InputError) as refused:
            select_joints(word, ["LF_hip"])
        assert "Did you mean" not in str(refused.value)
        assert f"there is no {word} here; there is LF_hip" in str(refused.value)
    with pytest.raises(InputError, match=r"Did you mean LF_hip\?"):
        select_joints("LF_hop", ["LF_hip"])
