"""The runs that a public function of this room was given."""

from __future__ import annotations

from typing import Any

from ckc_pin.base.validation import require_type
from ckc_pin.errors import InputError
from ckc_pin.run.run import Run

__all__ = ["given_runs"]


def given_runs(given: Any, who: str) -> list[Run]:
    """Return the runs that a public function was given, one or several.

    Raises
    ------
    InputError
        None at all, or something else among them.
    """
    runs = list(given) if isinstance(given, list | tuple) else [given]
    if not runs:
        raise InputError(f"{who}: no run given; give at least one")
    for run in runs:
        require_type(run, Run, f"{who}: runs", "runs, as simulate and Run.load return them")
    return runs
