"""A workspace of three dimensions as a figure: a panel for each section, from the lowest."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ckc_pin.kinematics.mapped import SingularityMap
from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, head, look, say, write
from ckc_pin.view.labels import plain
from ckc_pin.view.map_figure import det_label, draw_aspect, handles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_sections", "save_sections"]

COLUMNS = 3


def save_sections(found: Sequence[SingularityMap], folder: Path, formats: Sequence[str] = ("png", "svg")) -> list[Path]:
    """Draw sections and write them as map_sections.

    Raises
    ------
    InputError
        A folder that cannot be written, matplotlib missing.
    """
    return write(draw_sections(found), folder, "map_sections", formats)


def draw_sections(found: Sequence[SingularityMap]) -> Figure:
    """Return the figure of sections.

    Raises
    ------
    InputError
        matplotlib missing.
    """
    with look():
        from matplotlib.figure import Figure

        first = found[0]
        columns = min(len(found), COLUMNS)
        rows = -(-len(found) // columns)
        wide, high = (axis.high - axis.low for axis in first.axes)
        tall = float(np.clip(high / wide, 0.4, 1.6))
        width = (style.WIDTH - 0.6) / COLUMNS
        figure = Figure(figsize=(width * columns + 0.6, (width * tall + 0.35) * rows + 1.1), layout="constrained")
        name = plain(first.mechanism)
        (fixed,) = first.fixed
        head(figure, f"{name}: workspace of {first.point}", f"sections across ${fixed}$, working mode as assembled")
        most = max(float(np.nanmax(np.abs(one.aspects[0].det_phi_z))) for one in found)
        cell = float(np.prod([(axis.high - axis.low) / len(axis.values) for axis in first.axes]))
        panels = [figure.add_subplot(rows, columns, k + 1) for k in range(len(found))]
        for k, (ax, one) in enumerate(zip(panels, found, strict=True)):
            shown = draw_aspect(ax, one, 0, most)
            say(ax, f"${fixed}$ = {one.fixed[fixed]:.3f} m", f"reaches {cell * np.sum(one.aspects[0].reached):.3f} m²")
            ax.locator_params(nbins=4)
            if k % columns:
                ax.set_ylabel("")
                ax.tick_params(labelleft=False)
            if k + columns < len(found):
                ax.set_xlabel("")
        figure.colorbar(shown, ax=panels, label=det_label(first), shrink=0.85)
        legend = {handle.get_label(): handle for one in found for handle in handles(one)}
        fit_legend(figure, list(legend.values()))
        return figure
