"""Equations of motion of the five-bar, derived by hand in the links' absolute angles, as the suite's reference.

This module does not use the package's terms. a = (theta_1, theta_1 + theta_2, theta_3, theta_3 + theta_4) are the
angles of the links from +x, r their rates. A chain of links 1, 2 with pins at its ends has

    (I1 + m1 c1^2 + m2 l1^2) a1'' + B cos(a2 - a1) a2'' - B sin(a2 - a1) r2^2 + g (m1 c1 + m2 l1) cos a1 = f1
    (I2 + m2 c2^2) a2'' + B cos(a2 - a1) a1'' + B sin(a2 - a1) r1^2 + g m2 c2 cos a2 = f2,       B = m2 l1 c2

and the loop closes if the sum of s_i l_i (cos a_i, sin a_i) is (base, 0), s = (1, 1, -1, -1). Scalars instead of arrays
keep a right-hand side at a few microseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin, sqrt

from scripts.experiments.stability.planar import Planar

__all__ = ["Control", "Reduced", "free_motion", "set_point", "to_absolute", "tracking"]

Numbers = Sequence[float]
Pair = tuple[float, float]
SIGN = (1.0, 1.0, -1.0, -1.0)
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def to_absolute(theta: Numbers) -> list[float]:
    """Convert joint angles or rates to the links' absolute angles or rates."""
    return [theta[0], theta[0] + theta[1], theta[2], theta[2] + theta[3]]


@dataclass(frozen=True)
class Tree:
    """Mass matrix of the two chains (two blocks) and forces on a at a state: M a'' = f + J^T lambda."""

    m11: float
    m12: float
    m22: float
    m33: float
    m34: float
    m44: float
    f: tuple[float, float, float, float]

    def momentum(self, r: Numbers) -> list[float]:
        """Return M r."""
        return [
            self.m11 * r[0] + self.m12 * r[1],
            self.m12 * r[0] + self.m22 * r[1],
            self.m33 * r[2] + self.m34 * r[3],
            self.m34 * r[2] + self.m44 * r[3],
        ]


def _cross(x: Pair, y: Pair) -> float:
    return x[0] * y[1] - x[1] * y[0]


def _dot(x: Numbers, y: Numbers) -> float:
    return sum(a * b for a, b in zip(x, y, strict=True))


def _solve(D: tuple[float, float, float], f: Numbers) -> Pair:
    """Solve with the symmetric [[D11, D12], [D12, D22]]."""
    det = D[0] * D[2] - D[1] * D[1]
    return (D[2] * f[0] - D[1] * f[1]) / det, (D[0] * f[1] - D[1] * f[0]) / det


def tree(p: Planar, a: Numbers, r: Numbers, rates: bool = True) -> Tree:
    """Evaluate the equations above; without `rates` all velocities are zero."""
    blocks, f = [], []
    for i, j in ((0, 1), (2, 3)):
        bend = a[j] - a[i]
        B = p.m[j] * p.l[i] * p.c[j]
        coupling = B * sin(bend) if rates else 0.0
        blocks += [
            p.I[i] + p.m[i] * p.c[i] ** 2 + p.m[j] * p.l[i] ** 2,
            B * cos(bend),
            p.I[j] + p.m[j] * p.c[j] ** 2,
        ]
        f += [
            coupling * r[j] ** 2 - p.g * (p.m[i] * p.c[i] + p.m[j] * p.l[i]) * cos(a[i]),
            -coupling * r[i] ** 2 - p.g * p.m[j] * p.c[j] * cos(a[j]),
        ]
    if p.joint is not None:
        f[0] -= p.joint.stiffness * (a[0] - p.joint.rest) + p.joint.damping * r[0]
    if p.line is not None:
        _pull(p, a, r, f)
    m11, m12, m22, m33, m34, m44 = blocks
    return Tree(m11, m12, m22, m33, m34, m44, (f[0], f[1], f[2], f[3]))


def _pull(p: Planar, a: Numbers, r: Numbers, f: list[float]) -> None:
    """Add the line spring's force on the left tip."""
    s = p.line
    if s is None:
        return
    x = p.l[0] * cos(a[0]) + p.l[1] * cos(a[1]) - s.x
    y = p.l[0] * sin(a[0]) + p.l[1] * sin(a[1]) - s.y
    vx = -p.l[0] * sin(a[0]) * r[0] - p.l[1] * sin(a[1]) * r[1]
    vy = p.l[0] * cos(a[0]) * r[0] + p.l[1] * cos(a[1]) * r[1]
    length = hypot(x, y)
    pull = (s.stiffness * (length - s.rest) + s.damping * (x * vx + y * vy) / length) / length
    for k in (0, 1):
        f[k] -= pull * p.l[k] * (y * cos(a[k]) - x * sin(a[k]))


