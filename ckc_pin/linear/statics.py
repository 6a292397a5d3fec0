"""Static balance of a configuration by motor torques, joint stops and dry friction."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, combinations, islice

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns
from ckc_pin.control.actuation import Actuation
from ckc_pin.dynamics.equilibrium import weight
from ckc_pin.dynamics.formulations import tangent_basis
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import STOP_TOLERANCE
from ckc_pin.native.control import allocate
from ckc_pin.native.plant import LOST_RANK

__all__ = [
    "StaticBalance",
    "balance_at_rest",
    "closest_torques",
    "compute_velocity_basis",
    "has_unbalanced_force",
    "orthonormal_null_space",
]

FORCE_TOLERANCE = 1e-9  # relative to the sum of |forces| along the same freedom
COUPLED_FORCE_TOLERANCE = 1e-4  # relative to the largest tolerance of all freedoms
ABSOLUTE_FORCE_TOLERANCE = 1e-13  # relative to the weight and the largest force on any coordinate
MAX_STOP_SETS = 2000  # sets of loaded stops that are tried
RANK_TOLERANCE = 1e-9  # relative to the largest singular value
FREEDOM_RANK_TOLERANCE = 1e-6  # absolute, of orthonormal columns


@dataclass(frozen=True)
class StaticBalance:
    """Forces that keep a configuration at rest.

    Attributes
    ----------
    tau : (motors,) array
        Motor torques, N m or N.
    loaded_stops : int array
        Coordinates that are pushed into a stop.
    unloaded_stops : int array
        Coordinates that are at a stop without a force on it.
    passive_force : (n,) array
        Generalized force of loaded stops and dry friction on the tree.
    uses_friction : bool
        Whether the motors are not sufficient without dry friction.
    """

    tau: Array
    loaded_stops: IntArray
    unloaded_stops: IntArray
    passive_force: Array
    uses_friction: bool


def balance_at_rest(state: Terms, actuation: Actuation, *, has_friction: bool) -> StaticBalance:
    """Find motor torques, loaded stops and dry friction that keep a configuration at rest.

    The motors share the force as in a run. Friction acts only if the motors are not sufficient.

    Parameters
    ----------
    state : Terms
        At rest, on the constraint manifold.
    has_friction : bool
        Whether dry friction can hold joints at rest.

    Raises
    ------
    InputError
        Nothing balances the forces on the configuration.
    NumericalError
        J has lost rank.
    """
    mechanism = state.mechanism
    velocities, stop_sides = compute_velocity_basis(state), _find_stop_sides(mechanism, state.q_tree)
    at_stop, first_error = np.flatnonzero(stop_sides), None
    sets = chain.from_iterable(combinations(at_stop, count) for count in range(len(at_stop), -1, -1))
    for loaded in (np.array(indices, np.intp) for indices in islice(sets, MAX_STOP_SETS)):
        tangent = velocities @ orthonormal_null_space(velocities[loaded] / mechanism.tree.step_scale[loaded, None])
        try:
            tau, friction = _balance_along(state, tangent, actuation, has_friction=has_friction)
        except InputError as error:
            first_error = error
            continue
        residual = velocities.T @ (state.h_tree - mechanism.motors.force(tau) - friction)
        passive = friction.copy()
        passive[loaded] += np.linalg.lstsq(velocities[loaded].T, residual, rcond=RANK_TOLERANCE)[0]
        stop_forces = -stop_sides[loaded] * (passive - friction)[loaded]
        scale = np.abs(velocities.T) @ (np.abs(state.h_tree) + np.abs(mechanism.motors.force(tau)))
        if np.all(stop_forces > FORCE_TOLERANCE * scale.max(initial=0.0)):  # a stop cannot pull
            return StaticBalance(tau, loaded, np.setdiff1d(at_stop, loaded), passive, bool(friction.any()))
    raise first_error or InputError(
        f"{mechanism.name}: too many joints are at stops to find out which stops are loaded"
    )


def compute_velocity_basis(state: Terms) -> Array:
    """Return a basis of the velocities that the constraints allow, (n, d).

    Raises
    ------
    NumericalError
        J has lost rank.
    """
    try:
        return tangent_basis(state, np.zeros(state.mechanism.closure.rows))[0]
    except NumericalError as error:
        raise NumericalError(LOST_RANK, q_tree=error.q_tree) from None


def has_unbalanced_force(state: Terms, u_tree: Array, tangent: Array) -> bool:
    """Whether a state at rest has a resultant force beyond rounding along a basis of velocities.

    Parameters
    ----------
    u_tree : (n,) array
        All forces on the tree besides those of `Terms.h_tree`.
    tangent : (n, k) array
        The basis.
    """
    step_scale, springs = state.mechanism.tree.step_scale, state.mechanism.springs
    sizes = np.abs(state.h_tree) + np.abs(u_tree) + springs.sizes(state.q_tree)
    tolerance = FORCE_TOLERANCE * (np.abs(tangent.T) @ sizes)
    total = weight(state.mechanism) + float((step_scale * sizes).max())
    tolerance += ABSOLUTE_FORCE_TOLERANCE * total * np.abs(tangent / step_scale[:, None]).max(axis=0, initial=0.0)
    residual = np.abs(tangent.T @ (state.h_tree - u_tree))
    return bool(np.any(residual > tolerance + COUPLED_FORCE_TOLERANCE * tolerance.max(initial=0.0)))


def _find_stop_sides(mechanism: Mechanism, q_tree: Array) -> Array:
    """Return for each coordinate -1 at its lower stop, 1 at its upper stop, and 0 elsewhere."""
    joints, q = mechanism.joints, mechanism.tree.to_coordinates(q_tree)
    tolerance = STOP_TOLERANCE * mechanism.tree.step_scale
    return np.where(q - joints.lower <= tolerance, -1.0, np.where(joints.upper - q <= tolerance, 1.0, 0.0))


def orthonormal_null_space(rows: Array) -> Array:
    """Return an orthonormal basis of the null space of a matrix; the identity for a matrix without rows."""
    if not len(rows):
        return np.eye(rows.shape[1])
    _, values, directions = np.linalg.svd(rows)
    return np.asarray(directions[int(np.sum(values > RANK_TOLERANCE * values[0])) :].T)


def _balance_along(state: Terms, tangent: Array, actuation: Actuation, *, has_friction: bool) -> tuple[Array, Array]:
    """Return motor torques, and friction forces (n,), that balance the forces along a basis of velocities.

    Raises
    ------
    InputError
        They do not exist.
    """
    mechanism, zeros = state.mechanism, np.zeros(state.mechanism.n)
    turns, max_friction = mechanism.motors.transmission, mechanism.joints.friction
    tau = closest_torques(state, tangent, actuation)
    if not has_unbalanced_force(state, turns.T @ tau, tangent):
        return tau, zeros
    rubbing = np.flatnonzero(max_friction)
    if has_friction and len(rubbing):
        forces = _allocate_along(
            state,
            tangent,
            np.vstack([turns, np.eye(mechanism.n)[rubbing]]),
            np.hstack([actuation.limit, [-max_friction[rubbing], max_friction[rubbing]]]),
            np.concatenate([actuation.weights, np.ones(len(rubbing))]),
            np.concatenate([actuation.preload, np.zeros(len(rubbing))]),
        )
        tau, friction = forces[: len(tau)], zeros
        friction[rubbing] = forces[len(tau) :]
        if not has_unbalanced_force(state, turns.T @ tau + friction, tangent):
            return tau, friction
    raise InputError(f"{mechanism.name}: {_explain_imbalance(state, tangent, actuation)}")


def closest_torques(state: Terms, tangent: Array, actuation: Actuation) -> Array:
    """Return the motor torques within limits that balance a state at rest as well as possible along some velocities.

    Parameters
    ----------
    state : Terms
        At rest.
    tangent : (n, k) array
        Basis of the velocities.
    """
    turns = state.mechanism.motors.transmission
    return _allocate_along(state, tangent, turns, actuation.limit, actuation.weights, actuation.preload)


def _allocate_along(state: Terms, tangent: Array, turns: Array, limit: Array, weights: Array, preload: Array) -> Array:
    """Allocate the force that balances `state` to actuators, along the velocities that the actuators can influence."""
    _, values, directions = np.linalg.svd(turns @ tangent)
    driven = tangent @ directions[: int(np.sum(values > RANK_TOLERANCE * values.max(initial=0.0)))].T
    return allocate((turns @ driven).T, driven.T @ state.h_tree, limit, weights, preload)


def _explain_imbalance(state: Terms, tangent: Array, actuation: Actuation) -> str:
    mechanism, names = state.mechanism, state.mechanism.actuated
    unlimited = actuation.minimum_norm_torques(tangent, tangent.T @ state.h_tree)
    motors = f"the motor{'s' if len(names) > 1 else ''} ({', '.join(names)})"
    if not has_unbalanced_force(state, mechanism.motors.force(unlimited), tangent):
        overload = actuation.explain_overload(unlimited)
        return f"{motors} cannot hold this configuration within the torque limits: {overload}"
    freedoms = _name_undriven_freedoms(mechanism, tangent)
    if not names:
        return (
            "nothing holds this configuration: the mechanism has no motors, and gravity or springs act along "
            f"{freedoms}; choose another configuration or the equilibrium, or add motors"
        )
    return (
        f"{motors} cannot hold this configuration: no motor drives the motion along {freedoms}, and gravity or springs "
        "act on it; choose another configuration or the equilibrium, or add motors"
    )


def _name_undriven_freedoms(mechanism: Mechanism, tangent: Array) -> str:
    """Return the coordinates that describe best the freedoms without a motor."""
    basis, _ = np.linalg.qr(tangent / mechanism.tree.step_scale[:, None])
    undriven = basis @ orthonormal_null_space(
        mechanism.motors.transmission @ (mechanism.tree.step_scale[:, None] * basis)
    )
    q = mechanism.partition.q
    rank = np.linalg.matrix_rank(undriven, tol=FREEDOM_RANK_TOLERANCE)
    sufficient = np.linalg.matrix_rank(undriven[q], tol=FREEDOM_RANK_TOLERANCE) == rank
    candidates = q if sufficient else np.arange(mechanism.n)
    return ", ".join(
        mechanism.coordinates[candidates[k]] for k in sorted(pivoted_columns(undriven[candidates].T)[0][:rank])
    )
