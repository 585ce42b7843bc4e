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
from yaml.composer import Composer

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more

MAX_DEPTH = 20
MOST_NODES = 100_000
_DEEPEST = 1000  # libyaml's own limit of nesting, since PyYAML 6.0.4

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

if TYPE_CHECKING or not hasattr(yaml, "CSafeLoader"):
    _Loader, _Dumper = yaml.SafeLoader, yaml.SafeDumper
else:
    _Dumper = yaml.CSafeDumper

    class _Loader(Composer, yaml.CSafeLoader):
        """libyaml's parser; nodes are composed in Python, where `StrictLoader` can refuse them."""

        def __init__(self, text: str):
            yaml.CSafeLoader.__init__(self, text)
            Composer.__init__(self)


class StrictLoader(_Loader):
    """Loader of plain data: dict, list, str, int, float, bool and None.

    Parameters
    ----------
    text : str
        One YAML document.
    name : str
        Name of the file, for messages.

    Attributes
    ----------
    lines : dict
        The line (from 1) of every place, filled by `get_single_data`.
    """

    def __init__(self, text: str, name: str = "the text"):
        super().__init__(text)
        self.name, self.lines = name, dict[Place, int]()
        self._depth = self._nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """The next node, unless it is of a kind that is refused."""
        event: Any = self.peek_event()
        where = f"{self.name}, line {event.start_mark.line + 1}"
        marked = isinstance(event, yaml.AliasEvent) or event.anchor is not None
        tag = getattr(event, "tag", None)
        if isinstance(parent, yaml.MappingNode) and index is None:
            if marked or tag is not None or not isinstance(event, yaml.ScalarEvent):
                raise InputError(f"{where} has a key that is not a plain word. Use words as keys.")
        elif marked:
            raise InputError(
                f"{where} uses a YAML alias or anchor (& or *), which is refused because a few of "
                "them can unfold to gigabytes. Write the value out, or quote the text."
            )
        if tag is not None:
            raise InputError(f"{where} uses a YAML tag ({printable(tag)}). Write the plain value.")
        if self._depth > MAX_DEPTH:
            refuse_more(where, self._depth, MAX_DEPTH, "levels of nesting", exact=False)
        if self._nodes > MOST_NODES:
            refuse_more(self.name, self._nodes, MOST_NODES, "values", exact=False)
        self._depth, self._nodes = self._depth + 1, self._nodes + 1
        node = super().compose_node(parent, index)  # pyright: ignore[reportArgumentType]
        self._depth -= 1
        return node

    def get_single_data(self) -> Any:
        """The document's data."""
        node = self.get_single_node()
        if node is None:
            raise InputError(f"{self.name} is empty. Give a file with content.")
        return self._value(node, ())

    def _value(self, node: Any, place: Place) -> Any:
        self.lines[place] = node.start_mark.line + 1
        if isinstance(node, yaml.SequenceNode):
            return [self._value(item, (*place, n)) for n, item in enumerate(node.value)]
        if not isinstance(node, yaml.MappingNode):
            return node.value if node.style else _plain(node.value)
        mapping: dict[str, Any] = {}
        for key, value in node.value:
            if key.value in mapping:
                raise InputError(
                    f"{self.name}, line {key.start_mark.line + 1}, "
                    f"{place_text((*place, key.value))} stands in the file twice. "
                    "Remove one of the two."
                )
            mapping[key.value] = self._value(value, (*place, key.value))
        return mapping


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

    Raises
    ------
    InputError
        If the text is not YAML, or uses what this module refuses.

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
        if what == "but found another document":
            raise InputError(
                f"{name} holds several YAML documents ('---'). Keep one per file."
            ) from error
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
    if _INFINITE.fullmatch(text):
        return -math.inf if text.startswith("-") else math.inf
    if text in _NOT_A_NUMBER:
        return math.nan
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
