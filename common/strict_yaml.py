"""Plain YAML in, plain YAML out: numbers, text, lists and mappings, and nothing that surprises.

A file from a stranger is read event by event, so that nothing is built from what is refused:
aliases and anchors (a few lines of which can unfold to gigabytes), tags (which can name Python
objects), duplicate keys (of which ordinary readers silently keep the last), deep nesting and big
files. Words mean what they say: `yes` and `no` are text, `1e-3` is a number (YAML 1.2's rules).

`read` returns the data and the line each place stands on; `dump` writes what `read` reads back.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from pupper_sysid.common.errors import InputError

MAX_BYTES = 2_000_000
MAX_DEPTH = 20

Place = tuple[str | int, ...]
"""Where a value stands in a file: keys and list indices from the top."""

_INTEGER = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)")
_NOT_A_NUMBER = (".nan", ".NaN", ".NAN")
_WORDS: dict[str, bool | None] = {
    **{word: None for word in ("", "~", "null", "Null", "NULL")},
    **{word: True for word in ("true", "True", "TRUE")},
    **{word: False for word in ("false", "False", "FALSE")},
}

_Parser = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
_Dumper: type[yaml.SafeDumper] = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def read(path: Path) -> tuple[Any, dict[Place, int]]:
    """Read the YAML file at `path`.

    Returns
    -------
    data : dict, list, str, int, float, bool or None
    lines : dict
        The line (from 1) of every place in the file.

    Raises
    ------
    InputError
        If the file is missing, too big, not text, not YAML, or uses what this module refuses.
    """
    text = _read_text(path)
    lines: dict[Place, int] = {}
    try:
        events = yaml.parse(text, Loader=_Parser)
        next(events)  # start of the stream
        if isinstance(next(events), yaml.StreamEndEvent):
            raise InputError(f"{path} is empty. Give a file with content.")
        data = _value(events, next(events), (), lines, path)
        next(events)  # end of the document
        if not isinstance(next(events), yaml.StreamEndEvent):
            raise InputError(f"{path} holds several YAML documents ('---'). Keep one per file.")
    except yaml.YAMLError as error:
        raise InputError(f"{path} is not valid YAML: {_one_line(error)}.") from error
    return data, lines


def dump(data: Any) -> str:
    """`data` as YAML text; a mapping of scalars takes one line, so that a number stays whole."""
    return yaml.dump(data, Dumper=_PlainDumper, sort_keys=False, allow_unicode=True, width=10_000)


def place_text(place: Place) -> str:
    """`place` as people write it.

    Examples
    --------
    >>> place_text(("joints", "LF_hip", "selection", "candidate_models", 2))
    'joints.LF_hip.selection.candidate_models[2]'
    """
    words = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in place]
    return "".join(words).removeprefix(".")


def _read_text(path: Path) -> str:
    if not path.exists():
        raise InputError(f"{path} does not exist. Check the name.")
    if not path.is_file():
        raise InputError(f"{path} is not a file. Give the name of a YAML file.")
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    if len(content) > MAX_BYTES:
        raise InputError(
            f"{path} is larger than {MAX_BYTES / 1e6:g} MB, and no such file of this project is. "
            "Check that it is the file you meant."
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is not a text file (byte {error.start} is not UTF-8). "
            "Check that it is the file you meant."
        ) from error


def _value(
    events: Iterator[Any], event: Any, place: Place, lines: dict[Place, int], path: Path
) -> Any:
    """The value that begins with `event`; takes its remaining events from `events`."""
    line = event.start_mark.line + 1
    lines[place] = line
    where = f"{path}, line {line}"
    if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
        raise InputError(
            f"{where} uses a YAML alias or anchor (& or *), which is refused because a few of "
            "them can unfold to gigabytes. Write the value out, or quote the text."
        )
    if event.tag is not None:
        raise InputError(f"{where} uses a YAML tag ({event.tag}). Write the plain value.")
    if len(place) > MAX_DEPTH:
        raise InputError(f"{where} is nested deeper than {MAX_DEPTH} levels. Check the file.")
    if isinstance(event, yaml.SequenceStartEvent):
        items: list[Any] = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            items.append(_value(events, event, (*place, len(items)), lines, path))
        return items
    if isinstance(event, yaml.MappingStartEvent):
        mapping: dict[str, Any] = {}
        while not isinstance(event := next(events), yaml.MappingEndEvent):
            key = _key(event, place, mapping, path)
            mapping[key] = _value(events, next(events), (*place, key), lines, path)
        return mapping
    return event.value if event.style else _plain(event.value)


def _key(event: Any, place: Place, taken: dict[str, Any], path: Path) -> str:
    where = f"{path}, line {event.start_mark.line + 1}"
    if not isinstance(event, yaml.ScalarEvent) or event.anchor is not None or event.tag is not None:
        raise InputError(f"{where} has a key that is not a plain word. Use words as keys.")
    if event.value in taken:
        raise InputError(
            f"{where}, {place_text((*place, event.value))} stands in the file twice. "
            "Remove one of the two."
        )
    return event.value


def _plain(text: str) -> Any:
    """What unquoted `text` means by YAML 1.2's core rules."""
    if text in _WORDS:
        return _WORDS[text]
    if len(text) < 20 and _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _INFINITE.fullmatch(text):
        return -math.inf if text.startswith("-") else math.inf
    if text in _NOT_A_NUMBER:
        return math.nan
    return text


def _one_line(error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    what = getattr(error, "problem", None) or getattr(error, "reason", None) or str(error)
    place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return f"{place}{what}"


class _PlainDumper(_Dumper):
    """Writes only what `read` accepts, and text only so that it reads back as text."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.Node:
    style = "'" if _plain(text) is not text else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


def _represent_mapping(dumper: yaml.SafeDumper, mapping: dict) -> yaml.Node:
    flat = bool(mapping) and not any(isinstance(v, dict | list) for v in mapping.values())
    return dumper.represent_mapping("tag:yaml.org,2002:map", mapping, flow_style=flat)


def _represent_list(dumper: yaml.SafeDumper, items: list) -> yaml.Node:
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=not items)


_PlainDumper.add_representer(str, _represent_text)
_PlainDumper.add_representer(dict, _represent_mapping)
_PlainDumper.add_representer(list, _represent_list)
