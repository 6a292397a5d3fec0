"""Work against precision as a figure: a panel for each scene, error against time, a line for each family."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, look, write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_precision", "save_precision"]

LEAST = 1e-16  # an error of zero has no logarithm
MARKERS = {"auto": "o", "DOP853": "s", "RK45": "^", "Radau": "D"}
FORMULATIONS = ("dae", "reduced", "spf, w", "spf, z")


def save_precision(found: Mapping[str, Any], folder: Path, stem: str) -> list[Path]:
    """Draw a comparison and write it as PNG.

    Parameters
    ----------
    found : mapping
        As `precision_plain` gives it.
    folder : Path
    stem : str
        The file's name without its suffix.

    Raises
    ------
    InputError
        A folder that cannot be written, matplotlib missing.
    """
    return write(draw_precision(found), folder, stem, ("png",))


def draw_precision(found: Mapping[str, Any]) -> Figure:
    """Return the figure of a comparison with a reference (InputError where matplotlib is missing)."""
    with look():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(style.WIDTH, 4.6), layout="constrained")
        ax = figure.add_subplot()
        rows = [row for row in found["rows"] if row["error"] is not None]
        for name, own in _families(rows).items():
            points = [(1e3 * row["wall_s"], max(row["error"], LEAST)) for row in own]
            ax.plot(*zip(*points, strict=True), label=name, **_line(own[0]))
        accuracy = found["reference"]["accuracy"]
        low = max(LEAST, min((row["error"] for row in rows), default=accuracy))
        if low < 10 * accuracy:
            ax.axhspan(min(low, accuracy) / 2, 10 * accuracy, color=style.GREY, alpha=0.15, linewidth=0)
            ax.text(0.01, 10 * accuracy, "the reference's own uncertainty", color=style.GREY, va="top",
                    transform=ax.get_yaxis_transform())  # fmt: skip
        ax.set(xscale="log", yscale="log", xlabel="time of a run (ms)", ylabel="largest error of q_tree and v_tree")
        ax.set_title(f"{_plain(found['scene'])}, up to t = {found['reference']['t_end']:.4g} s")
        fit_legend(figure, ax.get_legend_handles_labels()[0], fontsize=style.NOTE)
        return figure


def _families(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    found: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["wall_s"] and math.isfinite(row["wall_s"]):
            found.setdefault(f"{row['formulation'] or row['program']}, {row['method']}", []).append(row)
    return found


def _line(row: Mapping[str, Any]) -> dict[str, Any]:
    """Colour by formulation, marker by method; MuJoCo grey."""
    if row["formulation"] is None:
        stiff = row["method"].endswith("dt")
        euler = not row["method"].startswith("RK4")
        dashes = (0, (4.0, 2.0)) if stiff else (0, (1.0, 1.5))
        return {"color": style.GREY, "marker": "x" if euler else "+", "linestyle": dashes, "linewidth": 1.2}
    colour = style.COLOURS[FORMULATIONS.index(row["formulation"])]
    thick = 1.6 if row["method"] == "auto" else 0.9
    return {"color": colour, "marker": MARKERS.get(row["method"], "v"), "markersize": 4, "linewidth": thick}


def _plain(text: str) -> str:
    return text.replace("$", r"\$")
