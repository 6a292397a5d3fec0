"""Fastest speed along a path under linear limits: reachability analysis by one sweep back and one sweep forth.

With b = s_dot^2 and u = s_ddot, the limits at each s are rows alpha u + beta b <= gamma (Bobrow; Verscheure). The rows
hold at both ends of each interval of a grid. The sweep back computes the interval of b from which the end can be
reached. The sweep forth takes the largest b in it (Pham and Pham, TOPP-RA).

In an interval u is linear in s. Its slope is estimated from the last sweeps, and its mean is found by the next ones.
With constant u, the duration would be too long by a part of the order of the interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.native import _core

__all__ = ["Blocked", "SpeedProfile", "SpeedRows", "estimate_slopes", "fastest_profile"]

MAX_TIME_STEPS = 20  # of Newton's method for the duration of an interval


class SpeedRows(Immutable, frozen=True):
    """Limits alpha u + beta b <= gamma and b <= largest at the points of a grid.

    Attributes
    ----------
    alpha, beta, gamma : (points, rows) arrays
    largest : (points,) array
        Of b; finite.
    """

    alpha: Array
    beta: Array
    gamma: Array
    largest: Array


@dataclass(frozen=True)
class Blocked:
    """Where no speed fulfils the limits: the number of the interval, and the row that limits it most."""

    interval: int
    row: int


class SpeedProfile:
    """The motion s(t) with s_ddot linear in s in each interval of a grid.

    Parameters
    ----------
    s : (points,) array
        Increasing.
    b : (points,) array
        s_dot^2, positive inside.
    slopes : (points - 1,) array
        Of s_ddot by s.

    Attributes
    ----------
    t : (points,) array
        Times at which the points are passed, s.
    """

    def __init__(self, s: Array, b: Array, slopes: Array) -> None:
        self.s, self.b, self.slopes = s, b, slopes
        step = np.diff(s)
        self._speed = np.sqrt(b)
        self._u = np.diff(b) / (2 * step) - slopes * step / 2  # at the start of each interval
        tau, slower = 2 * step / (self._speed[1:] + self._speed[:-1]), self._speed[1:] < self._speed[:-1]
        # Each interval is passed from its slower end on, from which Newton's method converges.
        v = np.where(slower, self._speed[1:], self._speed[:-1])
        u = np.where(slower, -self._u - slopes * step, self._u)
        for _ in range(MAX_TIME_STEPS):
            way, speed = _advance(v, u, slopes, tau)
            correction = (way - step) / speed
            tau = np.clip(tau - correction, tau / 2, 2 * tau)
            if np.all(np.abs(correction) <= 1e-15 * tau):
                break
        self.t = np.concatenate([[0.0], np.cumsum(tau)])

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return s, s_dot and s_ddot at times t (m,)."""
        at = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        way, speed = _advance(self._speed[at], self._u[at], self.slopes[at], t - self.t[at])
        return self.s[at] + way, speed, self._u[at] + self.slopes[at] * way


def _advance(v: Array, u: Array, slope: Array, tau: Array) -> tuple[Array, Array]:
    """Return the way with s_ddot = u + slope s from s = 0 and s_dot = v on in times tau, and the speed then."""
    w = np.sqrt(slope.astype(complex)) * tau
    way = v * tau * _sinhc(w) + u * tau**2 / 2 * _sinhc(w / 2) ** 2
    return way, np.maximum(v * np.cosh(w).real + u * tau * _sinhc(w), 1e-300)


def _sinhc(w: Array) -> Array:
    """Return sinh(w) / w of real or imaginary w, 1 at 0."""
    small = np.abs(w) < 1e-4
    safe = np.where(small, 1.0, w)
    return np.where(small, 1 + (w**2).real / 6, (np.sinh(safe) / safe).real)


def estimate_slopes(s: Array, b: Array) -> Array:
    """Return the slopes of s_ddot by s in the intervals of a grid, 0 where s_ddot jumps."""
    step = np.diff(s)
    u, middle = np.diff(b) / (2 * step), (s[1:] + s[:-1]) / 2
    change = np.diff(u) / np.diff(middle)
    before, after = change[:-1], change[1:]
    inside = np.where(before * after > 0, np.where(np.abs(before) < np.abs(after), before, after), 0.0)
    slopes = np.concatenate([inside[:1], inside, inside[-1:]])
    largest = np.abs(u) / step  # so that s_ddot keeps its sign in each interval
    return np.clip(slopes, -largest, largest)


def fastest_profile(
    s: Array, rows: SpeedRows, start: float, end: float, slopes: Array | float = 0.0
) -> Array | Blocked:
    """Return the largest b at the points of a grid s, from b = start to b = end.

    Parameters
    ----------
    s : (points,) array
        Increasing.
    rows : SpeedRows
    start, end : float
        b at both ends.
    slopes : (points - 1,) array, optional
        Of u by s in the intervals; default: u is constant.
    """
    A, B, C = _rows_by_ends(s, rows, slopes)
    b, interval, y = _core.fastest_profile(A, B, C, largest=rows.largest, start=start, end=end)
    return Blocked(interval, _tightest(A[interval], B[interval], C[interval], y)) if b is None else b


def _rows_by_ends(s: Array, rows: SpeedRows, slopes: Array | float) -> tuple[Array, Array, Array]:
    """Return the limits of each interval as rows A y + B b <= C of b at its start and y at its end."""
    step = 2 * np.diff(s)[:, None]
    off = (slopes * np.diff(s) / 2)[:, None]  # of u at the ends from its mean
    at_start = rows.alpha[:-1] / step, rows.beta[:-1] - rows.alpha[:-1] / step, rows.gamma[:-1] + rows.alpha[:-1] * off
    at_end = rows.beta[1:] + rows.alpha[1:] / step, -rows.alpha[1:] / step, rows.gamma[1:] - rows.alpha[1:] * off
    A, B, C = (np.hstack([x, y]) for x, y in zip(at_start, at_end, strict=True))
    size = np.maximum(np.abs(A).max(axis=1, initial=1e-300, keepdims=True) * 1e-14, 1e-300)
    return np.where(np.abs(A) > size, A, 0.0), np.where(np.abs(B) > size, B, 0.0), C


def _tightest(A: Array, B: Array, C: Array, y: float) -> int:
    """Return the row that is violated most at b = 0 and y."""
    return int(np.argmax((A * y - C) / np.maximum(np.abs(C), 1e-300)))