def miss(p: Planar, a: Numbers) -> Pair:
    """Return the left tip minus the right tip, m."""
    x = sum(s * l * cos(k) for s, l, k in zip(SIGN, p.l, a, strict=True)) - p.base
    return x, sum(s * l * sin(k) for s, l, k in zip(SIGN, p.l, a, strict=True))


def columns(p: Planar, a: Numbers) -> list[Pair]:
    """Return the columns of the closure's Jacobian."""
    return [(-s * l * sin(k), s * l * cos(k)) for s, l, k in zip(SIGN, p.l, a, strict=True)]


def _bend(p: Planar, a: Numbers, r: Numbers) -> Pair:
    """Return -J_dot r."""
    turning = [s * l * k * k for s, l, k in zip(SIGN, p.l, r, strict=True)]
    return (
        sum(x * cos(k) for x, k in zip(turning, a, strict=True)),
        sum(x * sin(k) for x, k in zip(turning, a, strict=True)),
    )


def free_motion(p: Planar) -> Callable[[float, Numbers], list[float]]:
    """Return the function y' of y = (a, r) for the free motion of the closed loop.

    Admissible rates form a plane. Its coordinates are the two rates whose complement has the best determinant, so that
    singularities of the chart (theta_1, theta_3) have no influence. Multipliers are not used: they would cancel if
    masses differ much.
    """

    def rate(t: float, y: Numbers) -> list[float]:
        a, r = [float(x) for x in y[:4]], [float(x) for x in y[4:]]
        T = tree(p, a, r)
        J = columns(p, a)
        i, j = max(PAIRS, key=lambda pair: abs(_cross(J[pair[0]], J[pair[1]])))
        det = _cross(J[i], J[j])

        def close(x: float, y: float) -> list[float]:
            """Return the rates of links i and j with J r = -(x, y)."""
            r = [0.0] * 4
            r[i], r[j] = -(J[j][1] * x - J[j][0] * y) / det, -(J[i][0] * y - J[i][1] * x) / det
            return r

        plane = []
        for k in range(4):
            if k not in (i, j):
                plane.append(close(*J[k]))
                plane[-1][k] = 1.0
        turned = close(*(-x for x in _bend(p, a, r)))
        forced = [x - y for x, y in zip(T.f, T.momentum(turned), strict=True)]
        one, two = plane
        heavy = T.momentum(one), T.momentum(two)
        D = (_dot(one, heavy[0]), _dot(one, heavy[1]), _dot(two, heavy[1]))
        x, z = _solve(D, (_dot(one, forced), _dot(two, forced)))
        return [*r, *(k + x * b + z * c for k, b, c in zip(turned, one, two, strict=True))]

    return rate


