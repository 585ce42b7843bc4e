"""Results as plain data: what `--json` prints and what a program keeps of an analysis.

Every public function of the library returns a frozen dataclass derived from `Result`. Its fields
are the keys of its JSON object; there is no second list of names. Fields that are not plain data
(trials for a picture, a fitted model) are declared with `internal()` and left out; properties that
belong to the data are declared with `derived`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

_INTERNAL = {"internal": True}


def internal(**keywords: Any) -> Any:
    """A dataclass field that is not part of the result's plain data."""
    return field(metadata=_INTERNAL, repr=False, **keywords)


class derived(property):
    """A property that is part of the result's plain data, after the fields."""


class Result:
    """Base of result dataclasses."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "__repr__" not in vars(cls):  # before `dataclass` writes one with every array in it
            setattr(cls, "__repr__", cls.__repr__)  # noqa: B010

    def __repr__(self) -> str:
        name = type(self).__name__
        if type(self).__str__ is not object.__str__:
            first, *more = str(self).splitlines()
            return f"{name}({first}{' …' if more else ''})"
        public = (f for f in fields(self) if not f.metadata.get("internal"))  # type: ignore[arg-type]
        return f"{name}({', '.join(f'{f.name}={_short(getattr(self, f.name))}' for f in public)})"

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain data: dicts, lists, text, finite numbers and None."""
        return plain(self)

    def to_frame(self) -> pd.DataFrame:
        """Table of the numbers and texts; an interval has the columns x, x_low and x_high."""
        import pandas as pd

        return pd.DataFrame(self.rows())

    def rows(self) -> list[dict[str, Any]]:
        """Rows of `to_frame`; by default a single one."""
        return [flat(self.to_dict())]


def _short(value: Any) -> str:
    """A value in a line: four digits, and how many where there are several."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else f"{value[:39]}…")
    if isinstance(value, dict | list | tuple | np.ndarray):
        return f"{len(value)} of them" if len(value) else "none"
    return f"{type(value).__name__}(…)" if isinstance(value, Result) else repr(value)


Each = TypeVar("Each", bound=Result)


@dataclass(frozen=True, kw_only=True, eq=False)
class JointResults(Result, Mapping[str, Each]):
    """Results by joint: a mapping, and one table and one JSON object of all."""

    joints: dict[str, Each]

    def __getitem__(self, joint: str) -> Each:
        return self.joints[joint]

    def __iter__(self) -> Iterator[str]:
        return iter(self.joints)

    def __len__(self) -> int:
        return len(self.joints)

    def __str__(self) -> str:
        return "\n".join(f"{joint}: {result}" for joint, result in self.joints.items())

    def __repr__(self) -> str:
        lines = (f"{joint}: {result!r}" for joint, result in self.joints.items())
        return "\n  ".join([type(self).__name__, *lines])

    def rows(self) -> list[dict[str, Any]]:
        """Rows of all joints, with the joint's name in the first column."""
        return [{"joint": j} | row for j, result in self.joints.items() for row in result.rows()]


def flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """One level of plain data: nested keys are joined by `_`, lists are left out.

    Examples
    --------
    >>> flat({"lag_s": {"value": 0.04, "low": 0.03, "high": 0.05}, "scores": {"fit_percent": 98.0}})
    {'lag_s': 0.04, 'lag_s_low': 0.03, 'lag_s_high': 0.05, 'scores_fit_percent': 98.0}
    """
    level: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            level |= flat(value, f"{prefix}{key}_")
        elif not isinstance(value, list):
            level[prefix[:-1] if key == "value" and prefix else f"{prefix}{key}"] = value
    return level


def plain(value: Any) -> Any:
    """`value` as JSON holds it; a number that is not finite becomes None.

    Examples
    --------
    >>> from pupper_sysid.common.interval import Interval
    >>> plain({"lag_s": Interval(0.04, 0.03, math.nan), "trials": (1, 2)})
    {'lag_s': {'value': 0.04, 'low': 0.03, 'high': None}, 'trials': [1, 2]}
    """
    if hasattr(value, "model_dump"):
        return plain(value.model_dump(mode="json", by_alias=True))
    if is_dataclass(value) and not isinstance(value, type):
        names = [f.name for f in fields(value) if not f.metadata.get("internal")]
        for kind in reversed(type(value).__mro__):
            names += [name for name, entry in vars(kind).items() if isinstance(entry, derived)]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(entry) for entry in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
