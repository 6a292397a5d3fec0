"""The map from named parameters to the numbers of a mechanism's model, differentiable, for many values at once.

Names are those of `mechanism.parameters`. The map evaluates what building the mechanism from changed files gives, as
arrays with a row for each set of values. Ensembles evaluate it at real values. Sensitivities and linear models take its
derivatives by the complex step, which are exact up to rounding.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.mechanism.couplings import find_coupling
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import INERTIA_ENTRIES, Value, split_component, split_name, values_of
from ckc_pin.mechanism.rows import Affine, Distance
from ckc_pin.mechanism.spec import FrameSpec, MechanismSpec

__all__ = [
    "ParameterMap",
    "inertial_rotation",
    "list_line_springs",
    "list_loop_frames",
    "list_spring_ends",
    "model_numbers",
]

Numbers = NDArray[Any]  # real, or complex for a derivative

COMPLEX_STEP = 1e-200
REPRODUCTION_TOLERANCE = 1e-12  # of the largest number of a kind
NON_NEGATIVE = ("stiffness", "damping", "rest_length", "friction", "armature", "restitution")


def list_loop_frames(spec: MechanismSpec) -> list[tuple[str, str | FrameSpec]]:
    """Return the frames of all loops with the beginnings of their parameters' names, in the order of the points."""
    return [(f"loop.{x.name}.{end}", getattr(x, end)) for end in ("frame_a", "frame_b") for x in spec.loop]


def list_line_springs(spec: MechanismSpec) -> list[int]:
    """Return the indices of the springs between frames."""
    return [k for k, spring in enumerate(spec.spring) if spring.joint is None]


def list_spring_ends(spec: MechanismSpec) -> list[tuple[str, str | FrameSpec | None]]:
    """Return the ends of all springs between frames with the beginnings of their parameters' names."""
    lines = list_line_springs(spec)
    return [(f"spring.{k}.{end}", getattr(spec.spring[k], end)) for end in ("frame_a", "frame_b") for k in lines]


def model_numbers(mechanism: Mechanism) -> dict[str, Array]:
    """Return the numbers of a mechanism's model, in SI units.

    Keys and shapes: gravity (3); by joint, the world's first, offset and centre (joints, 3), mass (joints) and inertia
    about the centre (joints, 3, 3); armature (n); rotors (n, n), the upper triangle of what rotors of
    motors on several joints add to D'; by loop frame point (frames, 3); by row length and affine_offset
    (rows), affine (rows, n); by coordinate constant, joint_stiffness, joint_rest, joint_damping (n); by spring end
    (2 springs, 3), stiffness, rest_length, damping (springs).
    """
    model, closure, springs, n = mechanism.tree.model, mechanism.closure, mechanism.springs, mechanism.tree.n
    length, affine_offset = np.zeros(closure.rows), np.zeros(closure.rows)
    affine = np.zeros((closure.rows, n))
    for group in closure.groups:
        if isinstance(group, Distance):
            length[group.out] = group.length
        elif isinstance(group, Affine):
            affine[group.out], affine_offset[group.out] = group.matrix, group.offset
    return {
        "gravity": np.array(model.gravity.linear),
        "offset": np.array([placement.translation for placement in model.jointPlacements]),
        "mass": np.array([inertia.mass for inertia in model.inertias]),
        "centre": np.array([inertia.lever * (inertia.mass > 0) for inertia in model.inertias]),
        "inertia": np.array([inertia.inertia for inertia in model.inertias]),
        "armature": np.array(model.armature),
        "rotors": np.triu(mechanism.tree.rotors),
        "point": np.reshape(closure.anchors.point_local, (-1, 3)),
        "length": length,
        "affine": affine,
        "affine_offset": affine_offset,
        "constant": springs.constant,
        "joint_stiffness": springs.joint_stiffness,
        "joint_rest": springs.joint_rest,
        "joint_damping": springs.joint_damping,
        "end": np.reshape(springs.anchors.point_local, (-1, 3)),
        "stiffness": springs.stiffness,
        "rest_length": springs.rest_length,
        "damping": springs.damping,
    }


