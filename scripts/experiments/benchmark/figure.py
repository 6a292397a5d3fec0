"""Figures of the benchmark: error, closure and energy against time, by program and formulation; growth of cost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from scripts.experiments.benchmark.analysis import NAMES, Analysis
from scripts.experiments.benchmark.growth import FAMILIES, FORMULATIONS, exponent
from scripts.experiments.benchmark.ours import PROGRAM
from scripts.experiments.chart import BLACK, COLOURS, chart, save, whole_decades

__all__ = ["MAIN", "draw", "draw_growth", "draw_main", "front"]

MAIN = ("swing", "andrews", "n_four_bar_16", "n_four_bar_4")  # the first three measured works are drawn
MARKERS = "osD^vPX<>"
FLOOR = 1e-17  # replaces zero on a logarithmic axis
LABELS = {
    "wall_s": "time (s)",
    "rhs": "right-hand sides",
    "error_max": "largest error along the run (rad or m)",
    "error_end": "error at the end (rad or m)",
    "closure": "largest |φ| (m or rad)",
    "energy_drift": "largest energy drift / kinetic energy",
}


@dataclass(frozen=True)
class Curve:
    """The Pareto front of a family in time and error, by falling error, and its line style."""

    name: str
    rows: pd.DataFrame
    look: Mapping[str, Any]


def draw(analysis: Analysis, work: str, folder: Path) -> str:
    """Draw the figure of one work; return the file name."""
    figure, axes = chart(columns=3, rows=2, size=(3.7, 3.1))
    rows = analysis.rows[analysis.rows.work == work]
    programs, formulations = list(_programs(rows, analysis.programs)), list(_formulations(rows))
    _panel(axes[0], programs, "wall_s", "error_max", "programs: error")
    _panel(axes[1], programs, "wall_s", "closure", "programs: closure")
    _panel(axes[2], programs, "wall_s", "energy_drift", "programs: energy")
    if analysis.works.controlled[work] or not axes[2].lines:
        axes[2].set_axis_off()
        axes[2].text(
            0.5, 0.5, "energy is not conserved: a controller or damper", ha="center", transform=axes[2].transAxes
        )
    _panel(axes[3], formulations, "wall_s", "error_max", f"{PROGRAM}: error")
    _panel(axes[4], formulations, "rhs", "error_max", f"{PROGRAM}: error")
    _panel(axes[5], formulations, "wall_s", "error_end", f"{PROGRAM}: at the end")
    figure.suptitle(analysis.works.says[work])
    _name(figure, axes[:3], loc="outside lower left", ncols=2, title="programs")
    _name(figure, axes[3:], loc="outside lower right", ncols=2, title=PROGRAM)
    return save(figure, folder, f"{work}.png")


def draw_main(analysis: Analysis, folder: Path) -> str:
    """Draw error against time of a few works side by side, by program; return the file name."""
    chosen = [key for key in MAIN if key in analysis.works.index][:3] or list(analysis.works.index[:3])
    figure, axes = chart(columns=len(chosen), size=(3.7, 3.2))
    for ax, work in zip(axes, chosen, strict=True):
        curves = list(_programs(analysis.rows[analysis.rows.work == work], analysis.programs))
        _panel(ax, curves, "wall_s", "error_max", analysis.works.says[work])
    _name(figure, axes)
    return save(figure, folder, "report.png")


def draw_growth(analysis: Analysis, folder: Path) -> str:
    """Draw the time of a right-hand side along each family of cases; return the file name."""
    figure, axes = chart(columns=len(FAMILIES), size=(3.7, 3.1))
    for ax, family in zip(axes, FAMILIES, strict=True):
        measured = analysis.growth[(analysis.growth.family == family.key) & analysis.growth.rhs_s.notna()]
        for k, formulation in enumerate(FORMULATIONS):
            points = measured[measured.formulation == formulation].set_index("x").rhs_s.sort_index()
            p = exponent(points.to_dict())
            if p is not None:
                look = {"color": COLOURS[k], "marker": MARKERS[k + 1], "markersize": 4, "clip_on": False}
                ax.plot(points.index, 1e6 * points, label=f"{NAMES[formulation]}: ∝ {family.along}^{p:.1f}", **look)
        ax.set(xscale="log", yscale="log", xlabel=family.along, title=family.says)
        ax.set_ylabel("one right-hand side (µs)")
        whole_decades(ax)
        if ax.lines:
            ax.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    return save(figure, folder, "growth.png")


def _programs(rows: pd.DataFrame, others: Sequence[str]) -> Iterator[Curve]:
    """Yield the Pareto front of each program, ckc_pin's first."""
    yield Curve(PROGRAM, front(rows[rows.program == PROGRAM]), {"color": BLACK, "marker": "o", "linewidth": 2.2})
    for k, name in enumerate(others):
        look = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[(k + 1) % len(MARKERS)]}
        line = "--" if k < len(COLOURS) else "-."
        yield Curve(name, front(rows[rows.program == name]), {**look, "linestyle": line})


def _formulations(rows: pd.DataFrame) -> Iterator[Curve]:
    """Yield the Pareto front of each formulation."""
    for k, (key, name) in enumerate(NAMES.items()):
        yield Curve(name, front(rows[rows.formulation == key]), {"color": COLOURS[k], "marker": MARKERS[k]})


def front(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the Pareto front of runs in time and error, by falling error."""
    done = rows[(rows.status == "done") & rows.error_max.notna()].sort_values(["wall_s", "error_max"])
    return done[done.error_max < done.error_max.cummin().shift(fill_value=np.inf)]


def _panel(ax: Any, curves: Sequence[Curve], x: str, y: str, title: str) -> None:
    ax.set(xscale="log", yscale="log", xlabel=LABELS[x], ylabel=LABELS[y], title=title)
    for curve in curves:
        points = curve.rows[[x, y]].dropna()
        points = points[points[x] > 0]
        if len(points):
            look = {"markersize": 4.5, "linewidth": 1.4, "clip_on": False, **curve.look}
            ax.plot(points[x], points[y].clip(lower=FLOOR), label=curve.name, **look)
    whole_decades(ax)
    for words in (ax.title, ax.xaxis.label, ax.yaxis.label):
        words.set_fontsize(8)


def _name(figure: Any, axes: Sequence[Any], **where: Any) -> None:
    """Draw a legend of the panels' curves below all panels."""
    named = {line.get_label(): line for ax in axes for line in ax.lines}
    figure.legend(list(named.values()), list(named), **({"loc": "outside lower center", "ncols": 4} | where))
