"""Mass and inertia of a MuJoCo body: as declared, or from the solids that it is made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.formats.draft import checked_direction
from ckc_pin.formats.mjcf.document import Attributes, Document
from ckc_pin.formats.orientation import from_z
from ckc_pin.formats.urdf.elements import Body, add_shape, numbers
from ckc_pin.mechanism.tree import Array

__all__ = ["Geom", "bounded", "declared", "from_geoms"]

SOLIDS = {"sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3}  # and how many sizes each has
WATER = 1000.0  # kg/m^3, MuJoCo's density where a model gives none
NOWHERE = np.zeros(3)


@dataclass(frozen=True)
class Geom:
    """A geom in its body's frame; `size` as MuJoCo has them (radii and half lengths)."""

    attributes: Attributes
    kind: str
    pose: pin.SE3
    size: Sequence[float]

    @classmethod
    def read(cls, a: Attributes, frame: pin.SE3, document: Document) -> Geom:
        """Read a geom's type, place and sizes."""
        kind = a.get("type", "sphere")
        count = SOLIDS.get(kind, 0)
        if count == 0 or "mesh" in a:
            return cls(a, "mesh" if "mesh" in a else kind, frame, ())
        if "fromto" not in a or kind == "sphere":
            return cls(a, kind, frame * document.pose(a), _positive(a.numbers("size", "", count)[:count], a))
        start, end = np.array(a.numbers("fromto", least=6)[:6]).reshape(2, 3)
        along = checked_direction(end - start, f"{a.where}: fromto, from one end to the other")
        radius, half = a.numbers("size", "", 1)[0], float(np.linalg.norm(along)) / 2
        size = [radius, half] if count == 2 else [radius, radius, half]
        return cls(a, kind, frame * pin.SE3(from_z(along), (start + end) / 2), _positive(size, a))

    def solid(self) -> Body | None:
        """Mass and inertia in the body's frame; None where the shape is unknown here (a mesh)."""
        if self.kind in ("plane", "hfield") or self.attributes.number("mass", 1.0) == 0:
            return Body(0.0, NOWHERE, np.zeros((3, 3)))
        if "mass" not in self.attributes and self.attributes.number("density", WATER) == 0:
            return Body(0.0, NOWHERE, np.zeros((3, 3)))
        if not self.size or self.attributes.flag("shellinertia", "false") == "true":
            return None
        volume, per_mass = _uniform(self.kind, self.size)
        density = self.attributes.number("density", WATER)
        mass = self.attributes.number("mass", density * volume)
        return Body(mass, NOWHERE, mass * np.diag(per_mass)).moved(self.pose)

    def draw(self, link: Element, body: pin.SE3) -> bool:
        """Add the shape to a link as a visual; False where a URDF has no such shape."""
        pose = body * self.pose
        if self.kind == "sphere":
            add_shape(link, pose, "sphere", radius=repr(self.size[0]))
        elif self.kind == "box":
            add_shape(link, pose, "box", size=numbers(2 * x for x in self.size))
        elif self.kind in ("cylinder", "capsule"):
            radius, half = self.size
            add_shape(link, pose, "cylinder", radius=repr(radius), length=repr(2 * half))
            for z in (-half, half) if self.kind == "capsule" else ():
                add_shape(link, pose * pin.SE3(np.eye(3), np.array([0.0, 0.0, z])), "sphere", radius=repr(radius))
        return self.kind in ("sphere", "box", "cylinder", "capsule")


def declared(a: Attributes, frame: pin.SE3, document: Document) -> Body:
    """Mass and inertia of an <inertial>, in the body's frame."""
    mass = a.numbers("mass", "", 1)[0]
    if "fullinertia" in a:
        xx, yy, zz, xy, xz, yz = a.numbers("fullinertia", least=6)[:6]
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        inertia = np.diag(a.numbers("diaginertia", "0 0 0", 3)[:3])
    return Body(mass, NOWHERE, inertia).moved(frame * document.pose(a))


def from_geoms(geoms: Sequence[Geom], document: Document) -> tuple[Body | None, list[Geom]]:
    """Mass and inertia of the geoms that count, and those whose mass is not known here."""
    first, last = (int(x) for x in document.compiler.numbers("inertiagrouprange", "0 5", 2)[:2])
    counting = [g for g in geoms if first <= int(g.attributes.number("group")) <= last]
    solids = [(g, g.solid()) for g in counting]
    body: Body | None = None
    for _, solid in solids:
        if solid is not None and solid.mass:
            body = solid if body is None else body + solid
    return body, [g for g, solid in solids if solid is None]


def bounded(body: Body, document: Document) -> Body:
    """Apply the compiler's boundmass, boundinertia and balanceinertia."""
    least = document.compiler.number("boundinertia")
    balance = document.compiler.flag("balanceinertia", "false") == "true"
    mass = max(body.mass, document.compiler.number("boundmass"))
    if not (least or balance):
        return Body(mass, body.centre, body.inertia)
    moments, axes = np.linalg.eigh(body.inertia)
    moments = np.maximum(moments, least)
    if balance and moments[0] + moments[1] < moments[2]:
        moments = np.full(3, moments.mean())
    return Body(mass, body.centre, axes @ np.diag(moments) @ axes.T)


def _uniform(kind: str, size: Sequence[float]) -> tuple[float, Array]:
    """Volume of a solid, and its principal moments per unit of mass."""
    if kind == "box":
        a, b, c = (2 * x for x in size)
        return a * b * c, np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 12
    if kind in ("sphere", "ellipsoid"):
        a, b, c = size if kind == "ellipsoid" else (size[0],) * 3
        return 4 / 3 * math.pi * a * b * c, np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 5
    r, length = size[0], 2 * size[1]
    if kind == "cylinder":
        across = (3 * r * r + length * length) / 12
        return math.pi * r * r * length, np.array([across, across, r * r / 2])
    tube, ball = length, 4 / 3 * r  # a capsule: a cylinder and two half balls; their volumes over pi r^2
    # a half ball's moment about an axis across it, through its flat side, is a ball's; its centre is 3 r / 8 from there
    shift = length * length / 4 + 3 * length * r / 8
    across = (tube * (3 * r * r + length * length) / 12 + ball * (2 * r * r / 5 + shift)) / (tube + ball)
    along = (tube * r * r / 2 + ball * 2 * r * r / 5) / (tube + ball)
    return math.pi * r * r * (tube + ball), np.array([across, across, along])


def _positive(size: Sequence[float], a: Attributes) -> Sequence[float]:
    if min(size) <= 0:
        raise InputError(f"{a.where}: size={a.get('size')!r}: positive numbers are needed")
    return size
