"""Write the suite's results as a page and as a table of all cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pandas as pd

from scripts.experiments.pages import GZIP, render, versions
from scripts.experiments.stability.cell import ALLOWED, BUDGET, Cell
from scripts.experiments.stability.long_runs import LongRun

__all__ = ["TITLES", "as_frame", "page", "satisfied", "save"]

USUAL_RTOL = 1e-8
REQUIRED_SHARE = 0.9  # smallest share of cells within tolerance

TITLES = {
    "method": "Every method on the swing",
    "epsilon": "Epsilon from 1e-1 to 1e-12, on the manifold and off it",
    "mass": "Ratios of masses from 1e-8 to 1e8",
    "length": "Lengths from 1e-3 to 1e3 m",
    "gain": "Gains from 1e-3 to 1e6, no damping",
    "singular": "Starts near both singularities",
    "speed": "Speeds to 1e3 rad/s, crossing type 2",
    "spring": "Springs to 1e9 N/m",
    "published": "Published mechanisms",
}


def as_frame(cells: Sequence[Cell]) -> pd.DataFrame:
    """Return a table with one row per cell."""
    return pd.DataFrame(map(asdict, cells), columns=[field.name for field in fields(Cell)])


def satisfied(cells: pd.DataFrame) -> bool:
    """Whether no cell FAILED and nine in ten are within tolerance."""
    return not (cells.verdict == "FAILED").any() and (cells.verdict == "within").mean() >= REQUIRED_SHARE


def save(cells: pd.DataFrame, path: Path) -> None:
    """Write all measurements except times."""
    table = cells.drop(columns="cpu_s")
    table.to_csv(path, index=False, float_format="%.3g", lineterminator="\n", compression=GZIP)


def page(cells: pd.DataFrame, long_runs: Sequence[LongRun]) -> str:
    """Return the text of docs/stability.md.

    Parameters
    ----------
    cells : DataFrame
        Result of `as_frame`, sorted by group in the order of `TITLES`.
    long_runs : sequence of LongRun
    """
    rows = list(cells.itertuples())
    cells = cells.assign(way=[_way(row) for row in rows], entry=[_entry(row) for row in rows])
    groups = dict(list(cells.groupby("group", sort=False)))
    return render(
        "stability",
        cells=cells,
        summary=_summary(cells),
        groups=groups,
        tables={group: _table(of_group) for group, of_group in groups.items()},
        titles=TITLES,
        long_runs=long_runs,
        usual_rtol=USUAL_RTOL,
        allowed=ALLOWED,
        most_rhs=BUDGET["solver.max_rhs"],
        versions=versions(),
    )


def _summary(cells: pd.DataFrame) -> pd.DataFrame:
    """Count verdicts by group, with the largest error of the cells within tolerance over the allowed error."""
    counts = pd.crosstab(cells.group, cells.verdict).reindex(
        index=cells.group.unique(), columns=["within", "stopped", "FAILED"], fill_value=0
    )
    within = cells[cells.verdict == "within"]
    shares = within[["error", "uncertainty"]].div(within.allowed, axis=0).groupby(within.group).max()
    counts.insert(0, "cells", counts.sum(axis=1))
    return counts.join(shares).reset_index()


def _table(cells: pd.DataFrame) -> pd.DataFrame:
    """Return a table of cases (rows) and ways, transposed if there are more ways than cases."""
    cases, ways = cells.case.unique(), cells.way.unique()
    table = cells.pivot(index="case", columns="way", values="entry").reindex(index=cases, columns=ways).fillna("")
    if len(cases) < len(ways):
        table = table.T.rename_axis(index="")
    return table.reset_index()


def _way(cell: Any) -> str:
    method = "" if cell.method.startswith("auto") else f" {cell.method}"
    rtol = f", rtol {cell.rtol:g}" if cell.rtol != USUAL_RTOL and f"rtol {cell.rtol:g}" not in cell.case else ""
    return f"{cell.formulation}{method}{rtol}"


def _entry(cell: Any) -> str:
    if cell.verdict == "within":
        return f"{cell.error:.0e}, {cell.rhs}"
    return f"stopped at {cell.t:.3g} s" if cell.verdict == "stopped" else f"FAILED, {cell.error:.0e}"
