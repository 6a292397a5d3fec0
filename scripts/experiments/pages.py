"""Pages: Jinja2 templates over data, in GitHub's Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import metadata
from math import isnan
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

__all__ = ["DOCS", "GZIP", "digits", "environment", "render", "said", "versions"]

DOCS = Path(__file__).resolve().parents[2] / "docs"
TEMPLATES = Path(__file__).parent / "templates"
MARKUP = re.compile(r"([\\*]|<(?=[A-Za-z/!?]))")  # underscores inside words, as in q_dot, are none on GitHub
GZIP: Any = {"method": "gzip", "mtime": 0}  # equal tables are equal files


def render(template: str, **content: Any) -> str:
    """Fill in a template; what it asks for and is not given is an error."""
    return environment().get_template(f"{template}.md.j2").render(content).lstrip("\n")


def said(template: str, **values: Any) -> dict[str, Any]:
    """Fill in a template's blocks. Lines of a paragraph are joined, and blank lines separate paragraphs.

    Returns
    -------
    dict of str to str
        By the blocks' names: fields of what the template is about.
    """
    filled = environment().get_template(f"{template}.md.j2")
    context = filled.new_context(values)
    return {name: _paragraphs("".join(block(context))) for name, block in filled.blocks.items()}


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", text.strip()))


def environment() -> Environment:
    """Return where templates are found, and the filters they have."""
    found = Environment(
        loader=FileSystemLoader(TEMPLATES),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    found.filters |= {"plain": _plain, "cell": _cell, "capital": lambda text: text[:1].upper() + text[1:]}
    found.filters |= {"digits": digits, "small": _or_empty("{:.0e}"), "count": _or_empty("{:,.0f}")}
    found.filters["numbers"] = lambda numbers, form: ", ".join(form % x for x in numbers)
    return found


def digits(x: float) -> str:
    """Write a number for people: two digits, never as a power of ten."""
    if x >= 10:
        return f"{float(f'{x:.2g}' if x < 100 else f'{x:.3g}'):,.0f}"
    return f"{x:.2g}"


def versions() -> str:
    """Say what a page's numbers are computed with."""
    packages = ("ckc_pin", "pin", "numpy", "scipy")
    return ", ".join(f"{name} {metadata.version(name)}" for name in packages)


def _or_empty(form: str) -> Callable[[float], str]:
    """Return how to write a number that may not be there."""
    return lambda x: "" if isnan(x) else form.format(x)


def _plain(text: object) -> str:
    """Keep a sentence from being read as markup; code between backticks stays code."""
    parts = str(text).split("`")
    parts[::2] = [MARKUP.sub(r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)


def _cell(text: object) -> str:
    """Keep a sentence within its cell, which a bar would end even inside code."""
    return _plain(text).replace("|", "\\|").replace("\n", " ")
