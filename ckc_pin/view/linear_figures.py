"""Figures of linear models: pole map, mode shapes, and the root locus over a gain."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.linear.linear_model import LinearModel
from ckc_pin.linear.locus import GainLocus
from ckc_pin.linear.modes import Mode, compute_eigenvalues, select_modes
from ckc_pin.view import style
from ckc_pin.view.layout import write_figure
from ckc_pin.view.style import coordinate_symbol, escape_mathtext, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_linear", "save_linear_figures"]

MAX_MODES = 8  # drawn
MIN_AMPLITUDE = 0.02  # of the largest in a mode; coordinates that move less are left out of a long list
MAX_COORDINATES = 16  # listed in full
LETTERS_PER_INCH = 13
SEPARATION_RATIO = 1e3  # largest to smallest eigenvalue: beyond it the axes are logarithmic
COINCIDENCE_TOLERANCE = 1e-3  # relative: poles this close are drawn as one
AMPLITUDE_LABEL = (
    "how far a coordinate is from rest, the one that swings most as 1 (angles in rad, lengths in the mechanism's size)"
)
GAIN_SYMBOLS = {"K_P": "$K_P$", "K_V": "$K_V$", "K_D": "$K_D$", "Lambda": r"$\Lambda$"}


def save_linear_figures(model: LinearModel, locus: GainLocus | None, folder: Path) -> list[Path]:
    """Draw a linear model and write it as poles.png, modes.png and, with a locus, locus.png.

    Raises
    ------
    InputError
        The folder cannot be written; matplotlib is not installed.
    """
    figures = draw_linear(model) | ({} if locus is None else draw_linear(locus))
    return [path for name, figure in figures.items() for path in write_figure(figure, folder, name, ("png",))]


def draw_linear(result: LinearModel | GainLocus) -> dict[str, Figure]:
    """Return the figures "poles" and "modes" of a linear model, or "locus" of a root locus.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    with figure_style():
        if isinstance(result, GainLocus):
            return {"locus": _draw_locus(result)}
        return {"poles": _draw_poles(result), "modes": _draw_modes(result)}


# --- poles ---------------------------------------------------------------------------------------


def _draw_poles(model: LinearModel) -> Figure:
    """Draw the poles of the plant, and of the closed loop if there is a controller."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.2, 5.2), layout="constrained")
    ax = figure.subplots()
    figure.suptitle(f"{escape_mathtext(model.name)}, {model.at}", x=0.01, ha="left", fontweight="bold")
    closed = np.zeros(0) if model.closed_loop is None else compute_eigenvalues(model.closed_loop)
    values = np.concatenate([model.eigenvalues, closed])
    _set_pole_axes(ax, values, values)
    ax.plot(model.eigenvalues.real, model.eigenvalues.imag, "x", color=style.COLOURS[0], label="plant", markersize=8)
    _count_coincident(ax, model.eigenvalues, style.COLOURS[0], above=True)
    if len(closed):
        ax.plot(closed.real, closed.imag, "o", color=style.COLOURS[1], fillstyle="none", label="closed loop")
        _count_coincident(ax, closed, style.COLOURS[1], above=False)
        ax.legend(loc="best", fontsize=8)
    return figure


def _draw_locus(locus: GainLocus) -> Figure:
    """Draw the eigenvalues of the closed loop over a gain, with circles at the gain of the scene."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.6, 5.2), layout="constrained")
    ax = figure.subplots()
    gain = GAIN_SYMBOLS[locus.gain]
    title = f"{escape_mathtext(locus.name)}, {locus.at}: root locus over {gain}"
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    values, factors = locus.eigenvalues, np.repeat(locus.factors, locus.eigenvalues.shape[1])
    scene_values = values[locus.scene_index]
    _set_pole_axes(ax, values, scene_values)
    dots = ax.scatter(values.real, values.imag, c=np.log10(factors), s=5, cmap="viridis")
    ax.plot(scene_values.real, scene_values.imag, "o", color=style.COLOURS[1], fillstyle="none")
    _count_coincident(ax, scene_values, style.COLOURS[1], above=True)
    bar = figure.colorbar(dots, ax=ax, label=f"factor on {gain} (circles: 1)")
    bar.set_ticks([-2, -1, 0, 1], labels=["0.01", "0.1", "1", "10"])
    return figure


