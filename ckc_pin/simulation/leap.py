"""One large step across a position where J loses rank: Gauss collocation with the position in its middle gap.

The motion is smooth there, only J does not determine it. So the position is put in the middle of the step, as far
from every stage as a stage can be, and each stage is put on the closure before it is evaluated: what is off the
closure would come back divided by J's least singular value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from ckc_pin.mechanism.tree import Array

__all__ = ["Leap", "leap"]

Rate = Callable[[float, Array], Array]

RUN_UP = 0.4  # of the leap: what is integrated first, to extrapolate the rest from
STAGES = (10, 14)  # of the run-up and a first leap, and of the leap itself; even: none in the middle
ACCURATE = 1e-9  # of |y|: how well the two leaps have to agree
ORDER = 12  # in the length of a leap: how its error is observed to grow
SWEEPS = 30  # of the fixed-point iteration on the stages
PLACES = np.linspace(-1.0, 1.0, 41)  # where they are compared


@dataclass(frozen=True)
class Leap:
    """A step as a polynomial.

    Attributes
    ----------
    t_old, t : float
    error : float
        How far two leaps with different stages are apart, relative to |y|.
    """

    t_old: float
    t: float
    error: float
    _series: Array  # Legendre series of y over the step, a row a degree

    def __call__(self, t: float) -> Array:
        """Return y at t."""
        x = (2 * t - self.t_old - self.t) / (self.t - self.t_old)
        return np.asarray(legendre.legval(x, self._series))

    @property
    def good(self) -> bool:
        """Whether the leap is as accurate as it has to be, and so stayed on its branch: off it the rates jump."""
        return self.error <= ACCURATE

    @property
    def scale(self) -> float:
        """How many times as long a leap as accurate as needed may be."""
        return float(0.9 * (ACCURATE / max(self.error, 1e-300)) ** (1 / ORDER))


def leap(rate: Rate, t: float, y: Array, span: float) -> Leap:
    """Step from (t, y) over a span with a position at its middle where J loses rank.

    Parameters
    ----------
    rate : callable
        y' at (t, y), y being put on the closure first; NaN where it does not exist.
    t : float
    y : array
    span : float
    """
    few, many = STAGES
    start = _series(np.array([rate(t, y)]), y, RUN_UP * span)
    run_up = _collocated(rate, t, y, RUN_UP * span, few, _rates_of(start, RUN_UP * span, few, 1.0))
    first = _collocated(rate, t, y, span, few, _rates_of(run_up, RUN_UP * span, few, 1 / RUN_UP))
    last = _collocated(rate, t, y, span, many, _rates_of(first, span, many, 1.0))
    gap = np.abs(legendre.legval(PLACES, last) - legendre.legval(PLACES, first)).max()
    error = float(gap / max(1.0, np.abs(y).max()))
    return Leap(t, t + span, error if np.isfinite(error) else np.inf, last)


def _collocated(rate: Rate, t: float, y: Array, span: float, stages: int, rates: Array) -> Array:
    """Solve the stages by fixed-point iteration, which the smoothness of the motion makes a contraction.

    Returns
    -------
    (stages + 1, len(y)) array
        Legendre series of y over the step; NaN where a stage does not exist.
    """
    nodes, _ = legendre.leggauss(stages)
    before = np.inf
    for _ in range(SWEEPS):
        places = legendre.legval(nodes, _series(rates, y, span)).T
        new = np.array([rate(t + span * (1 + x) / 2, place) for x, place in zip(nodes, places, strict=True)])
        change = float(np.abs(new - rates).max()) * span
        rates = new
        if change <= 0.001 * ACCURATE or not change < 0.5 * before:  # else at rounding, or diverging
            break
        before = change
    return _series(rates, y, span)


def _series(rates: Array, y: Array, span: float) -> Array:
    """Integrate the polynomial through the rates at Gauss nodes, from y on."""
    nodes, _ = legendre.leggauss(len(rates))
    coefficients = np.linalg.solve(legendre.legvander(nodes, len(nodes) - 1), rates)
    integral = legendre.legint(coefficients, lbnd=-1) * (span / 2)
    integral[0] += y
    return integral


def _rates_of(series: Array, span: float, stages: int, further: float) -> Array:
    """Rates of a polynomial at the nodes of a step that is `further` times as long."""
    nodes, _ = legendre.leggauss(stages)
    x = (1 + nodes) * further - 1
    return np.asarray(legendre.legval(x, legendre.legder(series) * (2 / span))).T
