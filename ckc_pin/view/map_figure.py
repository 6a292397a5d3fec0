"""The singularity map as a figure: a panel for each branch, det phi_z as colour, the unreachable gray."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.mapped import LABELS, Axis, Kind, Locus, SingularityMap
from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, head, look, say, write
from ckc_pin.view.labels import plain, symbol, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["det_label", "draw_aspect", "draw_map", "handles", "require_figures", "save_map"]

UNREACHED = "#C9C9C9"
COLOURS = "PuOr"  # its middle is singular, and its sides are told apart by every eye
LOOKS: dict[Kind, dict[str, Any]] = {
    "locked": {"color": style.COLOURS[1], "linewidth": 1.6},
    "fold": {"color": "black", "linewidth": 1.6},
    "rank loss": {"color": style.COLOURS[3], "linewidth": 1.6},
    "serial": {"color": style.COLOURS[2], "linewidth": 1.3, "linestyle": (0, (4.0, 1.6))},
}
DESIRED: dict[str, Any] = {"color": style.COLOURS[0], "linewidth": 1.4}
PALER = 1.5  # so that lines stand out
POINT = 1e-9  # of the map's units: a locus no larger is drawn as a dot


def save_map(found: SingularityMap, folder: Path, formats: Sequence[str] = ("png", "svg")) -> list[Path]:
    """Draw a map and write it as map_joint or map_cartesian.

    Raises
    ------
    InputError
        A folder that cannot be written, matplotlib missing.
    """
    return write(draw_map(found), folder, f"map_{found.space}", formats)


def draw_map(found: SingularityMap) -> Figure:
    """Return the figure of a map.

    Raises
    ------
    InputError
        matplotlib missing.
    """
    with look():
        return _plane(found) if len(found.axes) == 2 else _line(found)


def require_figures() -> None:
    """Find out before a computation, not after it, whether it can be drawn (InputError)."""
    look()


# --- over two coordinates ------------------------------------------------------------------------


def _plane(found: SingularityMap) -> Figure:
    from matplotlib.figure import Figure

    columns = min(len(found.aspects), 2)
    rows = -(-len(found.aspects) // columns)
    wide = style.WIDTH / 2 - 0.35
    figure = Figure(figsize=(wide * columns + 0.7, wide * rows * _tall(found) + 1.4), layout="constrained")
    head(figure, *_title(found))
    most = max(float(np.nanmax(np.abs(aspect.det_phi_z))) for aspect in found.aspects)
    panels = []
    for k in range(len(found.aspects)):
        ax = figure.add_subplot(rows, columns, k + 1)
        panels.append(ax)
        shown = draw_aspect(ax, found, k, most)
        say(ax, *_panel_title(found, k))
    figure.colorbar(shown, ax=panels, label=det_label(found), shrink=0.85)
    fit_legend(figure, handles(found))
    return figure


def draw_aspect(ax: Any, found: SingularityMap, k: int, most: float) -> Any:
    """Draw an aspect into an axes: what is reached, the loci, the trajectory; `most` is the largest |det phi_z|."""
    ax.set_facecolor(UNREACHED)
    ax.grid(False)
    first, second = found.axes
    edges = [np.linspace(axis.low, axis.high, len(axis.values) + 1) for axis in found.axes]
    colours = {"cmap": COLOURS, "vmin": -PALER * most, "vmax": PALER * most}
    shown = ax.pcolormesh(*edges, found.aspects[k].det_phi_z.T, **colours, shading="flat", rasterized=True)
    for locus in found.loci:
        _locus(ax, found.axes, locus, k)
    if found.path is not None:
        _path(ax, found, k)
    aspect = "equal" if first.unit == second.unit else "auto"
    ax.set(xlim=(first.low, first.high), ylim=(second.low, second.high), aspect=aspect)
    ax.set(xlabel=_axis_label(found, first), ylabel=_axis_label(found, second))
    for axis, ticks in ((first, ax.set_xticks), (second, ax.set_yticks)):
        if axis.turns:
            ticks(np.pi * np.arange(-1, 1.1, 0.5), ["$-π$", "$-π/2$", "0", "$π/2$", "$π$"])
    return shown


def det_label(found: SingularityMap) -> str:
    """Label the colours."""
    unit = found.measure_unit.replace("^", "$^{") + "}$" * ("^" in found.measure_unit)
    name = r"$\det \varphi_z$" if found.measure.startswith("det") else r"$\sigma_{min}(\varphi_z)$"
    return with_unit(name, unit)


def _tall(found: SingularityMap) -> float:
    """Height of the window over its width, within what fits a page."""
    first, second = found.axes
    if first.unit != second.unit:
        return 1.0
    return float(np.clip((second.high - second.low) / (first.high - first.low), 0.4, 1.5))


def _locus(ax: Any, axes: Sequence[Axis], locus: Locus, aspect: int) -> None:
    if np.ptp(locus.at, axis=0).max() < POINT:
        if locus.on[aspect].any():
            _curve(ax, axes, locus.at[:1], marker="o", markersize=5, markeredgecolor="white", zorder=4,
                   color=LOOKS[locus.kind]["color"])  # fmt: skip
        return
    _curve(ax, axes, np.where(locus.on[aspect][:, None], locus.at, np.nan), zorder=3, **LOOKS[locus.kind])


def _path(ax: Any, found: SingularityMap, aspect: int) -> None:
    path = found.path
    if path is None or not path.on[aspect].any():
        return
    at = np.where(path.on[aspect][:, None], path.at, np.nan)
    _curve(ax, found.axes, at, zorder=5, **DESIRED)
    if path.on[aspect][0]:
        _curve(ax, found.axes, path.at[:1], zorder=6, marker="s", markersize=4.5, markeredgecolor="white",
               color=DESIRED["color"])  # fmt: skip


def _curve(ax: Any, axes: Sequence[Axis], at: Array, **look: Any) -> None:
    """Draw a curve once for each turn by which it enters the window."""
    from matplotlib.patheffects import Normal, Stroke

    turns = []
    for k, axis in enumerate(axes):
        inside = at[:, k][np.isfinite(at[:, k])]
        if not axis.turns or not len(inside):
            turns.append([0.0])
            continue
        first = np.ceil((axis.low - inside.max()) / (2 * np.pi))
        last = np.floor((axis.high - inside.min()) / (2 * np.pi))
        turns.append([2 * np.pi * number for number in np.arange(first, last + 1)])
    for x in turns[0]:
        for y in turns[1]:
            (line,) = ax.plot(at[:, 0] + x, at[:, 1] + y, **look)
            line.set_path_effects([Stroke(linewidth=line.get_linewidth() + 1.2, foreground="white", alpha=0.75),
                                   Normal()] if look.get("linestyle", "-") == "-" else [Normal()])  # fmt: skip


# --- over one coordinate -------------------------------------------------------------------------


def _line(found: SingularityMap) -> Figure:
    from matplotlib.figure import Figure

    axis = found.axes[0]
    place = found.space == "cartesian"
    figure = Figure(figsize=(style.WIDTH, 3.8), layout="constrained")
    head(figure, *_title(found))
    ax = figure.add_subplot()
    if place:
        _point_curves(ax, found)
    else:
        for k, aspect in enumerate(found.aspects):
            ax.plot(axis.values, aspect.det_phi_z[:, 0], color=style.COLOURS[k], linewidth=1.4)
        _gray(ax, axis, found.counts[:, 0] == 0)
        for locus in found.loci:
            if locus.on.any():
                at = np.remainder(locus.at[0, 0] - axis.low, 2 * np.pi) + axis.low if axis.turns else locus.at[0, 0]
                ax.axvline(at, zorder=3, **LOOKS[locus.kind])
        ax.axhline(0.0, color=style.GREY, linewidth=0.8)
        if found.path is not None:
            level = np.full(len(found.path.at), 0.0)
            _curve(ax, [axis, Axis("", "", 0, 0, False, level)], np.column_stack([found.path.at, level]), zorder=5,
                   **DESIRED)  # fmt: skip
        ax.set(xlabel=_axis_label(found, axis), ylabel=det_label(found), xlim=(axis.low, axis.high))
    fit_legend(figure, handles(found))
    return figure


def _point_curves(ax: Any, found: SingularityMap) -> None:
    """Where the point of a mechanism of one freedom goes, in the plane that holds most of it."""
    every = np.concatenate([aspect.point[aspect.reached] for aspect in found.aspects if aspect.point is not None])
    first, second = np.sort(np.argsort(-np.ptp(every, axis=0), kind="stable")[:2])
    for k, aspect in enumerate(found.aspects):
        if aspect.point is not None:
            ax.plot(*aspect.point[:, 0, [first, second]].T, color=style.COLOURS[k], linewidth=1.4)
    for locus in found.loci:
        if locus.point is not None and locus.on.any():
            ax.plot(*locus.point[0, [first, second]], "o", markersize=5, markeredgecolor="white", zorder=4,
                    color=LOOKS[locus.kind]["color"])  # fmt: skip
    ax.set(xlabel=f"${'xyz'[first]}$ (m)", ylabel=f"${'xyz'[second]}$ (m)", aspect="equal")
    ax.margins(0.08)


def _gray(ax: Any, axis: Axis, unreached: Array) -> None:
    edges = np.linspace(axis.low, axis.high, len(unreached) + 1)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], unreached.astype(int), [0]])))
    for start, end in ends.reshape(-1, 2):
        ax.axvspan(edges[start], edges[end], color=UNREACHED, linewidth=0)


# --- words ---------------------------------------------------------------------------------------


def _title(found: SingularityMap) -> tuple[str, str]:
    fixed = ", ".join(f"{symbol(k)} = {x:.4g}" for k, x in found.fixed.items())
    where = f"workspace of {found.point}" if found.space == "cartesian" else "singularity map"
    return f"{plain(found.mechanism)}: {where}", f"at {fixed}" if fixed else ""


def _panel_title(found: SingularityMap, k: int) -> tuple[str, str]:
    assembled = " (as assembled)" if k == 0 else ""
    return f"{_what(found)} {k + 1}{assembled}", f"reaches {100 * float(np.mean(found.aspects[k].reached)):.1f} %"


def _what(found: SingularityMap) -> str:
    return "working mode" if found.space == "cartesian" and len(found.axes) == 2 else "branch"


def _axis_label(found: SingularityMap, axis: Axis) -> str:
    return with_unit(f"${axis.name}$", "m") if found.space == "cartesian" else with_unit(symbol(axis.name), axis.unit)


def handles(found: SingularityMap) -> list[Any]:
    """Return the legend of what a map shows."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    shown: list[Any] = []
    for kind in LABELS:
        some = [locus for locus in found.loci if locus.kind == kind and locus.on.any()]
        if some:
            dots = all(np.ptp(locus.at, axis=0).max() < POINT for locus in some) and len(found.axes) == 2
            look = {"color": LOOKS[kind]["color"], "marker": "o", "linestyle": "none"} if dots else LOOKS[kind]
            shown.append(Line2D([], [], label=LABELS[kind], **look))
    if len(found.axes) == 1:
        what = _what(found)
        shown += [Line2D([], [], color=style.COLOURS[k], linewidth=1.4, label=f"{what} {k + 1}")
                    for k in range(len(found.aspects))]  # fmt: skip
    if found.path is not None:
        name = plain(found.path.name)
        shown.append(Line2D([], [], label=f"desired: {name} (square: start)", **DESIRED))
    if len(found.axes) == 2 and not all(aspect.reached.all() for aspect in found.aspects):
        shown.append(
            Patch(
                color=UNREACHED, label=f"not reached in this {_what(found)}".replace("in this branch", "on this branch")
            )
        )
    elif found.space == "joint" and not found.counts.all():
        shown.append(Patch(color=UNREACHED, label="not reached on any branch shown"))
    return shown
