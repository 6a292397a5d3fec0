"""Playback as an animated GIF: a line drawing, made with matplotlib and without a browser."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.base.validation import describe_value, is_number
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.view import style
from ckc_pin.view.geometry import (
    Placements,
    Projection,
    compute_placements,
    compute_view_axes,
    is_planar,
    pinocchio_configurations,
    projection_planes,
)
from ckc_pin.view.layout import add_header, fit_legend, legend_line
from ckc_pin.view.links import find_link_shapes
from ckc_pin.view.outlines import Outline, draw_base, project_base, project_outline
from ckc_pin.view.player import require_parent_folder, require_playable_runs
from ckc_pin.view.run_group import compute_desired_poses
from ckc_pin.view.style import escape_mathtext, figure_style, label_runs

__all__ = ["FRAMES_PER_SECOND", "quantize_frames", "save_gif"]

FRAMES_PER_SECOND = 20.0  # by default
MIN_FRAMES_PER_SECOND, MAX_FRAMES_PER_SECOND = 1, 50  # Browsers slow down frames shorter than 0.02 s.
MAX_FRAMES = 1200
MAX_PIXELS = MAX_FRAMES * 480 * 600  # of all frames together, for the memory they take
LAST_FRAME_MS = 1000
MIN_SIDE_PX, MAX_SIDE_PX = 120, 3840
# The width of the default size and the limits of its height; letters and lines of other sizes are scaled.
WIDTH_IN, MIN_HEIGHT_IN, MAX_HEIGHT_IN = 4.8, 2.2, 6.0
DPI = 100
PLATE_ALPHA = 0.2
PALETTE_SIZE = 64
PALETTE_FRAMES = 5  # frames that the palette is computed from


def save_gif(
    runs: Run | Sequence[Run],
    path: str | Path,
    *,
    speed: float = 1.0,
    size: tuple[int, int] | None = None,
    fps: float = FRAMES_PER_SECOND,
) -> Path:
    """Write runs as an animated GIF that shows links, hinges and slides.

    Planar mechanisms are drawn on their plane, other mechanisms obliquely from above.

    Parameters
    ----------
    runs : Run or sequence of Run
        Runs of one mechanism, drawn on top of each other. The desired pose is grey.
    path : str or Path
    speed : float
        Simulated seconds per second of playback.
    size : (width, height), optional
        Pixels, 120 to 3840 each. Default: 480 wide, as high as the mechanism needs.
    fps : float
        Frames per second of playback, 1 to 50.

    Raises
    ------
    InputError
        As for `play_runs`; an invalid size or frame rate; the file cannot be written; more than 1200 frames, or too
        many pixels in all of them; matplotlib is not installed.
    """
    ordered = require_playable_runs(runs, speed)
    _require_size(size)
    if not (is_number(fps) and MIN_FRAMES_PER_SECOND <= fps <= MAX_FRAMES_PER_SECOND):
        raise InputError(
            f"video: fps = {describe_value(fps)}; a GIF shows {MIN_FRAMES_PER_SECOND} to {MAX_FRAMES_PER_SECOND} "
            "frames per second"
        )
    file = require_parent_folder(path, "save_gif: path")
    t_end = max(float(run.t[-1]) for run in ordered)
    count = int(np.ceil(t_end * fps / speed)) + 1
    if count > MAX_FRAMES:
        raise InputError(
            f"video: {t_end:g} s at speed {speed:g} and {fps:g} frames per second need {count} frames, but a GIF may "
            f"have {MAX_FRAMES}; choose speed {_round_up(t_end * fps / (MAX_FRAMES - 1)):g} or more, or fewer frames "
            "per second"
        )
    times = np.minimum(np.arange(count) * speed / fps, t_end)
    with figure_style():
        frames = _Animation(ordered, times, speed, size).render()
    # GIF measures in hundredths of a second; rounding the instants keeps the average rate exact.
    durations = 10 * np.diff(np.round(100 * np.arange(count) / fps)).astype(int)
    with open_atomic(file) as stream:
        frames[0].save(stream, "GIF", save_all=True, append_images=frames[1:],
                       duration=[*durations.tolist(), LAST_FRAME_MS], loop=0)  # fmt: skip
    return file


def _require_size(size: Any) -> None:
    if size is None:
        return
    is_pair = isinstance(size, tuple | list) and len(size) == 2 and all(isinstance(x, int) for x in size)
    if not (is_pair and all(MIN_SIDE_PX <= x <= MAX_SIDE_PX for x in size)):
        value = f"{size[0]} x {size[1]}" if is_pair else describe_value(size)
        raise InputError(
            f"video: size = {value}; expected width and height in pixels, two integers from {MIN_SIDE_PX} "
            f"to {MAX_SIDE_PX}"
        )


def _round_up(value: float) -> float:
    """Round up to two digits."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / unit - 1e-9) * unit)


