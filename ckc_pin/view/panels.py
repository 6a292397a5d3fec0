"""Panels of run figures: quantities over time, configuration space, and poses of the mechanism.

Each function takes a `PanelSlot` and a `RunGroup`, draws one axes for each unit, and labels it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.units import motor_units
from ckc_pin.run.desired_path import DesiredPath
from ckc_pin.run.run import Run
from ckc_pin.view import style
from ckc_pin.view.geometry import Projection, compute_placements
from ckc_pin.view.layout import PanelSlot, add_note, clip_end_peaks, fit_legend, legend_line, set_panel_title
from ckc_pin.view.links import find_link_shapes
from ckc_pin.view.outlines import Outline, draw_base, project_base, project_outline
from ckc_pin.view.run_group import RunGroup, coordinate_columns
from ckc_pin.view.style import axis_label, coordinate_symbol, escape_mathtext, rate_symbol

__all__ = ["INITIAL_COLOUR", "TARGET_COLOUR", "coordinate_unit", "draw_configuration_space", "draw_coordinates",
           "draw_efforts", "draw_errors", "draw_initial_and_desired", "draw_loop_forces", "draw_rates", "draw_scalar",
           "draw_snapshots", "effort_symbol"]  # fmt: skip

DESIRED_DOTS = 25  # dots of a desired curve
DESIRED_DOTS_SMALL = 10  # in a small panel
WRAP_RANGE_RAD = 2 * np.pi  # a hinge that moves further is drawn modulo a turn
MAX_WRAPPED_TURNS = 20  # a hinge that turns more often is drawn in turns, because wrapping would give stripes
MAX_NOTE_NAMES = 3
SNAPSHOTS = 5
COLORMAP_END = 0.85  # of viridis; the colours beyond are too pale for print
PLATE_ALPHA = 0.12
RING_SIZE_PT = 3.4
THIN_LINE = 0.7  # of curves without a legend entry
INITIAL_COLOUR, TARGET_COLOUR, PATH_COLOUR = style.COLOURS[:3]


# --- motion over time ----------------------------------------------------------------------------


def draw_coordinates(slot: PanelSlot, group: RunGroup, names: Sequence[str]) -> None:
    """Draw coordinates over time, and desired ones as dots. Hinges that spin are wrapped or counted in turns."""
    ranges = {name: max(float(np.ptp(run.q_tree[:, run.column(name)])) for run in group.runs) for name in names}
    free_coordinates = group.mechanism.tree.free_coordinates
    names_by_unit: dict[str, list[str]] = {}
    for name in names:
        unit = coordinate_unit(group, name)
        spins = unit == "rad" and name not in free_coordinates and ranges[name] > MAX_WRAPPED_TURNS * 2 * np.pi
        names_by_unit.setdefault("turns" if spins else unit, []).append(name)
    wrapped = [name for name in names_by_unit.get("rad", [])
               if ranges[name] > WRAP_RANGE_RAD and name not in free_coordinates]  # fmt: skip
    for (unit, unit_names), ax in zip(names_by_unit.items(), slot.add_axes(len(names_by_unit)), strict=True):

        def convert(q: Array, name: str, unit: str = unit) -> Array:
            return q / (2 * np.pi) if unit == "turns" else _wrap(q) if name in wrapped else q

        _plot_curves(ax, group, unit_names, lambda run, name: convert(run[name], name))
        _plot_desired(ax, group, unit_names, lambda desired, k, name: convert(desired.q[:, k], name))
        ax.set_ylabel(axis_label(coordinate_symbol(unit_names[0]) if len(unit_names) == 1 else "$q$", unit))
        if wrapped and unit == "rad":
            ax.set_yticks([-np.pi, 0, np.pi], ["$-π$", "0", "$π$"])
            listed = (
                ", ".join(map(coordinate_symbol, wrapped))
                if len(wrapped) <= MAX_NOTE_NAMES
                else f"{len(wrapped)} that spin"
            )
            add_note(ax, f"{'' if len(wrapped) == len(unit_names) else f'{listed}: '}wrapped to $±π$")
    _label_time(slot, group, len(names_by_unit))


def draw_rates(slot: PanelSlot, group: RunGroup, names: Sequence[str]) -> None:
    """Draw rates over time, and those of a desired trajectory as dots."""
    names_by_unit = _group_by_unit(names, lambda name: f"{coordinate_unit(group, name)}/s")
    for (unit, unit_names), ax in zip(names_by_unit.items(), slot.add_axes(len(names_by_unit)), strict=True):
        _plot_curves(ax, group, unit_names, lambda run, name: run[f"v.{name}"])
        if group.kind == "tracking":
            _plot_desired(ax, group, unit_names, lambda desired, k, _: desired.q_dot[:, k])
        curves = [(run.t, run.v_tree[:, coordinate_columns(run, unit_names)]) for run in group.runs]
        add_note(ax, clip_end_peaks(ax, curves, group.t_shown, group.has_small_panels))
        ax.set_ylabel(axis_label(rate_symbol(unit_names[0]) if len(unit_names) == 1 else r"$\dot q$", unit))
    _label_time(slot, group, len(names_by_unit))


def draw_errors(slot: PanelSlot, group: RunGroup, names: Sequence[str]) -> None:
    """Draw the errors q - q_d over time."""
    names_by_unit = _group_by_unit(names, lambda name: coordinate_unit(group, name))
    for (unit, unit_names), ax in zip(names_by_unit.items(), slot.add_axes(len(names_by_unit)), strict=True):
        for name in _sort_grey_first(group, unit_names):
            for run, desired, line_style in zip(group.runs, group.desired_paths, group.line_styles, strict=True):
                if desired is not None:
                    ax.plot(run.t, run[f"error.{name}"], **_curve_style(group, name, line_style))
        ax.set_ylabel(axis_label("$q - q_d$", unit))
    _label_time(slot, group, len(names_by_unit))


# --- forces over time ----------------------------------------------------------------------------


def draw_efforts(slot: PanelSlot, group: RunGroup, names: Sequence[str], note: str = "") -> None:
    """Draw motor efforts over time; a short peak at either end is clipped and marked."""
    run = group.runs[0]
    units = motor_units(group.mechanism)
    names_by_unit = _group_by_unit(names, lambda name: units[run.actuated.index(name)])
    for (unit, unit_names), ax in zip(names_by_unit.items(), slot.add_axes(len(names_by_unit)), strict=True):
        _plot_curves(ax, group, unit_names, lambda run, name: run[f"tau.{name}"])
        columns = [run.actuated.index(name) for name in unit_names]
        curves = [(run.t, run.tau[:, columns]) for run in group.runs]
        clipped = clip_end_peaks(ax, curves, group.t_shown, group.has_small_panels)
        add_note(ax, "\n".join(filter(None, [note, clipped])))
        note = ""  # The uppermost axes has it.
        ax.set_ylabel(axis_label(f"${effort_symbol(group)}$", unit))
    _label_time(slot, group, len(names_by_unit))


def effort_symbol(group: RunGroup) -> str:
    """Return "u" if the motors drive the independent joints directly, as in the paper, else "tau" as mathtext."""
    return "u" if group.mechanism.has_direct_drives else r"\tau"


def draw_loop_forces(slot: PanelSlot, group: RunGroup) -> None:
    """Draw the norm of each loop's force over time, N. It contains the multipliers of rows that are lengths."""
    mechanism = group.mechanism
    (ax,) = slot.add_axes()
    in_metres = mechanism.closure.in_metres(mechanism.tree)
    row_loops = [loop for loop, _ in mechanism.closure.names]
    norms_by_run = []
    for run in group.runs:
        norms = {}
        for loop, forces in run.loop_forces().items():
            selected = in_metres[[name == loop for name in row_loops]]
            if any(selected):
                norms[loop] = np.linalg.norm(forces[:, selected], axis=1)
        norms_by_run.append(norms)
    loops = list(norms_by_run[0])
    largest = {loop: max(float(np.nanmax(norms[loop], initial=0.0)) for norms in norms_by_run) for loop in loops}
    named = style.select_largest(largest)
    colours = style.assign_colours(named)
    for loop in [*(loop for loop in loops if loop not in named), *named]:
        for run, line_style, norms in zip(group.runs, group.line_styles, norms_by_run, strict=True):
            properties = line_style if loop in colours else line_style | {"linewidth": THIN_LINE}
            ax.plot(run.t, norms[loop], color=colours.get(loop, style.REST_COLOUR), **properties)
    curves = [
        (run.t, np.column_stack(list(norms.values())))
        for run, norms in zip(group.runs, norms_by_run, strict=True)
        if norms
    ]
    title = slot.title
    if len(loops) == 1:
        title = title.replace("loop forces", f"force in loop {escape_mathtext(loops[0])}")
    set_panel_title(ax, title, clip_end_peaks(ax, curves, group.t_end))
    _set_time_axis(ax, group.t_end)
    ax.set_ylabel(axis_label(r"$|\lambda|$", "N"))
    if not loops:
        ax.text(0.5, 0.5, "no loop holds points together", ha="center", va="center", transform=ax.transAxes)
    if len(loops) != 1:
        handles = [legend_line(colours[loop], escape_mathtext(loop)) for loop in named]
        if len(named) < len(loops):
            handles.append(legend_line(style.REST_COLOUR, f"{len(loops) - len(named)} more"))
        fit_legend(ax, handles)


