"""Moreau and Jean's time-stepping scheme for closed chains with stops and dry friction: first order, no events.

Each step of length h goes half way, answers the stops that are reached by the impact law, and takes momentum on over h
with friction and contact as bounded impulses; then it goes the other half. Loops are closed at the level of velocities,
which leaves them open by O(h^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from scripts.experiments.fuzz.contact.law import answer_impact, push_within_bounds
from scripts.experiments.fuzz.contact.stops import Contact, contacts_of
from scripts.experiments.fuzz.motion import REDUNDANT, Motion
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import state

__all__ = ["TimeStepping"]

MAX_ROUNDS = 50  # of an impact; what is left then is small beside a step


@dataclass
class TimeStepping:
    """The scheme for one mechanism whose joints have one freedom each."""

    model: Model
    contacts: Mapping[str, Contact]

    def __post_init__(self) -> None:
        self.motion = Motion(self.model)
        self.stops = contacts_of(self.model.labels, self.contacts)
        self.columns = np.array([stop.column for stop in self.stops], int)
        self.signs = np.array([stop.sign for stop in self.stops], float)
        self.limits = np.array([stop.limit for stop in self.stops])
        self.e = np.array([stop.restitution for stop in self.stops])
        self.friction = np.array([self.contacts[x].friction if x in self.contacts else 0.0 for x in self.model.labels])
        self.rubbing = np.flatnonzero(self.friction)
        self.rank: int | None = None

    def run(self, q: Array, v: Array, t_end: float, steps: int, seen: int) -> Array:
        """Coordinates at `seen` instants, evenly spaced, (seen, n)."""
        h, rows = t_end / steps, []
        for k in range(1, steps + 1):
            middle = q + 0.5 * h * v
            v = self.step(middle, v, h)
            q = middle + 0.5 * h * v
            if k % (steps // seen) == 0:
                rows.append(q)
        return np.array(rows)

    def step(self, q: Array, v: Array, h: float) -> Array:
        """The velocity after a step whose middle is q."""
        Y = state(self.model, q[None], v[None])
        H, force, G, *_ = (x[0] for x in self.motion.equations(Y, q[None]))
        Z = np.eye(len(q))
        if len(G):
            _, sv, Vt = np.linalg.svd(G)
            if self.rank is None:
                self.rank = int((sv > REDUNDANT * sv[0]).sum())
            Z = Vt[self.rank :].T
        D = Z.T @ H @ Z
        L = np.linalg.cholesky(D)
        u = np.linalg.solve(D, Z.T @ (H @ v))  # the projection onto what the loops allow here has their bias in it
        reached = self.signs * (q[self.columns] - self.limits) <= 0.0
        N = (self.signs[:, None] * Z[self.columns])[reached]
        pushed = Z.T @ force
        moves = np.linalg.norm(L.T @ u) > 1e-12 * h * np.linalg.norm(np.linalg.solve(L, pushed))
        if reached.any() and moves:
            u = answer_impact(D, N, u, self.e[reached], max_rounds=MAX_ROUNDS).v
        u = u + h * np.linalg.solve(D, pushed)
        rows, most = np.vstack([N, Z[self.rubbing]]), h * self.friction[self.rubbing]
        low, high = np.r_[np.zeros(len(N)), -most], np.r_[np.full(len(N), np.inf), most]
        movable = np.linalg.norm(rows, axis=1) > 1e-9
        u = push_within_bounds(L, rows[movable], u, low[movable], high[movable])
        return np.asarray(Z @ u)
