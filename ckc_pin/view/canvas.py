"""A figure's page: titles and what is said below them, a slot for each panel, legends that fit, axes that show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.errors import InputError
from ckc_pin.view import style

if TYPE_CHECKING:
    from contextlib import _GeneratorContextManager

    from matplotlib.figure import Figure

__all__ = ["Slot", "fit_legend", "head", "limit", "line", "look", "note_on", "page", "say", "write"]

MARGIN = 0.08  # of an axis beyond its curves
END = 0.03  # of the time shown: how long a peak at either end may last
DWARFED = 4.0  # times higher than all the rest is a peak at an end that would hide it
UNDER = 0.4  # in, below an axes: its numbers and its label
HEAD = 0.44  # in, of a title and the line below it


def look() -> _GeneratorContextManager[None]:
    """Our style on matplotlib's defaults, whatever the user has set, and that as it was afterwards.

    What it returns is for a ``with``, or decorates a function that draws: ``@look()``.

    Raises
    ------
    InputError
        matplotlib is missing.
    """
    try:
        from matplotlib import style as styles
    except ModuleNotFoundError:
        raise InputError("figures need matplotlib: pip install 'ckc_pin[view]'") from None
    return styles.context(["default", style.RC])


def write(figure: Figure, folder: Path, stem: str, formats: Sequence[str]) -> list[Path]:
    """Write a figure in several formats (InputError where the folder cannot be written)."""
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # the same figure gives the same file
    paths = [folder / f"{stem}.{kind}" for kind in formats]
    for kind, path in zip(formats, paths, strict=True):
        with look(), open_atomic(path) as file:
            figure.savefig(file, dpi=style.DPI, format=kind, metadata=dates.get(kind))
    return paths


@dataclass(frozen=True)
class Slot:
    """The place of a panel on a page, and its title."""

    figure: Figure
    place: Any
    title: str

    def axes(self, count: int = 1) -> list[Any]:
        """Return so many axes on top of each other, on one time; the uppermost has the title."""
        grid = self.place.subgridspec(count, 1)
        made: list[Any] = []
        for k in range(count):
            made.append(self.figure.add_subplot(grid[k], sharex=made[0] if made else None))
        for above in made[:-1]:
            above.tick_params(labelbottom=False)
        say(made[0], self.title)
        return made


def page(title: str, subtitle: str, titles: Sequence[str], columns: int, panel: tuple[float, float]) -> list[Slot]:
    """Return the slots of a new figure, with letters before their titles where they are two to four.

    Parameters
    ----------
    title, subtitle : str
    titles : sequence of str
        The panels', row by row.
    columns : int
    panel : (width, height)
        Of a panel, inches.
    """
    from matplotlib.figure import Figure

    rows = -(-len(titles) // columns)
    figure = Figure(figsize=(panel[0] * columns, panel[1] * rows + HEAD), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.05)  # type: ignore[union-attr, call-arg]
    head(figure, title, subtitle)
    grid = figure.add_gridspec(rows, columns)
    letters = [f"{letter})  " for letter in "abcd"] if 1 < len(titles) <= 4 else [""] * len(titles)
    return [Slot(figure, grid[k // columns, k % columns], f"{letters[k]}{titles[k]}") for k in range(len(titles))]


def head(figure: Figure, title: str, subtitle: str = "") -> None:
    """Write a title and a line of smaller grey letters below it, and keep their room free."""
    high = float(figure.get_figheight())
    top = 1.0 - 0.06 / high
    room = HEAD if subtitle else HEAD / 2
    figure.get_layout_engine().set(rect=(0.0, 0.0, 1.0, 1.0 - room / high))  # type: ignore[union-attr, call-arg]
    figure.suptitle(title, x=0.012, y=top, ha="left", va="top", fontweight="bold")
    figure.text(0.012, top - 0.185 / high, subtitle, ha="left", va="top", fontsize=style.NOTE, color=style.GREY)


def say(ax: Any, title: str, note: str = "") -> None:
    """Give an axes its title, and below it what is said about it in small grey letters; neither lies on a curve."""
    ax.set_title(title, pad=4.0)
    note_on(ax, note)


def note_on(ax: Any, note: str) -> None:
    """Say something about an axes below the title that it has."""
    if not note:
        return
    ax.set_title(next(filter(None, map(ax.get_title, ("left", "center", "right"))), ""),
                 pad=4.0 + 1.3 * style.NOTE * (note.count("\n") + 1))  # fmt: skip
    look = {"fontsize": style.NOTE, "color": style.GREY, "annotation_clip": False, "ha": "left", "va": "bottom"}
    said = ax.annotate(note, (0.0, 1.0), (0.0, 3.0), xycoords="axes fraction", textcoords="offset points", **look)
    said.set_in_layout(False)  # the title above it has its room; a long one takes none from its axes


def line(colour: Any, label: str, **look: Any) -> Any:
    """Return a legend's handle."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, label=label, **({"linewidth": 2.0} | look))


