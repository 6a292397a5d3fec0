"""Exact derivatives of the acceleration and multipliers of eq. 1 with respect to configuration, velocity and force.

With R = D' a + C' v' + h' - f(q', v') - u' - J^T lambda = 0 and phi_ddot = J a + J_dot v' = 0, a change of the state
satisfies

    D' da - J^T dlambda = -dR,    J da = -dphi_ddot,

where dR and dphi_ddot are the derivatives at constant a and lambda. They come from compiled terms, or from Pinocchio's
analytic derivatives of the tree's inverse dynamics, those of springs and dampers, and the rows' second and third
derivatives; finite differences are not used. Derivatives with respect to q' are along the tangent coordinates, at
constant coordinates of v', a and u'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.codegen.library import Library
from ckc_pin.control.forces import BodyForce
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.native.control import force_tables
from ckc_pin.native.tables import core_table

__all__ = ["LOST_RANK", "NONE", "AccelerationDerivatives", "Plant"]

NONE = np.zeros(0, dtype=np.intp)
LOST_RANK = (
    "the loop closure's Jacobian J has lost rank: branches of the motion meet at this configuration, so there is no "
    "linear model; take another configuration"
)


@dataclass(frozen=True)
class AccelerationDerivatives:
    """Solution of eq. 1 at one state, its derivatives, and the linear model in minimal coordinates.

    The states are d coordinates of the tree and their velocities. With v' = T q_dot and V = d(v')/dq at closed loops,
    the change of the acceleration is (a_q T + a_v V) dq + a_v T dq_dot + a_u du'. With redundant rows, the derivatives
    hold along admissible motions only.

    Attributes
    ----------
    acceleration : (n,) array
        a, the time derivative of v'.
    multipliers : (rows,) array
        Minimum-norm multipliers, N or N m.
    at : (d,) int array
        Coordinates of the states: `independent`, or others where those are singular.
    T, V : (n, d) arrays
        The rows `at` of T are the identity, those of V zero.
    A : (2 d, 2 d) array
    B : (2 d, motors) array
    a_q, a_v, a_u : (n, n) arrays
        Derivatives of a with respect to q' (tangent coordinates), v' and u'.
    multipliers_q, multipliers_v, multipliers_u : (rows, n) arrays
    """

    acceleration: Array
    multipliers: Array
    at: IntArray
    T: Array
    V: Array
    A: Array
    B: Array
    a_q: Array
    a_v: Array
    a_u: Array
    multipliers_q: Array
    multipliers_v: Array
    multipliers_u: Array


class Plant:
    """Evaluates eq. 1 and its derivatives at states of a mechanism.

    Parameters
    ----------
    mechanism : Mechanism
    smoothing : float, optional
        Velocity scale of the tanh of dry friction, rad/s or m/s. By default, there is no friction.
    library : Library, optional
        The mechanism's compiled terms. By default, terms are evaluated with Pinocchio.
    """

    def __init__(self, mechanism: Mechanism, smoothing: float | None = None, library: Library | None = None) -> None:
        self.mechanism = mechanism
        self._native = _core.Linearization(core_table(mechanism, library, smoothing), mechanism.motors.transmission)

    def at(
        self,
        terms: Terms,
        u_tree: Array,
        locked: IntArray = NONE,
        forces: Sequence[BodyForce] = (),
        correction: Array | None = None,
    ) -> AccelerationDerivatives:
        """Solve eq. 1 at a state and differentiate the solution.

        Parameters
        ----------
        terms : Terms
            The state.
        u_tree : (n,) array
            Forces on the tree that do not depend on the state: of actuators and of sliding joints.
        locked : int array, optional
            Coordinates that do not move, as of sticking joints.
        forces : sequence of BodyForce, optional
            Constant forces on links.
        correction : (rows,) array, optional
            Minus the prescribed acceleration of the constraint rows.

        Raises
        ------
        NumericalError
            J is rank deficient.
        """
        tables = force_tables(forces)
        if correction is None:
            correction = np.zeros(self.mechanism.closure.rows)
        state = (terms.q_tree, terms.v_tree, u_tree, np.asarray(locked).tolist())
        solution = self._native.at(*state, tables, correction)
        if solution is None:
            tree = self.mechanism.tree
            raise NumericalError(
                LOST_RANK,
                q_tree=tree.named(tree.to_coordinates(terms.q_tree)),
            )
        solution["at"] = np.array(solution["at"], dtype=np.intp)
        return AccelerationDerivatives(**solution)

    def seconds(self, terms: Terms, u_tree: Array, rounds: int = 2000) -> float:
        """Return the minimum time of an evaluation of A and B over many rounds, s."""
        return float(self._native.seconds(terms.q_tree, terms.v_tree, u_tree, rounds))
