"""How figures look: readable at a column's width, a colour per curve and a line per formulation, for every eye.

Figures are `WIDTH` wide, so that one set in a column of 3.5 inches has letters of 6 points. No more than `MOST` curves
of a panel have a colour and a name; what else there is lies behind them in grey.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ckc_pin.run.run import Run

__all__ = ["COLOURS", "DPI", "GREY", "MOST", "NOTE", "RC", "REST", "WIDTH", "WIDTH_BESIDE", "colours", "drawing_order",
           "foremost", "lines"]  # fmt: skip

# Okabe and Ito's palette without its black and its yellow, which is too pale for a line on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MOST = len(COLOURS)
GREY = "#6E6E6E"
REST = "#C4C4C4"  # curves without a name
DPI = 220
WIDTH = 5.2  # in
WIDTH_BESIDE = 7.2  # in, with a long legend beside the axes
NOTE = 7.5  # pt, of what is said beside a title

RC: dict[str, Any] = {
    "figure.figsize": (WIDTH, 3.1),
    "figure.constrained_layout.use": True,
    "font.size": 8.5,
    "axes.prop_cycle": f"cycler('color', {list(COLOURS)})",
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 8,
    "figure.titlesize": 10,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.formatter.use_mathtext": True,
    "axes.formatter.limits": (-4, 5),
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
    "svg.hashsalt": "ckc_pin",  # the same run gives the same file
    "svg.fonttype": "path",
}

# Several runs mostly lie on each other: the reduced model is a broad pale line that the dashes of the SPF stand on.
_LINES: dict[str, dict[str, Any]] = {
    "reduced": {"linestyle": "-", "linewidth": 3.0, "alpha": 0.4},
    "dae": {"linestyle": (0, (1.0, 1.6)), "linewidth": 1.6},
    "spf": {"linestyle": (0, (4.0, 2.2)), "linewidth": 1.1},
}
_AGAIN = ((0, (7.0, 2.0)), (0, (2.0, 1.2)), (0, (5.0, 1.5, 1.0, 1.5)))  # more runs of one formulation
_ORDER = ("reduced", "dae", "spf")


def colours(names: Sequence[str]) -> dict[str, str]:
    """Return a colour for each name; those that the palette is too short for are grey."""
    return {name: COLOURS[k] if k < MOST else REST for k, name in enumerate(names)}


def foremost(sizes: Mapping[str, float]) -> list[str]:
    """Return the names to tell apart, in their own order: all, or the `MOST` that have the largest sizes."""
    largest = sorted(sizes, key=lambda name: -sizes[name])[:MOST]  # stable: the first of equals
    return [name for name in sizes if name in largest]


def drawing_order(runs: Sequence[Run]) -> list[Run]:
    """Sort runs so that those with thin lines are drawn on those with broad ones."""
    return sorted(runs, key=lambda run: _ORDER.index(run.scene["formulation"]))


def lines(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return each run's line; a run alone has a plain one."""
    if len(runs) == 1:
        return [{"linestyle": "-", "linewidth": 1.3}]
    seen: dict[str, int] = {}
    looks = []
    for run in runs:
        formulation = run.scene["formulation"]
        again = seen[formulation] = seen.get(formulation, -1) + 1
        looks.append(_LINES[formulation] | ({"linestyle": _AGAIN[(again - 1) % len(_AGAIN)]} if again else {}))
        if again and formulation == "reduced":
            looks[-1] |= {"linewidth": 1.3, "alpha": 1.0}
    return looks
