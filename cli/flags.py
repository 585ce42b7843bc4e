"""Spell the arguments of the library as options of the command line.

A message below `cli/` names an argument in back-quotes, as Python spells it; `spell` replaces it by
the option of the running command, and leaves every other word alone. So a message reads right both
for a caller of the library and at the command line::

    `stall_torque_nm`    --stall-torque
    `force=True`         --force
    `preset='paper'`     --preset paper
    `learning_rate`      --learner.learning-rate

An option is found by the argument's name, by its name without the unit, or by `_OTHER_NAMES`.
Errors (`user_errors`) and warnings (`terminal.warn`) are spelled so; a command need not call this.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from typing import Any

_OTHER_NAMES = {"frequencies": "freqs", "address": "bus", "workers": "jobs", "p_gain": "gain"}
_OF_EVERY_PROGRAM = {"read_limit": "--read-limit"}
"""Options with a name of their own, by the library's argument (without its unit)."""

_ARGUMENT = re.compile(r"`([a-z][a-z0-9_]*)(?:=('?)([^`']*)\2)?`")
_UNIT = re.compile(r"_(rad_s|m_s|s|ms|hz|rad|nm)$")
_flags: ContextVar[Mapping[str, str]] = ContextVar("flags")


def remember(options: Any) -> None:
    """Take the options of the running command, parsed, as those that messages may name."""
    _flags.set(_flags_of(options))


def forget() -> None:
    """Spell nothing from now on: the command has ended."""
    _flags.set({})


def spell(text: str) -> str:
    """`text` with the arguments in back-quotes replaced by the running command's options."""
    known = _OF_EVERY_PROGRAM | dict(_flags.get({}))

    def flag(found: re.Match[str]) -> str:
        name = _UNIT.sub("", found[1])
        options = (known.get(n) for n in (found[1], name, _OTHER_NAMES.get(name)) if n)
        option = next(filter(None, options), None)
        if option is None:
            return found[0]
        return option if found[3] in (None, "True") else f"{option} {found[3]}"

    return _ARGUMENT.sub(flag, text)


def _flags_of(options: Any, prefix: str = "--") -> dict[str, str]:
    """Flag of every option that is not positional, by field; those of nested groups, too."""
    own, nested = {}, {}
    for field in fields(options):
        value, kind = getattr(options, field.name), str(field.type)
        flag = prefix + field.name.replace("_", "-")
        if is_dataclass(value):
            nested = _flags_of(value, prefix if "name=''" in kind else f"{flag}.") | nested
        elif "Positional" not in kind:
            own[field.name] = flag
    return nested | own
