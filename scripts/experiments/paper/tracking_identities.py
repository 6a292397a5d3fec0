"""Check the assumptions of eq. 19: skew-symmetry of D_dot - 2 C, and the algebra of the gains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.formulations import spf_z_dot
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.certificate.branch_walk import follow, margin

__all__ = ["Skewness", "claimed_form", "defect", "printed_form", "rate_form", "skewness"]

TRIES = 50  # attempts per state
STEP = 1e-4  # rad or m along a unit velocity: step of the differences for D_dot
MIN_RELATIVE_MARGIN = 0.3  # smallest |s| over the assembled |s|; differences are inaccurate near singular ones


@dataclass(frozen=True)
class Skewness:
    """Largest |S + S^T| of S = D_dot - 2 C over random states, relative to the largest entry of D_dot.

    Attributes
    ----------
    on : float
        On phi = 0, where both conventions are equal.
    off_rho_rho : float
        Off the manifold, D_dot along rho q_dot (on the level set) and C at rho q_dot.
    off_actual_rho : float
        Off the manifold, D_dot along the SPF's actual velocity and C at rho q_dot (eq. 8).
    off_actual_actual : float
        Off the manifold, D_dot and C both at the actual velocity (eq. 16).
    states : int
        Number of states far enough from singular configurations.
    """

    on: float
    off_rho_rho: float
    off_actual_rho: float
    off_actual_actual: float
    states: int


def skewness(mechanism: Mechanism, count: int, epsilon: float, off: float = 0.02, seed: int = 0) -> Skewness:
    """Measure the skew-symmetry of D_dot - 2 C at random states, with D_dot by differences of D.

    Parameters
    ----------
    mechanism : Mechanism
    count : int
        Number of states.
    epsilon : float
        Epsilon of the SPF.
    off : float
        Displacement of z off the constraint manifold, rad or m.
    seed : int
    """
    random = np.random.default_rng(seed)
    worst, states, smallest = np.zeros(4), 0, MIN_RELATIVE_MARGIN * margin(mechanism.assembled)
    for _ in range(TRIES * count):
        if states == count:
            break
        at, _ = follow(mechanism, mechanism.assembled, random.uniform(-1, 1, mechanism.d))
        away = np.zeros(mechanism.n)
        away[at.partition.z] = random.uniform(-off, off, mechanism.n - mechanism.d)
        moved = at.integrate(away)
        if min(margin(at), margin(moved)) < smallest:
            continue
        states += 1
        q_dot = random.uniform(-2, 2, mechanism.d)
        level, actual = moved.rho @ q_dot, moved.rho @ q_dot
        actual[moved.partition.z] = spf_z_dot(moved, q_dot, epsilon, moved.phi)
        pairs = ((at, at.rho @ q_dot, at.rho @ q_dot), (moved, level, level), (moved, actual, level),
                 (moved, actual, actual))  # fmt: skip
        worst = np.maximum(worst, [defect(mechanism, *pair) for pair in pairs])
    on, rho_rho, actual_rho, actual_actual = (float(x) for x in worst)
    return Skewness(on, rho_rho, actual_rho, actual_actual, states)


def defect(mechanism: Mechanism, at: Kinematics, along: Array, at_velocity: Array) -> float:
    speed = float(np.linalg.norm(along))

    def D(distance: float) -> Array:
        return Terms(mechanism, at.integrate(distance / speed * along), np.zeros(mechanism.n)).D

    D_dot = (8 * (D(STEP) - D(-STEP)) - (D(2 * STEP) - D(-2 * STEP))) / (12 * STEP / speed)
    S = D_dot - 2 * Terms(mechanism, at, at_velocity).C
    return float(np.abs(S + S.T).max() / np.abs(D_dot).max())


def rate_form(Lambda: Array, K_D: Array) -> Array:
    """Return the symmetric (2 d, 2 d) matrix of -dV_1/dt in (q_tilde, q_tilde_dot) along eq. 17.

    With D_dot - 2 C skew and d_1 = 1, dV_1/dt = -r^T K_D r + q_tilde_dot^T (A + A^T) q_tilde with A = Lambda^T K_D.
    """
    A = Lambda.T @ K_D
    r = np.hstack([Lambda, np.eye(len(K_D))])
    return _symmetric(r.T @ K_D @ r - _cross(A + A.T))


def claimed_form(Lambda: Array, K_D: Array) -> Array:
    """Return the form of eq. 19's last line, q_tilde_dot^T K_D q_tilde_dot + q_tilde^T Lambda^T K_D Lambda q_tilde."""
    zero = np.zeros_like(K_D)
    return _symmetric(np.block([[Lambda.T @ K_D @ Lambda, zero], [zero, K_D]]))


def printed_form(Lambda: Array, K_D: Array) -> Array:
    """Return the matrix of eq. 19's first line as printed, with -2 q_tilde_dot^T Lambda K_D q_tilde."""
    r = np.hstack([Lambda, np.eye(len(K_D))])
    return _symmetric(r.T @ K_D @ r + _cross(2 * Lambda @ K_D))


def _cross(X: Array) -> Array:
    """Return the matrix of the form q_tilde_dot^T X q_tilde."""
    zero = np.zeros_like(X)
    return np.block([[zero, zero], [X, zero]])


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2
