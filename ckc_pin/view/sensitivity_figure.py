"""How a run changes with its parameters, along time, as a figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ckc_pin.mechanism.units import joined
from ckc_pin.simulation.sensitivities import Sensitivities
from ckc_pin.simulation.units import key_unit
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
    """Return the figure: a panel a parameter, the six that matter most, a curve an independent coordinate.

    Raises
    ------
    InputError
        matplotlib is missing.
    """
    run = found.run
    at = [run.coordinates.index(name) for name in run.independent]
    chosen = list(range(len(found.parameters)))
    if len(chosen) > PANELS:
        most = np.abs(found.q_tree[:, at]).max(axis=(0, 1))
        chosen = sorted(np.argsort(-most, kind="stable")[:PANELS].tolist())
    with look():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(style.WIDTH_BESIDE, 1.4 + 1.7 * len(chosen)), layout="constrained")
        axes = figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
        every = len(found.parameters)
        left_out = "" if len(chosen) == every else f", {len(chosen)} of {every} parameters"
        title = f"{plain(run.scene_name)}: how it changes{left_out}"
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        colours = style.colours(run.independent)
        for ax, p in zip(axes, chosen, strict=True):
            for name, k in zip(run.independent, at, strict=True):
                ax.plot(found.t, found.q_tree[:, k, p], color=colours[name], label=symbol(name))
            ax.axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
            unit = joined(_by(run.mechanism.tree.units()[k], key_unit(run.mechanism, found.parameters[p])) for k in at)
            ax.set(title=f"by {plain(found.parameters[p])}", ylabel=with_unit(r"$\partial q / \partial p$", unit))
        if len(run.independent) <= NAMED:
            fit_legend(figure, axes[0].get_legend_handles_labels()[0])
        axes[-1].set_xlabel(with_unit("$t$", "s"))
        return figure


def _by(unit: str, other: str) -> str:
    """Return the unit of a derivative."""
    return f"{unit}/({other})" if "/" in other or " " in other else f"{unit}/{other}" if other else unit
