"""Piecewise polynomials of time: interpolated rows, motions through waypoints, and several of them side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError

__all__ = ["Interpolation", "PiecewisePolynomial", "Profile", "interpolate", "line", "pass_waypoints", "side_by_side"]

Interpolation = Literal["linear", "cubic", "quintic"]
Profile = Literal["quintic", "cubic", "linear", "trapezoidal"]

DEGREES = {"linear": 1, "cubic": 3, "quintic": 5}
HOLD = 1.0  # s, length of the constant pieces before and after waypoints, which are valid beyond it
ROUNDING = (
    1e-12  # relative: a trapezoid may exceed its limits by this, and a shorter phase at constant rate is left out
)
MIN_SPACING = 1e-9  # s, and relative to the time: of waypoints


class PiecewisePolynomial:
    """A vector function of time that consists of polynomials. The first and the last one have no end.

    Parameters
    ----------
    breaks : (m + 1,) array
        Increasing times, s. Piece k begins at ``breaks[k]``.
    coefficients : (degree + 1, m, d) array
        By power of ``t - breaks[k]``, the highest first.
    corners : sequence of float
        Times at which a run begins a new step, because the rate, the acceleration or a low derivative of it jumps, s.
    rate_jumps : sequence of float
        Times at which the rate jumps, s.
    max_frequency : float
        rad/s, see `Desired`.
    end : float
        Time until which the function is defined, s.
    """

    def __init__(
        self,
        breaks: Array,
        coefficients: Array,
        *,
        corners: Sequence[float] | Array = (),
        rate_jumps: Sequence[float] | Array = (),
        max_frequency: float = 0.0,
        end: float = math.inf,
    ) -> None:
        self.breaks, self.coefficients = breaks, coefficients
        self.corners, self.rate_jumps = np.array(corners, dtype=float), np.array(rate_jumps, dtype=float)
        self.max_frequency, self.end = max_frequency, end

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        """Return the value, its rate and its acceleration, each of shape (d,), or (count, d) at many times.

        At a break, they are those of the piece that begins there.
        """
        piece = np.searchsorted(self.breaks[1:-1], t, side="right")
        s = (np.asarray(t) - self.breaks[piece])[..., np.newaxis]
        x = x_dot = x_ddot = np.zeros((*np.shape(t), self.coefficients.shape[2]))
        for c in self.coefficients:  # Horner's scheme with both derivatives
            x_ddot = x_ddot * s + 2 * x_dot
            x_dot = x_dot * s + x
            x = x * s + c[piece]
        return x, x_dot, x_ddot

    @property
    def constant_rate(self) -> Array | None:
        """The rate of a motion that turns or moves at a constant one, shape (d,); None for any other motion."""
        is_line = len(self.coefficients) == 2 and len(self.breaks) == 2
        return self.coefficients[0, 0] if is_line and np.isinf(self.end) else None


def line(start: Array, rate: Array) -> PiecewisePolynomial:
    """Return start + rate t. A rate of an angle, in rad/s, is the frequency of what depends on the angle."""
    coefficients = np.array([rate, start])[:, np.newaxis]
    return PiecewisePolynomial(np.array([0.0, 1.0]), coefficients, max_frequency=float(np.abs(rate).max(initial=0.0)))


# --- rows of a table -----------------------------------------------------------------------------


def interpolate(t: Array, x: Array, interpolation: Interpolation) -> tuple[Array, Array]:
    """Return breaks and coefficients of the polynomials between the rows of a table.

    A spline is not-a-knot at its ends. Fewer rows than its degree + 1 are interpolated by one polynomial.

    Parameters
    ----------
    t : (m,) array
        Increasing times, at least two, s.
    x : (m, d) array
    interpolation : {"linear", "cubic", "quintic"}
    """
    if interpolation == "linear":
        return t, np.array([np.diff(x, axis=0) / np.diff(t)[:, np.newaxis], x[:-1]])
    from scipy.interpolate import make_interp_spline

    return _taylor(make_interp_spline(t, x, k=min(DEGREES[interpolation], len(t) - 1)))


def _taylor(spline: object) -> tuple[Array, Array]:
    """Return breaks and Taylor coefficients of a SciPy spline."""
    breaks = np.unique(spline.t)  # type: ignore[attr-defined]
    powers = range(spline.k, -1, -1)  # type: ignore[attr-defined]
    return breaks, np.array([spline(breaks[:-1], nu=k) / math.factorial(k) for k in powers])  # type: ignore[operator]


# --- waypoints -----------------------------------------------------------------------------------


def pass_waypoints(
    t: Array,
    x: Array,
    profile: Profile,
    max_rate: float | None = None,
    max_acceleration: float | None = None,
    where: str = "waypoints",
) -> PiecewisePolynomial:
    """Return a motion through waypoints. It holds the first one before it, and the last one after it.

    Parameters
    ----------
    t : (m,) array
        Increasing times, at least two, s.
    x : (m, d) array
    profile : {"quintic", "cubic", "linear", "trapezoidal"}
        A spline of this degree with zero rate at both ends, and zero acceleration if it is quintic; straight lines;
        or straight lines with zero rate at each waypoint, which begin with `max_acceleration`, go on at constant rate
        and end with -`max_acceleration`.
    max_rate, max_acceleration : float, optional
        Limits of a trapezoidal profile, 1/s and 1/s².
    where : str
        For messages.

    Raises
    ------
    InputError
        There are fewer than two waypoints, their times do not increase, or a trapezoidal profile exceeds its limits.
    """
    if len(t) < 2:
        raise InputError(f"{where}: got {len(t)}; at least two waypoints are needed")
    for k in np.flatnonzero(~(np.diff(t) > MIN_SPACING * np.maximum(1.0, np.abs(t[1:])))):
        raise InputError(f"{where}[{k + 1}]: t = {t[k + 1]:g} after t = {t[k]:g}; the times must increase")
    with np.errstate(over="ignore", invalid="ignore"):
        if profile == "trapezoidal":
            if max_rate is None or max_acceleration is None:
                raise InputError(f'{where}: profile "trapezoidal" needs max_rate and max_acceleration')
            breaks, inside = _trapezoids(t, x, max_rate, max_acceleration, where)
        elif profile == "linear":
            breaks, inside = interpolate(t, x, "linear")
        else:
            breaks, inside = _spline_at_rest(t, x, profile)
        coefficients = np.zeros((len(inside), len(breaks) + 1, x.shape[1]))
        coefficients[:, 1:-1] = inside
        coefficients[-1, 0], coefficients[-1, -1] = x[0], x[-1]
        jumps = t if profile == "linear" else ()
        motion = PiecewisePolynomial(
            np.concatenate([breaks[:1] - HOLD, breaks, breaks[-1:] + HOLD]),
            coefficients,
            corners=breaks,
            rate_jumps=jumps,
        )
        middles = (breaks[:-1] + breaks[1:]) / 2
        motion.max_frequency = float(np.abs(motion(np.concatenate([breaks, middles]))[1]).max())
    if not np.all(np.isfinite(coefficients)) or not math.isfinite(motion.max_frequency):
        raise InputError(f"{where}: the numbers are too large or too close together in time to be interpolated")
    return motion


def _spline_at_rest(t: Array, x: Array, profile: Literal["quintic", "cubic"]) -> tuple[Array, Array]:
    from scipy.interpolate import make_interp_spline

    zero = np.zeros(x.shape[1])
    rest = [(order, zero) for order in ((1, 2) if profile == "quintic" else (1,))]
    breaks, coefficients = _taylor(make_interp_spline(t, x, k=DEGREES[profile], bc_type=(rest, rest)))
    return breaks, coefficients


def _trapezoids(t: Array, x: Array, max_rate: float, max_acceleration: float, where: str) -> tuple[Array, Array]:
    """Return breaks and coefficients of straight lines that begin and end at rest and take all the time there is."""
    breaks, pieces = [t[0]], []
    for k, (begin, end) in enumerate(pairwise(t.tolist())):
        duration, way = end - begin, x[k + 1] - x[k]
        distance = float(np.linalg.norm(way))
        if distance == 0.0:
            breaks.append(end)
            pieces.append([0 * way, 0 * way, x[k]])
            continue
        turning = duration**2 - 4 * distance / max_acceleration
        rate = (
            2 * distance / (duration + math.sqrt(max(turning, 0.0)))
        )  # distance = rate (duration - rate / acceleration)
        if turning < -ROUNDING * duration**2 or rate > max_rate * (1 + ROUNDING):
            cruises = distance * max_acceleration > max_rate**2
            shortest = (
                distance / max_rate + max_rate / max_acceleration
                if cruises
                else 2 * math.sqrt(distance / max_acceleration)
            )
            raise InputError(
                f"{where}: the distance of {distance:.6g} from t = {begin:g} s to t = {end:g} s takes at least "
                f"{shortest:.6g} s with max_rate = {max_rate:g} and max_acceleration = {max_acceleration:g}; "
                "allow more time or raise the limits"
            )
        ramp = min(rate / max_acceleration, duration / 2)  # s, of each of the two
        along = way / distance
        rise, speed, bend = along * (rate * ramp / 2), along * rate, along * (rate / ramp / 2)
        breaks.append(begin + ramp)
        pieces.append([bend, 0 * way, x[k]])
        if duration - 2 * ramp > ROUNDING * duration:
            breaks.append(end - ramp)
            pieces.append([0 * way, speed, x[k] + rise])
        breaks.append(end)
        pieces.append([-bend, speed, x[k + 1] - rise])
    return np.array(breaks), np.array(pieces).transpose(1, 0, 2)


# --- several motions -----------------------------------------------------------------------------


def side_by_side(motions: Sequence[PiecewisePolynomial]) -> PiecewisePolynomial:
    """Return the components of several functions as one, with the breaks of all of them."""
    breaks = np.unique(np.concatenate([motion.breaks for motion in motions]))
    degree = max(len(motion.coefficients) for motion in motions)
    shifted = [_shift(motion, breaks[:-1], degree) for motion in motions]
    return PiecewisePolynomial(
        breaks,
        np.concatenate(shifted, axis=2),
        corners=np.unique(np.concatenate([motion.corners for motion in motions])),
        rate_jumps=np.unique(np.concatenate([motion.rate_jumps for motion in motions])),
        max_frequency=max(motion.max_frequency for motion in motions),
        end=min(motion.end for motion in motions),
    )


def _shift(motion: PiecewisePolynomial, breaks: Array, count: int) -> Array:
    """Return `count` coefficients of the pieces that begin at other breaks, by repeated synthetic division."""
    piece = np.searchsorted(motion.breaks[1:-1], breaks, side="right")
    by = (breaks - motion.breaks[piece])[:, np.newaxis]
    c = motion.coefficients[:, piece]  # a copy
    for k in range(len(c) - 1, 0, -1):
        for j in range(1, k + 1):
            c[j] += by * c[j - 1]
    return np.concatenate([np.zeros((count - len(c), *c.shape[1:])), c])
