"""Exact derivatives of eq. 1: of its acceleration and multipliers by configuration, velocity and force.

With R = D' a + C' v' + h' - f(q', v') - u' - J^T lambda and phi_ddot = J a + J_dot v', both zero, any change of the
state obeys

    D' da - J^T dlambda = -dR,    J da = -dphi_ddot,

where dR and dphi_ddot are taken with a and lambda constant: Pinocchio's analytic derivatives of the tree's inverse
dynamics, those of springs and dampers, and the rows' own second derivatives. Nothing is differenced. Derivatives by q'
are along the tangent coordinates, with the numbers of v', a and u' constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ckc_pin.dynamics.formulations import SINGULAR
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.linear import Factorization, null_space
from ckc_pin.mechanism.rank import rank_of, scaled
from ckc_pin.mechanism.tree import Array, IntArray

__all__ = ["AccelerationDerivatives", "acceleration_derivatives", "multiplier_gradient", "tree_force_derivatives"]

NONE = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True)
class AccelerationDerivatives:
    """Eq. 1 solved at one state, and its solution's derivatives.

    Where rows are redundant, derivatives are meant along motions that the loops allow: across them the loops
    contradict each other.

    Attributes
    ----------
    acceleration : (n,) array
        a, the rate of v'.
    multipliers : (rows,) array
        Of least norm, N or N m.
    tangent : (n, d) array
        Basis of the velocities that the loops allow, ones and zeros in the rows `chart`.
    chart : (d,) int array
        Coordinates that the basis is of: the best there are, whatever `independent` says.
    a_q, a_v, a_u : (n, n) arrays
        Of a by q' (tangent coordinates), v' and u'.
    multipliers_q, multipliers_v, multipliers_u : (rows, n) arrays
    v_q : (n, n) array
        Of v' by q', as the loops ask for it: the least change of v' that keeps J v' = 0.
    """

    acceleration: Array
    multipliers: Array
    tangent: Array
    chart: IntArray
    a_q: Array
    a_v: Array
    a_u: Array
    multipliers_q: Array
    multipliers_v: Array
    multipliers_u: Array
    v_q: Array


def acceleration_derivatives(
    terms: Terms, u_tree: Array, locked: IntArray = NONE, smoothing: float | None = None
) -> AccelerationDerivatives:
    """Solve eq. 1 and differentiate it.

    Parameters
    ----------
    terms : Terms
    u_tree : (n,) array
        Forces on the tree that do not change with the state: of actuators, and of joints that slide.
    locked : int array, optional
        Coordinates that do not move, as of joints that stick: their forces follow.
    smoothing : float, optional
        Rate over which dry friction grows as tanh, rad/s or m/s; absent, there is none beside u_tree.

    Raises
    ------
    NumericalError
        J has lost rank.

    Notes
    -----
    Cost: of order n evaluations of J_dot beside Pinocchio's.
    """
    system = _Constrained(terms, locked)
    n, rows = terms.mechanism.n, terms.mechanism.closure.rows
    force = u_tree - terms.bias_tree
    if smoothing is not None:
        force += terms.mechanism.joints.smooth_friction(terms.v_tree, smoothing)
    if terms.mechanism.springs.any_damping:
        force += terms.damping_force
    a, multipliers = system.solve(force[:, None], -(terms.J_dot @ terms.v_tree)[:, None])
    acceleration, own = a[:, 0], multipliers[:rows, 0]
    R_q, R_v = tree_force_derivatives(terms, acceleration)
    if smoothing is not None:
        R_v -= np.diag(terms.mechanism.joints.smooth_friction_rate(terms.v_tree, smoothing))
    closure, pose = terms.mechanism.closure, terms.at.pose
    swing = closure.acceleration_gradient(pose, terms.v_tree, acceleration)
    opened = closure.acceleration_gradient(pose, np.zeros(n), terms.v_tree)
    R_q -= multiplier_gradient(terms, own, np.eye(n))
    right = np.hstack([-R_q, -R_v, np.eye(n)])
    along = np.hstack([-swing, -(terms.J_dot + opened), np.zeros((rows, n))])
    a_x, multipliers_x = system.solve(right, along)
    multipliers_x[:rows, :n] += system.least_norm_change(multipliers[:, 0])
    a_q, a_v, a_u = np.split(a_x, 3, axis=1)
    multipliers_q, multipliers_v, multipliers_u = np.split(multipliers_x[:rows], 3, axis=1)
    return AccelerationDerivatives(
        acceleration=acceleration,
        multipliers=own,
        tangent=system.tangent,
        chart=system.chart,
        a_q=a_q,
        a_v=a_v,
        a_u=a_u,
        multipliers_q=multipliers_q,
        multipliers_v=multipliers_v,
        multipliers_u=multipliers_u,
        v_q=-system.J_inverse[:, :rows] @ opened,
    )


def tree_force_derivatives(terms: Terms, acceleration: Array, *, dampers: bool = True) -> tuple[Array, Array]:
    """Derivatives of D' a + C' v' + h', less what dampers do, by q' and by v', (n, n) each; by a it is D'."""
    mechanism, state = terms.mechanism, (terms.q_tree, terms.v_tree, acceleration)
    by_q, by_v = mechanism.tree.evaluate(_tree_derivatives, *state)
    if mechanism.springs.any:
        by_q += mechanism.springs.elastic_gradient(terms.q_tree)
    if dampers and mechanism.springs.any_damping:
        damping_q, damping_v = mechanism.springs.damping_gradient(terms.q_tree, terms.v_tree)
        by_q, by_v = by_q - damping_q, by_v - damping_v
    return by_q, by_v


