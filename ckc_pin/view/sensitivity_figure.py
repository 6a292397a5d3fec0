"""How a run changes with its parameters, along time, as a figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ckc_pin.mechanism.units import joined
from ckc_pin.run.units import key_unit, per
from ckc_pin.sensitivity.sensitivities import Sensitivities
from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, look, write
from ckc_pin.view.labels import plain, symbol, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_sensitivities", "save_sensitivities"]

PANELS = 6  # parameters; more would be too flat to read
NAMED = 12  # curves; more would hide what their legend names


def save_sensitivities(found: Sensitivities, folder: Path) -> list[Path]:
    """Draw how a run changes with its parameters and write it as sensitivities.png.

    Raises
    ------
    InputError
        A folder that cannot be written, matplotlib missing.
    """
    return write(draw_sensitivities(found), folder, "sensitivities", ("png",))


def draw_sensitivities(found: Sensitivities) -> Figure:
    """Return the figure: a panel for each of the first six parameters, a curve an independent coordinate.

    Raises
    ------
    InputError
        matplotlib is missing.
    """
    run = found.run
    at = [run.coordinates.index(name) for name in run.independent]
    shown = found.parameters[:PANELS]
    with look():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(style.WIDTH_BESIDE, 1.4 + 1.7 * len(shown)), layout="constrained")
        axes = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
        every = len(found.parameters)
        left_out = "" if len(shown) == every else f", the first {len(shown)} of {every} parameters"
        title = f"{plain(run.scene_name)}: how it changes{left_out}"
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        colours = style.colours(run.independent)
        for p, (ax, parameter) in enumerate(zip(axes, shown, strict=True)):
            for name, k in zip(run.independent, at, strict=True):
                ax.plot(found.t, found.q_tree[:, k, p], color=colours[name], label=symbol(name))
            ax.axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
            by = key_unit(run.mechanism, parameter)
            unit = joined(per(run.mechanism.tree.units()[k], by) for k in at)
            ax.set(title=f"by {plain(parameter)}", ylabel=with_unit(r"$\partial q / \partial p$", unit))
        if len(run.independent) <= NAMED:
            fit_legend(figure, axes[0].get_legend_handles_labels()[0])
        axes[-1].set_xlabel(with_unit("$t$", "s"))
        return figure