class Reduced:
    """Terms of eq. 6 at q = (a1, a3) on the level set phi = w, with the distal links from the intersection of circles.

    Attributes
    ----------
    a, r : list of 4 floats
        r is rho q_dot.
    D : (D11, D12, D22)
    """

    def __init__(self, p: Planar, q: Numbers, q_dot: Numbers, w: Numbers = (0.0, 0.0), branch: float = 1.0) -> None:
        self.p = p
        left = (p.l[0] * cos(q[0]) - w[0], p.l[0] * sin(q[0]) - w[1])
        right = (p.base + p.l[2] * cos(q[1]), p.l[2] * sin(q[1]))
        dx, dy = right[0] - left[0], right[1] - left[1]
        d2 = dx * dx + dy * dy
        times_rho = (d2 + p.l[1] ** 2 - p.l[3] ** 2) / (2 * d2)
        across = branch * sqrt(p.l[1] ** 2 / d2 - times_rho**2)
        x, y = left[0] + times_rho * dx + across * dy, left[1] + times_rho * dy - across * dx
        self.a = [q[0], atan2(y - left[1], x - left[0]), q[1], atan2(y - right[1], x - right[0])]
        self.J = columns(p, self.a)
        self.det = _cross(self.J[1], self.J[3])
        self.rho_1 = self._z(-self.J[0][0], -self.J[0][1])  # columns of rho: rates of a2 and a4 by that of theta_1
        self.rho_3 = self._z(-self.J[2][0], -self.J[2][1])
        self.r = self.times_rho(q_dot)
        self.tree = tree(p, self.a, self.r)
        one, three = self.times_rho((1.0, 0.0)), self.times_rho((0.0, 1.0))
        heavy = self.tree.momentum(one), self.tree.momentum(three)
        self.D = (_dot(one, heavy[0]), _dot(one, heavy[1]), _dot(three, heavy[1]))

    def _z(self, x: float, y: float) -> Pair:
        j2, j4 = self.J[1], self.J[3]
        return (j4[1] * x - j4[0] * y) / self.det, (j2[0] * y - j2[1] * x) / self.det

    def times_rho(self, v: Numbers) -> list[float]:
        """Return rho v."""
        return [
            v[0],
            self.rho_1[0] * v[0] + self.rho_3[0] * v[1],
            v[1],
            self.rho_1[1] * v[0] + self.rho_3[1] * v[1],
        ]

    def project(self, f: Numbers) -> Pair:
        """Return rho^T f."""
        return (
            f[0] + self.rho_1[0] * f[1] + self.rho_1[1] * f[3],
            f[2] + self.rho_3[0] * f[1] + self.rho_3[1] * f[3],
        )

    def solve(self, f: Numbers) -> Pair:
        """Return D^-1 f."""
        return _solve(self.D, f)

    def bias(self) -> Pair:
        """Return C q_dot + h, with dampers and springs."""
        z = self._z(*_bend(self.p, self.a, self.r))  # rho_dot q_dot
        f = self.tree.momentum([0.0, z[0], 0.0, z[1]])
        return self.project([x - y for x, y in zip(f, self.tree.f, strict=True)])

    def h(self) -> Pair:
        """Return h alone."""
        return self.project([-x for x in tree(self.p, self.a, (0.0,) * 4, rates=False).f])

    def C(self, v: Numbers) -> Pair:
        """Return C v, C from Christoffel symbols at the velocity rho q_dot."""
        s = self.times_rho(v)
        turning = [-k * l * x * y for k, l, x, y in zip(SIGN, self.p.l, self.r, s, strict=True)]
        z = self._z(
            -sum(x * cos(k) for x, k in zip(turning, self.a, strict=True)),
            -sum(x * sin(k) for x, k in zip(turning, self.a, strict=True)),
        )
        f = self.tree.momentum([0.0, z[0], 0.0, z[1]])
        for i, j in ((0, 1), (2, 3)):
            b = self.p.m[j] * self.p.l[i] * self.p.c[j] * sin(self.a[j] - self.a[i])
            f[i] -= b * self.r[j] * s[j]
            f[j] += b * self.r[i] * s[i]
        return self.project(f)


Control = Callable[[float, Reduced, Numbers, Numbers], Pair]  # q'' at (t, terms, q, q_dot)


def uncontrolled(t: float, now: Reduced, q: Numbers, q_dot: Numbers) -> Pair:
    """Return q'' of eq. 6 with u = 0."""
    b = now.bias()
    return now.solve((-b[0], -b[1]))


def set_point(p: Planar, q_d: Pair, K_P: float, K_V: float) -> Control:
    """Return q'' under eq. 14 with scalar gains."""
    h_d = Reduced(p, q_d, (0.0, 0.0)).h()

    def q_ddot(t: float, now: Reduced, q: Numbers, q_dot: Numbers) -> Pair:
        b = now.bias()
        f = [-K_P * (q[k] - q_d[k]) - K_V * q_dot[k] + h_d[k] - b[k] for k in (0, 1)]
        return now.solve(f)

    return q_ddot


def tracking(Lambda: float, K_D: float) -> Control:
    """Return q'' under eq. 16 on eq. 21: with s = e_dot + Lambda e, D (q'' - a) + C s + K_D s = 0."""

    def q_ddot(t: float, now: Reduced, q: Numbers, q_dot: Numbers) -> Pair:
        q_d, q_d_dot, q_d_ddot = eq_21(t)
        e = [q[k] - q_d[k] for k in (0, 1)]
        e_dot = [q_dot[k] - q_d_dot[k] for k in (0, 1)]
        s = [e_dot[k] + Lambda * e[k] for k in (0, 1)]
        Cs = now.C(s)
        x = now.solve((Cs[0] + K_D * s[0], Cs[1] + K_D * s[1]))
        return q_d_ddot[0] - Lambda * e_dot[0] - x[0], q_d_ddot[1] - Lambda * e_dot[1] - x[1]

    return q_ddot


def eq_21(t: float) -> tuple[Pair, Pair, Pair]:
    """Return q_d of eq. 21 and its first two derivatives."""
    a, b = pi / 3, pi / 4
    return (a * sin(t), b * (1 - cos(t))), (a * cos(t), b * sin(t)), (-a * sin(t), b * cos(t))
