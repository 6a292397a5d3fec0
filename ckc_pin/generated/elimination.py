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
    pivots : list of casadi.SX
        By coordinate.
    shares : list of casadi.SX
        What elimination has left of each diagonal entry, 1 to 0: digits are lost as it goes to 0, whatever the units.
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
        self.shares: list[Any] = [cs.SX(1)] * n
        self._l: list[dict[int, Any]] = [{} for _ in range(n)]  # L^T's rows: l[k][i] multiplies x_i, i < k
        for k in range(n - 1, -1, -1):
            self.pivots[k] = rows[k][k]
            self.shares[k] = rows[k][k] / A[k, k]
            for i in [i for i in rows[k] if i < k]:
                self._l[k][i] = rows[k][i] / self.pivots[k]
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
        return self.other_half([x / pivot for x, pivot in zip(self.half(b), self.pivots, strict=True)])
