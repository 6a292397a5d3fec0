"""One large step across a position where J loses rank: Gauss collocation with the position in its middle gap.

The motion is smooth there, only J does not determine it. So the position is put in the middle of the step, as far
from every stage as a stage can be, and each stage is put on the closure before it is evaluated: what is off the
closure would come back divided by J's least singular value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import legendre

from ckc_pin.mechanism.tree import Array

__all__ = ["Leap", "leap", "tables"]

Rates = Callable[[Array, Array], Array]

RUN_UP = 0.4  # of the leap: what is integrated first, to extrapolate the rest from
STAGES = (10, 14)  # of the run-up and a first leap, and of the leap itself; even: none in the middle
ACCURATE = 1e-9  # of |y|: how well the two leaps have to agree
ORDER = 12  # in the length of a leap: how its error is observed to grow
SWEEPS = 30  # of the fixed-point iteration on the stages
SETTLED = 0.005 * ACCURATE  # what is left to the fixed point when the iteration ends
FIRST = 0.1 * ACCURATE  # the same for the first leap, which the last one is compared with
GUESSED = 1e-4  # the same where only a guess is extrapolated from it
FAR = 0.03  # of |y|: a guess that is as far off foretells a leap that is not accurate
FORETOLD = 1e-6  # of how far off the guess is: the error of such a leap, as observed
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
        return _polynomials(x, len(self._series)) @ self._series

    @property
    def good(self) -> bool:
        """Whether the leap is as accurate as it has to be, and so stayed on its branch: off it the rates jump."""
        return self.error <= ACCURATE

    @property
    def scale(self) -> float:
        """How many times as long a leap as accurate as needed may be."""
        return float(0.9 * (ACCURATE / max(self.error, 1e-300)) ** (1 / ORDER))


def leap(rates: Rates, t: float, y: Array, span: float, known: Leap | None = None) -> Leap:
    """Step from (t, y) over a span with a position at its middle where J loses rank.

    Parameters
    ----------
    rates : callable
        y' at instants and rows of states, which are put on the closure first; NaN where it does not exist.
    t : float
    y : array
    span : float
    known : Leap, optional
        Another one from (t, y), over about the same span: no run-up is needed then.
    """
    few, many = STAGES
    if known is None:
        length = RUN_UP * span
        start = _series(rates(np.array([t]), y[None]), y, length)
        series, _ = _collocated(rates, t, y, length, _rates_of(start, length, few, 1.0), GUESSED)
    else:
        length, series = known.t - known.t_old, known._series
    size = max(1.0, float(np.abs(y).max()))
    first, off = _collocated(rates, t, y, span, _rates_of(series, length, few, span / length), FIRST, FAR * size)
    if not off <= FAR * size:
        return Leap(t, t + span, FORETOLD * off / size if np.isfinite(off) else np.inf, first)
    last, _ = _collocated(rates, t, y, span, _rates_of(first, span, many, 1.0))
    gap = np.abs(_at_places(many) @ last - _at_places(few) @ first).max()
    error = float(gap / size)
    return Leap(t, t + span, error if np.isfinite(error) else np.inf, last)


def _collocated(
    rates: Rates, t: float, y: Array, span: float, guess: Array, settled: float = SETTLED, far: float = np.inf
) -> tuple[Array, float]:
    """Solve the stages by fixed-point iteration, which the smoothness of the motion makes a contraction.

    Parameters
    ----------
    guess : (stages, len(y)) array
        Of y' at the stages.
    settled : float
        How near the fixed point is near enough, in y; what rounding leaves ends the iteration too.
    far : float
        A guess from which the first sweep goes farther is given up.

    Returns
    -------
    series : (stages + 1, len(y)) array
        Legendre series of y over the step; NaN where a stage does not exist.
    off : float
        How far the first sweep went, in y.
    """
    stages, off, before = len(guess), np.nan, np.inf
    nodes = _nodes(stages)
    times, to_nodes = t + span * (1 + nodes) / 2, _at_nodes(stages)
    for sweep in range(SWEEPS):
        series = _series(guess, y, span)
        if not np.isfinite(series).all():
            break
        new = rates(times, to_nodes @ series)
        change = float(np.abs(new - guess).max()) * span
        off = change if sweep == 0 else off
        guess = new
        if not change < 0.5 * before or off > far:  # diverging, or at rounding
            break
        left = change * (change / before if sweep else 1.0)  # contracting as it did last
        if left <= settled:
            break
        before = change
    return _series(guess, y, span), off


@cache
def tables() -> list[dict[str, Array]]:
    """What the native leap takes, by number of stages; it keeps states in columns."""
    return [
        {
            "nodes": _nodes(stages),
            "at_nodes": np.asfortranarray(_at_nodes(stages).T),
            "at_places": np.asfortranarray(_at_places(stages).T),
            "integration": np.asfortranarray(_integration(stages).T),
            "derivation": np.asfortranarray(_derivation(stages).T),
        }
        for stages in STAGES
    ]


@cache
def _nodes(stages: int) -> Array:
    nodes, _ = legendre.leggauss(stages)
    return nodes


@cache
def _at_nodes(stages: int) -> Array:
    """From a series of a step to its values at the nodes."""
    return np.asarray(legendre.legvander(_nodes(stages), stages))


@cache
def _at_places(stages: int) -> Array:
    """The same at the places where leaps are compared."""
    return np.asarray(legendre.legvander(PLACES, stages))


@cache
def _derivation(stages: int) -> Array:
    """From a series of a step to that of its derivative, shape (stages, stages + 1)."""
    return np.asarray(legendre.legder(np.eye(stages + 1)))


@cache
def _integration(stages: int) -> Array:
    """From values at the nodes to the series of their integral from -1 on, shape (stages + 1, stages)."""
    return legendre.legint(np.linalg.inv(legendre.legvander(_nodes(stages), stages - 1)), lbnd=-1)


def _series(rates: Array, y: Array, span: float) -> Array:
    """Integrate the polynomial through the rates at Gauss nodes, from y on."""
    integral = (span / 2) * _integration(len(rates)) @ rates
    integral[0] += y
    return integral


def _rates_of(series: Array, span: float, stages: int, further: float) -> Array:
    """Rates of a polynomial at the nodes of a step that is `further` times as long."""
    x = (1 + _nodes(stages)) * further - 1
    known = len(series) - 1
    return np.asarray(legendre.legvander(x, known - 1) @ (_derivation(known) @ series) * (2 / span))


def _polynomials(x: float, count: int) -> Array:
    """Legendre's first polynomials at one place, in a twentieth of the time of NumPy's, made for arrays."""
    values = [1.0, x]
    for k in range(1, count - 1):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return np.array(values)
