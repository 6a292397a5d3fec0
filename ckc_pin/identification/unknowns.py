"""Unknowns of an identification, and the parameters of the mechanism that they stand for.

A link of unknown inertia has ten unknowns: mass, first moment, and inertia about the link's origin. Torques and motions
depend on these alone, and torques linearly. The parameters are mass, centre of mass, and inertia about the centre.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from msgspec import field

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.base.validation import match_names
from ckc_pin.identification.physical import MIN_WEIGHT, nearest_physical
from ckc_pin.identification.pseudo_inertia import MOMENTS
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import ParameterMap, inertial_rotation
from ckc_pin.mechanism.parameters import INERTIA_ENTRIES

__all__ = ["INERTIAL", "LINK_VALUES", "ParameterValue", "Unknown", "Unknowns", "expand_names", "link_inertial_axes",
           "link_moments", "moment_unknowns", "total_mass", "typical_size"]  # fmt: skip

INERTIAL = "inertial"  # link.NAME.inertial: the ten numbers of a link
LINK_VALUES = ("mass", "com.x", "com.y", "com.z", *(f"inertia.{entry}" for entry in INERTIA_ENTRIES))
GRAVITY = 9.81  # m/s^2, of typical forces and times
POSITIVE = ("mass", "friction", "damping", "armature", "rotor_inertia", "stiffness", "length", "rest_length",
            "restitution", "torque_limit", "speed_limit")  # fmt: skip


class Unknown(Immutable, frozen=True):
    """A number that is estimated.

    Attributes
    ----------
    name : str
        A parameter's name; of a link's moments, ``link.NAME.moment.x`` and ``link.NAME.origin_inertia.ixx``.
    start : float
        Its value in the mechanism.
    scale : float
        A typical size, to compare numbers of different units.
    slopes : mapping of str to array
        For torques: derivatives of the numbers of `model_numbers`, of the friction (n,), of the offsets of motors
        (motors,), and of the dynamic parameters of bodies, ``body`` (joints - 1, 10).
    """

    name: str
    start: float
    scale: float
    slopes: Mapping[str, Array] = field(default_factory=dict)


class ParameterValue(Immutable, frozen=True):
    """A parameter as a function of the unknowns.

    Attributes
    ----------
    name : str
    value, start : float
    gradient : (p,) array
        By unknown.
    """

    name: str
    value: float
    start: float
    gradient: Array


class Unknowns:
    """Unknowns of an identification.

    Parameters
    ----------
    mechanism : Mechanism
        With the start values.
    unknowns : sequence of Unknown
    links : sequence of str
        Those whose ten inertial numbers are unknown.

    Attributes
    ----------
    names : list of str
    start, scale : (p,) arrays
    bodies : list of (10,) index arrays
        The unknowns of each of these links.
    """

    def __init__(self, mechanism: Mechanism, unknowns: Sequence[Unknown], links: Sequence[str]) -> None:
        self.mechanism, self.unknowns, self.links = mechanism, list(unknowns), list(links)
        self.names = [unknown.name for unknown in self.unknowns]
        self.start = np.array([unknown.start for unknown in self.unknowns])
        self.scale = np.array([unknown.scale for unknown in self.unknowns])
        at = {name: k for k, name in enumerate(self.names)}
        self.bodies: list[IntArray] = [
            np.array([at[f"link.{link}.{number}"] for number in MOMENTS], dtype=np.intp) for link in self.links
        ]

    def parameters_at(self, values: Array) -> list[ParameterValue]:
        """Return all parameters at values of the unknowns, (p,) in SI units."""
        parameters, in_links = [], {int(k) for at in self.bodies for k in at}
        for link, at in zip(self.links, self.bodies, strict=True):
            axes = link_inertial_axes(self.mechanism, link)
            here, start = (link_values(x[at], axes) for x in (values, self.start))
            gradients = np.zeros((len(LINK_VALUES), len(self.names)))
            for i, j in enumerate(at):
                moved = values[at].astype(complex)
                moved[i] += 1e-200j
                gradients[:, j] = link_values(moved, axes).imag / 1e-200
            for k, name in enumerate(LINK_VALUES):
                parameters.append(ParameterValue(f"link.{link}.{name}", float(here[k]), float(start[k]), gradients[k]))
        units = np.eye(len(self.names))
        for k, name in enumerate(self.names):
            if k not in in_links:
                parameters.append(ParameterValue(name, float(values[k]), float(self.start[k]), units[k]))
        return parameters

    def nearest_physical(
        self, measured: Array, determined: Array, information: Array, weight: float = MIN_WEIGHT
    ) -> Array:
        """Return steps of all unknowns from their start, in typical sizes, to values that some mechanism can have.

        See `physical.nearest_physical`.
        """
        in_bodies = {int(k) for at in self.bodies for k in at}
        positive = [k for k, x in enumerate(self.names) if k not in in_bodies and x.rpartition(".")[2] in POSITIVE]
        return nearest_physical(
            measured, determined, information, self.start, self.scale, self.bodies, np.array(positive, dtype=np.intp),
            weight,
        )  # fmt: skip


def total_mass(mechanism: Mechanism) -> float:
    """Return the mass of all bodies, kg; 1 if there is none."""
    return sum(inertia.mass for inertia in mechanism.tree.model.inertias) or 1.0


def typical_size(mechanism: Mechanism, unit: str) -> float:
    """Return a typical size of quantities of a unit, from the mechanism's mass, its size and gravity."""
    mass, size = total_mass(mechanism), mechanism.size
    sizes = {"kg": mass, "m": size, "s": (size / GRAVITY) ** 0.5, "N": mass * GRAVITY, "rad": 1.0, "": 1.0}
    value = 1.0
    for part, sign in zip(unit.split("/"), (1, -1), strict=False):
        for factor in part.split(" "):
            value *= sizes[factor.removesuffix("²")] ** (2 * sign if factor.endswith("²") else sign)
    return value


