"""Sphinx: pages in Markdown, and the reference of every command, generated from the code."""

from __future__ import annotations

import io
import os
import re
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from typing import get_args
from unittest.mock import patch

HERE = Path(__file__).resolve().parent
_PLAIN = {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}

project = "pupper-sysid"
copyright = "the pupper-sysid developers, Apache-2.0"
extensions = ["myst_parser", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "pupper-sysid"
# code that no highlighter knows is shown as it is
highlight_language = "text"

_PROGRAMS = (
    "pupper_sysid", "pupper_train", "pupper_play", "pupper_eval", "pupper_deploy",
    "pupper_analyze",
)  # fmt: skip


def _help(module: str, *words: str) -> str:
    """What `--help` prints, without colours and without the lines' empty ends."""
    said, plain = io.StringIO(), patch.dict(os.environ, _PLAIN)
    with plain, redirect_stdout(said), redirect_stderr(said), suppress(SystemExit):
        import_module(f"pupper_sysid.cli.programs.{module}").main([*words, "--help"])
    text = re.sub(r"\x1b\[[0-9;]*m", "", said.getvalue())
    return "\n".join(line.rstrip() for line in text.splitlines()).strip()


def subcommands(module: str) -> list[str]:
    """Names of a program's commands, those of a command's own as two words; empty without any."""
    return _names(getattr(import_module(f"pupper_sysid.cli.programs.{module}"), "Command", None))


def _names(command: object, *before: str) -> list[str]:
    found = []
    for one in get_args(command):
        inner, how = get_args(one)
        words = (*before, how.name)
        found += [" ".join(words), *_names(inner, *words)]
    return found


def reference() -> str:
    """The page of all commands, as Markdown."""
    lines = [
        "# Every command", "",
        "Generated from the code: what `--help` prints. Every program also takes `--version`, "
        "`--debug` (shows the traceback of an error) and `--install-completion`. Exit codes: 0, "
        "2 for bad input (one sentence says what and where), 1 for anything else.", "",
    ]  # fmt: skip
    for module in _PROGRAMS:
        program = module.replace("_", "-")
        lines += [f"## {program}", "", "```text", _help(module), "```", ""]
        for name in subcommands(module):
            shown = _help(module, *name.split())
            lines += [f"### {program} {name}", "", "```text", shown, "```", ""]
    return "\n".join(lines)


def setup(app) -> None:
    """Write the reference before the pages are read."""
    (HERE / "commands.md").write_text(reference())
