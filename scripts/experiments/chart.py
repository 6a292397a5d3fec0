"""The studies' figures: one look, written as PNG without a display."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["BLACK", "COLOURS", "chart", "save", "whole_decades"]

# Okabe and Ito's colours, told apart by every eye; yellow is left out, which is hard to see as a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
BLACK = "#000000"
PALETTE = 128  # colours of a file: lines and letters with their soft edges need no more


def chart(columns: int = 1, rows: int = 1, size: tuple[float, float] = (6.4, 4.6)) -> tuple[Any, Any]:
    """Return a figure with rows of axes, each of a size in inches: (Figure, flat array of Axes)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] * columns, size[1] * rows), dpi=110 if size[0] > 5 else 160, layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns)).flatten()
    for ax in axes:
        ax.grid(True, which="major", alpha=0.3)
    return figure, axes


def whole_decades(ax: Any) -> None:
    """End logarithmic axes at powers of ten, which alone have a label: those between run into each other."""
    ax.minorticks_off()
    for axis, room, (low, high) in zip("xy", (1.0, 1.6), ax.dataLim.get_points().T, strict=True):
        if 0 < low <= high < np.inf:
            ends = np.floor(np.log10(low / room) + 1e-9), np.ceil(np.log10(high * room) - 1e-9)
            ax.set(**{f"{axis}lim": 10.0 ** np.array([ends[0], max(ends[1], ends[0] + 1)])})


def save(figure: Any, folder: Path, name: str) -> str:
    """Write a figure into a folder, which is made if need be, with a palette; return its file name."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    image.quantize(PALETTE, dither=Image.Dither.NONE).save(folder / name, optimize=True)  # a third of the size
    return name
