"""Motions on a mesh: accelerations at the Gauss points of each interval, and motor torques at the knots.

A motion consists of phases, from one place to the next. Each has a duration of its own.
"""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, Immutable, IntArray
from ckc_pin.control.piecewise import PiecewisePolynomial

__all__ = ["DEGREE", "Guess", "Mesh", "Places", "Solution", "gauss_points", "times"]

DEGREE = 3  # Gauss points of an interval


class Places(Immutable, frozen=True):
    """Places that a motion passes, from its start to its end; its phases are between them.

    Attributes
    ----------
    q, rates : (places, d) arrays
        NaN: free.
    t : (places,) array
        Times, s. NaN: free.
    turns : (d,) array, optional
        The motion is periodic: it ends with the rates with which it begins, and with q that differ by this.
    jumps, jumps_at_start : bool
        Whether torques may jump at the places between start and end, and where a period ends.
    """

    q: Array
    rates: Array
    t: Array
    turns: Array | None = None
    jumps: bool = True
    jumps_at_start: bool = True


class Mesh(Immutable, frozen=True):
    """Knots of phases.

    Attributes
    ----------
    knots : (knots,) array
        Phase k is from k to k + 1, which are knots.
    """

    knots: Array

    @classmethod
    def uniform(cls, intervals: int, durations: Array) -> Mesh:
        """Return a mesh with about as many intervals, all of about the same duration."""
        counts = np.maximum(np.rint(intervals * durations / durations.sum()), 1 if len(durations) == 1 else 4)
        parts = [k + np.arange(n) / n for k, n in enumerate(counts.astype(int).tolist())]
        return cls(np.append(np.concatenate(parts), float(len(durations))))

    @property
    def phases(self) -> int:
        """The number of phases."""
        return int(self.knots[-1])

    @property
    def steps(self) -> Array:
        """Shares of the intervals in the durations of their phases."""
        return np.diff(self.knots)

    @property
    def phase(self) -> IntArray:
        """The phase of each interval."""
        return np.floor((self.knots[1:] + self.knots[:-1]) / 2).astype(np.int64)

    @property
    def begin(self) -> IntArray:
        """The place at which each interval begins, in a list of the knots of each phase, one phase after the other."""
        return np.arange(len(self.knots) - 1) + self.phase

    @property
    def knot(self) -> IntArray:
        """The knot of each entry of this list."""
        return np.sort(np.concatenate([np.arange(len(self.knots)), np.flatnonzero(self._is_inner_end)]))

    @property
    def phase_of_knots(self) -> IntArray:
        """The phase of each entry of this list."""
        phase = np.floor(self.knots[self.knot]).astype(np.int64)
        ends = np.flatnonzero(np.diff(self.knot) == 0)
        phase[ends] -= 1
        phase[-1] -= 1
        return phase

    @property
    def _is_inner_end(self) -> BoolArray:
        inner = self.knots == np.floor(self.knots)
        inner[[0, -1]] = False
        return inner

    def gauss_places(self) -> Array:
        """Return the Gauss points of the intervals, in units of the knots."""
        return np.asarray((self.knots[:-1, None] + self.steps[:, None] * gauss_points()[0]).ravel())

    def divide(self, intervals: BoolArray) -> Mesh:
        """Return a mesh with intervals and their neighbours halved."""
        halved = intervals.copy()
        halved[1:] |= intervals[:-1]
        halved[:-1] |= intervals[1:]
        middles = (self.knots[1:] + self.knots[:-1]) / 2
        return Mesh(np.sort(np.concatenate([self.knots, middles[halved]])))


class Guess(Immutable, frozen=True):
    """An initial guess.

    Attributes
    ----------
    mesh : Mesh
    durations : (phases,) array
        s.
    q, rates : (knots, d) arrays
    accelerations : (intervals, DEGREE, d) array
        At the Gauss points.
    torque : (knots + phases - 1, motors) array
        At the knots of each phase, one phase after the other.
    q_tree : (intervals DEGREE, nq) array
        Closed configurations near the Gauss points.
    """

    mesh: Mesh
    durations: Array
    q: Array
    rates: Array
    accelerations: Array
    torque: Array
    q_tree: Array

    @property
    def ends(self) -> Array:
        """Times of the places, s, (phases + 1,)."""
        return np.append(0.0, np.cumsum(self.durations))

    @property
    def t(self) -> Array:
        """Times of the knots, s."""
        return times(self.mesh.knots, self.ends)

    @property
    def torque_t(self) -> Array:
        """Times of the rows of `torque`, s; two rows have the same time where a phase ends."""
        return self.t[self.mesh.knot]


class Solution(Immutable, frozen=True):
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
        values, t = self.values, self.values.t
        step = np.diff(t)
        # Accelerations as polynomials of the share of the interval, by ascending power.
        powers = np.linalg.inv(np.vander(gauss_points()[0], increasing=True))
        a = np.einsum("pj,kjd->pkd", powers, values.accelerations)
        scaled = [a[p] / ((p + 1) * (p + 2)) / step[:, None] ** p for p in range(DEGREE)]
        coefficients = np.array([*scaled[::-1], values.rates[:-1], values.q[:-1]])
        rates = np.abs(values.rates).max(initial=0.0)
        return PiecewisePolynomial(t, coefficients, corners=t, max_frequency=float(rates), end=float(t[-1]))


def times(places: Array, ends: Array) -> Array:
    """Return times of places in units of the knots of a mesh, from the times of the ends of phases."""
    return np.asarray(np.interp(places, np.arange(len(ends)), ends))


def gauss_points() -> tuple[Array, Array, Array, Array, Array]:
    """Return points, weights, integrals and double integrals up to the points, and double integrals to the end."""
    x, w = np.polynomial.legendre.leggauss(DEGREE)
    points = (x + 1) / 2
    powers = np.linalg.inv(np.vander(points, increasing=True))
    n = np.arange(DEGREE)
    once = (points[:, None] ** (n + 1) / (n + 1)) @ powers
    twice = (points[:, None] ** (n + 2) / ((n + 1) * (n + 2))) @ powers
    return points, w / 2, once, twice, (1 / ((n + 1) * (n + 2))) @ powers
