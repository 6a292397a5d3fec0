"""The studies' figures: one look, written as PNG without a display."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["BLACK", "COLOURS", "chart", "save"]

# Okabe and Ito's colours, told apart by every eye; yellow is left out, which is hard to see as a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
BLACK = "#000000"


def chart(columns: int = 1) -> tuple[Any, Any]:
    """Return a figure with a row of axes: (Figure, flat array of Axes)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4 * columns, 4.6), dpi=110, layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, columns))
    for ax in axes:
        ax.grid(True, which="major", alpha=0.3)
    return figure, axes


def save(figure: Any, folder: Path, name: str) -> str:
    """Write a figure into a folder, which is made if need be; return its file name."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    folder.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(folder / name)
    return name
