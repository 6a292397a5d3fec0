"""Fill in the pages' Jinja2 templates, in GitHub's Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import metadata
from math import isnan
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

__all__ = ["DOCS", "GZIP", "digits", "environment", "render", "render_blocks", "versions"]

DOCS = Path(__file__).resolve().parents[2] / "docs"
TEMPLATES = Path(__file__).parent / "templates"
MARKUP = re.compile(r"([\\*]|<(?=[A-Za-z/!?]))")  # underscores inside words, as in q_dot, are none on GitHub
GZIP: Any = {"method": "gzip", "mtime": 0}  # without a time stamp, so that equal tables are equal files


def render(template: str, **content: Any) -> str:
    """Return a filled-in template. A variable without a value is an error."""
    return environment().get_template(f"{template}.md.j2").render(content).lstrip("\n")


def render_blocks(template: str, **values: Any) -> dict[str, Any]:
    """Return a template's filled-in blocks. Blank lines separate paragraphs; the lines of a paragraph are joined.

    Returns
    -------
    dict of str to str
        Texts by the blocks' names, which are fields of a `Claim` or an `Erratum`.
    """
    filled = environment().get_template(f"{template}.md.j2")
    context = filled.new_context(values)
    return {name: _paragraphs("".join(block(context))) for name, block in filled.blocks.items()}


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", text.strip()))


def environment() -> Environment:
    """Return the environment of the templates with its filters."""
    jinja = Environment(
        loader=FileSystemLoader(TEMPLATES),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    jinja.filters |= {"plain": _escape, "cell": _escape_cell, "capital": lambda text: text[:1].upper() + text[1:]}
    jinja.filters |= {"digits": digits, "small": _or_empty("{:.0e}"), "count": _or_empty("{:,.0f}")}
    jinja.filters["numbers"] = lambda numbers, form: ", ".join(form % x for x in numbers)
    return jinja


def digits(x: float) -> str:
    """Format a number with two or three digits, never as a power of ten."""
    if x >= 10:
        return f"{float(f'{x:.2g}' if x < 100 else f'{x:.3g}'):,.0f}"
    return f"{x:.2g}"


def versions() -> str:
    """Return the versions of the packages that a page's numbers are computed with."""
    packages = ("ckc_pin", "pin", "numpy", "scipy")
    return ", ".join(f"{name} {metadata.version(name)}" for name in packages)


def _or_empty(form: str) -> Callable[[float], str]:
    """Return a formatter that writes NaN as an empty text."""
    return lambda x: "" if isnan(x) else form.format(x)


def _escape(text: object) -> str:
    """Escape Markdown in a sentence, except in code between backticks."""
    parts = str(text).split("`")
    parts[::2] = [MARKUP.sub(r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)


def _escape_cell(text: object) -> str:
    """Escape a sentence for a table cell. A bar would end the cell even inside code."""
    return _escape(text).replace("|", "\\|").replace("\n", " ")
