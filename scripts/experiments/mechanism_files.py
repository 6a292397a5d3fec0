"""Texts of mechanism files for generators of mechanisms: URDF elements, TOML values, planar chains, closing frames.

Shared by the random mechanisms of the fuzz suite (`fuzz`), those of the property tests (`tests/property`), the arms of
the sensitivity tests (`tests/sensitivity/spatial.py`), and planar linkages (`stability/planar.py`,
`tests/analysis/planar.py`). It imports nothing of the package, so that references can use it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "PlanarLink",
    "closing_frame",
    "format_numbers",
    "planar_chain",
    "roll_pitch_yaw",
    "toml_value",
    "urdf_joint",
    "urdf_link",
    "urdf_robot",
]

Array = NDArray[np.float64]
Placement = tuple[Array, Array]  # rotation (3, 3) and origin (3,)

WIDE_LIMIT = '<limit lower="-100" upper="100" effort="1" velocity="1"/>'  # of a revolute joint that never reaches it


def format_numbers(numbers: Iterable[float]) -> str:
    """Return numbers as a URDF attribute, with all digits."""
    return " ".join(repr(float(x)) for x in numbers)


def toml_value(value: Any) -> str:
    """Return a value as TOML: as JSON except for tables, whose entries of None are left out."""
    if isinstance(value, dict):
        entries = (f"{json.dumps(key)} = {toml_value(x)}" for key, x in value.items() if x is not None)
        return "{" + ", ".join(entries) + "}"
    if isinstance(value, np.ndarray):
        return toml_value(value.tolist())
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return json.dumps(value)


def urdf_link(name: str, mass: float, com: Array, inertia: Array) -> str:
    """Return a URDF link with its inertia about its centre of mass."""
    entries = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    moments = " ".join(f'{key}="{float(inertia[entry])!r}"' for key, entry in entries.items())
    return (
        f'  <link name="{name}"><inertial><origin xyz="{format_numbers(com)}"/><mass value="{float(mass)!r}"/>\n'
        f"    <inertia {moments}/></inertial></link>"
    )


def urdf_joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: Iterable[float] = (0, 0, 0),
    rpy: Iterable[float] = (0, 0, 0),
    axis: Iterable[float] | None = None,
    limit: str = "",
) -> str:
    """Return a URDF joint. `limit` is an element; a fixed joint has no axis."""
    axis_element = "" if axis is None else f'<axis xyz="{format_numbers(axis)}"/>'
    return (
        f'  <joint name="{name}" type="{kind}">\n    <parent link="{parent}"/><child link="{child}"/>\n'
        f'    <origin xyz="{format_numbers(xyz)}" rpy="{format_numbers(rpy)}"/>{axis_element}{limit}\n  </joint>'
    )


def urdf_robot(name: str, elements: Iterable[str]) -> str:
    """Return a URDF file."""
    return f'<robot name="{name}">\n' + "\n".join(elements) + "\n</robot>\n"


def roll_pitch_yaw(R: Array) -> Array:
    """Return URDF's roll, pitch and yaw of a rotation."""
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


def closing_frame(a: Placement, b: Placement, xyz: Array, R: Array | None = None) -> tuple[Array, Array]:
    """Return xyz and rpy, in body B, of the frame that coincides with a frame of body A.

    Parameters
    ----------
    a, b : (rotation, origin)
        Placements of the bodies in the world.
    xyz, R : (3,) array, (3, 3) array
        The frame in body A; default rotation: none.
    """
    (R_A, p_A), (R_B, p_B) = a, b
    R_frame = R_A if R is None else R_A @ R
    return R_B.T @ (p_A + R_A @ xyz - p_B), roll_pitch_yaw(R_B.T @ R_frame)


@dataclass(frozen=True)
class PlanarLink:
    """A link along +x that a revolute joint turns about z.

    Attributes
    ----------
    joint, name : str
        Of its joint, and of the link.
    length, com : float
        From its joint to the next one and to the centre of mass, m.
    mass : float
        kg.
    inertia : (3,)
        Principal moments about the centre of mass, kg m^2.
    """

    joint: str
    name: str
    length: float
    com: float
    mass: float
    inertia: tuple[float, float, float]


def planar_chain(start: float, links: Sequence[PlanarLink], end_joint: str, tip: str, kind: str) -> list[str]:
    """Return URDF elements of a chain on link "base" that begins at x = `start` and ends with a massless link.

    Parameters
    ----------
    start : float
        m.
    links : sequence of PlanarLink
    end_joint, tip : str
        Names of the fixed joint and the link at the end.
    kind : "continuous" or "revolute"
        Of the joints; revolute ones get wide limits.
    """
    elements, parent, x = [f'  <link name="{tip}"/>'], "base", start
    limit = WIDE_LIMIT if kind == "revolute" else ""
    for link in links:
        elements.append(urdf_link(link.name, link.mass, np.array([link.com, 0.0, 0.0]), np.diag(link.inertia)))
        elements.append(urdf_joint(link.joint, kind, parent, link.name, (x, 0, 0), axis=(0, 0, 1), limit=limit))
        parent, x = link.name, link.length
    elements.append(urdf_joint(end_joint, "fixed", parent, tip, (x, 0, 0)))
    return elements
