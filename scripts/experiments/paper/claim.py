"""A statement of the paper with the experiment that answers it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

__all__ = ["Claim", "Verdict"]

Verdict = Literal["holds", "holds with a condition", "does not hold"]


@dataclass(frozen=True)
class Claim:
    """One row of docs/paper.md.

    Attributes
    ----------
    key : str
        Short name, e.g. "tikhonov-order".
    where : str
        Where the paper says it, e.g. "section II-A, eq. 13".
    says : str
        What it says, in a sentence.
    command : str
        What a reader runs to see it.
    found : str
        What was measured, with its numbers.
    verdict : Verdict
    figures : tuple of str
        File names in the page's folder of figures.
    table : (header, rows) or None
        Numbers worth a table; cells are strings.
    """

    key: str
    where: str
    says: str
    command: str
    found: str
    verdict: Verdict
    figures: tuple[str, ...] = ()
    table: tuple[tuple[str, ...], tuple[tuple[str, ...], ...]] | None = field(default=None)
