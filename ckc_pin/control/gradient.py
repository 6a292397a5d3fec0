"""What a controller's u depends on: its exact derivatives by q and q_dot, and a closed loop's by both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.derivatives import acceleration_derivatives, multiplier_gradient, tree_force_derivatives
from ckc_pin.dynamics.linearization import reduced
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.tree import Array

__all__ = ["Feedback", "closed_loop", "error_loop", "feedback", "u_gradient"]


@dataclass(frozen=True)
class Feedback:
    """A controller about one state: x_dot = A x + B u, u = K x, x = (q, q_dot), u on the independent coordinates.

    Attributes
    ----------
    A : (2 d, 2 d) array
    B : (2 d, d) array
    K : (d, 2 d) array
    """

    A: Array
    B: Array
    K: Array


def feedback(law: SetPoint | Tracking, t: float, terms: Terms, smoothing: float | None = None) -> Feedback:
    """Linearize plant and controller; `terms` at v' = rho q_dot, phi_z regular. Limits are not in it."""
    mechanism, q = terms.mechanism, terms.at.partition.q
    u_tree = np.zeros(mechanism.n)
    u_tree[q] = law.u(t, terms)
    plant = reduced(terms, acceleration_derivatives(terms, u_tree, smoothing=smoothing))
    return Feedback(plant.A, plant.by_u[:, q], np.hstack(u_gradient(law, t, terms)))


def closed_loop(law: SetPoint | Tracking, t: float, terms: Terms, smoothing: float | None = None) -> Array:
    """Return A of the state (q, q_dot) with a controller in the loop, as `feedback` has them: (2 d, 2 d)."""
    found = feedback(law, t, terms, smoothing)
    return found.A + found.B @ found.K


def error_loop(law: Tracking, t: float, terms: Terms, smoothing: float | None = None) -> Array:
    """Return `closed_loop` of tracking where the motion is as desired, r = 0: (2 d, 2 d).

    With the plant's own terms, D r_dot + (C + K_D) r = 0 is the closed loop, and its derivative; dampers that eq. 16
    does not know take the long way.
    """
    mechanism, d = terms.mechanism, terms.mechanism.d
    if law.model is not None or smoothing is not None or mechanism.springs.any_damping:
        return closed_loop(law, t, terms, smoothing)
    G = terms.D_factor.solve(terms.C + law.K_D)
    return np.block([[np.zeros((d, d)), np.eye(d)], [-G @ law.Lambda, -G - law.Lambda]])


def u_gradient(law: SetPoint | Tracking, t: float, terms: Terms) -> tuple[Array, Array]:
    """Derivatives of a controller's u by q, along sigma, and by q_dot, shape (d, d) each.

    Of eq. 16, C being bilinear in its two velocities, C(x) y = (C(x + y)(x + y) - C(x - y)(x - y)) / 4, so that its
    u is made of inverse dynamics alone.
    """
    if isinstance(law, SetPoint):
        return -law.K_P, -law.K_V
    q_d, q_d_dot, q_d_ddot = law.desired(t)
    v = q_d_dot - law.Lambda @ (terms.q - q_d)
    a = q_d_ddot - law.Lambda @ (terms.q_dot - q_d_dot)
    own, none = law.model(terms) if law.model else terms, np.zeros(len(q_d))
    parts = ((terms.q_dot + v, 4 * a, 0.25), (terms.q_dot - v, none, -0.25), (none, none, 1.0))
    by_q = _inverse_gradient(own, parts)
    return by_q - (own.C + law.K_D) @ law.Lambda, law.u_rate_gradient(t, terms)


def _inverse_gradient(terms: Terms, parts: Sequence[tuple[Array, Array, float]]) -> Array:
    """Derivative by q, along sigma, of the sum of factor (D b + C(x) x + h) over (x, b, factor): (d, d)."""
    mechanism, at = terms.mechanism, terms.at
    rho, z, closure, none = at.rho, at.partition.z, mechanism.closure, np.zeros(mechanism.n)
    on_tree, force = np.zeros((mechanism.n, mechanism.d)), np.zeros(mechanism.n)
    for x, b, factor in parts:
        along = Terms(mechanism, at, rho @ x)
        a_tree = rho @ b + along.rho_dot_times(x)
        opened = closure.acceleration_gradient(at.pose, none, along.v_tree)
        swing = closure.acceleration_gradient(at.pose, along.v_tree, a_tree)
        v_q, a_q = np.zeros((2, mechanism.n, mechanism.d))
        v_q[z] = -at.phi_z_factor.solve(opened @ rho)
        a_q[z] = -at.phi_z_factor.solve(swing @ rho + (along.J_dot + opened) @ v_q)
        by_q, by_v = tree_force_derivatives(along, a_tree, dampers=False)
        on_tree += factor * (by_q @ rho + by_v @ v_q + terms.D_tree @ a_q)
        force += factor * (terms.D_tree @ a_tree + along.bias_tree)
    # rho^T's own change: phi_z^T y = -force_z, as in `h_gradient`
    return rho.T @ (on_tree + multiplier_gradient(terms, at.phi_z_factor.solve_transposed(-force[z]), rho))
