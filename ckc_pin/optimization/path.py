"""Paths of the independent coordinates over a parameter s from 0 to 1: splines, and lines with rounded corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.control.piecewise import PiecewisePolynomial, interpolate
from ckc_pin.control.point_path import PointPath
from ckc_pin.errors import InputError
from ckc_pin.kinematics.point import Point
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.spec import PathSpec
from ckc_pin.optimization.speed_profile import SpeedProfile

__all__ = ["CoordinatePath", "PathMotion", "make_path", "round_corners"]

DEFAULT_ROUNDING = 0.1  # of the shorter line at a corner
STRAIGHT_TOLERANCE = 1e-9  # of the unit directions of two lines without a corner between them


class CoordinatePath(Immutable, frozen=True):
    """A path of the independent coordinates.

    Attributes
    ----------
    q : PiecewisePolynomial
        Of s, twice continuously differentiable.
    warnings : tuple of str
    start : (nq,) array, optional
        Closed configuration from which the path is followed; as assembled by default.
    """

    q: PiecewisePolynomial
    warnings: tuple[str, ...] = ()
    start: Array | None = None


@dataclass(frozen=True, eq=False)
class PathMotion:
    """q(s(t)): a motion along a path."""

    path: CoordinatePath
    profile: SpeedProfile

    @property
    def corners(self) -> Array:
        """Times of the grid's points, s."""
        return self.profile.t

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations, (m, d) each, at times t (m,)."""
        s, s_dot, s_ddot = self.profile(t)
        q, q_s, q_ss = self.path.q(s)
        return q, q_s * s_dot[:, None], q_s * s_ddot[:, None] + q_ss * s_dot[:, None] ** 2


def make_path(spec: PathSpec, mechanism: Mechanism) -> CoordinatePath:
    """Return the path of the independent coordinates that a path's table describes.

    A point's path is followed by the inverse kinematics at many places, with a quintic spline of q through them.

    Raises
    ------
    InputError
        Unknown names, fewer than two places, or places out of reach.
    """
    where = "optimize: path"
    if (spec.q is None) == (spec.point is None):
        raise InputError(f"{where}: expected one of q and point, got {'both' if spec.q else 'neither'}")
    if spec.rounding is not None and spec.shape != "lines":
        raise InputError(f'{where}.rounding belongs to shape = "lines"; remove it')
    if spec.q is not None:
        unknown = [name for name in spec.q if name not in mechanism.independent]
        missing = [name for name in mechanism.independent if name not in spec.q]
        if unknown or missing:
            problem = f"{unknown[0]!r} is none of them" if unknown else f"{missing[0]!r} is missing"
            raise InputError(f"{where}.q: needs places of each of {', '.join(mechanism.independent)}; {problem}")
        counts = {len(places) for places in spec.q.values()}
        if len(counts) != 1:
            raise InputError(f"{where}.q: expected equally many places of each coordinate, got {sorted(counts)}")
        places = np.array([spec.q[name] for name in mechanism.independent]).T
        q, warnings = _connect(places, spec, f"{where}.q")
        return CoordinatePath(q, warnings)
    assert spec.point is not None
    if len(spec.point) != 1:
        raise InputError(f"{where}.point: expected one point, got {', '.join(spec.point) or 'none'}")
    ((name, positions),) = spec.point.items()
    point = Point(mechanism, name)
    x, warnings = _connect(np.array(positions), spec, f"{where}.point.{name}")
    try:
        followed = PointPath(point, x, 1.0)
    except InputError as error:
        raise InputError(str(error).replace("controller.desired", where)) from None
    if followed.leaves_at is not None:
        at = ", ".join(f"{value:.4g}" for value in x(followed.leaves_at)[0])
        raise InputError(f"{where}.point.{name}: the point cannot follow the path beyond ({at}) on this branch")
    with one_blas_thread():
        knots = np.array([mechanism.independent_part(knot) for knot in followed.knots])
    breaks, coefficients = interpolate(followed.times, knots, "quintic")
    return CoordinatePath(PiecewisePolynomial(breaks, coefficients, end=1.0), warnings)


def _connect(places: Array, spec: PathSpec, where: str) -> tuple[PiecewisePolynomial, tuple[str, ...]]:
    """Return the curve through places (k, dimension), and warnings."""
    if len(places) < 2:
        raise InputError(f"{where}: got {len(places)}; at least two places are needed")
    if not np.isfinite(places).all():
        raise InputError(f"{where}: expected finite numbers")
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    if not lengths.min() > 1e-12 * max(lengths.max(), 1e-300):
        raise InputError(f"{where}[{int(np.argmin(lengths)) + 1}]: the same place twice in a row; remove one")
    s = np.concatenate([[0.0], np.cumsum(lengths)])
    if spec.shape == "spline":
        breaks, coefficients = interpolate(s / s[-1], places, "quintic")
        return PiecewisePolynomial(breaks, coefficients, end=1.0), ()
    return _round(places, lengths, spec.rounding, where)


def _round(
    places: Array, lengths: Array, rounding: float | None, where: str
) -> tuple[PiecewisePolynomial, tuple[str, ...]]:
    """Return straight lines whose corners are replaced by smooth curves."""
    directions = np.diff(places, axis=0) / lengths[:, None]
    reach = np.zeros(len(places))  # of the rounding of each place along its lines
    for k in range(1, len(places) - 1):
        if np.linalg.norm(directions[k] - directions[k - 1]) > STRAIGHT_TOLERANCE:
            shorter = float(min(lengths[k - 1], lengths[k]))
            reach[k] = DEFAULT_ROUNDING * shorter if rounding is None else rounding
            if np.linalg.norm(directions[k] + directions[k - 1]) <= STRAIGHT_TOLERANCE:
                raise InputError(
                    f"{where}[{k}]: the path turns back on itself; split it there into two paths at rest between them"
                )
    for k, length in enumerate(lengths.tolist()):
        if not length - reach[k] - reach[k + 1] >= 0:
            raise InputError(f"{where}[{k}]: rounding is too large for the line of {length:.4g} that begins here")
    corners = int(np.count_nonzero(reach))
    said = (f"path: {corners} corners are rounded, from {reach.max():.3g} before to behind them",) if corners else ()
    return round_corners(places, reach), said


def round_corners(places: Array, reach: Array) -> PiecewisePolynomial:
    """Return lines through places (k, dimension) whose corners are rounded from `reach` (k,) before to behind them."""
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    directions = np.diff(places, axis=0) / lengths[:, None]
    breaks, pieces, distance = [0.0], list[Array](), 0.0
    for k, length in enumerate(lengths.tolist()):
        straight = length - reach[k] - reach[k + 1]
        if straight > 0:
            distance += straight
            breaks.append(distance)
            pieces.append(_blend(places[k] + reach[k] * directions[k], directions[k], straight * directions[k],
                                   directions[k], straight))  # fmt: skip
        if reach[k + 1]:
            size = float(reach[k + 1])
            distance += 2 * size
            breaks.append(distance)
            way = size * (directions[k] + directions[k + 1])
            pieces.append(_blend(places[k + 1] - size * directions[k], directions[k], way, directions[k + 1], 2 * size))
    total = breaks[-1]
    powers = total ** np.arange(7, -1, -1)
    coefficients = np.array(pieces).transpose(1, 0, 2) * powers[:, None, None]
    return PiecewisePolynomial(np.array(breaks) / total, coefficients, end=1.0)


def _blend(start: Array, direction: Array, way: Array, end_direction: Array, length: float) -> Array:
    """Return the coefficients (8, dimension) of a curve with given ends and directions, three times differentiable.

    Its second and third derivatives are zero at both ends, as those of the lines that it connects.
    """
    rest, turn = way - length * direction, length * (end_direction - direction)
    c4, c5 = 35 * rest - 15 * turn, -84 * rest + 39 * turn
    c6, c7 = 70 * rest - 34 * turn, -20 * rest + 10 * turn
    zero = 0 * start
    scaled = [c7 / length**7, c6 / length**6, c5 / length**5, c4 / length**4, zero, zero, direction, start]
    return np.array(scaled)
