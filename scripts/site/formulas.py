"""Render formulas as inline SVG, which needs no font, script or network and has the colour of the text."""

from __future__ import annotations

from functools import cache
from html import escape
from typing import Any

from docutils import nodes
from ziamath.config import config
from ziamath.zmath import Latex

__all__ = ["setup_formulas"]

SIZE = 17.0  # px


def setup_formulas(app: Any) -> None:
    """Register the SVG renderer for ``html_math_renderer``."""
    app.add_html_math_renderer("drawn", (_inline, None), (_block, None))


@cache
def _drawn(latex: str, inline: bool) -> str:
    """Return a formula as SVG, aligned to the base line."""
    config.svg2 = False  # glyphs as paths: ids of shared glyphs would clash within a page
    formula = Latex(latex, size=SIZE, color="currentColor", inline=inline)
    sits = f"vertical-align: {formula.getyofst():.2f}px" if inline else ""
    said = escape(latex, quote=True)
    return formula.svg().replace("<svg ", f'<svg role="img" aria-label="{said}" style="{sits}" ', 1)


def _inline(self: Any, node: Any) -> None:
    self.body.append(f'<span class="math">{_drawn(node.astext(), True)}</span>')
    raise nodes.SkipNode


def _block(self: Any, node: Any) -> None:
    self.body.append(self.starttag(node, "div", CLASS="math-block"))
    self.body.append(f"{_drawn(node.astext(), False)}</div>\n")
    raise nodes.SkipNode
