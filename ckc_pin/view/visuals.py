"""What a mechanism looks like: the shapes of its URDFs, read from the texts a run carries."""

from __future__ import annotations

import math
import posixpath
from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.urdf import parse

__all__ = ["SHAPES", "Colour", "Visual", "visuals"]

Colour = tuple[float, float, float]

SHAPES = {"box": ("size", 3), "cylinder": ("radius length", 2), "sphere": ("radius", 1), "mesh": ("scale", 3)}


@dataclass(frozen=True)
class Visual:
    """A primitive or a mesh on a body.

    Attributes
    ----------
    link : str
    joint : int
        The body, by its joint; 0: the world.
    shape : "box", "cylinder" (along z), "sphere" or "mesh"
    size : tuple of float
        x, y, z; radius, length; radius; in metres. Of a mesh its scale along x, y, z.
    placement : (4, 4) array
        In the body's axes.
    colour : (r, g, b) in 0 ... 1, or None where the URDF has none
    file : str
        Of a mesh: its name in the mechanism's folder, or package://...
    """

    link: str
    joint: int
    shape: str
    size: tuple[float, ...]
    placement: Array
    colour: Colour | None
    file: str = ""


def visuals(mechanism: Mechanism) -> list[Visual]:
    """Return the shapes of all links; those that nobody knows are left out.

    Raises
    ------
    InputError
        A size, placement or colour that cannot be.
    """
    spec, text = mechanism.spec, mechanism.sources.text
    files = [(tree.file, tree.prefix) for tree in spec.tree] if spec.urdf is None else [(spec.urdf, "")]
    return [visual for file, prefix in files for visual in _of_tree(mechanism, text(file), file, prefix)]


def _of_tree(mechanism: Mechanism, text: str, source: str, prefix: str) -> Iterator[Visual]:
    robot = parse(text, source, prefix).root
    materials = {m.get("name"): _colour(m, f"{source}: material {m.get('name')!r}") for m in robot.findall("material")}
    for link in robot.findall("link"):
        name = link.attrib["name"]
        where = f"{source}: link {name!r}, <visual>"
        frame = mechanism.frames.links[name]
        for element in link.findall("visual"):
            shape = _shape(element)
            if shape is None:
                continue
            attributes, count = SHAPES[shape.tag]
            default = "1 1 1" if shape.tag == "mesh" else ""
            size = tuple(x for key in attributes.split() for x in _numbers(shape, key, default, where))
            if len(size) != count or (min(size) <= 0 and shape.tag != "mesh"):  # a mesh may be mirrored
                raise InputError(f"{where}: a {shape.tag} needs {attributes.replace(' ', ' and ')} above zero")
            material = element.find("material")
            colour = None if material is None else _colour(material, where) or materials.get(material.get("name"))
            placement = _homogeneous(frame.rotation, frame.translation) @ _origin(element, where)
            yield Visual(name, frame.joint, shape.tag, size, placement, colour, _mesh_file(shape, source))


def _mesh_file(shape: Element, source: str) -> str:
    """Return the name of a mesh file, which a URDF gives beside itself."""
    file = shape.get("filename", "")
    return file if "://" in file else posixpath.join(posixpath.dirname(source), file)


def _shape(visual: Element) -> Element | None:
    geometry = visual.find("geometry")
    return next((shape for shape in geometry or () if shape.tag in SHAPES), None)


def _origin(visual: Element, where: str) -> Array:
    origin = visual.find("origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = _numbers(origin, "xyz", "0 0 0", where), _numbers(origin, "rpy", "0 0 0", where)
    if len(xyz) != 3 or len(rpy) != 3:
        raise InputError(f"{where}: <origin> needs three numbers in xyz and in rpy")
    return _homogeneous(pin.rpy.rpyToMatrix(*rpy), np.array(xyz))


def _colour(material: Element, where: str) -> Colour | None:
    colour = material.find("color")
    if colour is None:
        return None
    rgba = _numbers(colour, "rgba", "", where)
    if len(rgba) != 4 or min(rgba) < 0 or max(rgba) > 1:
        raise InputError(f"{where}: a colour is rgba, four numbers from 0 to 1")
    return rgba[0], rgba[1], rgba[2]


def _numbers(element: Element, key: str, default: str, where: str) -> list[float]:
    text = element.get(key, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{where}: {key}={text!r} is not made of finite numbers")
    return numbers


def _homogeneous(rotation: Array, translation: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix
