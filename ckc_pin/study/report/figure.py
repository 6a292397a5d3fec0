"""Error against time and against right-hand sides, one figure a work."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ckc_pin.study.chart import COLOURS, chart, save
from ckc_pin.study.report.ours import PROGRAM
from ckc_pin.study.report.row import Row
from ckc_pin.study.report.work import Work

__all__ = ["draw"]

MARKERS = "osD^vPX<>"
FLOOR = 1e-15  # an error of zero has no logarithm


def draw(work: Work, rows: Sequence[Row], folder: Path) -> list[str]:
    """Draw each family's best: a formulation here, a program elsewhere; return the files, PNG and SVG."""
    families: dict[str, list[Row]] = {}
    for row in rows:
        if row.error_max is not None and row.status == "done":
            families.setdefault(_family(row), []).append(row)
    figure, (by_time, by_work) = chart(columns=2)
    axes: tuple[tuple[Any, str, Callable[[Row], float | None]], ...] = (
        (by_time, "time, s", lambda row: row.wall_s),
        (by_work, "right-hand sides (others: steps)", lambda row: row.rhs or row.steps),
    )
    for k, (name, own) in enumerate(families.items()):
        look = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]}
        line = "--" if not name.startswith(PROGRAM) else ":" if "in Python" in name else "-"
        for ax, _, cost in axes:
            points = [(x, max(row.error_max or 0.0, FLOOR)) for row in own if (x := cost(row))]
            if points:
                ax.plot(*zip(*points, strict=True), linestyle="", markersize=3, alpha=0.25, **look)
                ax.plot(*zip(*_front(points), strict=True), linestyle=line, markersize=5, label=name, **look)
    for ax, label, _ in axes:
        ax.set(xscale="log", yscale="log", xlabel=label)
    by_time.set(ylabel="largest error along the run, rad or m", title=work.says)
    by_time.legend(fontsize=8)
    return [save(figure, folder, f"{work.key}.{kind}") for kind in ("png", "svg")]


def _family(row: Row) -> str:
    if row.program != PROGRAM:
        return row.program
    formulation = "SPF, eq. 8" if row.setting.startswith("spf, eq. 8") else row.setting.split(",")[0]
    return f"{PROGRAM}, {formulation}{', in Python' if 'in Python' in row.setting else ''}"


def _front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points that no other one beats in both cost and error."""
    front: list[tuple[float, float]] = []
    for cost, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((cost, error))
    return front
