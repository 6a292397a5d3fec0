"""The paper's errata, each computed."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from scripts.experiments.paper.errata_control import CONTROL
from scripts.experiments.paper.errata_model import MODEL
from scripts.experiments.paper.errata_spf import SPF
from scripts.experiments.paper.erratum import Erratum

__all__ = ["ERRATA", "Erratum", "find"]

ERRATA: dict[str, Callable[[], Erratum]] = {
    compute.__name__.replace("_", "-"): compute for compute in (*MODEL, *SPF, *CONTROL)
}


def find(keys: Iterable[str]) -> list[Erratum]:
    """Compute errata by key, all of them without keys."""
    return [ERRATA[key]() for key in (list(keys) or ERRATA)]
