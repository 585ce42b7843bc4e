"""Help of every command, on one screen: `--help`; all options in full: `--help-all`.

tyro knows the options with their types, defaults and texts; this lays them out in two columns. A
page that would be longer than a screen shows the first sentence of each option, and groups of
settings (`--task.…`) only by name; its last line says that `--help-all` has the rest.
"""

from __future__ import annotations

import argparse
import difflib
import re
import shutil
import textwrap
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import tyro

HELP, ALL = ("-h", "--help"), "--help-all"
SCREEN_LINES = 60
"""Most lines of `--help`."""

_WIDEST, _NARROWEST = 100, 40
_COLUMN = 24  # at which texts begin
_NOTHING = re.compile(r"\s*\(default: (None|False|''|\[\]|)\)$")
_DEFAULT = re.compile(r"\s*(\(default: [^()]*(\([^()]*\)[^()]*)*\)|\(required\)|\(optional\))$")


def help_page(
    options: Any, arguments: Sequence[str], program: str, description: str | None, **keywords: Any
) -> str:
    """Help of the command whose options are `options`, as wide as the terminal.

    `options` is their dataclass, or a union of some as subcommands; `arguments`, as typed, name a
    subcommand and hold `--help` or `--help-all`; `program` is its words, such as `pupper-sysid
    servo`; the description is by default the dataclass's docstring; `keywords` are those of
    `tyro.cli`.
    """
    parser, program = _parser(options, arguments, program, description=description, **keywords)
    width = max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size().columns))
    everything = "\n".join(_page(parser, program, width, full=True, nested=True))
    if ALL in arguments or everything.count("\n") < SCREEN_LINES:
        return everything
    for full in (True, False):
        lines = _page(parser, program, width, full, nested=False)
        groups = Counter(
            name.split(".")[0] for a in parser._actions for name in a.option_strings if "." in name
        )
        listed = ", ".join(f"{group}.* ({count})" for group, count in groups.items())
        rest = f"Settings beside these: {listed}. " if groups else ""
        lines += ["", *textwrap.wrap(f"{rest}{program} {ALL} shows every option in full.", width)]
        if len(lines) <= SCREEN_LINES:
            break
    return "\n".join(lines)


def _parser(
    options: Any, arguments: Sequence[str], program: str, **keywords: Any
) -> tuple[Any, str]:
    """Parser of the command that `arguments` name, and the command's words."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # since tyro 1.0, without a successor
        parser: Any = tyro.extras.get_parser(options, prog=program, **keywords)
    for word in arguments:
        if word not in _subcommands(parser):
            break
        parser = _subcommands(parser)[word]
        program = f"{program} {word}"
    return parser, program


def correction(
    options: Any, arguments: Sequence[str], program: str, refusal: str, **keywords: Any
) -> str:
    """What to type instead of `arguments`, which tyro refused; empty if that is not known."""
    parser, program = _parser(options, arguments, program, **keywords)
    known = {name: action for action in parser._actions for name in action.option_strings}
    refused = re.search(r"Unrecognized options: ([^\n]*)", " ".join(refusal.split()))
    starts = [k for k, word in enumerate(arguments) if re.match(r"--?[a-zA-Z]", word)]
    for start, end in pairwise([*starts, len(arguments)]):
        typed, equals, value = arguments[start].partition("=")
        name = typed.replace("_", "-")
        values = [value] * bool(equals) + list(arguments[start + 1 : end])
        if name not in known:
            meant = _MEANT.get(name, "")
            near = [meant] if meant in known else _near(name, known)
            return f"{program} has no option {typed}. {_did_you_mean(near, program)}"
        action = known[name]
        if action.choices and values and values[0] not in action.choices:
            listed = ", ".join(map(str, action.choices))
            near = _near(values[0], action.choices)
            meant = f"Did you mean {name} {near[0]}? " if near else ""
            return f"{name} is '{values[0]}'. {meant}It may be {listed}."
        if isinstance(action.nargs, int) and action.nargs > 1 and "," in "".join(values):
            apart = [part for text in values for part in text.split(",") if part]
            return (
                f"{name} takes {action.nargs} values with spaces between them: "
                f"{name} {' '.join(apart[: action.nargs])}."
            )
        surplus = values[1:]
        if refused and surplus and all(word in refused[1] for word in surplus):
            if _NUMBER.match(_name(action)):
                return f"{name} takes one number, not {len(values)}: {name} {values[0]}."
            joined = ",".join(word.strip(",") for word in values)
            return f"Several values of one option go with commas, without spaces: {name} {joined}."
        unit = re.search(r"\[([^\[\]]+)\]", action.help or "")
        if (
            values
            and "not a" in refusal
            and re.fullmatch(r"[-+.\d]+ ?(?!e$)[a-zA-Z°%]+", values[0])
        ):
            kind = f"a number in {unit[1]}" if unit else "a number"
            return f"{name} is '{values[0]}'. Write {kind}, without its unit."
    for word in arguments[: starts[0] if starts else None]:
        if refused and word in refused[1]:
            name, equals, value = word.partition("=")
            if equals and f"--{name}" in known:
                return f"Options begin with two hyphens: --{name} {value}."
            of = [n for n, action in known.items() if word in (action.choices or ())]
            if of:
                return f"'{word}' needs the name of its option: {of[0]} {word}."
            near = _near(word, _subcommands(parser))
            return f"{program} does not take '{word}'. {_did_you_mean(near, program)}"
    return ""


_MEANT = {
    "--output": "--out", "-o": "--out", "--port": "--bus", "--device": "--bus", "--seeds": "--seed",
    "--joint": "--joints", "--model": "--models", "--amp": "--amplitude", "--format": "--to",
    "--frequencies": "--freqs", "--frequency": "--freqs", "--freq": "--freqs",
    "--envs": "--environments", "--num-envs": "--environments",
}  # fmt: skip
"""Other programs' words for an option; a word counts where the command has that option."""
_NUMBER = re.compile(r"\S+ (INT|FLOAT)$")


