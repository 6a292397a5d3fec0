"""Couplings between joints: which joints they tie, with which coefficients, and the curve of a nonlinear one.

Each coupling is one row of phi: the sum of coefficient * joint, less a curve of one joint and an offset. A polynomial
and a table are the same kind of curve, a piecewise polynomial.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array
from ckc_pin.errors import MechanismError
from ckc_pin.mechanism.spec import CouplingSpec, MechanismSpec

__all__ = ["PiecewiseCurve", "coefficients_of", "coupled_joints", "coupling_name", "curve_of", "describe_coupling",
           "find_coupling", "stack_curves", "validate_coupling"]  # fmt: skip

MIN_TABLE_POINTS, MAX_TABLE_POINTS = 3, 500
DEGREE = 5  # of the spline of a table


class PiecewiseCurve(Struct, frozen=True):
    """A piecewise polynomial p(x) with at least two continuous derivatives.

    Attributes
    ----------
    breaks : (pieces - 1,) array
        Ascending positions where one piece ends and the next begins.
    origins : (pieces,) array
    coefficients : (pieces, degree + 1) array
        Of the powers of x - origin.
    """

    breaks: Array
    origins: Array
    coefficients: Array

    def __call__(self, x: float) -> float:
        """Return p(x)."""
        piece = int(np.searchsorted(self.breaks, x, side="right"))
        return float(np.polyval(self.coefficients[piece][::-1], x - self.origins[piece]))


def coupling_name(spec: CouplingSpec) -> str:
    """Return the name of a coupling's row: its own, or that of its joints, ``wheel~pinion``."""
    return spec.name or "~".join(coupled_joints(spec))


def coupled_joints(spec: CouplingSpec) -> tuple[str, ...]:
    """Return the joints of a coupling, the one that follows the others first."""
    return tuple(spec.joints) or tuple(name for name in (spec.joint, spec.other) if name is not None)


def coefficients_of(spec: CouplingSpec) -> dict[str, float]:
    """Return the coefficients of the linear part, by joint."""
    if spec.joint is None:
        return dict(spec.joints)
    linear = {spec.joint: 1.0}
    if spec.other is not None and spec.ratio is not None:
        linear[spec.other] = -spec.ratio
    return linear


def curve_of(spec: CouplingSpec) -> PiecewiseCurve | None:
    """Return the curve of a nonlinear coupling, None of a linear one."""
    if spec.polynomial:
        return PiecewiseCurve(np.zeros(0), np.zeros(1), np.array([spec.polynomial], dtype=float))
    return _interpolate(np.array(spec.table, dtype=float)) if spec.table else None


def validate_coupling(spec: CouplingSpec) -> None:
    """Check that a coupling is given in one form, completely.

    Raises
    ------
    MechanismError
        No form or several, a joint tied to itself, coefficients that are all zero, or an invalid table.
    """
    where = f"coupling {coupling_name(spec)!r}"
    forms = [name for name in ("ratio", "polynomial", "table") if getattr(spec, name) not in (None, [])]
    if spec.joints:
        if spec.joint is not None or spec.other is not None or forms:
            raise MechanismError(f"{where}: give either joints, or joint and other with a ratio, polynomial or table")
        if not any(spec.joints.values()):
            raise MechanismError(f"{where}: all coefficients are zero; give at least one joint another coefficient")
        return
    if spec.joint is None or spec.other is None:
        raise MechanismError(f"{where}: give joint and other, or joints, a table of coefficients by joint")
    if len(forms) != 1:
        raise MechanismError(f"{where}: give one of ratio, polynomial and table, got {' and '.join(forms) or 'none'}")
    if spec.joint == spec.other:
        raise MechanismError(f"{where}: a joint cannot be coupled to itself")
    if spec.table:
        positions = np.array(spec.table, dtype=float)[:, 0]
        if not MIN_TABLE_POINTS <= len(positions) <= MAX_TABLE_POINTS:
            raise MechanismError(
                f"{where}: table: expected {MIN_TABLE_POINTS} to {MAX_TABLE_POINTS} points, got {len(positions)}"
            )
        back = np.flatnonzero(np.diff(positions) <= 0)
        if len(back):
            at = positions[back[0] : back[0] + 2]
            raise MechanismError(
                f"{where}: table: positions of {spec.other} must increase, but {at[1]:g} follows {at[0]:g}"
            )


def find_coupling(spec: MechanismSpec, carrier: str) -> int:
    """Return the index of the coupling that parameters call by this name, or by this number."""
    names = [coupling.name for coupling in spec.coupling]
    return names.index(carrier) if carrier in names else int(carrier)


