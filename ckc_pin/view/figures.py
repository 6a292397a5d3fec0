"""Figures of runs: the paper's Fig. 3 and Fig. 4, motion without control, checks and snapshots.

Runs of one mechanism under one kind of control share a figure: colours tell coordinates apart, line styles
formulations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import require_path
from ckc_pin.errors import InputError
from ckc_pin.mechanism.units import joined, motor_units, row_units
from ckc_pin.run.run import Run
from ckc_pin.view import panels, style
from ckc_pin.view.geometry import projection_planes
from ckc_pin.view.layout import PanelSlot, create_page, fit_legend, legend_line, write_figure
from ckc_pin.view.run_group import RunGroup, require_runs
from ckc_pin.view.style import axis_label, coordinate_symbol, escape_mathtext, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FORMATS", "draw_runs", "plot_runs", "require_formats", "write_figures"]

FORMATS = ("png", "svg", "pdf")
TITLES = {
    "set_point": "set-point control",
    "tracking": "tracking control",
    "servo": "joint servos",
    "prescribed": "prescribed joints",
    "own": "own controller",
    "motion": "motion without control",
}
PAPER_FIGURES = {"five_bar/set_point": "Fig. 3, eq. 14", "five_bar/tracking": "Fig. 4, eq. 16"}
PAPER_STEADY_START = 4.0  # s, where the paper's steady state begins
MAX_PANEL_COORDINATES = 12  # without control, all coordinates are drawn up to this number, else the independent ones
PANEL_SIZE_IN = (style.WIDTH_IN / 2, 1.95)
SECOND_UNIT_HEIGHT_IN = 0.6  # added to the height of panels with two units
SMALL_PANEL_HEIGHT_IN = 1.15
MIN_SPAN_RATIO = 0.01  # least span of a small panel's y axis, relative to the largest of the figure
LYAPUNOV_ROUNDING = 1e-15  # of the function's maximum; smaller values are rounding errors


def plot_runs(runs: Run | Sequence[Run], out_dir: str | Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Draw runs and write the figures.

    Parameters
    ----------
    runs : Run or sequence of Run
        Runs of one mechanism under one kind of control share a figure.
    out_dir : path
        A folder; it is created if missing.
    formats : sequence of "png", "svg", "pdf"

    Returns
    -------
    list of Path
        The files. Their names are ``set_point``, ``tracking``, ``servo``, ``prescribed``, ``own`` or ``motion``, alone
        and with suffixes:
        ``_snapshots``; for controlled runs ``_checks``, which shows whether to trust a run; and ``_coordinates`` and
        ``_efforts`` with a small panel for each, if there are more than colours.

    Raises
    ------
    InputError
        No run, unknown format, the folder cannot be written, or matplotlib is not installed.
    """
    require_formats(formats)
    return write_figures(draw_runs(runs), out_dir, formats)


