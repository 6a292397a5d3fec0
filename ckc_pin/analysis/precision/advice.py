"""Which setting to take: the fastest one that meets an accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ckc_pin.analysis.precision.motion import Row

__all__ = ["TARGETS", "Advice", "advise", "fastest"]

TARGETS = (1e-3, 1e-6, 1e-9)


@dataclass(frozen=True)
class Advice:
    """What to take for an error.

    Attributes
    ----------
    target : float
    row : Row or None
        The fastest setting that met it.
    reason : str
        Why there is none.
    peer : Row or None
        The fastest of MuJoCo's that met it.
    """

    target: float
    row: Row | None
    reason: str
    peer: Row | None

    @property
    def options(self) -> list[str]:
        """The setting as options of `ckc run`."""
        return [] if self.row is None else _options(self.row.changes)


def advise(rows: Sequence[Row], accuracy: float) -> list[Advice]:
    """Find the fastest row for each target; what the reference cannot tell is not advised."""
    found = []
    for target in TARGETS:
        ours, theirs = (fastest(rows, target, accuracy, program) for program in ("ckc_pin", "MuJoCo"))
        reason = ""
        if target <= accuracy:
            reason = f"the reference itself is only known to {accuracy:.1e}"
        elif ours is None:
            reason = "no setting that was tried gets there"
        found.append(Advice(target, ours, reason, theirs))
    return found


def fastest(rows: Sequence[Row], target: float, accuracy: float, program: str) -> Row | None:
    """Return the row that took the least time of those whose error, the reference's added, is within a target."""
    good = [row for row in rows if row.program == program and row.error is not None and row.error + accuracy <= target]
    return min(good, key=lambda row: row.wall_s or 0.0, default=None)


def _options(changes: Mapping[str, Any]) -> list[str]:
    return [f"{key}={x:.0e}" if isinstance(x, float) else f"{key}={x}" for key, x in changes.items() if x is not None]
