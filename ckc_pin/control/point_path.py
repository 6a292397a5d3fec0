"""Desired trajectories that are told for a point of the mechanism, and followed by its independent coordinates.

The inverse kinematics is exact at every instant: a table of configurations along the path, made once, says from where
Newton's method starts, so that the answer at t does not depend on what was asked before.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Protocol

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert
from ckc_pin.control.desired import Harmonics, Table, read_desired, read_table
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.point import Point
from ckc_pin.mechanism.batch import difference_many, integrate_many
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.spec import Vector3

__all__ = ["Circle", "Line", "Place", "PointPath", "make_desired"]

KNOTS = 400  # of a path
STRIDE = 40  # knots from one that the path is followed to, to the next
NODES = 6  # of the interpolation between those
BISECTIONS = 50


class Place(Protocol):
    """A place over time.

    Attributes
    ----------
    fastest : float
        As a trajectory's, rad/s.
    """

    fastest: float

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        """Return x, its rate and its acceleration, each of shape (3,) or (count, 3), metres and seconds."""


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class CircleSpec(_Spec, frozen=True):
    """Round a centre, `frequency` in rad/s, against the clock when seen against the normal.

    Attributes
    ----------
    centre : m
        In the world's axes.
        ``centre = [0.15, -0.42, 0.0]``
    radius : m
        Of the circle.
        ``radius = 0.06``
    frequency : rad/s
        Against the clock when seen against the normal.
        ``frequency = 1.0``
    phase : rad
        At t = 0.
        ``phase = 1.5707963``
    normal
        Of its plane; any length but 0.
        ``normal = [0.0, 0.0, -1.0]``
    """

    centre: Vector3
    radius: Annotated[float, msgspec.Meta(gt=0)]
    frequency: float
    phase: float = 0.0
    normal: Vector3 = (0.0, 0.0, 1.0)


class LineSpec(_Spec, frozen=True):
    """From one place to another and back, as a cosine, `frequency` in rad/s.

    Attributes
    ----------
    start : m
        Where it is at t = 0, at rest.
        ``start = [0.1, -0.4, 0.0]``
    end : m
        Where it turns back, at rest.
        ``end = [0.2, -0.4, 0.0]``
    frequency : rad/s
        There and back in 2π / frequency, as a cosine.
        ``frequency = 2.0``
    """

    start: Vector3
    end: Vector3
    frequency: float


class PointPathSpec(_Spec, frozen=True):
    """`[controller.desired]` with `point` in it: one of file, circle and line.

    Attributes
    ----------
    point
        A ``[[point]]`` of the mechanism.
        ``point = "tip"``
    file
        CSV with the columns ``t, x, y, z``; one of ``file``, ``circle``, ``line``.
        ``file = "path.csv"``
    circle
        Round a centre.
        ``circle = {centre = [0.15, -0.42, 0.0], radius = 0.06, frequency = 1.0}``
    line
        From one place to another and back.
        ``line = {start = [0.1, -0.4, 0.0], end = [0.2, -0.4, 0.0], frequency = 2.0}``
    """

    point: str
    file: str | None = None
    circle: CircleSpec | None = None
    line: LineSpec | None = None


class Circle:
    """centre + radius (a cos(frequency t + phase) + b sin(frequency t + phase)), a, b and the normal right-handed."""

    def __init__(self, spec: CircleSpec) -> None:
        from ckc_pin.mechanism.closure import perpendicular

        normal = np.array(spec.normal)
        if not np.linalg.norm(normal) > 0:
            raise InputError("controller.desired.circle: normal is no direction; give three numbers, not all zero")
        self.spec, self.fastest = spec, abs(spec.frequency)
        self.centre = np.array(spec.centre)
        self.a, self.b = perpendicular(normal / np.linalg.norm(normal))

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        """Return x, its rate and its acceleration, each of shape (3,), or (count, 3) at many times."""
        rate = self.spec.frequency
        angle = (rate * np.asarray(t) + self.spec.phase)[..., np.newaxis]
        out = self.spec.radius * (np.cos(angle) * self.a + np.sin(angle) * self.b)
        along = self.spec.radius * (np.cos(angle) * self.b - np.sin(angle) * self.a)
        return self.centre + out, rate * along, -(rate**2) * out


class Line:
    """The middle of start and end, minus half the way times cos(frequency t): at rest at both ends."""

    def __init__(self, spec: LineSpec) -> None:
        self.spec, self.fastest = spec, abs(spec.frequency)
        self.middle = (np.array(spec.start) + np.array(spec.end)) / 2
        self.half = (np.array(spec.end) - np.array(spec.start)) / 2

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        """Return x, its rate and its acceleration, each of shape (3,), or (count, 3) at many times."""
        rate = self.spec.frequency
        angle = (rate * np.asarray(t))[..., np.newaxis]
        cosine, sine = np.cos(angle) * self.half, np.sin(angle) * self.half
        return self.middle - cosine, rate * sine, rate**2 * cosine


class PointPath:
    """q_d(t) that takes a point along a path, with exact rates and accelerations.

    Parameters
    ----------
    point : Point
    place : Place
        The path.
    t_end : float
        How long it must last, s.

    Attributes
    ----------
    leaves_at : float or None
        When the path leaves the workspace of its working mode or of its assembly branch, s.
    fastest : float
        Of the path, rad/s.

    Raises
    ------
    InputError
        Its start cannot be reached.
    """

    def __init__(self, point: Point, place: Place, t_end: float) -> None:
        self.point = point
        self.place = place
        self.fastest = place.fastest
        self.leaves_at: float | None = None
        with one_blas_thread():
            try:
                first = point.inverse(place(0.0)[0])
            except InputError as error:
                raise InputError(f"controller.desired: the path cannot be started: {error}") from None
            self.start = point.kinematics(first.at.q_tree)
            self.times = np.linspace(0.0, t_end, KNOTS + 1)
            together = self._together()
            self.knots = self._one_by_one() if together is None else together

    @property
    def past_end(self) -> str:
        """What is to be said when it is asked for later than `leaves_at`."""
        return (
            f"the desired path of the point {self.point.name!r} leaves the workspace of its branch at "
            f"t = {self.leaves_at or 0.0:.5f} s"
        )

    def _together(self) -> Array | None:
        """Follow the path to every STRIDE-th knot and interpolate; what is between is then met exactly, all at once."""
        tree, coarse = self.point.mechanism.tree, [self.start]
        for t in self.times[STRIDE::STRIDE]:
            at = self._follow(coarse[-1], float(t))
            if at is None:
                return None
            coarse.append(at)
        near = [self.start.q_tree[np.newaxis]]
        weights = [_lagrange(np.arange(1, STRIDE + 1) / STRIDE + k) for k in range(NODES - 1)]
        for k, at in enumerate(coarse[:-1]):
            first = int(np.clip(k - NODES // 2 + 1, 0, len(coarse) - NODES))
            around = np.array([other.q_tree for other in coarse[first : first + NODES]])
            steps = difference_many(tree, np.tile(at.q_tree, (NODES, 1)), around)
            near.append(integrate_many(tree, np.tile(at.q_tree, (STRIDE, 1)), weights[k - first] @ steps))
        return self.point.meet(np.concatenate(near), self.place(self.times)[0], self.start)

    def _one_by_one(self) -> Array:
        """Follow the path from knot to knot; where it leaves the workspace, the last one is as near as can be."""
        knots = [self.start]
        for k, t in enumerate(self.times[1:], 1):
            at = self._follow(knots[-1], float(t))
            if at is None:
                self.leaves_at, at = self._end(knots[-1], float(self.times[k - 1]), float(t))
                self.times = np.append(self.times[:k], self.leaves_at)
                knots.append(at)
                break
            knots.append(at)
        return np.array([at.q_tree for at in knots])

    def _end(self, at: Kinematics, inside: float, outside: float) -> tuple[float, Kinematics]:
        """Bisect for the last instant that can be reached."""
        for _ in range(BISECTIONS):
            middle = 0.5 * (inside + outside)
            there = self._follow(at, middle)
            if there is None:
                outside = middle
            else:
                inside, at = middle, there
        return inside, at

    def _follow(self, at: Kinematics, t: float) -> Kinematics | None:
        """Go on to the place at t, unless the inverse kinematics or the independent coordinates fail on the way."""
        there = self.point.follow(at, self.place(t)[0])
        return there if there is not None and self.point.side(at.J) * self.point.side(there.J) > 0 else None

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        """Return q_d, its rate and its acceleration at time t (s), each of shape (d,).

        Raises
        ------
        NumericalError
            The path has left the workspace, or passes a serial singularity.
        """
        if self.leaves_at is not None and t > self.leaves_at:
            raise NumericalError(self.past_end, t=t)
        x, x_dot, x_ddot = self.place(t)
        ways = (self.point.follow(knot, x) for knot in self._near(t))
        psi = next((found for found in ways if found is not None), None)
        if psi is None:
            raise NumericalError(f"the desired path of the point {self.point.name!r} cannot be followed here", t=t)
        v, v_dot = self.point.rates(psi, x_dot, x_ddot)
        mechanism = self.point.mechanism
        q = mechanism.partition.q
        return mechanism.independent_part(psi.q_tree), v[q], v_dot[q]

    def _near(self, t: float) -> tuple[Kinematics, Kinematics]:
        """Return the knots around t, the nearer one first; the last one may be singular, at the workspace's edge."""
        after = int(np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1))
        around = (self.point.kinematics(self.knots[after - 1]), self.point.kinematics(self.knots[after]))
        return around if t - self.times[after - 1] < self.times[after] - t else around[::-1]


