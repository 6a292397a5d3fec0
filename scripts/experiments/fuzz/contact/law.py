"""The impact law as a reference: generalized reflections with Newton's restitution, in NumPy and SciPy alone.

One instant is answered in rounds. All stops that approach (gap velocity < 0) are reflected together,

    v+ = v_p - e v_o,   v_p = projection of v- onto {gap velocities >= 0} in the metric of D,   v_o = v- - v_p.

Where their restitutions differ, the group with the smallest one is a round of its own. Stops that rest (gap velocity 0)
belong to the cone too where they do not throw back: those with e = 0 in every round, all of them in a round with e = 0.
Rounds follow until no stop approaches.
By Moreau's decomposition v_p and v_o are orthogonal in the metric of D, so a reflection loses (1 - e^2)/2 |v_o|^2 >= 0.
Friction has no impulse.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear, nnls

from scripts.experiments.fuzz.spatial import Array

__all__ = ["Impact", "answer_impact", "project", "push_within_bounds"]

MAX_ROUNDS = 500
ROUNDING = 1e-12  # of |v|_D: slower gap velocities are zero
DOUBTFUL = 1e-9  # of |v|_D: slower ones may count as zero or as an approach


@dataclass
class Impact:
    """The answer to one instant: velocity after it, energy lost, which stops were hit, and whether it is certain."""

    v: Array
    lost: float = 0.0
    hit: set[int] = field(default_factory=set)
    certain: bool = True


def project(L: Array, N: Array, v: Array) -> tuple[Array, Array]:
    """Project v onto {N v >= 0} in the metric of D = L L^T; return the projection and the rest of v."""
    G = np.linalg.solve(L, N.T)
    size = float(np.linalg.norm(L.T @ v))
    if size == 0.0 or not len(N):
        return v, np.zeros_like(v)
    scale = np.linalg.norm(G, axis=0)
    impulses, _ = nnls(G / scale, -(L.T @ v) / size, maxiter=100 * (len(N) + 1))
    outward = np.linalg.solve(L.T, (G / scale) @ impulses * size)
    return v + outward, -outward


def answer_impact(
    D: Array, N: Array, v: Array, e: Array, *, rechoose: bool = False, max_rounds: int = MAX_ROUNDS
) -> Impact:
    """Apply the law to the stops with gap zero: N (stops, n) are their gap velocities' rows, e their restitutions.

    `rechoose`: the stops of a round's later groups are those that approach when their turn comes. Otherwise they are
    those that approached when the round began. The law leaves this open, and both readings lose energy alike. After
    `max_rounds` the projection ends it, and the answer is not certain.
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


def push_within_bounds(L: Array, rows: Array, u: Array, low: Array, high: Array) -> Array:
    """Add impulses along rows (or forces, u an acceleration) that leave the least energy, D = L L^T, within bounds."""
    if not len(rows):
        return u
    roots, target = np.linalg.solve(L, rows.T), L.T @ u
    scale, size = np.linalg.norm(roots, axis=0), max(float(np.linalg.norm(target)), 1e-300)
    bounds = (low * scale / size, high * scale / size)
    impulses = lsq_linear(roots / scale, -target / size, bounds, "bvls", tol=1e-15).x
    return np.asarray(np.linalg.solve(L.T, target + roots / scale @ impulses * size))
