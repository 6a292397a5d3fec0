"""Elimination written out: L diag L^T of a symmetric matrix without pivoting, as expressions.

Pivots are returned, so that who evaluates the code sees where it would have needed to pivot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = ["SymmetricFactor"]


class SymmetricFactor:
    """A = L diag(pivots) L^T, eliminated from the last coordinate to the first: a tree's inertia has no fill so.

    Parameters
    ----------
    A : casadi.SX
        Symmetric and definite, with structural zeros.

    Attributes
    ----------
    diagonal, pivots : list of casadi.SX
        By coordinate: A's own, and what elimination has left of it. Digits are lost as their ratio goes to 0, whatever
        the units.
    inverses : list of casadi.SX
        Of the pivots: a division costs as much as ten products.
    """

    def __init__(self, A: Any) -> None:
        import casadi as cs

        n = A.shape[0]
        self.n = n
        rows: list[dict[int, Any]] = [{} for _ in range(n)]
        for i in range(n):
            for j in range(i + 1):
                if A.sparsity().has_nz(i, j):
                    rows[i][j] = A[i, j]
        self.pivots: list[Any] = [cs.SX(1, 1)] * n
        self.inverses: list[Any] = [cs.SX(1, 1)] * n
        self.diagonal = [A[k, k] for k in range(n)]
        self._l: list[dict[int, Any]] = [{} for _ in range(n)]  # L^T's rows: l[k][i] multiplies x_i, i < k
        for k in range(n - 1, -1, -1):
            self.pivots[k] = rows[k][k]
            self.inverses[k] = 1 / rows[k][k]
            for i in [i for i in rows[k] if i < k]:
                self._l[k][i] = rows[k][i] * self.inverses[k]
            for i, factor in self._l[k].items():
                for j in [j for j in rows[k] if j <= i]:
                    rows[i][j] = rows[i].get(j, cs.SX(1, 1)) - factor * rows[k][j]

    def half(self, b: Sequence[Any]) -> list[Any]:
        """Solve L x = b, by entries; zeros stay structural."""
        x = list(b)
        for k in range(self.n - 1, -1, -1):
            if x[k].nnz():
                for i, factor in self._l[k].items():
                    x[i] = x[i] - factor * x[k]
        return x

    def other_half(self, b: Sequence[Any]) -> list[Any]:
        """Solve L^T x = b."""
        x = list(b)
        for k in range(self.n):
            for i, factor in self._l[k].items():
                x[k] = x[k] - factor * x[i]
        return x

    def solve(self, b: Sequence[Any]) -> list[Any]:
        """Solve A x = b."""
        return self.other_half([x * inverse for x, inverse in zip(self.half(b), self.inverses, strict=True)])
