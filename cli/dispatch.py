"""Programs with subcommands: find the command by the first word and import only its module.

A program has a table of `Command`s, by word. `run_command` parses the options of the one that the
first argument names and runs it; without one it prints the table, grouped.
"""

from __future__ import annotations

import difflib
import functools
import operator
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import import_module
from typing import Annotated, Any, NamedTuple, get_args

import tyro

from pupper_sysid.cli.help_page import ALL, HELP
from pupper_sysid.cli.user_errors import CONFIG, begin_work, end_politely, parse, user_errors
from pupper_sysid.common.errors import InputError

_SCREEN = 80
"""Characters of a line of a terminal."""


class Command(NamedTuple):
    """One word of a program."""

    group: str
    summary: str
    """What it does, in one line."""
    where: str
    """`module:Class` below `pupper_sysid.cli.commands`: a dataclass with a method `run`, or a union
    of such dataclasses as subcommands."""
    holds_bus: bool = False
    """Whether it must release a bus before it ends."""

    def load(self) -> Any:
        """Import the class."""
        module, name = self.where.split(":")
        return getattr(import_module(f"pupper_sysid.cli.commands.{module}"), name)


def commands_of(
    summaries: Mapping[str, Mapping[str, str]],
    module: Callable[[str, str], str],
    holding_bus: Collection[str] = (),
) -> dict[str, Command]:
    """Commands by word, from their summaries by group; `fit-servo` is a class `FitServo`.

    `module` gives the module of a group's word, below `pupper_sysid.cli.commands`; those
    `holding_bus` must release a bus before they end.
    """
    return {
        word: Command(
            group, summary, f"{module(group, word)}:{word.title().replace('-', '')}",
            word in holding_bus,
        )
        for group, words in summaries.items()
        for word, summary in words.items()
    }  # fmt: skip


def run_command(
    program: str,
    description: str,
    commands: Mapping[str, Command],
    arguments: Sequence[str] | None = None,
) -> None:
    """Run the command that the first of the arguments (by default the process's) names.

    Ends the process with 0, 2 (bad input, one sentence) or 1. `description`, what the program is
    for, stands above its table of commands.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    with user_errors(given, program) as left:
        first, rest = (left[0], left[1:]) if left else ("--help", [])
        if first in (*HELP, ALL):
            print(overview(program, description, commands))
            return
        if first.startswith("--tyro-"):  # completion, of all words and their options
            words = (Annotated[c.load(), tyro.conf.subcommand(w)] for w, c in commands.items())
            every: Any = functools.reduce(operator.or_, words)
            tyro.cli(every, prog=program, args=left, config=CONFIG)
        if first not in commands:
            near = difflib.get_close_matches(first, commands, n=1, cutoff=0.5)
            hint = f" Did you mean `{program} {near[0]}`?" if near else ""
            raise InputError(
                f"{program} has no command {first}.{hint} `{program} --help` lists all."
            )
        chosen = commands[first]
        kind = chosen.load()
        # a union has no docstring of its own, and Python's would be shown
        described = None if isinstance(kind, type) else chosen.summary
        command = parse(kind, rest, f"{program} {first}", described)
        if chosen.holds_bus:
            end_politely()
        else:
            begin_work()
        command.run()


def overview(program: str, description: str, commands: Mapping[str, Command]) -> str:
    """A program's help: its commands, by group, one line each."""
    group_width = 2 + max(len(c.group) for c in commands.values())
    rows: list[list[str]] = []  # a command without summary is shown with the one before it
    for word, (group, summary, *_) in commands.items():
        if summary:
            rows.append([group, word, summary])
        else:
            rows[-1][1] += f" / {word}"
    width = 2 + max(len(words) for _, words, _ in rows)
    usage, what = f"usage: {program} COMMAND [OPTIONS | --help]", description.strip()
    one_line = f"{usage}   {what}"
    lines, last = ([one_line] if len(one_line) <= _SCREEN else [usage, what]), None
    for group, words, summary in rows:
        lines.append(f"{'' if group == last else group:{group_width}}{words:{width}}{summary}")
        last = group
    return "\n".join(lines)


def words(commands: Mapping[str, Command]) -> list[str]:
    """All commands, those of a command's own as two words."""
    found = []
    for word, command in commands.items():
        inner = (get_args(one)[1].name for one in get_args(command.load()))
        found += [word, *(f"{word} {name}" for name in inner)]
    return found
