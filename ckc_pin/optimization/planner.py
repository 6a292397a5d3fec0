"""Optimal control over a horizon that is solved again from each new state: model-predictive control."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.validation import describe_value, is_number, require_table
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.collocation import Collocation
from ckc_pin.optimization.end_states import refuse_unsupported, resolve_state
from ckc_pin.optimization.first_guess import guess_between, interpolation, sample_motion
from ckc_pin.optimization.guess_motions import Shifted
from ckc_pin.optimization.ipopt import Ipopt, Optimum
from ckc_pin.optimization.limits import make_limits
from ckc_pin.optimization.mesh_motion import Guess, Mesh, Places, Solution
from ckc_pin.optimization.optimize import read_arguments
from ckc_pin.optimization.point_to_point import read_desired_motion, require_solved
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.spec import StateSpec
from ckc_pin.run.state import State

__all__ = ["HorizonPlan", "Planner"]

INTERVALS = 20
MAX_ITERATIONS = 100
MIN_PART = 0.05  # of the last duration: a free duration is guessed to be at least as long
TOLERANCE = 1e-6  # of IPOPT, relative to the scaled problem


class HorizonPlan(Immutable, frozen=True):
    """A motion from a state on, with its motor torques.

    Attributes
    ----------
    t_start, t_end : float
        s.
    cost : float
    parts : dict of str to float
        Parts of the cost, without weights.
    iterations : int
    wall_s : float
        Time that the solution took.
    motion : PiecewisePolynomial
        Independent coordinates over the time since `t_start`, with rates and accelerations.
    torque_t, torque : (k,) and (k, motors) arrays
        Motor torques, linear between the rows, over the time since `t_start`.
    """

    t_start: float
    t_end: float
    cost: float
    parts: dict[str, float]
    iterations: int
    wall_s: float
    motion: PiecewisePolynomial
    torque_t: Array
    torque: Array

    def tau(self, t: float) -> Array:
        """Return the motor torques at a time, (motors,); those of an end beyond it."""
        return np.asarray(interpolation(self.torque_t, self.torque)(np.array([t - self.t_start]))[0])


class Planner:
    """Optimal control over a horizon, solved again from each new state.

    Each solution begins at the one before, shifted by the time that has passed. The nonlinear program is built once.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
    horizon : float, optional
        Duration of each motion, s. Default: as short as possible, which needs ``to``.
    to : mapping, optional
        Where each motion ends, as in `optimize`. Default: anywhere.
    minimize : mapping, optional
        Weights, as in `optimize`. Default: the time.
    limits : mapping, optional
        Limits, as in `optimize`, without ``time``.
    desired : mapping, optional
        The motion that ``minimize["tracking"]`` refers to, as in `optimize`, over the time of the states.
    intervals : int
        Of the mesh.

    Raises
    ------
    InputError
        Unknown names, or a problem without a solution.

    Examples
    --------
    >>> planner = Planner("five_bar", horizon=0.4, to={"q": {"theta_1": -1.0, "theta_3": -1.9}},
    ...                   minimize={"effort": 1.0}, limits={"torque": 2.0})
    >>> plan = planner.solve({"t": 0.0, "q": {"theta_1": -1.434, "theta_3": -1.707}, "q_dot": {}})
    >>> plan.tau(0.01).shape
    (2,)
    """

    def __init__(
        self,
        mechanism: Mechanism | str | Path,
        *,
        horizon: float | None = None,
        to: Mapping[str, Any] | None = None,
        minimize: Mapping[str, float] | None = None,
        limits: Mapping[str, Any] | None = None,
        desired: Mapping[str, Any] | None = None,
        intervals: int = INTERVALS,
    ) -> None:
        self.mechanism = as_mechanism(mechanism, "Planner")
        if horizon is not None and not (is_number(horizon) and 0 < horizon < np.inf):
            raise InputError(f"Planner: horizon: expected a positive number of seconds, got {describe_value(horizon)}")
        if limits and "time" in limits:
            raise InputError("Planner: limits.time: the duration is horizon; remove it")
        if horizon is None and to is None:
            raise InputError("Planner: without a horizon, motions need an end; give to")
        with_time = dict(limits or {}) | ({} if horizon is None else {"time": horizon})
        tables = {"to": to, "minimize": minimize, "limits": with_time, "desired": desired}
        spec, sources = read_arguments(self.mechanism, tables, intervals, "Planner")
        self._minimize, self._limits = spec.minimize, make_limits(spec.limits, self.mechanism)
        if horizon is None and not spec.minimize.time:
            raise InputError("Planner: without a horizon, minimize needs a weight of time; give one of them")
        refuse_unsupported(self.mechanism, spec.minimize, self._limits, spec.desired)
        if self.mechanism.joints.friction.any():
            raise InputError("Planner: dry friction is not supported; set it to 0 in the planner's mechanism")
        self._dynamics, self.horizon = ReducedDynamics(self.mechanism), horizon
        self._end = None if spec.to is None else resolve_state(self.mechanism, spec.to, self.mechanism.assembled, "to")
        if spec.desired is not None and "point" in spec.desired:
            raise InputError("Planner: desired: paths of points are not supported; give a table of coordinates")
        self._desired = (
            None if spec.desired is None else read_desired_motion(spec.desired, self.mechanism, sources, 0.0)
        )
        self._mesh = Mesh(np.linspace(0.0, 1.0, intervals + 1))
        self._problem: Collocation | None = None
        self._last: tuple[HorizonPlan, Optimum] | None = None
        self._q_tree = self.mechanism.q_tree

    def solve(self, state: State | Mapping[str, Any]) -> HorizonPlan:
        """Plan the motion from a state on.

        Parameters
        ----------
        state : State or mapping
            ``simulator.state``, or ``{"t": t, "q": {...}, "q_dot": {...}}``.

        Raises
        ------
        InputError
            The state cannot be reached from the last one with closed loops.
        NumericalError
            No motion fulfils the limits, or the optimizer does not find one.
        """
        begin = perf_counter()
        t, q, rates = self._read(state)
        with one_blas_thread():
            closed = self._dynamics.close(self._q_tree[None], q[None])
            if closed is None:
                raise InputError("Planner.solve: state: the loops do not close at q on the branch of the last state")
            self._q_tree = closed[0]
            try:
                solution, optimum = self._optimize(t, q, rates)
            except NumericalError:
                self._last = None
                raise
        motion = solution.motion()
        plan = HorizonPlan(
            t_start=t, t_end=t + float(solution.values.ends[-1]), cost=solution.cost, parts=solution.parts,
            iterations=solution.iterations, wall_s=perf_counter() - begin, motion=motion, torque_t=motion.corners,
            torque=np.clip(solution.values.torque, *self._limits.torque),
        )  # fmt: skip
        self._last = plan, optimum
        return plan

    def _read(self, state: State | Mapping[str, Any]) -> tuple[float, Array, Array]:
        if isinstance(state, State):
            return state.t, state.q, state.q_dot
        names, where = self.mechanism.independent, "Planner.solve: state"
        require_table(state, where, "a State, or a table with t, q and q_dot")
        unknown = next((key for key in state if key not in ("t", "q", "q_dot")), None)
        if unknown is not None or "q" not in state:
            problem = "'q' is missing" if unknown is None else f"unknown key {unknown!r}"
            raise InputError(f"{where}: {problem}; give t, q and q_dot")
        q = self.mechanism.vector(state["q"], names, f"{where}.q")
        rates = self.mechanism.vector(state.get("q_dot", {}), names, f"{where}.q_dot", fill=0.0)
        return float(state.get("t", 0.0)), q, rates

    def _optimize(self, t: float, q: Array, rates: Array) -> tuple[Solution, Optimum]:
        guess = self._guess(t, q, rates)
        free, end = np.full(self.mechanism.d, np.nan), self._end
        places = Places(
            np.array([q, free if end is None else end.q]), np.array([rates, free if end is None else end.rates]),
            np.array([0.0, self.horizon or np.nan]),
        )  # fmt: skip
        desired = None if self._desired is None else self._desired(t + guess.ends[-1] * self._mesh.gauss_places())
        if self._problem is None:
            self._problem = Collocation(
                self._dynamics, self._limits, self._minimize, guess, self._q_tree, places, desired
            )
            self._cold, self._warm = (
                Ipopt(self._problem, iterations=MAX_ITERATIONS, tolerance=TOLERANCE, warm=warm)
                for warm in (False, True)
            )
        else:
            self._problem.set_places(places, desired)
        if self._last is not None:
            solution, optimum = self._problem.solve(guess, self._warm, self._last[1])
            if solution.is_optimum:
                return solution, optimum
        solution, optimum = self._problem.solve(guess, self._cold)
        require_solved(solution)
        return solution, optimum

    def _guess(self, t: float, q: Array, rates: Array) -> Guess:
        """Return the last solution from now on, or a first guess."""
        dynamics, limits, mesh = self._dynamics, self._limits, self._mesh
        if self._last is not None:
            last, passed = self._last[0], t - self._last[0].t_start
            whole = last.t_end - last.t_start
            duration = self.horizon or max(whole - passed, MIN_PART * whole)
            torque = interpolation(last.torque_t - passed, last.torque)
            return sample_motion(dynamics, limits, Shifted(last.motion, passed, duration), mesh, self._q_tree, torque)
        if self._end is None:
            assert self.horizon is not None
            still = PiecewisePolynomial(np.array([0.0, self.horizon]), q[None, None])
            return sample_motion(dynamics, limits, Shifted(still, 0.0, self.horizon), mesh, self._q_tree, None)
        names = self.mechanism.independent
        spec = StateSpec(
            q=dict(zip(names, q.tolist(), strict=True)), q_dot=dict(zip(names, rates.tolist(), strict=True))
        )
        start = resolve_state(self.mechanism, spec, self.mechanism.assembled, "state")
        motion = guess_between(dynamics, self._minimize, limits, start, self._end)
        return sample_motion(dynamics, limits, motion, mesh, self._q_tree, None)
