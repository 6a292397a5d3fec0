"""Linear models as figures: the map of their poles, the shapes of their modes, the root locus over a gain."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.simulation.linear_model import LinearModel, Mode
from ckc_pin.simulation.locus import GainLocus
from ckc_pin.view import style
from ckc_pin.view.canvas import look, write
from ckc_pin.view.labels import plain, symbol

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_locus", "draw_modes", "draw_poles", "save_linear_figures"]

MOST = 8  # modes drawn
LEAST = 0.02  # of the largest part of a shape: coordinates that move less are left out of a long list
LONG = 16  # coordinates


def save_linear_figures(model: LinearModel, locus: GainLocus | None, folder: Path) -> list[Path]:
    """Draw a linear model and write it as poles.png, modes.png and, with a locus, locus.png.

    Raises
    ------
    InputError
        A folder that cannot be written, matplotlib missing.
    """
    paths = write(draw_poles(model), folder, "poles", ("png",)) + write(draw_modes(model), folder, "modes", ("png",))
    return paths if locus is None else paths + write(draw_locus(locus), folder, "locus", ("png",))


def draw_poles(model: LinearModel) -> Figure:
    """Return the map of poles: the plant's, and the closed loop's where there is one."""
    with look():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.2, 5.2), layout="constrained")
        ax = figure.subplots()
        figure.suptitle(f"{plain(model.name)}, {model.at}", x=0.01, ha="left", fontweight="bold")
        closed = np.zeros(0) if model.closed_loop is None else np.linalg.eigvals(model.closed_loop)
        _plane(ax, np.concatenate([model.eigenvalues, closed]))
        ax.plot(
            model.eigenvalues.real, model.eigenvalues.imag, "x", color=style.COLOURS[0], label="plant", markersize=8
        )
        if len(closed):
            ax.plot(closed.real, closed.imag, "o", color=style.COLOURS[1], fillstyle="none", label="closed loop")
            ax.legend(loc="best", fontsize=8)
        return figure


def draw_modes(model: LinearModel) -> Figure:
    """Return the shapes of modes, a panel each: how far coordinates swing, and in which phase."""
    with look():
        from matplotlib.figure import Figure

        modes = model.modes[:MOST]
        names = _moving(model, modes)
        figure = Figure(figsize=(1.2 + 2.1 * len(modes), 1.3 + 0.24 * len(names)), layout="constrained")
        panels = figure.subplots(1, len(modes), sharey=True, squeeze=False)[0]
        figure.suptitle(f"{plain(model.name)}, {model.at}: modes", x=0.01, ha="left", fontweight="bold")
        for ax, mode, number in zip(panels, modes, range(1, len(modes) + 1), strict=True):
            _shape(ax, model, mode, names, number)
        panels[0].set_yticks(range(len(names)), [symbol(model.coordinates[k]) for k in names])
        panels[0].invert_yaxis()
        figure.supxlabel("how far a coordinate is from rest, the one that swings most as 1 "
                         "(angles in rad, lengths in the mechanism's size)", fontsize="medium")  # fmt: skip
        phases = {bars.get_label(): bars for ax in panels for bars in ax.containers}
        if len(phases) > 1:
            figure.legend(phases.values(), phases.keys(), loc="outside upper right", ncols=2)
        return figure


def _moving(model: LinearModel, modes: tuple[Mode, ...]) -> list[int]:
    """Coordinates that move in some mode; all where they are few."""
    if len(model.coordinates) <= LONG:
        return list(range(len(model.coordinates)))
    most = np.max([np.abs(mode.shape / model.mechanism.tree.reach) for mode in modes], axis=0)
    return [int(k) for k in np.flatnonzero(most >= LEAST)]


def _shape(ax: Any, model: LinearModel, mode: Mode, names: list[int], number: int) -> None:
    shape = (mode.shape / model.mechanism.tree.reach)[names]
    ax.barh(range(len(names)), shape.real, color=style.COLOURS[0], height=0.6, label="at one instant")
    if np.abs(shape.imag).max(initial=0.0) > LEAST:  # Re(shape exp(i pi / 2))
        ax.barh(
            range(len(names)), -shape.imag, color=style.COLOURS[1], height=0.25, label="a quarter of a period later"
        )
    ax.axvline(0.0, color=style.GREY, linewidth=0.8)
    ax.set(title=f"{number}: {mode.says}".replace(", ", "\n"), xlim=(-1.1, 1.1))


def draw_locus(locus: GainLocus) -> Figure:
    """Return the root locus: eigenvalues of the closed loop as one gain grows, the scene's own marked."""
    with look():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.6, 5.2), layout="constrained")
        ax = figure.subplots()
        gain = {"K_P": "$K_P$", "K_D": "$K_D$"}[locus.gain]
        figure.suptitle(f"{plain(locus.name)}: root locus over {gain}", x=0.01, ha="left", fontweight="bold")
        values, factors = locus.eigenvalues, np.repeat(locus.factors, locus.eigenvalues.shape[1])
        own = int(np.argmin(np.abs(np.log(locus.factors))))
        _plane(ax, values)
        dots = ax.scatter(values.real, values.imag, c=np.log10(factors), s=5, cmap="viridis")
        ax.plot(values[own].real, values[own].imag, "o", color=style.COLOURS[1], fillstyle="none")
        bar = figure.colorbar(dots, ax=ax, label=f"factor on {gain} (circles: 1)")
        bar.set_ticks([-2, -1, 0, 1], labels=["0.01", "0.1", "1", "10"])
        return figure


def _plane(ax: Any, values: Any) -> None:
    """The plane of eigenvalues, all of them inside, unstable half shaded."""
    size = max(float(np.abs(values).max(initial=0.0)), 1e-9)
    low, high = min(float(values.real.min()), 0.0), max(float(values.real.max()), 0.0)
    margin = 0.1 * (high - low) + 0.05 * size
    ax.set(xlabel="real part (1/s)", ylabel="imaginary part (rad/s)", xlim=(low - margin, high + margin))
    ax.axvspan(0.0, high + margin, color=style.COLOURS[1], alpha=0.08, linewidth=0)
    ax.axhline(0.0, color=style.GREY, linewidth=0.8)
