"""Acceleration of eq. 1 and its derivatives as CasADi expressions, by elimination without pivoting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ckc_pin.codegen.elimination import SymmetricFactor
from ckc_pin.codegen.expressions import TermExpressions

__all__ = ["ConstrainedInertia"]

MIN_PIVOT_RATIO = 1e-4  # pivot, relative to the sum that it is left of: elimination loses four digits there


class ConstrainedInertia:
    """Symbolic factorization of eq. 1's matrix [D', -J^T; J, 0]: maps forces and loop accelerations to accelerations.

    Parameters
    ----------
    terms : TermExpressions
    """

    def __init__(self, terms: TermExpressions) -> None:
        self._terms, self._n = terms, terms.v.numel()
        D, J = terms.D_tree, terms.rows.J
        entries = {(i, j): D[i, j] for i, j in _structural_nonzeros(D) if j <= i}
        place = {row: self._n + k for k, row in enumerate(terms.kept)}
        entries |= {(place[i], j): J[i, j] for i, j in _structural_nonzeros(J) if i in place}
        self._factor = SymmetricFactor(entries, self._n, terms.order, MIN_PIVOT_RATIO)

    def solve(self, force: Sequence[Any], row_acceleration: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Solve D' a = force + J^T multipliers, J a = row_acceleration.

        Parameters
        ----------
        force : sequence of n casadi.SX
        row_acceleration : sequence of casadi.SX, one a kept row

        Returns
        -------
        (a, multipliers)
        """
        import casadi as cs

        right_hand_side = {k: x for k, x in enumerate([*force, *row_acceleration]) if x.nnz()}
        solution = self._factor.solve(right_hand_side)
        full = [solution.get(k, cs.SX(1, 1)) for k in range(self._n + len(row_acceleration))]
        return full[: self._n], full[self._n :]

    def acceleration(self, u: Any, correction: Any) -> tuple[Any, Any]:
        """Return v'_dot under the force u', and the kept rows' multipliers.

        Parameters
        ----------
        u : casadi.SX of n
            u'.
        correction : casadi.SX of rows
            Baumgarte's terms, added to J_dot v.
        """
        import casadi as cs

        terms = self._terms
        force = u - terms.bias_tree + terms.damping
        row_acceleration = [-(terms.rows.J_dot_v[i] + correction[i]) for i in terms.kept]
        a, multipliers = self.solve([force[k] for k in range(self._n)], row_acceleration)
        return cs.vertcat(*a), cs.vertcat(*multipliers)

    def closing_step(self, residual: Any) -> Any:
        """Return the step x with J x = -residual that is smallest in the metric of D'.

        Parameters
        ----------
        residual : casadi.SX of rows
        """
        import casadi as cs

        step, _ = self.solve([cs.SX(1, 1)] * self._n, [-residual[i] for i in self._terms.kept])
        return cs.vertcat(*step)

    def derivatives(self, u: Any) -> tuple[Any, Any]:
        """Return the Jacobians of (q'_dot, v'_dot) by (q', v'), square of nq + n, and of v'_dot by u', (n, n).

        Eq. 1 is differentiated at its solution. Each column costs one more elimination, not a derivative through the
        elimination. Of a change of a free root's quaternion, only the part orthogonal to the quaternion counts.

        Parameters
        ----------
        u : casadi.SX of n
            u', without correction.
        """
        import casadi as cs

        terms, n = self._terms, self._n
        kept = list(terms.kept)
        residual, unknowns = self._residual()
        by_state = cs.horzcat(terms.configuration.jacobian(residual), cs.jacobian(residual, terms.v))
        by_state = cs.substitute(by_state, unknowns, self._solution(u))
        columns = [
            self.solve([-by_state[i, j] for i in range(n)], [-by_state[n + i, j] for i in range(len(kept))])[0]
            for j in range(by_state.shape[1])
        ]
        zero = cs.SX(1, 1)
        by_u = [self.solve([cs.SX(1) if i == j else zero for i in range(n)], [zero] * len(kept))[0] for j in range(n)]
        rates = cs.jacobian(terms.q_dot, cs.vertcat(terms.configuration.q, terms.v))
        jacobian = cs.vertcat(rates, cs.horzcat(*(cs.vertcat(*x) for x in columns)))
        return _project_quaternion_columns(jacobian, terms), cs.horzcat(*(cs.vertcat(*x) for x in by_u))

    def directional_derivative(self, u: Any, q: Any, v: Any, more: Any) -> Any:
        """Return the derivative of v'_dot along one direction, (n), at the cost of one more elimination.

        Parameters
        ----------
        u : casadi.SX of n
            u', without correction.
        q, v : casadi.SX
            Directions of q', which keep the quaternions' norms, and of v'.
        more : casadi.SX of n and the kept rows
            Directions of u' and of J v'_dot, including those from `argument_derivative`.
        """
        import casadi as cs

        n, (change, unknowns) = self._n, self.residual_change(q, v)
        more = more - cs.substitute(change, unknowns, self._solution(u))
        derivative, _ = self.solve([more[i] for i in range(n)], [more[i] for i in range(n, more.numel())])
        return cs.vertcat(*derivative)

    def residual_change(self, q: Any, v: Any) -> tuple[Any, Any]:
        """Return the derivative of eq. 1's left side along one direction of q' and v', and the unknowns of eq. 1.

        The left side has n forces and an acceleration for each kept row. The unknowns are dv'/dt and the kept rows'
        multipliers, whose symbols are in the derivative.
        """
        import casadi as cs

        residual, unknowns = self._residual()
        change = self._terms.configuration.directional_derivative(residual, q) + cs.jtimes(residual, self._terms.v, v)
        return change, unknowns

    def argument_derivative(self, u: Any, arguments: Any) -> Any:
        """Return the changes of u' and J v'_dot that are equivalent to a change of the mechanism's numbers.

        Parameters
        ----------
        u : casadi.SX of n
            u'.
        arguments : casadi.SX
            The direction in which the numbers change.

        Returns
        -------
        casadi.SX, (n and the kept rows, groups)
            A column for each group of numbers.
        """
        import casadi as cs

        (residual, unknowns), groups = self._residual(), self._terms.arguments.groups
        by_group = cs.SX(arguments.numel(), len(groups))
        for k, group in enumerate(groups):
            by_group[group, k] = arguments[group]
        change = -cs.jtimes(residual, self._terms.arguments.vector, by_group)
        return cs.substitute(change, unknowns, self._solution(u))

    def _residual(self) -> tuple[Any, Any]:
        """Return eq. 1's left side, which equals u' and zero, and its unknowns: `v_dot` and symbols of multipliers."""
        import casadi as cs

        terms, kept = self._terms, list(self._terms.kept)
        J, multipliers = terms.rows.J[kept, :], cs.SX.sym("l", len(kept))
        residual = cs.vertcat(
            terms.inverse_dynamics - terms.damping - cs.mtimes(J.T, multipliers),
            cs.mtimes(J, terms.v_dot) + terms.rows.J_dot_v[kept],
        )
        return residual, cs.vertcat(terms.v_dot, multipliers)

    def _solution(self, u: Any) -> Any:
        import casadi as cs

        return cs.vertcat(*self.acceleration(u, cs.SX(self._terms.rows.phi.numel(), 1)))

    def accuracy(self) -> Any:
        """Return a number that is positive if all pivots were accurate.

        The pivots are counted: their minimum would cost calls of fmin.
        """
        return self._factor.accurate_pivots - (len(self._terms.order) - 0.5)


def _project_quaternion_columns(by_state: Any, terms: TermExpressions) -> Any:
    """Remove the component along the quaternion's norm from the columns of a free root's quaternion."""
    import casadi as cs

    for start in terms.quaternions:
        x, columns = terms.configuration.q[start : start + 4], slice(start, start + 4)
        by_state[:, columns] = by_state[:, columns] - cs.mtimes(cs.mtimes(by_state[:, columns], x), x.T)
    return by_state


def _structural_nonzeros(x: Any) -> list[tuple[int, int]]:
    """Return rows and columns of a matrix's structural nonzeros."""
    return list(zip(*x.sparsity().get_triplet(), strict=True))
