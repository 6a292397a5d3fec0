"""What holds a mechanism at rest: its motors, stops that joints rest on, dry friction."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, combinations, islice

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.allocation import allocate
from ckc_pin.dynamics.equilibrium import weight
from ckc_pin.dynamics.formulations import tangent_basis
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import AT_STOP
from ckc_pin.native.plant import LOST_RANK

__all__ = ["Rest", "hold", "kernel", "motions", "unbalanced"]

LEFT_OVER = 1e-9  # of the forces along a freedom: rounding, which nothing needs to hold
ROUNDING = 1e-4  # of that along the others
NOTHING = 1e-13  # of the weight and the largest force on any coordinate: where both balance
MOST_WAYS = 2000  # sets of joints at stops that are tried
FLAT = 1e-9  # of the largest singular value: motions that joints at stops leave


@dataclass(frozen=True)
class Rest:
    """What holds a configuration.

    Attributes
    ----------
    tau : (motors,) array
        N m or N.
    touching : int array
        Coordinates at a stop that they are pushed into.
    idle : int array
        Those at a stop that nothing pushes into it.
    rubs : bool
        Whether the motors alone would not do, and dry friction holds the rest.
    """

    tau: Array
    touching: IntArray
    idle: IntArray
    rubs: bool


def hold(state: Terms, actuation: Actuation, *, rubs: bool) -> Rest:
    """Hold a configuration by its stops and the least torques, shared as in a run, and by friction where these fail.

    Parameters
    ----------
    state : Terms
        At rest, on the closure.
    rubs : bool
        Whether dry friction holds joints at rest.

    Raises
    ------
    InputError
        Nothing holds it.
    NumericalError
        J has lost rank.
    """
    mechanism = state.mechanism
    every, side = motions(state), _side(mechanism, state.q_tree)
    at_stop, refused = np.flatnonzero(side), None
    sets = chain.from_iterable(combinations(at_stop, count) for count in range(len(at_stop), -1, -1))
    for touching in (np.array(some, np.intp) for some in islice(sets, MOST_WAYS)):
        tangent = every @ kernel(every[touching] / mechanism.tree.step_scale[touching, None])
        try:
            tau, friction = _share(state, tangent, actuation, rubs=rubs)
        except InputError as error:
            refused = error
            continue
        left = every.T @ (state.h_tree - mechanism.motors.force(tau) - friction)
        push = -side[touching] * np.linalg.lstsq(every[touching].T, left, rcond=FLAT)[0]
        scale = np.abs(every.T) @ (np.abs(state.h_tree) + np.abs(mechanism.motors.force(tau)))
        if np.all(push > LEFT_OVER * scale.max(initial=0.0)):  # a stop does not pull
            return Rest(tau, touching, np.setdiff1d(at_stop, touching), bool(friction.any()))
    raise refused or InputError(f"{mechanism.name}: too many joints are at stops to tell which of them these hold")


def motions(state: Terms) -> Array:
    """Return a basis of the velocities that the loops allow, (n, d); NumericalError where J has lost rank."""
    try:
        return tangent_basis(state, np.zeros(state.mechanism.closure.rows))[0]
    except NumericalError as error:
        raise NumericalError(LOST_RANK, q_tree=error.q_tree) from None


def unbalanced(state: Terms, u_tree: Array, tangent: Array) -> bool:
    """Whether more than rounding is left of what acts at rest, along a basis of motions."""
    reach, springs = state.mechanism.tree.step_scale, state.mechanism.springs
    sizes = np.abs(state.h_tree) + np.abs(u_tree) + springs.sizes(state.q_tree)
    enough = LEFT_OVER * (np.abs(tangent.T) @ sizes)
    scale = weight(state.mechanism) + float((reach * sizes).max())
    enough += NOTHING * scale * np.abs(tangent / reach[:, None]).max(axis=0, initial=0.0)
    left = np.abs(tangent.T @ (state.h_tree - u_tree))
    return bool(np.any(left > enough + ROUNDING * enough.max(initial=0.0)))


def _side(mechanism: Mechanism, q_tree: Array) -> Array:
    """Return -1 at a joint's lower stop, 1 at its upper one, else 0, by coordinate."""
    joints, numbers = mechanism.joints, mechanism.tree.to_coordinates(q_tree)
    near = AT_STOP * mechanism.tree.step_scale
    return np.where(numbers - joints.lower <= near, -1.0, np.where(joints.upper - numbers <= near, 1.0, 0.0))


