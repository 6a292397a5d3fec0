"""The suite's results as a page and as a table of all cells."""

from __future__ import annotations

import csv
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import fields
from importlib.metadata import version
from io import StringIO
from itertools import groupby

import numpy as np

from scripts.experiments.markdown import table
from scripts.experiments.stability.cell import ALLOWED, BUDGET, Cell, Verdict
from scripts.experiments.stability.long_runs import LongRun

__all__ = ["as_csv", "page", "satisfied", "share_within", "tally"]

USUAL_RTOL = 1e-8
LEAST_WITHIN = 0.9
VERDICTS: tuple[Verdict, ...] = ("within", "stopped", "FAILED")

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


def tally(cells: Iterable[Cell]) -> str:
    """Count verdicts: "3 within, 0 stopped, 0 FAILED"."""
    counts = Counter(cell.verdict for cell in cells)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS)


def share_within(cells: Sequence[Cell]) -> float:
    """Return how many of the cells are within tolerance, from 0 to 1."""
    return sum(cell.verdict == "within" for cell in cells) / max(1, len(cells))


def satisfied(cells: Sequence[Cell]) -> bool:
    """Whether nothing FAILED and nine in ten are within tolerance."""
    return all(cell.verdict != "FAILED" for cell in cells) and share_within(cells) >= LEAST_WITHIN


def as_csv(cells: Sequence[Cell]) -> str:
    """Return a row a cell, all that was measured but for times."""
    names = [field.name for field in fields(Cell) if field.name != "cpu_s"]
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for cell in cells:
        writer.writerow([_plain(getattr(cell, name)) for name in names])
    return text.getvalue()


def _plain(value: object) -> object:
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.3g}"
    return value


def page(cells: Sequence[Cell], long_runs: Sequence[LongRun]) -> str:
    """Return docs/stability.md.

    Parameters
    ----------
    cells : sequence of Cell
        Groups together, in the order of `TITLES`.
    long_runs : sequence of LongRun
    """
    own = sys.modules["ckc_pin"].__version__
    versions = ", ".join([f"ckc_pin {own}", *(f"{name} {version(name)}" for name in ("pin", "numpy", "scipy"))])
    groups = [(key, list(members)) for key, members in groupby(cells, key=lambda cell: cell.group)]
    lines = [
        "# Stability",
        "",
        "Cases x formulations x methods. Each cell runs to its end and is compared, at every output instant, angles "
        "and rates, with a reference that shares nothing with the program but the case: the five-bar's equations "
        "written by hand in the links' angles and integrated by SciPy, or published values. A cell is *within* "
        f"tolerance if its largest error is at most {ALLOWED:g} rtol times the solution's scale and its loops are "
        "closed as well, *stopped* if it ended before and said why, and *FAILED* if it was done but wrong, or "
        "crashed. References start where the run starts, and were integrated twice, to know how far they may be off.",
        "",
        f"**{len(cells)} cells: {tally(cells)}; {100 * share_within(cells):.1f} % within tolerance.**",
        "",
        *table(
            ("group", "cells", *VERDICTS, "largest error / allowed", "reference off by / allowed"), _summary(groups)
        ),
        "",
        "In the tables below: the error and, after the comma, the right-hand sides; rtol is "
        f"{USUAL_RTOL:g} where nothing else is said. `spf` is eq. 17, `spf (8)` eq. 8 as printed. "
        f"A run may take {BUDGET['solver.max_rhs']:,} right-hand sides. All that was measured, max |phi|, energy "
        "drift, steps and changes of the partition included, is in [stability.csv](stability.csv).",
        "",
        f"Computed with {versions}; the cells took {sum(cell.cpu_s for cell in cells):.0f} seconds of processor time. "
        "`./scripts/experiment stability` writes this page and the table again; with GROUP it prints a group.",
    ]
    for key, members in groups:
        lines += ["", f"## {TITLES[key]}", "", *_group(members)]
    if long_runs:
        lines += ["", "## Long runs", "", *_long(long_runs)]
    return "\n".join(lines) + "\n"


def _summary(groups: Sequence[tuple[str, Sequence[Cell]]]) -> list[tuple[str, ...]]:
    rows = []
    for key, cells in groups:
        counts = Counter(cell.verdict for cell in cells)
        worst = max((cell.error / cell.allowed for cell in cells if cell.verdict == "within"), default=np.nan)
        unsure = max((cell.uncertainty / cell.allowed for cell in cells if cell.verdict == "within"), default=np.nan)
        row = (key, str(len(cells)), *(str(counts[verdict]) for verdict in VERDICTS), f"{worst:.2g}", f"{unsure:.1g}")
        rows.append(row)
    return rows


def _group(cells: Sequence[Cell]) -> list[str]:
    """Return cases by ways, or ways by cases where there are more of those, then why cells stopped or failed."""
    cases = list(dict.fromkeys(cell.case for cell in cells))
    ways = list(dict.fromkeys(_way(cell) for cell in cells))
    found = {(cell.case, _way(cell)): _entry(cell) for cell in cells}
    if len(cases) >= len(ways):
        rows = [(case, *(found.get((case, way), "") for way in ways)) for case in cases]
        lines = table(("case", *ways), rows)
    else:
        rows = [(way, *(found.get((case, way), "") for case in cases)) for way in ways]
        lines = table(("", *cases), rows)
    sources = sorted({cell.reference for cell in cells})
    lines += ["", f"References: {'; '.join(sources)}."]
    reasons = [(f"{cell.case}; {_way(cell)}", cell.verdict, cell.message) for cell in cells if cell.message]
    if reasons:
        lines += ["", "<details>", f"<summary>Why {len(reasons)} stopped</summary>", ""]
        lines += [*table(("cell", "verdict", "message"), reasons), "", "</details>"]
    return lines


def _way(cell: Cell) -> str:
    method = "" if cell.method.startswith("auto") else f" {cell.method}"
    rtol = f", rtol {cell.rtol:g}" if cell.rtol != USUAL_RTOL and f"rtol {cell.rtol:g}" not in cell.case else ""
    return f"{cell.formulation}{method}{rtol}"


def _entry(cell: Cell) -> str:
    if cell.verdict == "within":
        return f"{cell.error:.0e}, {cell.rhs}"
    return f"stopped at {cell.t:.3g} s" if cell.verdict == "stopped" else f"FAILED, {cell.error:.0e}"


def _long(runs: Sequence[LongRun]) -> list[str]:
    rows = [
        (
            run.name,
            run.formulation,
            run.method,
            f"{run.t:g}",
            f"{run.drift:.1e}",
            f"{run.max_phi:.1e}",
            str(run.crossings),
            f"{run.rhs:,}",
            f"{run.steps:,}",
            run.outcome,
        )
        for run in runs
    ]
    header = (
        "run", "formulation", "method", "t [s]", "energy drift", "max |phi| [m]", "crossings of type 2",
        "right-hand sides", "steps", "outcome",
    )  # fmt: skip
    return [
        f"At rtol {runs[0].rtol:g}. The drift is the largest difference of the energy from its start, relative to "
        "what the kinetic energy ranges over.",
        "",
        *table(header, rows),
    ]
