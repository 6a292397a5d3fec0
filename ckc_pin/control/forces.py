"""Forces and moments on links: constant, over time, or functions of the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import FileStruct, convert
from ckc_pin.base.validation import describe_value, require_controller_signature, require_type
from ckc_pin.control.desired import read_some_columns
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.frames import Frame
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.spec import Frame as FrameName
from ckc_pin.mechanism.spec import FrameSpec, Vector3

__all__ = [
    "COMPONENTS",
    "BodyForce",
    "Force",
    "LinkForceSpec",
    "as_vector",
    "body_wrenches",
    "generalized_force",
    "place_forces",
    "read_forces",
    "unit_forces",
]

COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")  # force, N, and moment, N m
EXPECTED_VECTOR = "3 numbers (x, y, z), or a function of (t, terms) that returns them"

Axes = Literal["world", "frame"]
VectorFunction = Callable[[float, Terms], Any]


class LinkForceSpec(FileStruct, frozen=True):
    """A force and a moment on a link, at the origin of a frame: constant, or from a table over time.

    Attributes
    ----------
    frame
        A link, ``joint:NAME``, or a frame placed relative to one of these.
        ``frame = {link = "rod", xyz = [0.3, 0.0, 0.0]}``
    name
        Name in messages and of the input of a linear model; default: the link.
        ``name = "push"``
    axes
        Axes in which force and moment are given: the world's, or the frame's, which turn with the link.
        ``axes = "frame"``
    force : N
        Constant force.
        ``force = [0.0, 0.0, -20.0]``
    moment : N m
        Constant moment.
        ``moment = [0.0, 0.0, 1.5]``
    file
        CSV with the column ``t``, s, and some of ``fx``, ``fy``, ``fz``, N, ``mx``, ``my``, ``mz``, N m, instead of
        constant values. The last row lasts.
        ``file = "push.csv"``
    interpolation
        Each row of the file lasts until the next one, or is interpolated linearly.
        ``interpolation = "linear"``
    """

    frame: FrameName
    name: str = ""
    axes: Axes = "world"
    force: Vector3 | None = None
    moment: Vector3 | None = None
    file: str | None = None
    interpolation: Literal["hold", "linear"] | None = None


@dataclass(frozen=True, init=False)
class Force:
    """A force and a moment of the caller's own on a link, at the origin of a frame.

    Parameters
    ----------
    frame : str or mapping
        A link, "joint:NAME", or a frame placed relative to one of these, as ``{"link": "rod", "xyz": [0.3, 0, 0]}``.
    force, moment : (3,) array or function, optional
        N and N m. A function of (t, terms) returns them.
    axes : "world" or "frame"
        Axes in which they are given; those of the frame turn with the link.
    name : str, optional
        Name in messages and of the input of a linear model; default: the link.

    Raises
    ------
    InputError
        A value of the wrong type, or neither force nor moment.

    Examples
    --------
    >>> wind = Force("plate", lambda t, terms: [2.0 * math.sin(t), 0.0, 0.0])
    >>> simulate("delta/hold", forces=[wind])
    """

    frame: FrameName
    parts: tuple[Array | VectorFunction, Array | VectorFunction]
    axes: Axes
    name: str

    def __init__(
        self,
        frame: str | Mapping[str, Any] | FrameSpec,
        force: Any = None,
        moment: Any = None,
        axes: Axes = "world",
        name: str = "",
    ) -> None:
        if force is None and moment is None:
            raise InputError("Force: give a force, a moment, or both")
        if axes not in ("world", "frame"):
            raise InputError(f'Force: axes: expected "world" or "frame", got {describe_value(axes)}')
        require_type(frame, (str, Mapping, FrameSpec), "Force: frame", "a link's name or a table with link and xyz")
        require_type(name, str, "Force: name", "a string")
        placed = convert(dict(frame), FrameSpec, "Force", "frame") if isinstance(frame, Mapping) else frame
        parts = (_require_vector(force, "force"), _require_vector(moment, "moment"))
        for key, value in {"frame": placed, "parts": parts, "axes": axes, "name": name}.items():
            object.__setattr__(self, key, value)

    def as_spec(self) -> LinkForceSpec | None:
        """Return its table in a scene; None if it is a function of the state."""
        constant = [part for part in self.parts if not callable(part)]
        if len(constant) < len(self.parts):
            return None
        vectors: list[Vector3] = [(float(x), float(y), float(z)) for x, y, z in constant]
        return LinkForceSpec(self.frame, self.name, self.axes, force=vectors[0], moment=vectors[1])


def _require_vector(value: Any, name: str) -> Array | VectorFunction:
    """Return a vector (3,), zero for None, or a function of (t, terms)."""
    if value is None:
        return np.zeros(3)
    if callable(value) and not isinstance(value, type):
        require_controller_signature(value, name, "Force")
        return value
    return as_vector(value, f"Force: {name}", EXPECTED_VECTOR)


def as_vector(value: Any, what: str, expected: str) -> Array:
    """Return three finite numbers as an array (InputError, which says what was expected for what)."""
    try:
        vector = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise InputError(f"{what}: expected {expected}, got {describe_value(value)}")
    return vector


class BodyForce(Struct, frozen=True):
    """A force and a moment on the body of a joint.

    Attributes
    ----------
    spec : LinkForceSpec
        Its table, which of a function of the state has no values.
    frame : Frame
        Its origin is where the force acts.
    over_time : PiecewisePolynomial or None
        Force and moment, (6,), over time. None if they are functions of the state, or recorded in a run.
    parts : tuple of two functions of (t, terms), optional
        Force and moment as functions of the state.
    """

    spec: LinkForceSpec
    frame: Frame
    over_time: PiecewisePolynomial | None = None
    parts: tuple[VectorFunction, VectorFunction] | None = None

    @property
    def name(self) -> str:
        """Its name in messages and inputs; by default the link."""
        return self.spec.name or _link_of(self.spec)

    @property
    def in_world(self) -> bool:
        """Whether the values are given in the world's axes instead of the frame's."""
        return self.spec.axes == "world"

    @property
    def is_constant(self) -> bool:
        """Whether its table has constant values."""
        return self.over_time is not None and self.spec.file is None

    def fixed(self, values: Array) -> BodyForce:
        """Return this force with constant values, shape (6,)."""
        return BodyForce(self.spec, self.frame, _constant(values))

    def values(self, t: float, terms: Terms) -> Array:
        """Return force and moment in their axes, shape (6,).

        Raises
        ------
        InputError
            A function of the caller's returned something else than three finite numbers.
        """
        if self.over_time is not None:
            return self.over_time(t)[0]
        assert self.parts is not None
        place = f"force {self.name!r} at t = {t:.9g}"
        return np.concatenate([as_vector(part(t, terms), place, "3 finite numbers") for part in self.parts])


def _build_force(force: LinkForceSpec | Force, mechanism: Mechanism, sources: Sources, where: str) -> BodyForce:
    """Place a force on its body and read its table; `where` is its place, for messages."""
    frame = mechanism.frames.find(force.frame, where)
    if frame.joint == 0:
        link = _link_of(force)
        raise InputError(f"{where}: frame: {link!r} is fixed to the world and does not move; choose a link that moves")
    if isinstance(force, LinkForceSpec):
        return BodyForce(force, frame, _read_values(force, sources, where))
    functions = [part if callable(part) else (lambda t, terms, part=part: part) for part in force.parts]
    spec = LinkForceSpec(force.frame, force.name, force.axes)
    return BodyForce(spec, frame, parts=(functions[0], functions[1]))


def _link_of(force: LinkForceSpec | Force) -> str:
    return force.frame if isinstance(force.frame, str) else force.frame.link


def _constant(values: Array) -> PiecewisePolynomial:
    return PiecewisePolynomial(np.array([0.0, 1.0]), values[None, None, :])


def _read_values(spec: LinkForceSpec, sources: Sources, where: str) -> PiecewisePolynomial:
    is_constant = spec.force is not None or spec.moment is not None
    if spec.file is None:
        if not is_constant:
            raise InputError(f"{where}: give force, moment or both, or file")
        if spec.interpolation is not None:
            raise InputError(f"{where}: interpolation belongs to file, which is missing")
        return _constant(np.array([*(spec.force or (0.0,) * 3), *(spec.moment or (0.0,) * 3)]))
    if is_constant:
        raise InputError(f"{where}: give either file, or force and moment")
    t, values = read_some_columns(sources.text(spec.file), COMPONENTS, spec.file, 1, "a force over time needs")
    slopes = np.zeros_like(values)  # after the last row, too
    if spec.interpolation == "linear":
        slopes[:-1] = np.diff(values, axis=0) / np.diff(t)[:, np.newaxis]
    return PiecewisePolynomial(np.append(t, t[-1] + 1.0), np.array([slopes, values]), corners=t[1:])


def read_forces(
    specs: Sequence[LinkForceSpec], forces: Sequence[Force], mechanism: Mechanism, sources: Sources
) -> list[BodyForce]:
    """Place the forces of a scene on the bodies of a mechanism: those of its tables, then those that are functions.

    Raises
    ------
    InputError, MechanismError
        No such link, a link that does not move, keys that exclude each other, an unusable file, or two equal names.
    """
    built = [_build_force(spec, mechanism, sources, f"force[{k}]") for k, spec in enumerate(specs)]
    built += [_build_force(one, mechanism, sources, f"forces[{k}]") for k, one in enumerate(forces)]
    names = [force.name for force in built]
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise InputError(f"force: two forces are called {twice!r}; give them different names")
    return built


def place_forces(specs: Sequence[LinkForceSpec], mechanism: Mechanism) -> list[BodyForce]:
    """Place the forces of a run on the bodies of its mechanism. Their values are in the run, not in the result."""
    return [BodyForce(spec, mechanism.frames.find(spec.frame, f"force[{k}]")) for k, spec in enumerate(specs)]


def body_wrenches(forces: Sequence[BodyForce], t: float, terms: Terms) -> Array:
    """Return the wrenches of forces on the bodies of the joints, in world axes, about the world's origin.

    Returns
    -------
    (joints, 6) array
        Force, N, and moment, N m; joint 0 is the world.
    """
    pose = terms.at.pose
    wrenches = np.zeros((len(pose.translation), 6))
    for force in forces:
        joint, frame, value = force.frame.joint, force.frame, force.values(t, terms)
        rotation = np.eye(3) if force.in_world else pose.rotation[joint] @ frame.rotation
        linear, moment = rotation @ value[:3], rotation @ value[3:]
        origin = pose.rotation[joint] @ frame.translation + pose.translation[joint]
        wrenches[joint] += np.concatenate([linear, moment + np.cross(origin, linear)])
    return wrenches


def generalized_force(wrenches: Array, terms: Terms) -> Array:
    """Return the generalized force of wrenches on the bodies (see `body_wrenches`) on the tree, (n,), N m or N."""
    pose = terms.at.pose
    jacobian = np.vstack([pose.linear_part, pose.angular_part])
    moves = terms.mechanism.tree.support[:, 0]  # (joints, n)
    return np.asarray(np.einsum("jc,cn,jn->n", wrenches, jacobian, moves))


def unit_forces(forces: Sequence[BodyForce], terms: Terms) -> Array:
    """Return the generalized forces of unit values of each component of forces, shape (n, 6 k)."""
    units = [force.fixed(value) for force in forces for value in np.eye(6)]
    columns = [generalized_force(body_wrenches([unit], 0.0, terms), terms) for unit in units]
    return np.array(columns).reshape(len(units), terms.mechanism.n).T
