"""Figures of inverse dynamics, exciting and planned motions, sensitivities, and work-precision comparisons."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.identification.excitation import Excitation
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.units import joined, motor_units
from ckc_pin.optimization.plan import Plan
from ckc_pin.run.columns import derivative_unit, key_unit
from ckc_pin.run.motion_forces import MotionForces
from ckc_pin.sensitivity.sensitivities import Sensitivities
from ckc_pin.view import style
from ckc_pin.view.layout import PanelSlot, add_note, create_page, fit_legend, legend_line, write_figure
from ckc_pin.view.style import axis_label, coordinate_symbol, escape_mathtext, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_excitation", "draw_motion_forces", "draw_plan", "draw_precision", "draw_sensitivities",
           "save_motion_forces", "save_precision", "save_sensitivities"]  # fmt: skip

MAX_NOTE_MOTORS = 3  # named in a note; longer notes exceed the panel
MAX_EXCITATION_ROWS = 1000
MAX_PARAMETERS = 6  # panels of a figure of sensitivities
MAX_LEGEND_CURVES = 12  # of a figure of sensitivities
MIN_ERROR = 1e-16  # smaller errors are drawn there, because zero has no logarithm
METHOD_MARKERS = {"auto": "o", "DOP853": "s", "RK45": "^", "Radau": "D"}
FORMULATIONS = ("dae", "reduced", "spf, w", "spf, z")  # in the order of colours


# --- inverse dynamics ----------------------------------------------------------------------------


def save_motion_forces(forces: MotionForces, folder: Path) -> list[Path]:
    """Draw motor efforts and loop forces along a motion and write the figure as inverse.png.

    Raises
    ------
    InputError
        The folder cannot be written; matplotlib is not installed.
    """
    return write_figure(draw_motion_forces(forces), folder, "inverse", ("png",))


def draw_motion_forces(forces: MotionForces) -> Figure:
    """Return the figure of motor efforts over time, with norms of the loop forces below.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    with figure_style():
        units = motor_units(forces.mechanism)
        title = f"{escape_mathtext(forces.name)}: forces required by the motion"
        panel_titles = ["motors", "forces transmitted by the loops"]
        effort_slot, loop_slot = create_page(title, "", panel_titles, 1, (style.WIDTH_IN, 2.4))
        motors_by_unit = {unit: [k for k, other in enumerate(units) if other == unit] for unit in dict.fromkeys(units)}
        _draw_efforts(effort_slot.add_axes(len(motors_by_unit)), forces, motors_by_unit)
        _draw_loop_forces(loop_slot.add_axes()[0], forces)
        return effort_slot.figure


def _draw_efforts(axes: list[Any], forces: MotionForces, motors_by_unit: dict[str, list[int]]) -> None:
    largest = dict(zip(forces.actuated, np.abs(forces.tau).max(axis=0), strict=True))
    named = style.select_largest(largest)
    colours = style.assign_colours(named)
    exceeded = {entry["motor"]: entry for entry in forces.exceeded}
    for ax, (unit, motors) in zip(axes, motors_by_unit.items(), strict=True):
        for k in sorted(motors, key=lambda k: forces.actuated[k] in named):  # grey curves behind coloured ones
            motor = forces.actuated[k]
            ax.plot(forces.t, forces.tau[:, k], color=colours.get(motor, style.REST_COLOUR))
            if motor in exceeded:  # Limits that are not exceeded would flatten the curves.
                for sign, limit in zip((-1, 1), forces.limit[:, k], strict=True):
                    if np.any(sign * forces.tau[:, k] > sign * limit):
                        colour = colours.get(motor, style.GREY)
                        ax.axhline(limit, color=colour, linestyle="--", linewidth=0.9)
        ax.set_ylabel(axis_label(r"$\tau$", unit))
    if exceeded:
        is_short = len(exceeded) <= MAX_NOTE_MOTORS
        listed = ", ".join(map(coordinate_symbol, exceeded)) if is_short else f"{len(exceeded)} of them"
        add_note(axes[0], f"beyond their limits (dashed): {listed}")
    _finish_axes(axes[-1], {coordinate_symbol(motor): colours[motor] for motor in named}, len(forces.actuated))


def _draw_loop_forces(ax: Any, forces: MotionForces) -> None:
    norms = {loop: np.linalg.norm(wrench[:, :3], axis=1) for loop, wrench in forces.loop_wrenches.items()}
    named = style.select_largest({loop: float(norm.max(initial=0.0)) for loop, norm in norms.items()})
    colours = style.assign_colours(named)
    for loop in sorted(norms, key=lambda loop: loop in named):
        ax.plot(forces.t, norms[loop], color=colours.get(loop, style.REST_COLOUR))
    ax.set_ylabel(axis_label("force", "N"))
    _finish_axes(ax, {escape_mathtext(loop): colours[loop] for loop in named}, len(norms))


