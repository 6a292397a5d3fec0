"""The triangles of a mesh file, through yourdfpy; a file that is missing or damaged has none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.sources import PACKAGE, resolve_path
from ckc_pin.errors import InputError

__all__ = ["Surface", "load_surface"]

MAX_BYTES = 2**26  # of a file
NEAR = 5e-4  # of a surface's size
MAX_FACES = 2**20  # of a surface: a browser still turns that

Surface = tuple[Array, IntArray]  # corners (m, 3), metres; faces (k, 3), three corners each


def load_surface(file: str, scale: tuple[float, ...], folder: Path | None) -> Surface | None:
    """Return a mesh in its link's axes, or None where it cannot be had.

    Parameters
    ----------
    file : str
        A name in the mechanism's folder, or ``package://PACKAGE/PATH``. Nothing else is opened.
    scale : (x, y, z)
    folder : Path or None
        The mechanism's. A saved run has none.
    """
    for path in _candidates(file, folder):
        try:
            if path.is_file() and path.stat().st_size <= MAX_BYTES:
                return _read(path, scale)
        except OSError:
            continue
    return None


def _candidates(file: str, folder: Path | None) -> Iterator[Path]:
    """Where a file may be: in the package it names, or in the folder, and never beside these."""
    name = file
    if file.startswith(PACKAGE):
        name = file.removeprefix(PACKAGE).partition("/")[2]
        with suppress(InputError, OSError, ValueError):  # no such package, or one that is left
            yield resolve_path(file, Path(), "mesh")
    if folder is None or "://" in name or "\0" in name:
        return
    path = (folder / name).resolve()
    if path.is_relative_to(folder.resolve()):
        yield path


@lru_cache(maxsize=128)
def _read(path: Path, scale: tuple[float, ...]) -> Surface | None:
    """Let yourdfpy read the file as the picture of a robot of one link."""
    try:
        import yourdfpy
    except ModuleNotFoundError:
        raise InputError("meshes need yourdfpy: pip install 'ckc_pin[view]'") from None
    mesh = yourdfpy.Mesh(filename=str(path), scale=np.array(scale))
    link = yourdfpy.Link("link", visuals=[yourdfpy.Visual(geometry=yourdfpy.Geometry(mesh=mesh))])
    robot = yourdfpy.Robot(name="mesh", links=[link])
    try:
        scene = yourdfpy.URDF(robot, filename_handler=lambda fname: fname, load_collision_meshes=False).scene
        parts = [part for part in scene.dump() if len(getattr(part, "faces", ()))]
    except Exception:  # whatever a damaged file makes the readers of a dozen formats raise
        return None
    if not parts or sum(len(part.faces) for part in parts) > MAX_FACES:
        return None
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    corners = np.concatenate([np.asarray(part.vertices, dtype=float) for part in parts])
    faces = np.concatenate([np.asarray(part.faces) + start for part, start in zip(parts, starts, strict=False)])
    return _joined(corners, faces) if np.all(np.isfinite(corners)) else None


def _joined(corners: Array, faces: IntArray) -> Surface:
    """Make corners one that are nearer than anybody sees: files have each as often as it has triangles or normals."""
    size = float(np.ptp(corners, axis=0).max(initial=0.0))
    if size == 0:
        return corners, faces
    grid = np.unique(np.round((corners - corners.min(axis=0)) / (NEAR * size)).astype(np.int64), axis=0,
                     return_index=True, return_inverse=True)  # fmt: skip
    own = grid[2].reshape(-1)[faces]
    flat = (own[:, 0] == own[:, 1]) | (own[:, 1] == own[:, 2]) | (own[:, 2] == own[:, 0])
    return corners[grid[1]], own[~flat]
