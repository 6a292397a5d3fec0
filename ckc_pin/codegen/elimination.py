"""Elimination written out: L diag L^T of a symmetric matrix without pivoting, as expressions.

What is eliminated makes a tree: an unknown's parent is the first of those that it is still coupled with. What each
leaves to others goes up the tree and is added up on the way, so that branches have nothing to do with each other until
they meet.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["SymmetricFactor"]

Entries = dict[Any, Any]  # expressions by where they are added


class SymmetricFactor:
    """A = L diag L^T, where A = [D, J^T; J, 0] with D positive definite, in an order without zero pivots.

    Whatever the order, pivots of D's coordinates are positive and those of J's rows negative: an earlier one of its own
    kind takes from a diagonal entry, one of the other kind adds to it.

    Parameters
    ----------
    entries : mapping of (int, int) to casadi.SX
        Of A's lower triangle, structural zeros left out.
    n : int
        Coordinates, which come before the rows.
    order : sequence of int
        Of elimination, all of A's unknowns.
    trusted : float
        Digits are lost as the ratio of what is left of a diagonal entry to what was added to it goes to 0, whatever the
        units: where an elimination is still sound.

    Attributes
    ----------
    sound : casadi.SX
        How many pivots are.
    """

    def __init__(self, entries: Mapping[tuple[int, int], Any], n: int, order: Sequence[int], trusted: float) -> None:
        import casadi as cs

        self._order, self._n, self._place = tuple(order), n, {k: at for at, k in enumerate(order)}
        self._inverses: dict[int, Any] = {}  # a division costs as much as ten products
        self._l: dict[int, dict[int, Any]] = {}  # L's columns, without signs
        own: dict[int, Entries] = defaultdict(dict)
        for (i, j), x in entries.items():
            own[min(i, j, key=self._place.__getitem__)][("whole", i) if i == j else ("at", i, j)] = x
        passed: dict[int | None, list[Entries]] = defaultdict(list)
        for k in order:
            left = _together([own[k], *passed[k]])
            whole = left.pop(("whole", k), cs.SX(0))
            pivot = whole - left.pop(("lost", k)) if ("lost", k) in left else whole
            self._inverses[k] = inverse = 1 / pivot
            found = {i + j - k: left.pop((at, i, j)) for at, i, j in [x for x in left if x[0] == "at" and k in x[1:]]}
            column = {i: found[i] for i in sorted(found)}
            self._l[k] = {i: x * inverse for i, x in column.items()}
            _add(left, ("sound",), whole * trusted < pivot)
            for i, factor in self._l[k].items():
                _add(left, ("lost" if (i < n) == (k < n) else "whole", i), factor * column[i])
                for j in column:
                    if j < i:
                        self._take(left, ("at", i, j), k, factor * column[j])
            passed[self._parent(k)].append(left)
        self.sound = _together(passed[None])[("sound",)]

    def _parent(self, k: int) -> int | None:
        """The first of those that k is coupled with when it is eliminated."""
        return min(self._l[k], key=self._place.__getitem__, default=None)

    def _take(self, into: Entries, at: Any, pivot: int, x: Any) -> None:
        """Subtract what the elimination of a coordinate leaves; pivots of rows are negative."""
        if pivot >= self._n:
            _add(into, at, x)
        else:
            into[at] = into[at] - x if at in into else -x

    def solve(self, b: Mapping[int, Any]) -> dict[int, Any]:
        """Return the a of the coordinates and the l of the rows with D a - J^T l = b and J a = b.

        Parameters
        ----------
        b : mapping of int to casadi.SX
            What is missing is zero; so is what is missing in the result.
        """
        y: Entries = {}
        passed: dict[int | None, list[Entries]] = defaultdict(list)
        for k in self._order:
            left = _together([{k: b[k]} if k in b else {}, *passed[k]])
            if k in left:
                y[k] = left.pop(k)
                for i, factor in self._l[k].items():
                    self._take(left, i, k, factor * y[k])
            passed[self._parent(k)].append(left)
        found: dict[int, Any] = {}
        for k in reversed(self._order):
            if k in y:
                found[k] = y[k] * self._inverses[k]
            for i, factor in self._l[k].items():
                if i in found:
                    self._take(found, k, i, factor * found[i])
        return found


def _add(into: Entries, at: Any, x: Any) -> None:
    into[at] = into[at] + x if at in into else x


def _together(parts: Sequence[Entries]) -> Entries:
    """The sum of entries."""
    found: Entries = {}
    for part in parts:
        for at, x in part.items():
            _add(found, at, x)
    return found