def _finish_axes(ax: Any, named_colours: dict[str, str], count: int) -> None:
    """Label the time axis and add a legend for the named curves of `count` curves."""
    ax.set_xlabel(axis_label("$t$", "s"))
    handles = [legend_line(colour, name) for name, colour in named_colours.items()]
    if count > len(named_colours):
        handles.append(legend_line(style.REST_COLOUR, f"{count - len(named_colours)} more"))
    if handles:
        fit_legend(ax, handles)


# --- excitation and plans ------------------------------------------------------------------------


def draw_excitation(excitation: Excitation) -> Figure:
    """Return the figure of run-in and period: independent coordinates, and motor torques with their limits below.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    mechanism = excitation.mechanism
    t = excitation.sample_times(MAX_EXCITATION_ROWS / (excitation.run_in + excitation.period))
    columns = excitation.quantities(t)
    bounds = dict(zip(excitation.limits.names, zip(excitation.limits.lower, excitation.limits.upper, strict=True),
                      strict=True))  # fmt: skip
    with figure_style():
        title = f"{escape_mathtext(mechanism.name)}: condition number {excitation.condition:.3g}"
        best = f"best of {excitation.random.count} random motions: {excitation.random.condition[0]:.3g}; dashed: limits"
        slots = create_page(title, best, ["motion", "motors"], 1, (style.WIDTH_IN, 2.4))
        _draw_coordinates_and_motors(slots, mechanism, t, columns, bounds)
        return slots[0].figure


def draw_plan(plan: Plan) -> Figure:
    """Return the figure of a plan: independent coordinates, motor torques with their limits, and margin to singularity.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    mechanism, t = plan.mechanism, plan.t
    bounds = dict(zip(plan.limits.names, zip(*plan.limits.bounds(), strict=True), strict=True))
    with figure_style():
        title = f"{escape_mathtext(mechanism.name)}: planned motion of {plan.t_end:.4g} s"
        titles = ["motion", "motors", "distance from singularities"]
        slots = create_page(title, "dashed: limits", titles, 1, (style.WIDTH_IN, 2.4))
        _draw_coordinates_and_motors(slots[:2], mechanism, t, plan.columns(), bounds)
        ax = slots[2].add_axes()[0]
        limit = plan.limits.singularity or -np.inf
        _draw_between(ax, t, plan.margin, (limit, np.inf), style.COLOURS[0])
        for crossing in plan.crossings:
            ax.axvline(crossing.t, color=style.COLOURS[1], lw=0.8, ls=":")
        ax.set_ylim(bottom=0.0)
        ax.set_ylabel(r"$\sigma_{\min}(\varphi_z)$ / start's")
        _finish_axes(ax, {}, 0)
        return slots[0].figure


def _draw_coordinates_and_motors(
    slots: Sequence[PanelSlot], mechanism: Mechanism, t: Array, columns: Mapping[str, Array],
    bounds: Mapping[str, tuple[float, float]],
) -> None:  # fmt: skip
    """Draw the independent coordinates and the motor torques, with their limits, into two slots."""
    coordinate_units = dict(zip(mechanism.coordinates, mechanism.tree.units(), strict=True))
    panels = ((mechanism.independent, "", "$q$", [coordinate_units[name] for name in mechanism.independent]),
              (mechanism.motors.names, "tau.", r"$\tau$", motor_units(mechanism)))  # fmt: skip
    for slot, (names, prefix, symbol, units) in zip(slots, panels, strict=True):
        named = style.select_largest({name: float(np.abs(columns[prefix + name]).max()) for name in names})
        colours = style.assign_colours(named)
        axes = slot.add_axes(len(set(units)))
        for ax, unit in zip(axes, dict.fromkeys(units), strict=True):
            for name in (name for name, other in zip(names, units, strict=True) if other == unit):
                _draw_between(ax, t, columns[prefix + name], bounds[prefix + name], colours.get(name))
            ax.set_ylabel(axis_label(symbol, unit))
        _finish_axes(axes[-1], {coordinate_symbol(name): colours[name] for name in named}, len(names))


def _draw_between(ax: Any, t: Array, curve: Array, limits: tuple[float, float], colour: str | None) -> None:
    ax.plot(t, curve, color=colour or style.REST_COLOUR)
    for limit in limits:
        if np.isfinite(limit):
            ax.axhline(limit, color=colour or style.GREY, linestyle="--", linewidth=0.9)


# --- sensitivities -------------------------------------------------------------------------------


def save_sensitivities(sensitivities: Sensitivities, folder: Path) -> list[Path]:
    """Draw sensitivities and write the figure as sensitivities.png.

    Raises
    ------
    InputError
        The folder cannot be written; matplotlib is not installed.
    """
    return write_figure(draw_sensitivities(sensitivities), folder, "sensitivities", ("png",))