class ParameterMap:
    """The numbers of a mechanism's model as functions of named parameters.

    Beside those of `model_numbers`: by joint rotation (joints, 3, 3) of its placement, and of its body about the
    joint's origin moment = mass * centre (joints, 3) and origin_inertia (joints, 3, 3); by loop frame
    point_rotation (frames, 3, 3); reported (points, 3), the mechanism's named points; friction, restitution, lower,
    upper (n); by motor torque_limit (2, m) and transmission (m, n).

    Parameters
    ----------
    mechanism : Mechanism
    overrides : mapping, optional
        Parameters that the mechanism was built with. A mass scales its link's inertia except for entries that are
        given here.
    rebuild : callable, optional
        Builds the mechanism from other overrides. It is needed for a link whose mass was overridden with zero: how
        its inertia grows with the mass is known from the file alone.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        overrides: Mapping[str, Value] | None = None,
        rebuild: Callable[[Mapping[str, Value]], Mechanism] | None = None,
    ) -> None:
        self.mechanism, self.overrides, self._rebuild = mechanism, dict(overrides or {}), rebuild
        self.values = values_of(mechanism.spec, mechanism.urdf)
        self.numbers = model_numbers(mechanism)
        self.all_numbers = {**self.numbers, **_more_numbers(mechanism, self.numbers)}

    def value_of(self, name: str) -> float:
        """Return a single parameter's value: a number, or a component of a vector."""
        vector, axis = split_component(name)
        value = self.values[name if name in self.values else vector]
        return value[axis] if isinstance(value, tuple) else value

    def evaluate(self, names: Sequence[str], values: Array) -> tuple[dict[str, Array], BoolArray]:
        """Evaluate the numbers that differ from the mechanism's.

        Parameters
        ----------
        names : sequence of str
            Single parameters.
        values : (members, names) array

        Returns
        -------
        dict of str to (members, ...) array
            Numbers that depend on the parameters, by key; the others are left out.
        (members,) array of bool
            Which members are physical as far as is checked here: finite, masses positive, inertias positive
            semidefinite, stiffness, damping, friction and lengths not negative.
        """
        members = _Members(self, names, values)
        members.add_entries()
        members.add_geometry()
        return members.numbers, members.is_physical

    def derivative(self, name: str) -> dict[str, Array]:
        """Return the derivatives of all numbers that depend on a single parameter, shapes as of the numbers."""
        return self.derivatives([name])[name]

    def derivatives(self, names: Sequence[str]) -> dict[str, dict[str, Array]]:
        """Return `derivative` of many single parameters, by name."""
        masses = [name for name in names if name.endswith(".mass")]  # scale inertias, which other names would fix
        slopes: dict[str, dict[str, Array]] = {}
        for group in (masses, [name for name in names if name not in masses]):
            values = np.array([self.value_of(name) for name in group])
            _, together = self.linearize(group, values) if group else ({}, {})
            for k, name in enumerate(group):
                slopes[name] = {key: slope[k] for key, slope in together.items() if slope[k].any()}
        return slopes

    def linearize(self, names: Sequence[str], values: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return the numbers that depend on single parameters, and their derivatives (names, ...), at other values."""
        numbers, _ = self.evaluate(names, values + 1j * COMPLEX_STEP * np.eye(len(names)))
        slopes = {key: np.array([_clean(slope) for slope in x.imag / COMPLEX_STEP]) for key, x in numbers.items()}
        return {key: x[0].real for key, x in numbers.items()}, slopes

    def reproduces(self, names: Sequence[str]) -> bool:
        """Whether the mechanism's own values give its own numbers up to rounding."""
        numbers, _ = self.evaluate(names, np.array([[self.value_of(name) for name in names]]))
        for key, x in numbers.items():
            base = self.all_numbers[key]
            atol = REPRODUCTION_TOLERANCE * np.abs(base).max(initial=1e-3)
            if not np.allclose(x[0], base, rtol=0, atol=atol):
                return False
        return True

    def inertia_per_mass(self, link: str) -> Array:
        """Return how a link's inertia about its centre grows with its mass, (3, 3), in its inertial frame's axes."""
        values: Mapping[str, Value] = self.values
        key = f"link.{link}.mass"
        if not self.value_of(key) and key in self.overrides and self._rebuild:
            original = self._rebuild({name: x for name, x in self.overrides.items() if name != key})
            values = values_of(original.spec, original.urdf)
        mass = values[key]
        assert not isinstance(mass, tuple)
        tensor = np.zeros((3, 3))
        for entry, (i, j) in INERTIA_ENTRIES.items():
            name = f"link.{link}.inertia.{entry}"
            if name not in self.overrides and mass > 0:
                tensor[i, j] = tensor[j, i] = float(values[name]) / mass  # type: ignore[arg-type]
        return tensor


def _more_numbers(mechanism: Mechanism, numbers: Mapping[str, Array]) -> dict[str, Array]:
    """Numbers that compiled terms do not take."""
    model, joints, motors = mechanism.tree.model, mechanism.joints, mechanism.motors
    mass, centre = numbers["mass"], numbers["centre"]
    around = np.array([m * _point_inertia(c) for m, c in zip(mass, centre, strict=True)])
    placed = [mechanism.frames.find(frame, "parameters") for _, frame in list_loop_frames(mechanism.spec)]
    return {
        "rotation": np.array([placement.rotation for placement in model.jointPlacements]),
        "moment": mass[:, None] * centre,
        "origin_inertia": numbers["inertia"] + around,
        "point_rotation": np.reshape([frame.rotation for frame in placed], (-1, 3, 3)),
        "reported": np.reshape([frame.translation for frame in mechanism.points.values()], (-1, 3)),
        "friction": joints.friction,
        "restitution": joints.restitution,
        "lower": joints.lower,
        "upper": joints.upper,
        "torque_limit": motors.torque_limit,
        "transmission": motors.transmission,
    }


class _Members:
    """One evaluation of the map: numbers with a leading axis of members where they depend on the parameters."""

    def __init__(self, parameters: ParameterMap, names: Sequence[str], values: Numbers) -> None:
        self.map, self.mechanism, self.count = parameters, parameters.mechanism, len(values)
        self.numbers: dict[str, Numbers] = {}
        self.is_physical: BoolArray = np.all(np.isfinite(values), axis=1)
        self.member_values: dict[str, Numbers] = {}  # by vector or scalar parameter
        for name, column in zip(names, values.T, strict=True):
            vector, axis = split_component(name)
            if name in parameters.values:
                self.member_values[name] = column
                continue
            if vector not in self.member_values:
                start = np.array(parameters.values[vector], dtype=values.dtype)
                self.member_values[vector] = np.tile(start, (self.count, 1))
            self.member_values[vector][:, axis] = column

    # --- numbers that stand in the model as in the file ---

    def add_entries(self) -> None:
        """Add numbers of gravity, joints, loops, couplings, springs, forces and motors."""
        add = {"joint": self._add_joint, "loop": self._add_loop, "coupling": self._add_coupling,
               "spring": self._add_spring, "force": self._add_force, "motor": self._add_motor}  # fmt: skip
        for name, column in self.member_values.items():
            root, carrier, key = split_name(name)
            if root == "gravity":
                self.numbers["gravity"] = column
            elif root in add and column.ndim == 1:
                if key in NON_NEGATIVE:
                    self.is_physical &= column.real >= 0
                add[root](name, carrier, key, column)

    def _add_joint(self, name: str, carrier: str, key: str, column: Numbers) -> None:
        at = self.mechanism.tree.index[carrier]
        if key in ("damping", "armature"):  # springs and motors add to the same number
            self._increase("joint_damping" if key == "damping" else key, at, column - self.map.value_of(name))
        else:
            self._set(key, at, column)

    def _add_loop(self, name: str, carrier: str, key: str, column: Numbers) -> None:
        self.is_physical &= column.real > 0
        self._set("length", self.mechanism.closure.names.index((carrier, "length")), column)

    def _add_coupling(self, name: str, carrier: str, key: str, column: Numbers) -> None:
        number = find_coupling(self.mechanism.spec, carrier)
        row = [k for k, (_, kind) in enumerate(self.mechanism.closure.names) if kind == "coupling"][number]
        if key == "offset":
            self._set("affine_offset", row, column)
        elif key == "ratio":
            other = str(self.mechanism.spec.coupling[number].other)
            self._set("affine", (row, self.mechanism.tree.index[other]), -column)
        else:
            self._set("affine", (row, self.mechanism.tree.index[key.removeprefix("joints.")]), column)

    def _add_spring(self, name: str, carrier: str, key: str, column: Numbers) -> None:
        spring = self.mechanism.spec.spring[int(carrier)]
        if spring.joint is None:
            self._set(key, list_line_springs(self.mechanism.spec).index(int(carrier)), column)
        elif key == "damping":
            at = self.mechanism.tree.index[spring.joint]
            self._increase("joint_damping", at, column - spring.damping)
        else:
            self._set(f"joint_{key}", self.mechanism.tree.index[spring.joint], column)

    def _add_force(self, name: str, carrier: str, key: str, column: Numbers) -> None:
        force = self.mechanism.spec.force[int(carrier)]
        self._increase("constant", self.mechanism.tree.index[force.joint], column - force.value)

    def _add_motor(self, name: str, carrier: str, key: str, column: Numbers) -> None:
        number = self.mechanism.motors.names.index(carrier)
        motor, gear = self.mechanism.spec.motor[number], self.mechanism.motors.transmission[number]
        ratio = self.member_values.get(f"motor.{carrier}.ratio", motor.ratio)
        inertia = self.member_values.get(f"motor.{carrier}.rotor_inertia", motor.rotor_inertia)
        if key in ("torque_limit", "torque_limit.lower"):
            self._set("torque_limit", (0, number), column if key.endswith("lower") else -column)
        if key in ("torque_limit", "torque_limit.upper"):
            self._set("torque_limit", (1, number), column)
        if key == "ratio":
            self._set("transmission", number, gear * (column / motor.ratio)[:, None])
        if key == "rotor_inertia" or (key == "ratio" and f"motor.{carrier}.rotor_inertia" not in self.member_values):
            step: Numbers = np.asarray((ratio / motor.ratio) ** 2 * inertia - motor.rotor_inertia)
            driven = [int(at) for at in np.flatnonzero(gear)]
            if len(driven) == 1:
                self._increase("armature", driven[0], gear[driven[0]] ** 2 * step)
            else:
                self._array("rotors")[:] += np.triu(np.outer(gear, gear)) * step[:, None, None]

    def _set(self, key: str, at: Any, column: Numbers) -> None:
        where = at if isinstance(at, tuple) else (at,)
        self._array(key)[(slice(None), *where)] = column

    def _increase(self, key: str, at: int, column: Numbers) -> None:
        self._array(key)[:, at] += column

    def _array(self, key: str) -> Numbers:
        if key not in self.numbers:
            start = self.map.all_numbers[key]
            dtype = np.result_type(float, *self.member_values.values())
            self.numbers[key] = np.tile(start.astype(dtype), (self.count, *([1] * start.ndim)))
        return self.numbers[key]

    # --- numbers that follow from where links, joints and frames are placed ---

    def add_geometry(self) -> None:
        """Add placements of joints, bodies, loop frames, spring ends and points."""
        if not any(
            name.startswith("link.") or (x.ndim > 1 and name != "gravity") for name, x in self.member_values.items()
        ):
            return
        spec = self.mechanism.spec
        self.links: dict[str, tuple[int, Numbers, Numbers]] = {}  # body, rotation, translation in it
        self.joints: dict[str, tuple[int, Numbers, Numbers]] = {}
        with np.errstate(all="ignore"):  # members that are not physical
            self._place_links()
            self._add_bodies()
            loops, ends = list_loop_frames(spec), list_spring_ends(spec)
            points = [("", point.frame) for point in spec.point]
            for key, frames in (("point", loops), ("end", ends), ("reported", points)):
                for k, (name, frame) in enumerate(frames):
                    rotation, translation = self._place_frame(name, frame)
                    self._set_if_dependent(key, k, translation, 1)
                    if key == "point":
                        self._set_if_dependent("point_rotation", k, rotation, 2)

    def _value(self, name: str) -> Numbers:
        return self.member_values.get(name, np.array(self.map.values.get(name, (0.0, 0.0, 0.0)), dtype=float))

    def _set_if_dependent(self, key: str, at: int, x: Numbers, ndim: int) -> None:
        if x.ndim > ndim:
            self._set(key, at, x)

    def _place_links(self) -> None:
        """Place all links in the bodies that they are part of, and joints in the bodies that carry them."""
        joints = self.mechanism.urdf.findall("joint")
        children = {_link(joint, "child") for joint in joints}
        for link in self.mechanism.urdf.findall("link"):
            if link.attrib["name"] not in children:
                self.links[link.attrib["name"]] = (0, np.eye(3), np.zeros(3))
        remaining = list(joints)
        while remaining:
            joint = next(joint for joint in remaining if _link(joint, "parent") in self.links)
            remaining.remove(joint)
            name = joint.attrib["name"]
            body, rotation, translation = self.links[_link(joint, "parent")]
            translation = translation + _turn(rotation, self._value(f"joint.{name}.xyz"))
            rotation = rotation @ _rpy_matrix(self._value(f"joint.{name}.rpy"))
            if self.mechanism.tree.model.existJointName(name):
                body = self.mechanism.tree.model.getJointId(name)
                self._set_if_dependent("offset", body, translation, 1)
                self._set_if_dependent("rotation", body, rotation, 2)
                rotation, translation = np.eye(3), np.zeros(3)
            self.joints[name] = self.links[_link(joint, "child")] = (body, rotation, translation)

    def _add_bodies(self) -> None:
        """Put together the links that fixed joints make one body."""
        parts: dict[int, list[tuple[Numbers, Numbers, Numbers, Numbers]]] = defaultdict(list)
        for link in self.mechanism.urdf.findall("link"):
            name, inertial = link.attrib["name"], link.find("inertial")
            body, rotation, translation = self.links[name]
            if body == 0 or inertial is None:
                continue
            mass = self._value(f"link.{name}.mass")
            centre = translation + _turn(rotation, self._value(f"link.{name}.com"))
            inertia = self._link_inertia(name, mass)
            parts[body].append((mass, centre, rotation @ inertial_rotation(inertial), inertia))
        for body, links in parts.items():
            self._add_body(body, links)

    def _add_body(self, body: int, parts: Sequence[tuple[Numbers, Numbers, Numbers, Numbers]]) -> None:
        """Add a body made of links: of each the mass, centre, rotation, and inertia about the centre."""
        if not any(x.ndim > ndim for part in parts for x, ndim in zip(part, (0, 1, 2, 2), strict=True)):
            return
        total = sum((mass for mass, *_ in parts), np.zeros(()))
        moment = sum((mass[..., None] * c for mass, c, *_ in parts), np.zeros(3))
        centre = moment / total[..., None]
        inertia: Numbers = np.zeros((3, 3))
        origin_inertia: Numbers = np.zeros((3, 3))
        for mass, c, rotation, tensor in parts:
            turned = rotation @ tensor @ np.swapaxes(rotation, -1, -2)
            inertia = inertia + turned + mass[..., None, None] * _point_inertia(c - centre)
            origin_inertia = origin_inertia + turned + mass[..., None, None] * _point_inertia(c)
        members = {"mass": (total, 0), "moment": (moment, 1), "origin_inertia": (origin_inertia, 2)}
        if np.all(total != 0):
            members |= {"centre": (centre, 1), "inertia": (inertia, 2)}
        for key, (x, ndim) in members.items():
            self._set_if_dependent(key, body, x, ndim)

    def _link_inertia(self, name: str, mass: Numbers) -> Numbers:
        """A link's inertia about its centre: a new mass is the same body of another density."""
        values = self.map.values
        tensor: Numbers = np.zeros((3, 3))
        for entry, (i, j) in INERTIA_ENTRIES.items():
            tensor[i, j] = tensor[j, i] = values[f"link.{name}.inertia.{entry}"]
        if mass.ndim:
            self.is_physical &= mass.real > 0
            step = mass - self.map.value_of(f"link.{name}.mass")
            tensor = tensor + step[:, None, None] * self.map.inertia_per_mass(name)
        entries = [entry for entry in INERTIA_ENTRIES if f"link.{name}.inertia.{entry}" in self.member_values]
        if entries:
            dtype = np.result_type(tensor, *self.member_values.values())
            tensor = np.array(np.broadcast_to(tensor, (self.count, 3, 3)), dtype=dtype)
            for entry in entries:
                i, j = INERTIA_ENTRIES[entry]
                tensor[:, i, j] = tensor[:, j, i] = self.member_values[f"link.{name}.inertia.{entry}"]
            finite = np.where(np.isfinite(tensor), tensor, 0.0).real
            self.is_physical &= np.linalg.eigvalsh(finite)[:, 0] >= 0
        return tensor

    def _place_frame(self, name: str, frame: str | FrameSpec | None) -> tuple[Numbers, Numbers]:
        link = "world" if frame is None else frame if isinstance(frame, str) else frame.link
        carriers, key = (self.joints, link[6:]) if link.startswith("joint:") else (self.links, link)
        _, rotation, translation = (0, np.eye(3), np.zeros(3)) if link == "world" else carriers[key]
        if frame is None or isinstance(frame, str):
            xyz, rpy = (self._value(f"{name}.{x}") for x in ("xyz", "rpy"))
        else:
            xyz, rpy = (self.member_values.get(f"{name}.{x}", np.array(getattr(frame, x))) for x in ("xyz", "rpy"))
        return rotation @ _rpy_matrix(rpy), translation + _turn(rotation, xyz)


def _link(joint: ElementTree.Element, tag: str) -> str:
    return joint.find(tag).attrib["link"]  # type: ignore[union-attr]


def _turn(rotation: Numbers, vector: Numbers) -> Numbers:
    turned: Numbers = (rotation @ vector[..., None])[..., 0]
    return turned


def _rpy_matrix(rpy: Numbers) -> Numbers:
    """Return the rotations by roll, pitch and yaw, (..., 3, 3), as URDF defines them."""
    (sr, sp, sy), (cr, cp, cy) = (np.moveaxis(f(rpy), -1, 0) for f in (np.sin, np.cos))
    rows = [[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr]]  # fmt: skip
    matrix: Numbers = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return matrix


def inertial_rotation(inertial: ElementTree.Element) -> Array:
    """Return the axes of a link's inertial frame in the link's frame, shape (3, 3)."""
    origin = inertial.find("origin")
    return _rpy_matrix(
        np.array([float(x) for x in ("0 0 0" if origin is None else origin.get("rpy", "0 0 0")).split()])
    )


def _point_inertia(c: Numbers) -> Numbers:
    """Inertia of a unit of mass at c about the origin, (..., 3, 3)."""
    inertia: Numbers = np.sum(c * c, axis=-1)[..., None, None] * np.eye(3) - c[..., :, None] * c[..., None, :]
    return inertia


def _clean(slope: Array) -> Array:
    """Set to zero what rounding leaves of zeros."""
    return np.where(np.abs(slope) > 1e-14 * np.abs(slope).max(initial=0.0), slope, 0.0)
