"""Desired trajectories given as the path of a point, followed by the independent coordinates.

The inverse kinematics is solved exactly at every instant. A table of configurations along the path, computed once,
provides the initial guesses of Newton's method, so that the result at t does not depend on earlier calls.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Protocol

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import FileStruct, convert
from ckc_pin.control.desired import Harmonics, Sum, Table, read_desired, read_table
from ckc_pin.control.piecewise import Interpolation, PiecewisePolynomial, Profile, pass_waypoints
from ckc_pin.control.spec import Limit, require_profile
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.point import Point
from ckc_pin.mechanism.batch import difference_many, integrate_many
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.spec import Vector3

__all__ = ["Circle", "Line", "PointPath", "PointTrajectory", "make_desired"]

INTERVALS = 400  # of the table of configurations
STRIDE = 40  # intervals between configurations that are found by following the path
INTERPOLATION_NODES = 6  # followed configurations from which those between them are interpolated
BISECTIONS = 50


class PointTrajectory(Protocol):
    """A position over time.

    Attributes
    ----------
    max_frequency : float
        As of a desired trajectory, rad/s.
    """

    max_frequency: float

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        """Return x, its rate and its acceleration, each of shape (3,) or (count, 3), metres and seconds."""


class CircleSpec(FileStruct, frozen=True):
    """A circular path.

    Attributes
    ----------
    centre : m
        In the world's axes.
        ``centre = [0.15, -0.42, 0.0]``
    radius : m
        Of the circle.
        ``radius = 0.06``
    frequency : rad/s
        Counterclockwise if the normal points to the viewer.
        ``frequency = 1.0``
    phase : rad
        At t = 0.
        ``phase = 1.5707963``
    normal
        Of the circle's plane; any length but 0.
        ``normal = [0.0, 0.0, -1.0]``
    """

    centre: Vector3
    radius: Annotated[float, msgspec.Meta(gt=0)]
    frequency: float
    phase: float = 0.0
    normal: Vector3 = (0.0, 0.0, 1.0)


class LineSpec(FileStruct, frozen=True):
    """A straight path there and back, with a cosine over time.

    Attributes
    ----------
    start : m
        Position at t = 0, at rest.
        ``start = [0.1, -0.4, 0.0]``
    end : m
        Turning point, at rest.
        ``end = [0.2, -0.4, 0.0]``
    frequency : rad/s
        There and back in 2π / frequency.
        ``frequency = 2.0``
    """

    start: Vector3
    end: Vector3
    frequency: float


class PointPathSpec(FileStruct, frozen=True):
    """`[controller.desired]` with `point` in it, and one of file, circle, line and waypoints.

    Attributes
    ----------
    point
        A ``[[point]]`` of the mechanism.
        ``point = "tip"``
    file
        CSV with the columns ``t, x, y, z``; one of ``file``, ``circle``, ``line``, ``waypoints``.
        ``file = "path.csv"``
    interpolation
        Between the rows of ``file``; if absent, ``"quintic"`` with at least six rows.
        ``interpolation = "cubic"``
    circle
        A circular path.
        ``circle = {centre = [0.15, -0.42, 0.0], radius = 0.06, frequency = 1.0}``
    line
        A straight path there and back.
        ``line = {start = [0.1, -0.4, 0.0], end = [0.2, -0.4, 0.0], frequency = 2.0}``
    waypoints : s, m
        ``[t, [x, y, z]]`` each, at least two; the position is held before the first and after the last.
        ``waypoints = [[0.0, [0.1, -0.4, 0.0]], [1.0, [0.2, -0.4, 0.0]]]``
    profile
        Of the motion between waypoints; ``"quintic"`` if absent.
        ``profile = "linear"``
    max_rate : m/s
        Limit of the speed along the straight line, of ``profile = "trapezoidal"`` only.
        ``max_rate = 0.5``
    max_acceleration : m/s²
        Acceleration along the line where it begins and ends, of ``profile = "trapezoidal"`` only.
        ``max_acceleration = 2.0``
    """

    point: str
    file: str | None = None
    interpolation: Interpolation | None = None
    circle: CircleSpec | None = None
    line: LineSpec | None = None
    waypoints: list[tuple[float, Vector3]] | None = None
    profile: Profile | None = None
    max_rate: Limit | None = None
    max_acceleration: Limit | None = None


class Circle:
    """centre + radius (a cos(frequency t + phase) + b sin(frequency t + phase)), a, b and the normal right-handed."""

    def __init__(self, spec: CircleSpec) -> None:
        from ckc_pin.mechanism.closure import perpendicular

        normal = np.array(spec.normal)
        if not np.linalg.norm(normal) > 0:
            raise InputError("controller.desired.circle: normal must not be zero; give three numbers")
        self.spec, self.max_frequency = spec, abs(spec.frequency)
        self.centre = np.array(spec.centre)
        self.a, self.b = perpendicular(normal / np.linalg.norm(normal))

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        """Return x, its rate and its acceleration, each of shape (3,), or (count, 3) at many times."""
        rate = self.spec.frequency
        angle = (rate * np.asarray(t) + self.spec.phase)[..., np.newaxis]
        radial = self.spec.radius * (np.cos(angle) * self.a + np.sin(angle) * self.b)
        tangential = self.spec.radius * (np.cos(angle) * self.b - np.sin(angle) * self.a)
        return self.centre + radial, rate * tangential, -(rate**2) * radial


class Line:
    """middle - half cos(frequency t), where half is from the middle to the end: at rest at both ends."""

    def __init__(self, spec: LineSpec) -> None:
        self.spec, self.max_frequency = spec, abs(spec.frequency)
        self.middle = (np.array(spec.start) + np.array(spec.end)) / 2
        self.half = (np.array(spec.end) - np.array(spec.start)) / 2

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        """Return x, its rate and its acceleration, each of shape (3,), or (count, 3) at many times."""
        rate = self.spec.frequency
        angle = (rate * np.asarray(t))[..., np.newaxis]
        cosine, sine = np.cos(angle) * self.half, np.sin(angle) * self.half
        return self.middle - cosine, rate * sine, rate**2 * cosine


class PointPath:
    """q_d(t) that moves a point along a path, with exact rates and accelerations.

    Parameters
    ----------
    point : Point
    path : PointTrajectory
    t_end : float
        Time that it must cover, s.

    Attributes
    ----------
    start : Kinematics
        The configuration at t = 0.
    times, knots : (m,) array, (m, nq) array
        Table of configurations along the path.
    leaves_at : float or None
        When the path leaves the workspace of its working mode or of its assembly branch, s.
    max_frequency : float
        Of the path, rad/s.
    corners, rate_jumps : (k,) arrays
        Times at which a run begins a new step, and at which the rate jumps, s.

    Raises
    ------
    InputError
        The start of the path cannot be reached.
    """

    def __init__(self, point: Point, path: PointTrajectory, t_end: float) -> None:
        self.point = point
        self.path = path
        self.max_frequency = path.max_frequency
        self.corners, self.rate_jumps = (np.asarray(getattr(path, name, ())) for name in ("corners", "rate_jumps"))
        self.leaves_at: float | None = None
        with one_blas_thread():
            try:
                inverse = point.inverse(path(0.0)[0])
            except InputError as error:
                raise InputError(f"controller.desired: the start of the path cannot be reached: {error}") from None
            self.start = point.kinematics(inverse.at.q_tree)
            self.times = np.linspace(0.0, t_end, INTERVALS + 1)
            knots = self._solve_interpolated()
            self.knots = self._follow_all() if knots is None else knots

    @property
    def exit_message(self) -> str:
        """The message of an error at times after `leaves_at`."""
        return (
            f"the desired path of the point {self.point.name!r} leaves the workspace of its branch at "
            f"t = {self.leaves_at or 0.0:.5f} s"
        )

    def _solve_interpolated(self) -> Array | None:
        """Return all knots, or None: follow the path to every STRIDE-th knot, interpolate, and solve for the others."""
        tree, coarse = self.point.mechanism.tree, [self.start]
        for t in self.times[STRIDE::STRIDE]:
            at = self._follow(coarse[-1], float(t))
            if at is None:
                return None
            coarse.append(at)
        guesses = [self.start.q_tree[np.newaxis]]
        count = INTERPOLATION_NODES
        weights = [_lagrange_weights(np.arange(1, STRIDE + 1) / STRIDE + k) for k in range(count - 1)]
        for k, at in enumerate(coarse[:-1]):
            first = int(np.clip(k - count // 2 + 1, 0, len(coarse) - count))
            nodes = np.array([node.q_tree for node in coarse[first : first + count]])
            steps = difference_many(tree, np.tile(at.q_tree, (count, 1)), nodes)
            guesses.append(integrate_many(tree, np.tile(at.q_tree, (STRIDE, 1)), weights[k - first] @ steps))
        return self.point.invert_path(np.concatenate(guesses), self.path(self.times)[0], self.start)

    def _follow_all(self) -> Array:
        """Follow the path from knot to knot. If it leaves the workspace, the last knot is at the exit."""
        knots = [self.start]
        for k, t in enumerate(self.times[1:], 1):
            at = self._follow(knots[-1], float(t))
            if at is None:
                self.leaves_at, at = self._find_exit(knots[-1], float(self.times[k - 1]), float(t))
                self.times = np.append(self.times[:k], self.leaves_at)
                knots.append(at)
                break
            knots.append(at)
        return np.array([at.q_tree for at in knots])

    def _find_exit(self, at: Kinematics, inside: float, outside: float) -> tuple[float, Kinematics]:
        """Bisect for the last instant that can be reached."""
        for _ in range(BISECTIONS):
            middle = 0.5 * (inside + outside)
            moved = self._follow(at, middle)
            if moved is None:
                outside = middle
            else:
                inside, at = middle, moved
        return inside, at

    def _follow(self, at: Kinematics, t: float) -> Kinematics | None:
        """Return the configuration at t, or None if the inverse kinematics or the chart q fails on the way."""
        moved = self.point.follow(at, self.path(t)[0])
        return (
            moved if moved is not None and self.point.branch_sign(at.J) * self.point.branch_sign(moved.J) > 0 else None
        )

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        """Return q_d, its rate and its acceleration at time t (s), each of shape (d,).

        Raises
        ------
        NumericalError
            The path has left the workspace, or passes a serial singularity.
        """
        if self.leaves_at is not None and t > self.leaves_at:
            raise NumericalError(self.exit_message, t=t)
        x, x_dot, x_ddot = self.path(t)
        solutions = (self.point.follow(knot, x) for knot in self._nearest_knots(t))
        psi = next((solution for solution in solutions if solution is not None), None)
        if psi is None:
            raise NumericalError(f"the desired path of the point {self.point.name!r} cannot be followed here", t=t)
        v, v_dot = self.point.rates(psi, x_dot, x_ddot)
        mechanism = self.point.mechanism
        q = mechanism.partition.q
        return mechanism.independent_part(psi.q_tree), v[q], v_dot[q]

    def _nearest_knots(self, t: float) -> tuple[Kinematics, Kinematics]:
        """Return the knots around t, the nearer one first. The last knot may be singular, at the workspace's edge."""
        after = int(np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1))
        around = (self.point.kinematics(self.knots[after - 1]), self.point.kinematics(self.knots[after]))
        return around if t - self.times[after - 1] < self.times[after] - t else around[::-1]


