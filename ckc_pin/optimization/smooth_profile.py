"""Speed along a path with other costs and limits than those of the fastest motion, by nonlinear programming.

With b = s_dot^2 and u = s_ddot linear in s between the points of a grid, eq. 6 at the points gives the motor torques.
Durations of intervals are 2 ds / (sqrt(b_k) + sqrt(b_k+1)). Time and effort alone make a convex problem (Verscheure et
al. 2009); limits of jerk, power and rates of torques do not, so that the result is a local optimum.
"""

from __future__ import annotations

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


class PathOptimum(Immutable, frozen=True):
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
    status, iterations = stats["return_status"], stats["iter_count"]
    if status == "Infeasible_Problem_Detected":
        raise NumericalError("optimize: infeasible: no motion along the path fulfils all limits; raise them")
    if status == "Maximum_Iterations_Exceeded":
        raise NumericalError(
            f"optimize: budget: no optimum along the path after {iterations} iterations; give other intervals, weights "
            "or limits"
        )
    if not stats["success"]:
        raise NumericalError(
            f"optimize: stuck: IPOPT reports {status} after {iterations} iterations along the path; give other "
            "intervals, weights or limits"
        )
    w = result["x"].full().ravel()
    values = cs.Function("parts", [problem.w], [*problem.parts.values(), problem.u, problem.b])(w)
    *parts, u, b = (x.full().ravel() for x in values)
    named = {name: float(x[0]) for name, x in zip(problem.parts, parts, strict=True)}
    slopes = np.diff(u) / np.diff(path.s)
    return PathOptimum(SpeedProfile(path.s, b, slopes), named, int(stats["iter_count"]))


