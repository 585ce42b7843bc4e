"""Text from files reaches the terminal without its control characters."""

from __future__ import annotations

import io
import json

import pytest

from pupper_sysid.cli import terminal
from pupper_sysid.cli.programs import pupper_sysid
from support.command_line import refused

ESCAPES = ["\x1b[31m", "\x1b]0;title\x07", "\x9b2J", "\u202e", "\r"]


@pytest.mark.parametrize("escape", ESCAPES)
def test_tables_warnings_and_json_have_no_control_characters(capsys, escape):
    shown = terminal.table(f"of {escape}", f"joint{escape}")
    shown.add_row(f"a{escape}b")
    terminal.out.print(shown)
    terminal.out.print(f"x{escape}y", soft_wrap=True)
    terminal.warn([f"odd {escape}"])
    terminal.print_json({"name": f"k{escape}"})
    printed = capsys.readouterr()
    assert escape[0] not in printed.out + printed.err
    assert json.loads(printed.out[printed.out.index("{") :])["name"] == f"k{escape}"


def test_a_hostile_cell_is_quoted_without_its_escape(capsys, tmp_path):
    path = tmp_path / "hostile.csv"
    path.write_text("send_time_s,read_time_s,trial,joint,frequency_hz,command_rad,position_rad\n")
    with path.open("a") as file:
        file.write("0,0,0,a,1,\x1b[2Jhello,0\n" * 30)
    assert "\x1b" not in refused(capsys, pupper_sysid, "doctor", path)


@pytest.mark.parametrize("on_terminal", [True, False])
def test_sentences_are_broken_between_words_on_a_terminal_and_commands_are_not(on_terminal):
    sentence = "error: results/a.csv does not exist. Check the name."
    command = "Next: pupper-sysid calibrate a.csv b.csv c.csv"
    file = io.StringIO()
    console = type(terminal.out)(file=file, force_terminal=on_terminal, width=20)
    console.print(sentence, soft_wrap=True)
    console.print(command, soft_wrap=True)
    lines = file.getvalue().splitlines()
    assert lines[-1] == command
    assert " ".join(line.strip() for line in lines[:-1]) == sentence
    assert (len(lines) > 2) is on_terminal