def write_figures(figures: Mapping[str, Figure], out_dir: str | Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Write figures to a folder, one file for each figure and format.

    Raises
    ------
    InputError
        Unknown format; the folder cannot be written.
    """
    require_formats(formats)
    require_path(out_dir, "plot: out_dir", "a folder")
    return [path for name, figure in figures.items() for path in write_figure(figure, Path(out_dir), name, formats)]


def require_formats(formats: Sequence[str]) -> None:
    """Raise InputError if a format is unsupported, or if there is none."""
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise InputError(f"plot: format {unknown[0] if unknown else 'missing'!r}; valid: {', '.join(FORMATS)}")


def draw_runs(runs: Run | Sequence[Run]) -> dict[str, Figure]:
    """Return the figures that `plot_runs` writes, by name, as matplotlib figures.

    Raises
    ------
    InputError
        No run; matplotlib is not installed.
    """
    runs = require_runs(runs, "plot")
    figures: dict[str, Figure] = {}
    groups = _group_runs(runs)
    with figure_style():
        for stem, group in zip(_name_files(groups), groups, strict=True):
            figures[stem] = _LAYOUTS[group.kind](group)
            if group.kind != "motion":
                figures[f"{stem}_checks"] = _draw_checks(group)
            figures[f"{stem}_snapshots"] = _draw_snapshots(group)
            figures |= {f"{stem}_{suffix}": figure for suffix, figure in _draw_small_panels(group).items()}
    return figures


def _group_runs(runs: Iterable[Run]) -> list[RunGroup]:
    """Group runs that share a figure: one kind of control, one mechanism, one choice of coordinates and motors."""
    members: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        controller = run.scene.get("controller")
        law = controller["type"] if controller else "torques"
        if run.scene.get("prescribed") and (law == "torques" or not run.independent):
            kind = "prescribed"
        elif law != "torques":
            kind = "servo" if law == "joint_servo" else str(law)
        else:
            kind = "own" if np.any(run.tau) else "motion"
        members.setdefault((kind, run.mechanism.name, run.coordinates, run.independent, run.actuated), []).append(run)
    groups = []
    for (kind, *_), group_runs in members.items():
        ordered = style.sort_for_drawing(group_runs)
        groups.append(
            RunGroup(kind, ordered, [run.desired_path if "controller" in run.scene else None for run in ordered])
        )
    return groups


def _name_files(groups: Sequence[RunGroup]) -> list[str]:
    """Return distinct file names: the kind of control, if needed with the mechanism's name and a number."""
    stems = [group.kind for group in groups]
    if len(set(stems)) < len(stems):
        names = ["".join(c if c.isalnum() or c in "-_" else "_" for c in group.mechanism.name) for group in groups]
        stems = [f"{name}_{stem}" for name, stem in zip(names, stems, strict=True)]
    if len(set(stems)) < len(stems):
        stems = [f"{stem}_{k}" for k, stem in enumerate(stems, 1)]
    return stems


# --- layouts -------------------------------------------------------------------------------------


def _draw_set_point(group: RunGroup) -> Figure:
    """Draw the paper's Fig. 3: a) configurations, b) torques, c) errors, d) velocities."""
    slots = _create_page(group, ["configurations", _efforts_title(group), "errors", "velocities"])
    panels.draw_initial_and_desired(slots[0], group, projection_planes(group.mechanism)[0])
    panels.draw_efforts(slots[1], group, group.runs[0].actuated, _describe_peaks(group))
    panels.draw_errors(slots[2], group, group.independent)
    panels.draw_rates(slots[3], group, group.independent)
    handles = [legend_line(panels.INITIAL_COLOUR, "initial"), legend_line(panels.TARGET_COLOUR, "desired")]
    fit_legend(slots[0].figure.axes[0], handles)
    _add_legend(slots[0].figure, group)
    return slots[0].figure


def _draw_tracking(group: RunGroup) -> Figure:
    """Draw the paper's Fig. 4: a) configuration space, b) torques, c) angles, d) velocities.

    With more than two freedoms panel a shows errors, or the energy if there is no desired motion.
    """
    d = len(group.independent)
    if d <= 2:
        first_title = "phase plane" if d == 1 else "configuration space"
    else:
        first_title = "errors" if group.distinct_desired else "energy"
    slots = _create_page(group, [first_title, _efforts_title(group), "coordinates", "velocities"])
    if d <= 2:
        panels.draw_configuration_space(slots[0], group)
    elif group.distinct_desired:
        panels.draw_errors(slots[0], group, group.independent)
    else:
        panels.draw_scalar(slots[0], group, lambda run: run.energy, axis_label("$E$", "J"))
    panels.draw_efforts(slots[1], group, group.runs[0].actuated, _describe_peaks(group))
    panels.draw_coordinates(slots[2], group, group.independent)
    panels.draw_rates(slots[3], group, group.independent)
    desired_dot = legend_line("black", "desired", linestyle="none", marker=".", markersize=4)
    _add_legend(slots[0].figure, group, extra_handles=[desired_dot] if group.distinct_desired else [])
    return slots[0].figure


def _draw_prescribed(group: RunGroup) -> Figure:
    """Draw a motion with prescribed joints: coordinates, rates, torques, energy."""
    names = _list_panel_coordinates(group)
    slots = _create_page(group, ["coordinates", "velocities", _efforts_title(group), "energy"])
    panels.draw_coordinates(slots[0], group, names)
    panels.draw_rates(slots[1], group, names)
    panels.draw_efforts(slots[2], group, group.runs[0].actuated, _describe_peaks(group))
    panels.draw_scalar(slots[3], group, lambda run: run.energy, axis_label("$E$", "J"))
    _add_legend(slots[0].figure, group, list(dict.fromkeys([*names, *group.runs[0].actuated])))
    return slots[0].figure


def _draw_motion(group: RunGroup) -> Figure:
    """Draw a motion without control: coordinates, rates, change of energy, closure residual."""
    names = _list_panel_coordinates(group)
    is_smooth = group.mechanism.joints.has_smooth_friction(group.runs[0].scene.get("friction_smoothing"))
    is_damped = group.mechanism.springs.any_damping or group.runs[0].dissipated is not None or is_smooth
    energy_title = f"energy {'change' if is_damped else 'drift'}"
    slots = _create_page(group, ["coordinates", "velocities", energy_title, "closure residual"])
    panels.draw_coordinates(slots[0], group, names)
    panels.draw_rates(slots[1], group, names)
    drift = max(float(np.abs(run.energy - run.energy[0]).max()) for run in group.runs)
    power = math.floor(math.log10(drift)) if drift > 0 else 0
    unit = rf"$10^{{{power}}}$ J" if power else "J"
    panels.draw_scalar(slots[2], group, lambda run: (run.energy - run.energy[0]) / 10.0**power,
                       axis_label("$E - E(0)$", unit), clip=False)  # fmt: skip
    _draw_residual(slots[3], group)
    _add_legend(slots[0].figure, group, names, by_run=True)
    return slots[0].figure


def _draw_checks(group: RunGroup) -> Figure:
    """Draw what shows whether to trust a run: closure residual, loop forces, energy, Lyapunov function."""
    has_lyapunov = any(run.lyapunov is not None for run in group.runs)
    titles = ["closure residual", "loop forces", "energy"] + ["Lyapunov function"] * has_lyapunov
    slots = _create_page(group, titles)
    _draw_residual(slots[0], group)
    panels.draw_loop_forces(slots[1], group)
    panels.draw_scalar(slots[2], group, lambda run: run.energy, axis_label("$E$", "J"))
    if has_lyapunov:
        _set_log_scale(panels.draw_scalar(slots[3], group, _compute_lyapunov, axis_label("$V$", "J"), clip=False))
    _add_legend(slots[0].figure, group, [], by_run=True)
    return slots[0].figure


def _draw_snapshots(group: RunGroup) -> Figure:
    """Draw poses at equal time intervals; for motions without control, which have no checks, also loop forces."""
    planes = projection_planes(group.mechanism)
    titles = [plane.title or "snapshots" for plane in planes] + ["loop forces"] * (group.kind == "motion")
    size = (3.6, 3.3) if len(titles) == 1 else (PANEL_SIZE_IN[0], 2.3)
    subtitle = f"snapshots of {group.labels[0]}" if len(group.runs) > 1 else ""
    slots = _create_page(group, titles, size, subtitle)
    figure = slots[0].figure
    mappable = panels.draw_snapshots(slots[: len(planes)], group, planes)
    bar_axes = figure.axes[: len(planes)] if len(planes) == 1 else [figure.axes[-1]]
    if group.kind == "motion":
        panels.draw_loop_forces(slots[-1], group)
        bar_axes = figure.axes[:1]
    figure.colorbar(mappable, ax=bar_axes, label=axis_label("$t$", "s"), shrink=0.85, aspect=30)
    if group.kind == "motion":
        _add_legend(figure, group, [])
    return figure


def _draw_small_panels(group: RunGroup) -> dict[str, Figure]:
    """Draw a small panel for each coordinate and each motor, if there are more of them than colours."""
    from matplotlib import rc_context

    coordinates = group.runs[0].coordinates if group.draws_all_coordinates else group.independent
    motors = group.runs[0].actuated if group.kind != "motion" else ()
    kinds: dict[str, tuple[Sequence[str], Callable[[PanelSlot, RunGroup, Sequence[str]], None]]] = {
        "coordinates": (coordinates, panels.draw_coordinates),
        "efforts": (motors, panels.draw_efforts),
    }
    figures = {}
    for kind, (names, draw_panel) in kinds.items():
        if len(names) <= style.MAX_COLOURS:
            continue
        columns = 3 if len(names) <= 2 * MAX_PANEL_COORDINATES else 4
        max_letters = int(13 * style.WIDTH_IN / columns)
        titles = [name if len(name) <= max_letters else f"{name[: max_letters - 8]}…{name[-7:]}" for name in names]
        plain_group = group.with_one_colour()
        with rc_context({"axes.titlesize": style.NOTE_SIZE_PT, "axes.titlelocation": "right"}):
            size = (style.WIDTH_IN / columns, SMALL_PANEL_HEIGHT_IN)
            slots = _create_page(group, [coordinate_symbol(title) for title in titles], size, kind)
            for slot, name in zip(slots, names, strict=True):
                draw_panel(slot, plain_group, [name])
                unit = slot.figure.axes[-1].get_ylabel().rpartition("(")[2]
                slot.figure.axes[-1].set_ylabel(f"({unit}")  # The title has the name.
        _simplify_axes(slots[0].figure, columns)
        _add_legend(slots[0].figure, group, [])
        figures[kind] = slots[0].figure
    return figures


_LAYOUTS = {
    "set_point": _draw_set_point,
    "tracking": _draw_tracking,
    "servo": _draw_tracking,
    "prescribed": _draw_prescribed,
    "own": _draw_tracking,
    "motion": _draw_motion,
}


# --- parts ---------------------------------------------------------------------------------------


def _create_page(
    group: RunGroup, titles: Sequence[str], size: tuple[float, float] = PANEL_SIZE_IN, subtitle: str = ""
) -> list[PanelSlot]:
    scene = group.runs[0].scene_name
    parts = [subtitle, escape_mathtext(scene) if "/" in scene else "", PAPER_FIGURES.get(scene, ""),
             group.labels[0] if len(group.runs) == 1 else ""]  # fmt: skip
    columns = round(style.WIDTH_IN / size[0]) if len(titles) > 1 else 1
    title = f"{escape_mathtext(group.mechanism.name)}: {TITLES[group.kind]}"
    coordinates = [name for name in group.curve_names if name in group.runs[0].coordinates]
    if size == PANEL_SIZE_IN and len({panels.coordinate_unit(group, name) for name in coordinates}) > 1:
        size = (PANEL_SIZE_IN[0], PANEL_SIZE_IN[1] + SECOND_UNIT_HEIGHT_IN)
    return create_page(title, ", ".join(filter(None, parts)), titles, columns, size)


def _simplify_axes(figure: Figure, columns: int) -> None:
    """Label the time of small panels in the lowest row only, show few numbers, and do not magnify rounding errors."""
    spans: dict[str, float] = {}
    for ax in figure.axes:
        low, high = ax.get_ylim()
        spans[ax.get_ylabel()] = max(spans.get(ax.get_ylabel(), 0.0), high - low)
    for k, ax in enumerate(figure.axes):
        ax.locator_params(axis="x", nbins=3)
        (low, high), min_span = ax.get_ylim(), MIN_SPAN_RATIO * spans[ax.get_ylabel()]
        if high - low < min_span and ax.get_autoscaley_on():  # A clipped axis is not autoscaled.
            ax.set_ylim(0.5 * (low + high - min_span), 0.5 * (low + high + min_span))
        if k + columns < len(figure.axes):
            ax.set_xlabel("")


def _list_panel_coordinates(group: RunGroup) -> tuple[str, ...]:
    """Return all coordinates for a panel, or the independent ones if there are too many and some are independent."""
    coordinates = group.runs[0].coordinates
    return coordinates if len(coordinates) <= MAX_PANEL_COORDINATES else group.independent or coordinates


def _efforts_title(group: RunGroup) -> str:
    units = set(motor_units(group.mechanism))
    return "torques and forces" if len(units) > 1 else "forces" if units == {"N"} else "torques"


def _describe_peaks(group: RunGroup) -> str:
    """Return a note with the largest efforts; for the paper's tracking scene also with the paper's values."""
    peaks: dict[str, float] = {}
    for k, unit in enumerate(motor_units(group.mechanism)):
        peaks[unit] = max(peaks.get(unit, 0.0), *(float(np.abs(run.tau[:, k]).max()) for run in group.runs))
    name = panels.effort_symbol(group)
    note = f"max $|{name}|$ = {', '.join(f'{peak:.3g} {unit}' for unit, peak in peaks.items())}"
    steady = [run.tau[run.t >= PAPER_STEADY_START] for run in group.runs if run.t[-1] > PAPER_STEADY_START]
    if steady and all(run.scene_name == "five_bar/tracking" for run in group.runs):
        steady_peak = max(float(np.abs(tau).max(initial=0.0)) for tau in steady)
        return f"{note} (paper: ≤ 30)\nafter {PAPER_STEADY_START:.0f} s {steady_peak:.3g} N m (paper: ≤ 5)"
    return note


def _draw_residual(slot: PanelSlot, group: RunGroup) -> None:
    def compute_residual(run: Run) -> Array:
        residual = np.abs(run.phi - run.w).max(axis=1, initial=0.0)
        return np.where(residual > 0, residual, np.nan)  # A logarithmic axis has no zero.

    name = axis_label(r"max $|\varphi - w|$", joined(row_units(group.mechanism)) or "m")
    _set_log_scale(panels.draw_scalar(slot, group, compute_residual, name, dots=True, clip=False))


def _set_log_scale(ax: Any) -> None:
    if any(np.any(np.isfinite(line.get_ydata())) for line in ax.get_lines()):
        ax.set_yscale("log")
    else:
        ax.set_ylim(-1.0, 1.0)
        ax.text(0.5, 0.5, "zero throughout", ha="center", va="center", transform=ax.transAxes, color=style.GREY)


def _compute_lyapunov(run: Run) -> Array:
    if run.lyapunov is None:
        return np.full(len(run.t), np.nan)
    floor = LYAPUNOV_ROUNDING * float(np.abs(run.lyapunov).max(initial=0.0))
    return np.where(run.lyapunov > floor, run.lyapunov, np.nan)


def _add_legend(
    figure: Figure,
    group: RunGroup,
    names: Sequence[str] | None = None,
    extra_handles: Sequence[Any] = (),
    by_run: bool = False,
) -> None:
    """Add one legend below all panels: colours of coordinates, then line styles of runs.

    A single coordinate is named on its axes, and a single run in the subtitle. With `by_run` some panels have a
    colour for each run.
    """
    names = group.curve_names if names is None else names
    coloured = [name for name in names if group.colours[name] != style.REST_COLOUR]
    handles = []
    if len(names) > 1:
        handles += [legend_line(group.colours[name], coordinate_symbol(name)) for name in coloured]
    if len(coloured) < len(names):
        handles.append(legend_line(style.REST_COLOUR, f"{len(names) - len(coloured)} more"))
    handles += extra_handles
    if len(group.runs) > 1:
        for k, (label, line_style) in enumerate(zip(group.labels, group.line_styles, strict=True)):
            colour = style.COLOURS[k % len(style.COLOURS)] if by_run else "black"
            handles.append(legend_line(colour, label, **line_style))
    fit_legend(figure, handles)
