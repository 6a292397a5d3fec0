"""A statement of the paper with the result of its experiment."""

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
        The statement, a sentence.
    measured : str
        Results of the experiment, with numbers.
    verdict : Verdict
    commands : tuple of str
        Further commands that show the result, besides ``./scripts/experiment paper KEY``.
    figures : tuple of str
        File names in the page's folder of figures.
    table : (header, rows) or None
        Table of results; cells are strings.
    """

    key: str
    where: str
    says: str
    measured: str
    verdict: Verdict
    commands: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()
    table: tuple[tuple[str, ...], tuple[tuple[str, ...], ...]] | None = None
