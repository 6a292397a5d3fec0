"""Elimination of eq. 1 without pivoting: a fixed elimination order, and L diag L^T as CasADi expressions.

The order is chosen numerically for little fill and for pivots that stay large near the assembled configuration. The
symbolic factorization then follows the elimination tree: the parent of an unknown is the first unknown that it is still
coupled with. Contributions are added up on the way to the root, so that branches of the mechanism stay independent of
each other until they meet.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["SymmetricFactor", "elimination_order", "saddle_point_matrix", "smallest_pivot_ratio"]

SAMPLE_STATES = 16  # beside the assembled configuration
SAMPLE_SPREAD = 0.5  # rad, or times the mechanism's size: distance of the samples from the assembled configuration
MIN_PIVOT_RATIO = 1e-2  # pivot, relative to what it is a difference of and to its value if all rows came last
ZERO_TOLERANCE = 1e-12  # relative to the other entries of the row and column

Entries = dict[Any, Any]  # expressions by the place where they are added


def elimination_order(mechanism: Mechanism, kept: Sequence[int]) -> tuple[int, ...]:
    """Return an elimination order of [D', J^T; J, 0] with little fill and no small pivots.

    Among the unknowns whose pivots are large enough at all sampled states, the one with the fewest neighbours is next.
    A constraint row may come before coordinates that it depends on: one branch is then finished before another begins.
    Coordinates without inertia of their own wait for all of their rows, because each row alone gives them a pivot in
    some configurations only.

    Parameters
    ----------
    mechanism : Mechanism
    kept : sequence of int
        Independent constraint rows.

    Returns
    -------
    tuple of int
        The n coordinates, and the kept rows numbered from n on.
    """
    n = mechanism.n
    A, references = (np.array(x) for x in zip(*_sample_matrices(mechanism, kept), strict=True))
    size = A.shape[1]
    largest = np.abs(A).max(axis=2)
    filled = np.any(np.abs(A) > ZERO_TOLERANCE * np.minimum(largest[:, :, None], largest[:, None, :]), axis=0)
    sign = np.where(np.arange(size) < n, 1.0, -1.0)
    sums = sign * np.diagonal(A, axis1=1, axis2=2)
    massless = np.append((references[:, :n] > 0).all(axis=0), np.zeros(size - n, dtype=bool))
    remaining = [*range(n - 1, -1, -1), *range(n, size)]  # from leaves to roots
    order: list[int] = []
    while remaining:
        pivots = sign * np.diagonal(A, axis1=1, axis2=2)
        ratios = (pivots / np.maximum(np.maximum(sums, references), 1e-300)).min(axis=0)
        ratios[massless & filled[:, [k for k in remaining if k >= n]].any(axis=1)] *= MIN_PIVOT_RATIO / 2
        candidates = [k for k in remaining if ratios[k] >= min(MIN_PIVOT_RATIO, ratios[remaining].max())]
        k = min(candidates, key=lambda k: np.count_nonzero(filled[k, remaining]))
        order.append(k)
        remaining.remove(k)
        column = np.where(np.isin(np.arange(size), remaining), A[:, k], 0.0)
        pivot = np.where(pivots[:, k] == 0.0, np.inf, pivots[:, k])  # a coordinate without inertia in that state
        update = sign[k] * column**2 / pivot[:, None]
        sums = sums + np.where(sign == sign[k], 0.0, np.abs(update))
        A = A - sign[k] * column[:, :, None] * column[:, None, :] / pivot[:, None, None]
        filled |= np.outer(filled[k], filled[k])
    return tuple(order)


def smallest_pivot_ratio(A: Array, n: int, order: Sequence[int]) -> float:
    """Return the smallest ratio of a pivot to the sum that it is left of, for [D', J^T; J, 0] in an elimination order.

    The digits lost by elimination without pivoting are about -log10 of it. Zero: a pivot is not of the right sign.
    """
    A, sign, smallest = A.copy(), np.where(np.arange(len(A)) < n, 1.0, -1.0), np.inf
    sums, remaining = sign * np.diag(A), np.ones(len(A), dtype=bool)
    for k in order:
        pivot, remaining[k] = sign[k] * A[k, k], False
        smallest = min(smallest, pivot / sums[k] if sums[k] > 0 else 0.0)
        if not smallest > 0:
            return 0.0
        column = np.where(remaining, A[:, k], 0.0)
        sums = sums + np.where(sign == sign[k], 0.0, column**2 / pivot)
        A = A - sign[k] * np.outer(column, column) / pivot
    return smallest


def saddle_point_matrix(D: Array, J: Array) -> Array:
    """Return eq. 1's matrix [D', J^T; J, 0]."""
    return np.block([[D, J.T], [J, np.zeros((len(J), len(J)))]])


def _sample_matrices(mechanism: Mechanism, kept: Sequence[int]) -> Iterator[tuple[Array, Array]]:
    """Yield [D', J^T; J, 0] at sampled states, and a reference value for each pivot.

    The reference of a row is its pivot if all rows came last, the diagonal of J D'^-1 J^T. The reference of a
    coordinate without inertia is the inertia that its rows give it.
    """
    tree, random, n = mechanism.tree, np.random.default_rng(0), mechanism.n
    for k in range(SAMPLE_STATES + 1):
        step = SAMPLE_SPREAD * random.uniform(-1, 1, n) * tree.step_scale * (k > 0)
        at = mechanism.kinematics(tree.integrate(mechanism.q_tree, step))
        D = np.triu(Terms(mechanism, at, np.zeros(n)).D_tree)
        D, J = D + np.triu(D, 1).T, at.J[list(kept)]
        mobility = np.sum(J * (np.linalg.pinv(D, hermitian=True) @ J.T).T, axis=1)
        is_mobile = mobility > ZERO_TOLERANCE * mobility.max(initial=0.0)
        inertia_by_rows = np.sum(J**2 / np.where(is_mobile, mobility, np.inf)[:, None], axis=0)
        massless = np.diag(D) <= ZERO_TOLERANCE * inertia_by_rows
        yield saddle_point_matrix(D, J), np.concatenate([np.where(massless, inertia_by_rows, 0.0), mobility])


class SymmetricFactor:
    """Symbolic factorization A = L diag L^T of A = [D, J^T; J, 0], D positive definite, without pivoting.

    In any order, pivots of coordinates are positive and pivots of rows negative. An unknown eliminated earlier reduces
    the diagonal entries of its own kind and adds to those of the other kind.

    Parameters
    ----------
    entries : mapping of (int, int) to casadi.SX
        Of A's lower triangle, structural zeros left out.
    n : int
        Number of coordinates, which come before the rows.
    order : sequence of int
        Elimination order of all unknowns.
    min_pivot_ratio : float
        A pivot is accurate if it is more than this fraction of the sum that it is left of. The ratio does not depend on
        units.

    Attributes
    ----------
    accurate_pivots : casadi.SX
        Number of accurate pivots.
    """

    def __init__(
        self, entries: Mapping[tuple[int, int], Any], n: int, order: Sequence[int], min_pivot_ratio: float
    ) -> None:
        import casadi as cs

        self._order, self._n, self._place = tuple(order), n, {k: place for place, k in enumerate(order)}
        self._inverses: dict[int, Any] = {}  # a division costs as much as ten products
        self._l: dict[int, dict[int, Any]] = {}  # L's columns, without signs
        own_entries: dict[int, Entries] = defaultdict(dict)
        for (i, j), x in entries.items():
            own_entries[min(i, j, key=self._place.__getitem__)][("sum", i) if i == j else ("entry", i, j)] = x
        passed_on: dict[int | None, list[Entries]] = defaultdict(list)
        for k in order:
            rest = _sum([own_entries[k], *passed_on[k]])
            total = rest.pop(("sum", k), cs.SX(0))
            pivot = total - rest.pop(("reduction", k)) if ("reduction", k) in rest else total
            self._inverses[k] = inverse = 1 / pivot
            coupled = [x for x in rest if x[0] == "entry" and k in x[1:]]
            values = {i + j - k: rest.pop((kind, i, j)) for kind, i, j in coupled}
            column = {i: values[i] for i in sorted(values)}
            self._l[k] = {i: x * inverse for i, x in column.items()}
            _add(rest, ("accurate",), total * min_pivot_ratio < pivot)
            for i, factor in self._l[k].items():
                _add(rest, ("reduction" if (i < n) == (k < n) else "sum", i), factor * column[i])
                for j in column:
                    if j < i:
                        self._subtract(rest, ("entry", i, j), k, factor * column[j])
            passed_on[self._parent(k)].append(rest)
        self.accurate_pivots = _sum(passed_on[None])[("accurate",)]

    def _parent(self, k: int) -> int | None:
        """Return the first unknown that k is coupled with when it is eliminated."""
        return min(self._l[k], key=self._place.__getitem__, default=None)

    def _subtract(self, target: Entries, place: Any, pivot: int, x: Any) -> None:
        """Subtract an update of a coordinate's elimination, or add a row's, whose pivot is negative."""
        if pivot >= self._n:
            _add(target, place, x)
        else:
            target[place] = target[place] - x if place in target else -x

    def solve(self, b: Mapping[int, Any]) -> dict[int, Any]:
        """Solve D a - J^T l = b_n and J a = b_rows for the coordinates' a and the rows' multipliers l.

        Parameters
        ----------
        b : mapping of int to casadi.SX
            By unknown. Missing entries are zero, in the result too.
        """
        y: Entries = {}
        passed_on: dict[int | None, list[Entries]] = defaultdict(list)
        for k in self._order:
            rest = _sum([{k: b[k]} if k in b else {}, *passed_on[k]])
            if k in rest:
                y[k] = rest.pop(k)
                for i, factor in self._l[k].items():
                    self._subtract(rest, i, k, factor * y[k])
            passed_on[self._parent(k)].append(rest)
        solution: dict[int, Any] = {}
        for k in reversed(self._order):
            if k in y:
                solution[k] = y[k] * self._inverses[k]
            for i, factor in self._l[k].items():
                if i in solution:
                    self._subtract(solution, k, i, factor * solution[i])
        return solution


def _add(target: Entries, place: Any, x: Any) -> None:
    target[place] = target[place] + x if place in target else x


def _sum(parts: Sequence[Entries]) -> Entries:
    total: Entries = {}
    for part in parts:
        for place, x in part.items():
            _add(total, place, x)
    return total
