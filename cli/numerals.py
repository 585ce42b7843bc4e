"""Numbers of the command line: decimal numerals in ASCII, as in files.

tyro's own rule takes `4_1` for 41 and the digits of every script (`common.reading.dialect`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
