"""The figures to reach: how many times faster than the best other program, at every accuracy it gets to."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from scripts.experiments.benchmark.ours import PROGRAM
from scripts.experiments.benchmark.reference import Reference
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.sentences import fastest, here, ratio, times
from scripts.experiments.benchmark.work import Work
from scripts.experiments.markdown import table

__all__ = ["BY_HAND", "PACKAGED", "Cell", "Goal", "cells", "goals_table"]


@dataclass(frozen=True)
class Goal:
    """How many times faster than whom, down to which accuracy.

    Attributes
    ----------
    says : str
    factor : float
    targets : tuple of float
    planar : bool
        Asked for on planar works alone.
    by_hand : bool
        Against loops written by hand, else against packaged programs.
    """

    says: str
    factor: float
    targets: tuple[float, ...]
    planar: bool
    by_hand: bool


PACKAGED = Goal("the best packaged program", 5.0, tuple(10.0**-k for k in range(3, 10)), planar=True, by_hand=False)
BY_HAND = Goal("the loop written by hand", 2.0, tuple(10.0**-k for k in range(3, 13)), planar=False, by_hand=True)


@dataclass(frozen=True)
class Cell:
    """A goal on one work at one accuracy, where the others get to it.

    Attributes
    ----------
    target : float
    ratio : float or None
        How many times as long the best of them takes; None where nothing here gets there.
    program : str
        Which one that is.
    reached : bool
    """

    target: float
    ratio: float | None
    program: str
    reached: bool


def cells(goal: Goal, rows: Sequence[Row], reference: Reference, by_hand: Collection[str]) -> Iterator[Cell]:
    """Compare one work's rows at each accuracy that the reference tells and one of the others reaches."""
    others = [row for row in rows if row.program != PROGRAM and (row.program in by_hand) == goal.by_hand]
    for target in goal.targets:
        best = fastest(others, target)
        if best is None or target < reference.accuracy:
            continue
        found = ratio(fastest(here(rows), target), best)
        yield Cell(target, found, best.program, found is not None and found >= goal.factor)


def goals_table(
    goal: Goal,
    works: Sequence[Work],
    rows: Mapping[str, Sequence[Row]],
    references: Mapping[str, Reference],
    by_hand: Collection[str],
) -> list[str]:
    """Return a sentence and a table, a row a work, a column an accuracy; nothing where there is nobody to compare."""
    asked = {work.key: work.says for work in works if work.planar or not goal.planar}
    found = {work: {c.target: c for c in cells(goal, rows[work], references[work], by_hand)} for work in asked}
    found = {work: own for work, own in found.items() if own}
    every = [cell for own in found.values() for cell in own.values()]
    if not every:
        return []
    missed = [cell for cell in every if not cell.reached]
    where = [said for work, own in found.items() if (said := _missed(work, list(own.values())))]
    said = (
        f"At least {goal.factor:g} times faster than {goal.says}: reached at {len(every) - len(missed)} of "
        f"{len(every)} accuracies that one gets to{' (planar works)' if goal.planar else ''}"
        + (f"; missed on {', '.join(where)}." if where else ".")
    )
    header = ["work", *(f"{target:.0e}" for target in goal.targets)]
    several = len({cell.program for cell in every}) > 1
    lines = [[asked[work], *(_said(own.get(x), several) for x in goal.targets)] for work, own in found.items()]
    return [said, "", *table(header, lines)]


def _missed(work: str, own: Sequence[Cell]) -> str:
    """Name a work and the accuracies at which a goal is missed; nothing where there is none."""
    missed = [f"{cell.target:.0e}" for cell in own if not cell.reached]
    if len(missed) == len(own) > 1:
        return f"{work} at all {len(own)}"
    return f"{work} at {', '.join(missed)}" if missed else ""


def _said(cell: Cell | None, with_program: bool) -> str:
    if cell is None:
        return ""
    whose = f", {cell.program}" if with_program else ""
    if cell.ratio is None:
        return f"missed, nothing here{whose}"
    return f"{times(cell.ratio)}{'' if cell.reached else ', missed'}{whose}"
