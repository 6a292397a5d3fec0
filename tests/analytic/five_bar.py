"""The five-bar of the paper's appendix in numpy, independent of the package and of Pinocchio.

Equations 23-27 with their errata: the Christoffel matrix of eq. 25 is the one that makes ``D_dot - 2 C``
skew, and the closure of eq. 27 uses the chain numbering of eqs. 24-26 (1, 2 the left chain, 3, 4 the right
one, proximal first). Vectors over the tree are in the order theta_1 ... theta_4; q = (theta_1, theta_3),
z = (theta_2, theta_4), torques in the order of q. Gravity acts along -y. The multipliers enter eq. 1 as
``... = u' + J^T lambda``.

Everything but `FiveBar.sigma` also takes complex angles, so that it can be differentiated by a complex
step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]  # real, or complex for a complex step

Q, Z = [0, 2], [1, 3]  # where q and z stand among the four angles
CHAINS = ((0, 1), (2, 3))  # proximal, distal
E = np.eye(4)[:, Q]  # u' = E u

# Table I: length, pin to centre of mass, mass, moment of inertia about the centre of mass
TABLE_I = np.array(
    [
        [0.2794, 0.1466, 0.2451, 2.770e-3],
        [0.3048, 0.1581, 0.2611, 3.476e-3],
        [0.3048, 0.1467, 0.2611, 3.476e-3],
        [0.2794, 0.1410, 0.2352, 2.607e-3],
    ]
)


@dataclass(frozen=True)
class FiveBar:
    """Lengths l, pin to centre of mass c, masses m, inertias I about the centre of mass, by chain number."""

    l: tuple[float, ...]
    c: tuple[float, ...]
    m: tuple[float, ...]
    I: tuple[float, ...]
    base: float = 0.3048
    g: float = 9.81

    @classmethod
    def from_table(cls, *rows: int) -> FiveBar:
        """The five-bar whose links 1 ... 4 of eqs. 24-26 are these rows of Table I, counted from 1."""
        l, c, m, I = TABLE_I[np.array(rows) - 1].T.tolist()
        return cls(tuple(l), tuple(c), tuple(m), tuple(I))

    def heavier(self, mass: float, inertia: float) -> FiveBar:
        """The same with its masses and its inertias about the centres of mass multiplied by these factors."""
        return replace(self, m=tuple(mass * x for x in self.m), I=tuple(inertia * x for x in self.I))

    # The tree, eqs. 23-26

    def D_tree(self, q_tree: Array) -> Array:
        """D' of eq. 24, (4, 4)."""
        l, c, m, I = self.l, self.c, self.m, self.I
        D = np.zeros((4, 4), dtype=np.asarray(q_tree).dtype)
        for i, j in CHAINS:
            distal_inertia = I[j] + m[j] * c[j] ** 2
            coupling = m[j] * l[i] * c[j] * np.cos(q_tree[j])
            D[i, i] = I[i] + m[i] * c[i] ** 2 + m[j] * l[i] ** 2 + distal_inertia + 2 * coupling
            D[i, j] = D[j, i] = distal_inertia + coupling
            D[j, j] = distal_inertia
        return D

    def C_tree(self, q_tree: Array, v_tree: Array) -> Array:
        """C' of Christoffel symbols, (4, 4): eq. 25 with erratum 1."""
        C = np.zeros((4, 4), dtype=np.result_type(q_tree, v_tree))
        for i, j in CHAINS:
            a = -self.m[j] * self.l[i] * self.c[j] * np.sin(q_tree[j])
            C[i, i] = a * v_tree[j]
            C[i, j] = a * (v_tree[i] + v_tree[j])
            C[j, i] = -a * v_tree[i]
        return C

    def h_tree(self, q_tree: Array) -> Array:
        """h' of eq. 26, (4,)."""
        l, c, m, g = self.l, self.c, self.m, self.g
        h = np.zeros(4, dtype=np.asarray(q_tree).dtype)
        for i, j in CHAINS:
            h[j] = m[j] * c[j] * g * np.cos(q_tree[i] + q_tree[j])
            h[i] = (m[i] * c[i] + m[j] * l[i]) * g * np.cos(q_tree[i]) + h[j]
        return h

    def potential_energy(self, q_tree: Array) -> Any:
        """Potential energy, zero with every centre of mass on the base line."""
        l, c, m, g = self.l, self.c, self.m, self.g
        return sum(
            (m[i] * c[i] + m[j] * l[i]) * g * np.sin(q_tree[i]) + m[j] * c[j] * g * np.sin(q_tree[i] + q_tree[j])
            for i, j in CHAINS
        )

    def energy(self, q_tree: Array, v_tree: Array) -> Any:
        """Kinetic and potential energy."""
        return v_tree @ self.D_tree(q_tree) @ v_tree / 2 + self.potential_energy(q_tree)

    # The closure, eq. 27

    def phi(self, q_tree: Array) -> Array:
        """Left tip minus right tip, (2,): eq. 27 with erratum 2."""
        l, (a1, a2, a3, a4) = self.l, _absolute(q_tree)
        return np.array(
            [
                l[0] * np.cos(a1) + l[1] * np.cos(a2) - l[2] * np.cos(a3) - l[3] * np.cos(a4) - self.base,
                l[0] * np.sin(a1) + l[1] * np.sin(a2) - l[2] * np.sin(a3) - l[3] * np.sin(a4),
            ]
        )

    def J(self, q_tree: Array) -> Array:
        """d phi / d q', (2, 4)."""
        a = _absolute(q_tree)
        return _columns(self.l * np.array([-np.sin(a), np.cos(a)]))

    def J_dot(self, q_tree: Array, v_tree: Array) -> Array:
        """Time derivative of J, (2, 4)."""
        a = _absolute(q_tree)
        return _columns(self.l * _absolute(v_tree) * np.array([-np.cos(a), -np.sin(a)]))

    def phi_q(self, q_tree: Array) -> Array:
        """Columns of J for q, (2, 2)."""
        return self.J(q_tree)[:, Q]

    def phi_z(self, q_tree: Array) -> Array:
        """Columns of J for z, (2, 2)."""
        return self.J(q_tree)[:, Z]

    def s(self, q_tree: Array) -> Any:
        """det phi_z / (l2 l4), the sine of the angle between the distal links: zero where singular."""
        a = _absolute(q_tree)
        return np.sin(a[1] - a[3])

    def sigma(self, q: Array, branch: int = 1) -> Array:
        """q' of eq. 4, (4,), as the intersection of two circles; z within (-pi, pi].

        `branch` is the sign of det phi_z: with 1 the tip is to the right of the line from the left to the
        right elbow, with -1 to the left. Raises ValueError where the circles do not meet.
        """
        l = self.l
        left = l[0] * np.array([np.cos(q[0]), np.sin(q[0])])
        right = l[2] * np.array([np.cos(q[1]), np.sin(q[1])]) + [self.base, 0.0]
        line = right - left
        distance2 = line @ line
        along = (distance2 + l[1] ** 2 - l[3] ** 2) / (2 * distance2)
        across2 = l[1] ** 2 / distance2 - along**2
        if not across2 >= 0:
            raise ValueError(f"out of reach: elbows {np.sqrt(distance2)} apart at q = {q}")
        tip = left + along * line + branch * np.sqrt(across2) * np.array([line[1], -line[0]])
        a2 = np.arctan2(*(tip - left)[::-1])
        a4 = np.arctan2(*(tip - right)[::-1])
        return np.array([q[0], _wrap(a2 - q[0]), q[1], _wrap(a4 - q[1])])

    def rho(self, q_tree: Array) -> Array:
        """d q' / d q of eq. 5, (4, 2)."""
        return _rho(self.J(q_tree))

    def rho_dot(self, q_tree: Array, v_tree: Array) -> Array:
        """Time derivative of rho where the four angles move with v', (4, 2)."""
        J = self.J(q_tree)
        return _rho_dot(J, self.J_dot(q_tree, v_tree), _rho(J))

    # The reduced model, eq. 6, at any q' (on phi = 0 or off it)

    def D(self, q_tree: Array) -> Array:
        """D of eq. 6, (2, 2)."""
        rho = self.rho(q_tree)
        return rho.T @ self.D_tree(q_tree) @ rho

    def C(self, q_tree: Array, v_tree: Array) -> Array:
        """C of eq. 6, (2, 2), for the tree velocity v'."""
        J = self.J(q_tree)
        rho = _rho(J)
        rho_dot = _rho_dot(J, self.J_dot(q_tree, v_tree), rho)
        return rho.T @ (self.D_tree(q_tree) @ rho_dot + self.C_tree(q_tree, v_tree) @ rho)

    def h(self, q_tree: Array) -> Array:
        """h of eq. 6, (2,)."""
        return self.rho(q_tree).T @ self.h_tree(q_tree)

    def force(self, q_tree: Array, q_dot: Array, q_ddot: Array) -> Array:
        """u of eq. 6, (2,), at the tree velocity rho q_dot: D q_ddot + C q_dot + h = rho^T (D' a' + C' v' + h')."""
        J = self.J(q_tree)
        rho = _rho(J)
        v_tree = rho @ q_dot
        a_tree = rho @ q_ddot + _rho_dot(J, self.J_dot(q_tree, v_tree), rho) @ q_dot
        return rho.T @ (self.D_tree(q_tree) @ a_tree + self.C_tree(q_tree, v_tree) @ v_tree + self.h_tree(q_tree))

    def acceleration(self, q_tree: Array, q_dot: Array, u: Array) -> Array:
        """Second derivative of q by eq. 6, (2,), with the tree velocity rho q_dot."""
        return np.linalg.solve(self.D(q_tree), u - self.force(q_tree, q_dot, np.zeros(2)))

    def acceleration_and_multipliers(self, q_tree: Array, v_tree: Array, u: Array) -> tuple[Array, Array]:
        """Second derivative of q', (4,), and lambda, (2,), of eq. 1 with the closure differentiated twice."""
        J = self.J(q_tree)
        force = E @ u - self.C_tree(q_tree, v_tree) @ v_tree - self.h_tree(q_tree)
        matrix = np.block([[self.D_tree(q_tree), -J.T], [J, np.zeros((2, 2))]])
        solution = np.linalg.solve(matrix, np.concatenate([force, -self.J_dot(q_tree, v_tree) @ v_tree]))
        return solution[:4], solution[4:]

    def equilibrium(self) -> Array:
        """The hanging equilibrium, (4,): Newton with a complex-step Jacobian on h' = J^T lambda, phi = 0."""

        def residual(x: Array) -> Array:
            return np.concatenate([self.h_tree(x[:4]) - self.J(x[:4]).T @ x[4:], self.phi(x[:4])])

        x = np.array([-1.4, 0.2, -1.7, -0.2, 0.0, 0.0])
        for _ in range(20):
            x = x - np.linalg.solve(complex_step(residual, x), residual(x))
        if not np.abs(residual(x)).max() < 1e-14:
            raise AssertionError("the Newton iteration for the equilibrium did not converge")
        return x[:4]


