"""The three formulations as first-order systems y' = f(t, y) for an integrator.

============== ==================== =====================================================
system         y                    equations
============== ==================== =====================================================
`LevelSet`     q, q_dot             eq. 6 on the level set phi = w(0) exp(-t / epsilon): with
                                    w(0) = 0 the reduced model, else the SPF in eq. 17's
                                    coordinates, whose w is known in closed form
`PrintedSpf`   q, q_dot, z          eq. 8 as printed
`Dae`          q', v'               eq. 1, its closure differentiated twice, projected
============== ==================== =====================================================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import pinocchio as pin

from ckc_pin.dynamics.formulations import (
    CoriolisVelocity,
    closing_step,
    dae_acceleration,
    reduced_acceleration,
    spf_terms,
    spf_z_dot,
)
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.chart import Chart
from ckc_pin.mechanism.kinematics import Kinematics, Partition
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rank import choose_dependent, scaled
from ckc_pin.mechanism.sigma import newton, predict, sigma
from ckc_pin.mechanism.tree import Array

__all__ = ["Counts", "Dae", "Force", "LevelSet", "PrintedSpf", "System", "nearly_singular"]

Gradient = Callable[[float, Terms], Array | None]  # d u / d q_dot at (t, terms); None where it is not known
Rhs = Callable[[float, Array], Array]

WEAK = 1e-3  # of the largest singular value of J: below that a direction is not trusted to close along
DIFFERENCE = 1.5e-8  # step of forward differences, rad or m
SWITCH_MARGIN = 0.03  # of |J|: where an uncontrolled run looks for a better q
CHART_MARGIN = 1e-5  # of |J|: phi_z's least singular value at which q has stopped to be a chart

Force = Callable[[float, Terms], Array]  # u' on the tree at (t, terms)


@dataclass
class Counts:
    """Work done by a system: Newton corrections, factorizations, changes of the partition."""

    newton: int = 0
    factorizations: int = 0
    switches: int = 0


class System(Protocol):
    """What the step loop needs of a formulation.

    Attributes
    ----------
    positions : int
        How many leading entries of y are positions whose rates are the next as many; 0 when they are not.
    projects : bool
        Whether `accept` edits the state.
    passes_rank_loss : bool
        Whether the motion can be followed where J loses rank.
    """

    mechanism: Mechanism
    counts: Counts

    @property
    def positions(self) -> int: ...

    @property
    def projects(self) -> bool: ...

    @property
    def passes_rank_loss(self) -> bool: ...

    def start(self) -> Array:
        """Initial y."""

    def rhs(self, t: float, y: Array) -> Array:
        """f(t, y); NumericalError where it does not exist."""

    def terms(self, t: float, y: Array) -> Terms:
        """Terms at a state, on the closure if the formulation holds it."""

    def configuration(self, t: float, y: Array) -> Array:
        """Pinocchio's q at a state, as near as it is known without closing the loops, shape (nq,)."""

    def accept(self, t: float, y: Array) -> Array | None:
        """Take note of an accepted step; return y projected, or None when it stays as it is."""

    def jacobian(self, t: float, y: Array, rhs: Rhs) -> Array | None:
        """d rhs / d y, shape (len(y), len(y)); None when nothing is known that differences would not find."""

    def velocity(self, t: float, terms: Terms) -> Array:
        """The velocity of the tree, shape (n,); off the manifold the SPF's z_dot differs from rho_z q_dot."""

    def w(self, t: float) -> Array:
        """What phi should be at t, shape (rows,)."""

    def w_dot(self, t: float) -> Array:
        """What its rate should be, shape (rows,)."""


