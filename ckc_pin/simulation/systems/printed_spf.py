"""Eq. 8 as printed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ckc_pin.dynamics.formulations import CoriolisVelocity, reduced_acceleration, spf_terms, spf_z_dot
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.systems.base import DIFFERENCE, Counts, Force, Rhs, require_chart, spf_velocity

__all__ = ["PrintedSpf"]


@dataclass
class PrintedSpf:
    """Eq. 8 as printed: y = (q, q_dot, z), with phi = w0 at the start."""

    mechanism: Mechanism
    initial: Kinematics
    q_dot: Array
    force: Force
    epsilon: float
    w0: Array
    convention: CoriolisVelocity = "rho"
    counts: Counts = field(default_factory=Counts)
    projects: bool = False
    backend: ClassVar[str] = "python"
    held: ClassVar[int] = 0

    def __post_init__(self) -> None:
        self.positions = self.mechanism.d
        tree, partition = self.mechanism.tree, self.mechanism.partition
        self._d = self.mechanism.d
        self._q, self._z = tree.place[partition.q], tree.place[partition.z]

    def start(self) -> Array:
        q_tree = self.initial.q_tree
        return np.concatenate([q_tree[self._q], self.q_dot, q_tree[self._z]])

    def w(self, t: float) -> Array:
        return self.w0 * np.exp(-t / self.epsilon)

    def w_dot(self, t: float) -> Array:
        return -self.w(t) / self.epsilon

    def velocity(self, t: float, terms: Terms) -> Array:
        # with the exact w: what a tolerance leaves phi off by would be divided by epsilon
        return spf_velocity(terms, self.epsilon, self.w(t))

    def slope(self, t: float, y: Array, f: Array) -> Array:
        z_dot = self.velocity(t, self.terms(t, y))[self.mechanism.partition.z]
        return np.concatenate([f[: 2 * self._d], z_dot])

    def terms(self, t: float, y: Array) -> Terms:
        d = self._d
        q_tree = np.empty(self.mechanism.tree.nq)
        q_tree[self._q], q_tree[self._z] = y[:d], y[2 * d :]
        at = self.mechanism.kinematics(q_tree)
        return spf_terms(self.mechanism, at, y[d : 2 * d], self.epsilon, at.phi, self.convention)

    def configuration(self, t: float, y: Array) -> Array:
        return self.terms(t, y).q_tree

    def rhs(self, t: float, y: Array) -> Array:
        d = self._d
        terms = self.terms(t, y)
        self.counts.factorizations += 2
        q_dot = y[d : 2 * d]
        q_ddot = reduced_acceleration(terms, self.force(t, terms), q_dot if self.convention == "actual" else None)
        return np.concatenate([q_dot, q_ddot, spf_z_dot(terms.at, q_dot, self.epsilon, terms.phi)])

    def jacobian(self, t: float, y: Array, rhs: Rhs) -> Array | None:
        """Forward differences, but exact in what epsilon divides, -phi_z^-1 d phi / epsilon.

        That part would drown the rest in its rounding errors, and SciPy's differences, which shorten their steps
        on it until nothing is left of them.
        """
        d, f, terms = self._d, rhs(t, y), self.terms(t, y)
        phi, rho_z = terms.phi, terms.at.rho[terms.at.partition.z]
        z_dot = spf_z_dot(terms.at, y[d : 2 * d], self.epsilon, phi)
        jacobian = np.empty((len(y), len(y)))
        for k in range(len(y)):
            moved = y.copy()
            moved[k] += DIFFERENCE * max(1.0, abs(float(y[k])))
            step = moved[k] - y[k]
            jacobian[: 2 * d, k] = (rhs(t, moved)[: 2 * d] - f[: 2 * d]) / step
            at = self.terms(t, moved).at
            jacobian[2 * d :, k] = (spf_z_dot(at, moved[d : 2 * d], self.epsilon, phi) - z_dot) / step
        jacobian[2 * d :, :d] += rho_z / self.epsilon
        jacobian[2 * d :, 2 * d :] -= np.eye(len(y) - 2 * d) / self.epsilon
        return jacobian

    def accept(self, t: float, y: Array) -> Array | None:
        require_chart(self.terms(t, y).at)
        return None