def draw_scalar(
    slot: PanelSlot, group: RunGroup, compute: Callable[[Run], Array], name: str, dots: bool = False, clip: bool = True
) -> Any:
    """Draw one scalar over the whole time, with a colour for each run; `dots` suits values that are mostly rounding."""
    (ax,) = slot.add_axes()
    for k, (run, line_style) in enumerate(zip(group.runs, group.line_styles, strict=True)):
        dot_style = {"linestyle": "none", "marker": ".", "markersize": 2.0 * line_style["linewidth"]}
        colour = style.COLOURS[k % len(style.COLOURS)]
        ax.plot(run.t, compute(run), color=colour, **(dot_style if dots else line_style))
    if clip:
        curves = [(run.t, compute(run)[:, None]) for run in group.runs]
        set_panel_title(ax, slot.title, clip_end_peaks(ax, curves, group.t_end))
    ax.set_ylabel(name)
    _set_time_axis(ax, group.t_end)
    return ax


def coordinate_unit(group: RunGroup, name: str) -> str:
    """Return the unit of a coordinate."""
    return group.mechanism.tree.units()[group.mechanism.tree.index[name]]


# --- configuration space and poses ---------------------------------------------------------------


def draw_configuration_space(slot: PanelSlot, group: RunGroup) -> None:
    """Draw two independent coordinates against each other, or the phase plane of a single one."""
    (ax,) = slot.add_axes()
    is_phase_plane = len(group.independent) == 1
    for run, line_style in zip(group.runs, group.line_styles, strict=True):
        columns = coordinate_columns(run, run.independent)
        x, y = _select_plane(run, run.q_tree[:, columns], run.v_tree[:, columns])
        ax.plot(x, y, color=PATH_COLOUR, **line_style)
        ax.plot(x[:1], y[:1], linestyle="none", marker="o", markersize=4.5, color=PATH_COLOUR)
    for run, desired in group.distinct_desired:
        x, y = _select_plane(run, desired.q, desired.q_dot)
        if len(np.unique(np.column_stack([x, y]), axis=0)) == 1:
            ax.plot(x[:1], y[:1], linestyle="none", marker="x", markersize=5.5, color="black")
        else:
            ax.plot(x, y, linestyle=":", linewidth=1.2, color="black")
    names = group.independent[:2]
    units = [coordinate_unit(group, name) for name in names]
    labels = [axis_label(coordinate_symbol(name), unit) for name, unit in zip(names, units, strict=True)]
    ax.set_xlabel(labels[0])
    ax.set_ylabel(axis_label(rate_symbol(names[0]), f"{units[0]}/s") if is_phase_plane else labels[1])
    ax.margins(0.08)
    if not is_phase_plane and len(set(units)) == 1:
        ax.set_aspect("equal", adjustable="datalim")


