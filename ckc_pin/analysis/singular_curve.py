"""Trace the curve of singular configurations through one of them, by continuation.

In a mechanism with two freedoms, singular configurations form curves in (q', v). Each step predicts along the curve's
tangent and corrects by Newton's method on the equations of `ckc_pin.analysis.singularities`. The curve is closed when
every body is where it was at the start, regardless of full turns of the joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.analysis.singularities import RESIDUAL_TOLERANCE, SingularPoint, SingularSystem
from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["SingularCurve", "trace_curve", "trace_singular"]

MIN_STEP = 1e-6  # of the longest step; if a shorter one is needed, the curve ends or branches
MAX_STEP_GROWTH = 1.5
MIN_TANGENT_COSINE = 0.95  # between two points; a closed curve has at least twenty points
MIN_PROGRESS = 0.5  # of the step size; a corrected point must not fall behind
RANK_TOLERANCE = 1e-9  # of the largest singular value of the Jacobian
MIN_CLOSED_POINTS = 10  # before the curve can return to its start
CORRECTOR_ITERATIONS = 6


@dataclass(frozen=True)
class SingularCurve:
    """Points along a curve of singular configurations, in order.

    Attributes
    ----------
    q_tree : (m, nq) array
        Pinocchio's q.
    null : (m, n) array
        The null velocity, |v| = 1, as in `SingularPoint`.
    closed : bool
        Whether the last point is the first one again.
    residual : float
        Largest residual of the equations along the curve.
    """

    q_tree: Array
    null: Array
    closed: bool
    residual: float


@dataclass(frozen=True)
class _CurvePoint:
    at: Kinematics
    null: Array
    tangent: Array
    residual: float


def trace_singular(
    mechanism: Mechanism, start: SingularPoint, step: float = 0.05, point: str | None = None, max_points: int = 5000
) -> SingularCurve:
    """Trace the curve of singular configurations through one of them.

    Parameters
    ----------
    mechanism : Mechanism
        With two freedoms.
    start : SingularPoint
        From `find_singular`, for the same `point`.
    step : float
        Longest step along the curve in (q', v), rad or m. Steps are shorter where the curve bends.
    point : str, optional
        As in `find_singular`.
    max_points : int
        Largest number of points in each direction, for a curve that does not close.

    Raises
    ------
    InputError
        The mechanism does not have two freedoms, or the step is not positive.
    """
    if mechanism.d != 2:
        raise InputError(
            f"{mechanism.name}: singular configurations form a curve if d = 2, got d = {mechanism.d}; sample them with "
            "search_singular"
        )
    if not 0 < step < np.inf:
        raise InputError(f"step = {step}: expected a positive number")
    return trace_curve(SingularSystem(mechanism, point), start.at, start.null, step, max_points)


def trace_curve(
    system: SingularSystem, at: Kinematics, null: Array, step: float = 0.05, max_points: int = 5000
) -> SingularCurve:
    """Trace the curve of solutions (q', v) of a system through one of them.

    Parameters
    ----------
    system : SingularSystem
        Whose solutions form curves.
    at : Kinematics
    null : (n,) array
        The solution to start from.
    step, max_points
        As in `trace_singular`.
    """
    tangent = _tangent(system, at, null)
    first = _CurvePoint(at, null, tangent, float(np.abs(system.residual(at, null)).max()))
    points, closed = _follow_tangent(system, first, step, max_points)
    if not closed:
        reverse = _CurvePoint(first.at, first.null, -tangent, first.residual)
        other_half, _ = _follow_tangent(system, reverse, step, max_points)
        points = [*reversed(other_half), *points[1:]]
    return SingularCurve(
        q_tree=np.array([point.at.q_tree for point in points]),
        null=np.array([point.null for point in points]),
        closed=closed,
        residual=max(point.residual for point in points),
    )


def _follow_tangent(
    system: SingularSystem, first: _CurvePoint, max_step: float, max_points: int
) -> tuple[list[_CurvePoint], bool]:
    """Follow the tangent until the curve closes or ends; return its points and whether it is closed."""
    points, step = [first], max_step
    while len(points) < max_points:
        next_point = _take_step(system, points[-2] if len(points) > 1 else None, points[-1], step)
        if next_point is not None:
            if len(points) > MIN_CLOSED_POINTS and _lies_between(first, points[-1], next_point):
                return [*points, first], True
            points.append(next_point)
            step = min(MAX_STEP_GROWTH * step, max_step)
        elif step < MIN_STEP * max_step:
            break
        else:
            step /= 2
    return points, False


def _take_step(
    system: SingularSystem, before: _CurvePoint | None, point: _CurvePoint, step: float
) -> _CurvePoint | None:
    """Predict and correct; return None if the result is not the next point of the same curve.

    The prediction is the cubic through the last two points with their tangents, or the tangent of the first point.
    """
    n, prediction = system.mechanism.n, step * point.tangent
    if before is not None:
        chord = np.concatenate([point.at.tree.difference(before.at.q_tree, point.at.q_tree), point.null - before.null])
        length = np.linalg.norm(chord)
        excess = (length * point.tangent - chord) / length**2
        cubic = 2 * excess + (before.tangent - point.tangent) / length
        prediction += step**2 * (excess + cubic) + step**3 / length * cubic
    guess = point.at.integrate(prediction[:n])
    at, null, residual = system.solve(guess, point.null + prediction[n:], iterations=CORRECTOR_ITERATIONS)
    if residual > max(RESIDUAL_TOLERANCE, system.mechanism.tolerance):
        return None
    tangent = _tangent(system, at, null)
    tangent = tangent * np.sign(tangent @ point.tangent)
    displacement = np.concatenate([at.tree.difference(point.at.q_tree, at.q_tree), null - point.null])
    if tangent @ point.tangent < MIN_TANGENT_COSINE or displacement @ point.tangent < MIN_PROGRESS * step:
        return None
    return _CurvePoint(at, null, tangent, residual)


def _tangent(system: SingularSystem, at: Kinematics, null: Array) -> Array:
    """Return the unit tangent of the curve. If v is not unique, choose the direction with the most motion in q'."""
    _, sizes, directions = np.linalg.svd(system.jacobian(at, null))
    null_space = directions[min(int(np.sum(sizes > RANK_TOLERANCE * sizes[0])), len(directions) - 1) :]
    weights = np.linalg.svd(null_space[:, : system.mechanism.n], full_matrices=False)[0][:, 0]
    return np.asarray(weights @ null_space)


def _lies_between(point: _CurvePoint, before: _CurvePoint, after: _CurvePoint) -> bool:
    """Whether a point of the curve lies between two neighbours, to the accuracy of one step."""
    stride = _distance(before, after)
    return _distance(before, point) <= stride and _distance(after, point) <= stride


def _distance(a: _CurvePoint, b: _CurvePoint) -> float:
    """Return the distance of all bodies and of the null vectors, whose sign has no meaning. Full turns do not count."""
    null = min(np.abs(a.null - b.null).max(), np.abs(a.null + b.null).max())
    return float(np.sqrt(np.sum((_placements(a.at) - _placements(b.at)) ** 2) + null**2))


def _placements(at: Kinematics) -> Array:
    return np.concatenate([at.pose.rotation.ravel(), at.pose.translation.ravel()])
