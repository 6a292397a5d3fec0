"""Layout of figures: pages with titles, panels, notes and legends, and axes that are not flattened by short peaks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.view import style
from ckc_pin.view.style import figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["PanelSlot", "add_header", "add_note", "clip_end_peaks", "create_page", "fit_legend", "legend_line",
           "set_panel_title", "write_figure"]  # fmt: skip

AXIS_MARGIN = 0.08  # fraction of the curves' range
END_FRACTION = 0.03  # of the time shown: a peak this close to either end may be clipped
PEAK_RATIO = 4.0  # a peak at an end is clipped if it exceeds everything else by this factor
LEGEND_OFFSET_IN = 0.4  # room below an axes for its numbers and its label
HEADER_HEIGHT_IN = 0.44  # title and subtitle
MAX_LEGEND_COLUMNS = 6


def write_figure(figure: Figure, folder: Path, stem: str, formats: Sequence[str]) -> list[Path]:
    """Write a figure in several formats and return the paths (InputError if the folder cannot be written)."""
    no_dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # equal figures give equal files
    paths = [folder / f"{stem}.{suffix}" for suffix in formats]
    for suffix, path in zip(formats, paths, strict=True):
        with figure_style(), open_atomic(path) as file:
            figure.savefig(file, dpi=style.DPI, format=suffix, metadata=no_dates.get(suffix))
    return paths


@dataclass(frozen=True)
class PanelSlot:
    """The place of one panel in a figure, with the panel's title. A panel is drawn by adding axes to its slot."""

    figure: Figure
    place: Any
    title: str

    def add_axes(self, count: int = 1) -> list[Any]:
        """Add `count` axes above each other that share their time axis; the uppermost carries the title."""
        grid = self.place.subgridspec(count, 1)
        axes: list[Any] = []
        for k in range(count):
            axes.append(self.figure.add_subplot(grid[k], sharex=axes[0] if axes else None))
        for upper in axes[:-1]:
            upper.tick_params(labelbottom=False)
        set_panel_title(axes[0], self.title)
        return axes


