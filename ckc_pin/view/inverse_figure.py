"""What a motion asks for as a figure: efforts of the motors with their limits, and the forces of the loops."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.mechanism.units import motor_units
from ckc_pin.run.motion_forces import MotionForces
from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, line, look, note_on, page, write
from ckc_pin.view.labels import plain, symbol, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_inverse", "save_inverse"]

TITLED = 3  # motors; more would be longer than their panel


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
        unit = motor_units(found.mechanism)
        kinds = list(dict.fromkeys(unit))
        titles = ["motors", "forces that the loops transmit"]
        efforts, loops = page(f"{plain(found.name)}: what the motion asks for", "", titles, 1, (style.WIDTH, 2.4))
        panels = efforts.axes(len(kinds))
        _efforts(panels, found, {kind: [k for k, own in enumerate(unit) if own == kind] for kind in kinds})
        _loops(loops.axes()[0], found)
        return efforts.figure


def _efforts(panels: list[Any], found: MotionForces, kinds: dict[str, list[int]]) -> None:
    largest = dict(zip(found.actuated, np.abs(found.tau).max(axis=0), strict=True))
    named = style.foremost(largest)
    colours = style.colours(named)
    beyond = {entry["motor"]: entry for entry in found.exceeded}
    for ax, (unit, own) in zip(panels, kinds.items(), strict=True):
        for k in sorted(own, key=lambda k: found.actuated[k] in named):  # those without a colour lie behind
            motor = found.actuated[k]
            ax.plot(found.t, found.tau[:, k], color=colours.get(motor, style.REST))
            if motor in beyond:  # a limit that is far away would flatten the curves
                for side in (-1, 1):
                    limit = beyond[motor]["limit"]
                    if np.any(side * found.tau[:, k] > limit):
                        ax.axhline(side * limit, color=colours.get(motor, style.GREY), linestyle="--", linewidth=0.9)
        ax.set_ylabel(with_unit(r"$\tau$", unit))
    names = ", ".join(symbol(motor) for motor in beyond) if len(beyond) <= TITLED else f"{len(beyond)} of them"
    if beyond:
        note_on(panels[0], f"beyond their limits (dashed): {names}")
    _finish(panels[-1], {symbol(motor): colours[motor] for motor in named}, len(found.actuated))


def _loops(ax: Any, found: MotionForces) -> None:
    sizes = {loop: np.linalg.norm(wrench[:, :3], axis=1) for loop, wrench in found.loop_wrenches.items()}
    named = style.foremost({loop: float(size.max(initial=0.0)) for loop, size in sizes.items()})
    colours = style.colours(named)
    for loop in sorted(sizes, key=lambda loop: loop in named):
        ax.plot(found.t, sizes[loop], color=colours.get(loop, style.REST))
    ax.set_ylabel(with_unit("force", "N"))
    _finish(ax, {plain(loop): colours[loop] for loop in named}, len(sizes))


def _finish(ax: Any, named: dict[str, str], count: int) -> None:
    ax.set_xlabel(with_unit("$t$", "s"))
    rest = [line(style.REST, f"{count - len(named)} more")] if count > len(named) else []
    fit_legend(ax, [line(colour, name) for name, colour in named.items()] + rest)
