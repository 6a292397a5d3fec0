"""Eq. 1 as expressions: eliminated without pivoting, the acceleration, and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ckc_pin.codegen.elimination import SymmetricFactor
from ckc_pin.codegen.expressions import Expressions

__all__ = ["ConstrainedInertia"]

TRUSTED = 1e-4  # of a diagonal entry left by elimination without pivoting: four digits are lost then


class ConstrainedInertia:
    """The matrix [D', -J^T; J, 0] of eq. 1, eliminated: what a force and an acceleration of the loops make of the tree.

    Parameters
    ----------
    terms : Expressions
    """

    def __init__(self, terms: Expressions) -> None:
        self._terms, self._n = terms, terms.v.numel()
        D, J = terms.D_tree, terms.rows.J
        entries = {(i, j): D[i, j] for i, j in _filled(D) if j <= i}
        place = {row: self._n + k for k, row in enumerate(terms.kept)}
        entries |= {(place[i], j): J[i, j] for i, j in _filled(J) if i in place}
        self._factor = SymmetricFactor(entries, self._n, terms.order, TRUSTED)

    def solve(self, force: Sequence[Any], along: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Return a and the kept rows' multipliers: D' a = force + J^T multipliers, J a = along.

        Parameters
        ----------
        force : sequence of n casadi.SX
        along : sequence of casadi.SX, one a kept row
        """
        import casadi as cs

        given = {k: x for k, x in enumerate([*force, *along]) if x.nnz()}
        found = self._factor.solve(given)
        whole = [found.get(k, cs.SX(1, 1)) for k in range(self._n + len(along))]
        return whole[: self._n], whole[self._n :]

    def acceleration(self, u: Any, correction: Any) -> tuple[Any, Any]:
        """Return v'_dot where u' acts, and the kept rows' multipliers.

        Parameters
        ----------
        u : casadi.SX of n
            u'.
        correction : casadi.SX of rows
            Added to J_dot v: Baumgarte's terms.
        """
        import casadi as cs

        terms = self._terms
        force = u - terms.bias_tree + terms.damping
        along = [-(terms.rows.J_dot_v[i] + correction[i]) for i in terms.kept]
        a, multipliers = self.solve([force[k] for k in range(self._n)], along)
        return cs.vertcat(*a), cs.vertcat(*multipliers)

    def closing_step(self, residual: Any) -> Any:
        """Return the x with J x = -residual that is smallest in the metric of D'.

        Parameters
        ----------
        residual : casadi.SX of rows
        """
        import casadi as cs

        step, _ = self.solve([cs.SX(1, 1)] * self._n, [-residual[i] for i in self._terms.kept])
        return cs.vertcat(*step)

    def derivatives(self, u: Any) -> tuple[Any, Any]:
        """Return derivatives of (q'_dot, v'_dot) by (q', v'), square of nq + n, and of v'_dot by u', (n, n).

        Eq. 1 differentiated where its solution is known: one more elimination a column instead of a derivative through
        each. A free root's quaternion counts by its part across itself: its length is one.

        Parameters
        ----------
        u : casadi.SX of n
            u'; nothing is corrected.
        """
        import casadi as cs

        terms, n = self._terms, self._n
        kept = list(terms.kept)
        left, unknown = self._left()
        by_state = cs.horzcat(terms.angles.jacobian(left), cs.jacobian(left, terms.v))
        by_state = cs.substitute(by_state, unknown, self._solution(u))
        columns = [
            self.solve([-by_state[i, j] for i in range(n)], [-by_state[n + i, j] for i in range(len(kept))])[0]
            for j in range(by_state.shape[1])
        ]
        zero = cs.SX(1, 1)
        by_u = [self.solve([cs.SX(1) if i == j else zero for i in range(n)], [zero] * len(kept))[0] for j in range(n)]
        rates = cs.jacobian(terms.q_dot, cs.vertcat(terms.angles.q, terms.v))
        found = cs.vertcat(rates, cs.horzcat(*(cs.vertcat(*x) for x in columns)))
        return _across(found, terms), cs.horzcat(*(cs.vertcat(*x) for x in by_u))

    def change(self, u: Any, q: Any, v: Any, more: Any) -> Any:
        """Return how v'_dot changes along one direction, (n).

        As in `derivatives`: one more elimination.

        Parameters
        ----------
        u : casadi.SX of n
            u'; nothing is corrected.
        q, v : casadi.SX
            Changes of q' (its quaternions' lengths stay one) and v'.
        more : casadi.SX of n and the kept rows
            Changes of u' and of J v'_dot, among them what `by_arguments` gives.
        """
        import casadi as cs

        n, (left, unknown) = self._n, self._left()
        change = self._terms.angles.along(left, q) + cs.jtimes(left, self._terms.v, v)
        more = more - cs.substitute(change, unknown, self._solution(u))
        found, _ = self.solve([more[i] for i in range(n)], [more[i] for i in range(n, more.numel())])
        return cs.vertcat(*found)

    def by_arguments(self, u: Any, arguments: Any) -> Any:
        """Return what a change of the numbers that are arguments is like, a column for each of their groups.

        Parameters
        ----------
        u : casadi.SX of n
            u'.
        arguments : casadi.SX
            The change.

        Returns
        -------
        casadi.SX, (n and the kept rows, groups)
            The changes of u' and of J v'_dot that would do the same.
        """
        import casadi as cs

        (left, unknown), groups = self._left(), self._terms.arguments.groups
        each = cs.SX(arguments.numel(), len(groups))
        for k, group in enumerate(groups):
            each[group, k] = arguments[group]
        change = -cs.jtimes(left, self._terms.arguments.vector, each)
        return cs.substitute(change, unknown, self._solution(u))

    def _left(self) -> tuple[Any, Any]:
        """What eq. 1 says is u' and zero, in `v_dot` and symbols for the kept rows' multipliers; those symbols."""
        import casadi as cs

        terms, kept = self._terms, list(self._terms.kept)
        J, multipliers = terms.rows.J[kept, :], cs.SX.sym("l", len(kept))
        left = cs.vertcat(
            terms.needed - terms.damping - cs.mtimes(J.T, multipliers),
            cs.mtimes(J, terms.v_dot) + terms.rows.J_dot_v[kept],
        )
        return left, cs.vertcat(terms.v_dot, multipliers)

    def _solution(self, u: Any) -> Any:
        import casadi as cs

        return cs.vertcat(*self.acceleration(u, cs.SX(self._terms.rows.phi.numel(), 1)))

    def soundness(self) -> Any:
        """Return a number that is positive where elimination had no need of pivots.

        They are counted: the least of them would cost calls.
        """
        return self._factor.sound - (len(self._terms.order) - 0.5)


def _across(by_state: Any, terms: Expressions) -> Any:
    """Without what a change of the quaternions' lengths would do."""
    import casadi as cs

    for place in terms.quaternions:
        x, at = terms.angles.q[place : place + 4], slice(place, place + 4)
        by_state[:, at] = by_state[:, at] - cs.mtimes(cs.mtimes(by_state[:, at], x), x.T)
    return by_state


def _filled(x: Any) -> list[tuple[int, int]]:
    """Where a matrix is not zero by its structure."""
    return list(zip(*x.sparsity().get_triplet(), strict=True))
