"""A value as a person sees it first: a title and a few lines, as text for a terminal or as a table for a notebook."""

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

__all__ = ["Card", "Row", "Shown", "eigenvalues_text", "in_notebook", "pairs", "quantities", "to_json"]

WIDTH = 88  # characters of a line of a repr
MOST_LINES = 3  # of a row of a repr; a command prints all
MOST_ROWS = 16
COUNTED = 14  # characters of what says how many items are left out
GAP = "  "  # between items
SHOWN = 6  # eigenvalues, in what people read

Row = tuple[str, str | Sequence[str]]


@dataclass(frozen=True)
class Card:
    """What there is to see of a value.

    Attributes
    ----------
    title : str
    rows : sequence of (label, text) or (label, items)
        A text is broken between words; of items none is broken.
    """

    title: str
    rows: Sequence[Row]

    def lines(self, width: int = WIDTH, most: int | None = None) -> Iterator[str]:
        """Yield the lines below the title; `most` of a row, where the rest is counted."""
        column = max((len(label) for label, _ in self.rows), default=0) + len(GAP)
        for label, content in self.rows:
            room = max(width - column, 20)
            broken = _of_text(content, room, most) if isinstance(content, str) else _of_items(content, room, most)
            for k, line in enumerate(broken or [""]):
                yield f"{'' if k else label:<{column}}{line}".rstrip()

    def text(self, width: int = WIDTH, most: int | None = MOST_LINES) -> str:
        """Return title and rows for a terminal of so many columns."""
        shown = self
        if most is not None and len(self.rows) > MOST_ROWS:
            shown = Card(self.title, [*self.rows[: MOST_ROWS - 1], ("…", f"and {len(self.rows) - MOST_ROWS + 1} more")])
        return "\n".join([printable(self.title), *(f"  {printable(line)}" for line in shown.lines(width - 2, most))])

    def html(self) -> str:
        """Return title and rows as a table for a notebook."""
        from html import escape  # here, as wrap below: a run whose outcome is JSON needs neither

        rows = "".join(
            f'<tr><th style="text-align: left; white-space: nowrap">{escape(label)}</th>'
            f'<td style="text-align: left">{escape(GAP.join(items))}</td></tr>'
            for label, items in ((label, [x] if isinstance(x, str) else x) for label, x in self.rows)
        )
        return f"<div><strong>{escape(self.title)}</strong><table>{rows}</table></div>"


class Shown:
    """A value that shows itself as a card: in one screen, and inline in a notebook."""

    def card(self) -> Card:
        """Return what there is to see."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return self.card().text()

    def _repr_html_(self) -> str:
        return self.card().html()


def quantities(names: Sequence[str], values: Array, units: Sequence[str] = (), digits: int = 6) -> list[str]:
    """Return items as ``theta_1 = 0.4 rad``, one a name."""
    shown = [f"{name} = {value:.{digits}g}" for name, value in zip(names, np.asarray(values).tolist(), strict=True)]
    return [f"{text} {unit}" for text, unit in zip(shown, units, strict=True)] if len(units) else shown


def _of_text(text: str, room: int, most: int | None) -> list[str]:
    from textwrap import wrap

    lines = wrap(text, room, break_long_words=False, break_on_hyphens=False)
    return lines if most is None or len(lines) <= most else [*lines[: most - 1], f"{lines[most - 1]} …"]


def _of_items(items: Sequence[str], room: int, most: int | None) -> list[str]:
    """Break between items alone."""
    lines: list[list[str]] = [[]]
    for k, item in enumerate(items):
        last = most is not None and len(lines) == most
        if lines[-1] and len(GAP.join([*lines[-1], item])) > room - (COUNTED if last else 0):
            if last:
                lines[-1].append(f"and {len(items) - k} more")
                break
            lines.append([])
        lines[-1].append(item)
    return [GAP.join(line) for line in lines]


def in_notebook() -> bool:
    """Whether what a cell returns is shown in a page: a kernel runs us, and not a terminal."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


def to_json(data: dict[str, Any]) -> str:
    """Return plain data as one line of JSON, which knows no NaN and no infinity: null."""
    return json.dumps(_finite(data), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def pairs(values: Any) -> list[list[float]]:
    """Return complex numbers as [re, im]."""
    return [[float(x.real), float(x.imag)] for x in np.asarray(values, dtype=complex)]


def eigenvalues_text(values: Any) -> str:
    """Return the rightmost eigenvalues in words, a pair of conjugates as one."""
    some = [x for x in values if x.imag >= -1e-9 * abs(x)]
    shown = [
        f"{x.real:.4g}" if abs(x.imag) <= 1e-9 * abs(x) else f"{x.real:.4g} +- {x.imag:.4g}i" for x in some[:SHOWN]
    ]
    return ", ".join(shown) + (f" and {len(some) - SHOWN} more" if len(some) > SHOWN else "")
