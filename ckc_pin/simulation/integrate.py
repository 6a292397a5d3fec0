"""The step loop: SciPy's solvers, one accepted step at a time.

What the loop adds to a solver: states where the right-hand side does not exist are offered to it as NaN,
so that it shortens its step instead of failing; the closure is projected between steps; budgets; and an
interpolant good enough for output between them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.scene import SolverSpec
from ckc_pin.simulation.stiffness import bdf_rtol, choose
from ckc_pin.simulation.systems import Dae, System, nearly_singular

__all__ = ["BudgetError", "Step", "Stepper"]

EXPLICIT = ("RK23", "RK45", "DOP853")
ONE_STEP = (*EXPLICIT, "Radau")
CAUTION = 5 / 6  # of the step SciPy proposes to an explicit method, a third of which are refused: 7 % less work
GROWTH = 2.0  # of an explicit method's step; more when two steps in a row ask for it, for one may do so by chance
DOUBT = 50  # steps
RECENT = 12  # evaluations remembered: those of one Newton iteration and of one Jacobian
NEWTON_TOL = 0.03  # of the local error; SciPy's own, rtol^0.5, takes a third more right-hand sides for nothing


class BudgetError(Exception):
    """A budget of the scene is used up."""


@dataclass(frozen=True)
class Step:
    """One accepted step and y in between."""

    t_old: float
    t: float
    interpolant: Callable[[float], Array]


class Stepper:
    """A SciPy solver on a system, with the counts that a run reports.

    Parameters
    ----------
    system : System
    method : str
        A class of `scipy.integrate`; "IDA", for a DAE that is not projected; or "auto", which chooses one by the
        eigenvalues at the start.
    spec : SolverSpec
    t_end : float

    Raises
    ------
    InputError
        Projection with a multistep method, whose history it would corrupt.
    """

    def __init__(self, system: System, method: str, spec: SolverSpec, t_end: float) -> None:
        if system.projects and method not in ("auto", *ONE_STEP):
            raise InputError(
                f"solver: {method} is a multistep method, and projection edits the state between steps, which "
                f"corrupts its history; take one of {', '.join(ONE_STEP)}, or projection = false"
            )
        self.system = system
        self.spec = spec
        self.rhs_count = self.steps = self.rejected = 0
        self.failure: NumericalError | None = None
        self.growing = False  # whether the last step asked for one of more than `GROWTH` times its length
        self._deadline = perf_counter() + spec.max_wall_s if spec.max_wall_s else np.inf
        self._budgeted = False  # from the first step on: what a solver evaluates to be made is let pass
        self._times: set[float] = set()
        self.y = system.start()
        self._before = (0.0, self.y)
        self._recent: deque[tuple[float, Array, Array]] = deque(maxlen=RECENT)
        self._rhs(0.0, self.y, at_start=True)
        self._known_jacobian: Array | None = None
        jacobian = self._jacobian(0.0, self.y) if method in ("auto", "BDF", "Radau") else None
        self._take(self._choose(jacobian, t_end) if method == "auto" else method, method == "auto", jacobian)
        # eigenvalues at the start foretell nothing of what comes: DOP853 is doubted after so many steps
        self.doubt = DOUBT if method == "auto" and self.method == "DOP853" else np.inf
        self.solver = self._solver(0.0, self.y, t_end)
        self._budgeted = True
        self._retired = {"nlu": 0, "njev": 0}  # counts of solvers that a change of coordinates ended

    def _choose(self, jacobian: Array | None, duration: float) -> str:
        """What "auto" stands for: implicit where nothing is known, but no multistep method where y is edited."""
        method = "Radau"
        if jacobian is not None and np.all(np.isfinite(jacobian)):
            method = choose(jacobian, duration, self.system.held)
        if method == "BDF" and isinstance(self.system, Dae):
            self.system.close_within()
        return "Radau" if method == "BDF" and self.system.projects else method

    def _take(self, method: str, auto: bool, jacobian: Array | None) -> None:
        """Take a method from the next solver on."""
        import scipy.integrate

        spec, self.method = self.spec, method
        rtol = bdf_rtol(spec.rtol, self.system.held) if auto and method == "BDF" else spec.rtol
        atol = spec.atol if spec.atol is not None else spec.rtol / 100
        self.options: dict[str, Any] = {"rtol": rtol, "atol": atol * rtol / spec.rtol}
        if spec.max_step:
            self.options["max_step"] = spec.max_step
        if method in ("BDF", "Radau") and jacobian is not None:
            self.options["jac"] = self._jacobian
        self._class: Any = self._ida if method == "IDA" else getattr(scipy.integrate, method)

    def _reconsider(self) -> None:
        """Look at the eigenvalues once more, and go on with another method if they ask for one."""
        self.doubt *= 2
        t, y = self.t, self.solver.y.copy()
        jacobian = self._jacobian(t, y)
        if jacobian is None or not np.all(np.isfinite(jacobian)):
            return
        method = self._choose(jacobian, self.solver.t_bound - t)
        if method != self.method:
            self.doubt, length = np.inf, self.solver.step_size
            self._take(method, True, jacobian)
            self._restart(t, y, length)

    def _solver(self, t: float, y: Array, t_end: float, **options: Any) -> Any:
        with np.errstate(all="ignore"):
            solver = self._class(self._rhs, t, y, t_end, **self.options, **options)
        if self.method == "BDF":
            solver.newton_tol = NEWTON_TOL
        return solver

    @property
    def t(self) -> float:
        """Time reached."""
        return float(self.solver.t)

    @property
    def before(self) -> tuple[float, Array]:
        """Where the last step began: t and y."""
        return self._before

    def step(self) -> Step:
        """Advance by one accepted step; to be followed by `settle` once the step has been looked at.

        Raises
        ------
        NumericalError
            The solver cannot go on; the message says why.
        BudgetError
            A budget is used up.
        """
        solver = self.solver
        t_old, y_old, f_old = self.t, solver.y.copy(), getattr(solver, "f", None)
        before = self.rhs_count
        self._times.clear()
        try:
            with np.errstate(all="ignore"):
                message = solver.step()
        except (ValueError, np.linalg.LinAlgError) as error:  # an overflow in an implicit method's own algebra
            raise self._explain(f"the solver met a number that is not finite ({error})") from None
        if solver.status == "failed":
            raise self._explain(message)
        self._before = (t_old, y_old)
        if self.method in EXPLICIT:
            most, proposed = GROWTH * (solver.t - t_old), CAUTION * solver.h_abs
            asked = bool(solver.status == "running" and proposed > most)
            solver.h_abs = most if asked and not self.growing else proposed
            self.growing = asked
        self.steps += 1
        self.rejected += self._attempts(self.rhs_count - before) - 1
        if solver.t - t_old < self.spec.min_step and solver.status == "running":
            raise self._explain(f"the step fell below min_step = {self.spec.min_step:g} s")
        self.failure = None
        return Step(t_old, self.t, self._interpolant(t_old, y_old, f_old))

    def settle(self) -> None:
        """Let the system take note of the step, project its state, or change its coordinates.

        Raises
        ------
        NumericalError
            The system's coordinates end here.
        """
        solver, switches = self.solver, self.system.counts.switches
        projected = self.system.accept(self.t, solver.y)
        if self.system.counts.switches > switches and projected is not None:
            self._restart(self.t, projected, solver.step_size)
        elif projected is not None:
            solver.y = projected
            solver.f = self._rhs(self.t, projected)
        if self.steps >= self.doubt and self.solver.status == "running":
            self._reconsider()

    def _ida(self, *start: Any, **options: Any) -> Any:
        from ckc_pin.simulation.ida import Ida

        assert isinstance(self.system, Dae)
        return Ida(*start, system=self.system, count=self.count, **options)

    def refine(self, rtol: float) -> bool:
        """Take a finer tolerance from the next solver on; return whether it is finer than before."""
        finer = rtol < self.options["rtol"]
        if finer:
            self.options.update(rtol=rtol, atol=min(self.options["atol"], rtol / 100))
        return finer

    def adopt(self, t: float, y: Array, f: Array, h_abs: float, before: tuple[float, Array]) -> None:
        """Go on from (t, y) with rate f, where the native loop has stepped to; its last step began at `before`."""
        solver = self.solver
        solver.t, solver.y, solver.f, solver.h_abs, solver.t_old = t, y, f, h_abs, before[0]
        self._before = before
        if t >= solver.t_bound:
            solver.status = "finished"

    def go_on(self, t: float, y: Array, length: float) -> None:
        """Go on from (t, y), which something else integrated to; the next step tries a length."""
        if t < self.solver.t_bound:
            self._restart(t, y, length)
        else:
            self.solver.t, self.solver.y, self.solver.status = t, y, "finished"

    def take_back(self, length: float) -> None:
        """Undo the last step; the next one tries another length."""
        t_old, y_old = self._before
        self.steps -= 1
        self.rejected += 1
        self._restart(t_old, y_old, length)

    def _restart(self, t: float, y: Array, first_step: float) -> None:
        """Go on with a new solver that remembers nothing."""
        self.growing = False
        self._retired = {name: count + int(getattr(self.solver, name)) for name, count in self._retired.items()}
        t_end = self.solver.t_bound
        self.solver = self._solver(t, y, t_end, first_step=min(first_step, t_end - t))

    def stats(self) -> dict[str, int]:
        """Return the counts so far."""
        solver, counts = self.solver, self.system.counts
        return {
            "rhs": self.rhs_count,
            "steps": self.steps,
            "rejected": self.rejected,
            "newton": counts.newton,
            "factorizations": counts.factorizations + int(solver.nlu) + self._retired["nlu"],
            "jacobians": int(solver.njev) + self._retired["njev"],
            "switches": counts.switches,
        }

    def _rhs(self, t: float, y: Array, at_start: bool = False) -> Array:
        self.count(t)
        try:
            with np.errstate(all="ignore"):
                derivative = self.system.rhs(t, y) if np.all(np.isfinite(y)) else np.full_like(y, np.nan)
        except NumericalError as error:
            if at_start:
                raise
            self.failure = error
            return np.full_like(y, np.nan)
        if not np.all(np.isfinite(derivative)):
            if self.failure is None or np.all(np.isfinite(y)):  # else the reason is what made y so
                self.failure = NumericalError("the right-hand side is not finite", t=t)
            if at_start:
                raise self.failure
        self._recent.append((t, y.copy(), derivative))
        return derivative

    def count(self, *times: float) -> None:
        """Take note of evaluations, as long as there is a budget for them."""
        most = self.spec.max_rhs
        if self._budgeted and most is not None and self.rhs_count + len(times) > most:
            raise BudgetError(f"the budget of max_rhs = {most} right-hand sides is used up")
        self.rhs_count += len(times)
        self._times.update(times)
        self.require_time()

    def require_time(self) -> None:
        """Raise BudgetError when max_wall_s is used up."""
        if self._budgeted and perf_counter() > self._deadline:
            raise BudgetError(f"the budget of max_wall_s = {self.spec.max_wall_s:g} s is used up")

    def _jacobian(self, t: float, y: Array) -> Array | None:
        """The system's Jacobian; a right-hand side that the solver has just evaluated is not evaluated again."""

        def rhs(t: float, y: Array) -> Array:
            for known_t, known_y, known in self._recent:
                if t == known_t and np.array_equal(y, known_y):
                    return known
            return self._rhs(t, y)

        try:
            jacobian = self.system.jacobian(t, y, rhs)
        except NumericalError as error:
            self.failure = error
            jacobian = np.full((len(y), len(y)), np.nan)
        if jacobian is not None and not np.all(np.isfinite(jacobian)) and self._known_jacobian is not None:
            return self._known_jacobian  # the step is refused for its right-hand side
        self._known_jacobian = jacobian
        return jacobian

    def _explain(self, message: str) -> NumericalError:
        """Say why the solver gave up: the closure's own verdict where there is one."""
        if self.failure is not None:
            return NumericalError(str(self.failure), t=self.t, q_tree=self.failure.q_tree)
        reason = (message if message[:2].isupper() else message[0].lower() + message[1:]).rstrip(".")
        nearly = nearly_singular(self.system.terms(self.t, self.solver.y).at, 1e-3)
        return NumericalError(f"{nearly}; {reason}" if nearly else reason, t=self.t)

    def _attempts(self, evaluations: int) -> int:
        """How many steps were tried in one accepted step, from what was evaluated."""
        if self.method in ("RK23", "RK45", "DOP853"):
            return max(1, evaluations // int(self.solver.n_stages))
        stages = 3 if self.method == "Radau" else 1
        distinct = len(self._times - {self.solver.t_old})
        return max(1, -(-distinct // stages))

    def _interpolant(self, t_old: float, y_old: Array, f_old: Array | None) -> Callable[[float], Array]:
        """Radau's own interpolant is of order 3 only and IDA has none: end derivatives are used; else the solver's."""
        solver = self.solver
        if self.method not in ("Radau", "IDA") or f_old is None:
            dense: list[Callable[[float], Array]] = []
            t_new, y_new = float(solver.t), solver.y.copy()

            def own(t: float) -> Array:
                if t in (t_old, t_new):  # no interpolation, which costs DOP853 three right-hand sides
                    return np.array(y_old if t == t_old else y_new)
                if not dense:
                    dense.append(_frozen_dense_output(solver))
                return np.asarray(dense[0](t))

            return own
        t_new, y_new = float(solver.t), solver.y.copy()
        slopes = self.system.slope(t_old, y_old, f_old), self.system.slope(t_new, y_new, solver.f.copy())
        return _hermite(t_old, y_old, slopes[0], t_new, y_new, slopes[1], self.system.positions)


def _frozen_dense_output(solver: Any) -> Callable[[float], Array]:
    output: Callable[[float], Array] = solver.dense_output()
    return output


def _hermite(
    t0: float, y0: Array, f0: Array, t1: float, y1: Array, f1: Array, positions: int
) -> Callable[[float], Array]:
    """Cubic Hermite interpolation of y; of fifth degree for positions, whose second derivatives are in f.

    y = (positions, their rates, rest): rates are the derivative of the positions' quintic.
    """
    h, n = t1 - t0, positions

    def at(t: float) -> Array:
        s = (t - t0) / h
        y = (
            (1 + 2 * s) * (1 - s) ** 2 * y0
            + s * (1 - s) ** 2 * h * f0
            + s**2 * (3 - 2 * s) * y1
            + s**2 * (s - 1) * h * f1
        )
        if n:
            q0, v0, a0 = y0[:n], h * f0[:n], h * h * f0[n : 2 * n]
            q1, v1, a1 = y1[:n], h * f1[:n], h * h * f1[n : 2 * n]
            # p(s) = q0 + v0 s + a0 s^2 / 2 + c3 s^3 + c4 s^4 + c5 s^5
            gap, slope, bend = q1 - q0 - v0 - a0 / 2, v1 - v0 - a0, a1 - a0
            c3 = 10 * gap - 4 * slope + bend / 2
            c4 = -15 * gap + 7 * slope - bend
            c5 = 6 * gap - 3 * slope + bend / 2
            y[:n] = q0 + s * (v0 + s * (a0 / 2 + s * (c3 + s * (c4 + s * c5))))
            y[n : 2 * n] = (v0 + s * (a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h
        return y

    return at
