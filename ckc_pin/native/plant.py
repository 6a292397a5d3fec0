"""Exact derivatives of eq. 1: of its acceleration and multipliers by configuration, velocity and force.

With R = D' a + C' v' + h' - f(q', v') - u' - J^T lambda and phi_ddot = J a + J_dot v', both zero, any change of the
state obeys

    D' da - J^T dlambda = -dR,    J da = -dphi_ddot,

where dR and dphi_ddot are taken with a and lambda constant: by the terms written out, where they were compiled, or by
Pinocchio's analytic derivatives of the tree's inverse dynamics, those of springs and dampers, and the rows' own second
and third ones. Nothing is differenced. Derivatives by q' are along the tangent coordinates, with the numbers of v', a
and u' constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.codegen.library import Library
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table

__all__ = ["LOST_RANK", "NONE", "AccelerationDerivatives", "Plant"]

NONE = np.zeros(0, dtype=np.intp)
LOST_RANK = (
    "the loop closure's Jacobian J has lost rank: branches of the motion meet here, and no linear model describes them "
    "all; take another configuration"
)


@dataclass(frozen=True)
class AccelerationDerivatives:
    """Eq. 1 solved at one state, its solution's derivatives, and both in minimal coordinates.

    The states are d coordinates of the tree and their rates. With T what those rates make of v', and V what a change of
    the coordinates asks of v' so that the loops stay closed, the change of the acceleration along them is
    (a_q T + a_v V) dq + a_v T dq_dot + a_u du'. Where rows are redundant, derivatives are meant along motions that the
    loops allow: across them the loops contradict each other.

    Attributes
    ----------
    acceleration : (n,) array
        a, the rate of v'.
    multipliers : (rows,) array
        Of least norm, N or N m.
    at : (d,) int array
        The coordinates that the states are of: `independent`, or others where those are no chart.
    T, V : (n, d) arrays
        Zero and identity, or zero, in the rows `at`.
    A : (2 d, 2 d) array
    B : (2 d, motors) array
    a_q, a_v, a_u : (n, n) arrays
        Of a by q' (tangent coordinates), v' and u'.
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
    """A mechanism whose eq. 1 is differentiated at one state after another.

    Parameters
    ----------
    mechanism : Mechanism
    smoothing : float, optional
        Rate over which dry friction grows as tanh, rad/s or m/s; absent, there is none.
    library : Library, optional
        Its terms, compiled; absent, they are Pinocchio's.
    """

    def __init__(self, mechanism: Mechanism, smoothing: float | None = None, library: Library | None = None) -> None:
        self.mechanism = mechanism
        self._native = _core.Plant(core_table(mechanism, library, smoothing), mechanism.motors.transmission)

    def at(self, terms: Terms, u_tree: Array, locked: IntArray = NONE) -> AccelerationDerivatives:
        """Solve eq. 1 and differentiate it.

        Parameters
        ----------
        terms : Terms
            The state.
        u_tree : (n,) array
            Forces on the tree that do not change with the state: of actuators, and of joints that slide.
        locked : int array, optional
            Coordinates that do not move, as of joints that stick: their forces follow.

        Raises
        ------
        NumericalError
            J has lost rank.
        """
        found = self._native.at(terms.q_tree, terms.v_tree, u_tree, np.asarray(locked).tolist())
        if found is None:
            tree = self.mechanism.tree
            raise NumericalError(
                LOST_RANK,
                q_tree=tree.named(tree.to_coordinates(terms.q_tree)),
            )
        found["at"] = np.array(found["at"], dtype=np.intp)
        return AccelerationDerivatives(**found)

    def seconds(self, terms: Terms, u_tree: Array, rounds: int = 2000) -> float:
        """Return how long A and B take, s, the least of many."""
        return float(self._native.seconds(terms.q_tree, terms.v_tree, u_tree, rounds))
