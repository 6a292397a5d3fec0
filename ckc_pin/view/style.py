"""How figures look: a colour per coordinate, a line per formulation, safe for colour-blind readers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ckc_pin.simulation.run import Run

__all__ = ["COLOURS", "DPI", "GREY", "RC", "colours", "drawing_order", "lines"]

# Okabe and Ito's palette without its black and its yellow, which is too pale for a line on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY = "#6E6E6E"
DPI = 150

RC: dict[str, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
    "svg.hashsalt": "ckc_pin",  # the same run gives the same file
    "svg.fonttype": "path",
}

# Several runs mostly lie on each other: the reduced model is a broad pale line that the dashes of the SPF stand on.
_LINES: dict[str, dict[str, Any]] = {
    "reduced": {"linestyle": "-", "linewidth": 3.6, "alpha": 0.4},
    "dae": {"linestyle": (0, (1.0, 1.6)), "linewidth": 1.9},
    "spf": {"linestyle": (0, (4.0, 2.2)), "linewidth": 1.3},
}
_AGAIN = ((0, (7.0, 2.0)), (0, (2.0, 1.2)), (0, (5.0, 1.5, 1.0, 1.5)))  # more runs of one formulation
_ORDER = ("reduced", "dae", "spf")


def colours(names: Sequence[str]) -> dict[str, Any]:
    """Return a colour for each name; more names than the palette has get steps of a colour map."""
    if len(names) <= len(COLOURS):
        return dict(zip(names, COLOURS, strict=False))
    import matplotlib

    steps = matplotlib.colormaps["viridis"].resampled(len(names))
    return {name: steps(k) for k, name in enumerate(names)}


def drawing_order(runs: Sequence[Run]) -> list[Run]:
    """Sort runs so that those with thin lines are drawn on those with broad ones."""
    return sorted(runs, key=lambda run: _ORDER.index(run.scene["formulation"]))


def lines(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return each run's line; a run alone has a plain one."""
    if len(runs) == 1:
        return [{"linestyle": "-", "linewidth": 1.6}]
    seen: dict[str, int] = {}
    looks = []
    for run in runs:
        formulation = run.scene["formulation"]
        again = seen[formulation] = seen.get(formulation, -1) + 1
        looks.append(_LINES[formulation] | ({"linestyle": _AGAIN[(again - 1) % len(_AGAIN)]} if again else {}))
        if again and formulation == "reduced":
            looks[-1] |= {"linewidth": 1.6, "alpha": 1.0}
    return looks
