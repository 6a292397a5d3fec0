"""Figures: error, closure and energy against time, by program and by formulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scripts.experiments.benchmark.ours import PROGRAM, of_row
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.sentences import here
from scripts.experiments.benchmark.work import Work
from scripts.experiments.chart import BLACK, COLOURS, chart, save, whole_decades

__all__ = ["MAIN", "draw", "draw_main"]

MAIN = ("swing", "andrews", "n_four_bar_16", "n_four_bar_4")  # the first three of them that were measured
MARKERS = "osD^vPX<>"
FLOOR = 1e-17  # a number of zero has no logarithm
APART = 11.0  # points between the labels of two curves
REACH = 100.0  # points: labels further apart do not meet
LETTER = 5.0  # points wide
NAMES = {"dae": "DAE", "reduced": "reduced model", "spf": "SPF eq. 17", "spf, eq. 8": "SPF eq. 8 as printed"}

Number = Callable[[Row], float | None]


@dataclass(frozen=True)
class Curve:
    """Rows that no other one of the same family beats in both time and error, by falling error, and how they look."""

    name: str
    rows: tuple[Row, ...]
    look: Mapping[str, Any]


def draw(work: Work, rows: Sequence[Row], others: Sequence[str], folder: Path) -> str:
    """Draw one work; return the file's name.

    Parameters
    ----------
    work : Work
    rows : sequence of Row
    others : sequence of str
        All other programs of the report, so that each has one look on all figures.
    folder : Path
    """
    figure, axes = chart(columns=3, rows=2, size=(5.6, 4.2))
    programs, formulations = list(_programs(rows, others)), list(_formulations(rows))
    time = ("time, s", lambda row: row.wall_s)
    error = ("largest error along the run, rad or m", lambda row: row.error_max)
    _panel(axes[0], programs, time, error, "programs: error")
    _panel(axes[1], programs, time, ("largest |φ|, m or rad", lambda row: row.closure), "programs: closure")
    drift = ("largest energy drift / kinetic energy", lambda row: row.energy_drift)
    _panel(axes[2], programs, time, drift, "programs: energy")
    if work.controlled or not axes[2].lines:
        axes[2].set_axis_off()
        axes[2].text(0.5, 0.5, "energy is not kept here: something acts", ha="center", transform=axes[2].transAxes)
    _panel(axes[3], formulations, time, error, f"{PROGRAM}: error")
    _panel(axes[4], formulations, ("right-hand sides", lambda row: row.rhs), error, f"{PROGRAM}: error")
    _panel(
        axes[5], formulations, time, ("error at the end, rad or m", lambda row: row.error_end), f"{PROGRAM}: at the end"
    )
    figure.suptitle(work.says)
    _name(figure, axes)
    return save(figure, folder, f"{work.key}.png")


def draw_main(works: Sequence[Work], rows: Mapping[str, Sequence[Row]], others: Sequence[str], folder: Path) -> str:
    """Draw error against time of a few works side by side, by program; return the file's name."""
    chosen = [work for key in MAIN for work in works if work.key == key][:3] or list(works[:3])
    figure, axes = chart(columns=len(chosen), size=(5.6, 4.6))
    for ax, work in zip(axes, chosen, strict=True):
        curves = list(_programs(rows[work.key], others))
        time, error = ("time, s", lambda row: row.wall_s), ("largest error, rad or m", lambda row: row.error_max)
        _panel(ax, curves, time, error, work.says)
    _name(figure, axes)
    return save(figure, folder, "report.png")


def _programs(rows: Sequence[Row], others: Sequence[str]) -> Iterator[Curve]:
    """Each program's best, this one's first."""
    yield Curve(PROGRAM, _front(here(rows)), {"color": BLACK, "marker": "o", "linewidth": 2.2})
    for k, name in enumerate(others):
        look = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[(k + 1) % len(MARKERS)]}
        line = "--" if k < len(COLOURS) else "-."
        yield Curve(name, _front([row for row in rows if row.program == name]), {**look, "linestyle": line})


def _formulations(rows: Sequence[Row]) -> Iterator[Curve]:
    """Each formulation's best."""
    for k, (key, name) in enumerate(NAMES.items()):
        there = [row for row in here(rows) if of_row(row).formulation == key]
        yield Curve(name, _front(there), {"color": COLOURS[k], "marker": MARKERS[k]})


def _front(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return the rows that no other one beats in both time and error."""
    front: list[Row] = []
    done = [row for row in rows if row.status == "done" and row.error_max is not None]
    for row in sorted(done, key=lambda row: (row.wall_s, row.error_max)):
        if not front or (row.error_max or 0.0) < (front[-1].error_max or 0.0):
            front.append(row)
    return tuple(front)


def _panel(ax: Any, curves: Sequence[Curve], x: tuple[str, Number], y: tuple[str, Number], title: str) -> None:
    ax.set(xscale="log", yscale="log", xlabel=x[0], ylabel=y[0], title=title)
    for curve in curves:
        points = [(a, max(b, FLOOR)) for row in curve.rows if (a := x[1](row)) and (b := y[1](row)) is not None]
        if points:
            ax.plot(
                *zip(*points, strict=True),
                **{"markersize": 4.5, "linewidth": 1.4, "clip_on": False, **curve.look},
                label=curve.name,
            )
    whole_decades(ax)


def _name(figure: Any, axes: Sequence[Any]) -> None:
    """Write each curve's name beside its end, where that does not lie on another name."""
    figure.draw_without_rendering()  # settles the layout, in which the labels are to be placed
    figure.set_layout_engine("none")
    scale = 72.0 / figure.dpi
    for ax in axes:
        right, taken = ax.bbox.x1 * scale, list[tuple[float, float, int]]()
        ends = [
            (line, ax.transData.transform((line.get_xdata()[-1], line.get_ydata()[-1])) * scale) for line in ax.lines
        ]
        for line, (x, low) in sorted(ends, key=lambda end: float(end[1][1])):
            words = line.get_label().removeprefix("Pinocchio ").replace(", ", ",\n")
            lines = words.count("\n") + 1
            y = max(float(low), ax.bbox.y0 * scale + APART * lines / 2)
            while any(abs(x - a) < REACH and abs(y - b) < APART * (lines + n) / 2 for a, b, n in taken):
                y += 1.0
            taken.append((float(x), y, lines))
            inside = x + LETTER * max(map(len, words.splitlines())) < right
            ax.annotate(
                words,
                (line.get_xdata()[-1], line.get_ydata()[-1]),
                xytext=(6 if inside else -6, y - float(low)),
                textcoords="offset points",
                ha="left" if inside else "right",
                va="center",
                fontsize=8,
                linespacing=1.0,
                color=_dark(line.get_color()),
                bbox={"boxstyle": "square,pad=0.05", "facecolor": "white", "edgecolor": "none", "alpha": 0.7},
            )


def _dark(colour: str) -> str:
    """Return a colour dark enough to be read as text on white."""
    from matplotlib.colors import to_hex, to_rgb

    red, green, blue = to_rgb(colour)
    return str(to_hex((0.62 * red, 0.62 * green, 0.62 * blue)))
