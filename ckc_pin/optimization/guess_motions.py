"""Motions over time that initial guesses are taken from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.optimization.replay import CoordinateMotion

__all__ = ["Joined", "Shifted", "Slowed", "SmoothMotion", "scale_durations"]


class _TimedMotion:
    """A motion that begins at 0 and takes a duration, s."""

    duration: float

    @property
    def corners(self) -> Array:
        """Both ends, s."""
        return np.array([0.0, self.duration])


@dataclass(frozen=True, eq=False)
class SmoothMotion(_TimedMotion):
    """Motion along a path with a cubic polynomial of time, plus cubics that give the rates at the ends."""

    path: PiecewisePolynomial
    start: Array
    end: Array
    duration: float

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations, (m, d) each, at times t (m,)."""
        T = self.duration
        x = t / T
        s, s_dot, s_ddot = 3 * x**2 - 2 * x**3, (6 * x - 6 * x**2) / T, (6 - 12 * x) / T**2
        q, q_s, q_ss = self.path(s)
        first = np.array([x - 2 * x**2 + x**3, (1 - 4 * x + 3 * x**2) / T, (-4 + 6 * x) / T**2])
        last = np.array([x**3 - x**2, (3 * x**2 - 2 * x) / T, (6 * x - 2) / T**2])
        more = [T * (np.outer(a, self.start) + np.outer(b, self.end)) for a, b in zip(first, last, strict=True)]
        return (q + more[0], q_s * s_dot[:, None] + more[1],
                q_s * s_ddot[:, None] + q_ss * s_dot[:, None] ** 2 + more[2])  # fmt: skip


@dataclass(frozen=True, eq=False)
class Slowed(_TimedMotion):
    """A motion with another duration."""

    motion: CoordinateMotion
    duration: float

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations, (m, d) each, at times t (m,)."""
        factor = float(self.motion.corners[-1]) / self.duration
        q, v, a = self.motion(np.minimum(t * factor, self.motion.corners[-1]))
        return q, v * factor, a * factor**2


@dataclass(frozen=True, eq=False)
class Shifted(_TimedMotion):
    """A motion from a later time on, at rest after its end."""

    motion: PiecewisePolynomial
    passed: float
    duration: float

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations, (m, d) each, at times t (m,)."""
        end = self.motion.breaks[-1]
        q, v, a = self.motion(np.minimum(t + self.passed, end))
        moves = (t + self.passed <= end)[:, None]
        return q, v * moves, a * moves


@dataclass(frozen=True, eq=False)
class Joined:
    """Motions one after the other."""

    motions: Sequence[CoordinateMotion]

    @property
    def corners(self) -> Array:
        """Both ends of each motion, s."""
        return np.append(0.0, np.cumsum([motion.corners[-1] for motion in self.motions]))

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations, (m, d) each, at times t (m,)."""
        corners = self.corners
        which = np.clip(np.searchsorted(corners, t, side="right") - 1, 0, len(self.motions) - 1)
        parts = [motion(t[which == k] - corners[k]) for k, motion in enumerate(self.motions)]
        order = np.argsort(np.argsort(which, kind="stable"), kind="stable")
        q, v, a = (np.concatenate(x)[order] for x in zip(*parts, strict=True))
        return q, v, a


def scale_durations(durations: Array, t: Array) -> Array:
    """Return durations scaled so that places are passed at the times that are given.

    Parameters
    ----------
    durations : (phases,) array
    t : (phases + 1,) array
        Times of the places. NaN: free.
    """
    result = np.array(durations)
    fixed = np.flatnonzero(np.isfinite(t))
    for first, last in zip(fixed[:-1].tolist(), fixed[1:].tolist(), strict=True):
        result[first:last] *= (t[last] - t[first]) / durations[first:last].sum()
    return result
