"""Motions on a mesh: accelerations at the Gauss points of each interval, and motor torques at the knots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.control.piecewise import PiecewisePolynomial

__all__ = ["DEGREE", "Ends", "Guess", "Solution", "gauss_points"]

DEGREE = 3  # Gauss points of an interval


@dataclass(frozen=True, eq=False)
class Ends(Immutable):
    """Start and end of a motion: q and rates (2, d) each. NaN: the end is free."""

    q: Array
    rates: Array


@dataclass(frozen=True, eq=False)
class Guess(Immutable):
    """An initial guess.

    Attributes
    ----------
    mesh : (knots,) array
        From 0 to 1.
    duration : float
        s.
    q, rates : (knots, d) arrays
    accelerations : (intervals, DEGREE, d) array
        At the Gauss points.
    torque : (knots, motors) array
    q_tree : (intervals DEGREE, nq) array
        Closed configurations near the Gauss points.
    """

    mesh: Array
    duration: float
    q: Array
    rates: Array
    accelerations: Array
    torque: Array
    q_tree: Array


@dataclass(frozen=True, eq=False)
class Solution(Immutable):
    """What the optimizer returns: a `Guess`, its status, cost, parts of the cost, iterations, and largest violation."""

    values: Guess
    status: str
    cost: float
    parts: dict[str, float]
    iterations: int
    violation: tuple[str, float]

    @property
    def is_optimum(self) -> bool:
        """Whether IPOPT reports a local optimum."""
        return self.status in ("Solve_Succeeded", "Solved_To_Acceptable_Level")

    def motion(self) -> PiecewisePolynomial:
        """Return q over time."""
        values, T = self.values, self.values.duration
        t, step = T * values.mesh, T * np.diff(values.mesh)
        # Accelerations as polynomials of the share of the interval, by ascending power.
        powers = np.linalg.inv(np.vander(gauss_points()[0], increasing=True))
        a = np.einsum("pj,kjd->pkd", powers, values.accelerations)
        scaled = [a[p] / ((p + 1) * (p + 2)) / step[:, None] ** p for p in range(DEGREE)]
        coefficients = np.array([*scaled[::-1], values.rates[:-1], values.q[:-1]])
        rates = np.abs(values.rates).max(initial=0.0)
        return PiecewisePolynomial(t, coefficients, corners=t, max_frequency=float(rates), end=float(t[-1]))


def gauss_points() -> tuple[Array, Array, Array, Array, Array]:
    """Return points, weights, integrals and double integrals up to the points, and double integrals to the end."""
    x, w = np.polynomial.legendre.leggauss(DEGREE)
    points = (x + 1) / 2
    powers = np.linalg.inv(np.vander(points, increasing=True))
    n = np.arange(DEGREE)
    once = (points[:, None] ** (n + 1) / (n + 1)) @ powers
    twice = (points[:, None] ** (n + 2) / ((n + 1) * (n + 2))) @ powers
    return points, w / 2, once, twice, (1 / ((n + 1) * (n + 2))) @ powers
