"""Smoothing splines of measured quantities, whose rates and accelerations have known standard deviations.

Generalized cross-validation chooses the degree and the number of knots. A spline of high degree follows a smooth motion
with fewer knots, so less noise passes into accelerations: their standard deviation grows with the number of knots to
the power 2.5. The highest degree is therefore taken that is not significantly worse. A few more knots than those of
cross-validation are taken too: the number that is best for values leaves a smoothing error of the accelerations, as
large as that of noise, which no standard deviation includes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.errors import InputError
from ckc_pin.identification.records import Record

__all__ = ["SplineFit", "fit_spline", "fit_splines"]

DEGREES = (7, 11, 15)
COARSE, FINE = 1.25, 1.06  # between numbers of knot intervals that are compared
SIGNIFICANT = 1.0  # standard deviations by which the score of a lower degree has to be better
MAX_WORSE = 8  # numbers of knot intervals that are tried after the best one
MIN_SHARE = 0.4  # of the knot intervals of the lowest degree: fewer ones are not tried with a higher degree
MAX_SMOOTHING = 0.1  # smoothing error of accelerations, relative to its size with the knots of cross-validation
MIN_SAMPLES_PER_KNOT = 3.0
MAX_EDGE_STD = 3.0  # standard deviation of an acceleration at an end, relative to the interior, that is used
EDGE_GRID = 50  # instants of each third at the ends, at which it is computed


@dataclass(frozen=True, eq=False)
class SplineFit(Immutable):
    """A spline fitted to one measured quantity.

    Attributes
    ----------
    noise : float
        Standard deviation of a measurement, given or estimated.
    std : (3,) array
        Standard deviations of the spline, its rate and its acceleration in the interior, root mean squares.
    interval : float
        Distance of two knots, s.
    factor : (degree + 1, coefficients) array
        Cholesky factor of the normal equations, as a band.
    span : (2,) array
        First and last time at which the acceleration is not extrapolated, s.
    """

    spline: Any
    noise: float
    std: Array
    interval: float
    factor: Array
    span: Array

    def values(self, t: Array) -> Array:
        """Return value, rate and acceleration, shape (3, len(t))."""
        return np.array([self.spline(t), self.spline.derivative(1)(t), self.spline.derivative(2)(t)])

    def errors(self, t: Array, gains: Array) -> Array:
        """Return errors of sums of gains (3, m, r) times value, rate and acceleration at times (m,).

        Returns
        -------
        (r, coefficients) array
            Factors of independent errors of variance 1.
        """
        from scipy.interpolate import BSpline

        degree = self.spline.k
        sums = np.zeros((gains.shape[2], len(self.spline.c)))
        for k, gain in enumerate(gains):
            by_coefficient = BSpline(self.spline.t, np.eye(len(self.spline.c)), degree).derivative(k)
            design = BSpline.design_matrix(t, by_coefficient.t, degree - k)
            sums += (gain.T @ design) @ by_coefficient.c[: design.shape[1]]
        return self.noise * _whiten(self.factor, sums)


def fit_splines(record: Record, names: Sequence[str]) -> dict[str, SplineFit]:
    """Fit splines to measured quantities of a record (InputError)."""
    return {
        name: fit_spline(f"{record.source}: {name}", record.times(name), record.values[name], record.noise.get(name))
        for name in names
    }


def fit_spline(name: str, t: Array, y: Array, noise: float | None = None) -> SplineFit:
    """Fit a spline to measurements y at increasing times t, which may be unequal; NaN marks gaps.

    Messages call the quantity `name`.

    Raises
    ------
    InputError
        Fewer than sixteen measurements.
    """
    measured = np.isfinite(y)
    t, y = t[measured], y[measured]
    smallest = 2 * (DEGREES[0] + 1)
    if len(t) < smallest:
        raise InputError(f"identify: {name}: {len(t)} values; at least {smallest} are needed")
    best = _choose_knots(t, y)
    more = MAX_SMOOTHING ** (-1.0 / (best.degree + 1.5))  # errors of values fall with the power degree + 1
    intervals = min(round(more * best.intervals), _max_intervals(t, best.degree))
    spline = _least_squares(t, y, best.degree, max(2, intervals))
    size = len(spline.c)
    if noise is None:
        noise = float(np.sqrt(np.sum((y - spline(t)) ** 2) / max(len(t) - size, 1)))
    interval = (t[-1] - t[0]) / (size - best.degree)
    factor = _factor(spline, t)
    inside = np.linspace(t[0], t[-1], 25)[2:-2]
    std = np.sqrt([np.mean(_variance(spline, factor, inside, k)) for k in range(3)])
    return SplineFit(spline, noise, noise * std, float(interval), factor, _span(spline, factor, std[2]))


class _Choice(NamedTuple):
    """Score of generalized cross-validation, and what has it."""

    score: float
    degree: int
    intervals: int


def _choose_knots(t: Array, y: Array) -> _Choice:
    """Return the degree and the number of knot intervals with the lowest score of cross-validation."""
    low, *higher = DEGREES
    first = _scan(t, y, low, 2, _max_intervals(t, low), COARSE)
    choices = [first]
    for degree in higher:
        if len(t) >= 2 * (degree + 1):
            choices.append(_scan(t, y, degree, MIN_SHARE * first.intervals, first.intervals, COARSE))
    best = min(choices)
    chance = (2 * (best.intervals + best.degree)) ** 0.5 / len(t)  # standard deviation of a score, relative
    best = next(x for x in choices[::-1] if x.score <= (1 + SIGNIFICANT * chance) * best.score)
    return min(best, _scan(t, y, best.degree, best.intervals / COARSE, COARSE * best.intervals, FINE))


def _scan(t: Array, y: Array, degree: int, smallest: float, largest: float, growth: float) -> _Choice:
    """Return the best of geometrically growing numbers of knot intervals, at least two."""
    best = _Choice(np.inf, degree, 2)
    count, worse, largest = max(2.0, smallest), 0, min(largest, _max_intervals(t, degree))
    while (count <= largest or best.score == np.inf) and worse <= MAX_WORSE:
        spline = _least_squares(t, y, degree, int(count))
        score = float(np.mean((y - spline(t)) ** 2)) / (1 - len(spline.c) / len(t)) ** 2
        worse = 0 if score < best.score else worse + 1
        best = min(best, _Choice(score, degree, int(count)))
        count = max(count + 1, count * growth)
    return best


def _max_intervals(t: Array, degree: int) -> int:
    return max(2, int(len(t) / MIN_SAMPLES_PER_KNOT - degree))


def _least_squares(t: Array, y: Array, degree: int, intervals: int) -> Any:
    """Return the spline whose knot intervals have equally many measurements."""
    from scipy.interpolate import make_lsq_spline

    inner = np.quantile(t, np.linspace(0, 1, intervals + 1)[1:-1])
    knots = np.concatenate([[t[0]] * (degree + 1), inner, [t[-1]] * (degree + 1)])
    spline = make_lsq_spline(t, y - y[0], knots, k=degree)  # without rounding errors of the rate if y is constant
    spline.c += y[0]
    return spline


def _factor(spline: Any, t: Array) -> Array:
    """Return the upper Cholesky factor of the normal equations, as a band."""
    from scipy.interpolate import BSpline
    from scipy.linalg import cholesky_banded

    design = BSpline.design_matrix(t, spline.t, spline.k)
    gram = (design.T @ design).tocsc()
    band = np.zeros((spline.k + 1, gram.shape[0]))
    for k in range(spline.k + 1):
        band[spline.k - k, k:] = gram.diagonal(k)
    return np.asarray(cholesky_banded(band))


def _whiten(factor: Array, sums: Array) -> Array:
    """Return the errors of sums (r, coefficients) of coefficients as factors of independent errors, for unit noise."""
    from scipy.linalg import solve_banded

    lower = np.array([np.roll(row, -k) for k, row in enumerate(factor[::-1])])  # the transposed factor
    return np.asarray(solve_banded((len(factor) - 1, 0), lower, sums.T).T)


def _variance(spline: Any, factor: Array, t: Array, order: int) -> Array:
    """Return the variance of a derivative of the spline at times, for unit noise."""
    from scipy.interpolate import BSpline

    unit = BSpline(spline.t, np.eye(len(spline.c)), spline.k).derivative(order)
    return np.asarray(np.sum(_whiten(factor, unit(t)) ** 2, axis=1))


def _span(spline: Any, factor: Array, std: float) -> Array:
    """Return the first and last time at which the standard deviation of the acceleration is not much above `std`."""
    first, last = spline.t[[0, -1]]
    third = np.linspace(0.0, (last - first) / 3, EDGE_GRID)
    ends = []
    for grid in (first + third, last - third):
        is_far = np.sqrt(_variance(spline, factor, grid, 2)) > MAX_EDGE_STD * std
        ends.append(grid[min(int(np.sum(is_far)), EDGE_GRID - 1)])
    return np.array(ends)