def create_page(
    title: str, subtitle: str, titles: Sequence[str], columns: int, panel: tuple[float, float]
) -> list[PanelSlot]:
    """Create a figure and return its panel slots. Two to four panels get letters before their titles.

    Parameters
    ----------
    title, subtitle : str
    titles : sequence of str
        Titles of the panels, row by row.
    columns : int
    panel : (width, height)
        Size of a panel, inches.
    """
    from matplotlib.figure import Figure

    rows = -(-len(titles) // columns)
    figure = Figure(figsize=(panel[0] * columns, panel[1] * rows + HEADER_HEIGHT_IN), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.05)  # type: ignore[union-attr, call-arg]
    add_header(figure, title, subtitle)
    grid = figure.add_gridspec(rows, columns)
    letters = [f"{letter})  " for letter in "abcd"] if 1 < len(titles) <= 4 else [""] * len(titles)
    return [PanelSlot(figure, grid[k // columns, k % columns], f"{letters[k]}{titles[k]}") for k in range(len(titles))]


def add_header(figure: Figure, title: str, subtitle: str = "") -> None:
    """Add a title and a smaller grey subtitle to a figure, and reserve their room in its layout."""
    height = float(figure.get_figheight())
    top = 1.0 - 0.06 / height
    room = HEADER_HEIGHT_IN if subtitle else HEADER_HEIGHT_IN / 2
    figure.get_layout_engine().set(rect=(0.0, 0.0, 1.0, 1.0 - room / height))  # type: ignore[union-attr, call-arg]
    figure.suptitle(title, x=0.012, y=top, ha="left", va="top", fontweight="bold")
    figure.text(0.012, top - 0.185 / height, subtitle, ha="left", va="top", fontsize=style.NOTE_SIZE_PT,
                color=style.GREY)  # fmt: skip


def set_panel_title(ax: Any, title: str, note: str = "") -> None:
    """Set the title of an axes, with a note in small grey letters between the title and the axes."""
    ax.set_title(title, pad=4.0)
    add_note(ax, note)


def add_note(ax: Any, note: str) -> None:
    """Add a note in small grey letters below the title that an axes already has; an empty note changes nothing."""
    if not note:
        return
    title = next(filter(None, map(ax.get_title, ("left", "center", "right"))), "")
    ax.set_title(title, pad=4.0 + 1.3 * style.NOTE_SIZE_PT * (note.count("\n") + 1))
    properties = {"fontsize": style.NOTE_SIZE_PT, "color": style.GREY, "annotation_clip": False, "ha": "left",
                  "va": "bottom"}  # fmt: skip
    annotation = ax.annotate(
        note, (0.0, 1.0), (0.0, 3.0), xycoords="axes fraction", textcoords="offset points", **properties
    )
    annotation.set_in_layout(False)  # The title reserves the height, and a long note must not narrow the axes.


def legend_line(colour: Any, label: str, **properties: Any) -> Any:
    """Return a legend handle that is a line."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, label=label, **({"linewidth": 2.0} | properties))


def fit_legend(owner: Any, handles: Sequence[Any], **options: Any) -> None:
    """Add a legend below a figure or below an axes, with as many columns as fit into the width."""
    if not handles:
        return
    figure = owner.get_figure(root=True)
    if owner is figure:
        room = figure.get_figwidth()
        location: dict[str, Any] = {"loc": "outside lower center"}
    else:
        from matplotlib.transforms import ScaledTranslation

        room = figure.get_figwidth() * owner.get_subplotspec().get_position(figure).width
        lower = owner.transAxes + ScaledTranslation(0.0, -LEGEND_OFFSET_IN, figure.dpi_scale_trans)
        location = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "bbox_transform": lower, "borderaxespad": 0.0,
                    "fontsize": style.NOTE_SIZE_PT}  # fmt: skip
    for limit in range(min(len(handles), MAX_LEGEND_COLUMNS), 0, -1):
        columns = -(-len(handles) // -(-len(handles) // limit))  # full rows
        spacing = {"handlelength": 2.2, "columnspacing": 1.2, "handletextpad": 0.5}
        legend = owner.legend(handles=list(handles), ncols=columns, **(spacing | location | options))
        if columns == 1 or legend.get_window_extent().width <= figure.dpi * (room - 0.1):
            return
        legend.remove()


def clip_end_peaks(ax: Any, curves: Sequence[tuple[Array, Array]], t_end: float, omit_times: bool = False) -> str:
    """Limit the y axis so that a short peak at the start or the end does not flatten the rest of the curves.

    Parameters
    ----------
    curves : sequence of ((m,), (m, k)) arrays
        Times and values.
    t_end : float
        End of the time shown, s.
    omit_times : bool
        Leave the times of the peaks out of the text.

    Returns
    -------
    str
        The peaks beyond the axis, each marked by a triangle at the axes' edge; empty if nothing is clipped.
    """
    shown = [(t[t <= t_end], y[t <= t_end]) for t, y in curves if y.size and np.isfinite(y).any()]
    last = max((float(t[-1]) for t, _ in shown), default=0.0)
    inner = [y[(t >= END_FRACTION * last) & (t <= (1 - END_FRACTION) * last)].ravel() for t, y in shown]
    inner_values, values = (np.concatenate([[], *parts]) for parts in (inner, [y.ravel() for _, y in shown]))
    inner_values, values = inner_values[np.isfinite(inner_values)], values[np.isfinite(values)]
    if not np.any(inner_values) or np.abs(values).max() <= PEAK_RATIO * np.abs(inner_values).max():
        return ""
    low, high = min(inner_values.min(), 0.0), max(inner_values.max(), 0.0)
    low, high = low - AXIS_MARGIN * (high - low), high + AXIS_MARGIN * (high - low)
    ax.set_ylim(low, high)
    notes = []
    for sign, edge, marker, triangle in ((1, high, "^", "▲"), (-1, low, "v", "▼")):
        if (sign * values).max() > sign * edge:
            peaks = [(float(np.nanmax(sign * y)), float(t[np.nanargmax(np.nanmax(sign * y, axis=1))]))
                     for t, y in shown]  # fmt: skip
            peak, t = max(peaks)
            ax.plot([t], [edge], marker=marker, markersize=5, color="black", clip_on=False, linestyle="none", zorder=5)
            notes.append(f"{triangle} {sign * peak:.3g}" + ("" if omit_times else f" at {t:.3g} s"))
    return ", ".join(notes)
