"""Style of the report's figures, and their PNG and SVG files.

Figures are narrow, with large letters, for phones and print; colours are those of Okabe and Ito,
which are distinct to colour-blind readers. pyplot's global state is not used.
"""

from __future__ import annotations

import hashlib
import html
import io
import re
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from PIL import Image

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, write_bytes

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

WIDTH_IN = 5.0
DPI = 190

INK = "#333333"
FAINT = "#9a9a9a"
BLUE = "#0072B2"
SKY = "#56B4E9"
GREEN = "#009E73"
ORANGE = "#E69F00"
RED = "#D55E00"
PINK = "#CC79A7"
JOINT_COLOURS = (BLUE, RED, GREEN, PINK, ORANGE, SKY, INK)
MARKERS = "osD^vP"

_STYLE: dict[RcKeyType, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelsize": 10,
    "xtick.labelsize": 9.5,
    "ytick.labelsize": 9.5,
    "legend.fontsize": 9.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "figure.facecolor": "white",
    "axes.titlelocation": "left",
    "svg.hashsalt": "pupper-sysid",  # the same names inside an SVG each time
}

_P = ParamSpec("_P")


def styled(draw: Callable[_P, Figure]) -> Callable[_P, Figure]:
    """Draw in this style; matplotlib's settings are restored afterwards."""

    @wraps(draw)
    def drawn(*args: _P.args, **kwargs: _P.kwargs) -> Figure:
        with rc_context(_STYLE):
            return draw(*args, **kwargs)

    return drawn


def png(figure: Figure) -> bytes:
    """The figure as a PNG image."""
    with rc_context(_STYLE):
        canvas = FigureCanvasAgg(figure)
        figure.set_dpi(DPI)
        canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    buffer = io.BytesIO()
    # lines and letters need few colours; with a palette the report is a third of the size
    picture.quantize(128, dither=Image.Dither.NONE).save(
        buffer, "PNG", optimize=True, dpi=(DPI, DPI)
    )
    return buffer.getvalue()


def svg(figure: Figure) -> bytes:
    """The figure as an SVG drawing, the same bytes each time."""
    buffer = io.BytesIO()
    with rc_context(_STYLE):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    return buffer.getvalue()


def inline_svg(drawing: bytes, words: str) -> str:
    """A drawing of `svg` as an element of an HTML page; `words` are for screen readers.

    It is an `<svg>` of class `drawing`, as wide as its parent. Colours of this style are the CSS
    variables `--ink`, `--drawing-blue` and so on, so that a page can change them. What was drawn
    with the `gid` "part:NAME" has the class `part-NAME`. Its ids occur once on a page.
    """
    text = drawing.decode()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    head, body = text.split(">", 1)
    (box,) = re.findall(r'viewBox="[0-9. ]+"', head)
    body = re.sub(r'<g id="part:([\w-]+)">', r'<g class="part-\1">', body)
    body = re.sub(r'<g id="[^"]*">', "<g>", body)
    prefix = hashlib.sha256(drawing).hexdigest()[:8]
    body = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", body)
    names = {colour.lower(): name for colour, name in _VARIABLES.items()}
    body = re.sub(
        r"#[0-9a-fA-F]{6}\b",
        lambda m: f"var(--{names[m[0].lower()]}, {m[0]})" if m[0].lower() in names else m[0], body,
    )  # fmt: skip
    label = html.escape(words, quote=True)
    return f'<svg class="drawing" role="img" aria-label="{label}" {box}>{body}'


_VARIABLES = {
    "#000000": "ink", INK: "ink", FAINT: "drawing-faint", "#ffffff": "drawing-paper",
    _STYLE["grid.color"]: "line", BLUE: "drawing-blue", SKY: "drawing-sky",
    GREEN: "drawing-green", ORANGE: "drawing-orange", RED: "drawing-red",
    PINK: "drawing-pink",
}  # fmt: skip


def refuse_picture(path: Path, force: bool = False) -> None:
    """Refuse a path to which no picture can be written."""
    if path.suffix.lower() not in (".png", ".svg"):
        raise InputError(f"{path}: pictures are written as .png or .svg; choose one of them.")
    refuse_overwrite(path, force)


def save(figure: Figure, path: Path, force: bool = False) -> None:
    """Write `figure` to `path`, as PNG or SVG by its ending."""
    refuse_picture(path, force)
    draw = svg if path.suffix.lower() == ".svg" else png
    write_bytes(path, draw(figure), force)


def axes_grid(count: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    """Small multiples: `count` axes in rows of `columns`, each row `height` inches high.

    A figure of three or more columns is twice as wide as others.
    """
    columns = min(columns, max(count, 1))
    rows = -(-max(count, 1) // columns)
    width = WIDTH_IN if columns < 3 else 2 * WIDTH_IN
    figure = Figure(figsize=(width, 1.2 + height * rows), layout="constrained")
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in grid[count:]:
        axes.remove()
    return figure, grid[:count]


def axes_column(rows: int, height: float) -> tuple[Figure, list[Axes]]:
    """An empty figure of `rows` axes above each other, `height` inches high."""
    figure = Figure(figsize=(WIDTH_IN, height), layout="constrained")
    return figure, list(figure.subplots(max(rows, 1), 1, squeeze=False)[:, 0])