def _lagrange_weights(x: Array) -> Array:
    """Return weights, at x, of values at 0, 1, 2 ..., shape (len(x), INTERPOLATION_NODES)."""
    nodes = np.arange(INTERPOLATION_NODES)
    others = [[m for m in nodes if m != k] for k in nodes]
    return np.array([np.prod([(x - m) / (k - m) for m in others[k]], axis=0) for k in nodes]).T


def make_desired(
    desired: Mapping[str, Any], mechanism: Mechanism, sources: Sources, t_end: float
) -> Harmonics | PiecewisePolynomial | Sum | PointPath:
    """Build the trajectory of a `[controller.desired]` table, of the independent coordinates or of a point.

    Raises
    ------
    InputError
        The table is not a trajectory, it ends before the run, or a point's start cannot be reached.
    """
    if "point" not in desired or "point" in mechanism.independent:
        trajectory = read_desired(desired, mechanism.independent, sources)
        if isinstance(trajectory, Table):
            _require_length(trajectory, str(desired["file"]), t_end)
        return trajectory
    where = "controller.desired"
    spec = convert(dict(desired), PointPathSpec, sources.name, where)
    choices = ("file", "circle", "line", "waypoints")
    names = [name for name in choices if getattr(spec, name) is not None]
    where = f"{sources.name}: {where}"
    if len(names) != 1:
        raise InputError(f"{where}: point needs exactly one of file, circle, line and waypoints, got {names}")
    if spec.interpolation is not None and spec.file is None:
        raise InputError(f"{where}: interpolation belongs to file, not to {names[0]}; remove it")
    require_profile(spec, where)
    return PointPath(Point(mechanism, spec.point), _make_path(spec, sources, where, t_end), t_end)


def _make_path(spec: PointPathSpec, sources: Sources, where: str, t_end: float) -> PointTrajectory:
    if spec.circle is not None:
        return Circle(spec.circle)
    if spec.line is not None:
        return Line(spec.line)
    if spec.waypoints is not None:
        t, x = (np.array([waypoint[k] for waypoint in spec.waypoints], dtype=float) for k in (0, 1))
        limits = (spec.max_rate, spec.max_acceleration)
        return pass_waypoints(t, x, spec.profile or "quintic", *limits, f"{where}.waypoints")
    table = read_table(sources.text(str(spec.file)), ("x", "y", "z"), str(spec.file), spec.interpolation)
    _require_length(table, str(spec.file), t_end)
    return table


def _require_length(table: Table, file: str, t_end: float) -> None:
    if table.end < t_end:
        raise InputError(
            f"{file}: the desired trajectory ends at t = {table.end:g} s, before the scene's t_end = {t_end:g} s; "
            "lengthen the trajectory or shorten the run"
        )
