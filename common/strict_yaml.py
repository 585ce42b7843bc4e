"""YAML without surprises: a strict subclass of `yaml.SafeLoader`, and the dumper that matches it.

A file from an unknown source is refused before anything is built from it if it uses aliases or
anchors (a few lines of which can unfold to gigabytes), tags (which can name Python objects),
duplicate keys (of which ordinary readers silently keep the last) or deep nesting. Scalars follow
YAML 1.2: `yes` and `no` are text, `1e-3` is a number. `common.border.read_yaml` reads a file.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

import yaml

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more

MAX_DEPTH = 20
MOST_NODES = 100_000
_DEEPEST = 1000  # libyaml's own limit of nesting, since PyYAML 6.0.4

Place = tuple[str | int, ...]  # where a value stands in a file: keys and list indices from the top

_INTEGER = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_WORDS: dict[str, bool | float | None] = {
    **{word: None for word in ("", "~", "null", "Null", "NULL")},
    **{word: True for word in ("true", "True", "TRUE")},
    **{word: False for word in ("false", "False", "FALSE")},
    **{word: math.nan for word in (".nan", ".NaN", ".NAN")},
    **{f"{s}.{w}": float(f"{s}inf") for s in ("", "+", "-") for w in ("inf", "Inf", "INF")},
}

if TYPE_CHECKING or not hasattr(yaml, "CSafeLoader"):
    _Loader, _Dumper = yaml.SafeLoader, yaml.SafeDumper
else:
    _Loader, _Dumper = yaml.CSafeLoader, yaml.CSafeDumper


class StrictLoader(_Loader):
    """Loader of plain data: dict, list, str, int, float, bool and None, of one YAML document.

    Data are made of the parser's events, without nodes and tags between them. `get_single_data`
    fills `lines`, the line (from 1) of every place.
    """

    def __init__(self, text: str, name: str = "the text"):
        super().__init__(text)
        self.name, self.lines = name, dict[Place, int]()
        self._nodes = 0

    def get_single_data(self) -> Any:
        """The document's data."""
        self.get_event()
        if self.check_event(yaml.StreamEndEvent):
            raise InputError(f"{self.name} is empty. Give a file with content.")
        self.get_event()
        data = self._value(self.get_event(), ())
        self.get_event()
        if not self.check_event(yaml.StreamEndEvent):
            raise InputError(
                f"{self.name} holds several YAML documents ('---'). Keep one per file."
            )
        return data

    def _value(self, event: Any, place: Place) -> Any:
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise InputError(
                f"{self._where(event)} uses a YAML alias or anchor (& or *), which is refused "
                "because a few of them can unfold to gigabytes. Write the value out, or quote the "
                "text."
            )
        self._admit(event, len(place))
        self.lines[place] = event.start_mark.line + 1
        if isinstance(event, yaml.ScalarEvent):
            return event.value if event.style else _plain(event.value)
        if isinstance(event, yaml.SequenceStartEvent):
            items: list[Any] = []
            while not isinstance(event := self.get_event(), yaml.SequenceEndEvent):
                items.append(self._value(event, (*place, len(items))))
            return items
        mapping: dict[str, Any] = {}
        while not isinstance(event := self.get_event(), yaml.MappingEndEvent):
            key = self._key(event, len(place) + 1)
            if key in mapping:
                raise InputError(
                    f"{self._where(event)}, {place_text((*place, key))} stands in the file twice. "
                    "Remove one of the two."
                )
            mapping[key] = self._value(self.get_event(), (*place, key))
        return mapping

    def _key(self, event: Any, depth: int) -> str:
        plain = isinstance(event, yaml.ScalarEvent) and event.anchor is None and event.tag is None
        if not plain:
            raise InputError(
                f"{self._where(event)} has a key that is not a plain word. Use words as keys."
            )
        self._admit(event, depth)
        return event.value

    def _admit(self, event: Any, depth: int) -> None:
        if event.tag is not None:
            raise InputError(
                f"{self._where(event)} uses a YAML tag ({printable(event.tag)}). Write the plain "
                "value."
            )
        if depth > MAX_DEPTH:
            refuse_more(self._where(event), depth, MAX_DEPTH, "levels of nesting", exact=False)
        if self._nodes > MOST_NODES:
            refuse_more(self.name, self._nodes, MOST_NODES, "values", exact=False)
        self._nodes += 1

    def _where(self, event: Any) -> str:
        return f"{self.name}, line {event.start_mark.line + 1}"


def place_text(place: Place) -> str:
    """`place` in words.

    Examples
    --------
    >>> place_text(("joints", "LF_hip", "selection", "candidate_models", 2))
    'joints.LF_hip.selection.candidate_models[2]'
    """
    words = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in place]
    return printable("".join(words).removeprefix("."))


def printable(text: str) -> str:
    """`text` without line breaks and terminal codes, which a file may hold and a sentence not."""
    return "".join(c if c.isprintable() else " " for c in text)


def load(text: str, name: str = "the text") -> tuple[Any, dict[Place, int]]:
    """Data of YAML `text`, and the line (from 1) of every place in it.

    Examples
    --------
    >>> load("{legs: 4, names: [yes, '5']}")[0]
    {'legs': 4, 'names': ['yes', '5']}
    """
    try:
        loader = StrictLoader(text, name)
        return loader.get_single_data(), loader.lines
    except RecursionError:
        raise InputError(f"{name} is nested too deeply. Check the file.") from None
    except yaml.YAMLError as error:
        what = getattr(error, "problem", None) or getattr(error, "reason", None) or str(error)
        if "nesting depth" in what:
            refuse_more(name, _DEEPEST, MAX_DEPTH, "levels of nesting", exact=False)
            raise InputError(f"{name} is nested too deeply. Check the file.") from error
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        at = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise InputError(f"{name} is not valid YAML: {at}{what}.") from error


def dump(data: Any) -> str:
    """`data` as YAML text that `load` reads back; a mapping of scalars takes one line."""
    return yaml.dump(data, Dumper=_PlainDumper, sort_keys=False, allow_unicode=True, width=10_000)


def _plain(text: str) -> Any:
    """What unquoted `text` means by YAML 1.2's core rules."""
    if text in _WORDS:
        return _WORDS[text]
    if len(text) <= 20 and _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    return text


class _PlainDumper(_Dumper):
    """Writes only what `load` accepts, and text only so that it reads back as text."""

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