def _set_pole_axes(ax: Any, values: Any, main_values: Any) -> None:
    """Set axes that contain all eigenvalues, and shade the unstable half.

    The axes are logarithmic around zero if the largest of `main_values` would hide the smallest.
    """
    nonzero = np.abs(main_values)[np.abs(main_values) > 0.0]
    size = float(np.abs(values).max(initial=0.0)) or 1.0
    largest = float(nonzero.max(initial=0.0)) or 1.0
    threshold = 10.0 ** np.floor(np.log10(max(float(nonzero.min(initial=largest)), 1e-6 * largest)))
    low, high = min(float(values.real.min(initial=0.0)), 0.0), max(float(values.real.max(initial=0.0)), 0.0)
    # A lower bound of the height keeps rounding errors of real eigenvalues from showing.
    height = max(1.1 * float(np.abs(values.imag).max(initial=0.0)), 0.1 * size)
    if largest > SEPARATION_RATIO * threshold:
        for axis in ("x", "y"):
            set_scale = getattr(ax, f"set_{axis}scale")
            set_scale("symlog", linthresh=threshold, linscale=np.log10(size / threshold) / 4)
        limits, height = (3 * low - threshold, 3 * high + threshold), 3 * height
    else:
        margin = 0.1 * (high - low) + 0.05 * size
        limits = (low - margin, high + margin)
    ax.set(xlabel="real part (1/s)", ylabel="imaginary part (rad/s)", xlim=limits, ylim=(-height, height))
    ax.axvspan(0.0, limits[1], color=style.COLOURS[1], alpha=0.08, linewidth=0)
    ax.axhline(0.0, color=style.GREY, linewidth=0.8)


def _count_coincident(ax: Any, values: Any, colour: str, *, above: bool) -> None:
    """Annotate poles that coincide with their number."""
    remaining = list(values)
    while remaining:
        first = remaining[0]
        tolerance = COINCIDENCE_TOLERANCE * abs(first)
        coincident = [x for x in remaining if abs(x - first) <= tolerance]
        if len(coincident) > 1:
            ax.annotate(f"×{len(coincident)}", (first.real, first.imag), (6, 6 if above else -12), color=colour,
                        textcoords="offset points", fontsize=8)  # fmt: skip
        remaining = [x for x in remaining if abs(x - first) > tolerance]


# --- modes ---------------------------------------------------------------------------------------


def _draw_modes(model: LinearModel) -> Figure:
    """Draw a panel for each mode: the amplitude of each coordinate, and a quarter of a period later."""
    from matplotlib.figure import Figure

    rigid_count = sum(not mode.eigenvalue for mode in model.modes)
    is_all_rigid = rigid_count == len(model.modes)
    shown = [k for k in select_modes(model.modes, MAX_MODES) if model.modes[k].eigenvalue or is_all_rigid]
    rows = _select_coordinates(model, [model.modes[k] for k in shown])
    width = max(1.2 + 2.1 * len(shown), 4.6)
    figure = Figure(figsize=(width, 1.5 + 0.24 * len(rows)), layout="constrained")
    panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    title = f"{escape_mathtext(model.name)}, {model.at}: modes"
    hidden_rigid = 0 if is_all_rigid else rigid_count
    hidden = {"rigid": hidden_rigid, "more": len(model.modes) - len(shown) - hidden_rigid}
    if any(hidden.values()):
        title += f"; {' and '.join(f'{count} {kind}' for kind, count in hidden.items() if count)} not shown"
    figure.suptitle(fill(title, int(LETTERS_PER_INCH * width)), x=0.01, ha="left", fontweight="bold")
    for ax, k in zip(panels, shown, strict=True):
        _draw_mode(ax, model, model.modes[k], rows, k + 1)
    panels[0].set_yticks(range(len(rows)), [coordinate_symbol(model.coordinates[k]) for k in rows])
    panels[0].invert_yaxis()
    figure.supxlabel(fill(AMPLITUDE_LABEL, int(LETTERS_PER_INCH * width)), fontsize="medium")
    bars_by_phase = {bars.get_label(): bars for ax in panels for bars in ax.containers}
    if len(bars_by_phase) > 1:
        figure.legend(bars_by_phase.values(), bars_by_phase.keys(), loc="outside upper right", ncols=2)
    return figure


def _select_coordinates(model: LinearModel, modes: list[Mode]) -> list[int]:
    """Return the indices of coordinates that move in some mode; all of them if they are few."""
    if len(model.coordinates) <= MAX_COORDINATES:
        return list(range(len(model.coordinates)))
    amplitudes = np.max([np.abs(mode.shape / model.mechanism.tree.step_scale) for mode in modes], axis=0)
    return [int(k) for k in np.flatnonzero(amplitudes >= MIN_AMPLITUDE)]


def _draw_mode(ax: Any, model: LinearModel, mode: Mode, rows: list[int], number: int) -> None:
    shape = (mode.shape / model.mechanism.tree.step_scale)[rows]
    ax.barh(range(len(rows)), shape.real, color=style.COLOURS[0], height=0.6, label="at one instant")
    if np.abs(shape.imag).max(initial=0.0) > MIN_AMPLITUDE:  # The later bars are Re(shape exp(i pi / 2)).
        ax.barh(range(len(rows)), -shape.imag, color=style.COLOURS[1], height=0.25, label="a quarter of a period later")
    ax.axvline(0.0, color=style.GREY, linewidth=0.8)
    ax.set(title=f"{number}: {mode.description}".replace(", ", "\n"), xlim=(-1.1, 1.1))