class _Problem:
    """The nonlinear program of a profile.

    Variables are b between both ends, u and the motor torques at all points, the work that each motor gives by s at
    all points if energy has a weight, and the largest torque if it has one.
    """

    def __init__(
        self, dynamics: ReducedDynamics, path: PathDynamics, limits: MotionLimits, minimize: MinimizeSpec,
        fastest: SpeedProfile,
    ) -> None:  # fmt: skip
        import casadi as cs

        self.path, self.limits, self.dynamics = path, limits, dynamics
        self.rows: list[Any] = []
        self.bounds: list[tuple[float, float]] = []
        self.parts: dict[str, Any] = {}
        points, motors = len(path.s), dynamics.motors
        self.shafts = path.v_tree @ dynamics.mechanism.motors.transmission.T  # rates for s_dot = 1
        b, largest = fastest.b / SLOWER**2, float(fastest.b.max())
        u = np.gradient(b, path.s) / 2
        force = path.force(u, b)
        torque = minimum_norm_within(path.transmission, force, limits.torque)
        work = np.maximum(torque * self.shafts, 0.0)  # by s
        self.size = float(np.abs(force).max())
        self.unit = np.maximum(np.abs(torque).max(axis=0), 1e-9 * max(self.size, 1e-9))
        self.work_unit = max(float(work.max(initial=0.0)), 1e-9)
        blocks = {
            "b": (b[1:-1] / largest, MIN_B, largest_path_rates(dynamics, path, limits)[1:-1] / largest),
            "u": (u / largest, -np.inf, np.inf),
            "tau": ((torque / self.unit).T.ravel(), *(np.repeat(x / self.unit, points) for x in limits.torque)),
            "work": ((work / self.work_unit).T.ravel() if minimize.energy else np.zeros(0), 0.0, np.inf),
            "peak": (np.ones(1 if minimize.peak_torque else 0), 0.0, np.inf),
        }
        guesses, lower, upper = zip(*blocks.values(), strict=True)
        self.guess = np.concatenate(guesses)
        self.lower, self.upper = (
            np.concatenate([np.broadcast_to(x, len(y)) for x, y in zip(bound, guesses, strict=True)])
            for bound in (lower, upper)
        )
        w = {name: cs.SX.sym(name, len(guess)) for name, guess in zip(blocks, guesses, strict=True)}
        self.w = cs.vertcat(*w.values())
        self.b, self.u = largest * cs.vertcat(0, w["b"], 0), largest * w["u"]
        self.s_dot = cs.vertcat(0, cs.sqrt(self.b[1:-1]), 0)  # sqrt has no derivative at 0
        self.duration = 2 * cs.DM(np.diff(path.s)) / (self.s_dot[1:] + self.s_dot[:-1])
        self.tau = [self.unit[k] * w["tau"][k * points : (k + 1) * points] for k in range(motors)]
        self.power = [self.tau[k] * cs.DM(self.shafts[:, k]) * self.s_dot for k in range(motors)]
        self.a = {k: cs.DM(path.v_tree[:, k]) * self.u + cs.DM(path.a_tree[:, k]) * self.b
                  for k in range(dynamics.n) if k in dynamics.q_at or np.isfinite(limits.acceleration[k])}  # fmt: skip
        drawn = cs.reshape(w["work"], -1, motors) if minimize.energy else None
        self._add_equations(largest)
        self._add_limits()
        self._add_parts(minimize, drawn, w["peak"])

    def _add_equations(self, largest: float) -> None:
        """Require that b belongs to u and is positive between the points, and eq. 6 at all points."""
        import casadi as cs

        path, step = self.path, cs.DM(np.diff(self.path.s))
        self._require((self.b[1:] - self.b[:-1] - step * (self.u[1:] + self.u[:-1])) / largest, 0.0, 0.0)
        # b is a quadratic polynomial of s in each interval, positive inside if its second Bernstein coefficient is.
        self._require((self.b[:-1] + step * self.u[:-1]) / largest, MIN_B, np.inf)
        for i in range(self.dynamics.d):
            needed = (cs.DM(path.inertia[:, i]) * self.u + cs.DM(path.centrifugal[:, i]) * self.b
                      + cs.DM(path.damping[:, i]) * self.s_dot + cs.DM(path.static[:, i]))  # fmt: skip
            produced = sum(cs.DM(path.transmission[:, i, k]) * tau for k, tau in enumerate(self.tau))
            self._require((needed - produced) / self.size, 0.0, 0.0)

    def _add_limits(self) -> None:
        """Limit accelerations, power, rates of torques, jerks and the duration."""
        import casadi as cs

        limits = self.limits
        for at, acceleration in self.a.items():
            self._limit(acceleration, limits.acceleration[at])
        for k, (tau, power) in enumerate(zip(self.tau, self.power, strict=True)):
            self._limit(power, limits.power[k])
            self._limit_rate(tau, limits.torque_rate[k])
        if np.isfinite(limits.total_power):
            self._require(sum(self.power) / float(limits.total_power), -np.inf, 1.0)
        for i, at in enumerate(self.dynamics.q_at.tolist()):
            self._limit_rate(self.a[at], limits.jerk[i])
        if np.isfinite(limits.time):
            self._require(cs.sum1(self.duration) / limits.time, -np.inf, 1.0)

    def _add_parts(self, minimize: MinimizeSpec, work: Any, peak: Any) -> None:
        """Add the parts of the cost that have weights."""
        import casadi as cs

        parts, duration = self.parts, self.duration
        if minimize.time:
            parts["time"] = cs.sum1(duration)
        if minimize.effort:
            parts["effort"] = sum(cs.dot(duration, x[1:] ** 2 + x[1:] * x[:-1] + x[:-1] ** 2) / 3 for x in self.tau)
        if minimize.torque_rate:
            parts["torque_rate"] = sum(self._integrate_squared_rate(x) for x in self.tau)
        if minimize.jerk:
            parts["jerk"] = sum(self._integrate_squared_rate(self.a[at]) for at in self.dynamics.q_at.tolist())
        if minimize.energy:
            step, energy = cs.DM(np.diff(self.path.s)), 0
            for k, tau in enumerate(self.tau):
                self._require(work[:, k] - tau * cs.DM(self.shafts[:, k]) / self.work_unit, 0.0, np.inf)
                energy += self.work_unit * cs.dot(step, work[1:, k] + work[:-1, k]) / 2
            parts["energy"] = energy
        if minimize.peak_torque:
            top = float(self.unit.max())
            for tau in self.tau:
                self._require(peak - tau / top, 0.0, np.inf)
                self._require(peak + tau / top, 0.0, np.inf)
            parts["peak_torque"] = top * peak

    def _integrate_squared_rate(self, values: Any) -> Any:
        """Return the integral of the squared rate of a quantity that is linear between the points."""
        import casadi as cs

        return cs.sum1((values[1:] - values[:-1]) ** 2 / self.duration)

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
