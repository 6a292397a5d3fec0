"""The paper's appendix as printed, errors included, for comparison: eqs. 24 to 27 and Table I."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array

__all__ = ["TABLE_I", "Printed"]

# Rows 1 to 4: length, pin to centre of mass (m), mass (kg), moment of inertia (kg m^2)
TABLE_I = (
    (0.2794, 0.1466, 0.2451, 2.770e-3),
    (0.3048, 0.1581, 0.2611, 3.476e-3),
    (0.3048, 0.1467, 0.2611, 3.476e-3),
    (0.2794, 0.1410, 0.2352, 2.607e-3),
)
BASE = 0.3048  # row 0, which eq. 27 calls c
G = 9.81


@dataclass(frozen=True)
class Printed:
    """The appendix with an assignment of Table I's rows to the links 1 to 4.

    Parameters
    ----------
    rows : tuple of int
        (1, 2, 3, 4) as printed, or (1, 2, 4, 3) if Table I is numbered around the loop.
    """

    rows: tuple[int, int, int, int]

    def D_tree(self, q_tree: Array) -> Array:
        """Return D' of eq. 24, shape (4, 4)."""
        l, c, m, I = (self._column(k) for k in range(4))
        D = np.zeros((4, 4))
        for i, j in ((0, 1), (2, 3)):
            D[i, i] = I[i] + I[j] + m[i] * c[i] ** 2
            D[i, i] += m[j] * (l[i] ** 2 + c[j] ** 2 + 2 * l[i] * c[j] * np.cos(q_tree[j]))
            D[i, j] = D[j, i] = I[j] + m[j] * c[j] ** 2 + m[j] * l[i] * c[j] * np.cos(q_tree[j])
            D[j, j] = I[j] + m[j] * c[j] ** 2
        return D

    def C_tree(self, q_tree: Array, v_tree: Array, power: int = 2) -> Array:
        """Return C' of eq. 25, shape (4, 4); the `power` of the rate in c12 and c34 is printed as 2."""
        l, c, m, _ = (self._column(k) for k in range(4))
        C = np.zeros((4, 4))
        for i, j in ((0, 1), (2, 3)):
            a = m[j] * l[i] * c[j] * np.sin(q_tree[j])
            C[i, i] = -2 * a * v_tree[j]
            C[i, j] = -a * v_tree[j] ** power
            C[j, i] = a * v_tree[i]
        return C

    def h_tree(self, q_tree: Array) -> Array:
        """Return h' of eq. 26, shape (4,)."""
        l, c, m, _ = (self._column(k) for k in range(4))
        h = np.zeros(4)
        for i, j in ((0, 1), (2, 3)):
            h[j] = m[j] * c[j] * G * np.cos(q_tree[i] + q_tree[j])
            h[i] = (m[i] * c[i] + m[j] * l[i]) * G * np.cos(q_tree[i]) + h[j]
        return h

    def phi(self, q_tree: Array) -> Array:
        """Return phi of eq. 27, shape (2,): l3 has the sum of angles, l4 only theta_4."""
        l, (one, two, three, four) = self._column(0), q_tree
        angles, lengths = np.array([one, one + two, three + four, four]), l * [1, 1, -1, -1]
        return np.array([lengths @ np.cos(angles) - BASE, lengths @ np.sin(angles)])

    def _column(self, k: int) -> Array:
        return np.array([TABLE_I[row - 1][k] for row in self.rows])
