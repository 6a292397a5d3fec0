"""The stable equilibrium that a mechanism falls to, and the Hessian of its potential in q."""

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

STEPS = 300
LONGEST = 0.3  # rad or m along each principal direction of the Hessian
FLAT = 1e-9  # of its largest eigenvalue: nothing to tell from zero
SHORT = 0.25  # of a step: where less of it can be taken, other coordinates are tried
POOR = 10.0  # times further from failing: other coordinates are taken at any rate
SINGULAR = 1e-9  # margin of phi_z below which q is none


def h_gradient(mechanism: Mechanism, at: Kinematics) -> Array:
    """d h / d q of the reduced gravity vector, by the chain rule through sigma, shape (d, d).

    h = rho^T h'. With multipliers phi_z^T y = -h'_z it is h'_q + phi_q^T y, so that along column k of
    rho its derivative is rho^T (dh'/dq' rho_k + Jdot(rho_k)^T y): symmetric, as a Hessian is.
    """
    terms = Terms(mechanism, at, np.zeros(mechanism.n))
    y = at.phi_z_factor.solve_transposed(-terms.h_tree[at.partition.z])
    return at.rho.T @ (_h_tree_gradient(terms) @ at.rho + _multiplier_gradient(terms, y))


def _multiplier_gradient(terms: Terms, y: Array) -> Array:
    """Derivative of J^T y along the columns of rho, y constant: shape (n, d)."""
    steps = terms.at.rho.T
    if not y.any():
        return np.zeros((terms.mechanism.n, len(steps)))
    return np.array([y @ terms.at.J_dot(step) for step in steps]).T


def _h_tree_gradient(terms: Terms) -> Array:
    tree, springs = terms.mechanism.tree, terms.mechanism.springs
    gradient = tree.evaluate(pin.computeGeneralizedGravityDerivatives, terms.q_tree)
    return gradient + springs.elastic_gradient(terms.q_tree) if springs.any else gradient


def stable_equilibrium(mechanism: Mechanism) -> Kinematics:
    """Return the `equilibrium` in the mechanism's own independent coordinates.

    Raises
    ------
    InputError
        The loops constrain a free root in part.
    NumericalError
        There is none, or those coordinates do not determine the others there.
    """
    if mechanism.splits_root:
        raise InputError(f"{mechanism.name}: {CONSTRAINED_IN_PART}")
    at = equilibrium(mechanism)
    own = mechanism.kinematics(at.q_tree)
    if mechanism.d == 0 or own.margin() > SINGULAR:
        return own
    names = ", ".join(mechanism.coordinates[k] for k in at.partition.q)
    raise _none(
        mechanism,
        at,
        f"where it comes to rest, {', '.join(mechanism.independent)} do not determine the other coordinates; take "
        f"independent = {names}",
    )


def equilibrium(mechanism: Mechanism) -> Kinematics:
    """Return the minimum of the potential energy reached from the assembled configuration by descent.

    Newton's steps on h(q) = 0, with the Hessian shifted until it is positive definite and the step
    shortened until the energy falls, on the loops all the way. Where q fails as coordinates the descent goes on in
    others, as a mechanism falls through there, and what is returned is in those.

    Raises
    ------
    NumericalError
        The descent runs into a configuration where the loops lose rank, or does not end.
    """
    terms = Terms(mechanism, mechanism.assembled, np.zeros(mechanism.n))
    scale = 1e-13 * (1.0 + weight(mechanism))
    if mechanism.d == 0:
        return terms.at
    for _ in range(STEPS):
        values, vectors = np.linalg.eigh((hessian := h_gradient(mechanism, terms.at)) / 2 + hessian.T / 2)
        steepest = np.abs(values).max()
        falls_away = values[0] < -FLAT * steepest
        calm = np.abs(terms.h).max() <= scale
        if calm and not falls_away:
            return terms.at
        if calm:  # balanced on a top or a saddle, as an upright start is: off it, either way leads down
            step = 0.1 * vectors[:, 0]
        else:
            wanted = (vectors.T @ terms.h) / np.maximum(np.abs(values), max(FLAT * steepest, 1e-200))
            step = -vectors @ np.clip(wanted, -LONGEST, LONGEST)  # each by itself: a soft direction stops no stiff one
        moved, fraction = _downhill(mechanism, terms, step)
        if moved is None and np.abs(terms.h).max() <= 1e3 * scale and not falls_away:
            return terms.at  # energy differences are rounding here
        other = _other_coordinates(mechanism, moved or terms, 2.0 if fraction < SHORT else POOR)
        if moved is None and other is None:
            raise _none(mechanism, terms.at, "the descent ends where the loops lose rank")
        terms = other or moved or terms
    raise _none(mechanism, terms.at, f"after {STEPS} steps it still falls, as something does that nothing holds")


def _downhill(mechanism: Mechanism, terms: Terms, step: Array) -> tuple[Terms | None, float]:
    """Shorten a step until the potential energy falls, or |h| does where the energy is flat; say how much.

    A step is one of Newton's corrections, not a way that is followed: what cannot be reached at once is not looked for.
    """
    fraction = 1.0
    while fraction > 1e-8:
        closed = newton(predict(terms.at, fraction * step), 0.0, mechanism.tolerance)
        if closed.converged and same_branch(terms.at, closed.at) and closed.at.margin() > SINGULAR:
            trial = Terms(mechanism, closed.at, np.zeros(mechanism.n))
            flat = 1e-14 * abs(terms.potential_energy)
            falls = trial.potential_energy < terms.potential_energy - flat
            calmer = np.abs(trial.h).max() < np.abs(terms.h).max()
            if falls or (calmer and trial.potential_energy <= terms.potential_energy + flat):
                return trial, fraction
        fraction /= 2
    return None, fraction


def _other_coordinates(mechanism: Mechanism, terms: Terms, factor: float) -> Terms | None:
    """Return the same state in the coordinates that are best there; None where they are not better by a factor.

    Of a free root that is held in part those are tangent coordinates of it, some of them dependent.
    """
    best = mechanism.choose_partition(terms.at, keep_roots_together=not mechanism.splits_root)
    if best is None:
        return None
    other = Kinematics(terms.at.tree, terms.at.closure, best, terms.at.q_tree)
    better = other.margin() > max(factor * terms.at.margin(), SINGULAR)
    return Terms(mechanism, other, np.zeros(mechanism.n)) if better else None


def _none(mechanism: Mechanism, at: Kinematics, why: str) -> NumericalError:
    return NumericalError(
        f"{mechanism.name}: no stable equilibrium is reached from q_guess: {why}",
        q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(at.q_tree)),
    )


def weight(mechanism: Mechanism) -> float:
    """Scale of h: what the whole weight does on the arm of the mechanism's size, N m."""
    mass = sum(inertia.mass for inertia in list(mechanism.tree.model.inertias)[1:])
    gravity = float(np.linalg.norm(mechanism.tree.model.gravity.linear))
    return float(mass) * gravity * mechanism.size