@dataclass
class LevelSet:
    """The reduced model (w0 = 0), or the SPF in the coordinates of eq. 17 (w0 = phi at the start).

    z is found on the level set by Newton from where the last evaluated state, moved along rho, leads.
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
    counts: Counts = field(default_factory=Counts)
    passes_rank_loss: bool = False
    projects: bool = False

    def __post_init__(self) -> None:
        tree = self.mechanism.tree
        self._last = self.initial
        self._d = self.mechanism.d
        self._on_manifold = self.w0 is None or not np.any(self.w0)
        self._zero = np.zeros(self.mechanism.closure.rows)
        self._chart = Chart(tree, self.mechanism.partition.q, self.initial.q_tree)
        # a free root among q is charted by rotation vectors, and the chart moves along between steps
        self.projects = not self._chart.plain
        self.positions = self._d if self._chart.plain else 0

    def start(self) -> Array:
        return np.concatenate([self._chart.numbers(self.initial.q_tree), self.q_dot])

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
        return _spf_velocity(terms, self.epsilon, self.w(t))

    def terms(self, t: float, y: Array) -> Terms:
        q_dot, w = y[self._d :], self.w(t)
        dq = self._chart.step(self._last.q_tree, y[: self._d])
        guess = predict(self._last, dq)
        outcome = newton(guess, w, self.mechanism.tolerance)
        self.counts.newton += outcome.iterations
        self.counts.factorizations += outcome.iterations
        if not outcome.converged:
            found = sigma(self._last, dq, w, self.mechanism.tolerance, anywhere=False)
            self.counts.newton += found.iterations
            self.counts.factorizations += found.iterations
            if found.verdict != "converged":
                raise NumericalError(
                    f"sigma(q) is {found.verdict}: {found.reason}",
                    t=t,
                    q_tree=self.mechanism.tree.named(self.mechanism.tree.to_coordinates(found.at.q_tree)),
                )
            outcome = type(outcome)(found.at, found.iterations, True)
        self._last = outcome.at
        if self._on_manifold:
            return Terms(self.mechanism, outcome.at, outcome.at.rho @ q_dot)
        return spf_terms(self.mechanism, outcome.at, q_dot, self.epsilon, w, self.convention)

    def configuration(self, t: float, y: Array) -> Array:
        return self.terms(t, y).q_tree

    def rhs(self, t: float, y: Array) -> Array:
        terms = self.terms(t, y)
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

    def accept(self, t: float, y: Array) -> Array | None:
        margin = self._last.sigma_min() / max(float(np.linalg.norm(self._last.J)), 1e-300)
        if margin < SWITCH_MARGIN and self.may_switch:
            better = self._better_partition(margin)
            if better is not None:
                terms = self.terms(t, y)
                self._last = Kinematics(terms.at.tree, terms.at.closure, better, terms.q_tree)
                self._chart = Chart(terms.at.tree, better.q, terms.q_tree)
                self.counts.switches += 1
                return np.concatenate([self._chart.numbers(terms.q_tree), terms.v_tree[better.q]])
        _require_chart(self._last)
        if self._chart.plain:
            return None
        q_tree = self.terms(t, y).q_tree
        self._chart = Chart(self.mechanism.tree, self._last.partition.q, q_tree)
        return np.concatenate([self._chart.numbers(q_tree), y[self._d :]])

    def _better_partition(self, margin: float) -> Partition | None:
        """Return a split whose phi_z is clearly further from singular here, if there is one."""
        tree, closure, at = self.mechanism.tree, self.mechanism.closure, self._last
        jacobian = scaled(at.J, tree, closure, self.mechanism.size)
        z = choose_dependent(jacobian, self.mechanism.rank, [np.arange(v, v + 6) for _, v in tree.free])
        if z is None:
            return None
        split = Partition(np.setdiff1d(np.arange(tree.n), z), z)
        gained = Kinematics(tree, closure, split, at.q_tree).sigma_min() / float(np.linalg.norm(at.J))
        return split if gained > 2 * margin else None


@dataclass
class PrintedSpf:
    """Eq. 8 as printed: y = (q, q_dot, z)."""

    mechanism: Mechanism
    initial: Kinematics
    q_dot: Array
    force: Force
    epsilon: float
    convention: CoriolisVelocity = "rho"
    counts: Counts = field(default_factory=Counts)
    passes_rank_loss: bool = False
    projects: bool = False

    def __post_init__(self) -> None:
        self.positions = self.mechanism.d
        tree, partition = self.mechanism.tree, self.mechanism.partition
        self._d = self.mechanism.d
        self._q, self._z = tree.place[partition.q], tree.place[partition.z]
        self._w0 = self.initial.phi

    def start(self) -> Array:
        q_tree = self.initial.q_tree
        return np.concatenate([q_tree[self._q], self.q_dot, q_tree[self._z]])

    def w(self, t: float) -> Array:
        return self._w0 * np.exp(-t / self.epsilon)

    def w_dot(self, t: float) -> Array:
        return -self.w(t) / self.epsilon

    def velocity(self, t: float, terms: Terms) -> Array:
        return _spf_velocity(terms, self.epsilon, terms.phi)

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
        return None

    def accept(self, t: float, y: Array) -> Array | None:
        _require_chart(self.terms(t, y).at)
        return None


@dataclass
class Dae:
    """Eq. 1: y = (q', v'), position and velocity put back on the closure after each step if `projects`."""

    mechanism: Mechanism
    initial: Kinematics
    v_tree: Array
    force: Force
    projects: bool = True
    counts: Counts = field(default_factory=Counts)
    passes_rank_loss: bool = True

    def __post_init__(self) -> None:
        self.positions = self.mechanism.n if self.mechanism.tree.flat else 0

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
        return self._projected(at, v_tree) if self.projects else Terms(self.mechanism, at, v_tree)

    def configuration(self, t: float, y: Array) -> Array:
        return self._split(y)[0]

    def rhs(self, t: float, y: Array) -> Array:
        q_tree, v_tree = self._split(y)
        terms = Terms(self.mechanism, self.mechanism.kinematics(q_tree), v_tree)
        self.counts.factorizations += 2
        rate = self.mechanism.tree.configuration_rate(q_tree, v_tree)
        return np.concatenate([rate, dae_acceleration(terms, self.force(t, terms))])

    def jacobian(self, t: float, y: Array, rhs: Rhs) -> Array | None:
        return None

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


def nearly_singular(at: Kinematics, margin: float) -> str | None:
    """Say that phi_z is singular within a margin relative to J; None when it is not."""
    sigma_min = at.sigma_min()
    if not sigma_min <= margin * np.linalg.norm(at.J):
        return None
    names = at.tree.coordinates
    q, z = ([names[k] for k in part] for part in (at.partition.q, at.partition.z))
    return (
        f"phi_z is singular (its least singular value is {sigma_min:.2g}): "
        f"{', '.join(q)} do not determine {', '.join(z)} here"
    )


def _require_chart(at: Kinematics) -> None:
    """Stop where q is no chart any more: results beyond would be rounding errors."""
    problem = nearly_singular(at, CHART_MARGIN)
    if problem:
        q_tree = at.tree.named(at.tree.to_coordinates(at.q_tree))
        raise NumericalError(problem, q_tree=q_tree)


def _spf_velocity(terms: Terms, epsilon: float, w: Array) -> Array:
    velocity = terms.v_tree.copy()
    velocity[terms.at.partition.z] = spf_z_dot(terms.at, terms.q_dot, epsilon, w)
    return velocity
