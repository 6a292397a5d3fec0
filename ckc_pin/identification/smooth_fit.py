"""Smooth functions of time fitted to measurements: values, rates and accelerations, with their errors."""

from __future__ import annotations

from abc import ABCMeta, abstractmethod
from collections.abc import Callable

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array, Immutable

__all__ = ["SmoothFit", "describe_errors"]

MAX_EDGE_STD = 3.0  # standard deviation of an acceleration at an end, relative to the interior, that is used
EDGE_GRID = 50  # instants of each third at the ends, at which it is computed


class _AbstractStruct(msgspec.StructMeta, ABCMeta):
    """Metaclass of structures with abstract methods."""


class SmoothFit(Immutable, frozen=True, metaclass=_AbstractStruct):
    """A smooth function of time fitted to one measured quantity.

    Attributes
    ----------
    noise : float
        Standard deviation of a measurement, given or estimated.
    std : (3,) array
        Standard deviations of the value, its rate and its acceleration in the interior, root mean squares.
    interval : float
        Distance of instants at which the function is independent, s.
    span : (2,) array
        First and last time at which the acceleration is not extrapolated, s.
    """

    noise: float
    std: Array
    interval: float
    span: Array

    @abstractmethod
    def values(self, t: Array) -> Array:
        """Return value, rate and acceleration, shape (3, len(t))."""

    @abstractmethod
    def errors(self, t: Array, gains: Array) -> Array:
        """Return errors of sums of gains (3, m, r) times value, rate and acceleration at times (m,).

        Returns
        -------
        (r, any) array
            Factors of independent errors of variance 1.
        """


def describe_errors(variance: Callable[[Array, int], Array], t: Array) -> tuple[Array, Array]:
    """Return `std` for unit noise and `span` of a fit to measurements at times t.

    Parameters
    ----------
    variance : callable
        Of a derivative at times (m,), by its order, for unit noise.
    """
    first, last = t[0], t[-1]
    inside = np.linspace(first, last, 25)[2:-2]
    std = np.sqrt([np.mean(variance(inside, order)) for order in range(3)])
    third = np.linspace(0.0, (last - first) / 3, EDGE_GRID)
    ends = []
    for grid in (first + third, last - third):
        is_far = np.sqrt(variance(grid, 2)) > MAX_EDGE_STD * std[2]
        ends.append(grid[min(int(np.sum(is_far)), EDGE_GRID - 1)])
    return std, np.array(ends)
