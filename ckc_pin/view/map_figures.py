"""Figures of singularity maps and workspaces: one panel for each branch or section, det phi_z as colour."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.mapped import LABELS, Aspect, Axis, Kind, Locus, SingularityMap
from ckc_pin.view import style
from ckc_pin.view.layout import add_header, fit_legend, set_panel_title, write_figure
from ckc_pin.view.style import axis_label, coordinate_symbol, escape_mathtext, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_bare_map", "draw_map", "draw_sections", "require_matplotlib", "save_map", "save_sections"]

UNREACHED_COLOUR = "#C9C9C9"
COLORMAP = "PuOr"  # diverging, singular in the middle; people with colour blindness can tell its sides apart
LOCUS_STYLES: dict[Kind, dict[str, Any]] = {
    "locked": {"color": style.COLOURS[1], "linewidth": 1.6},
    "fold": {"color": "black", "linewidth": 1.6},
    "rank loss": {"color": style.COLOURS[3], "linewidth": 1.6},
    "serial": {"color": style.COLOURS[2], "linewidth": 1.3, "linestyle": (0, (4.0, 1.6))},
}
DESIRED_STYLE: dict[str, Any] = {"color": style.COLOURS[0], "linewidth": 1.4}
COLOUR_RANGE_RATIO = 1.5  # range of the colours to that of the values: pale colours let lines stand out
POINT_TOLERANCE = 1e-9  # in units of the axes: a smaller locus is drawn as a dot
SECTION_COLUMNS = 3
BARE_DPI = 100
UNREACHED_HATCH = "////"  # tells cells that are not reached apart without colour


def require_matplotlib() -> None:
    """Raise InputError if matplotlib is not installed; call it before a computation whose result will be drawn."""
    figure_style()


# --- maps ----------------------------------------------------------------------------------------


def save_map(singularity_map: SingularityMap, folder: Path, formats: Sequence[str] = ("png", "svg")) -> list[Path]:
    """Draw a map and write it as map_joint or map_cartesian.

    Raises
    ------
    InputError
        The folder cannot be written; matplotlib is not installed.
    """
    return write_figure(draw_map(singularity_map), folder, f"map_{singularity_map.space}", formats)


def draw_map(singularity_map: SingularityMap) -> Figure:
    """Return the figure of a singularity map over one or two axes.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    with figure_style():
        return _draw_2d(singularity_map) if len(singularity_map.axes) == 2 else _draw_1d(singularity_map)


def save_sections(
    sections: Sequence[SingularityMap], folder: Path, formats: Sequence[str] = ("png", "svg")
) -> list[Path]:
    """Draw sections of a workspace and write them as map_sections.

    Raises
    ------
    InputError
        The folder cannot be written; matplotlib is not installed.
    """
    return write_figure(draw_sections(sections), folder, "map_sections", formats)


def draw_sections(sections: Sequence[SingularityMap]) -> Figure:
    """Return the figure of a three-dimensional workspace: one panel for each section, from the lowest.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    with figure_style():
        from matplotlib.figure import Figure

        first = sections[0]
        columns = min(len(sections), SECTION_COLUMNS)
        rows = -(-len(sections) // columns)
        width, height = (axis.high - axis.low for axis in first.axes)
        aspect = float(np.clip(height / width, 0.4, 1.6))
        panel_width = (style.WIDTH_IN - 0.6) / SECTION_COLUMNS
        size = (panel_width * columns + 0.6, (panel_width * aspect + 0.35) * rows + 1.1)
        figure = Figure(figsize=size, layout="constrained")
        name = escape_mathtext(first.mechanism)
        (fixed,) = first.fixed
        subtitle = f"sections across ${fixed}$, working mode as assembled"
        add_header(figure, f"{name}: workspace of {first.point}", subtitle)
        max_det = max(float(np.nanmax(np.abs(section.aspects[0].det_phi_z))) for section in sections)
        cell_area = float(np.prod([(axis.high - axis.low) / len(axis.values) for axis in first.axes]))
        panels = [figure.add_subplot(rows, columns, k + 1) for k in range(len(sections))]
        for k, (ax, section) in enumerate(zip(panels, sections, strict=True)):
            mesh = _draw_aspect(ax, section, 0, max_det)
            area = cell_area * np.sum(section.aspects[0].reached)
            set_panel_title(ax, f"${fixed}$ = {section.fixed[fixed]:.3f} m", f"reaches {area:.3f} m²")
            ax.locator_params(nbins=4)
            if k % columns:
                ax.set_ylabel("")
                ax.tick_params(labelleft=False)
            if k + columns < len(sections):
                ax.set_xlabel("")
        figure.colorbar(mesh, ax=panels, label=_measure_label(first), shrink=0.85)
        handles = {handle.get_label(): handle for section in sections for handle in _create_handles(section)}
        fit_legend(figure, list(handles.values()))
        return figure


def draw_bare_map(singularity_map: SingularityMap, aspect: int, width_px: int, height_px: int) -> bytes:
    """Return one aspect of a map over one or two independent coordinates as a PNG without axes.

    The axes' ranges reach from edge to edge. Colours are dark far from singular configurations and pale near them;
    cells that are not reached are hatched. No style of matplotlib is set, so that it can be called in any thread.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_px / BARE_DPI, height_px / BARE_DPI), dpi=BARE_DPI)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.patch.set(hatch=UNREACHED_HATCH, edgecolor=style.GREY)
    max_det = max(float(np.nanmax(np.abs(aspect.det_phi_z))) for aspect in singularity_map.aspects)
    if len(singularity_map.axes) == 2:
        _draw_aspect(ax, singularity_map, aspect, max_det)
    else:
        axis = singularity_map.axes[0]
        _draw_cells(ax, [axis, Axis("", "", 0.0, 1.0, False, np.zeros(1))], singularity_map.aspects[aspect], max_det)
        for locus in singularity_map.loci:
            if locus.on[aspect].any():
                ax.axvline(_place_on_axis(axis, locus.at[0, 0]), **LOCUS_STYLES[locus.kind])
        ax.set(xlim=(axis.low, axis.high))
    ax.set(aspect="auto")
    ax.set_axis_off()
    ax.add_artist(ax.patch)  # axes that are off draw no background
    ax.patch.set_zorder(-1)
    buffer = BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