def moment_unknowns(mechanism: Mechanism, parameters: ParameterMap, link: str) -> list[Unknown]:
    """Return the ten unknowns of a link, in the link's frame."""
    start = link_moments(parameters, link)
    mass = start[0] or total_mass(mechanism)
    radius = np.sqrt((start[4] + start[6] + start[9]) / 2 / mass) or mechanism.size
    scales = mass * radius ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])
    return [Unknown(f"link.{link}.{number}", start[k], scales[k]) for k, number in enumerate(MOMENTS)]


def link_values(moments: Any, axes: Array) -> Any:
    """Return mass, centre of mass and inertia about it, in the axes of the file, of ten inertial numbers."""
    mass, moment = moments[0], moments[1:4]
    xx, xy, yy, xz, yz, zz = moments[4:]
    centre = moment / (mass if mass != 0 else 1.0)
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    inertia = inertia - mass * ((centre @ centre) * np.eye(3) - np.outer(centre, centre))
    inertia = axes.T @ inertia @ axes
    return np.array([mass, *centre, *(inertia[at] for at in INERTIA_ENTRIES.values())])


def link_inertial_axes(mechanism: Mechanism, link: str) -> Array:
    """Return the axes of a link's inertial frame in the link's frame, shape (3, 3)."""
    inertial = next(x for x in mechanism.urdf.findall("link") if x.attrib["name"] == link).find("inertial")
    assert inertial is not None
    return inertial_rotation(inertial)


def link_moments(parameters: ParameterMap, link: str) -> Array:
    """Return the ten inertial numbers of a link in its own frame."""
    values = parameters.values
    tensor = np.zeros((3, 3))
    for entry, (i, j) in INERTIA_ENTRIES.items():
        tensor[i, j] = tensor[j, i] = values[f"link.{link}.inertia.{entry}"]
    rotation, centre = link_inertial_axes(parameters.mechanism, link), np.array(values[f"link.{link}.com"])
    inertia = pin.Inertia(float(values[f"link.{link}.mass"]), centre, rotation @ tensor @ rotation.T)  # type: ignore[arg-type]
    return np.asarray(inertia.toDynamicParameters())


def expand_names(names: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """Return the names that patterns with wildcards stand for, in the order of the names, each once.

    If the ten numbers of a link are unknown, its single ones are left out.

    Raises
    ------
    InputError
        A pattern that no name matches.
    """
    names = list(names)
    matches = {name for pattern in patterns for name in match_names(pattern, names, "identify: parameters")}
    whole = tuple(name.removesuffix(INERTIAL) for name in matches if name.endswith(f".{INERTIAL}"))
    return [name for name in names if name in matches and (name.endswith(f".{INERTIAL}") or not name.startswith(whole))]
