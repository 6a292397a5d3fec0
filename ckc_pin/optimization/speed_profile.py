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

__all__ = ["Blocked", "SpeedProfile", "SpeedRows", "estimate_slopes", "fastest_profile", "find_vertex"]

MAX_VERTEX_STEPS = 100
MAX_TIME_STEPS = 20  # of Newton's method for the duration of an interval
TOLERANCE = 1e-11  # relative: of what a limit may be exceeded by because of rounding


@dataclass(frozen=True, eq=False)
class SpeedRows(Immutable):
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
    highest, lowest = _extreme_ends(A, B, C, rows.largest)
    count = len(s) - 1
    low, high = np.zeros(count + 1), np.zeros(count + 1)
    low[count] = high[count] = end
    listed = [list(zip(a, b, c, strict=True)) for a, b, c in zip(A.tolist(), B.tolist(), C.tolist(), strict=True)]
    largest = rows.largest.tolist()
    highest_y, lowest_y = highest.tolist(), lowest.tolist()
    lo, hi = float(end), float(end)
    tolerance = TOLERANCE * float(rows.largest.max())
    for k in range(count - 1, -1, -1):
        up, low_at_top = _b_range(listed[k], largest[k], min(max(highest_y[k], lo), hi))
        high_at_bottom, down = _b_range(listed[k], largest[k], min(max(lowest_y[k], lo), hi))
        if not (up >= low_at_top - tolerance and high_at_bottom >= down - tolerance):
            return Blocked(k, _tightest(A[k], B[k], C[k], min(max(highest_y[k], lo), hi)))
        lo, hi = down, max(up, down)
        low[k], high[k] = lo, hi
    if not lo - tolerance <= start <= hi + tolerance:
        return Blocked(0, _tightest(A[0], B[0], C[0], high[1]))
    b = [start]
    ends = high.tolist()
    for k in range(count):
        here, y = b[-1], ends[k + 1]
        for a, c, limit in listed[k]:
            if a > 0.0:
                y = min(y, (limit - c * here) / a)
        b.append(max(y, low[k + 1], 0.0))
    return np.array(b)


def _rows_by_ends(s: Array, rows: SpeedRows, slopes: Array | float) -> tuple[Array, Array, Array]:
    """Return the limits of each interval as rows A y + B b <= C of b at its start and y at its end."""
    step = 2 * np.diff(s)[:, None]
    off = (slopes * np.diff(s) / 2)[:, None]  # of u at the ends from its mean
    at_start = rows.alpha[:-1] / step, rows.beta[:-1] - rows.alpha[:-1] / step, rows.gamma[:-1] + rows.alpha[:-1] * off
    at_end = rows.beta[1:] + rows.alpha[1:] / step, -rows.alpha[1:] / step, rows.gamma[1:] - rows.alpha[1:] * off
    A, B, C = (np.hstack([x, y]) for x, y in zip(at_start, at_end, strict=True))
    size = np.maximum(np.abs(A).max(axis=1, initial=1e-300, keepdims=True) * 1e-14, 1e-300)
    return np.where(np.abs(A) > size, A, 0.0), np.where(np.abs(B) > size, B, 0.0), C


def _b_range(rows: list[tuple[float, float, float]], largest: float, y: float) -> tuple[float, float]:
    """Return the largest and the smallest b of an interval for a given y; an empty range if there is none."""
    up, down = largest, 0.0
    for a, b, c in rows:
        rest = c - a * y
        if b > 0.0:
            up = min(up, rest / b)
        elif b < 0.0:
            down = max(down, rest / b)
        elif rest < -TOLERANCE * (abs(c) + abs(a * y)):
            return -np.inf, np.inf
    return up, down


def _extreme_ends(A: Array, B: Array, C: Array, largest: Array) -> tuple[Array, Array]:
    """Return the y at which b is largest, and that at which it is smallest, in each interval."""
    one, zero = np.ones((len(A), 1)), np.zeros((len(A), 1))
    A = np.hstack([A, one, -one])
    B = np.hstack([B, zero, zero])
    C = np.hstack([C, largest[1:, None], zero])
    return find_vertex(A, B, C, largest[:-1], 1.0)[1], find_vertex(A, B, C, zero[:, 0], -1.0)[1]


def find_vertex(A: Array, B: Array, C: Array, b: Array, sign: float) -> tuple[Array, Array]:
    """Return the largest (sign = 1) or smallest (sign = -1) b of A y + B b <= C up to a bound, and the y there.

    The width in y of the feasible set is a concave function of b. Newton's method finds its zero from the outside.

    Parameters
    ----------
    A, B, C : (count, rows) arrays
    b : (count,) array
        The bound.
    """
    up, down, flat, at = A > 0, A < 0, A == 0, np.arange(len(A))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope, right = B / A, C / A
        level = sign * np.where(flat & (sign * B > 0), C / B, sign * np.inf)
    b = sign * np.minimum(sign * b, level.min(axis=1, initial=np.inf))
    for _ in range(MAX_VERTEX_STEPS):
        with np.errstate(invalid="ignore", over="ignore"):
            y = right - slope * b[:, None]
        above, below = np.where(up, y, np.inf), np.where(down, y, -np.inf)
        i, j = above.argmin(axis=1), below.argmax(axis=1)
        width, change = above[at, i] - below[at, j], slope[at, j] - slope[at, i]
        outside = (width < 0) & (sign * change < 0)
        if not outside.any():
            break
        b = np.where(outside, b - width / np.where(outside, change, 1.0), b)
    return b, (above[at, i] + below[at, j]) / 2


def _tightest(A: Array, B: Array, C: Array, y: float) -> int:
    """Return the row that is violated most at b = 0 and y."""
    return int(np.argmax((A * y - C) / np.maximum(np.abs(C), 1e-300)))
