"""One-screen summaries of results, as text for a terminal and as HTML for a notebook, and JSON of results."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import printable

__all__ = [
    "HasSummary",
    "Row",
    "Summary",
    "format_eigenvalues",
    "format_quantities",
    "in_notebook",
    "to_json",
    "to_pairs",
]

LINE_WIDTH = 88  # characters of a line of a repr
MAX_LINES_PER_ROW = 3  # in a repr; a command prints every line
MAX_ROWS = 16  # in a repr
REMAINDER_WIDTH = 14  # characters kept free for "and 12 more"
GAP = "  "  # between two items, and between label and content
MAX_EIGENVALUES = 6
REAL_TOLERANCE = 1e-9  # an eigenvalue is printed as real if its imaginary part is smaller, relative to its size

Row = tuple[str, str | Sequence[str]]


@dataclass(frozen=True)
class Summary:
    """Title and labelled rows that describe a value.

    Attributes
    ----------
    title : str
    rows : sequence of (label, text) or (label, items)
        A text may be broken between words. A list of items is broken between items only.
    """

    title: str
    rows: Sequence[Row]

    def lines(self, width: int = LINE_WIDTH, max_lines: int | None = None) -> Iterator[str]:
        """Yield the lines below the title: at most `max_lines` for each row, the last with a count of omitted items."""
        column = max((len(label) for label, _ in self.rows), default=0) + len(GAP)
        for label, content in self.rows:
            available = max(width - column, 20)
            wrap = _wrap_text if isinstance(content, str) else _wrap_items
            for k, line in enumerate(wrap(content, available, max_lines) or [""]):  # type: ignore[arg-type]
                yield f"{'' if k else label:<{column}}{line}".rstrip()

    def text(self, width: int = LINE_WIDTH, max_lines: int | None = MAX_LINES_PER_ROW) -> str:
        """Return title and rows as text of at most `width` columns."""
        summary = self
        if max_lines is not None and len(self.rows) > MAX_ROWS:
            omitted = len(self.rows) - MAX_ROWS + 1
            summary = Summary(self.title, [*self.rows[: MAX_ROWS - 1], ("…", f"and {omitted} more")])
        lines = (f"  {printable(line)}" for line in summary.lines(width - 2, max_lines))
        return "\n".join([printable(self.title), *lines])

    def html(self) -> str:
        """Return title and rows as an HTML table, with every row and every item."""
        from html import escape  # imported here because a run that prints JSON does not need it

        rows = "".join(
            f'<tr><th style="text-align: left; white-space: nowrap">{escape(label)}</th>'
            f'<td style="text-align: left">{escape(GAP.join(items))}</td></tr>'
            for label, items in ((label, [x] if isinstance(x, str) else x) for label, x in self.rows)
        )
        title = f"<strong>{escape(self.title)}</strong>" if self.title else ""
        return f"<div>{title}<table>{rows}</table></div>"


class HasSummary:
    """Base of results that print as a one-screen summary, and as a table in a notebook."""

    def summary(self) -> Summary:
        """Return the title and rows that describe this value."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return self.summary().text()

    def _repr_html_(self) -> str:
        return self.summary().html()


def format_quantities(names: Sequence[str], values: Array, units: Sequence[str] = (), digits: int = 6) -> list[str]:
    """Return one text for each quantity, such as ``theta_1 = 0.4 rad``."""
    texts = [f"{name} = {value:.{digits}g}" for name, value in zip(names, np.asarray(values).tolist(), strict=True)]
    return [f"{text} {unit}" for text, unit in zip(texts, units, strict=True)] if len(units) else texts


def _wrap_text(text: str, width: int, max_lines: int | None) -> list[str]:
    from textwrap import wrap  # imported here because a run that prints JSON does not need it

    lines = wrap(text, width, break_long_words=False, break_on_hyphens=False)
    if max_lines is None or len(lines) <= max_lines:
        return lines
    return [*lines[: max_lines - 1], f"{lines[max_lines - 1]} …"]


def _wrap_items(items: Sequence[str], width: int, max_lines: int | None) -> list[str]:
    lines: list[list[str]] = [[]]
    for k, item in enumerate(items):
        is_last_line = max_lines is not None and len(lines) == max_lines
        if lines[-1] and len(GAP.join([*lines[-1], item])) > width - (REMAINDER_WIDTH if is_last_line else 0):
            if is_last_line:
                lines[-1].append(f"and {len(items) - k} more")
                break
            lines.append([])
        lines[-1].append(item)
    return [GAP.join(line) for line in lines]


def in_notebook() -> bool:
    """Whether the program runs in a notebook kernel, which can display HTML, and not in a terminal."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


def to_json(data: dict[str, Any]) -> str:
    """Return data as one line of JSON. NaN and infinity, which JSON does not have, become null."""
    return json.dumps(_replace_nonfinite(data), allow_nan=False)


def _replace_nonfinite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_nonfinite(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nonfinite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_pairs(values: Any) -> list[list[float]]:
    """Return complex numbers as a list of [real part, imaginary part]."""
    return [[float(x.real), float(x.imag)] for x in np.asarray(values, dtype=complex)]


def format_eigenvalues(values: Any) -> str:
    """Return the first eigenvalues as text, such as ``-1 +- 2i, -3``: a conjugate pair is written once."""
    upper = [x for x in values if x.imag >= -REAL_TOLERANCE * abs(x)]
    texts = [
        f"{x.real:.4g}" if abs(x.imag) <= REAL_TOLERANCE * abs(x) else f"{x.real:.4g} +- {x.imag:.4g}i"
        for x in upper[:MAX_EIGENVALUES]
    ]
    return ", ".join(texts) + (f" and {len(upper) - MAX_EIGENVALUES} more" if len(upper) > MAX_EIGENVALUES else "")
