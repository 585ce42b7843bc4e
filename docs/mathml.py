"""Formulas as MathML, which every browser draws by itself: no script, no network."""

from __future__ import annotations

from typing import Any

from latex2mathml.converter import convert


def _inline(translator: Any, node: Any) -> None:
    translator.body.append(convert(node.astext()))


def _block(translator: Any, node: Any) -> None:
    translator.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>\n')


def _nothing(translator: Any, node: Any) -> None:
    """Leave the node."""


def _skip(visit: Any) -> Any:
    """Draw a formula and leave its source out."""
    from docutils.nodes import SkipNode

    def wrapped(translator: Any, node: Any) -> None:
        visit(translator, node)
        raise SkipNode

    return wrapped


def setup(app: Any) -> dict[str, bool]:
    """Register the renderer; conf.py chooses it by name."""
    app.add_html_math_renderer("mathml", (_skip(_inline), _nothing), (_skip(_block), _nothing))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
