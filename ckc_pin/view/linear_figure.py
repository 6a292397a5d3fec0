"""Linear models as figures: the map of their poles, the shapes of their modes, the root locus over a gain."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.linear.linear_model import LinearModel
from ckc_pin.linear.locus import GainLocus
from ckc_pin.linear.modes import Mode, compute_eigenvalues, select_modes
from ckc_pin.view import style
from ckc_pin.view.canvas import look, write
from ckc_pin.view.labels import plain, symbol

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_linear", "save_linear_figures"]

MOST = 8  # modes drawn
LEAST = 0.02  # of the largest part of a shape: coordinates that move less are left out of a long list
LONG = 16  # coordinates
LETTERS = 13  # of a line of small letters, in an inch
APART = 1e3  # times larger than the others are poles that would hide them: then axes are logarithmic
ALIKE = 1e-3  # of their size: poles so near to each other are drawn as one
SCALE = (
    "how far a coordinate is from rest, the one that swings most as 1 (angles in rad, lengths in the mechanism's size)"
)
GAINS = {"K_P": "$K_P$", "K_V": "$K_V$", "K_D": "$K_D$", "Lambda": r"$\Lambda$"}


def save_linear_figures(model: LinearModel, locus: GainLocus | None, folder: Path) -> list[Path]:
    """Draw a linear model and write it as poles.png, modes.png and, with a locus, locus.png.

    Raises
    ------
    InputError
        A folder that cannot be written, matplotlib missing.
    """
    figures = draw_linear(model) | ({} if locus is None else draw_linear(locus))
    return [path for name, figure in figures.items() for path in write(figure, folder, name, ("png",))]


def draw_linear(shown: LinearModel | GainLocus) -> dict[str, Figure]:
    """Return the figures of a linear model, poles and modes, or that of a locus, by name.

    Raises
    ------
    InputError
        matplotlib is missing.
    """
    with look():
        if isinstance(shown, GainLocus):
            return {"locus": _locus(shown)}
        return {"poles": _poles(shown), "modes": _modes(shown)}


def _poles(model: LinearModel) -> Figure:
    """The plant's, and the closed loop's where there is one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.2, 5.2), layout="constrained")
    ax = figure.subplots()
    figure.suptitle(f"{plain(model.name)}, {model.at}", x=0.01, ha="left", fontweight="bold")
    closed = np.zeros(0) if model.closed_loop is None else compute_eigenvalues(model.closed_loop)
    values = np.concatenate([model.eigenvalues, closed])
    _plane(ax, values, values)
    ax.plot(model.eigenvalues.real, model.eigenvalues.imag, "x", color=style.COLOURS[0], label="plant", markersize=8)
    _count(ax, model.eigenvalues, style.COLOURS[0], above=True)
    if len(closed):
        ax.plot(closed.real, closed.imag, "o", color=style.COLOURS[1], fillstyle="none", label="closed loop")
        _count(ax, closed, style.COLOURS[1], above=False)
        ax.legend(loc="best", fontsize=8)
    return figure


def _modes(model: LinearModel) -> Figure:
    """A panel for each shape: how far coordinates swing, and in which phase."""
    from matplotlib.figure import Figure

    rigid = sum(not mode.eigenvalue for mode in model.modes)
    shown = [k for k in select_modes(model.modes, MOST) if model.modes[k].eigenvalue or rigid == len(model.modes)]
    names = _moving(model, [model.modes[k] for k in shown])
    wide = max(1.2 + 2.1 * len(shown), 4.6)
    figure = Figure(figsize=(wide, 1.5 + 0.24 * len(names)), layout="constrained")
    panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    title = f"{plain(model.name)}, {model.at}: modes"
    hidden = 0 if rigid == len(model.modes) else rigid
    more = {"rigid": hidden, "more": len(model.modes) - len(shown) - hidden}
    if any(more.values()):
        title += f"; {' and '.join(f'{k} {kind}' for kind, k in more.items() if k)} not shown"
    figure.suptitle(fill(title, int(LETTERS * wide)), x=0.01, ha="left", fontweight="bold")
    for ax, k in zip(panels, shown, strict=True):
        _shape(ax, model, model.modes[k], names, k + 1)
    panels[0].set_yticks(range(len(names)), [symbol(model.coordinates[k]) for k in names])
    panels[0].invert_yaxis()
    figure.supxlabel(fill(SCALE, int(LETTERS * wide)), fontsize="medium")
    phases = {bars.get_label(): bars for ax in panels for bars in ax.containers}
    if len(phases) > 1:
        figure.legend(phases.values(), phases.keys(), loc="outside upper right", ncols=2)
    return figure


