"""The curve of singular configurations through one of them, by continuation.

A mechanism of two freedoms has curves of them in (q', v). Steps go along the curve's tangent, Newton brings
each back to the equations of `ckc_pin.analysis.singularities`, and the curve is closed when every body is
where it was at the start, whatever the joints have turned meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.analysis.singularities import EXACT, SingularPoint, SingularSystem
from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["SingularCurve", "trace", "trace_singular"]

SHORTEST = 1e-6  # of the step wanted: where shorter ones would be needed the curve ends, or branches
BEND = 0.95  # cosine of the angle that the tangent may turn in one step: a closed curve has twenty of them or more
FLAT = 1e-9  # of the largest singular value: along such directions the equations stay solved
FEWEST = 10  # points before the start can come back


@dataclass(frozen=True)
class SingularCurve:
    """Points along a curve of singular configurations, in order.

    Attributes
    ----------
    q_tree : (m, nq) array
        Pinocchio's q.
    null : (m, n) array
        The velocity that is lost sight of, |v| = 1, as in `SingularPoint`.
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
class _Place:
    at: Kinematics
    null: Array
    tangent: Array
    residual: float


def trace_singular(
    mechanism: Mechanism, start: SingularPoint, step: float = 0.05, point: str | None = None, max_points: int = 5000
) -> SingularCurve:
    """Follow the curve of singular configurations through one of them.

    Parameters
    ----------
    mechanism : Mechanism
        Of two freedoms.
    start : SingularPoint
        From `find_singular`, for the same `point`.
    step : float
        Longest step along the curve in (q', v), rad or m; shorter ones are taken where it bends.
    point : str, optional
        As in `find_singular`.
    max_points : int
        Where to end a curve that does not close, in each direction.

    Raises
    ------
    InputError
        Not two freedoms, a step that is not positive.
    """
    if mechanism.d != 2:
        raise InputError(
            f"{mechanism.name}: singular configurations form a curve where d = 2, here d = {mechanism.d}; "
            "sample them with search_singular"
        )
    if not 0 < step < np.inf:
        raise InputError(f"step = {step}: expected a positive number")
    return trace(SingularSystem(mechanism, point), start.at, start.null, step, max_points)


def trace(
    system: SingularSystem, at: Kinematics, null: Array, step: float = 0.05, max_points: int = 5000
) -> SingularCurve:
    """Follow the curve of solutions (q', v) of a system through one of them; what `trace_singular` does.

    Parameters
    ----------
    system : SingularSystem
        With curves of solutions.
    at : Kinematics
    null : (n,) array
        The solution to start from.
    step, max_points
        As in `trace_singular`.
    """
    tangent = _tangent(system, at, null)
    first = _Place(at, null, tangent, float(np.abs(system.residual(at, null)).max()))
    way, closed = _walk(system, first, step, max_points)
    if not closed:
        back, _ = _walk(system, _Place(first.at, first.null, -tangent, first.residual), step, max_points)
        way = [*reversed(back), *way[1:]]
    return SingularCurve(
        q_tree=np.array([place.at.q_tree for place in way]),
        null=np.array([place.null for place in way]),
        closed=closed,
        residual=max(place.residual for place in way),
    )


def _walk(system: SingularSystem, first: _Place, step: float, max_points: int) -> tuple[list[_Place], bool]:
    """Follow the tangent until the curve closes or ends."""
    way, length = [first], step
    while len(way) < max_points:
        ahead = _advance(system, way[-1], length)
        if ahead is not None:
            if len(way) > FEWEST and _lies_between(first, way[-1], ahead):
                return [*way, first], True
            way.append(ahead)
            length = min(1.5 * length, step)
        elif length < SHORTEST * step:
            break
        else:
            length /= 2
    return way, False


def _advance(system: SingularSystem, place: _Place, length: float) -> _Place | None:
    """Predict along the tangent and correct; None where that is no local step."""
    n = system.mechanism.n
    guess = place.at.integrate(length * place.tangent[:n])
    at, null, residual = system.solve(guess, place.null + length * place.tangent[n:], iterations=6)
    if residual > max(EXACT, system.mechanism.tolerance):
        return None
    tangent = _tangent(system, at, null)
    tangent = tangent * np.sign(tangent @ place.tangent)
    went = np.concatenate([at.tree.difference(place.at.q_tree, at.q_tree), null - place.null])
    if tangent @ place.tangent < BEND or went @ place.tangent < 0.5 * length:
        return None
    return _Place(at, null, tangent, residual)


def _tangent(system: SingularSystem, at: Kinematics, null: Array) -> Array:
    """Return the direction of the curve; where v is not unique, the one that moves the mechanism most."""
    _, sizes, directions = np.linalg.svd(system.jacobian(at, null))
    along = directions[min(int(np.sum(sizes > FLAT * sizes[0])), len(directions) - 1) :]
    mixed = np.linalg.svd(along[:, : system.mechanism.n], full_matrices=False)[0][:, 0]
    return np.asarray(mixed @ along)


def _lies_between(place: _Place, before: _Place, after: _Place) -> bool:
    """Whether a place of the curve lies between two neighbours, as far as one step can tell."""
    stride = _apart(before, after)
    return _apart(before, place) <= stride and _apart(after, place) <= stride


def _apart(a: _Place, b: _Place) -> float:
    """How far apart all bodies and the null vectors (whose sign means nothing) are; full turns do not count."""
    null = min(np.abs(a.null - b.null).max(), np.abs(a.null + b.null).max())
    return float(np.sqrt(np.sum((_placements(a.at) - _placements(b.at)) ** 2) + null**2))


def _placements(at: Kinematics) -> Array:
    return np.concatenate([at.pose.rotation.ravel(), at.pose.translation.ravel()])
