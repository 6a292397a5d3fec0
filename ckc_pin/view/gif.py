"""Playback as a GIF: lines on a plane, drawn without a browser."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.errors import InputError
from ckc_pin.run.run import Run
from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, head, line, look
from ckc_pin.view.desired import desired_poses
from ckc_pin.view.labels import plain, run_labels
from ckc_pin.view.outline import Outline, base, outline
from ckc_pin.view.player import file_in_folder, shown_runs
from ckc_pin.view.skeleton import Projection, configurations, is_planar, placements, planes, viewpoint

__all__ = ["in_one_palette", "save_gif"]

RATE = 20  # frames a second; a GIF counts in hundredths
MOST = 1200  # frames
LAST = 1000  # ms, that the end is shown
WIDE, LOWEST, HIGHEST = 4.8, 2.2, 6.0  # in
DPI = 100
COLOURS = 64
LOOKED_AT = 5  # frames that the colours are chosen from


def save_gif(runs: Run | Sequence[Run], path: str | Path, *, speed: float = 1.0) -> Path:
    """Write runs as a moving picture: bars, hinges and slides on the mechanism's plane, or aslant from above.

    Parameters
    ----------
    runs : Run or sequence of Run
        They lie on each other; all of one mechanism. What a controller wanted is grey.
    path : str or Path
    speed : float
        Seconds of the run in a second.

    Raises
    ------
    InputError
        As for `play`; a file that cannot be written; more than 1200 frames of 1/20 s; matplotlib missing.
    """
    shown = shown_runs(runs, speed)
    file = file_in_folder(path, "save_gif: path")
    end = max(float(run.t[-1]) for run in shown)
    count = int(np.ceil(end * RATE / speed)) + 1
    if count > MOST:
        raise InputError(
            f"save_gif: {end:g} s at speed {speed:g} are {count} frames, and {MOST} the most; "
            f"speed {end * RATE / (MOST - 1):.2g} or more is short enough"
        )
    times = np.minimum(np.arange(count) * speed / RATE, end)
    with look():
        frames = _Frames(shown, times, speed).images()
    durations = [1000 // RATE] * (count - 1) + [LAST]
    with open_atomic(file) as written:
        frames[0].save(written, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0)
    return file


def in_one_palette(drawn: Sequence[Any]) -> list[Any]:
    """Return images in few colours, which are the same in all: what stands still is the same in the next frame."""
    from PIL import Image

    some = [np.asarray(drawn[k]) for k in np.linspace(0, len(drawn) - 1, LOOKED_AT).astype(int)]
    palette = Image.fromarray(np.vstack(some)).quantize(COLOURS)
    made = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in drawn]
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[np.asarray(made[0])[-1, -1]] = 255  # the paper, which was averaged with what is nearly white
    for image in made:
        image.putpalette(colours.ravel().tolist())
    return made


class _Moving:
    """The artists of one mechanism, which are put elsewhere for each frame."""

    def __init__(self, ax: Any, ways: list[Outline], colour: Any, **shape: Any) -> None:
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Polygon

        self.ways = ways
        first = ways[0]
        self.bars = ax.add_collection(LineCollection(first.bars, colors=[colour], **shape))
        face = {"color": colour, "markerfacecolor": "white", "markersize": 4.5, "alpha": shape.get("alpha")}
        (self.rings,) = ax.plot(*first.rings.T, linestyle="none", marker="o", **face)
        look = {"facecolor": "white", "edgecolor": colour, "alpha": shape.get("alpha")}
        self.blocks = [ax.add_patch(Polygon(block, **look)) for block in first.blocks]
        self.artists = [self.bars, *self.blocks, self.rings]  # each on those before

    def go(self, k: int, exists: bool = True) -> None:
        """Stand as in frame k."""
        way = self.ways[k]
        self.bars.set_segments(way.bars)
        self.rings.set_data(*way.rings.T)
        for patch, block in zip(self.blocks, way.blocks, strict=True):
            patch.set_xy(block)
        for artist in self.artists:
            artist.set_visible(exists)


class _Frames:
    """A figure that is drawn once a frame."""

    def __init__(self, runs: list[Run], times: Array, speed: float) -> None:
        mechanism = runs[0].mechanism
        self.runs, self.times = runs, times
        axes = viewpoint(mechanism)[:2]
        self.plane = planes(mechanism)[0] if is_planar(mechanism) else Projection("", axes, ("", ""))
        rows = [np.array([run.at(t) for t in times]) for run in runs]
        moved = [placements(run.mechanism, configurations(run, at)) for run, at in zip(runs, rows, strict=True)]
        ways = [[outline(run.mechanism, where.row(k), self.plane) for k in range(len(times))]
                for run, where in zip(runs, moved, strict=True)]  # fmt: skip
        bars, rails = base(mechanism, moved[0], self.plane)
        paths = [self.plane.axes @ path.T for run in runs for path in run.points.values()]
        moving = [x for way in ways for one in way for x in (*one.bars, one.rings, *one.blocks)]
        self._page(np.vstack([*bars, *rails, *(path.T for path in paths), *moving]), speed)
        for bar in bars:
            self.ax.plot(*bar.T, color=style.GREY, linewidth=3.0, alpha=0.5 if rails else 1.0)
        for rail in rails:
            self.ax.plot(*rail.T, color="black", linewidth=1.0, marker="|", markersize=5)
        for path in paths:
            self.ax.plot(*path, color=style.GREY, linewidth=0.8, linestyle=":")
        self.wanted, self.exists = self._wanted(rows[0])
        looks = [{"linewidth": 2.4}] if len(runs) == 1 else style.lines(runs)
        self.moving = [_Moving(self.ax, way, style.COLOURS[k % style.MOST], **shape)
                       for k, (way, shape) in enumerate(zip(ways, looks, strict=True))]  # fmt: skip
        labels = run_labels(runs) if len(runs) > 1 else []
        handles = [line(style.COLOURS[k % style.MOST], label, **looks[k]) for k, label in enumerate(labels)]
        fit_legend(self.figure, [*handles, *([line(style.REST, "desired")] if self.wanted else [])])

    def _page(self, every: Array, speed: float) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        low, high = every.min(axis=0), every.max(axis=0)
        low, high = low - 0.06 * (high - low).max(), high + 0.06 * (high - low).max()
        tall = float(np.clip(WIDE * (high - low)[1] / (high - low)[0] + 0.7, LOWEST, HIGHEST))
        self.figure = Figure(figsize=(WIDE, tall), dpi=DPI, layout="constrained")
        self.canvas: Any = FigureCanvasAgg(self.figure)
        head(self.figure, plain(self.runs[0].scene_name), "" if speed == 1 else f"{speed:g} × real time")
        self.ax: Any = self.figure.subplots()
        self.ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        self.ax.axis("off")
        self.now = self.figure.text(0.985, 1.0 - 0.06 / tall, "", ha="right", va="top")

    def _wanted(self, rows: Any) -> tuple[_Moving | None, Any]:
        """The pose that the first run should have; hidden while the mechanism cannot have it."""
        wanted = desired_poses(self.runs[0], rows)
        if wanted is None:
            return None, None
        mechanism = self.runs[0].mechanism
        moved = placements(mechanism, wanted.q_tree)
        ways = [outline(mechanism, moved.row(k), self.plane) for k in range(len(rows))]
        return _Moving(self.ax, ways, style.REST, linewidth=2.4), wanted.exists

    def images(self) -> list[Any]:
        """Draw all, in one palette; what stands still is drawn once."""
        from PIL import Image

        shown = ([] if self.wanted is None else [self.wanted]) + self.moving
        artists = [artist for one in shown for artist in one.artists] + [self.now]
        for artist in artists:
            artist.set_animated(True)
        self.canvas.draw()
        still = self.canvas.copy_from_bbox(self.figure.bbox)
        drawn = []
        for k, t in enumerate(self.times):
            self.canvas.restore_region(still)
            for one in shown:
                one.go(k, one is not self.wanted or bool(self.exists[k]))
            self.now.set_text(self._says(float(t)))
            for artist in artists:
                self.figure.draw_artist(artist)
            drawn.append(Image.fromarray(np.asarray(self.canvas.buffer_rgba())[..., :3].copy()))
        return in_one_palette(drawn)

    def _says(self, t: float) -> str:
        """The time, and whether a run has stopped by then."""
        stopped = any(run.status != "done" and t >= run.t[-1] for run in self.runs)
        return f"{'stopped, ' if stopped else ''}t = {t:.2f} s"
