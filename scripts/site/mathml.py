"""Formulas as MathML, which browsers draw themselves: nothing is fetched, and no script runs."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

__all__ = ["setup_math"]


def setup_math(app: Any) -> None:
    """Make MathML a renderer that ``html_math_renderer`` can name."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))


def _inline(self: Any, node: Any) -> None:
    self.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _block(self: Any, node: Any) -> None:
    number = ""
    if node["number"]:
        number = f'<span class="eqno">({node["number"]})</span>'
    self.body.append(self.starttag(node, "div", CLASS="math-block"))
    self.body.append(f"{convert(node.astext(), display='block')}{number}</div>\n")
    raise nodes.SkipNode
