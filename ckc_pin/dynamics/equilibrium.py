"""The stable equilibrium of a mechanism, found by descent of its potential energy, and the Hessian of the potential."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.continuation import same_branch
from ckc_pin.kinematics.sigma import newton, predict
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism

__all__ = ["equilibrium", "h_gradient", "stable_equilibrium", "weight"]

MAX_STEPS = 300
MAX_DESCENT_STEP = 0.3  # rad or m along each principal direction of the Hessian
ZERO_EIGENVALUE = 1e-9  # of the largest eigenvalue of the Hessian: smaller ones are rounding errors
SHORT_STEP = 0.25  # of a step: if less of it can be taken, better coordinates are used
MARGIN_RATIO_SHORT = 2.0  # by which the margin of other coordinates must be larger after a short step
MARGIN_RATIO = 10.0  # the same after a full step
MIN_MARGIN = 1e-9  # of `Kinematics.margin`: below it q does not determine the configuration
MIN_FRACTION = 1e-8  # of a step


def h_gradient(mechanism: Mechanism, at: Kinematics) -> Array:
    """Return the derivative of the reduced gravity vector h by q, shape (d, d): the Hessian of the potential energy.

    h = rho^T h'. With multipliers y from phi_z^T y = -h'_z it equals h'_q + phi_q^T y. Column k of the derivative is
    therefore rho^T (dh'/dq' rho_k + J_dot(rho_k)^T y).
    """
    terms = Terms(mechanism, at, np.zeros(mechanism.n))
    y = at.phi_z_factor.solve_transposed(-terms.h_tree[at.partition.z])
    return at.rho.T @ (_h_tree_gradient(terms) @ at.rho + _multiplier_gradient(terms, y))


def _multiplier_gradient(terms: Terms, y: Array) -> Array:
    """Return the directional derivatives of J^T y along the columns of rho for constant y, shape (n, d)."""
    steps = terms.at.rho.T
    if not y.any():
        return np.zeros((terms.mechanism.n, len(steps)))
    return np.array([y @ terms.at.J_dot(step) for step in steps]).T


def _h_tree_gradient(terms: Terms) -> Array:
    tree, springs = terms.mechanism.tree, terms.mechanism.springs
    gradient = tree.evaluate(pin.computeGeneralizedGravityDerivatives, terms.q_tree)
    return gradient + springs.elastic_gradient(terms.q_tree) if springs.any else gradient


def stable_equilibrium(mechanism: Mechanism) -> Kinematics:
    """Return the stable equilibrium below q_guess, in the independent coordinates of the mechanism.

    Raises
    ------
    InputError
        The loops constrain a free root in part.
    NumericalError
        No equilibrium was found, or the independent coordinates do not determine the others there.
    """
    if mechanism.splits_root:
        raise InputError(f"{mechanism.name}: {CONSTRAINED_IN_PART}")
    at = equilibrium(mechanism)
    kinematics = mechanism.kinematics(at.q_tree)
    if mechanism.d == 0 or kinematics.margin() > MIN_MARGIN:
        return kinematics
    names = ", ".join(mechanism.coordinates[k] for k in at.partition.q)
    raise _no_equilibrium(
        mechanism,
        at,
        f"where it comes to rest, {', '.join(mechanism.independent)} do not determine the other coordinates; take "
        f"independent = {names}",
    )


def equilibrium(mechanism: Mechanism) -> Kinematics:
    """Return a minimum of the potential energy, by descent from the assembled configuration.

    The descent uses Newton steps on h(q) = 0 with absolute values of the eigenvalues of the Hessian. Each step is
    shortened until the energy decreases, and keeps the loops closed. Where the independent coordinates become
    singular, the descent goes on in other coordinates, and the result is in those.

    Raises
    ------
    NumericalError
        The descent ends where J loses rank, or does not converge.
    """
    terms = Terms(mechanism, mechanism.assembled, np.zeros(mechanism.n))
    scale = 1e-13 * (1.0 + weight(mechanism))
    if mechanism.d == 0:
        return terms.at
    for _ in range(MAX_STEPS):
        values, vectors = np.linalg.eigh((hessian := h_gradient(mechanism, terms.at)) / 2 + hessian.T / 2)
        steepest = np.abs(values).max()
        is_unstable = values[0] < -ZERO_EIGENVALUE * steepest
        is_balanced = np.abs(terms.h).max() <= scale
        if is_balanced and not is_unstable:
            return terms.at
        if is_balanced:  # a maximum or a saddle, such as an upright start: both directions lead down
            step = 0.1 * vectors[:, 0]
        else:
            newton_step = (vectors.T @ terms.h) / np.maximum(np.abs(values), max(ZERO_EIGENVALUE * steepest, 1e-200))
            # Each component is limited separately, so that a soft direction does not shorten steps in stiff ones.
            step = -vectors @ np.clip(newton_step, -MAX_DESCENT_STEP, MAX_DESCENT_STEP)
        moved, fraction = _line_search(mechanism, terms, step)
        if moved is None and np.abs(terms.h).max() <= 1e3 * scale and not is_unstable:
            return terms.at  # differences of the energy are rounding errors here
        ratio = MARGIN_RATIO_SHORT if fraction < SHORT_STEP else MARGIN_RATIO
        other = _change_coordinates(mechanism, moved or terms, ratio)
        if moved is None and other is None:
            raise _no_equilibrium(mechanism, terms.at, "the descent ends where the loops lose rank")
        terms = other or moved or terms
    raise _no_equilibrium(
        mechanism, terms.at, f"after {MAX_STEPS} steps it still falls, so a part of it may be unsupported"
    )


def _line_search(mechanism: Mechanism, terms: Terms, step: Array) -> tuple[Terms | None, float]:
    """Halve a step until the potential energy decreases, or |h| at equal energy. Return terms and fraction of the step.

    A trial configuration is closed by Newton's method alone, without continuation.
    """
    fraction = 1.0
    while fraction > MIN_FRACTION:
        closed = newton(predict(terms.at, fraction * step), 0.0, mechanism.tolerance)
        if closed.converged and same_branch(terms.at, closed.at) and closed.at.margin() > MIN_MARGIN:
            trial = Terms(mechanism, closed.at, np.zeros(mechanism.n))
            rounding = 1e-14 * abs(terms.potential_energy)
            has_less_energy = trial.potential_energy < terms.potential_energy - rounding
            has_less_force = np.abs(trial.h).max() < np.abs(terms.h).max()
            if has_less_energy or (has_less_force and trial.potential_energy <= terms.potential_energy + rounding):
                return trial, fraction
        fraction /= 2
    return None, fraction


def _change_coordinates(mechanism: Mechanism, terms: Terms, ratio: float) -> Terms | None:
    """Return the same state in the best independent coordinates, or None if their margin is not larger by a ratio.

    The coordinates of a free root may be split if the loops constrain the root in part.
    """
    best = mechanism.choose_partition(terms.at, keep_roots_together=not mechanism.splits_root)
    if best is None:
        return None
    other = Kinematics(terms.at.tree, terms.at.closure, best, terms.at.q_tree)
    is_better = other.margin() > max(ratio * terms.at.margin(), MIN_MARGIN)
    return Terms(mechanism, other, np.zeros(mechanism.n)) if is_better else None


def _no_equilibrium(mechanism: Mechanism, at: Kinematics, why: str) -> NumericalError:
    return NumericalError(
        f"{mechanism.name}: no stable equilibrium is reached from q_guess: {why}",
        q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(at.q_tree)),
    )


def weight(mechanism: Mechanism) -> float:
    """Return the scale of h: the weight of the mechanism times its size, N m."""
    mass = sum(inertia.mass for inertia in list(mechanism.tree.model.inertias)[1:])
    gravity = float(np.linalg.norm(mechanism.tree.model.gravity.linear))
    return float(mass) * gravity * mechanism.size