def _moving(model: LinearModel, modes: list[Mode]) -> list[int]:
    """Coordinates that move in some mode; all where they are few."""
    if len(model.coordinates) <= LONG:
        return list(range(len(model.coordinates)))
    most = np.max([np.abs(mode.shape / model.mechanism.tree.step_scale) for mode in modes], axis=0)
    return [int(k) for k in np.flatnonzero(most >= LEAST)]


def _shape(ax: Any, model: LinearModel, mode: Mode, names: list[int], number: int) -> None:
    shape = (mode.shape / model.mechanism.tree.step_scale)[names]
    ax.barh(range(len(names)), shape.real, color=style.COLOURS[0], height=0.6, label="at one instant")
    if np.abs(shape.imag).max(initial=0.0) > LEAST:  # Re(shape exp(i pi / 2))
        ax.barh(
            range(len(names)), -shape.imag, color=style.COLOURS[1], height=0.25, label="a quarter of a period later"
        )
    ax.axvline(0.0, color=style.GREY, linewidth=0.8)
    ax.set(title=f"{number}: {mode.description}".replace(", ", "\n"), xlim=(-1.1, 1.1))


def _locus(locus: GainLocus) -> Figure:
    """Eigenvalues of the closed loop as one gain grows, the scene's own marked."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.6, 5.2), layout="constrained")
    ax = figure.subplots()
    gain = GAINS[locus.gain]
    figure.suptitle(f"{plain(locus.name)}, {locus.at}: root locus over {gain}", x=0.01, ha="left", fontweight="bold")
    values, factors = locus.eigenvalues, np.repeat(locus.factors, locus.eigenvalues.shape[1])
    own = values[locus.scene_index]
    _plane(ax, values, own)
    dots = ax.scatter(values.real, values.imag, c=np.log10(factors), s=5, cmap="viridis")
    ax.plot(own.real, own.imag, "o", color=style.COLOURS[1], fillstyle="none")
    _count(ax, own, style.COLOURS[1], above=True)
    bar = figure.colorbar(dots, ax=ax, label=f"factor on {gain} (circles: 1)")
    bar.set_ticks([-2, -1, 0, 1], labels=["0.01", "0.1", "1", "10"])
    return figure


def _plane(ax: Any, values: Any, foremost: Any) -> None:
    """The plane of eigenvalues, all of them inside, unstable half shaded; logarithmic where some would hide."""
    sizes = np.abs(foremost)[np.abs(foremost) > 0.0]
    size = float(np.abs(values).max(initial=0.0)) or 1.0
    most = float(sizes.max(initial=0.0)) or 1.0
    least = 10.0 ** np.floor(np.log10(max(float(sizes.min(initial=most)), 1e-6 * most)))
    low, high = min(float(values.real.min(initial=0.0)), 0.0), max(float(values.real.max(initial=0.0)), 0.0)
    tall = max(1.1 * float(np.abs(values.imag).max(initial=0.0)), 0.1 * size)  # never so near that rounding shows
    if most > APART * least:
        for axis in ("x", "y"):
            getattr(ax, f"set_{axis}scale")("symlog", linthresh=least, linscale=np.log10(size / least) / 4)
        limits, tall = (3 * low - least, 3 * high + least), 3 * tall
    else:
        margin = 0.1 * (high - low) + 0.05 * size
        limits = (low - margin, high + margin)
    ax.set(xlabel="real part (1/s)", ylabel="imaginary part (rad/s)", xlim=limits, ylim=(-tall, tall))
    ax.axvspan(0.0, limits[1], color=style.COLOURS[1], alpha=0.08, linewidth=0)
    ax.axhline(0.0, color=style.GREY, linewidth=0.8)


def _count(ax: Any, values: Any, colour: str, *, above: bool) -> None:
    """Say how many poles lie on each other."""
    left = list(values)
    while left:
        alike = [x for x in left if abs(x - left[0]) <= ALIKE * abs(left[0])]
        if len(alike) > 1:
            ax.annotate(f"×{len(alike)}", (left[0].real, left[0].imag), (6, 6 if above else -12), color=colour,
                        textcoords="offset points", fontsize=8)  # fmt: skip
        left = [x for x in left if abs(x - left[0]) > ALIKE * abs(left[0])]