# --- two axes ------------------------------------------------------------------------------------


def _draw_2d(singularity_map: SingularityMap) -> Figure:
    from matplotlib.figure import Figure

    aspects = singularity_map.aspects
    columns = min(len(aspects), 2)
    rows = -(-len(aspects) // columns)
    width = style.WIDTH_IN / 2 - 0.35
    size = (width * columns + 0.7, width * rows * _panel_aspect(singularity_map) + 1.4)
    figure = Figure(figsize=size, layout="constrained")
    add_header(figure, *_format_title(singularity_map))
    max_det = max(float(np.nanmax(np.abs(aspect.det_phi_z))) for aspect in aspects)
    panels = []
    for k in range(len(aspects)):
        ax = figure.add_subplot(rows, columns, k + 1)
        panels.append(ax)
        mesh = _draw_aspect(ax, singularity_map, k, max_det)
        set_panel_title(ax, *_format_panel_title(singularity_map, k))
    figure.colorbar(mesh, ax=panels, label=_measure_label(singularity_map), shrink=0.85)
    fit_legend(figure, _create_handles(singularity_map))
    return figure


def _draw_aspect(ax: Any, singularity_map: SingularityMap, k: int, max_det: float) -> Any:
    """Draw one aspect: reached cells, loci and the desired trajectory. `max_det` is the largest |det phi_z|."""
    ax.set_facecolor(UNREACHED_COLOUR)
    ax.grid(False)
    first, second = singularity_map.axes
    mesh = _draw_cells(ax, singularity_map.axes, singularity_map.aspects[k], max_det)
    for locus in singularity_map.loci:
        _draw_locus(ax, singularity_map.axes, locus, k)
    if singularity_map.path is not None:
        _draw_path(ax, singularity_map, k)
    aspect = "equal" if first.unit == second.unit else "auto"
    ax.set(xlim=(first.low, first.high), ylim=(second.low, second.high), aspect=aspect)
    ax.set(xlabel=_axis_label(singularity_map, first), ylabel=_axis_label(singularity_map, second))
    for axis, set_ticks in ((first, ax.set_xticks), (second, ax.set_yticks)):
        if axis.turns:
            set_ticks(np.pi * np.arange(-1, 1.1, 0.5), ["$-π$", "$-π/2$", "0", "$π/2$", "$π$"])
    return mesh


def _draw_cells(ax: Any, axes: Sequence[Axis], aspect: Aspect, max_det: float) -> Any:
    """Draw the cells that an aspect reaches. Colours are dark where |det phi_z| is large."""
    edges = [np.linspace(axis.low, axis.high, len(axis.values) + 1) for axis in axes]
    limit = COLOUR_RANGE_RATIO * max_det
    colours = {"cmap": COLORMAP, "vmin": -limit, "vmax": limit}
    return ax.pcolormesh(*edges, aspect.det_phi_z.T, **colours, shading="flat", rasterized=True)


def _panel_aspect(singularity_map: SingularityMap) -> float:
    """Return height over width of a panel, limited to what fits a page."""
    first, second = singularity_map.axes
    if first.unit != second.unit:
        return 1.0
    return float(np.clip((second.high - second.low) / (first.high - first.low), 0.4, 1.5))


def _draw_locus(ax: Any, axes: Sequence[Axis], locus: Locus, aspect: int) -> None:
    if np.ptp(locus.at, axis=0).max() < POINT_TOLERANCE:
        if locus.on[aspect].any():
            _plot_periodic(ax, axes, locus.at[:1], marker="o", markersize=5, markeredgecolor="white", zorder=4,
                           color=LOCUS_STYLES[locus.kind]["color"])  # fmt: skip
        return
    points = np.where(locus.on[aspect][:, None], locus.at, np.nan)
    _plot_periodic(ax, axes, points, zorder=3, **LOCUS_STYLES[locus.kind])


def _draw_path(ax: Any, singularity_map: SingularityMap, aspect: int) -> None:
    path = singularity_map.path
    if path is None or not path.on[aspect].any():
        return
    points = np.where(path.on[aspect][:, None], path.at, np.nan)
    _plot_periodic(ax, singularity_map.axes, points, zorder=5, **DESIRED_STYLE)
    if path.on[aspect][0]:
        _plot_periodic(ax, singularity_map.axes, path.at[:1], zorder=6, marker="s", markersize=4.5,
                       markeredgecolor="white", color=DESIRED_STYLE["color"])  # fmt: skip


def _plot_periodic(ax: Any, axes: Sequence[Axis], points: Array, **properties: Any) -> None:
    """Plot a curve (m, 2), repeated for each full turn of an angle by which it enters the axes' limits."""
    from matplotlib.patheffects import Normal, Stroke

    shifts = []
    for k, axis in enumerate(axes):
        finite = points[:, k][np.isfinite(points[:, k])]
        if not axis.turns or not len(finite):
            shifts.append([0.0])
            continue
        first = np.ceil((axis.low - finite.max()) / (2 * np.pi))
        last = np.floor((axis.high - finite.min()) / (2 * np.pi))
        shifts.append([2 * np.pi * number for number in np.arange(first, last + 1)])
    is_solid = properties.get("linestyle", "-") == "-"
    for x in shifts[0]:
        for y in shifts[1]:
            (line,) = ax.plot(points[:, 0] + x, points[:, 1] + y, **properties)
            outline = Stroke(linewidth=line.get_linewidth() + 1.2, foreground="white", alpha=0.75)
            line.set_path_effects([outline, Normal()] if is_solid else [Normal()])


# --- one axis ------------------------------------------------------------------------------------


def _draw_1d(singularity_map: SingularityMap) -> Figure:
    from matplotlib.figure import Figure

    axis = singularity_map.axes[0]
    figure = Figure(figsize=(style.WIDTH_IN, 3.8), layout="constrained")
    add_header(figure, *_format_title(singularity_map))
    ax = figure.add_subplot()
    if singularity_map.space == "cartesian":
        _draw_point_curves(ax, singularity_map)
    else:
        for k, aspect in enumerate(singularity_map.aspects):
            ax.plot(axis.values, aspect.det_phi_z[:, 0], color=style.COLOURS[k], linewidth=1.4)
        _shade_unreached(ax, axis, singularity_map.counts[:, 0] == 0)
        for locus in singularity_map.loci:
            if locus.on.any():
                ax.axvline(_place_on_axis(axis, locus.at[0, 0]), zorder=3, **LOCUS_STYLES[locus.kind])
        ax.axhline(0.0, color=style.GREY, linewidth=0.8)
        if singularity_map.path is not None:
            zeros = np.full(len(singularity_map.path.at), 0.0)
            points = np.column_stack([singularity_map.path.at, zeros])
            _plot_periodic(ax, [axis, Axis("", "", 0, 0, False, zeros)], points, zorder=5, **DESIRED_STYLE)
        ax.set(xlabel=_axis_label(singularity_map, axis), ylabel=_measure_label(singularity_map),
               xlim=(axis.low, axis.high))  # fmt: skip
    fit_legend(figure, _create_handles(singularity_map))
    return figure


def _place_on_axis(axis: Axis, value: float) -> float:
    """Return a coordinate within the range of its axis, if that is a full turn."""
    return float(np.remainder(value - axis.low, 2 * np.pi) + axis.low) if axis.turns else value


def _draw_point_curves(ax: Any, singularity_map: SingularityMap) -> None:
    """Draw the path of a point of a mechanism with one freedom, in the plane that contains most of it."""
    points = np.concatenate(
        [aspect.point[aspect.reached] for aspect in singularity_map.aspects if aspect.point is not None]
    )
    first, second = np.sort(np.argsort(-np.ptp(points, axis=0), kind="stable")[:2])
    for k, aspect in enumerate(singularity_map.aspects):
        if aspect.point is not None:
            ax.plot(*aspect.point[:, 0, [first, second]].T, color=style.COLOURS[k], linewidth=1.4)
    for locus in singularity_map.loci:
        if locus.point is not None and locus.on.any():
            ax.plot(*locus.point[0, [first, second]], "o", markersize=5, markeredgecolor="white", zorder=4,
                    color=LOCUS_STYLES[locus.kind]["color"])  # fmt: skip
    ax.set(xlabel=f"${'xyz'[first]}$ (m)", ylabel=f"${'xyz'[second]}$ (m)", aspect="equal")
    ax.margins(0.08)


def _shade_unreached(ax: Any, axis: Axis, is_unreached: Array) -> None:
    edges = np.linspace(axis.low, axis.high, len(is_unreached) + 1)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], is_unreached.astype(int), [0]])))
    for start, end in ends.reshape(-1, 2):
        ax.axvspan(edges[start], edges[end], color=UNREACHED_COLOUR, linewidth=0)


