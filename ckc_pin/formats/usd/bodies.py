"""Rigid bodies of USD: masses by the rules of UsdPhysicsMassAPI, and simple shapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import SubElement

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.formats.robot import Body, Link
from ckc_pin.formats.urdf.elements import format_numbers, make_visuals
from ckc_pin.formats.usd.stage import Stage

__all__ = ["SHAPES", "add_visuals", "read_link"]

SHAPES = ("Cube", "Sphere", "Cylinder", "Capsule")
WATER = 1000.0  # kg/m^3, USD's density of colliders for which the stage gives none


def read_link(stage: Stage, prim: Any, parts: Sequence[Any], notes: dict[str, list[str]]) -> Link:
    """Return a rigid body as a link, from its prim and all prims that belong to it.

    A mass overrides densities. The density of a collision shape comes from itself, its body, its material or water. A
    mass, centre or inertia of the body overrides that of its shapes. `notes` collects bodies by what was assumed.
    """
    link, (pose, _) = Link(), stage.pose(prim)
    into, total, problems = pose.inverse(), pin.Inertia.Zero(), set[str]()
    for part in parts:
        add_visuals(link, stage, part, into)
        if "PhysicsCollisionAPI" not in part.GetAppliedSchemas() or not stage.value(part, "physics:collisionEnabled"):
            continue
        is_simple, density = part.GetTypeName() in SHAPES, _density(stage, part, prim)
        if not is_simple or density is None:
            problems.add("the default density of 1000 kg/m^3" if is_simple else "no mass of their meshes")
        body = _body(stage, part, WATER if density is None else density) if is_simple else Body()
        body = body if part == prim else _override(stage, part, body)
        total += pin.Inertia(body.mass, body.centre, body.inertia)
    centre = total.lever if total.mass > 0 else pose.translation
    body = _override(stage, prim, Body(float(total.mass), centre, np.array(total.inertia)))
    if not body.inertia.any():
        problems = {f"no {'inertia' if body.mass else 'mass'}, because the file gives none"}
    elif all(_read_mass_key(stage, prim, key).any() for key in ("mass", "diagonalInertia")):
        problems = set()
    for problem in problems:
        notes.setdefault(f"bodies with {problem}", []).append(str(prim.GetName()))
    link.body = body.transformed(into)
    return link


def add_visuals(link: Link, stage: Stage, prim: Any, into: pin.SE3) -> None:
    """Add a simple shape to what is drawn of a link, unless it only guides."""
    from pxr import UsdGeom

    kind, colours = str(prim.GetTypeName()), stage.value(prim, "primvars:displayColor")
    if kind not in SHAPES or UsdGeom.Imageable(prim).ComputePurpose() == "guide":
        return
    pose, edges, radius, height = _measure(stage, prim)
    for visual in make_visuals(into * pose, {"Cube": "box"}.get(kind, kind.lower()), edges, radius, height):
        if colours:
            rgba = format_numbers([*colours[0], 1.0])
            SubElement(SubElement(visual, "material", name=""), "color", rgba=rgba)
        link.visuals.append(visual)


def _measure(stage: Stage, prim: Any) -> tuple[pin.SE3, Array, float, float]:
    """Return the pose of a shape, with z along its axis, and its edges or its radius and height (m)."""
    pose, scale = stage.pose(prim)
    axis, scale = "XYZ".index(str(stage.value(prim, "axis") or "Z")), np.abs(scale)
    size, radius, height = (stage.number(prim, key, 0.0) for key in ("size", "radius", "height"))
    if min(size, radius, height) < 0:
        raise InputError(f"{stage.where(prim)}: a negative size; expected a positive one")
    across = scale if prim.GetTypeName() == "Sphere" else np.delete(scale, axis)
    turn = pin.Quaternion.FromTwoVectors(np.eye(3)[2], np.eye(3)[axis]).matrix()
    return pose * pin.SE3(turn, np.zeros(3)), size * scale, radius * float(across.max()), height * float(scale[axis])


def _body(stage: Stage, prim: Any, density: float) -> Body:
    """Return a simple shape as a body in the axes of the world."""
    pose, edges, r, h = _measure(stage, prim)
    ball, rod = 4 / 3 * math.pi * r**3, math.pi * r**2 * h
    shapes: dict[str, tuple[float, Any, Sequence[float]]] = {
        "Cube": (float(edges.prod()), pin.Inertia.FromBox, edges.tolist()),
        "Sphere": (ball, pin.Inertia.FromSphere, [r]),
        "Cylinder": (rod, pin.Inertia.FromCylinder, [r, h]),
        "Capsule": (ball + rod, pin.Inertia.FromCapsule, [r, h]),
    }
    volume, make, sizes = shapes[str(prim.GetTypeName())]
    return Body(density * volume, inertia=np.array(make(density * volume, *sizes).inertia)).transformed(pose)


def _read_mass_key(stage: Stage, prim: Any, key: str) -> Array:
    """Return numbers of UsdPhysicsMassAPI, zeros if the prim does not give them."""
    default = [0.0] if key in ("mass", "density") else [0.0, 0.0, 0.0]
    return stage.numbers(prim, f"physics:{key}", default) if _has_mass(prim) else np.array(default)


def _has_mass(prim: Any) -> bool:
    return "PhysicsMassAPI" in prim.GetAppliedSchemas()


def _density(stage: Stage, shape: Any, body: Any) -> float | None:
    from pxr import UsdShade

    material = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial("physics")[0].GetPrim()
    densities = [float(_read_mass_key(stage, prim, "density")[0]) for prim in (shape, body)]
    densities += [stage.number(material, "physics:density", 0.0)] if material else []
    return next((x * stage.mass / stage.length**3 for x in densities if x > 0), None)


def _override(stage: Stage, prim: Any, body: Body) -> Body:
    """Return a body in the axes of the world with the mass, centre and inertia that a prim gives."""
    pose, scale = stage.pose(prim)
    mass, moments = (
        float(_read_mass_key(stage, prim, "mass")[0]) * stage.mass,
        _read_mass_key(stage, prim, "diagonalInertia"),
    )
    if mass < 0 or moments.min() < 0:
        raise InputError(f"{stage.where(prim)}: a negative mass or moment of inertia; expected positive ones")
    inertia = body.inertia * (mass / body.mass if mass and body.mass else 1.0)
    body = Body(mass or body.mass, body.centre, inertia)
    centre = stage.value(prim, "physics:centerOfMass") if _has_mass(prim) else None
    if centre is not None and np.isfinite(np.array(centre)).all():
        place = pose.act(scale * stage.numbers(prim, "physics:centerOfMass", [0.0, 0.0, 0.0]))
        offset, body.centre = body.centre - place, place
        if body.inertia.any():  # of the shapes, about another point now
            body.inertia = body.inertia + body.mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    if moments.any():
        axes = pose.rotation @ stage.rotation(prim, "physics:principalAxes")
        body.inertia = stage.mass * stage.length**2 * axes @ np.diag(moments) @ axes.T
    return body