def draw_sensitivities(sensitivities: Sensitivities) -> Figure:
    """Return the figure of sensitivities over time.

    It has a panel for each of the first six parameters, with a curve for each independent coordinate.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    run = sensitivities.run
    columns = [run.coordinates.index(name) for name in run.independent]
    parameters = sensitivities.parameters[:MAX_PARAMETERS]
    with figure_style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(style.WIDE_WIDTH_IN, 1.4 + 1.7 * len(parameters)), layout="constrained")
        axes = figure.subplots(len(parameters), 1, sharex=True, squeeze=False)[:, 0]
        count = len(sensitivities.parameters)
        omission = "" if len(parameters) == count else f", the first {len(parameters)} of {count} parameters"
        title = f"{escape_mathtext(run.scene_name)}: sensitivities{omission}"
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        colours = style.assign_colours(run.independent)
        for p, (ax, parameter) in enumerate(zip(axes, parameters, strict=True)):
            for name, k in zip(run.independent, columns, strict=True):
                ax.plot(sensitivities.t, sensitivities.q_tree[:, k, p], color=colours[name],
                        label=coordinate_symbol(name))  # fmt: skip
            ax.axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
            parameter_unit = key_unit(run.mechanism, parameter)
            unit = joined(derivative_unit(run.mechanism.tree.units()[k], parameter_unit) for k in columns)
            ax.set(title=f"by {escape_mathtext(parameter)}", ylabel=axis_label(r"$\partial q / \partial p$", unit))
        if len(run.independent) <= MAX_LEGEND_CURVES:
            fit_legend(figure, axes[0].get_legend_handles_labels()[0])
        axes[-1].set_xlabel(axis_label("$t$", "s"))
        return figure


# --- work-precision ------------------------------------------------------------------------------


def save_precision(comparison: Mapping[str, Any], folder: Path, stem: str) -> list[Path]:
    """Draw a work-precision comparison and write it as PNG.

    Parameters
    ----------
    comparison : mapping
        The JSON-ready data of a `WorkPrecision` with a reference.
    folder : Path
    stem : str
        The file's name without its suffix.

    Raises
    ------
    InputError
        The folder cannot be written; matplotlib is not installed.
    """
    return write_figure(draw_precision(comparison), folder, stem, ("png",))


def draw_precision(comparison: Mapping[str, Any]) -> Figure:
    """Return the figure of a work-precision comparison: error over run time, a line for each program and method.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    with figure_style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(style.WIDTH_IN, 4.6), layout="constrained")
        ax = figure.add_subplot()
        rows = [row for row in comparison["rows"] if row["error"] is not None]
        for name, family in _group_by_method(rows).items():
            points = [(1e3 * row["wall_s"], max(row["error"], MIN_ERROR)) for row in family]
            ax.plot(*zip(*points, strict=True), label=name, **_method_style(family[0]))
        accuracy = comparison["reference"]["accuracy"]
        low = max(MIN_ERROR, min((row["error"] for row in rows), default=accuracy))
        if low < 10 * accuracy:
            ax.axhspan(min(low, accuracy) / 2, 10 * accuracy, color=style.GREY, alpha=0.15, linewidth=0)
            ax.text(0.01, 10 * accuracy, "the reference's own uncertainty", color=style.GREY, va="top",
                    transform=ax.get_yaxis_transform())  # fmt: skip
        ax.set(xscale="log", yscale="log", xlabel="time of a run (ms)", ylabel="largest error of q_tree and v_tree")
        scene = comparison["scene"].replace("$", r"\$")
        ax.set_title(f"{scene}, up to t = {comparison['reference']['t_end']:.4g} s")
        fit_legend(figure, ax.get_legend_handles_labels()[0], fontsize=style.NOTE_SIZE_PT)
        return figure


def _group_by_method(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    families: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["wall_s"] and math.isfinite(row["wall_s"]):
            families.setdefault(f"{row['formulation'] or row['program']}, {row['method']}", []).append(row)
    return families


def _method_style(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return line properties: colour by formulation, marker by method; MuJoCo is grey."""
    if row["formulation"] is None:
        is_dashed = row["method"].endswith("dt")
        is_rk4 = row["method"].startswith("RK4")
        dashes = (0, (4.0, 2.0)) if is_dashed else (0, (1.0, 1.5))
        return {"color": style.GREY, "marker": "+" if is_rk4 else "x", "linestyle": dashes, "linewidth": 1.2}
    colour = style.COLOURS[FORMULATIONS.index(row["formulation"])]
    linewidth = 1.6 if row["method"] == "auto" else 0.9
    return {"color": colour, "marker": METHOD_MARKERS.get(row["method"], "v"), "markersize": 4, "linewidth": linewidth}