# --- titles, labels, legend ----------------------------------------------------------------------


def _format_title(singularity_map: SingularityMap) -> tuple[str, str]:
    fixed = ", ".join(f"{coordinate_symbol(k)} = {x:.4g}" for k, x in singularity_map.fixed.items())
    is_cartesian = singularity_map.space == "cartesian"
    topic = f"workspace of {singularity_map.point}" if is_cartesian else "singularity map"
    return f"{escape_mathtext(singularity_map.mechanism)}: {topic}", f"at {fixed}" if fixed else ""


def _format_panel_title(singularity_map: SingularityMap, k: int) -> tuple[str, str]:
    assembled = " (as assembled)" if k == 0 else ""
    percentage = 100 * float(np.mean(singularity_map.aspects[k].reached))
    return f"{_aspect_noun(singularity_map)} {k + 1}{assembled}", f"reaches {percentage:.1f} %"


def _aspect_noun(singularity_map: SingularityMap) -> str:
    return "working mode" if singularity_map.space == "cartesian" and len(singularity_map.axes) == 2 else "branch"


def _measure_label(singularity_map: SingularityMap) -> str:
    unit = singularity_map.measure_unit.replace("^", "$^{") + "}$" * ("^" in singularity_map.measure_unit)
    name = r"$\det \varphi_z$" if singularity_map.measure.startswith("det") else r"$\sigma_{min}(\varphi_z)$"
    return axis_label(name, unit)


