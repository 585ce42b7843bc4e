"""Reports as one HTML page without network or scripts: figures are inside.

A page is a list of `Section` objects of text, pictures and tables, set by one template for screens
of all sizes and for print. `write_page` writes it, and beside it its figures as PNG and SVG and its
tables as CSV.
"""

from __future__ import annotations

import base64
import csv
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from pupper_sysid.common.figure_style import png, svg
from pupper_sysid.common.files import refuse_overwrite, write_bytes, write_text
from pupper_sysid.common.results import plain

Row = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, and the text of a row's cell."""

    heading: str
    show: Callable[[Row], str]
    kind: Literal["key", "number", "words", "prose"] = "number"
    """Layout: a key stays visible when a table is scrolled, prose is broken into lines."""


@dataclass(frozen=True)
class Table:
    """A table of the report.

    Attributes
    ----------
    name : str
        Name of its CSV file, without ending.
    title : str
    columns : tuple of Column
        On the page.
    rows : tuple of dict
        In the CSV file; all rows have the same keys.
    marked : str
        Rows in which this key is true are bold on the page.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    marked: str = ""

    def to_csv(self) -> str:
        """All values of all rows; a cell is empty where a number is not finite."""
        buffer = io.StringIO()
        writer = csv.DictWriter(
            buffer, list(self.rows[0]) if self.rows else [], lineterminator="\n"
        )
        writer.writeheader()
        writer.writerows(plain(row) for row in self.rows)
        return buffer.getvalue()


@dataclass(frozen=True)
class Picture:
    """A figure of the report."""

    name: str
    """Name of its files, without ending."""
    caption: str
    """What it shows; also its text for screen readers."""
    figure: Figure

    @cached_property
    def png(self) -> bytes:
        """The figure as a PNG image, for the page."""
        return png(self.figure)

    @cached_property
    def svg(self) -> bytes:
        """The figure as an SVG drawing, for print."""
        return svg(self.figure)

    @property
    def base64(self) -> str:
        """The image as text, for a `data:` address."""
        return base64.b64encode(self.png).decode("ascii")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels], from the PNG's header."""
        return int.from_bytes(self.png[16:20], "big"), int.from_bytes(self.png[20:24], "big")


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes
    ----------
    anchor, title : str
    text : sequence of str
        Paragraphs.
    findings : sequence of (str, str)
        Each with its name, which may be empty.
    figures : sequence of Picture
    tables : sequence of Table
    notes : sequence of str
        In small print.
    """

    anchor: str
    title: str
    text: Sequence[str] = ()
    findings: Sequence[tuple[str, str]] = ()
    figures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = field(default=())


@dataclass(frozen=True)
class WrittenPage:
    """The files of a report."""

    path: Path
    figures: tuple[Path, ...]
    drawings: tuple[Path, ...]
    tables: tuple[Path, ...]


def write_page(
    path: Path, title: str, subtitle: str, sections: Sequence[Section], force: bool = False
) -> WrittenPage:
    """Write a page, and beside it its figures and tables.

    Parameters
    ----------
    path : Path
        Of the page; its folder gets `figures/*.png`, `figures/*.svg` and `tables/*.csv`.
    title, subtitle : str
    sections : sequence of Section
    force : bool
        Replace files that exist.

    Raises
    ------
    InputError
        If one of the files exists and `force` is not given (nothing has been written then), or if
        one cannot be written.
    """
    html = render(title, subtitle, sections)
    drawn = [(path.parent / "figures" / p.name, p) for s in sections for p in s.figures]
    pngs = {file.with_name(f"{file.name}.png"): p.png for file, p in drawn}
    svgs = {file.with_name(f"{file.name}.svg"): p.svg for file, p in drawn}
    csvs = {
        path.parent / "tables" / f"{t.name}.csv": t.to_csv()
        for s in sections
        for t in s.tables
        if t.rows
    }
    for file in (path, *pngs, *svgs, *csvs):
        refuse_overwrite(file, force)
    for file, image in (pngs | svgs).items():
        write_bytes(file, image, force)
    for file, text in csvs.items():
        write_text(file, text, force)
    write_text(path, html, force)
    return WrittenPage(path, tuple(pngs), tuple(svgs), tuple(csvs))


def render(title: str, subtitle: str, sections: Sequence[Section]) -> str:
    """The page as HTML. Every text is escaped: names of files are the user's."""
    environment = Environment(
        loader=PackageLoader("pupper_sysid.common"), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["code"] = _code
    template = environment.get_template("page.html.j2")
    return template.render(title=title, subtitle=subtitle, sections=sections)


def _code(text: str) -> Markup:
    """The text, escaped; between backticks as code."""
    quoted = str(escape(text))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", quoted))