def describe_coupling(spec: CouplingSpec) -> str:
    """Return a coupling as an equation."""
    if spec.joints:
        return f"{_format_sum(spec.joints)} = {spec.offset:g}"
    if spec.ratio is not None:
        return f"{spec.joint} = {spec.ratio:g} {spec.other} + {spec.offset:g}"
    form = f"polynomial of degree {len(spec.polynomial) - 1}" if spec.polynomial else f"{len(spec.table)} points"
    return f"{spec.joint} = p({spec.other})" + (f" + {spec.offset:g}" if spec.offset else "") + f" ({form})"


def _format_sum(joints: Mapping[str, float]) -> str:
    terms = [f"{'- ' if x < 0 else '+ '}{abs(x):g} {name}" for name, x in joints.items()]
    return " ".join(terms).removeprefix("+ ")


def _interpolate(points: Array) -> PiecewiseCurve:
    """Return the not-a-knot quintic spline through points, or their polynomial if there are at most six.

    Four derivatives of the spline are continuous. A cubic spline would leave kinks in accelerations, at which
    integrators of high order take very short steps. Beyond its ends, the curve keeps the second derivative of the end.
    """
    x, y = points.T
    scale = (x[-1] - x[0]) / (len(x) - 1)
    if len(x) <= DEGREE + 1:
        powers = np.vander((x - x[0]) / scale, len(x), increasing=True)
        origins, inside = x[:1], np.linalg.solve(powers, y)[None, :] / scale ** np.arange(len(x))
    else:
        origins, inside = x[:-1], _spline_pieces(x / scale, y) / scale ** np.arange(DEGREE + 1)
    ends = np.zeros((2, inside.shape[1]))
    for end, piece, at in ((ends[0], inside[0], 0.0), (ends[1], inside[-1], x[-1] - origins[-1])):
        for order, factor in ((0, 1.0), (1, 1.0), (2, 0.5)):
            end[order] = factor * np.polyval(np.polyder(piece[::-1], order), at)
    breaks = np.append(origins, x[-1])
    return PiecewiseCurve(breaks, np.concatenate([x[:1], breaks]), np.vstack([ends[:1], inside, ends[1:]]))


def _spline_pieces(x: Array, y: Array) -> Array:
    """Return the coefficients of the powers of a quintic spline's pieces, shape (pieces, 6).

    The unknowns are the first and second derivative at each point.
    """
    h, count = np.diff(x)[:, None], len(x)

    def pieces(y: Array, slope: Array, curvature: Array) -> list[Array]:
        """Return the coefficients of the powers, shape (pieces, columns) each, of polynomials between the points."""
        rise = y[1:] - y[:-1] - h * slope[:-1] - h**2 * curvature[:-1] / 2
        turn = h * (slope[1:] - slope[:-1]) - h**2 * curvature[:-1]
        bend = h**2 * (curvature[1:] - curvature[:-1])
        cubic, quartic, quintic = (
            (10 * rise - 4 * turn + bend / 2) / h**3,
            (-15 * rise + 7 * turn - bend) / h**4,
            (6 * rise - 3 * turn + bend / 2) / h**5,
        )
        return [y[:-1], slope[:-1], curvature[:-1] / 2, cubic, quartic, quintic]

    def conditions(y: Array, unknowns: Array) -> Array:
        slope, curvature = unknowns[:count], unknowns[count:]
        *_, cubic, quartic, quintic = pieces(y, slope, curvature)
        third = cubic + 4 * h * quartic + 10 * h**2 * quintic  # p''' / 6 at the end of each piece
        fourth = quartic + 5 * h * quintic
        knots = [0, 1, -2, -1]  # of the interior ones, where the fifth derivative is continuous too
        jumps = third[:-1] - cubic[1:], fourth[:-1] - quartic[1:], (quintic[:-1] - quintic[1:])[knots]
        return np.concatenate(jumps)

    matrix = conditions(np.zeros((count, 2 * count)), np.eye(2 * count))
    unknowns = np.asarray(np.linalg.solve(matrix, -conditions(y[:, None], np.zeros((2 * count, 1)))), dtype=float)
    return np.hstack(pieces(y[:, None], unknowns[:count], unknowns[count:]))


def stack_curves(curves: Sequence[PiecewiseCurve]) -> tuple[Array, Array, Array]:
    """Return breaks, origins and coefficients of several curves as arrays, padded to the same pieces and degree.

    Padding breaks are infinite, so that their pieces are never used.
    """
    pieces = max(len(curve.origins) for curve in curves)
    width = max(curve.coefficients.shape[1] for curve in curves)
    breaks = np.full((len(curves), pieces - 1), np.inf)
    origins, coefficients = np.zeros((len(curves), pieces)), np.zeros((len(curves), pieces, width))
    for k, curve in enumerate(curves):
        breaks[k, : len(curve.breaks)] = curve.breaks
        origins[k, : len(curve.origins)] = curve.origins
        coefficients[k, : len(curve.origins), : curve.coefficients.shape[1]] = curve.coefficients
    return breaks, origins, coefficients
