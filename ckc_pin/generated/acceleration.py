"""Eq. 1's acceleration as one expression: D' and J D'^-1 J^T eliminated as they are."""

from __future__ import annotations

from typing import Any

from ckc_pin.generated.elimination import SymmetricFactor
from ckc_pin.generated.expressions import Expressions

__all__ = ["acceleration"]


def acceleration(terms: Expressions, u: Any, correction: Any) -> tuple[Any, list[Any]]:
    """Return v'_dot where u' acts, and what is left of the diagonals of D' and J D'^-1 J^T when they are eliminated.

    Parameters
    ----------
    terms : Expressions
    u : casadi.SX of n
        u'.
    correction : casadi.SX of rows
        Added to J_dot v: Baumgarte's terms.
    """
    import casadi as cs

    n, rows, kept = terms.v.numel(), terms.rows, terms.kept
    factor = SymmetricFactor(terms.D_tree)
    force = u - terms.bias_tree + terms.damping
    free = [x / pivot for x, pivot in zip(factor.half([force[k] for k in range(n)]), factor.pivots, strict=True)]
    halves = [factor.half([rows.J[i, k] for k in range(n)]) for i in kept]  # L^-1 J^T, by rows of J
    scaled = [[x / pivot for x, pivot in zip(half, factor.pivots, strict=True)] for half in halves]
    S = cs.SX(len(kept), len(kept))
    for i, a in enumerate(halves):
        for j in range(i + 1):
            common = [a[k] * scaled[j][k] for k in range(n) if a[k].nnz() and scaled[j][k].nnz()]
            if common:
                S[i, j] = S[j, i] = sum(common)
    wanted = [
        -(rows.J_dot_v[i] + correction[i]) - sum(half[k] * free[k] for k in range(n) if half[k].nnz())
        for i, half in zip(kept, halves, strict=True)
    ]
    closing = SymmetricFactor(S)
    multipliers = closing.solve(wanted)
    total = list(free)
    for half, multiplier in zip(scaled, multipliers, strict=True):
        for k in range(n):
            if half[k].nnz():
                total[k] = total[k] + half[k] * multiplier
    return cs.vertcat(*factor.other_half(total)), [*factor.shares, *closing.shares]