def fit_legend(owner: Any, handles: Sequence[Any], **where: Any) -> None:
    """Put a legend below a figure, or below an axes, in as many columns as its width has room for."""
    if not handles:
        return
    figure = owner.get_figure(root=True)
    if owner is figure:
        room = figure.get_figwidth()
        below: dict[str, Any] = {"loc": "outside lower center"}
    else:
        from matplotlib.transforms import ScaledTranslation

        room = figure.get_figwidth() * owner.get_subplotspec().get_position(figure).width
        lower = owner.transAxes + ScaledTranslation(0.0, -UNDER, figure.dpi_scale_trans)  # under its numbers
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "bbox_transform": lower, "borderaxespad": 0.0,
                 "fontsize": style.NOTE}  # fmt: skip
    for most in range(min(len(handles), 6), 0, -1):
        columns = -(-len(handles) // -(-len(handles) // most))  # full rows
        spaces = {"handlelength": 2.2, "columnspacing": 1.2, "handletextpad": 0.5}
        legend = owner.legend(handles=list(handles), ncols=columns, **(spaces | below | where))
        if columns == 1 or legend.get_window_extent().width <= figure.dpi * (room - 0.1):
            return
        legend.remove()


def limit(ax: Any, curves: Sequence[tuple[Array, Array]], end: float, brief: bool = False) -> str:
    """Keep a short peak at either end of the time from flattening all the rest; say where the axis was cut.

    Parameters
    ----------
    curves : sequence of ((m,), (m, k)) arrays
        Times and values.
    end : float
        Of the time shown.
    brief : bool
        Do not say when.

    Returns
    -------
    str
        The peaks that lie beyond the axis, marked by a triangle at its edge; empty where it shows everything.
    """
    shown = [(t[t <= end], y[t <= end]) for t, y in curves if y.size and np.isfinite(y).any()]
    last = max((float(t[-1]) for t, _ in shown), default=0.0)
    inner = [y[(t >= END * last) & (t <= (1 - END) * last)].ravel() for t, y in shown]
    rest, every = (np.concatenate([[], *ys]) for ys in (inner, [y.ravel() for _, y in shown]))
    rest, every = rest[np.isfinite(rest)], every[np.isfinite(every)]
    if not np.any(rest) or np.abs(every).max() <= DWARFED * np.abs(rest).max():
        return ""
    low, high = min(rest.min(), 0.0), max(rest.max(), 0.0)
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    ax.set_ylim(low, high)
    said = []
    for sign, edge, marker, sign_shown in ((1, high, "^", "▲"), (-1, low, "v", "▼")):
        if (sign * every).max() > sign * edge:
            peaks = [(float(np.nanmax(sign * y)), float(t[np.nanargmax(np.nanmax(sign * y, axis=1))]))
                     for t, y in shown]  # fmt: skip
            peak, t = max(peaks)
            ax.plot([t], [edge], marker=marker, markersize=5, color="black", clip_on=False, linestyle="none", zorder=5)
            said.append(f"{sign_shown} {sign * peak:.3g}" + ("" if brief else f" at {t:.3g} s"))
    return ", ".join(said)
