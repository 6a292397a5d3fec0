"""Splines fitted to a measured quantity by least squares.

Generalized cross-validation chooses the degree and the number of knots. A spline of high degree follows a smooth motion
with fewer knots, so less noise passes into accelerations: their standard deviation grows with the number of knots to
the power 2.5. The highest degree is therefore taken that is not significantly worse. A few more knots than those of
cross-validation are taken too: the number that is best for values leaves a smoothing error of the accelerations, as
large as that of noise, which no standard deviation includes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.identification.smooth_fit import SmoothFit, describe_errors

__all__ = ["MIN_MEASUREMENTS", "KnotChoice", "SplineFit", "choose_knots", "fit_spline"]

DEGREES = (7, 11, 15)
MIN_MEASUREMENTS = 2 * (DEGREES[0] + 1)
COARSE, FINE = 1.25, 1.06  # between numbers of knot intervals that are compared
SIGNIFICANT = 1.0  # standard deviations by which the score of a lower degree has to be better
MAX_WORSE = 8  # numbers of knot intervals that are tried after the best one
MIN_SHARE = 0.4  # of the knot intervals of the lowest degree: fewer ones are not tried with a higher degree
MAX_SMOOTHING = 0.1  # smoothing error of accelerations, relative to its size with the knots of cross-validation
MIN_SAMPLES_PER_KNOT = 3.0


class SplineFit(SmoothFit, frozen=True):
    """A spline fitted to one measured quantity.

    Attributes
    ----------
    spline : BSpline
    factor : (degree + 1, coefficients) array
        Cholesky factor of the normal equations, as a band.
    """

    spline: Any
    factor: Array

    def values(self, t: Array) -> Array:
        """Return value, rate and acceleration, shape (3, len(t))."""
        return np.array([self.spline(t), self.spline.derivative(1)(t), self.spline.derivative(2)(t)])

    def errors(self, t: Array, gains: Array) -> Array:
        """Return errors of sums of gains times value, rate and acceleration; see `SmoothFit.errors`."""
        from scipy.interpolate import BSpline

        degree = self.spline.k
        sums = np.zeros((gains.shape[2], len(self.spline.c)))
        for k, gain in enumerate(gains):
            by_coefficient = BSpline(self.spline.t, np.eye(len(self.spline.c)), degree).derivative(k)
            design = BSpline.design_matrix(t, by_coefficient.t, degree - k)
            sums += (gain.T @ design) @ by_coefficient.c[: design.shape[1]]
        return self.noise * _whiten(self.factor, sums)


class KnotChoice(NamedTuple):
    """Degree and number of knot intervals of a spline, with its score of generalized cross-validation."""

    score: float
    degree: int
    intervals: int


def fit_spline(t: Array, y: Array, knots: KnotChoice, noise: float | None) -> SplineFit:
    """Fit a spline with a few more knots than those of cross-validation to measurements y at increasing times t."""
    more = MAX_SMOOTHING ** (-1.0 / (knots.degree + 1.5))  # errors of values fall with the power degree + 1
    intervals = min(round(more * knots.intervals), _max_intervals(t, knots.degree))
    spline = _least_squares(t, y, knots.degree, max(2, intervals))
    size = len(spline.c)
    if noise is None:
        noise = float(np.sqrt(np.sum((y - spline(t)) ** 2) / max(len(t) - size, 1)))
    factor = _factor(spline, t)
    std, span = describe_errors(lambda at, order: _variance(spline, factor, at, order), t)
    return SplineFit(noise, noise * std, float(t[-1] - t[0]) / (size - knots.degree), span, spline, factor)


def choose_knots(t: Array, y: Array) -> KnotChoice:
    """Choose the degree and the number of knot intervals by cross-validation."""
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


def _scan(t: Array, y: Array, degree: int, smallest: float, largest: float, growth: float) -> KnotChoice:
    """Return the best of geometrically growing numbers of knot intervals, at least two."""
    best = KnotChoice(np.inf, degree, 2)
    count, worse, largest = max(2.0, smallest), 0, min(largest, _max_intervals(t, degree))
    while (count <= largest or best.score == np.inf) and worse <= MAX_WORSE:
        spline = _least_squares(t, y, degree, int(count))
        score = float(np.mean((y - spline(t)) ** 2)) / (1 - len(spline.c) / len(t)) ** 2
        worse = 0 if score < best.score else worse + 1
        best = min(best, KnotChoice(score, degree, int(count)))
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
