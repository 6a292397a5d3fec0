"""Which setting to take: the fastest one that meets an accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ckc_pin.analysis.precision.motion import PrecisionRow

__all__ = ["TARGETS", "Advice", "advise", "fastest"]

TARGETS = (1e-3, 1e-6, 1e-9)
CHANCE = 0.1  # of a time


@dataclass(frozen=True)
class Advice:
    """What to take for an error.

    Attributes
    ----------
    target : float
    row : PrecisionRow or None
        The fastest setting that met it.
    reason : str
        Why there is none.
    peer : PrecisionRow or None
        The fastest of MuJoCo's that met it.
    """

    target: float
    row: PrecisionRow | None
    reason: str
    peer: PrecisionRow | None

    @property
    def options(self) -> list[str]:
        """The setting as options of `ckc run`."""
        return [] if self.row is None else _options(self.row.overrides)

    @property
    def removed(self) -> list[str]:
        """Keys to take out of the scene, which no option can."""
        return [] if self.row is None else [key for key, x in self.row.overrides.items() if x is None]


def advise(rows: Sequence[PrecisionRow], accuracy: float) -> list[Advice]:
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


def fastest(rows: Sequence[PrecisionRow], target: float, accuracy: float, program: str) -> PrecisionRow | None:
    """Return the row that took the least time of those whose error, the reference's added, is within a target.

    Times that close are a matter of chance: of rows that take as long, "auto" is preferred.
    """
    good = [
        (row.wall_s, row)
        for row in rows
        if row.program == program
        and row.error is not None
        and row.wall_s is not None
        and row.error + accuracy <= target
    ]
    least = min((wall_s for wall_s, _ in good), default=0.0)
    same = [(row.method != "auto", wall_s, row) for wall_s, row in good if wall_s <= (1 + CHANCE) * least]
    return min(same, key=lambda each: each[:2])[2] if same else None


def _options(overrides: Mapping[str, Any]) -> list[str]:
    return [f"{key}={x:.0e}" if isinstance(x, float) else f"{key}={x}" for key, x in overrides.items() if x is not None]