def _select_plane(run: Run, q: Array, q_dot: Array) -> tuple[Array, Array]:
    return (q[:, 0], q_dot[:, 0]) if len(run.independent) == 1 else (q[:, 0], q[:, 1])


def draw_initial_and_desired(slot: PanelSlot, group: RunGroup, plane: Projection) -> None:
    """Draw the initial pose in blue, the desired poses in red, and the paths of named points dotted."""
    mechanism, run = group.mechanism, group.runs[0]
    (ax,) = slot.add_axes()
    poses = [(mechanism.tree.from_coordinates(run.q_tree[0]), INITIAL_COLOUR)]
    for _, desired in group.distinct_desired:
        target = sigma(mechanism, desired.q[-1])
        if target.verdict == "converged":
            poses.append((target.at.q_tree, TARGET_COLOUR))
    for path in run.points.values():
        ax.plot(*(plane.axes @ path.T), color=style.GREY, linewidth=0.8, linestyle=":")
    placements = compute_placements(mechanism, np.array([q_tree for q_tree, _ in poses]))
    shapes = find_link_shapes(mechanism, placements)
    draw_base(ax, project_base(shapes, plane))
    for k, (_, colour) in enumerate(poses):
        _draw_pose(ax, project_outline(mechanism, shapes, placements.select_row(k), plane), colour, 1.8)
    _label_plane(ax, plane)


