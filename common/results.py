"""Results as plain data: what `--json` prints and what a program keeps of an analysis.

Every public function of the library returns a frozen dataclass derived from `Result`. Its fields
are the keys of its JSON object; there is no second list of names. Fields that are not plain data
(trials for a picture, a fitted model) are declared with `internal()` and left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

_INTERNAL = {"internal": True}


def internal(**keywords: Any) -> Any:
    """A dataclass field that is not part of the result's plain data."""
    return field(metadata=_INTERNAL, repr=False, **keywords)


class Result:
    """Base of result dataclasses."""

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain data: dicts, lists, text, finite numbers and None."""
        return plain(self)


def plain(value: Any) -> Any:
    """`value` as JSON holds it; a number that is not finite becomes None.

    Examples
    --------
    >>> from pupper_sysid.common.interval import Interval
    >>> plain({"lag_s": Interval(0.04, 0.03, math.nan), "trials": (1, 2)})
    {'lag_s': {'value': 0.04, 'low': 0.03, 'high': None}, 'trials': [1, 2]}
    """
    if is_dataclass(value) and not isinstance(value, type):
        shown = (f for f in fields(value) if not f.metadata.get("internal"))
        return {f.name: plain(getattr(value, f.name)) for f in shown}
    if hasattr(value, "model_dump"):
        return plain(value.model_dump(mode="json", by_alias=True))
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(entry) for entry in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
