"""The logarithm of a rotation differentiated: u_dot = Jlog(u) omega, omega in body axes, and Jlog once more.

Jlog(u) = 1 + [u]/2 + c [u]^2 is the inverse right Jacobian of SO(3), c = 1/theta^2 - cot(theta/2) / (2 theta) and
theta = |u|.
"""

from __future__ import annotations

import math

import numpy as np

from ckc_pin.base.arrays import Array

__all__ = ["log_jacobian", "log_jacobian_dot", "skew"]

# c = sum of |B_2k| / (2k)! theta^(2k - 2); beyond these terms nothing is left where theta < 1
_BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798, 174611 / 330,
              854513 / 138, 236364091 / 2730, 8553103 / 6)  # fmt: skip
_SERIES = [np.array([b / math.factorial(2 * k) for k, b in enumerate(_BERNOULLI, 1)])[::-1]]
_SERIES.append(2 * np.polyder(_SERIES[0]))  # a derivative by theta^2, of which d/dtheta / theta is twice


def skew(a: Array) -> Array:
    """Cross-product matrices of vectors (k, 3)."""
    m = np.zeros((len(a), 3, 3))
    m[:, 0, 1], m[:, 0, 2], m[:, 1, 2] = -a[:, 2], a[:, 1], -a[:, 0]
    return m - np.swapaxes(m, 1, 2)


def _coefficients(u: Array, count: int) -> list[Array]:
    """Return c, or c and c'/theta, (k,) each."""
    square = np.sum(u * u, axis=1)
    if np.all(square < 1.0):
        return [np.polyval(series, square) for series in _SERIES[:count]]
    t = np.where(square < 1.0, 1.0, np.sqrt(square))
    cotangent, sine2 = 1 / np.tan(t / 2), np.sin(t / 2) ** 2
    c = 1 / t**2 - cotangent / (2 * t)
    first = -2 / t**3 + cotangent / (2 * t**2) + 1 / (4 * t * sine2)
    far = (c, first / t)
    each = zip(_SERIES[:count], far, strict=False)
    return [np.where(square < 1.0, np.polyval(series, square), x) for series, x in each]


def log_jacobian(u: Array) -> Array:
    """Jlog, shape (k, 3, 3)."""
    (c,) = _coefficients(u, 1)
    s = skew(u)
    return np.eye(3) + s / 2 + c[:, None, None] * (s @ s)


def log_jacobian_dot(u: Array, u_dot: Array) -> Array:
    """Time derivative of `log_jacobian` along u_dot."""
    c, c_rate = _coefficients(u, 2)
    c_dot = c_rate * np.sum(u * u_dot, axis=1)
    s, s_dot = skew(u), skew(u_dot)
    return s_dot / 2 + c_dot[:, None, None] * (s @ s) + c[:, None, None] * (s_dot @ s + s @ s_dot)
