"""Tables of results: one list of columns for the terminal, the HTML page and the CSV file.

A result's rows hold its fields under their names, in SI units; the columns say which of them are
shown, in which unit and with how many digits. `cli.terminal.result_table` sets a `Table` for the
terminal, `common.page` for a page, `Table.to_csv` writes all rows in full.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import plain

Row = Mapping[str, Any]
FACTORS = {"ms": 1e3, "mrad": 1e3, "mm": 1e3, "mm/s": 1e3, "mrad/s": 1e3, "%": 100.0}
"""Of units that are not those of the rows."""


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, and which number of a row it shows."""

    heading: str
    field: str
    """Key of the row. An interval's ends are beside it, as `field_low` and `field_high`."""
    unit: str = ""
    """Unit of the shown number, such as ms where the row has seconds; stands in the heading."""
    digits: int = 1
    kind: Literal["number", "interval", "margin", "key", "words", "prose"] = "number"
    """A margin is half an interval's width. A key stays visible when a table is scrolled; prose is
    broken into lines."""
    show: Callable[[Row], str] | None = None
    """Text of a cell that no single field has."""
    short: str | None = None
    """Heading at a terminal, where the title may have the unit."""
    detail: bool = False
    """Not at a terminal, which is too narrow."""

    @property
    def page_heading(self) -> str:
        """Heading where there is space."""
        return f"{self.heading}, {self.unit}" if self.unit else self.heading

    @property
    def terminal_heading(self) -> str:
        """Heading where there is little."""
        return f"{self.heading} {self.unit}".strip() if self.short is None else self.short

    @property
    def is_number(self) -> bool:
        """Whether the cells are numbers, set to the right."""
        return self.kind in ("number", "interval", "margin")

    def text(self, row: Row) -> str:
        """The cell of a row."""
        if self.show is not None:
            return self.show(row)
        if self.field not in row:
            return ""
        value = row[self.field]
        if not self.is_number:
            return "" if value is None else str(value)
        factor = FACTORS.get(self.unit, 1.0)
        number = rounded(value, self.digits, factor)
        if self.kind == "number":
            return number
        low, high = (row.get(f"{self.field}_{end}") for end in ("low", "high"))
        if self.kind == "interval":
            # without spaces, at which a narrow table would break it
            ends = (rounded(end, self.digits, factor) for end in (low, high))
            return f"{number} ({'…'.join(ends)})"
        half = None if value is None or high is None else high - value
        return f"{number} ±{rounded(half, 0, factor)}" if number != "–" else number


def rounded(value: float | None, digits: int, factor: float = 1.0) -> str:
    """A number with these digits, a dash where there is none; zero has no sign."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value * factor:.{digits}f}"
    return text if float(text) != 0 else text.lstrip("-")


def ends(name: str, interval: Interval) -> dict[str, float]:
    """An interval as three fields of a row."""
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


@dataclass(frozen=True)
class Table:
    """A table of results."""

    name: str
    """Name of its CSV file, without ending; a table without a name has no file."""
    title: str
    columns: Sequence[Column]
    """Where it is shown."""
    rows: Sequence[Row]
    """In the CSV file; all rows have the same keys."""
    marked: str = ""
    """Rows in which this key is true are bold."""

    def where(self, key: str, value: object, title: str = "") -> Table:
        """The part of the rows whose `key` is `value`, without that column; it has no file."""
        return replace(
            self, name="", title=title or self.title,
            rows=tuple(row for row in self.rows if row[key] == value),
            columns=tuple(c for c in self.columns if c.kind != "key"),
        )  # fmt: skip

    def to_csv(self) -> str:
        """All values of all rows; a cell is empty where a number is not finite."""
        buffer = io.StringIO()
        writer = csv.DictWriter(
            buffer, list(self.rows[0]) if self.rows else [], lineterminator="\n"
        )
        writer.writeheader()
        writer.writerows(plain(row) for row in self.rows)
        return buffer.getvalue()