def draw_snapshots(slots: Sequence[PanelSlot], group: RunGroup, planes: Sequence[Projection]) -> Any:
    """Draw poses of the first run at equal time intervals, one panel for each plane.

    The first and the last pose have thicker lines. Returns the mappable for a colour bar over time.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    mechanism, run = group.mechanism, group.runs[0]
    t_end = min(group.t_shown, float(run.t[-1]))
    colormap = ListedColormap(colormaps["viridis"](np.linspace(0.0, COLORMAP_END, 256)))
    mappable = ScalarMappable(Normalize(0.0, t_end or 1.0), colormap)
    rows = [run.at(float(t)) for t in np.linspace(0.0, t_end, SNAPSHOTS)]
    configurations = np.array([mechanism.tree.from_coordinates(run.q_tree[row]) for row in rows])
    placements = compute_placements(mechanism, configurations)
    shapes = find_link_shapes(mechanism, placements)
    for slot, plane in zip(slots, planes, strict=True):
        (ax,) = slot.add_axes()
        for path in run.points.values():
            ax.plot(*(plane.axes @ path[run.t <= t_end].T), color=style.GREY, linewidth=0.8, linestyle=":")
        draw_base(ax, project_base(shapes, plane))
        for k, row in enumerate(rows):
            linewidth = 1.8 if k in (0, len(rows) - 1) else 0.9
            outline = project_outline(mechanism, shapes, placements.select_row(k), plane)
            _draw_pose(ax, outline, mappable.to_rgba(run.t[row]), linewidth)
        _label_plane(ax, plane)
    return mappable


def _draw_pose(ax: Any, outline: Outline, colour: Any, linewidth: float) -> None:
    from matplotlib.patches import Polygon

    for plate in outline.plates:
        ax.add_patch(Polygon(plate, facecolor=(colour, PLATE_ALPHA), edgecolor=colour, linewidth=linewidth, zorder=3))
    for bar in outline.bars:
        ax.plot(*bar.T, color=colour, linewidth=linewidth, zorder=3)
    for block in outline.blocks:
        ax.add_patch(Polygon(block, facecolor="white", edgecolor=colour, linewidth=1.1, zorder=4))
    if len(outline.rings):
        ax.plot(*outline.rings.T, color=colour, linestyle="none", marker="o", markersize=RING_SIZE_PT,
                markerfacecolor="white", markeredgewidth=min(linewidth, 1.0), zorder=4)  # fmt: skip


def _label_plane(ax: Any, plane: Projection) -> None:
    ax.set_xlabel(axis_label(plane.names[0], "m"))
    ax.set_ylabel(axis_label(plane.names[1], "m"))
    ax.margins(0.06)
    ax.set_aspect("equal", adjustable="datalim")


# --- curves and axes -----------------------------------------------------------------------------


def _group_by_unit(names: Sequence[str], unit_of: Callable[[str], str]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(unit_of(name), []).append(name)
    return groups


def _sort_grey_first(group: RunGroup, names: Sequence[str]) -> list[str]:
    """Sort names so that grey curves are drawn first, behind coloured ones."""
    return sorted(names, key=lambda name: group.colours[name] != style.REST_COLOUR)


def _curve_style(group: RunGroup, name: str, line_style: dict[str, Any]) -> dict[str, Any]:
    colour = group.colours[name]
    return line_style | {"color": colour} | ({"linewidth": THIN_LINE} if colour == style.REST_COLOUR else {})


def _plot_curves(ax: Any, group: RunGroup, names: Sequence[str], compute: Callable[[Run, str], Array]) -> None:
    ordered = _sort_grey_first(group, names)
    for run, line_style in zip(group.runs, group.line_styles, strict=True):
        for name in ordered:
            ax.plot(run.t, compute(run, name), **_curve_style(group, name, line_style))


def _plot_desired(
    ax: Any, group: RunGroup, names: Sequence[str], compute: Callable[[DesiredPath, int, str], Array]
) -> None:
    count = DESIRED_DOTS_SMALL if group.has_small_panels else DESIRED_DOTS
    for run, desired in group.distinct_desired:
        rows = np.unique(np.linspace(0, len(run.t) - 1, count).astype(int))
        for k, name in enumerate(run.independent):
            if name in names and group.colours[name] != style.REST_COLOUR:
                values = compute(desired, k, name)
                ax.plot(run.t[rows], values[rows], linestyle="none", marker=".", markersize=3, color="black")


def _wrap(q: Array) -> Array:
    """Wrap angles to ±pi. NaN before each jump keeps matplotlib from drawing a vertical line."""
    wrapped = np.remainder(q + np.pi, 2 * np.pi) - np.pi
    jumps = np.flatnonzero(np.abs(np.diff(wrapped)) > np.pi)
    wrapped[jumps] = np.nan
    return wrapped


def _label_time(slot: PanelSlot, group: RunGroup, count: int) -> None:
    """Set the time axes of a panel's last `count` axes, and label the lowest."""
    for ax in slot.figure.axes[-count:]:
        _set_time_axis(ax, group.t_shown)
        ax.set_xlabel("")
    slot.figure.axes[-1].set_xlabel(axis_label("$t$", "s"))


def _set_time_axis(ax: Any, t_end: float) -> None:
    ax.set_xlabel(axis_label("$t$", "s"))
    if t_end > 0:
        ax.set_xlim(-0.02 * t_end, 1.02 * t_end)
