"""Reports as one HTML page without network or scripts: figures are inside.

A page is a list of `Section` objects of text, pictures and tables, set by one template for screens
of all sizes and for print; details are folded. Figures are drawings within the page, which follow
its dark mode. `write_page` writes it, and beside it its figures as PNG and SVG and its tables as
CSV.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from pupper_sysid.common.figure_style import inline_svg, png, svg
from pupper_sysid.common.files import refuse_overwrite, write_bytes, write_text
from pupper_sysid.common.processes.stop import held
from pupper_sysid.common.tables import Column, Row, Table


@dataclass(frozen=True)
class Picture:
    """A figure of the report."""

    name: str
    """Name of its files, without ending."""
    caption: str
    """What it shows; also its text for screen readers."""
    figure: Figure
    wide: bool = False
    """Many panels beside each other: the width of the page, scrolled on a narrow screen."""

    @cached_property
    def png(self) -> bytes:
        """The figure as a PNG image."""
        return png(self.figure)

    @cached_property
    def svg(self) -> bytes:
        """The figure as an SVG drawing."""
        return svg(self.figure)

    @property
    def inline(self) -> Markup:
        """The drawing as a part of the page."""
        return Markup(inline_svg(self.svg, self.caption))


@dataclass(frozen=True)
class Fold:
    """Details under one title, shown when it is opened."""

    title: str
    figures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    opened: bool = False


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    anchor: str
    title: str
    text: Sequence[str] = ()
    """Paragraphs."""
    findings: Sequence[tuple[str, str]] = ()
    """Each with its name, which may be empty."""
    toggles: Mapping[str, str] = field(default_factory=dict)
    """Parts of the page's figures that the reader can hide, and what they are called; a part is
    what was drawn under that `gid`."""
    figures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    files: Sequence[Table] = ()
    """Written as CSV, not shown."""
    folds: Sequence[Fold] = ()
    notes: Sequence[str] = ()
    """In small print."""

    @property
    def pictures(self) -> list[Picture]:
        """Those of the section and of its folds."""
        return [*self.figures, *(p for f in self.folds for p in f.figures)]


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
    """Write a page, and in its folder `figures/*.png`, `figures/*.svg` and `tables/*.csv`."""
    drawn = [(path.parent / "figures" / p.name, p) for s in sections for p in s.pictures]
    tables = {
        path.parent / "tables" / f"{t.name}.csv": t
        for s in sections
        for t in (*s.tables, *s.files)
        if t.rows and t.name
    }
    endings = [file.with_name(f"{file.name}.{e}") for file, _ in drawn for e in ("png", "svg")]
    for file in (path, *endings, *tables):  # before anything is drawn
        refuse_overwrite(file, force)
    html = render(title, subtitle, sections)
    pngs = {file.with_name(f"{file.name}.png"): p.png for file, p in drawn}
    svgs = {file.with_name(f"{file.name}.svg"): p.svg for file, p in drawn}
    csvs = {file: table.to_csv() for file, table in tables.items()}
    with held():  # a page needs its pictures
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
    environment.filters["cell"] = _cell
    template = environment.get_template("page.html.j2")
    return template.render(title=title, subtitle=subtitle, sections=sections)


def _cell(column: Column, row: Row) -> Markup:
    """A cell, with a typographic minus in numbers."""
    text = column.text(row)
    if column.is_number:
        text = type(text)(re.sub(r"(?<!\w)-(?=\d)", "−", text))
    return _code(text)


def _code(text: str) -> Markup:
    """The text, escaped; between backticks as code."""
    quoted = str(escape(text))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", quoted))
