"""Visual shapes of links: the <visual> elements of URDFs, and the triangles of their mesh files."""

from __future__ import annotations

import math
import posixpath
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.sources import PACKAGE, resolve_path
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.urdf import parse
from ckc_pin.view.geometry import homogeneous

__all__ = ["SHAPES", "Colour", "Surface", "Visual", "load_surface", "read_visuals"]

Colour = tuple[float, float, float]  # red, green, blue from 0 to 1
Surface = tuple[Array, IntArray]  # corners (m, 3), m, and faces (k, 3) as indices of corners

SHAPES = {"box": ("size", 3), "cylinder": ("radius length", 2), "sphere": ("radius", 1), "mesh": ("scale", 3)}

MAX_MESH_BYTES = 2**26  # per file
MAX_FACES = 2**20  # per surface; browsers still display that many smoothly
MERGE_TOLERANCE = 5e-4  # of a surface's size: corners closer than this become one


@dataclass(frozen=True)
class Visual:
    """A primitive shape or a mesh of a body.

    Attributes
    ----------
    link : str
    joint : int
        Joint of the body; 0 is the world.
    shape : "box", "cylinder" (along z), "sphere" or "mesh"
    size : tuple of float
        x, y, z of a box; radius and length; radius; metres. For a mesh the scale along x, y, z.
    placement : (4, 4) array
        In the body's axes.
    colour : (r, g, b) from 0 to 1, or None if the URDF specifies none
    file : str
        File name of a mesh in the mechanism's folder, or package://...
    """

    link: str
    joint: int
    shape: str
    size: tuple[float, ...]
    placement: Array
    colour: Colour | None
    file: str = ""


# --- URDF ----------------------------------------------------------------------------------------


def read_visuals(mechanism: Mechanism) -> list[Visual]:
    """Return the visual shapes of all links; unsupported shapes are left out.

    Raises
    ------
    InputError
        Invalid size, placement or colour.
    """
    spec, text = mechanism.spec, mechanism.sources.text
    files = [(tree.file, tree.prefix) for tree in spec.tree] if spec.urdf is None else [(spec.urdf, "")]
    return [visual for file, prefix in files for visual in _read_tree(mechanism, text(file), file, prefix)]


def _read_tree(mechanism: Mechanism, text: str, source: str, prefix: str) -> Iterator[Visual]:
    robot = parse(text, source, prefix).root
    materials = {m.get("name"): _read_colour(m, f"{source}: material {m.get('name')!r}")
                 for m in robot.findall("material")}  # fmt: skip
    for link in robot.findall("link"):
        name = link.attrib["name"]
        where = f"{source}: link {name!r}, <visual>"
        frame = mechanism.frames.links[name]
        for element in link.findall("visual"):
            shape = _find_shape(element)
            if shape is None:
                continue
            attributes, count = SHAPES[shape.tag]
            default = "1 1 1" if shape.tag == "mesh" else ""
            size = tuple(x for key in attributes.split() for x in _read_numbers(shape, key, default, where))
            if len(size) != count or (min(size) <= 0 and shape.tag != "mesh"):  # A negative scale mirrors a mesh.
                raise InputError(f"{where}: a {shape.tag} needs {attributes.replace(' ', ' and ')} above zero")
            material = element.find("material")
            colour = None if material is None else _read_colour(material, where) or materials.get(material.get("name"))
            placement = homogeneous(frame.rotation, frame.translation) @ _read_origin(element, where)
            yield Visual(name, frame.joint, shape.tag, size, placement, colour, _mesh_path(shape, source))


def _mesh_path(shape: Element, source: str) -> str:
    """Return the path of a mesh file in the mechanism's folder; a URDF gives it relative to itself."""
    file = shape.get("filename", "")
    return file if "://" in file else posixpath.join(posixpath.dirname(source), file)


def _find_shape(visual: Element) -> Element | None:
    geometry = visual.find("geometry")
    return next((shape for shape in geometry or () if shape.tag in SHAPES), None)


def _read_origin(visual: Element, where: str) -> Array:
    origin = visual.find("origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = _read_numbers(origin, "xyz", "0 0 0", where), _read_numbers(origin, "rpy", "0 0 0", where)
    if len(xyz) != 3 or len(rpy) != 3:
        raise InputError(f"{where}: <origin> needs three numbers in xyz and in rpy")
    return homogeneous(pin.rpy.rpyToMatrix(*rpy), np.array(xyz))


def _read_colour(material: Element, where: str) -> Colour | None:
    colour = material.find("color")
    if colour is None:
        return None
    rgba = _read_numbers(colour, "rgba", "", where)
    if len(rgba) != 4 or min(rgba) < 0 or max(rgba) > 1:
        raise InputError(f"{where}: rgba must be four numbers from 0 to 1")
    return rgba[0], rgba[1], rgba[2]


def _read_numbers(element: Element, key: str, default: str, where: str) -> list[float]:
    text = element.get(key, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{where}: {key}={text!r} must consist of finite numbers")
    return numbers


# --- mesh files ----------------------------------------------------------------------------------


def load_surface(file: str, scale: tuple[float, ...], folder: Path | None) -> Surface | None:
    """Load a mesh file in its link's axes; None if the file is missing, damaged or too large.

    Parameters
    ----------
    file : str
        A name in the mechanism's folder, or ``package://PACKAGE/PATH``. No other file is opened.
    scale : (x, y, z)
    folder : Path or None
        The mechanism's folder. A saved run has none.
    """
    for path in _candidate_paths(file, folder):
        try:
            if path.is_file() and path.stat().st_size <= MAX_MESH_BYTES:
                return _read_mesh(path, scale)
        except OSError:
            continue
    return None


def _candidate_paths(file: str, folder: Path | None) -> Iterator[Path]:
    """Yield where a mesh file may be: inside the package that it names, then inside the folder."""
    name = file
    if file.startswith(PACKAGE):
        name = file.removeprefix(PACKAGE).partition("/")[2]
        with suppress(InputError, OSError, ValueError):  # no such package, or a path that leaves it
            yield resolve_path(file, Path(), "mesh")
    if folder is None or "://" in name or "\0" in name:
        return
    path = (folder / name).resolve()
    if path.is_relative_to(folder.resolve()):
        yield path


@lru_cache(maxsize=128)
def _read_mesh(path: Path, scale: tuple[float, ...]) -> Surface | None:
    """Read a mesh with yourdfpy, as the visual of a robot with one link."""
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
    except Exception:  # A damaged file makes the readers of a dozen formats raise any kind of error.
        return None
    if not parts or sum(len(part.faces) for part in parts) > MAX_FACES:
        return None
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    corners = np.concatenate([np.asarray(part.vertices, dtype=float) for part in parts])
    faces = np.concatenate([np.asarray(part.faces) + start for part, start in zip(parts, starts, strict=False)])
    return _merge_corners(corners, faces) if np.all(np.isfinite(corners)) else None


def _merge_corners(corners: Array, faces: IntArray) -> Surface:
    """Merge corners that coincide. Mesh files repeat a corner for each of its triangles or normals."""
    size = float(np.ptp(corners, axis=0).max(initial=0.0))
    if size == 0:
        return corners, faces
    cells = np.round((corners - corners.min(axis=0)) / (MERGE_TOLERANCE * size)).astype(np.int64)
    _, representatives, cell_numbers = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    merged = cell_numbers.reshape(-1)[faces]
    is_degenerate = (merged[:, 0] == merged[:, 1]) | (merged[:, 1] == merged[:, 2]) | (merged[:, 2] == merged[:, 0])
    return corners[representatives], merged[~is_degenerate]
