"""Moreau-Jean time-stepping scheme for closed chains with stops and dry friction. It is of first order, without events.

A step of size h moves by h/2, applies the impact law at the stops that are reached, updates the velocities over h with
friction and contact as bounded impulses, and moves by another h/2. Loops are closed for velocities, so positions open
by O(h^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from scripts.experiments.fuzz.contact.law import apply_impact_law, minimize_energy_with_bounds
from scripts.experiments.fuzz.contact.stops import Contact, list_joint_stops
from scripts.experiments.fuzz.newton_euler import RANK_TOLERANCE, NewtonEuler
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import to_state

__all__ = ["TimeStepping"]

MAX_ROUNDS = 50  # of an impact; the remaining approach velocities are negligible in a step


@dataclass
class TimeStepping:
    """The scheme for one mechanism whose joints have one freedom each."""

    model: Model
    contacts: Mapping[str, Contact]

    def __post_init__(self) -> None:
        self.dynamics = NewtonEuler(self.model)
        self.stops = list_joint_stops(self.model.labels, self.contacts)
        self.columns = np.array([stop.column for stop in self.stops], int)
        self.signs = np.array([stop.sign for stop in self.stops], float)
        self.limits = np.array([stop.limit for stop in self.stops])
        self.e = np.array([stop.restitution for stop in self.stops])
        self.friction = np.array([self.contacts[x].friction if x in self.contacts else 0.0 for x in self.model.labels])
        self.rubbing = np.flatnonzero(self.friction)
        self.rank: int | None = None

    def run(self, q: Array, v: Array, t_end: float, steps: int, instants: int) -> Array:
        """Return coordinates at evenly spaced instants, (instants, n)."""
        h, rows = t_end / steps, []
        for k in range(1, steps + 1):
            middle = q + 0.5 * h * v
            v = self.step(middle, v, h)
            q = middle + 0.5 * h * v
            if k % (steps // instants) == 0:
                rows.append(q)
        return np.array(rows)

    def step(self, q: Array, v: Array, h: float) -> Array:
        """Return the velocity after a step with midpoint q."""
        Y = to_state(self.model, q[None], v[None])
        H, force, G, *_ = (x[0] for x in self.dynamics.compute_equations(Y, q[None]))
        Z = np.eye(len(q))
        if len(G):
            _, sv, Vt = np.linalg.svd(G)
            if self.rank is None:
                self.rank = int((sv > RANK_TOLERANCE * sv[0]).sum())
            Z = Vt[self.rank :].T
        D = Z.T @ H @ Z
        L = np.linalg.cholesky(D)
        u = np.linalg.solve(D, Z.T @ (H @ v))  # this projection includes the bias of the loops
        reached = self.signs * (q[self.columns] - self.limits) <= 0.0
        N = (self.signs[:, None] * Z[self.columns])[reached]
        generalized_force = Z.T @ force
        is_moving = np.linalg.norm(L.T @ u) > 1e-12 * h * np.linalg.norm(np.linalg.solve(L, generalized_force))
        if reached.any() and is_moving:
            u = apply_impact_law(D, N, u, self.e[reached], max_rounds=MAX_ROUNDS).v
        u = u + h * np.linalg.solve(D, generalized_force)
        rows, max_friction = np.vstack([N, Z[self.rubbing]]), h * self.friction[self.rubbing]
        low, high = np.r_[np.zeros(len(N)), -max_friction], np.r_[np.full(len(N), np.inf), max_friction]
        movable = np.linalg.norm(rows, axis=1) > 1e-9
        u = minimize_energy_with_bounds(L, rows[movable], u, low[movable], high[movable])
        return np.asarray(Z @ u)
