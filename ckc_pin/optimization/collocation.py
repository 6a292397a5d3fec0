"""Optimal control from one place to another by direct collocation of the reduced equations of motion.

Unknowns are the duration T of each phase, q and its rate at the knots of a mesh, accelerations at the Gauss points of
each interval, and motor torques at the knots, which are linear between them and may jump where a phase ends. q is the
polynomial that has these accelerations, so that rates and accelerations belong to the same motion everywhere. Eq. 6
holds at the Gauss points. The dependent coordinates are sigma(q) everywhere (`ReducedDynamics`), so the loops are
closed along the continuous motion.

Rates and accelerations are by t / T of their phase. All equations but eq. 6 and the limits of the state (`StateLimits`)
are then linear, except for limits of accelerations and jerks, and for the rates where a phase ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.optimization.collocation_cost import cost_parts
from ckc_pin.optimization.ipopt import Ipopt, Optimum, merge_patterns, nonzeros
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.mesh_motion import DEGREE, Guess, Places, Solution, gauss_points
from ckc_pin.optimization.phase_dynamics import PhaseDynamics
from ckc_pin.optimization.reduced import Derivatives, MotionInstants, ReducedDynamics
from ckc_pin.optimization.spec import MinimizeSpec
from ckc_pin.optimization.state_limits import StateLimits

__all__ = ["MIN_DURATION", "TOLERANCE", "Collocation"]

MIN_DURATION = 1e-4  # of the initial guess's
MAX_DURATION = 1e3  # of the initial guess's, if there is no limit
TOLERANCE = 1e-9  # of IPOPT, relative to the scaled problem


class Collocation:
    """The nonlinear program of a motion on a mesh, for IPOPT.

    Parameters
    ----------
    dynamics : ReducedDynamics
    limits : MotionLimits
    minimize : MinimizeSpec
    guess : Guess
        Its mesh, its durations, and the sizes of its quantities are kept.
    start : (nq,) array
        Configuration to which `limits.singularity` is relative.
    places : Places
    desired : (m, d) array, optional
        The motion at the Gauss points that is to be tracked.
    members : sequence of ReducedDynamics, optional
        Dynamics of each phase, if they differ in the bodies' inertias.
    """

    def __init__(
        self, dynamics: ReducedDynamics, limits: MotionLimits, minimize: MinimizeSpec, guess: Guess, start: Array,
        places: Places, desired: Array | None = None, members: Sequence[ReducedDynamics] = (),
    ) -> None:  # fmt: skip
        self.dynamics, self.limits, self.minimize, self.guess = dynamics, limits, minimize, guess
        d, motors = dynamics.d, dynamics.motors
        self.d, self.motors = d, motors
        mesh = guess.mesh
        self.step, self.phases, self.phase, self.begin = mesh.steps, mesh.phases, mesh.phase, mesh.begin
        self.knot, self.phase_of_knots = mesh.knot, mesh.phase_of_knots
        self.intervals = len(self.step)
        self._phase_dynamics = PhaseDynamics(members or [dynamics] * self.phases, np.repeat(self.phase, DEGREE))
        self.last = np.searchsorted(self.phase, np.arange(self.phases), side="right") - 1  # interval of each phase
        self.points, self.weights, self.once, self.twice, self.to_end = gauss_points()
        torque = np.where(np.isfinite(limits.torque), np.abs(limits.torque), 0.0).max(axis=0, initial=0.0)
        typical = np.maximum(np.abs(guess.torque).max(axis=0), 1e-3 * max(np.abs(guess.torque).max(initial=0.0), 1e-9))
        self.unit = np.where(torque > 0, torque, typical)  # of torques
        self.force_unit = float(self.unit.max(initial=1.0))
        self.power_unit = self.force_unit * max(float(np.abs(guess.rates).max(initial=0.0)), 1e-9)
        self.state_limits = StateLimits(dynamics, limits, start, self.power_unit, with_power=bool(minimize.energy))
        self.slacks = motors if minimize.energy else 0  # of each Gauss point
        self.q_tree = guess.q_tree
        self._number_variables()
        self._cache: dict[str, tuple[bytes, Any]] = {}
        self.set_places(places, desired)
        self._make_simple_part()
        self._make_patterns()

    def set_places(self, places: Places, desired: Array | None = None) -> None:
        """Set the places that the motion passes, and the motion at the Gauss points (m, d) that it is to track."""
        self.places = places
        m = self.intervals * DEGREE
        desired = np.zeros((m, self.d)) if desired is None else desired
        self._parameters = np.concatenate([np.nan_to_num(places.rates).ravel(), desired.ravel()])
        self._cache.clear()

    # --- variables -------------------------------------------------------------------------------

    def _number_variables(self) -> None:
        d, motors, count, knots = self.d, self.motors, self.intervals, len(self.knot)
        sizes = [1, self.phases, (count + 1) * d, knots * d, count * DEGREE * d, knots * motors,
                 count * DEGREE * self.slacks]  # fmt: skip
        ends = np.cumsum([0, *sizes])
        number = [np.arange(a, b) for a, b in pairwise(ends.tolist())]
        self.size = int(ends[-1])
        self.peak_at, self.T_at = int(number[0][0]), number[1]
        # Rates by t / T and torques have two values where a phase ends and the next one begins.
        self.q_at, self.v_at = number[2].reshape(count + 1, d), number[3].reshape(knots, d)
        self.a_at, self.tau_at = number[4].reshape(count, DEGREE, d), number[5].reshape(knots, motors)
        self.slack_at = number[6].reshape(count * DEGREE, self.slacks)
        # Of each interval: its variables, and x = (q, rates, accelerations, tau, T) at the Gauss points by them.
        self.columns = np.concatenate(
            [self.q_at[:-1], self.v_at[self.begin], self.a_at.reshape(count, -1), self.tau_at[self.begin],
             self.tau_at[self.begin + 1], self.T_at[self.phase][:, None]], axis=1,
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
        w, T = np.empty(self.size), guess.durations
        w[self.T_at] = T
        w[self.q_at], w[self.v_at] = guess.q, T[self.phase_of_knots, None] * guess.rates[self.knot]
        w[self.a_at] = T[self.phase, None, None] ** 2 * guess.accelerations
        w[self.tau_at] = guess.torque / self.unit
        w[self.peak_at] = np.abs(guess.torque).max(initial=0.0) / self.force_unit
        w[self.slack_at] = 0.0
        at = self._instants(w) if self.slacks else None
        if at is not None:
            w[self.slack_at] = np.maximum(self.state_limits.values(at)[:, self._energy_at], 0.0)
        return w

    def unpack(self, w: Array) -> Guess:
        """Return variables as a guess."""
        T = w[self.T_at]
        rates = w[self.v_at] / T[self.phase_of_knots, None]
        first = np.append(self.begin, self.begin[-1] + 1)
        return Guess(
            self.guess.mesh, T, w[self.q_at], rates[first], w[self.a_at] / T[self.phase, None, None] ** 2,
            w[self.tau_at] * self.unit, self.q_tree,
        )  # fmt: skip

    # --- cost and simple constraints -------------------------------------------------------------

    def _make_simple_part(self) -> None:
        """Write the cost, and all constraints but those of the mechanism at the Gauss points, with CasADi."""
        import casadi as cs

        w, p = cs.SX.sym("w", self.size), cs.SX.sym("p", len(self._parameters))
        rows: list[Any] = []
        bounds: list[Array] = []
        self.labels: list[str] = []

        def require(labels: Sequence[str], expression: Any, low: float | Array, high: float | Array) -> None:
            """Require limits of a vector, whose entries have these labels, repeated as often as needed."""
            rows.append(expression)
            count = int(expression.numel())
            bounds.append(np.array([np.broadcast_to(low, count), np.broadcast_to(high, count)]))
            self.labels += list(labels) * (count // len(labels))

        parts = cost_parts(self, w, p)
        self._connect(require, w, p)
        self._limit_motion(require, w)
        self._limit_torques(require, w)
        weights = [getattr(self.minimize, name) for name in parts]
        cost = sum(weight * part for weight, part in zip(weights, parts.values(), strict=True))
        g = cs.vertcat(*rows)
        multipliers, factor = cs.SX.sym("multipliers", g.numel()), cs.SX.sym("factor")
        self.simple_bounds = np.hstack(bounds)
        self._parts = cs.Function("parts", [w, p], list(parts.values()))
        self._part_names = list(parts)
        self._value = cs.Function("value", [w, p], [cs.densify(cost), cs.densify(g)])
        self._gradient = cs.Function("gradient", [w, p], [cs.densify(cs.gradient(cost, w))])
        jacobian = cs.jacobian(g, w)
        lagrangian = factor * cost + cs.dot(multipliers, g)
        hessian = cs.triu(cs.hessian(lagrangian, w)[0])
        self._simple_jacobian = jacobian.sparsity().get_triplet()
        self._simple_hessian = hessian.sparsity().get_triplet()
        self._jacobian = cs.Function("jacobian", [w, p], [nonzeros(jacobian)])
        self._hessian = cs.Function("hessian", [w, p, factor, multipliers], [nonzeros(hessian)])

    def at_points(self, w: Any, order: int) -> Any:
        """Return q (order 0), rates or accelerations by t / T at the Gauss points, in their order."""
        import casadi as cs

        d = self.d
        block = self.by_variables[:, :, order * d : (order + 1) * d].reshape(self.intervals, DEGREE * d, -1)
        row = np.broadcast_to(np.arange(len(block) * DEGREE * d).reshape(len(block), -1, 1), block.shape)
        column = np.broadcast_to(self.columns[:, None, :], block.shape)
        used = block != 0
        rows, columns = row[used].tolist(), column[used].tolist()
        matrix = cs.DM.triplet(rows, columns, cs.DM(block[used]), self.intervals * DEGREE * d, self.size)
        return cs.mtimes(matrix, w)

    def jerks(self, w: Any, places: Array) -> Any:
        """Return the jerks by t / T at places of each interval, by interval, place, and coordinate."""
        import casadi as cs

        powers = np.linalg.inv(np.vander(self.points, increasing=True))
        slopes = np.vander(places, DEGREE, increasing=True) @ np.diag(np.arange(1.0, DEGREE), 1) @ powers
        a = cs.reshape(w[self.a_at.transpose(1, 2, 0).reshape(-1).tolist()], self.intervals * self.d, DEGREE)
        # Column-major: rows are intervals and coordinates.
        steps = cs.repmat(cs.DM(np.tile(self.step, self.d)), 1, len(places))
        by_place = cs.mtimes(a, cs.DM(slopes).T) / steps
        order = np.arange(by_place.numel()).reshape(len(places), self.d, self.intervals).transpose(2, 0, 1)
        return cs.vec(by_place)[order.ravel().tolist()]

    def _connect(self, require: Callable[..., None], w: Any, p: Any) -> None:
        """Require that polynomials of intervals end at the next knot, and the places' rates and times."""
        import casadi as cs

        T, h, d = w[self.T_at.tolist()], cs.DM(self.step), self.d
        for i in range(d):
            q = w[self.q_at[:, i].tolist()]
            v_begin, v_end = (w[self.v_at[self.begin + side, i].tolist()] for side in (0, 1))
            a = [w[self.a_at[:, k, i].tolist()] for k in range(DEGREE)]
            gain = sum(x * y for x, y in zip(self.weights.tolist(), a, strict=True))
            way = sum(x * y for x, y in zip(self.to_end.tolist(), a, strict=True))
            require(["motion"], v_end - v_begin - h * gain, 0.0, 0.0)
            require(["motion"], q[1:] - q[:-1] - h * v_begin - h**2 * way, 0.0, 0.0)
        ends = self.begin[self.last] + 1  # of the phases
        v = [w[self.v_at[k].tolist()] for k in (0, *ends.tolist())]
        for k in range(1, self.phases):
            after = w[self.v_at[ends[k - 1] + 1].tolist()]
            require(["motion"], T[k] * v[k] - T[k - 1] * after, 0.0, 0.0)
            if not self.places.jumps:
                tau = w[self.tau_at[ends[k - 1] + 1].tolist()] - w[self.tau_at[ends[k - 1]].tolist()]
                require(["torque at places"], tau, 0.0, 0.0)
        rates = [x - T[max(k - 1, 0)] * p[k * d : (k + 1) * d] for k, x in enumerate(v)]
        require(["rates at places"], cs.vertcat(*rates), 0.0, 0.0)
        self._rate_rows = slice(len(self.labels) - len(rates) * d, len(self.labels))
        if self.phases > 1:
            require(["time"], cs.cumsum(T), 0.0, 0.0)
            self._time_rows = slice(len(self.labels) - self.phases, len(self.labels))
        if self.places.turns is not None:
            q, tau = ([w[at[k].tolist()] for k in (0, -1)] for at in (self.q_at, self.tau_at))
            require(["period"], q[1] - q[0], self.places.turns, self.places.turns)
            require(["period"], v[-1] - v[0] if self.phases == 1 else T[0] * v[-1] - T[-1] * v[0], 0.0, 0.0)
            if not self.places.jumps_at_start:
                require(["period"], tau[1] - tau[0], 0.0, 0.0)

    def _limit_motion(self, require: Callable[..., None], w: Any) -> None:
        """Limit the independent coordinates, their rates, accelerations and jerks."""
        limits, names, d = self.limits, self.dynamics.mechanism.independent, self.d
        jerks = self.jerks(w, np.array([0.0, 1.0]))  # which are linear in each interval
        orders = [self.at_points(w, order) for order in range(3)]
        for i, at in enumerate(self.dynamics.q_at.tolist()):
            low, high = limits.q[:, at].tolist()
            if np.isfinite([low, high]).any():
                require([names[i]], orders[0][i::d], low, high)
            knots = w[self.v_at[:, i].tolist()]
            of_points, of_ends = np.repeat(self.phase, DEGREE), np.repeat(self.phase, 2)
            for label, limit, values, power in (
                ("v", limits.rate[at], [(orders[1][i::d], of_points), (knots, self.phase_of_knots)], 1),
                ("a", limits.acceleration[at], [(orders[2][i::d], of_points)], 2),
                ("jerk", limits.jerk[i], [(jerks[i::d], of_ends)], 3),
            ):
                for x, phase in values if np.isfinite(limit) else ():
                    unit = w[self.T_at[phase].tolist()] ** power
                    require([f"{label}.{names[i]}"], x / float(limit) - unit, -np.inf, 0.0)
                    require([f"{label}.{names[i]}"], x / float(limit) + unit, 0.0, np.inf)

    def _limit_torques(self, require: Callable[..., None], w: Any) -> None:
        import casadi as cs

        limits, T, peak = self.limits, w[self.T_at[self.phase].tolist()], w[self.peak_at]
        for motor, name in enumerate(self.dynamics.mechanism.motors.names):
            tau = w[self.tau_at[:, motor].tolist()]
            if self.minimize.peak_torque:
                share = self.unit[motor] / self.force_unit
                require(["peak_torque"], share * tau - peak, -np.inf, 0.0)
                require(["peak_torque"], share * tau + peak, 0.0, np.inf)
            limit = limits.torque_rate[motor]
            if np.isfinite(limit):
                bound = cs.DM(limit * self.step / self.unit[motor]) * T
                change = tau[(self.begin + 1).tolist()] - tau[self.begin.tolist()]
                require([f"torque_rate.{name}"], change - bound, -np.inf, 0.0)
                require([f"torque_rate.{name}"], change + bound, 0.0, np.inf)

    # --- the mechanism at the Gauss points -------------------------------------------------------

    def _make_patterns(self) -> None:
        """Find the places of all derivatives in the sparse matrices of the whole problem."""
        m, d = self.intervals * DEGREE, self.d
        limited = self.state_limits.bounds.shape[1]
        self._energy_at = slice(limited - self.slacks, limited)
        self.simple_rows, each = self.simple_bounds.shape[1], d + limited
        self.rows = self.simple_rows + m * each
        local_rows = self.simple_rows + np.arange(m * each).reshape(self.intervals, DEGREE, each)
        width = self.columns.shape[1]
        row = np.broadcast_to(local_rows[..., None], (*local_rows.shape, width))
        column = np.broadcast_to(self.columns[:, None, None, :], row.shape)
        simple = self._simple_jacobian
        slack_rows = local_rows.reshape(m, each)[:, each - self.slacks :]
        self.jacobian_pattern, self._jacobian_places = merge_patterns(
            [(np.array(simple[0]), np.array(simple[1])), (row.ravel(), column.ravel()),
             (slack_rows.ravel(), self.slack_at.ravel())], self.rows, self.size,
        )  # fmt: skip
        row = np.broadcast_to(self.columns[:, :, None], (self.intervals, width, width))
        column = np.broadcast_to(self.columns[:, None, :], row.shape)
        self._upper = row <= column
        simple = self._simple_hessian
        self.hessian_pattern, self._hessian_places = merge_patterns(
            [(np.array(simple[0]), np.array(simple[1])), (row[self._upper], column[self._upper])], self.size, self.size
        )
        of_point = np.hstack([np.zeros((2, d)), self.state_limits.bounds])
        self.bounds = np.hstack([self.simple_bounds, np.tile(of_point, m)])
        names = self.dynamics.mechanism.independent
        self.labels += [*(f"eq. 6, {name}" for name in names), *self.state_limits.labels] * m

    def _points_of(self, w: Array) -> Array:
        """Return x = (q, rates, accelerations, tau, T) at the Gauss points, (m, 3 d + motors + 1)."""
        x = np.einsum("kjxc,kc->kjx", self.by_variables, w[self.columns])
        return x.reshape(self.intervals * DEGREE, -1)

    def _point_durations(self, w: Array) -> Array:
        """Return the duration of the phase of each Gauss point, (m,)."""
        return np.asarray(np.repeat(w[self.T_at][self.phase], DEGREE))

    def _instants(self, w: Array) -> MotionInstants | None:
        def compute() -> MotionInstants | None:
            x, d = self._points_of(w), self.d
            T = x[:, -1:]
            if not np.all(T > 0):
                return None
            q_tree = self.dynamics.close(self.q_tree, x[:, :d])
            if q_tree is None:
                return None
            tau = x[:, 3 * d : 3 * d + self.motors]
            return self._phase_dynamics.instants(q_tree, x[:, d : 2 * d] / T, x[:, 2 * d : 3 * d] / T**2, tau)

        return self._cached("instants", w, compute)

    def _derivatives(self, w: Array) -> tuple[MotionInstants, Derivatives, Array, Array, Array] | None:
        """Return instants, their derivatives, those of the state, of its limits, and of all rows, by plain x."""

        def compute() -> tuple[MotionInstants, Derivatives, Array, Array, Array] | None:
            at = self._instants(w)
            if at is None:
                return None
            self.q_tree = at.q_tree
            by_x = self._phase_dynamics.differentiate(at)
            force = by_x.force / self.force_unit
            if not self.state_limits.labels:
                none = np.zeros((len(force), 0, 0))
                return at, by_x, none, none, force
            by_state = self.dynamics.state_derivatives(by_x)
            gradients = self.state_limits.gradients(at)
            return at, by_x, by_state, gradients, np.concatenate([force, gradients @ by_state], axis=1)

        return self._cached("derivatives", w, compute)

    def _cached(self, name: str, w: Array, compute: Callable[[], Any]) -> Any:
        key = w.tobytes()
        if self._cache.get(name, (b"", None))[0] != key:
            self._cache[name] = key, compute()
        return self._cache[name][1]

    def constraints(self, w: Array) -> tuple[float, Array]:
        """Return the cost and all constraints; NaN where the loops do not close."""
        cost, g = (x.full().ravel() for x in self._value(w, self._parameters))
        at = self._instants(w)
        if at is None:
            return float("nan"), np.concatenate([g, np.full(self.rows - self.simple_rows, np.nan)])
        limited = self.state_limits.values(at)
        limited[:, self._energy_at] -= w[self.slack_at]
        return float(cost[0]), np.concatenate([g, np.hstack([at.force / self.force_unit, limited]).ravel()])

    def gradient(self, w: Array) -> Array:
        """Return the gradient of the cost."""
        return np.asarray(self._gradient(w, self._parameters).full().ravel())

    def jacobian(self, w: Array) -> Array:
        """Return the nonzeros of the constraints' Jacobian."""
        simple = self._jacobian(w, self._parameters).full().ravel()
        result = self._derivatives(w)
        if result is None:
            return np.full(self.jacobian_pattern.nnz(), np.nan)
        at, _, _, _, rows = result
        T, d = self._point_durations(w), self.d
        scaled = rows.copy()  # by rates and accelerations by t / T
        scaled[..., d : 2 * d] /= T[:, None, None]
        scaled[..., 2 * d : 3 * d] /= T[:, None, None] ** 2
        v, a = at.v_tree[:, self.dynamics.q_at], at.a_tree[:, self.dynamics.q_at]
        by_T = -np.einsum("mij,mj->mi", rows[..., d : 2 * d], v) / T[:, None]
        by_T -= 2 * np.einsum("mij,mj->mi", rows[..., 2 * d : 3 * d], a) / T[:, None]
        full = np.concatenate([scaled, by_T[..., None]], axis=2)
        local = full.reshape(self.intervals, DEGREE, rows.shape[1], -1) @ self.by_variables
        values = np.concatenate([simple, local.ravel(), np.full(self.slack_at.size, -1.0)])
        return _sum_at(self._jacobian_places, values, self.jacobian_pattern.nnz())

    def hessian(self, w: Array, factor: float, multipliers: Array) -> Array:
        """Return the nonzeros of the Lagrangian's Hessian, upper triangle."""
        simple = self._hessian(w, self._parameters, factor, multipliers[: self.simple_rows]).full().ravel()
        result = self._derivatives(w)
        if result is None:
            return np.full(self.hessian_pattern.nnz(), np.nan)
        at, by_x, by_state, gradients, rows = result
        T, d = self._point_durations(w)[:, None], self.d
        weights = multipliers[self.simple_rows :].reshape(len(rows), -1)
        force_weights, limit_weights = weights[:, :d] / self.force_unit, weights[:, d:]
        if self.state_limits.labels:
            state_weights = np.einsum("mi,mis->ms", limit_weights, gradients)
            plain = self._phase_dynamics.hessian(at, by_x, force_weights, state_weights)
            self.state_limits.add_hessian(plain, at, by_state, limit_weights)
        else:
            plain = self._phase_dynamics.hessian(at, by_x, force_weights)
        gradient = np.einsum("mi,mij->mj", weights, rows)
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
        full[:, -1, -1] += 2 * np.einsum("mi,mi->m", gradient[:, rate], v / T**2)
        full[:, -1, -1] += 6 * np.einsum("mi,mi->m", gradient[:, acceleration], a / T**2)
        by_variables = self.by_variables
        blocks = full.reshape(self.intervals, DEGREE, size + 1, size + 1)
        local = (by_variables.transpose(0, 1, 3, 2) @ blocks @ by_variables).sum(axis=1)
        values = np.concatenate([simple, local[self._upper]])
        return _sum_at(self._hessian_places, values, self.hessian_pattern.nnz())

    # --- solution --------------------------------------------------------------------------------

    def variable_bounds(self) -> Array:
        """Return lower and upper bounds of the variables, (2, variables)."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        low[self.T_at] = MIN_DURATION * self.guess.durations
        high[self.T_at] = np.minimum(self.limits.time, MAX_DURATION * self.guess.durations)
        if self.phases == 1 and np.isfinite(self.places.t[1]):
            low[self.T_at] = high[self.T_at] = self.places.t[1]
        low[self.q_at], high[self.q_at] = self.limits.q[:, self.dynamics.q_at]
        low[self.tau_at], high[self.tau_at] = self.limits.torque / self.unit
        low[self.peak_at] = low[self.slack_at] = 0.0
        if not self.minimize.peak_torque:
            high[self.peak_at] = low[self.peak_at]
        for k, q in zip((0, *(self.last + 1).tolist()), self.places.q, strict=True):
            fixed = np.isfinite(q)
            at = self.q_at[k][fixed]
            low[at] = high[at] = q[fixed]
        return np.array([low, high])

    def solve(self, guess: Guess, optimizer: Ipopt, last: Optimum | None = None) -> tuple[Solution, Optimum]:
        """Run an optimizer of this program from a guess, with the multipliers of a solution nearby."""
        self.q_tree = guess.q_tree
        free = ~np.isfinite(self.places.rates.ravel())
        self.bounds[:, self._rate_rows] = np.where(free, [[-np.inf], [np.inf]], 0.0)
        if self.phases > 1:
            free = ~np.isfinite(self.places.t[1:])
            self.bounds[:, self._time_rows] = np.where(free, [[-np.inf], [np.inf]], self.places.t[1:])
            end = self._time_rows.stop - 1
            self.bounds[1, end] = min(self.bounds[1, end], self.limits.time)
        optimum = optimizer.solve(self.pack(guess), self.variable_bounds(), last)
        w = optimum.w
        cost, values = self.constraints(w)
        excess = np.maximum(self.bounds[0] - values, values - self.bounds[1])
        worst = int(np.argmax(np.where(np.isnan(excess), np.inf, excess)))
        at = self._instants(w)
        if at is not None:
            self.q_tree = at.q_tree
        parts = dict(zip(self._part_names, [float(x) for x in _as_list(self._parts(w, self._parameters))], strict=True))
        violation = self.labels[worst], float(excess[worst])
        return Solution(self.unpack(w), optimum.status, cost, parts, optimum.iterations, violation), optimum


def _as_list(x: Any) -> list[Any]:
    return list(x) if isinstance(x, list | tuple) else [x]


def _sum_at(places: IntArray, values: Array, count: int) -> Array:
    return np.asarray(np.bincount(places, values, count), dtype=float)
