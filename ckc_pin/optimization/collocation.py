"""Optimal control from one configuration to another by direct collocation of the reduced equations of motion.

Unknowns are the duration T, q and its rate at the knots of a mesh, accelerations at the Gauss points of each interval,
and motor torques at the knots, which are linear between them. q is the polynomial that has these accelerations, so that
rates and accelerations belong to the same motion everywhere. Eq. 6 holds at the Gauss points. The dependent coordinates
are sigma(q) everywhere (`ReducedDynamics`), so the loops are closed along the continuous motion.

Rates and accelerations are by t / T. All equations but eq. 6 are then linear, except for limits of accelerations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.reduced import Derivatives, MotionInstants, ReducedDynamics
from ckc_pin.optimization.spec import MinimizeSpec

__all__ = ["Collocation", "Ends", "Guess", "Solution"]

DEGREE = 3  # Gauss points of an interval
MIN_DURATION = 1e-4  # of the initial guess's
MAX_DURATION = 1e3  # of the initial guess's, if there is no limit
TOLERANCE = 1e-9  # of IPOPT, relative to the scaled problem


@dataclass(frozen=True, eq=False)
class Ends(Immutable):
    """Start and end of a motion: q and rates (2, d) each."""

    q: Array
    rates: Array


@dataclass(frozen=True, eq=False)
class Guess(Immutable):
    """An initial guess.

    Attributes
    ----------
    mesh : (knots,) array
        From 0 to 1.
    duration : float
        s.
    q, rates : (knots, d) arrays
    accelerations : (intervals, DEGREE, d) array
        At the Gauss points.
    torque : (knots, motors) array
    q_tree : (intervals DEGREE, nq) array
        Closed configurations near the Gauss points.
    """

    mesh: Array
    duration: float
    q: Array
    rates: Array
    accelerations: Array
    torque: Array
    q_tree: Array


@dataclass(frozen=True, eq=False)
class Solution(Immutable):
    """What the optimizer returns: a `Guess`, its status, cost, parts of the cost, iterations, and largest violation."""

    values: Guess
    status: str
    cost: float
    parts: dict[str, float]
    iterations: int
    violation: tuple[str, float]

    def motion(self) -> PiecewisePolynomial:
        """Return q over time."""
        values, T = self.values, self.values.duration
        t, step = T * values.mesh, T * np.diff(values.mesh)
        # Accelerations as polynomials of the share of the interval, by ascending power.
        powers = np.linalg.inv(np.vander(gauss_points()[0], increasing=True))
        a = np.einsum("pj,kjd->pkd", powers, values.accelerations)
        scaled = [a[p] / ((p + 1) * (p + 2)) / step[:, None] ** p for p in range(DEGREE)]
        coefficients = np.array([*scaled[::-1], values.rates[:-1], values.q[:-1]])
        rates = np.abs(values.rates).max(initial=0.0)
        return PiecewisePolynomial(t, coefficients, corners=t, max_frequency=float(rates), end=float(t[-1]))


def gauss_points() -> tuple[Array, Array, Array, Array, Array]:
    """Return points, weights, integrals and double integrals up to the points, and double integrals to the end."""
    x, w = np.polynomial.legendre.leggauss(DEGREE)
    points = (x + 1) / 2
    powers = np.linalg.inv(np.vander(points, increasing=True))
    n = np.arange(DEGREE)
    once = (points[:, None] ** (n + 1) / (n + 1)) @ powers
    twice = (points[:, None] ** (n + 2) / ((n + 1) * (n + 2))) @ powers
    return points, w / 2, once, twice, (1 / ((n + 1) * (n + 2))) @ powers


class Collocation:
    """The nonlinear program of a motion on a mesh, for IPOPT.

    Parameters
    ----------
    dynamics : ReducedDynamics
    limits : MotionLimits
    minimize : MinimizeSpec
    ends : Ends
    guess : Guess
    """

    def __init__(
        self, dynamics: ReducedDynamics, limits: MotionLimits, minimize: MinimizeSpec, ends: Ends, guess: Guess
    ) -> None:
        self.dynamics, self.limits, self.minimize, self.ends, self.guess = dynamics, limits, minimize, ends, guess
        d, motors = dynamics.d, dynamics.motors
        self.d, self.motors = d, motors
        self.step = np.diff(guess.mesh)
        self.intervals = len(self.step)
        self.points, self.weights, self.once, self.twice, self.to_end = gauss_points()
        torque = np.where(np.isfinite(limits.torque), np.abs(limits.torque), 0.0).max(axis=0, initial=0.0)
        typical = np.maximum(np.abs(guess.torque).max(axis=0), 1e-3 * max(np.abs(guess.torque).max(initial=0.0), 1e-9))
        self.unit = np.where(torque > 0, torque, typical)  # of torques
        self.force_unit = float(self.unit.max(initial=1.0))
        self.q_tree = guess.q_tree
        self._number_variables()
        self._cache: dict[str, tuple[bytes, Any]] = {}
        self._make_simple_part()
        self._make_patterns()

    # --- variables -------------------------------------------------------------------------------

    def _number_variables(self) -> None:
        d, motors, count = self.d, self.motors, self.intervals
        sizes = [1, 1, (count + 1) * d, (count + 1) * d, count * DEGREE * d, (count + 1) * motors]
        ends = np.cumsum([0, *sizes])
        number = [np.arange(a, b) for a, b in pairwise(ends.tolist())]
        self.size = int(ends[-1])
        self.peak_at, self.T_at = int(number[0][0]), int(number[1][0])
        self.q_at, self.v_at = (x.reshape(count + 1, d) for x in number[2:4])
        self.a_at, self.tau_at = number[4].reshape(count, DEGREE, d), number[5].reshape(count + 1, motors)
        # Of each interval: its variables, and x = (q, rates, accelerations, tau, T) at the Gauss points by them.
        self.columns = np.concatenate(
            [self.q_at[:-1], self.v_at[:-1], self.a_at.reshape(count, -1), self.tau_at[:-1], self.tau_at[1:],
             np.full((count, 1), self.T_at)], axis=1,
        )  # fmt: skip
        width, unit = self.columns.shape[1], np.arange(d)
        self.by_variables = np.zeros((count, DEGREE, 3 * d + motors + 1, width))
        h = self.step
        for j in range(DEGREE):
            x = self.by_variables[:, j]
            x[:, unit, unit] = 1.0
            x[:, unit, d + unit] = (h * self.points[j])[:, None]
            x[:, d + unit, d + unit] = 1.0
            for k in range(DEGREE):
                at = 2 * d + k * d + unit
                x[:, unit, at] = (h**2 * self.twice[j, k])[:, None]
                x[:, d + unit, at] = (h * self.once[j, k])[:, None]
            x[:, 2 * d + unit, 2 * d + j * d + unit] = 1.0
            motor = np.arange(motors)
            first = (2 + DEGREE) * d + motor
            x[:, 3 * d + motor, first] = (1 - self.points[j]) * self.unit
            x[:, 3 * d + motor, first + motors] = self.points[j] * self.unit
            x[:, -1, -1] = 1.0

    def pack(self, guess: Guess) -> Array:
        """Return the variables of a guess."""
        w, T = np.empty(self.size), guess.duration
        w[self.T_at] = T
        w[self.q_at], w[self.v_at] = guess.q, T * guess.rates
        w[self.a_at], w[self.tau_at] = T**2 * guess.accelerations, guess.torque / self.unit
        w[self.peak_at] = np.abs(guess.torque).max(initial=0.0) / self.force_unit
        return w

    def unpack(self, w: Array) -> Guess:
        """Return variables as a guess."""
        T = float(w[self.T_at])
        return Guess(
            self.guess.mesh, T, w[self.q_at], w[self.v_at] / T, w[self.a_at] / T**2, w[self.tau_at] * self.unit,
            self.q_tree,
        )  # fmt: skip

    # --- cost and simple constraints -------------------------------------------------------------

    def _make_simple_part(self) -> None:
        """Write the cost, and all constraints but those of the mechanism at the Gauss points, with CasADi."""
        import casadi as cs

        w = cs.SX.sym("w", self.size)
        T, peak = w[self.T_at], w[self.peak_at]
        rows: list[Any] = []
        lower: list[float] = []
        upper: list[float] = []
        self.labels: list[str] = []

        def require(label: str, expression: Any, low: float, high: float) -> None:
            rows.append(expression)
            lower.append(low)
            upper.append(high)
            self.labels.append(label)

        parts = self._cost_parts(w, T, peak)
        for k in range(self.intervals):
            self._connect(require, w, k)
        for k in range(self.intervals + 1):
            self._limit_knot(require, w, T, peak, k)
        for k, side in ((0, 0), (self.intervals, 1)):
            for i in range(self.d):
                rate = float(self.ends.rates[side, i])
                if rate:
                    require("ends", w[int(self.v_at[k, i])] - rate * T, 0.0, 0.0)
        weights = [getattr(self.minimize, name) for name in parts]
        cost = sum(weight * part for weight, part in zip(weights, parts.values(), strict=True))
        g = cs.vertcat(*rows)
        multipliers, factor = cs.SX.sym("multipliers", g.numel()), cs.SX.sym("factor")
        self.simple_bounds = np.array([lower, upper])
        self._parts = cs.Function("parts", [w], list(parts.values()))
        self._part_names = list(parts)
        self._value = cs.Function("value", [w], [cs.densify(cost), cs.densify(g)])
        self._gradient = cs.Function("gradient", [w], [cs.densify(cs.gradient(cost, w))])
        jacobian = cs.jacobian(g, w)
        lagrangian = factor * cost + cs.dot(multipliers, g)
        hessian = cs.triu(cs.hessian(lagrangian, w)[0])
        self._simple_jacobian = jacobian.sparsity().get_triplet()
        self._simple_hessian = hessian.sparsity().get_triplet()
        self._jacobian = cs.Function("jacobian", [w], [_nonzeros(jacobian)])
        self._hessian = cs.Function("hessian", [w, factor, multipliers], [_nonzeros(hessian)])

    def _cost_parts(self, w: Any, T: Any, peak: Any) -> dict[str, Any]:
        """Return the parts of the cost, in SI units."""
        import casadi as cs

        parts: dict[str, Any] = {}
        if self.minimize.time:
            parts["time"] = T
        if self.minimize.effort:
            effort = cs.SX(0)
            for k, h in enumerate(self.step.tolist()):
                for motor, unit in enumerate(self.unit.tolist()):
                    a, b = w[int(self.tau_at[k, motor])], w[int(self.tau_at[k + 1, motor])]
                    effort += h / 3 * unit**2 * (a**2 + a * b + b**2)
            parts["effort"] = T * effort
        if self.minimize.jerk:
            powers = np.vander(self.points, increasing=True)
            slopes = powers @ np.diag(np.arange(1.0, DEGREE), 1) @ np.linalg.inv(powers)
            jerk = cs.SX(0)
            for k, h in enumerate(self.step.tolist()):
                for i in range(self.d):
                    a = w[self.a_at[k, :, i].tolist()]
                    rates = cs.mtimes(cs.DM(slopes), a) / h
                    jerk += h * cs.dot(cs.DM(self.weights), rates**2)
            parts["jerk"] = jerk / T**5
        if self.minimize.peak_torque:
            parts["peak_torque"] = peak * self.force_unit
        return parts

    def _connect(self, require: Callable[..., None], w: Any, k: int) -> None:
        """Require that the polynomial of an interval ends at the next knot."""
        h = float(self.step[k])
        for i in range(self.d):
            q, v = w[int(self.q_at[k, i])], w[int(self.v_at[k, i])]
            a = [w[int(x)] for x in self.a_at[k, :, i]]
            end_v = v + h * sum(x * y for x, y in zip(self.weights.tolist(), a, strict=True))
            end_q = q + h * v + h**2 * sum(x * y for x, y in zip(self.to_end.tolist(), a, strict=True))
            require("motion", w[int(self.q_at[k + 1, i])] - end_q, 0.0, 0.0)
            require("motion", w[int(self.v_at[k + 1, i])] - end_v, 0.0, 0.0)

    def _limit_knot(self, require: Callable[..., None], w: Any, T: Any, peak: Any, k: int) -> None:
        """Add the limits at a knot, and at the Gauss points of the interval that begins there."""
        limits, names = self.limits, self.dynamics.mechanism.independent
        inside = range(DEGREE) if k < self.intervals else ()
        for i, at in enumerate(self.dynamics.q_at.tolist()):
            low, high = limits.q[:, at].tolist()
            if np.isfinite([low, high]).any():
                for j in inside:
                    require(names[i], self._at_point(w, k, j, i, 0), low, high)
            for label, limit, order in (("v", limits.rate[at], 1), ("a", limits.acceleration[at], 2)):
                if np.isfinite(limit):
                    bound = float(limit) * T**order
                    values = [self._at_point(w, k, j, i, order) for j in inside]
                    values += [w[int(self.v_at[k, i])]] if order == 1 else []
                    for x in values:
                        require(f"{label}.{names[i]}", x - bound, -np.inf, 0.0)
                        require(f"{label}.{names[i]}", x + bound, 0.0, np.inf)
        for motor, name in enumerate(self.dynamics.mechanism.motors.names):
            here = w[int(self.tau_at[k, motor])]
            if self.minimize.peak_torque:
                share = self.unit[motor] / self.force_unit
                require("peak_torque", share * here - peak, -np.inf, 0.0)
                require("peak_torque", share * here + peak, 0.0, np.inf)
            limit = limits.torque_rate[motor]
            if np.isfinite(limit) and k < self.intervals:
                change = w[int(self.tau_at[k + 1, motor])] - here
                bound = float(limit * self.step[k] / self.unit[motor]) * T
                require(f"torque_rate.{name}", change - bound, -np.inf, 0.0)
                require(f"torque_rate.{name}", change + bound, 0.0, np.inf)

    def _at_point(self, w: Any, k: int, j: int, i: int, order: int) -> Any:
        """Return q (order 0), its rate or its acceleration by t / T at a Gauss point."""
        h = float(self.step[k])
        if order == 2:
            return w[int(self.a_at[k, j, i])]
        a = [w[int(x)] for x in self.a_at[k, :, i]]
        v = w[int(self.v_at[k, i])]
        if order == 1:
            return v + h * sum(x * y for x, y in zip(self.once[j].tolist(), a, strict=True))
        q = w[int(self.q_at[k, i])]
        return (
            q
            + h * float(self.points[j]) * v
            + h**2 * sum(x * y for x, y in zip(self.twice[j].tolist(), a, strict=True))
        )

    # --- the mechanism at the Gauss points -------------------------------------------------------

    def _make_patterns(self) -> None:
        """Find the places of all derivatives in the sparse matrices of the whole problem."""
        m, d = self.intervals * DEGREE, self.d
        self.simple_rows = self.simple_bounds.shape[1]
        self.rows = self.simple_rows + m * d
        local_rows = self.simple_rows + np.arange(m * d).reshape(self.intervals, DEGREE, d)
        width = self.columns.shape[1]
        row = np.broadcast_to(local_rows[..., None], (*local_rows.shape, width))
        column = np.broadcast_to(self.columns[:, None, None, :], row.shape)
        simple = self._simple_jacobian
        self.jacobian_pattern, self._jacobian_places = _merge(
            [(np.array(simple[0]), np.array(simple[1])), (row.ravel(), column.ravel())], self.rows, self.size
        )
        row = np.broadcast_to(self.columns[:, :, None], (self.intervals, width, width))
        column = np.broadcast_to(self.columns[:, None, :], row.shape)
        self._upper = row <= column
        simple = self._simple_hessian
        self.hessian_pattern, self._hessian_places = _merge(
            [(np.array(simple[0]), np.array(simple[1])), (row[self._upper], column[self._upper])], self.size, self.size
        )
        self.bounds = np.hstack([self.simple_bounds, np.zeros((2, m * d))])
        names = self.dynamics.mechanism.independent
        self.labels += [f"eq. 6, {name}" for name in names] * m

    def _points_of(self, w: Array) -> Array:
        """Return x = (q, rates, accelerations, tau, T) at the Gauss points, (m, 3 d + motors + 1)."""
        x = np.einsum("kjxc,kc->kjx", self.by_variables, w[self.columns])
        return x.reshape(self.intervals * DEGREE, -1)

    def _instants(self, w: Array) -> MotionInstants | None:
        def compute() -> MotionInstants | None:
            x, d = self._points_of(w), self.d
            T = w[self.T_at]
            if not T > 0:
                return None
            q_tree = self.dynamics.close(self.q_tree, x[:, :d])
            if q_tree is None:
                return None
            tau = x[:, 3 * d : 3 * d + self.motors]
            return self.dynamics.instants(q_tree, x[:, d : 2 * d] / T, x[:, 2 * d : 3 * d] / T**2, tau)

        return self._cached("instants", w, compute)

    def _derivatives(self, w: Array) -> tuple[MotionInstants, Derivatives] | None:
        def compute() -> tuple[MotionInstants, Derivatives] | None:
            at = self._instants(w)
            if at is None:
                return None
            self.q_tree = at.q_tree
            return at, self.dynamics.differentiate(at)

        return self._cached("derivatives", w, compute)

    def _cached(self, name: str, w: Array, compute: Callable[[], Any]) -> Any:
        key = w.tobytes()
        if self._cache.get(name, (b"", None))[0] != key:
            self._cache[name] = key, compute()
        return self._cache[name][1]

    def _by_scaled(self, by_x: Array, T: float) -> Array:
        """Return derivatives by (q, rates, accelerations, tau) as derivatives by rates and accelerations by t / T."""
        d = self.d
        scaled = by_x.copy()
        scaled[..., d : 2 * d] /= T
        scaled[..., 2 * d : 3 * d] /= T**2
        return scaled

    def constraints(self, w: Array) -> tuple[float, Array]:
        """Return the cost and all constraints; NaN where the loops do not close."""
        cost, g = (x.full().ravel() for x in self._value(w))
        at = self._instants(w)
        force = np.full(self.rows - self.simple_rows, np.nan) if at is None else at.force.ravel() / self.force_unit
        return float(cost[0]) if at is not None else float("nan"), np.concatenate([g, force])

    def gradient(self, w: Array) -> Array:
        """Return the gradient of the cost."""
        return np.asarray(self._gradient(w).full().ravel())

    def jacobian(self, w: Array) -> Array:
        """Return the nonzeros of the constraints' Jacobian."""
        simple = self._jacobian(w).full().ravel()
        result = self._derivatives(w)
        if result is None:
            return np.full(self.jacobian_pattern.nnz(), np.nan)
        at, by_x = result
        T, d = float(w[self.T_at]), self.d
        scaled = self._by_scaled(by_x.force, T)
        v, a = at.v_tree[:, self.dynamics.q_at], at.a_tree[:, self.dynamics.q_at]
        by_T = -np.einsum("mij,mj->mi", by_x.force[..., d : 2 * d], v) / T
        by_T -= 2 * np.einsum("mij,mj->mi", by_x.force[..., 2 * d : 3 * d], a) / T
        full = np.concatenate([scaled, by_T[..., None]], axis=2) / self.force_unit
        local = full.reshape(self.intervals, DEGREE, d, -1) @ self.by_variables
        return _sum_at(self._jacobian_places, np.concatenate([simple, local.ravel()]), self.jacobian_pattern.nnz())

    def hessian(self, w: Array, factor: float, multipliers: Array) -> Array:
        """Return the nonzeros of the Lagrangian's Hessian, upper triangle."""
        simple = self._hessian(w, factor, multipliers[: self.simple_rows]).full().ravel()
        result = self._derivatives(w)
        if result is None:
            return np.full(self.hessian_pattern.nnz(), np.nan)
        at, by_x = result
        T, d = float(w[self.T_at]), self.d
        weights = multipliers[self.simple_rows :].reshape(-1, d) / self.force_unit
        plain = self.dynamics.hessian(at, by_x, weights)
        gradient = np.einsum("mi,mij->mj", weights, by_x.force)
        size = plain.shape[1]
        # By the chain rule for rates / T and accelerations / T^2.
        inner = np.zeros((len(plain), size, size + 1))
        unit, rate, acceleration = np.arange(size), slice(d, 2 * d), slice(2 * d, 3 * d)
        inner[:, unit, unit] = 1.0
        inner[:, np.arange(d, 2 * d), np.arange(d, 2 * d)] = 1 / T
        inner[:, np.arange(2 * d, 3 * d), np.arange(2 * d, 3 * d)] = 1 / T**2
        v, a = at.v_tree[:, self.dynamics.q_at], at.a_tree[:, self.dynamics.q_at]
        inner[:, rate, -1], inner[:, acceleration, -1] = -v / T, -2 * a / T
        full = inner.transpose(0, 2, 1) @ plain @ inner
        full[:, rate, -1] -= gradient[:, rate] / T**2
        full[:, -1, rate] -= gradient[:, rate] / T**2
        full[:, acceleration, -1] -= 2 * gradient[:, acceleration] / T**3
        full[:, -1, acceleration] -= 2 * gradient[:, acceleration] / T**3
        full[:, -1, -1] += 2 * np.einsum("mi,mi->m", gradient[:, rate], v) / T**2
        full[:, -1, -1] += 6 * np.einsum("mi,mi->m", gradient[:, acceleration], a) / T**2
        by_variables = self.by_variables
        blocks = full.reshape(self.intervals, DEGREE, size + 1, size + 1)
        local = (by_variables.transpose(0, 1, 3, 2) @ blocks @ by_variables).sum(axis=1)
        values = np.concatenate([simple, local[self._upper]])
        return _sum_at(self._hessian_places, values, self.hessian_pattern.nnz())

    # --- solution --------------------------------------------------------------------------------

    def variable_bounds(self) -> Array:
        """Return lower and upper bounds of the variables, (2, variables)."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        low[self.T_at] = MIN_DURATION * self.guess.duration
        high[self.T_at] = min(self.limits.time, MAX_DURATION * self.guess.duration)
        low[self.q_at], high[self.q_at] = self.limits.q[:, self.dynamics.q_at]
        low[self.tau_at], high[self.tau_at] = self.limits.torque / self.unit
        low[self.peak_at] = 0.0
        if not self.minimize.peak_torque:
            high[self.peak_at] = low[self.peak_at]
        for k, side in ((0, 0), (-1, 1)):
            low[self.q_at[k]] = high[self.q_at[k]] = self.ends.q[side]
            fixed = self.ends.rates[side] == 0
            at = self.v_at[k][fixed]
            low[at] = high[at] = 0.0
        return np.array([low, high])

    def solve(self, *, iterations: int, warm: bool = False) -> Solution:
        """Run IPOPT from the guess."""
        import casadi as cs

        n, rows = self.size, self.rows
        column, none = cs.Sparsity.dense(n, 1), cs.Sparsity(0, 0)
        one, g = cs.Sparsity.dense(1, 1), cs.Sparsity.dense(rows, 1)
        functions = [
            _callback("nlp", {"x": column, "p": none}, {"f": one, "g": g}, lambda x: list(self.constraints(x[0]))),
            _callback("grad_f", {"x": column, "p": none}, {"f": one, "grad_f_x": column},
                      lambda x: [self.constraints(x[0])[0], self.gradient(x[0])]),
            _callback("jac_g", {"x": column, "p": none}, {"g": g, "jac_g_x": self.jacobian_pattern},
                      lambda x: [self.constraints(x[0])[1], self.jacobian(x[0])]),
            _callback("hess_lag", {"x": column, "p": none, "lam_f": one, "lam_g": g},
                      {"triu_hess_gamma_x_x": self.hessian_pattern},
                      lambda x: [self.hessian(x[0], float(x[2][0]), x[3])]),
        ]  # fmt: skip
        settings: dict[str, Any] = {
            "print_level": 0, "sb": "yes", "max_iter": iterations, "tol": TOLERANCE, "constr_viol_tol": 1e-9,
            "acceptable_tol": 1e-7, "acceptable_constr_viol_tol": 1e-9, "acceptable_iter": 5,
            "mu_strategy": "adaptive",
        }  # fmt: skip
        if warm:
            settings |= {"warm_start_init_point": "yes", "mu_init": 1e-6, "mu_strategy": "monotone",
                         "warm_start_bound_push": 1e-8, "warm_start_mult_bound_push": 1e-8}  # fmt: skip
        nlp, grad_f, jac_g, hess = functions
        solver = cs.nlpsol("plan", "ipopt", nlp, {
            "grad_f": grad_f, "jac_g": jac_g, "hess_lag": hess, "no_nlp_grad": True, "print_time": False,
            "calc_lam_p": False, "show_eval_warnings": False, "ipopt": settings,
        })  # fmt: skip
        low, high = self.variable_bounds()
        start = np.clip(self.pack(self.guess), low, high)
        result = solver(x0=start, lbx=low, ubx=high, lbg=self.bounds[0], ubg=self.bounds[1])
        w, stats = result["x"].full().ravel(), solver.stats()
        cost, values = self.constraints(w)
        excess = np.maximum(self.bounds[0] - values, values - self.bounds[1])
        worst = int(np.argmax(np.where(np.isfinite(excess), excess, np.inf)))
        at = self._instants(w)
        if at is not None:
            self.q_tree = at.q_tree
        parts = dict(zip(self._part_names, [float(x) for x in _as_list(self._parts(w))], strict=True))
        return Solution(
            self.unpack(w), str(stats["return_status"]), cost, parts, int(stats["iter_count"]),
            (self.labels[worst], float(excess[worst])),
        )  # fmt: skip


def _as_list(x: Any) -> list[Any]:
    return list(x) if isinstance(x, list | tuple) else [x]


def _sum_at(places: IntArray, values: Array, count: int) -> Array:
    return np.asarray(np.bincount(places, values, count), dtype=float)


def _nonzeros(matrix: Any) -> Any:
    """Return a sparse matrix's nonzeros as a dense column."""
    import casadi as cs

    return cs.densify(cs.vertcat(*matrix.nonzeros())) if matrix.nnz() else cs.SX(0, 1)


