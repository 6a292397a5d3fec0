"""Eq. 1 as a DAE: its closure differentiated twice, position and velocity projected."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pinocchio as pin

from ckc_pin.dynamics.formulations import closing_step, dae_acceleration, dae_rate_gradient, tangent_basis
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.linear import Factorization
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.systems.base import DIFFERENCE, Counts, Force, Gradient, Rhs

__all__ = ["Dae"]

NEGLIGIBLE = 1e-9  # rad, m: Newton's last step onto the closure
WEAK = 1e-3  # of the largest singular value of J: below that a direction is not trusted to close along


@dataclass
class Dae:
    """Eq. 1: y = (q', v'), position and velocity put back on the closure after each step if `projects`.

    Or, after `close_within`, for methods that remember former states: the state is left alone, and put on the closure
    wherever it is evaluated. What is off the closure then has no effect, and does not grow.

    `baumgarte` = (alpha, beta) lets what is off the closure decay instead: phi_ddot + 2 alpha phi_dot + beta^2 phi = 0.
    """

    mechanism: Mechanism
    initial: Kinematics
    v_tree: Array
    force: Force
    projects: bool = True
    baumgarte: tuple[float, float] | None = None
    u_rate_gradient: Gradient | None = None
    counts: Counts = field(default_factory=Counts)
    backend: ClassVar[str] = "python"

    def __post_init__(self) -> None:
        self.positions = self.mechanism.n if self.mechanism.tree.flat else 0
        self.held = 2 * self.mechanism.rank
        self.closes_within = False

    @property
    def closed(self) -> bool:
        """Whether what is read from a state is on the closure, in one way or the other."""
        return self.projects or self.closes_within

    def close_within(self) -> None:
        """Leave the state alone from now on."""
        self.projects, self.closes_within = False, True

    def start(self) -> Array:
        return np.concatenate([self.initial.q_tree, self.v_tree])

    def w(self, t: float) -> Array:
        return np.zeros(self.mechanism.closure.rows)

    def w_dot(self, t: float) -> Array:
        return np.zeros(self.mechanism.closure.rows)

    def velocity(self, t: float, terms: Terms) -> Array:
        return terms.v_tree

    def _split(self, y: Array) -> tuple[Array, Array]:
        tree = self.mechanism.tree
        return (y[: tree.nq] if tree.flat else pin.normalize(tree.model, y[: tree.nq])), y[tree.nq :]

    def terms(self, t: float, y: Array) -> Terms:
        q_tree, v_tree = self._split(y)
        at = self.mechanism.kinematics(q_tree)
        return self._projected(at, v_tree) if self.closed else Terms(self.mechanism, at, v_tree)

    def configuration(self, t: float, y: Array) -> Array:
        return self._split(y)[0]

    def rhs(self, t: float, y: Array) -> Array:
        q_tree, v_tree = self._split(y)
        if self.closes_within:
            terms = self.terms(t, y)
            v_tree = terms.v_tree
        else:
            terms = Terms(self.mechanism, self.mechanism.kinematics(q_tree), v_tree)
        self.counts.factorizations += 2
        rate = self.mechanism.tree.configuration_rate(q_tree, v_tree)
        return np.concatenate([rate, dae_acceleration(terms, self.force(t, terms), self._correction(terms))])

    def _correction(self, terms: Terms) -> Array | float:
        if self.baumgarte is None:
            return 0.0
        alpha, beta = self.baumgarte
        return 2 * alpha * (terms.at.J @ terms.v_tree) + beta**2 * terms.phi

    def jacobian(self, t: float, y: Array, rhs: Rhs) -> Array | None:
        """Exact along v', where a closed loop is stiff; forward differences along the freedoms of q'.

        Across the freedoms nothing changes, in the metric of the inertia in which the closure is kept.
        """
        if not self.closed or not self.mechanism.tree.flat:
            return None
        terms = self.terms(t, y)
        gradient = self.u_rate_gradient(t, terms) if self.u_rate_gradient else None
        if gradient is None:
            return None
        n, q = self.mechanism.n, self.mechanism.partition.q
        u_gradient = np.zeros((n, n))
        u_gradient[np.ix_(q, q)] = gradient
        tangent, _ = tangent_basis(terms, np.zeros(self.mechanism.closure.rows))
        heavy = tangent.T @ terms.D_tree
        along = Factorization(heavy @ tangent).solve(heavy)  # coordinates of a velocity along the freedoms
        f, jacobian = rhs(t, y), np.zeros((2 * n, 2 * n))
        for direction, row in zip(tangent.T, along, strict=True):
            moved = y.copy()
            moved[:n] += DIFFERENCE * direction
            jacobian[:, :n] += np.outer((rhs(t, moved) - f) / DIFFERENCE, row)
        jacobian[:n, n:] = tangent @ along
        jacobian[n:, n:] = dae_rate_gradient(terms, u_gradient) @ tangent @ along
        return jacobian

    def slope(self, t: float, y: Array, f: Array) -> Array:
        return f

    def accept(self, t: float, y: Array) -> Array | None:
        if not self.projects:
            return None
        q_tree, v_tree = self._split(y)
        at = self.mechanism.kinematics(q_tree)
        drift = np.abs(at.phi).max(initial=0.0)
        drift_rate = np.abs(at.J @ v_tree).max(initial=0.0) / (1.0 + np.abs(v_tree).max(initial=0.0))
        if max(drift, drift_rate) <= self.mechanism.tolerance:
            return None
        terms = self._projected(at, v_tree)
        return np.concatenate([terms.q_tree, terms.v_tree])

    def on_closure(self, y: Array) -> Array:
        """Return y put on the closure to rounding, along every direction, however weakly J determines it.

        Within the tolerance of a projection an error off the closure would stay, and be divided by J's
        least singular value in the acceleration.
        """
        q_tree, v_tree = self._split(y)
        at = self.mechanism.kinematics(q_tree)
        for _ in range(10):
            step = self._shortest(at, at.phi)
            at = at.moved(step)
            if np.abs(step).max() <= NEGLIGIBLE:  # what is left is its square
                return np.concatenate([at.q_tree, v_tree + self._shortest(at, at.J @ v_tree)])
        raise NumericalError("projection onto the closure did not converge: J is nearly singular here")

    def rates_on_closure(self, times: Array, states: Array) -> Array:
        """Return y' at each instant and row of states, put on the closure first; NaN where it does not exist."""
        rates = np.full_like(states, np.nan)
        for k, (t, y) in enumerate(zip(times.tolist(), states, strict=True)):
            with suppress(NumericalError):
                rates[k] = self.rhs(t, self.on_closure(y))
        return rates

    def _shortest(self, at: Kinematics, residual: Array) -> Array:
        self.counts.factorizations += 1
        tangent, some = tangent_basis(Terms(self.mechanism, at, residual), residual)
        return some - tangent @ Factorization(tangent.T @ tangent).solve(tangent.T @ some)

    def _projected(self, at: Kinematics, v_tree: Array) -> Terms:
        """Put a state on the closure by the shortest steps in the metric of the inertia.

        That is the correction with the least work on the motion: its velocity part does not change the
        momentum along the allowed directions, so the energy drifts less than with steps in coordinates.
        """
        for _ in range(10):
            if np.abs(at.phi).max(initial=0.0) <= self.mechanism.tolerance:
                break
            step = self._closing(Terms(self.mechanism, at, v_tree), at.phi)
            self.counts.newton += 1
            self.counts.factorizations += 2
            closed = float(np.abs(at.J @ step).max()) <= self.mechanism.tolerance  # what else remains, rows contradict
            at = at.moved(step)
            if closed:
                break
        else:
            raise NumericalError("projection onto the closure did not converge: J is nearly singular here")
        correction = self._closing(Terms(self.mechanism, at, v_tree), at.J @ v_tree)
        return Terms(self.mechanism, at, v_tree + correction)

    def _closing(self, terms: Terms, residual: Array) -> Array:
        """Close in the metric of the inertia; near a rank loss only along the directions that J determines."""
        values = np.linalg.svd(terms.at.J, compute_uv=False)
        if self.mechanism.rank and values[self.mechanism.rank - 1] < WEAK * values[0]:
            return -np.asarray(np.linalg.lstsq(terms.at.J, residual, rcond=WEAK)[0], dtype=float)
        return closing_step(terms, residual)
