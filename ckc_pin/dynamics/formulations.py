"""The three formulations as functions of `Terms`: the DAE (eq. 1), the reduced model (eq. 6) and the SPF (eq. 8).

In all of them u' is the generalized force of the actuators on the tree, and u = rho^T u'.
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
    "rank_loss_error",
    "reduced_acceleration",
    "require_mass",
    "spf_terms",
    "spf_z_dot",
    "tangent_basis",
    "tree_force",
]

CoriolisVelocity = Literal["rho", "actual"]

MIN_INERTIA_RATIO = 1e-12  # of the largest root of a diagonal entry of D: below it the coordinate moves no mass
MIN_INERTIA_EIGENVALUE = 1e-13  # of D with ones on its diagonal: below it a motion moves no mass


def reduced_acceleration(terms: Terms, u_tree: Array, q_dot: Array | None = None) -> Array:
    """Return the acceleration of q from the reduced model, eq. 6, or from the first line of the SPF, eq. 8.

    Parameters
    ----------
    terms : Terms
        At v' = rho q_dot. If `q_dot` is given, at the velocity at which C is evaluated.
    u_tree : (n,) array
        Generalized forces of the actuators.
    q_dot : (d,) array, optional
        Required if v' is not rho q_dot: for the SPF off its manifold with the convention of eq. 16.

    Returns
    -------
    (d,) array
    """
    force = u_tree - terms.bias_tree
    if q_dot is None:
        # rho^T (D' rho_dot q_dot + C' v' + h') requires neither C' nor the matrix rho_dot.
        force -= terms.D_tree @ terms.rho_dot_times(terms.q_dot)
        right = terms.rho.T @ force
    else:
        right = terms.rho.T @ (u_tree - terms.h_tree) - terms.C_times(q_dot)
    if terms.mechanism.springs.any_damping:
        right += terms.rho.T @ terms.damping_force
    return terms.D_factor.solve(right)


def spf_z_dot(at: Kinematics, q_dot: Array, epsilon: float, w: Array) -> Array:
    """Return z_dot of the SPF, second line of eq. 8: -phi_z^-1 (phi_q q_dot + w / epsilon), shape (n - d,)."""
    return at.rho[at.partition.z] @ q_dot - at.phi_z_factor.solve(w) / epsilon


def spf_terms(
    mechanism: Mechanism, at: Kinematics, q_dot: Array, epsilon: float, w: Array, convention: CoriolisVelocity
) -> Terms:
    """Return the terms of the SPF at (q, z, q_dot).

    Eq. 8 has C(q, z, q_dot), with the velocity rho q_dot in C ("rho"). Eq. 16 has C(q, q_dot, z, z_dot), with the
    actual z_dot ("actual"), which contains w / epsilon.
    """
    v_tree = at.rho @ q_dot
    if convention == "actual":
        v_tree[at.partition.z] = spf_z_dot(at, q_dot, epsilon, w)
    return Terms(mechanism, at, v_tree)


def tangent_basis(terms: Terms, residual: Array) -> tuple[Array, Array]:
    """Return a basis of the null space of J and a solution of J x = -residual.

    Parameters
    ----------
    residual : (rows,) array, or (rows, k)
        For example J_dot v'. Consistent if rows of J are redundant, as for every motion.

    Returns
    -------
    tangent : (n, d) array
        Basis of the velocities that the loops allow.
    particular : (n,) array, or (n, k)
        A solution x of J x = -residual.

    Raises
    ------
    NumericalError
        J has lost rank.
    """
    tangent, particular, has_rank = null_space(terms.at.J, terms.mechanism.rank, residual)
    if not has_rank:
        raise rank_loss_error(terms)
    return tangent, particular


def rank_loss_error(terms: Terms) -> NumericalError:
    """Return the error for a configuration at which J has lost rank."""
    tree = terms.mechanism.tree
    return NumericalError(
        "the loop closure's Jacobian J has lost rank: the mechanism has more freedoms here than elsewhere",
        q_tree=tree.named(tree.to_coordinates(terms.q_tree)),
    )


def dae_acceleration(terms: Terms, u_tree: Array, correction: Array | float = 0.0) -> Array:
    """Return the acceleration dv'/dt of the DAE, eq. 1 with J a + J_dot v' + correction = 0, shape (n,).

    The equations are projected onto the null space of J. Redundant rows and massless links are therefore allowed, as
    long as D' is regular on that space, and no choice of q is involved. `correction`, shape (rows,), is the term of
    Baumgarte's stabilisation.

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
    """Return the minimum-norm multipliers of eq. 1, D' a + C' v' + h' = u' + J^T lambda, shape (rows,).

    For point rows they are the force of the loop on frame A, in newtons.
    """
    force = tree_force(terms, acceleration) - u_tree
    return np.asarray(np.linalg.lstsq(terms.at.J.T, force, rcond=1e-9)[0])


def tree_force(terms: Terms, acceleration: Array) -> Array:
    """Return the force of actuators and loops for an acceleration, D' a + C' v' + h' minus damping, shape (n,)."""
    force = terms.D_tree @ acceleration + terms.bias_tree
    return force - terms.damping_force if terms.mechanism.springs.any_damping else force


def require_mass(terms: Terms, tangent: Array, among: IntArray) -> None:
    """Require that every motion moves mass. Massless links are allowed if every motion also moves a link with mass.

    The inertia is scaled to a diagonal of ones, so that units and ratios of masses do not matter.

    Parameters
    ----------
    terms : Terms
    tangent : (n, d) array
        Basis of the motions.
    among : int array
        Coordinates by which the message names a motion.

    Raises
    ------
    InputError
        A motion moves no mass.
    """
    D = tangent.T @ terms.D_tree @ tangent
    scale = np.sqrt(np.maximum(np.diagonal(D), 0.0))
    motion = np.eye(len(D))[int(np.argmin(scale))]
    if scale.min() > MIN_INERTIA_RATIO * scale.max():
        values, directions = np.linalg.eigh(D / np.outer(scale, scale))
        if values[0] > MIN_INERTIA_EIGENVALUE:
            return
        motion = directions[:, 0] / scale
    largest = among[int(np.argmax(np.abs(tangent @ motion / terms.mechanism.tree.step_scale)[among]))]
    raise InputError(
        f"{terms.mechanism.name}: the motion along {terms.mechanism.coordinates[largest]} moves no mass, so its "
        "acceleration is not determined; give the links it moves a mass and an inertia, or make the joint fixed"
    )
