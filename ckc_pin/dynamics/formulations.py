"""The three formulations as functions of `Terms`: the DAE (eq. 1), the reduced model (eq. 6), the SPF (eq. 8).

In every one of them u' is the generalized force of the actuators on the tree; u = rho^T u'.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import Factorization, null_space
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = [
    "CoriolisVelocity",
    "dae_acceleration",
    "multipliers",
    "reduced_acceleration",
    "refuse_massless",
    "spf_terms",
    "spf_z_dot",
    "tangent_basis",
    "tree_force",
]

CoriolisVelocity = Literal["rho", "actual"]

SINGULAR = 1e-12  # relative size of the last pivot of J^T at which its rank counts as lost


def reduced_acceleration(terms: Terms, u_tree: Array, q_dot: Array | None = None) -> Array:
    """Solve eq. 6 (and the first line of eq. 8) for the acceleration of q.

    Parameters
    ----------
    terms : Terms
        At v' = rho q_dot; or, with `q_dot` given, at any v' that C is to be evaluated at.
    u_tree : (n,) array
        Generalized forces of the actuators.
    q_dot : (d,) array, optional
        Needed when v' is not rho q_dot (the SPF off its manifold, eq. 16's convention).

    Returns
    -------
    (d,) array
    """
    force = u_tree - terms.bias_tree
    if q_dot is None:
        # rho^T (D' rho_dot q_dot + C' v' + h') needs neither C' nor the matrix rho_dot
        force -= terms.D_tree @ terms.rho_dot_times(terms.q_dot)
        right = terms.rho.T @ force
    else:
        right = terms.rho.T @ (u_tree - terms.h_tree) - terms.C_times(q_dot)
    if terms.mechanism.springs.any_damping:
        right += terms.rho.T @ terms.damping_force
    return terms.D_factor.solve(right)


def spf_z_dot(at: Kinematics, q_dot: Array, epsilon: float, w: Array) -> Array:
    """Second line of eq. 8: z_dot = -phi_z^-1 (phi_q q_dot + w / epsilon), shape (n - d,)."""
    return at.rho[at.partition.z] @ q_dot - at.phi_z_factor.solve(w) / epsilon


def spf_terms(
    mechanism: Mechanism, at: Kinematics, q_dot: Array, epsilon: float, w: Array, convention: CoriolisVelocity
) -> Terms:
    """Terms of the SPF at (q, z, q_dot).

    Eq. 8 writes C(q, z, q_dot): the velocity inside C is rho q_dot ("rho"). Eq. 16 writes
    C(q, q_dot, z, z_dot), with the actual z_dot ("actual"), which contains w / epsilon.
    """
    v_tree = at.rho @ q_dot
    if convention == "actual":
        v_tree[at.partition.z] = spf_z_dot(at, q_dot, epsilon, w)
    return Terms(mechanism, at, v_tree)


def tangent_basis(terms: Terms, residual: Array) -> tuple[Array, Array]:
    """Split the tangent space and meet a condition on J.

    Parameters
    ----------
    residual : (rows,) array, or (rows, k)
        For example J_dot v'; with redundant rows consistent, as every motion makes it.

    Returns
    -------
    tangent : (n, d) array
        Basis of the velocities that the loops allow.
    particular : (n,) array, or (n, k)
        An x with J x = -residual.

    Raises
    ------
    NumericalError
        J has lost rank.
    """
    mechanism = terms.mechanism
    tangent, particular, pivots = null_space(terms.at.J, mechanism.rank, residual)
    if mechanism.rank and not pivots[-1] > SINGULAR * pivots[0]:
        raise NumericalError(
            "the loop closure's Jacobian J has lost rank: the mechanism has more freedoms here than elsewhere",
            q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(terms.q_tree)),
        )
    return tangent, particular


def dae_acceleration(terms: Terms, u_tree: Array, correction: Array | float = 0.0) -> Array:
    """Solve eq. 1 with its closure differentiated twice, J a + J_dot v' + correction = 0, for a = dv'/dt, shape (n,).

    The motion is projected on the tangent space of the closure, so no choice of q is involved,
    redundant rows do no harm, and massless links do none as long as D' is regular on that space.
    `correction`, shape (rows,), is what Baumgarte's stabilisation adds.

    Raises
    ------
    NumericalError
        J has lost rank.
    """
    tangent, particular = tangent_basis(terms, terms.J_dot @ terms.v_tree + correction)
    force = u_tree - terms.bias_tree
    if terms.mechanism.springs.any_damping:
        force += terms.damping_force
    inertia = tangent.T @ terms.D_tree @ tangent
    right = tangent.T @ (force - terms.D_tree @ particular)
    return particular + tangent @ Factorization(inertia).solve(right)


def multipliers(terms: Terms, u_tree: Array, acceleration: Array) -> Array:
    """Multipliers of eq. 1, D' a + C' v' + h' = u' + J^T lambda, of minimum norm, shape (rows,).

    For point rows they are the force that the loop exerts on frame A, in newtons.
    """
    force = tree_force(terms, acceleration) - u_tree
    return np.asarray(np.linalg.lstsq(terms.at.J.T, force, rcond=1e-9)[0])


def tree_force(terms: Terms, acceleration: Array) -> Array:
    """What actuators and loops together must do to the tree, D' a + C' v' + h' less what dampers do: shape (n,)."""
    force = terms.D_tree @ acceleration + terms.bias_tree
    return force - terms.damping_force if terms.mechanism.springs.any_damping else force


def refuse_massless(terms: Terms, tangent: Array, among: IntArray) -> None:
    """Refuse motions that move no mass. Massless links are fine as long as every motion moves some.

    Judged on the inertia with its diagonal scaled to one, so that neither units nor ratios of masses matter.

    Parameters
    ----------
    terms : Terms
    tangent : (n, d) array
        Basis of the motions.
    among : int array
        Coordinates that the motion is named by.

    Raises
    ------
    InputError
    """
    D = tangent.T @ terms.D_tree @ tangent
    scale = np.sqrt(np.maximum(np.diagonal(D), 0.0))
    motion = np.eye(len(D))[int(np.argmin(scale))]
    if scale.min() > 1e-12 * scale.max():
        values, directions = np.linalg.eigh(D / np.outer(scale, scale))
        if values[0] > 1e-13:
            return
        motion = directions[:, 0] / scale
    most = among[int(np.argmax(np.abs(tangent @ motion / terms.mechanism.tree.step_scale)[among]))]
    raise InputError(
        f"{terms.mechanism.name}: the motion along {terms.mechanism.coordinates[most]} moves no mass, so no force can "
        "tell its acceleration; give the links it moves a mass and an inertia, or make the joint fixed"
    )
