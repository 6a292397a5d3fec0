"""Speed along a path with other costs and limits than those of the fastest motion, by nonlinear programming.

With b = s_dot^2 and u = s_ddot linear in s between the points of a grid, eq. 6 at the points gives the motor torques.
Durations of intervals are 2 ds / (sqrt(b_k) + sqrt(b_k+1)). Time and effort alone make a convex problem (Verscheure et
al. 2009); limits of jerk, power and rates of torques do not, so that the result is a local optimum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Immutable
from ckc_pin.errors import NumericalError
from ckc_pin.optimization.along_path import PathDynamics, largest_path_rates, minimum_norm_within
from ckc_pin.optimization.ipopt import make_settings
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.spec import MinimizeSpec
from ckc_pin.optimization.speed_profile import SpeedProfile

__all__ = ["PathOptimum", "optimize_profile"]

MAX_ITERATIONS = 300  # of IPOPT
TOLERANCE = 1e-9  # of it
SLOWER = 1.3  # duration of the initial guess, relative to the fastest motion
MIN_B = 1e-8  # of the largest b: lower bound of b inside


@dataclass(frozen=True, eq=False)
class PathOptimum(Immutable):
    """A motion along a path: its profile, the parts of its cost, and iterations of the optimizer."""

    profile: SpeedProfile
    parts: dict[str, float]
    iterations: int


def optimize_profile(
    dynamics: ReducedDynamics, path: PathDynamics, limits: MotionLimits, minimize: MinimizeSpec, fastest: SpeedProfile
) -> PathOptimum:
    """Return the motion along a path, from rest to rest, of smallest cost.

    Parameters
    ----------
    dynamics : ReducedDynamics
    path : PathDynamics
        At the points of the grid.
    limits : MotionLimits
        Those of coordinates, singularity and points hold along the path.
    minimize : MinimizeSpec
        Without tracking.
    fastest : SpeedProfile
        The fastest motion, on the same grid.

    Raises
    ------
    NumericalError
        IPOPT found no optimum.
    """
    import casadi as cs

    problem = _Problem(dynamics, path, limits, minimize, fastest)
    bounds = np.array(problem.bounds).T
    g = cs.vertcat(*problem.rows)
    cost = sum(getattr(minimize, name) * part for name, part in problem.parts.items())
    solver = cs.nlpsol("profile", "ipopt", {"x": problem.w, "f": cost, "g": g},
                       {"print_time": False, "ipopt": make_settings(MAX_ITERATIONS, TOLERANCE)})  # fmt: skip
    result = solver(x0=problem.guess, lbx=problem.lower, ubx=problem.upper, lbg=bounds[0], ubg=bounds[1])
    stats = solver.stats()
    if not stats["success"]:
        raise NumericalError(
            f"optimize: stuck: IPOPT reports {stats['return_status']} after {stats['iter_count']} iterations along the "
            "path; give other intervals, weights or limits"
        )
    w = result["x"].full().ravel()
    values = cs.Function("parts", [problem.w], [*problem.parts.values(), problem.u, problem.b])(w)
    *parts, u, b = (x.full().ravel() for x in values)
    named = {name: float(x[0]) for name, x in zip(problem.parts, parts, strict=True)}
    slopes = np.diff(u) / np.diff(path.s)
    return PathOptimum(SpeedProfile(path.s, b, slopes), named, int(stats["iter_count"]))


class _Problem:
    """Variables, cost and constraints of a profile: b inside, u and motor torques at all points, and two for maxima."""

    def __init__(
        self, dynamics: ReducedDynamics, path: PathDynamics, limits: MotionLimits, minimize: MinimizeSpec,
        fastest: SpeedProfile,
    ) -> None:  # fmt: skip
        import casadi as cs

        self.rows: list[Any] = []
        self.bounds: list[tuple[float, float]] = []
        self.path, self.limits, self.dynamics = path, limits, dynamics
        points, motors = len(path.s), dynamics.motors
        step, largest = np.diff(path.s), float(fastest.b.max())
        start_b = fastest.b / SLOWER**2
        start_u = np.gradient(start_b, path.s) / 2
        force = path.force(start_u, start_b)
        start_tau = np.clip(minimum_norm_within(path.transmission, force, limits.torque), *limits.torque)
        unit = np.maximum(np.abs(start_tau).max(axis=0), 1e-9 * max(float(np.abs(force).max()), 1e-9))
        w_b, w_u = cs.SX.sym("b", points - 2), cs.SX.sym("u", points)
        w_tau, w_power = cs.SX.sym("tau", motors * points), cs.SX.sym("power", motors * points * bool(minimize.energy))
        peak = cs.SX.sym("peak", bool(minimize.peak_torque))
        self.w = cs.vertcat(w_b, w_u, w_tau, w_power, peak)
        self.b, self.u = largest * cs.vertcat(0, w_b, 0), largest * w_u
        rate = cs.sqrt(self.b[1:-1])
        s_dot = cs.vertcat(0, rate, 0)
        self.duration = 2 * cs.DM(step) / (s_dot[1:] + s_dot[:-1])
        tau = [unit[k] * w_tau[k * points : (k + 1) * points] for k in range(motors)]
        size = float(np.abs(force).max())
        self._require((self.b[1:] - self.b[:-1] - cs.DM(step) * (self.u[1:] + self.u[:-1])) / largest, 0.0, 0.0)
        for i in range(dynamics.d):
            needed = (cs.DM(path.inertia[:, i]) * self.u + cs.DM(path.centrifugal[:, i]) * self.b
                      + cs.DM(path.damping[:, i]) * s_dot + cs.DM(path.static[:, i]))  # fmt: skip
            produced = sum(cs.DM(path.transmission[:, i, k]) * tau[k] for k in range(motors))
            self._require((needed - produced) / size, 0.0, 0.0)
        q_at = dynamics.q_at.tolist()
        accelerations = {k: cs.DM(path.v_tree[:, k]) * self.u + cs.DM(path.a_tree[:, k]) * self.b
                         for k in range(dynamics.n) if k in q_at or np.isfinite(limits.acceleration[k])}  # fmt: skip
        for k, acceleration in accelerations.items():
            self._limit(acceleration, limits.acceleration[k])
        shafts = path.v_tree @ dynamics.mechanism.motors.transmission.T
        power = [tau[k] * cs.DM(shafts[:, k]) * s_dot for k in range(motors)]
        for k in range(motors):
            self._limit(power[k], limits.power[k])
            self._limit_rate(tau[k], limits.torque_rate[k])
        for i, k in enumerate(q_at):
            self._limit_rate(accelerations[k], limits.jerk[i])
        self.parts: dict[str, Any] = {}
        if minimize.time:
            self.parts["time"] = cs.sum1(self.duration)
        if minimize.effort:
            self.parts["effort"] = sum(
                cs.dot(self.duration, x[1:] ** 2 + x[1:] * x[:-1] + x[:-1] ** 2) / 3 for x in tau
            )
        if minimize.torque_rate:
            self.parts["torque_rate"] = sum(cs.sum1((x[1:] - x[:-1]) ** 2 / self.duration) for x in tau)
        if minimize.jerk:
            self.parts["jerk"] = sum(
                cs.sum1((accelerations[k][1:] - accelerations[k][:-1]) ** 2 / self.duration) for k in q_at
            )
        start_power = np.maximum(start_tau * shafts * np.sqrt(start_b)[:, None], 0.0)
        power_unit = max(float(start_power.max(initial=0.0)), 1e-9)
        if minimize.energy:
            drawn = [power_unit * w_power[k * points : (k + 1) * points] for k in range(motors)]
            for one, other in zip(drawn, power, strict=True):
                self._require((one - other) / power_unit, 0.0, np.inf)
            self.parts["energy"] = sum(cs.dot(self.duration, x[1:] + x[:-1]) / 2 for x in drawn)
        if minimize.peak_torque:
            top = float(unit.max())
            for x in tau:
                self._require((top * peak - x) / top, 0.0, np.inf)
                self._require((top * peak + x) / top, 0.0, np.inf)
            self.parts["peak_torque"] = top * peak
        if np.isfinite(limits.time):
            self._require(cs.sum1(self.duration) / limits.time, -np.inf, 1.0)
        highest = largest_path_rates(dynamics, path, limits)[1:-1] / largest
        free = np.full(motors * points * bool(minimize.energy) + bool(minimize.peak_torque), np.inf)
        self.lower = np.concatenate([np.full(points - 2, MIN_B), np.full(points, -np.inf),
                                     np.repeat(limits.torque[0] / unit, points), 0 * np.zeros_like(free)])  # fmt: skip
        self.upper = np.concatenate(
            [highest, np.full(points, np.inf), np.repeat(limits.torque[1] / unit, points), free]
        )
        self.guess = np.concatenate([start_b[1:-1] / largest, start_u / largest, (start_tau / unit).T.ravel(),
                                     (start_power.T.ravel() / power_unit)[: len(free)] if minimize.energy else [],
                                     np.ones(int(bool(minimize.peak_torque)))])  # fmt: skip

    def _require(self, expression: Any, low: float, high: float) -> None:
        self.rows.append(expression)
        self.bounds += [(low, high)] * int(expression.numel())

    def _limit(self, expression: Any, limit: float) -> None:
        if np.isfinite(limit):
            self._require(expression / float(limit), -1.0, 1.0)

    def _limit_rate(self, values: Any, limit: float) -> None:
        """Limit the rate of a quantity between the points."""
        if np.isfinite(limit):
            self._require((values[1:] - values[:-1]) / (float(limit) * self.duration), -1.0, 1.0)
