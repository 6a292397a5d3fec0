"""Surfaces of plates: rounded convex hulls of points."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.view.visuals import Surface

__all__ = ["compute_flat_hull", "compute_hull_outline", "compute_solid_hull"]

CORNER_POINTS = 24  # around a rounded corner


def compute_flat_hull(points: Array, normal: Array, radius: float, thickness: float) -> Surface:
    """Return a plate of some thickness with rounded corners around points (k, 3) of a plane with a normal."""
    side = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    side /= np.linalg.norm(side)
    angles = 2 * np.pi * np.arange(CORNER_POINTS)[:, None] / CORNER_POINTS
    circle = radius * (np.cos(angles) * side + np.sin(angles) * np.cross(normal, side))
    faces = [circle + 0.5 * sign * thickness * normal for sign in (-1, 1)]
    return _compute_hull((points[:, None] + np.vstack(faces)).reshape(-1, 3))


def compute_solid_hull(points: Array, radius: float) -> Surface:
    """Return a solid with rounded corners around points (k, 3) that are in no common plane."""
    angles = 2 * np.pi * np.arange(CORNER_POINTS) / CORNER_POINTS
    heights = np.linspace(-1.0, 1.0, CORNER_POINTS // 2 + 1)[:, None]
    widths = np.sqrt(1 - heights**2)
    sphere = np.stack([widths * np.cos(angles), widths * np.sin(angles), heights + 0 * angles], axis=-1).reshape(-1, 3)
    return _compute_hull((points[:, None] + radius * np.unique(sphere, axis=0)).reshape(-1, 3))


def compute_hull_outline(points: Array) -> Array:
    """Return the corners (m, 2) of the convex hull of points (k, 2), in order; at least one corner."""
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
    chains = [_find_lower_chain(ordered), _find_lower_chain(ordered[::-1])]
    return np.array([*chains[0][:-1], *chains[1][:-1]] or ordered[:1])


def _find_lower_chain(points: Array) -> list[Array]:
    """Return the lower half of a hull from sorted points (A. M. Andrew's monotone chain)."""
    chain: list[Array] = []
    for point in points:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-1] - chain[-2], point - chain[-2]
            if ax * by - ay * bx > 0:
                break
            chain.pop()
        chain.append(point)
    return chain


def _compute_hull(points: Array) -> Surface:
    from scipy.spatial import ConvexHull

    faces = ConvexHull(points).simplices
    corners, indices = np.unique(faces, return_inverse=True)
    return points[corners], indices.reshape(faces.shape)
