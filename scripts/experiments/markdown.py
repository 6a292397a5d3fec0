"""Plain sentences as GitHub's Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence

__all__ = ["escaped", "table"]

MARKUP = re.compile(r"([\\*]|<(?=[A-Za-z/!?]))")  # underscores inside words, as in q_dot, are none on GitHub


def escaped(text: str, *, table: bool = False) -> str:
    """Keep what a sentence says from being read as markup; code between backticks stays code.

    Parameters
    ----------
    text : str
    table : bool
        For a cell: a bar would end it, even inside code.
    """
    parts = text.split("`")
    parts[::2] = [MARKUP.sub(r"\\\1", part) for part in parts[::2]]
    joined = "`".join(parts)
    return joined.replace("|", "\\|").replace("\n", " ") if table else joined


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table of plain cells."""
    cells = [[escaped(cell, table=True) for cell in row] for row in (header, *rows)]
    return [_row(cells[0]), f"|{'---|' * len(header)}", *(_row(row) for row in cells[1:])]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
