"""All sign changes of a function of time within one step, those that undo each other among them.

The function is known at Chebyshev points of the step. Between them it can still dip through zero and come
back, so it is also evaluated at the extrema of the polynomial through those points; and where it comes near
to zero there, the nearest point is searched for, which finds the tip of a kink as well.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev

from ckc_pin.mechanism.tree import Array

__all__ = ["PLACES", "Walk", "walk"]

DEGREE = 8
PLACES = (1.0 - np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)) / 2  # in the step, from 0 to 1
SERIES = np.linalg.inv(chebyshev.chebvander(2 * PLACES - 1, DEGREE))  # from values to Chebyshev coefficients

ZERO = 1e-12  # of the largest value in the step: counts as zero
NEAR = 0.25  # of the function's range in the step: an extremum so near to zero is refined
T_TOLERANCE = 1e-12  # s

Points = list[tuple[float, float]]  # (t, value), increasing in t
Gap = Callable[[float], float]


class Walk:
    """What a function did along a step.

    Attributes
    ----------
    found : list of (t, direction)
        Its sign changes, in order of time; direction 1 from below, -1 from above.
    sign : int
        Its sign at the end, or the last one it had; 0 while it has had none.
    on_zero : bool
        Whether it is zero at the end.
    """

    def __init__(self, sign: int) -> None:
        self.found: list[tuple[float, int]] = []
        self.sign = sign
        self.on_zero = False


def walk(gap: Gap, times: Array, values: Array, sign: int, floor: float) -> Walk:
    """Find the sign changes of a function within a step.

    Parameters
    ----------
    gap : callable
        The function at a time within the step.
    times, values : (k,) arrays
        The `PLACES` of the step, and the function there.
    sign : int
        The sign it came with; 0 for none yet, then its first one is no change.
    floor : float
        Largest value that counts as zero, beside 1e-12 of the largest in the step.
    """
    zero = max(floor, ZERO * float(np.abs(values).max()))
    points = _with_extrema(gap, list(zip(times.tolist(), values.tolist(), strict=True)), zero)
    result, last = Walk(sign), points[0]
    for point in points:
        new = 0 if abs(point[1]) <= zero else int(np.sign(point[1]))
        result.on_zero = new == 0
        if new and result.sign not in (0, new):
            result.found.append((_root(gap, last, point), new))
        if new:
            result.sign, last = new, point
    return result


def _root(gap: Gap, start: tuple[float, float], end: tuple[float, float]) -> float:
    if start[1] * end[1] >= 0:  # zero at the start of the step, or beyond it by what counts as zero
        return start[0]
    from scipy.optimize import brentq

    return float(brentq(gap, start[0], end[0], xtol=T_TOLERANCE, rtol=4 * np.finfo(float).eps))


def _with_extrema(gap: Gap, points: Points, zero: float) -> Points:
    """Add the points between the given ones where the function comes nearest to zero."""
    values = np.array([value for _, value in points])
    spread = float(np.ptp(values))
    if not np.abs(values).min() <= spread:  # too far from zero to reach it and come back
        return points
    t_old, h = points[0][0], points[-1][0] - points[0][0]
    extrema = [(t, gap(t)) for t in (t_old + h * _extrema(SERIES @ values)).tolist()]
    points = sorted({*points, *extrema})
    tips = []
    for k, (_, value) in enumerate(points):
        around = points[max(k - 1, 0) : k + 2]
        nearest = all(value * other > 0 and abs(value) <= abs(other) for _, other in around)
        if nearest and zero < abs(value) < NEAR * spread:
            tips.append(_tip(gap, around[0][0], around[-1][0], float(np.sign(value))))
    return sorted({*points, *tips})


def _extrema(series: Array) -> Array:
    """Places within (0, 1) where the derivative of a Chebyshev series vanishes."""
    slope = chebyshev.chebtrim(chebyshev.chebder(series), 1e-13 * float(np.abs(series).max()))
    if len(slope) < 2:
        return np.zeros(0)
    roots = chebyshev.chebroots(slope)
    places = (1.0 + np.real(roots[np.abs(np.imag(roots)) < 1e-6])) / 2
    return np.asarray(places[(places > 0) & (places < 1)], dtype=float)


def _tip(gap: Gap, start: float, end: float, sign: float) -> tuple[float, float]:
    """Return the point between two times where sign * function is least."""
    from scipy.optimize import minimize_scalar

    options = {"xatol": 1e-9 * (end - start)}
    found = minimize_scalar(lambda t: sign * gap(t), bounds=(start, end), method="bounded", options=options)
    return float(found.x), sign * float(found.fun)