def _near(word: str, names: Iterable[Any]) -> list[str]:
    """The most similar of some names; case and hyphens count for nothing."""

    def bare(name: Any) -> str:
        return re.sub(r"[-_ ]", "", str(name)).lower()

    by_letters = {bare(name): str(name) for name in names}
    nearest = difflib.get_close_matches(bare(word), by_letters, n=1, cutoff=0.7)
    return [by_letters[name] for name in nearest]


def _did_you_mean(names: Sequence[str], program: str) -> str:
    meant = f"Did you mean {names[0]}? " if names else ""
    return f"{meant}`{program} --help` lists all."


def _subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action.choices, dict):
            return dict(action.choices)
    return {}


def _page(
    parser: argparse.ArgumentParser, program: str, width: int, full: bool, nested: bool
) -> list[str]:
    positional = [
        a for a in parser._actions if not (a.option_strings or isinstance(a.choices, dict))
    ]
    words = " ".join(map(_name, positional))
    subcommands = _subcommands(parser)
    usage = [program, "COMMAND" if subcommands else words, "[OPTIONS]"]
    lines = [f"usage: {' '.join(part for part in usage if part)}"]
    example = "Example: "
    for paragraph in re.split(r"\n\n|\s+(?=Example: )", (parser.description or "").strip()):
        if not (paragraph.startswith(example) and lines[-1].startswith((example, " "))):
            lines.append("")
        lines += textwrap.wrap(
            " ".join(paragraph.split()), width, break_on_hyphens=False,
            subsequent_indent=" " * len(example) * paragraph.startswith(example),
        )  # fmt: skip
    if subcommands:
        lines += ["", "commands:"]
        for name, subcommand in subcommands.items():
            summary = (subcommand.description or "").strip().split("\n\n")[0]
            lines += _row(name, summary, width)
    for title, actions in _groups(parser, nested):
        lines += ["", *([f"{title}:"] if title else [])]
        for action in actions:
            text, end = _text(action)
            text = text if full else _first_sentence(text)
            lines += _row(_name(action), text + end, width)
    return lines


def _groups(
    parser: argparse.ArgumentParser, nested: bool
) -> Iterable[tuple[str, list[argparse.Action]]]:
    """Positional arguments, options, and groups of settings, in that order."""
    for group in parser._action_groups:
        actions = [
            action
            for action in group._group_actions
            if not isinstance(action.choices, dict)
            and (nested or not any("." in name for name in action.option_strings))
        ]
        if actions:
            title = "" if group.title in ("options", "positional arguments") else group.title
            yield (title or "").removesuffix(" options"), actions


def _name(action: argparse.Action) -> str:
    """An option and what it takes."""
    metavar = action.metavar if isinstance(action.metavar, str) else ""
    several = " ..." if "..." in metavar else ""
    if not action.option_strings:
        word = action.dest.split(".")[-1].split("(")[0].strip().replace("-", "_").upper()
        return f"[{word}{several}]" if metavar[:1] == "[" else f"{word}{several}"
    if several:
        metavar = f"{metavar.strip('[]').split()[0]}{several}"
    if action.choices is not None and len(metavar) > _COLUMN:
        metavar = action.option_strings[0].split(".")[-1].lstrip("-").upper().replace("-", "_")
    return f"{', '.join(action.option_strings)} {metavar}".strip()


def _text(action: argparse.Action) -> tuple[str, str]:
    """Text of an option, and its end: choices that its name does not hold, and its default."""
    if "--help" in action.option_strings:
        return f"Show this page ({ALL}: every option in full).", ""
    text = _NOTHING.sub("", " ".join((action.help or "").replace("%%", "%").split()))
    default = _DEFAULT.search(text)
    end = default[0] if default else ""
    text = text.removesuffix(end)
    metavar = action.metavar if isinstance(action.metavar, str) else ""
    if action.option_strings and action.choices is not None and len(metavar) > _COLUMN:
        choices = metavar.strip("{}").replace(",", ", ")
        end = f" One of {choices}.{end}"
    return text, end


def _row(name: str, text: str, width: int) -> list[str]:
    indent, head = " " * _COLUMN, f"  {name}"
    wrapped = textwrap.wrap(text, width - _COLUMN, break_on_hyphens=False) or [""]
    if len(head) + 2 <= _COLUMN:
        first, *rest = wrapped
        return [f"{head:{_COLUMN}}{first}".rstrip(), *(indent + line for line in rest)]
    if len(head) + 2 + 16 > width:
        return [head, *(indent + line for line in wrapped)]
    return textwrap.wrap(f"{head}  {text}", width, subsequent_indent=indent, break_on_hyphens=False)


def _first_sentence(text: str) -> str:
    """The text up to the first stop or semicolon outside of brackets."""
    for match in re.finditer(r"[.;](?=\s|$)", text):
        sentence = text[: match.start()]
        if sentence.count("(") == sentence.count(")") and not sentence.endswith(("e.g", "i.e")):
            return f"{sentence}."
    return text
