"""Thumbnails of the gallery: the largest axes of a figure, without letters that would be too small to read."""

from __future__ import annotations

from typing import Any

__all__ = ["reduce_to_thumbnail"]

SIZE_IN = (3.0, 1.8)  # the ratio of the places in the gallery
INNER_BOX = (0.03, 0.05, 0.94, 0.90)  # of the axes: left, bottom, width, height as fractions


def reduce_to_thumbnail(figure: Any) -> None:
    """Reduce a matplotlib figure to its largest axes, without text, ticks and legends, in the size of a thumbnail.

    Of equally large axes, the one with the most lines and markers is shown.
    """
    figure.canvas.draw()  # The layout gives the axes their sizes.
    largest = max(figure.axes, key=_measure_axes)
    for ax in [ax for ax in figure.axes if ax is not largest]:
        ax.remove()
    for element in [*figure.texts, *figure.legends, figure._suptitle, largest.get_legend(), *largest.texts]:
        if element is not None:
            element.set_visible(False)
    for place in ("left", "center", "right"):
        largest.set_title("", loc=place)
    largest.set(xlabel="", ylabel="")
    largest.tick_params(which="both", length=0, labelbottom=False, labelleft=False, labelright=False, labeltop=False)
    for axis in (largest.xaxis, largest.yaxis):
        axis.get_offset_text().set_visible(False)
    figure.set_layout_engine("none")
    figure.set_size_inches(SIZE_IN)
    largest.set_position(INNER_BOX)


def _measure_axes(ax: Any) -> tuple[float, int]:
    box = ax.get_position()
    return round(box.width * box.height, 2), len(ax.lines) + len(ax.collections)