def quantize_frames(images: Sequence[Any]) -> list[Any]:
    """Reduce images to one common palette, so that GIF compresses the parts that do not change between frames."""
    from PIL import Image

    samples = [np.asarray(images[k]) for k in np.linspace(0, len(images) - 1, PALETTE_FRAMES).astype(int)]
    palette = Image.fromarray(np.vstack(samples)).quantize(PALETTE_SIZE)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    # The background's entry is an average of white and nearly white; make it white.
    colours[np.asarray(frames[0])[-1, -1]] = 255
    for frame in frames:
        frame.putpalette(colours.ravel().tolist())
    return frames


class _MovingOutline:
    """The artists of one mechanism, which are moved from frame to frame."""

    def __init__(self, ax: Any, outlines: list[Outline], colour: Any, **properties: Any) -> None:
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Polygon

        self.outlines = outlines
        first = outlines[0]
        plate_properties = {"facecolor": (colour, PLATE_ALPHA), "edgecolor": colour, "joinstyle": "round"} | properties
        self.plates = [ax.add_patch(Polygon(plate, **plate_properties)) for plate in first.plates]
        self.bars = ax.add_collection(LineCollection(first.bars, colors=[colour], **properties))
        alpha = properties.get("alpha")
        ring_properties = {"color": colour, "markerfacecolor": "white", "markersize": 4.5, "alpha": alpha}
        (self.rings,) = ax.plot(*first.rings.T, linestyle="none", marker="o", **ring_properties)
        block_properties = {"facecolor": "white", "edgecolor": colour, "alpha": alpha}
        self.blocks = [ax.add_patch(Polygon(block, **block_properties)) for block in first.blocks]
        self.artists = [*self.plates, self.bars, *self.blocks, self.rings]  # in drawing order

    def move_to(self, k: int, is_visible: bool = True) -> None:
        """Move the artists to frame k."""
        outline = self.outlines[k]
        for patch, plate in zip(self.plates, outline.plates, strict=True):
            patch.set_xy(plate)
        self.bars.set_segments(outline.bars)
        self.rings.set_data(*outline.rings.T)
        for patch, block in zip(self.blocks, outline.blocks, strict=True):
            patch.set_xy(block)
        for artist in self.artists:
            artist.set_visible(is_visible)


