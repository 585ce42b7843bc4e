"""Text from files reaches the terminal without its control characters."""

from __future__ import annotations

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
