"""Values of the command line: numbers as in files, optional values by their type alone.

tyro's own rules take `4_1` for 41 and the digits of every script (`common.reading.dialect`), and
show an optional value as `{None}|STR`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import NoneType
from typing import Any, get_args

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from pupper_sysid.common.reading.dialect import decimal, whole

NUMERALS = ConstructorRegistry()
"""Rules for `tyro.cli`."""

_READERS: dict[Any, Callable[[str], float]] = {int: whole, float: decimal}


@NUMERALS.primitive_rule
def numeral(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """How an option of type int or float is read; None for other types."""
    kind: Any = type_info.type
    if kind not in _READERS:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=lambda words: _READERS[kind](words[0]),
        is_instance=lambda value: (
            isinstance(value, (int, kind)) and (not isinstance(value, bool) or kind is float)
        ),
        str_from_instance=lambda value: [str(value)],
    )


@NUMERALS.primitive_rule
def optional(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """How an option of a type or None is read: as the type, or `None` as typed."""
    kinds = [kind for kind in get_args(type_info.type) if kind is not NoneType]
    if NoneType not in get_args(type_info.type) or len(kinds) != 1:
        return None
    inner = ConstructorRegistry.get_primitive_spec(
        PrimitiveTypeInfo.make(kinds[0], parent_markers=type_info.markers)
    )
    if not isinstance(inner, PrimitiveConstructorSpec) or inner.nargs != 1:
        return None
    return replace(
        inner,
        instance_from_str=lambda words: (
            None if words == ["None"] else inner.instance_from_str(words)
        ),
        is_instance=lambda value: value is None or inner.is_instance(value),
        str_from_instance=lambda value: (
            ["None"] if value is None else inner.str_from_instance(value)
        ),
    )
