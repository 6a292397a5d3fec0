"""Reference implementation of the impact law with NumPy and SciPy: reflections with Newton's restitution.

An impact is computed in rounds. All approaching stops (gap velocity < 0) are reflected together,

    v+ = v_p - e v_o,   v_p = projection of v- onto {gap velocities >= 0} in the metric of D,   v_o = v- - v_p.

Stops are reflected in groups of equal restitution, the smallest restitution first. The cone of a group also includes
resting stops (gap velocity 0) with e = 0, and all resting stops if the group has e = 0. Rounds are repeated until no
stop approaches.
By Moreau's decomposition v_p and v_o are orthogonal in the metric of D, so a reflection loses (1 - e^2)/2 |v_o|^2 >= 0.
Friction has no impulse.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear, nnls

from scripts.experiments.fuzz.spatial import Array

__all__ = ["Impact", "apply_impact_law", "minimize_energy_with_bounds", "project"]

MAX_ROUNDS = 500
ROUNDING = 1e-12  # relative to |v|_D; smaller gap velocities are zero
DOUBTFUL = 1e-9  # relative to |v|_D; smaller gap velocities may count as zero or as approaching


@dataclass
class Impact:
    """Result of an impact: velocity after it, energy lost, stops that were hit, and whether the result is certain."""

    v: Array
    lost: float = 0.0
    hit: set[int] = field(default_factory=set)
    certain: bool = True


def project(L: Array, N: Array, v: Array) -> tuple[Array, Array]:
    """Project v onto {N v >= 0} in the metric of D = L L^T; return the projection and the residual."""
    G = np.linalg.solve(L, N.T)
    size = float(np.linalg.norm(L.T @ v))
    if size == 0.0 or not len(N):
        return v, np.zeros_like(v)
    scale = np.linalg.norm(G, axis=0)
    impulses, _ = nnls(G / scale, -(L.T @ v) / size, maxiter=100 * (len(N) + 1))
    outward = np.linalg.solve(L.T, (G / scale) @ impulses * size)
    return v + outward, -outward


def apply_impact_law(
    D: Array, N: Array, v: Array, e: Array, *, rechoose: bool = False, max_rounds: int = MAX_ROUNDS
) -> Impact:
    """Apply the impact law to closed stops with Jacobian N (stops, n) of their gap velocities and restitutions e.

    `rechoose`: select the approaching stops again before each group of a round, not once for a round. The law allows
    both. After `max_rounds` the velocity is projected onto the cone, and the result is not certain.
    """
    L = np.asarray(np.linalg.cholesky(D), float)
    out = Impact(v.copy())
    weight: Array = np.linalg.norm(np.linalg.solve(L, N.T), axis=0)
    for _ in range(max_rounds):
        fine = ROUNDING * float(np.linalg.norm(L.T @ out.v)) * weight
        speeds = N @ out.v
        approaching = speeds < -fine
        out.certain &= not np.any((speeds < -fine) & (speeds > -fine * DOUBTFUL / ROUNDING))
        if not approaching.any():
            return out
        groups = np.unique(e[approaching])
        for restitution in groups[:1] if rechoose else groups:
            members = approaching & (e == restitution)
            cone = members | ((np.abs(N @ out.v) <= fine) & ((e == 0) | (restitution == 0)))
            nearest, outward = project(L, N[cone], out.v)
            out.v = nearest - restitution * outward
            out.lost += 0.5 * (1 - restitution**2) * float(np.sum((L.T @ outward) ** 2))
            out.hit |= set(np.flatnonzero(members).tolist())
    speeds = N @ out.v
    nearest, outward = project(L, N, out.v)
    out.lost += 0.5 * float(np.sum((L.T @ outward) ** 2))
    out.v, out.certain = nearest, False
    return out


def minimize_energy_with_bounds(L: Array, rows: Array, u: Array, low: Array, high: Array) -> Array:
    """Add bounded impulses along rows that minimize the energy of u in the metric of D = L L^T.

    If u is an acceleration, `low` and `high` are bounds of forces (Gauss' principle).
    """
    if not len(rows):
        return u
    roots, target = np.linalg.solve(L, rows.T), L.T @ u
    scale, size = np.linalg.norm(roots, axis=0), max(float(np.linalg.norm(target)), 1e-300)
    bounds = (low * scale / size, high * scale / size)
    impulses = lsq_linear(roots / scale, -target / size, bounds, "bvls", tol=1e-15).x
    return np.asarray(np.linalg.solve(L.T, target + roots / scale @ impulses * size))
