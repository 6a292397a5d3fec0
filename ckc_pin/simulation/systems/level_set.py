"""The reduced model, eq. 6, on a level set of phi: with w(t) of eq. 17 that is the SPF."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ckc_pin.dynamics.formulations import CoriolisVelocity, reduced_acceleration, spf_terms
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.chart import Chart
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.sigma import newton, sigma
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.systems.base import (
    CHART_MARGIN,
    DIFFERENCE,
    Counts,
    Force,
    Gradient,
    Rhs,
    require_chart,
    spf_velocity,
)
from ckc_pin.simulation.systems.trail import Trail

__all__ = ["LevelSet"]

SWITCH_MARGIN = 0.03  # of |J|: where an uncontrolled run looks for a better q
FALLEN = 0.7  # of the margin at which none was found: where it looks again
POOR = 1e-3  # of |J|: from there on it looks at every step


@dataclass
class LevelSet:
    """The reduced model (w0 = 0), or the SPF in the coordinates of eq. 17 (w0 = phi at the start).

    z is found on the level set by Newton from where the trail of former states leads. A right-hand side may
    be off the level set by `slack`, which an integrator of a given tolerance does not notice.
    With `may_switch` the split into q and z is changed where phi_z comes near to singular; a controller,
    which lives in the mechanism's own q, forbids that.
    """

    mechanism: Mechanism
    initial: Kinematics
    q_dot: Array
    force: Force
    epsilon: float = 1.0
    convention: CoriolisVelocity = "rho"
    w0: Array | None = None
    u_rate_gradient: Gradient | None = None
    may_switch: bool = False
    slack: float = 0.0
    counts: Counts = field(default_factory=Counts)
    backend: ClassVar[str] = "python"
    held: ClassVar[int] = 0

    def __post_init__(self) -> None:
        self._d = self.mechanism.d
        self._on_manifold = self.w0 is None or not np.any(self.w0)
        self._zero = np.zeros(self.mechanism.closure.rows)
        self._start = self._chart_from(self.initial, self.q_dot)
        switched = self._switched(0.0, self._start)  # before a first step, whose error in a bad q nobody would see
        self._start = self._start if switched is None else switched

    @property
    def projects(self) -> bool:
        """A free root among q is charted by rotation vectors, and the chart moves along between steps."""
        return not self._chart.plain

    @property
    def positions(self) -> int:
        return self._d if self._chart.plain else 0

    @property
    def margin(self) -> float:
        """Of |J|: phi_z's least singular value down to which a step is plain."""
        return self._alarm if self.may_switch else CHART_MARGIN

    def _new_trail(self, start: Kinematics) -> Trail:
        return Trail(start, self.epsilon)

    def start(self) -> Array:
        return self._start.copy()

    def w(self, t: float) -> Array:
        """Eq. 17's second line, exact."""
        if self._on_manifold or self.w0 is None:
            return self._zero
        return self.w0 * np.exp(-t / self.epsilon)

    def w_dot(self, t: float) -> Array:
        return -self.w(t) / self.epsilon

    def velocity(self, t: float, terms: Terms) -> Array:
        if self._on_manifold:
            return terms.v_tree
        return spf_velocity(terms, self.epsilon, self.w(t))

    def terms(self, t: float, y: Array) -> Terms:
        return self._terms(t, y, self.mechanism.tolerance)

    def _terms(self, t: float, y: Array, tolerance: float) -> Terms:
        q_dot, w = y[self._d :], self.w(t)
        at = self._close(t, y[: self._d], w, tolerance)
        v_tree = at.rho @ q_dot
        if self._on_manifold:
            self._trail.add(t, at, v_tree, w)
            return Terms(self.mechanism, at, v_tree)
        v_tree[at.partition.z] += at.phi_z_factor.solve(self.w_dot(t))
        self._trail.add(t, at, v_tree, w)
        return spf_terms(self.mechanism, at, q_dot, self.epsilon, w, self.convention)

    def _close(self, t: float, numbers: Array, w: Array, tolerance: float) -> Kinematics:
        """Find z on the level set phi(q, z) = w."""
        outcome = newton(self._trail.predict(t, numbers, self._chart, w), w, tolerance)
        self._count(outcome.iterations)
        if outcome.converged:
            return outcome.at
        last = self._trail.last
        found = sigma(last, self._chart.step(last.q_tree, numbers), w, tolerance, anywhere=False)
        self._count(found.iterations)
        if found.verdict != "converged":
            tree = self.mechanism.tree
            raise NumericalError(
                f"sigma(q) is {found.verdict}: {found.reason}",
                t=t,
                q_tree=tree.named(tree.to_coordinates(found.at.q_tree)),
            )
        return found.at

    def _count(self, iterations: int) -> None:
        self.counts.newton += iterations
        self.counts.factorizations += iterations

    def configuration(self, t: float, y: Array) -> Array:
        return self.terms(t, y).q_tree

    def rhs(self, t: float, y: Array) -> Array:
        terms = self._terms(t, y, max(self.mechanism.tolerance, self.slack))
        self.counts.factorizations += 2  # phi_z and D
        q_dot = y[self._d :]
        with_actual = self.convention == "actual" and not self._on_manifold
        q_ddot = reduced_acceleration(terms, self.force(t, terms), q_dot if with_actual else None)
        return np.concatenate([self._chart.rate(terms.q_tree, q_dot), q_ddot])

    def jacobian(self, t: float, y: Array, rhs: Rhs) -> Array | None:
        """Exact along q_dot, where a closed loop is stiff; forward differences along q."""
        terms = self.terms(t, y)
        gradient = self.u_rate_gradient(t, terms) if self.u_rate_gradient else None
        if gradient is None or not self._chart.plain:
            return None
        d, f = self._d, rhs(t, y)
        # C(x) y = C(y) x, so that d(C q_dot)/d q_dot = 2 C
        gradient = gradient - 2 * terms.C
        if self.mechanism.springs.any_damping:
            gradient -= terms.rho.T @ self.mechanism.springs.damping_matrix(terms.q_tree) @ terms.rho
        jacobian = np.zeros((2 * d, 2 * d))
        jacobian[:d, d:] = np.eye(d)
        jacobian[d:, d:] = terms.D_factor.solve(gradient)
        for k in range(d):
            moved = y.copy()
            moved[k] += DIFFERENCE
            jacobian[d:, k] = (rhs(t, moved)[d:] - f[d:]) / (moved[k] - y[k])
        return jacobian

    def slope(self, t: float, y: Array, f: Array) -> Array:
        return f

    def accept(self, t: float, y: Array) -> Array | None:
        switched = self._switched(t, y)
        if switched is not None:
            return switched
        require_chart(self._trail.last)
        if self._chart.plain:
            return None
        return self._chart_from(self.terms(t, y).at, y[self._d :])

    def _chart_from(self, at: Kinematics, q_dot: Array) -> Array:
        """Start the coordinates anew at a configuration."""
        self._chart = Chart(at.tree, at.partition.q, at.q_tree)
        self._trail = self._new_trail(at)
        self._alarm = SWITCH_MARGIN
        return np.concatenate([self._chart.numbers(at.q_tree), q_dot])

    def _switched(self, t: float, y: Array) -> Array | None:
        """Change the split where phi_z is nearly singular and another is clearly further from it; None to stay.

        Off the manifold eq. 8 is another model in other q (z_dot alone closes the loops), so there it stays.
        """
        at = self._trail.last
        if not self.may_switch or np.abs(self.w(t)).max(initial=0.0) > self.mechanism.tolerance:
            return None
        size = max(float(np.linalg.norm(at.J)), 1e-300)
        margin = at.sigma_min() / size
        if margin >= self._alarm:
            return None
        self._alarm = max(FALLEN * margin, POOR)
        better = self.mechanism.best_partition(at)
        if better is None:
            return None
        terms = self.terms(t, y)
        moved = Kinematics(at.tree, at.closure, better, terms.q_tree)
        if moved.sigma_min() <= 2 * margin * size:
            return None
        self.counts.switches += 1
        return self._chart_from(moved, terms.v_tree[better.q])
