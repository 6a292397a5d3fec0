"""How motors share a force on the freedoms: the small box QP that the native core solves too, to be read."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array

__all__ = ["allocate", "minimum_norm_torques"]

ROUNDING = 1e-13  # of u, scaled: what a tau may miss it by
FLAT = 1e-12  # of the dual's largest curvature: a direction in which it has none
GIVES = 1e-7  # of that curvature: give, where u is out of reach
SETTLED = 1e-6  # how far from 1 the length of Newton's last step is
MOST = 50  # steps; random problems take at most 10


def allocate(transmission: Array, u: Array, limit: Array, weights: Array, preload: Array) -> Array:
    """Return the tau with u = transmission tau that is nearest to a preload, within limits.

    Where the limits leave no such tau, what u is missed by has a price, rows measured by what one unit of all motors
    does in them: sum weights (tau - preload)^2 + |miss|^2 / give is least. So what the motors do together hardly jumps
    where u goes out of reach, mostly by less than 1e-5 of it.

    Parameters
    ----------
    transmission : (d, m) array
    u : (d,) array
    limit, weights, preload : (m,) arrays
        Nearest is what makes sum weights (tau - preload)^2 least; |tau| <= limit, which may be infinite.
    """
    tau = preload + minimum_norm_torques(transmission, u - transmission @ preload, weights)
    if np.any(np.abs(tau) > limit):
        found = None
        for give in (0.0, GIVES) if np.ptp(transmission.shape) else ():
            if found is None:
                found = _within_limits(transmission, u, limit, weights, preload, give)
        tau = np.clip(tau, -limit, limit) if found is None else found
    return np.asarray(tau, dtype=float)


def minimum_norm_torques(transmission: Array, u: Array, weights: Array) -> Array:
    """Return the tau with u = transmission tau, or as nearly as can be, whose sum of weights tau^2 is least."""
    scale = 1.0 / np.sqrt(weights)
    return np.asarray(scale * np.linalg.lstsq(transmission * scale, u, rcond=1e-9)[0], dtype=float)


def _within_limits(
    transmission: Array, u: Array, limit: Array, weights: Array, preload: Array, give: float
) -> Array | None:
    """Maximise the dual, tau(x) = clip(preload + transmission^T x / weights), by Newton's method; None: infeasible.

    The dual is concave and piecewise quadratic: with an exact line search that ends after finitely many steps. With
    `give`, of its largest curvature, u may be missed, at a price of the miss squared by `give`.
    """
    rows = 1.0 / np.maximum(np.linalg.norm(transmission, axis=1), 1e-300)  # free of units
    T, u = transmission * rows[:, None], u * rows
    sizes = np.linalg.norm(T, axis=0)
    limited = np.isfinite(limit)
    size = float(np.linalg.norm(u) + limit[limited] @ sizes[limited])
    steepest = float((sizes**2 / weights).sum())
    give *= steepest
    x, settled = np.zeros(len(u)), None
    for _ in range(MOST):
        raw = preload + T.T @ x / weights
        tau = np.clip(raw, -limit, limit)
        rest = u - T @ tau - give * x
        free = np.abs(raw) < limit
        solved = bool(np.linalg.norm(rest) <= ROUNDING * size)
        if solved or (settled is not None and np.array_equal(free, settled)):
            return np.asarray(tau)
        pull, size_x = np.abs(T.T @ x), float(np.linalg.norm(x))
        bounded = not give and not np.any(pull[~limited] > ROUNDING * size_x * sizes[~limited])
        if size_x and bounded and x @ u > limit[limited] @ pull[limited] + ROUNDING * size * size_x:
            return None  # what x weighs in u is more than all motors together can do (Farkas)
        curvatures, axes = np.linalg.eigh((T[:, free] / weights[free]) @ T[:, free].T)
        flat = curvatures <= FLAT * steepest
        parts = axes.T @ rest
        if give:
            direction = axes @ (parts / (curvatures + give))
        elif np.linalg.norm(parts[flat]) > ROUNDING * size:
            direction = axes[:, flat] @ parts[flat]
        else:
            direction = axes[:, ~flat] @ (parts[~flat] / curvatures[~flat])
        bent = give * float(direction @ direction)
        length = _along(raw, T.T @ direction / weights, limit, weights, float(direction @ rest), bent)
        if not np.isfinite(length):
            return None
        x = x + length * direction
        settled = free if give and abs(length - 1.0) < SETTLED else None
    return None


def _along(raw: Array, slope: Array, limit: Array, weights: Array, rise: float, bent: float) -> float:
    """Return where along a direction the dual is largest: its slope falls by w slope^2 for each motor within limits."""
    enters, leaves = np.zeros(len(raw)), np.where(slope == 0.0, 0.0, np.inf)
    k = np.flatnonzero((slope != 0.0) & np.isfinite(limit))
    ends = np.sort([(-limit[k] - raw[k]) / slope[k], (limit[k] - raw[k]) / slope[k]], axis=0)
    enters[k], leaves[k] = np.maximum(ends, 0.0)
    at = 0.0
    for end in [*np.sort(np.maximum(ends, 0.0), axis=None), np.inf]:
        if not end > at:
            continue
        bend = bent + float((weights * slope**2)[(enters <= at) & (leaves > at)].sum())
        if bend > 0.0 and rise <= bend * (end - at):
            return at + rise / bend
        rise -= bend * (end - at) if bend > 0.0 else 0.0
        at = float(end)
    return np.inf
