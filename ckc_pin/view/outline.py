"""A pose as lines on a plane: bars, the rings of its hinges, the blocks of its slides. Figures and GIFs draw these."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.view.skeleton import Placements, Projection, slides, sticks

__all__ = ["Outline", "base", "outline"]

ENDWAYS = 0.3  # sine of the angle to the line of sight below which a slider is seen from its end


@dataclass(frozen=True)
class Outline:
    """What of a mechanism moves, in one pose, on a plane.

    Attributes
    ----------
    bars : list of (2, 2) arrays
        By end and axis of the plane, m.
    rings : (m, 2) array
        Hinges, m.
    blocks : list of (4, 2) arrays
        Corners of sliders and sleeves, m.
    """

    bars: list[Array]
    rings: Array
    blocks: list[Array]


def outline(mechanism: Mechanism, at: Placements, plane: Projection) -> Outline:
    """Return one pose's lines on a plane; `at` is of one configuration."""
    sliding = {slide.joint: slide for slide in slides(mechanism)}
    bars: list[Array] = []
    rings: list[Array] = []
    for stick in sticks(mechanism):
        if stick.joint == stick.end_joint == 0:
            rings += [stick.start, stick.end]
            continue
        rail = stick.joint != stick.end_joint
        if rail and not stick.joint:
            continue  # it stands still: see `base`
        ends = np.vstack([at.of(stick.joint, stick.start), at.of(stick.end_joint, stick.end)])
        bars.append(ends @ plane.axes.T)
        if not rail:
            rings += [end for end, local in zip(ends, (stick.start, stick.end), strict=True)
                      if stick.joint not in sliding or np.any(local)]  # fmt: skip
    blocks = []
    for slide in sliding.values():  # on a rail of the base a slider, of another body a sleeve round the rod
        carrier = at.rotation[0, slide.parent]
        where = at.translation[0, slide.joint] if not slide.parent else at.of(slide.parent, slide.origin)[0]
        blocks.append(_block(plane, where, carrier @ slide.along, mechanism.size))
        rings = [ring for ring in rings if np.linalg.norm(ring - where) > 1e-9 * mechanism.size]
    return Outline(bars, np.array(rings).reshape(-1, 3) @ plane.axes.T, blocks)


def _block(plane: Projection, where: Array, along: Array, size: float) -> Array:
    middle, way = plane.axes @ where, plane.axes @ along
    long = 0.045 * size * (way if np.linalg.norm(way) > ENDWAYS else np.array([0.5, 0.0]))
    wide = 0.022 * size * np.array([-long[1], long[0]]) / np.linalg.norm(long)
    return np.array([middle + a * long + b * wide for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))])


def base(mechanism: Mechanism, moved: Placements, plane: Projection) -> tuple[list[Array], list[Array]]:
    """Return what stands still on a plane: the base's bars, and its rails as far as sliders go in all these poses."""
    bars = [np.array([stick.start, stick.end]) @ plane.axes.T
            for stick in sticks(mechanism) if stick.joint == stick.end_joint == 0]  # fmt: skip
    rails = []
    for slide in slides(mechanism):
        if not slide.parent:
            far = (moved.translation[:, slide.joint] - slide.origin) @ slide.along
            room = 0.08 * mechanism.size
            span = np.outer([far.min() - room, far.max() + room], slide.along) + slide.origin
            rails.append(span @ plane.axes.T)
    return bars, rails