class _Animation:
    """A figure that is drawn once per frame."""

    def __init__(self, runs: list[Run], times: Array, speed: float, size: tuple[int, int] | None) -> None:
        mechanism = runs[0].mechanism
        self.runs, self.times = runs, times
        oblique = Projection("", compute_view_axes(mechanism)[:2], ("", ""))
        self.plane = projection_planes(mechanism)[0] if is_planar(mechanism) else oblique
        rows = [np.array([run.at(t) for t in times]) for run in runs]
        motions = [compute_placements(run.mechanism, pinocchio_configurations(run, selected))
                   for run, selected in zip(runs, rows, strict=True)]  # fmt: skip
        outlines = [self._project(run.mechanism, motion) for run, motion in zip(runs, motions, strict=True)]
        base = project_base(find_link_shapes(mechanism, motions[0]), self.plane)
        paths = [self.plane.axes @ path.T for run in runs for path in run.points.values()]
        moving_points = [x for frames in outlines for frame in frames
                         for x in (*frame.bars, *frame.plates, frame.rings, *frame.blocks)]  # fmt: skip
        self._create_figure(
            np.vstack([base.ground, *base.rails, *(path.T for path in paths), *moving_points]), speed, size
        )
        draw_base(self.ax, base)
        for path in paths:
            self.ax.plot(*path, color=style.GREY, linewidth=0.8, linestyle=":")
        self.desired, self.is_reachable = self._create_desired(rows[0])
        line_styles = [{"linewidth": 2.4}] if len(runs) == 1 else style.line_styles(runs)
        colours = [style.COLOURS[k % style.MAX_COLOURS] for k in range(len(runs))]
        self.outlines = [
            _MovingOutline(self.ax, frames, colour, **line_style)
            for frames, colour, line_style in zip(outlines, colours, line_styles, strict=True)
        ]
        labels = label_runs(runs) if len(runs) > 1 else []
        handles = [legend_line(colours[k], label, **line_styles[k]) for k, label in enumerate(labels)]
        if self.desired:
            handles.append(legend_line(style.REST_COLOUR, "desired"))
        fit_legend(self.figure, handles)

    def _create_figure(self, points: Array, speed: float, size: tuple[int, int] | None) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        low, high = points.min(axis=0), points.max(axis=0)
        low, high = low - 0.06 * (high - low).max(), high + 0.06 * (high - low).max()
        if size is None:
            height = WIDTH_IN * (high - low)[1] / (high - low)[0] + 0.7
            size = (round(DPI * WIDTH_IN), round(DPI * float(np.clip(height, MIN_HEIGHT_IN, MAX_HEIGHT_IN))))
        width_px, height_px = size
        pixels = len(self.times) * width_px * height_px
        if pixels > MAX_PIXELS:
            raise InputError(
                f"video: {len(self.times)} frames of {width_px} x {height_px} pixels are {pixels / MAX_PIXELS:.2g} "
                "times as much as a GIF may have; choose a smaller size, fewer frames per second or a higher speed"
            )
        dpi = min(width_px / WIDTH_IN, height_px / MIN_HEIGHT_IN)
        height = height_px / dpi
        # The canvas rounds down to whole pixels.
        self.figure = Figure(((width_px + 0.01) / dpi, (height_px + 0.01) / dpi), dpi=dpi, layout="constrained")
        self.canvas: Any = FigureCanvasAgg(self.figure)
        subtitle = "" if speed == 1 else f"{speed:g} × real time"
        add_header(self.figure, escape_mathtext(self.runs[0].scene_name), subtitle)
        self.ax: Any = self.figure.subplots()
        self.ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        self.ax.axis("off")
        self.time_text = self.figure.text(0.985, 1.0 - 0.06 / height, "", ha="right", va="top")

    def _create_desired(self, rows: Any) -> tuple[_MovingOutline | None, Any]:
        """Create the desired pose of the first run; it is hidden while the mechanism cannot reach it."""
        desired = compute_desired_poses(self.runs[0], rows)
        if desired is None:
            return None, None
        mechanism = self.runs[0].mechanism
        poses = compute_placements(mechanism, desired.q_tree)
        return _MovingOutline(
            self.ax, self._project(mechanism, poses), style.REST_COLOUR, linewidth=2.4
        ), desired.is_reachable

    def _project(self, mechanism: Mechanism, poses: Placements) -> list[Outline]:
        """Project a mechanism in all poses, one for each frame."""
        shapes = find_link_shapes(mechanism, poses)
        frames = range(len(self.times))
        return [project_outline(mechanism, shapes, poses.select_row(k), self.plane) for k in frames]

    def render(self) -> list[Any]:
        """Draw all frames in one palette; parts that do not move are drawn once."""
        from PIL import Image

        outlines = ([] if self.desired is None else [self.desired]) + self.outlines
        artists = [artist for outline in outlines for artist in outline.artists] + [self.time_text]
        for artist in artists:
            artist.set_animated(True)
        self.canvas.draw()
        background = self.canvas.copy_from_bbox(self.figure.bbox)
        images = []
        for k, t in enumerate(self.times):
            self.canvas.restore_region(background)
            for outline in outlines:
                outline.move_to(k, outline is not self.desired or bool(self.is_reachable[k]))
            self.time_text.set_text(self._format_time(float(t)))
            for artist in artists:
                self.figure.draw_artist(artist)
            images.append(Image.fromarray(np.asarray(self.canvas.buffer_rgba())[..., :3].copy()))
        return quantize_frames(images)

    def _format_time(self, t: float) -> str:
        """Return the time, and whether a run has stopped by then."""
        has_stopped = any(run.status != "done" and t >= run.t[-1] for run in self.runs)
        return f"{'stopped, ' if has_stopped else ''}t = {t:.2f} s"
