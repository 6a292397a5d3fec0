"""What a motion asks for as a figure: efforts of the motors with their limits, and the forces of the loops."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.simulation.motion_forces import MotionForces
from ckc_pin.view import style
from ckc_pin.view.labels import effort_units, plain, symbol
from ckc_pin.view.map_figure import look, write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_inverse", "save_inverse"]

TITLED = 3  # motors; more would be longer than their panel
NAMED = 12  # curves; more would hide what their legend names


def save_inverse(found: MotionForces, folder: Path) -> list[Path]:
    """Draw what a motion asks for and write it as inverse.png.

    Raises
    ------
    InputError
        A folder that cannot be written, matplotlib missing.
    """
    return write(draw_inverse(found), folder, "inverse", ("png",))


def draw_inverse(found: MotionForces) -> Figure:
    """Return the figure: efforts over time, the sizes of loop forces below (InputError where matplotlib is missing)."""
    with look():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.4, 6.4), layout="constrained")
        efforts, loops = figure.subplots(2, 1, sharex=True)
        figure.suptitle(f"{plain(found.name)}: what the motion asks for", x=0.01, ha="left", fontweight="bold")
        _efforts(efforts, found)
        _loops(loops, found)
        loops.set_xlabel("t, s")
        return figure


def _efforts(ax: Any, found: MotionForces) -> None:
    colours = style.colours(found.actuated)
    beyond = {entry["motor"]: entry for entry in found.exceeded}
    for k, motor in enumerate(found.actuated):
        ax.plot(found.t, found.tau[:, k], color=colours[motor], label=symbol(motor))
        if motor in beyond:  # a limit that is far away would flatten the curves
            for side in (-1, 1):
                limit = beyond[motor]["limit"]
                if np.any(side * found.tau[:, k] > limit):
                    ax.axhline(side * limit, color=colours[motor], linestyle="--", linewidth=0.9)
    names = ", ".join(symbol(motor) for motor in beyond) if len(beyond) <= TITLED else f"{len(beyond)} of them"
    ax.set(
        title=f"motors, beyond their limits (dashed): {names}" if beyond else "motors",
        ylabel=rf"$\tau$, {effort_units(found.mechanism)}",
    )
    _legend(ax)


def _loops(ax: Any, found: MotionForces) -> None:
    colours = style.colours(list(found.loop_wrenches))
    for loop, wrench in found.loop_wrenches.items():
        ax.plot(found.t, np.linalg.norm(wrench[:, :3], axis=1), color=colours[loop], label=plain(loop))
    ax.set(title="forces that the loops transmit", ylabel="N")
    _legend(ax)


def _legend(ax: Any) -> None:
    handles, labels = ax.get_legend_handles_labels()
    if len(labels) > NAMED:
        handles, labels = handles[:: len(labels) - 1], labels[:: len(labels) - 1]
    if labels:
        ax.legend(handles, labels, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
