"""Figures of the studies: one style, PNG files without a display, and small files for all pictures of docs/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["BLACK", "COLOURS", "chart", "save", "shrink", "whole_decades"]

# Okabe and Ito's colours, which colour-blind readers can distinguish. Yellow is left out: its lines are hard to see.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
BLACK = "#000000"
MAX_COLOUR_ERROR = 16  # of 255: largest invisible difference of a colour from its palette


def chart(columns: int = 1, rows: int = 1, size: tuple[float, float] = (6.4, 4.6)) -> tuple[Any, Any]:
    """Return a figure and a flat array of its axes, each with `size` in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] * columns, size[1] * rows), dpi=110 if size[0] > 5 else 160, layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns)).flatten()
    for ax in axes:
        ax.grid(True, which="major", alpha=0.3)
    return figure, axes


def whole_decades(ax: Any) -> None:
    """End logarithmic axes at powers of ten and label these only, since labels between them would overlap."""
    ax.minorticks_off()
    for axis, room, (low, high) in zip("xy", (1.0, 1.6), ax.dataLim.get_points().T, strict=True):
        if 0 < low <= high < np.inf:
            ends = np.floor(np.log10(low / room) + 1e-9), np.ceil(np.log10(high * room) - 1e-9)
            ax.set(**{f"{axis}lim": 10.0 ** np.array([ends[0], max(ends[1], ends[0] + 1)])})


def save(figure: Any, folder: Path, name: str) -> str:
    """Write a figure into a folder, which is created if necessary; return the file name."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    _write(Image.fromarray(np.asarray(canvas.buffer_rgba())), folder / name)
    return name


def shrink(path: Path) -> None:
    """Rewrite a PNG as small as possible without a visible difference. A file with a palette is left as it is."""
    from PIL import Image

    with Image.open(path) as image:
        if image.mode != "P":
            _write(image, path)


def _write(image: Any, path: Path) -> None:
    """Write a picture with a palette, a third of the size, or without one if shades would change visibly."""
    from PIL import Image

    exact = image.convert("RGB")
    quantized = exact.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=4, dither=Image.Dither.NONE)
    error = np.abs(np.asarray(quantized.convert("RGB"), dtype=int) - np.asarray(exact, dtype=int)).max()
    (quantized if error <= MAX_COLOUR_ERROR else exact).save(path, optimize=True)
