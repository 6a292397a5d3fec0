"""What measurements say about one parameter, and about a combination of parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["BY_PRIOR", "IDENTIFIED", "IN_COMBINATION", "NOT_IDENTIFIABLE", "PRIOR_ONLY", "UNCHANGED", "VERDICTS",
           "Combination", "Estimate"]  # fmt: skip

IDENTIFIED, BY_PRIOR, PRIOR_ONLY = "identified", "identified with a prior", "prior only"
IN_COMBINATION, NOT_IDENTIFIABLE = "only in a combination", "not identifiable"
UNCHANGED = 0.98  # standard deviation, relative to the prior's, with which measurements add nothing to it
VERDICTS = (IDENTIFIED, BY_PRIOR, PRIOR_ONLY, IN_COMBINATION, NOT_IDENTIFIABLE)


@dataclass(frozen=True)
class Estimate:
    """What measurements say about one parameter.

    Attributes
    ----------
    value, std : float or None
        None if neither they nor a prior determine it.
    start : float
        Value in the mechanism's files; of an offset 0.
    verdict : str
        "identified", "identified with a prior", "prior only" (the measurements add nothing), "only in a combination" or
        "not identifiable".
    missing : str or None
        Without a value, why, and which motion would tell it.
    """

    value: float | None
    std: float | None
    start: float
    verdict: str
    missing: str | None = None


@dataclass(frozen=True)
class Combination:
    """A linear combination of unknowns that measurements determine.

    Attributes
    ----------
    coefficients : mapping of str to float
        By unknown; 1 for the first.
    value, std : float
    """

    coefficients: Mapping[str, float]
    value: float
    std: float

    def __str__(self) -> str:
        """Return the combination as a formula."""
        terms = []
        for name, coefficient in self.coefficients.items():
            size = "" if abs(abs(coefficient) - 1) < 1e-9 else f"{abs(coefficient):.6g} "
            terms.append(f"{'-' if coefficient < 0 else '+'} {size}{name}")
        return " ".join(terms).removeprefix("+ ")

    def to_dict(self) -> dict[str, Any]:
        """Return the combination as JSON-ready data."""
        return {
            "combination": str(self), "coefficients": dict(self.coefficients), "value": self.value, "std": self.std
        }  # fmt: skip
