"""MuJoCo's shapes as a URDF's visuals."""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.formats.urdf.elements import add_shape, numbers

__all__ = ["draw"]

SPHERE, CAPSULE, CYLINDER, BOX = 2, 3, 5, 6  # mjtGeom


def draw(model: Any, geom: int, link: Element, pose: pin.SE3) -> bool:
    """Add a shape to a link as a visual at a pose; False where a URDF has no such shape."""
    kind = int(model.geom_type[geom])
    radius, half, _ = (float(x) for x in model.geom_size[geom])
    if kind == SPHERE:
        add_shape(link, pose, "sphere", radius=repr(radius))
    elif kind == BOX:
        add_shape(link, pose, "box", size=numbers(2 * model.geom_size[geom]))
    elif kind in (CYLINDER, CAPSULE):
        add_shape(link, pose, "cylinder", radius=repr(radius), length=repr(2 * half))
        for z in (-half, half) if kind == CAPSULE else ():
            add_shape(link, pose * pin.SE3(np.eye(3), np.array([0.0, 0.0, z])), "sphere", radius=repr(radius))
    return kind in (SPHERE, BOX, CYLINDER, CAPSULE)