def _merge(parts: Sequence[tuple[Any, Any]], rows: int, columns: int) -> tuple[Any, IntArray]:
    """Return a CasADi sparsity with the entries of several lists of rows and columns, and the place of each entry."""
    import casadi as cs

    row, column = (np.concatenate([part[k] for part in parts]).astype(np.int64) for k in (0, 1))
    keys, places = np.unique(column * rows + row, return_inverse=True)
    starts = np.searchsorted(keys, np.arange(columns + 1) * rows)
    return cs.Sparsity(rows, columns, starts.tolist(), (keys % rows).tolist()), places


def _callback(
    name: str, inputs: dict[str, Any], outputs: dict[str, Any], evaluate: Callable[[list[Array]], list[Any]]
) -> Any:
    """Return a CasADi function that calls a Python function with vectors and takes nonzeros."""
    import casadi as cs

    class Function(cs.Callback):
        def __init__(self) -> None:
            cs.Callback.__init__(self)
            self.construct(name, {})

        def get_n_in(self) -> int:
            return len(inputs)

        def get_n_out(self) -> int:
            return len(outputs)

        def get_name_in(self, k: int) -> str:
            return list(inputs)[k]

        def get_name_out(self, k: int) -> str:
            return list(outputs)[k]

        def get_sparsity_in(self, k: int) -> Any:
            return list(inputs.values())[k]

        def get_sparsity_out(self, k: int) -> Any:
            return list(outputs.values())[k]

        def eval(self, arguments: Sequence[Any]) -> list[Any]:
            values = evaluate([x.full().ravel() for x in arguments])
            return [cs.DM(pattern, x) for pattern, x in zip(outputs.values(), values, strict=True)]

    return Function()