FIVE_BAR = FiveBar.from_table(1, 2, 4, 3)  # Table I numbered around the loop: erratum 3, the default
AS_PRINTED = FiveBar.from_table(1, 2, 3, 4)  # Table I numbered along the chains

Controller = Callable[[float, Array, Array], Array]  # u of t, q', q_dot


def set_point(model: FiveBar, q_d: Array, K_P: float = 10.0, K_V: float = 1.0) -> Controller:
    """Eq. 14 with the error q - q_d; `model` is what the controller believes the plant to be."""
    h_d = model.h(model.sigma(q_d))
    return lambda t, q_tree, q_dot: -K_P * (q_tree[Q] - q_d) - K_V * q_dot + h_d


def tracking(model: FiveBar, Lambda: float = 1.0, K_D: float = 10.0) -> Controller:
    """Eq. 16 on eq. 21, its D, C, h those of `model` at the measured angles, its tree velocity rho q_dot."""

    def u(t: float, q_tree: Array, q_dot: Array) -> Array:
        q_d, q_d_dot, q_d_ddot = desired(t)
        error, error_dot = q_tree[Q] - q_d, q_dot - q_d_dot
        v, a, r = q_d_dot - Lambda * error, q_d_ddot - Lambda * error_dot, error_dot + Lambda * error
        C = model.C(q_tree, model.rho(q_tree) @ q_dot)
        return model.D(q_tree) @ a + C @ v + model.h(q_tree) - K_D * r

    return u