def multiplier_gradient(terms: Terms, multipliers: Array, steps: Array) -> Array:
    """Derivative of J^T lambda along tangent steps (n, k), lambda constant: shape (n, k)."""
    if not multipliers.any():
        return np.zeros(steps.shape)
    return np.array([multipliers @ terms.at.J_dot(step) for step in steps.T]).reshape(steps.shape[::-1]).T


def _tree_derivatives(model: pin.Model, data: pin.Data, *state: Array) -> Array:
    pin.computeRNEADerivatives(model, data, *state)
    return np.array([data.dtau_dq, data.dtau_dv])


class _Constrained:
    """The matrix [D', -J^T; J, 0] with rows for locked coordinates below J's, factorized once."""

    def __init__(self, terms: Terms, locked: IntArray) -> None:
        mechanism = terms.mechanism
        self._terms, self._locked = terms, locked
        self._J = np.vstack([terms.at.J, np.eye(mechanism.n)[locked]])
        rank = mechanism.rank
        if len(locked):
            J = scaled(terms.at.J, mechanism.tree, mechanism.closure)
            rank = rank_of(np.vstack([J, np.eye(mechanism.n)[locked]])).rank
        self._rank = rank
        self.tangent, _, pivots = null_space(self._J, rank, np.zeros(len(self._J)))
        if rank and not pivots[-1] > SINGULAR * pivots[0]:
            raise NumericalError(
                "the loop closure's Jacobian J has lost rank: branches of the motion meet here, and no linear model "
                "describes them all; take another configuration",
                q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(terms.q_tree)),
            )
        self.chart = _units(self.tangent)
        self._inertia = Factorization(self.tangent.T @ terms.D_tree @ self.tangent)
        self.J_inverse = np.linalg.pinv(self._J, rcond=1e-9)

    def solve(self, force: Array, along: Array) -> tuple[Array, Array]:
        """Return a and multipliers with D' a = force + J^T multipliers, J a = along; locked coordinates rest."""
        full = np.vstack([along, np.zeros((len(self._locked), along.shape[1]))])
        _, particular, _ = null_space(self._J, self._rank, -full)
        D = self._terms.D_tree
        a = particular + self.tangent @ self._inertia.solve(self.tangent.T @ (force - D @ particular))
        return a, self.J_inverse.T @ (D @ a - force)

    def least_norm_change(self, multipliers: Array) -> Array:
        """What keeps the multipliers the least ones as the range of J turns: zero without redundant rows."""
        closure, pose = self._terms.mechanism.closure, self._terms.at.pose
        if self._rank == len(self._J):
            return np.zeros((closure.rows, len(self.tangent)))
        step = self.J_inverse @ multipliers
        turned = np.zeros(self._J.shape)
        turned[: closure.rows] = closure.acceleration_gradient(pose, np.zeros(len(step)), step)
        return (turned - self._J @ (self.J_inverse @ turned))[: closure.rows]


def _units(tangent: Array) -> IntArray:
    """Return the rows of a basis where it is the identity."""
    single = np.count_nonzero(tangent, axis=1) == 1
    rows = [next(k for k in np.flatnonzero(single & (column == 1.0))) for column in tangent.T]
    return np.array(rows, dtype=np.intp)