def _axis_label(singularity_map: SingularityMap, axis: Axis) -> str:
    if singularity_map.space == "cartesian":
        return axis_label(f"${axis.name}$", "m")
    return axis_label(coordinate_symbol(axis.name), axis.unit)


def _create_handles(singularity_map: SingularityMap) -> list[Any]:
    """Return the legend handles for the contents of a map."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    noun = _aspect_noun(singularity_map)
    handles: list[Any] = []
    for kind in LABELS:
        loci = [locus for locus in singularity_map.loci if locus.kind == kind and locus.on.any()]
        if loci:
            are_points = all(np.ptp(locus.at, axis=0).max() < POINT_TOLERANCE for locus in loci)
            dot_style = {"color": LOCUS_STYLES[kind]["color"], "marker": "o", "linestyle": "none"}
            uses_dots = are_points and len(singularity_map.axes) == 2
            handles.append(Line2D([], [], label=LABELS[kind], **(dot_style if uses_dots else LOCUS_STYLES[kind])))
    if len(singularity_map.axes) == 1:
        handles += [Line2D([], [], color=style.COLOURS[k], linewidth=1.4, label=f"{noun} {k + 1}")
                    for k in range(len(singularity_map.aspects))]  # fmt: skip
    if singularity_map.path is not None:
        name = escape_mathtext(singularity_map.path.name)
        handles.append(Line2D([], [], label=f"desired: {name} (square: start)", **DESIRED_STYLE))
    if len(singularity_map.axes) == 2 and not all(aspect.reached.all() for aspect in singularity_map.aspects):
        preposition = "on" if noun == "branch" else "in"
        handles.append(Patch(color=UNREACHED_COLOUR, label=f"not reached {preposition} this {noun}"))
    elif singularity_map.space == "joint" and not singularity_map.counts.all():
        handles.append(Patch(color=UNREACHED_COLOUR, label="not reached on any branch shown"))
    return handles