def no_control(t: float, q_tree: Array, q_dot: Array) -> Array:
    """u = 0."""
    return np.zeros(2)


def desired(t: float) -> tuple[Array, Array, Array]:
    """q_d of eq. 21 and its first two derivatives, each (2,)."""
    a, b, sin, cos = np.pi / 3, np.pi / 4, np.sin(t), np.cos(t)
    return np.array([a * sin, b * (1 - cos)]), np.array([a * cos, b * sin]), np.array([-a * sin, b * cos])


def complex_step(f: Callable[[Array], Array], x: Array) -> Array:
    """Jacobian of f at x, exact to rounding."""
    return np.array([f(x + 1e-200j * e).imag / 1e-200 for e in np.eye(len(x))]).T


def _absolute(angles: Array) -> Array:
    """Angles of the four links from +x, or their rates from the joint rates."""
    a1, a2, a3, a4 = angles
    return np.array([a1, a1 + a2, a3, a3 + a4])


def _columns(b: Array) -> Array:
    """J from what a unit rate of each link's absolute angle does to the end of that link, (2, 4)."""
    return np.array([b[:, 0] + b[:, 1], b[:, 1], -b[:, 2] - b[:, 3], -b[:, 3]]).T


def _rho(J: Array) -> Array:
    """Rho of eq. 5 from J, (4, 2)."""
    rho = E.astype(J.dtype)
    rho[Z] = -np.linalg.solve(J[:, Z], J[:, Q])
    return rho


def _rho_dot(J: Array, J_dot: Array, rho: Array) -> Array:
    """Time derivative of rho, (4, 2)."""
    rho_dot = np.zeros((4, 2), dtype=np.result_type(J, J_dot))
    rho_dot[Z] = -np.linalg.solve(J[:, Z], J_dot @ rho)
    return rho_dot


def _wrap(angle: Any) -> Any:
    return np.pi - (np.pi - angle) % (2 * np.pi)