def _lagrange(x: Array) -> Array:
    """Weights, at x, of values at 0, 1, 2 ..., shape (len(x), NODES)."""
    nodes = np.arange(NODES)
    others = [[m for m in nodes if m != k] for k in nodes]
    return np.array([np.prod([(x - m) / (k - m) for m in others[k]], axis=0) for k in nodes]).T


def make_desired(
    desired: Mapping[str, Any], mechanism: Mechanism, sources: Sources, t_end: float
) -> Harmonics | Table | PointPath:
    """Build what the `[controller.desired]` table says: of the independent coordinates, or of a point.

    Raises
    ------
    InputError
        Not a trajectory, one that ends too soon, or one of a point whose start cannot be reached.
    """
    if "point" not in desired or "point" in mechanism.independent:
        found = read_desired(desired, mechanism.independent, sources)
        if isinstance(found, Table):
            _require_length(found, str(desired["file"]), t_end)
        return found
    where = "controller.desired"
    spec = convert(dict(desired), PointPathSpec, sources.name, where)
    given = [name for name in ("file", "circle", "line") if getattr(spec, name) is not None]
    if len(given) != 1:
        raise InputError(f"{sources.name}: {where}: beside point give one of file, circle and line, not {given}")
    place: Place
    if spec.circle is not None:
        place = Circle(spec.circle)
    elif spec.line is not None:
        place = Line(spec.line)
    else:
        place = table = read_table(sources.text(str(spec.file)), ("x", "y", "z"), str(spec.file))
        _require_length(table, str(spec.file), t_end)
    return PointPath(Point(mechanism, spec.point), place, t_end)


def _require_length(table: Table, file: str, t_end: float) -> None:
    if table.end < t_end:
        raise InputError(
            f"{file}: ends at t = {table.end:g} s, the scene at t_end = {t_end:g} s; "
            "lengthen the trajectory or shorten the run"
        )
