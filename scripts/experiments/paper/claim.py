"""A statement of the paper with the experiment that answers it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Claim", "Verdict"]

Verdict = Literal["holds", "holds with a condition", "does not hold"]


@dataclass(frozen=True)
class Claim:
    """One row of docs/paper.md; its texts are in ``templates/claims``.

    Attributes
    ----------
    key : str
        Short name, e.g. "tikhonov-order".
    where : str
        Where the paper says it, e.g. "section II-A, eq. 13".
    says : str
        What it says, in a sentence.
    found : str
        What was measured, with its numbers.
    verdict : Verdict
    commands : tuple of str
        What else a reader can run to see it; ``./scripts/experiment paper KEY`` always shows it.
    figures : tuple of str
        File names in the page's folder of figures.
    table : (header, rows) or None
        Numbers worth a table; cells are strings.
    """

    key: str
    where: str
    says: str
    found: str
    verdict: Verdict
    commands: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()
    table: tuple[tuple[str, ...], tuple[tuple[str, ...], ...]] | None = None