def kernel(rows: Array) -> Array:
    """Basis of what rows leave over; the identity without rows."""
    if not len(rows):
        return np.eye(rows.shape[1])
    _, values, directions = np.linalg.svd(rows)
    return np.asarray(directions[int(np.sum(values > FLAT * values[0])) :].T)


def _share(state: Terms, tangent: Array, actuation: Actuation, *, rubs: bool) -> tuple[Array, Array]:
    """Torques of motors, and where these do not do it alone forces of friction, (n,), that hold along a basis."""
    mechanism, none = state.mechanism, np.zeros(state.mechanism.n)
    turns, friction = mechanism.motors.transmission, mechanism.joints.friction
    tau = _least(state, tangent, turns, actuation.limit, actuation.weights, actuation.preload)
    if not unbalanced(state, turns.T @ tau, tangent):
        return tau, none
    rubbing = np.flatnonzero(friction)
    if rubs and len(rubbing):
        forces = _least(
            state,
            tangent,
            np.vstack([turns, np.eye(mechanism.n)[rubbing]]),
            np.concatenate([actuation.limit, friction[rubbing]]),
            np.concatenate([actuation.weights, np.ones(len(rubbing))]),
            np.concatenate([actuation.preload, np.zeros(len(rubbing))]),
        )
        tau, rubbed = forces[: len(tau)], none
        rubbed[rubbing] = forces[len(tau) :]
        if not unbalanced(state, turns.T @ tau + rubbed, tangent):
            return tau, rubbed
    raise InputError(f"{mechanism.name}: {_why_not(state, tangent, actuation)}")


def _least(state: Terms, tangent: Array, turns: Array, limit: Array, weights: Array, preload: Array) -> Array:
    """Forces that hold along what they move at all of a basis, as `allocate` shares them."""
    _, values, directions = np.linalg.svd(turns @ tangent)
    reached = tangent @ directions[: int(np.sum(values > FLAT * values.max(initial=0.0)))].T
    return allocate((turns @ reached).T, reached.T @ state.h_tree, limit, weights, preload)


def _why_not(state: Terms, tangent: Array, actuation: Actuation) -> str:
    mechanism, names = state.mechanism, state.mechanism.actuated
    without_limits = actuation.distribute(tangent, tangent.T @ state.h_tree)
    over = np.abs(without_limits) / np.maximum(actuation.limit, 1e-300)
    motors = f"the motor{'s' if len(names) > 1 else ''} ({', '.join(names)})"
    if not unbalanced(state, mechanism.motors.force(without_limits), tangent):
        k = int(np.argmax(over))
        return (
            f"{motors} cannot hold this configuration within the torque limits: {names[k]} would need "
            f"{abs(without_limits[k]):.4g}, its limit is {actuation.limit[k]:.4g}"
        )
    loose = _loose(mechanism, tangent)
    if not names:
        return (
            f"nothing holds this configuration: it has no motors, and gravity or springs act along {loose}; take "
            "another one or the equilibrium, or give it motors"
        )
    return (
        f"{motors} cannot hold this configuration: nothing holds the motion along {loose}, and gravity or springs act "
        "on it; take another one or the equilibrium, or give it more motors"
    )


def _loose(mechanism: Mechanism, tangent: Array) -> str:
    """Name freedoms that no motor drives, by the coordinates that tell them best."""
    ways, _ = np.linalg.qr(tangent / mechanism.tree.step_scale[:, None])
    loose = ways @ kernel(mechanism.motors.transmission @ (mechanism.tree.step_scale[:, None] * ways))
    own = mechanism.partition.q
    rank = np.linalg.matrix_rank(loose, tol=1e-6)
    first = own if np.linalg.matrix_rank(loose[own], tol=1e-6) == rank else np.arange(mechanism.n)
    return ", ".join(mechanism.coordinates[first[k]] for k in sorted(pivoted_columns(loose[first].T)[0][:rank]))
