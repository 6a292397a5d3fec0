"""Integrate one motion in every formulation by SciPy, for the studies of epsilon and of cost.

Nothing is recorded on the way, so that times and counts are those of the integration only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.ivp import Dae, Force, Ivp, LevelSet, PrintedSpf, make_force
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.parts import build_scene_actuation, build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import Scene

__all__ = [
    "W0",
    "Outcome",
    "Problem",
    "between",
    "difference",
    "end_of",
    "five_bar_problem",
    "march",
    "on_level",
    "sample",
    "vector",
]

W0 = np.array([0.01, -0.006])  # w(0) of the studies on the five-bar, m
MOVING = np.array([1.0, -2.0])  # q_dot(0) of their moving start, rad/s
OFFSET = 0.5  # of theta_1 and theta_3 from the equilibrium, rad
OPEN = (0.0, np.inf)  # s: the time span of a `march` is set by its t_end


@dataclass(frozen=True)
class Problem:
    """Mechanism, start and force of a motion.

    Attributes
    ----------
    mechanism : Mechanism
    at : Kinematics
        The start, on phi = 0.
    q_dot : (d,) array
    force : callable
        Function of (t, terms) that returns u' on the tree.
    """

    mechanism: Mechanism
    at: Kinematics
    q_dot: Array
    force: Force

    @classmethod
    def free(cls, mechanism: Mechanism, at: Kinematics, q_dot: Array) -> Problem:
        """Return a problem without actuation."""
        none = np.zeros(mechanism.n)
        return cls(mechanism, at, q_dot, lambda t, terms: none)

    @classmethod
    def of_scene(cls, scene: Scene) -> Problem:
        """Return a problem with a scene's start and controller; formulation, solver and w of the scene are ignored."""
        mechanism = load_scene_mechanism(scene)
        start = find_start(mechanism, scene)
        force = make_force(build_scene_controller(scene, mechanism), build_scene_actuation(scene, mechanism))
        return cls(mechanism, start.at, start.q_dot, force)

    def dae(self) -> Dae:
        """Return eq. 1 with phi_ddot = 0 and without projection."""
        return Dae(self.mechanism, self.at, self.at.rho @ self.q_dot, self.force, OPEN)

    def reduced(self) -> LevelSet:
        """Return eq. 6."""
        return LevelSet(self.mechanism, self.at, self.q_dot, self.force, OPEN)

    def spf(self, epsilon: float, w: Array, convention: CoriolisVelocity = "rho") -> LevelSet:
        """Return eq. 17 from the same q and q_dot, with z on phi = w."""
        start = on_level(self.mechanism, self.at, w)
        return LevelSet(self.mechanism, start, self.q_dot, self.force, OPEN, epsilon, w, convention)

    def printed_spf(self, epsilon: float) -> PrintedSpf:
        """Return eq. 8 as printed, from phi = 0."""
        w0 = np.zeros(self.mechanism.closure.rows)
        return PrintedSpf(self.mechanism, self.at, self.q_dot, self.force, OPEN, epsilon, w0)


def five_bar_problem(moving: bool) -> Problem:
    """Return a free motion of the five-bar from half a radian past the equilibrium, at rest or moving."""
    mechanism = load("five_bar")
    equilibrium = stable_equilibrium(mechanism)
    start = sigma(mechanism, mechanism.independent_part(equilibrium.q_tree) + OFFSET, equilibrium)
    return Problem.free(mechanism, start.at, MOVING if moving else np.zeros(mechanism.d))


@dataclass(frozen=True)
class Outcome:
    """Result of `march`.

    Attributes
    ----------
    t : float
        Time reached, s.
    terms : Terms
        Terms at that time.
    stats : dict of str to int
        rhs, steps, newton (corrections of sigma); jacobians and factorizations of an implicit integrator.
    iterations : int or None
        Newton iterations of an implicit integrator, 0 for an explicit one, None for LSODA, which does not count
        them. For Radau the error is at most a third of the number of rejected steps.
    seconds : float
        Processor time, s.
    stopped : str
        Why the integration ended early; empty otherwise.
    """

    t: float
    terms: Terms
    stats: dict[str, int]
    iterations: int | None
    seconds: float
    stopped: str = ""


def on_level(mechanism: Mechanism, at: Kinematics, w: Array) -> Kinematics:
    """Return the configuration with the same q on phi = w.

    Raises
    ------
    NumericalError
        This branch has none.
    """
    solution = sigma(mechanism, mechanism.independent_part(at.q_tree), at, w)
    if solution.verdict != "converged":
        raise NumericalError(f"no z with phi = {np.asarray(w).tolist()} at this q: {solution.reason}")
    return solution.at


def march(
    ivp: Ivp,
    method: str,
    rtol: float,
    t_end: float,
    *,
    max_rhs: int | None = None,
    on_step: Callable[[Any], None] | None = None,
) -> Outcome:
    """Integrate to t_end, or until the budget of right-hand sides is exhausted or the numerics fail.

    Parameters
    ----------
    ivp : Ivp
    method : str
        Name of a class of `scipy.integrate`; Jacobians are computed by differences.
    rtol : float
        Relative tolerance; atol = rtol / 100.
    t_end : float
    max_rhs : int, optional
    on_step : callable, optional
        Called with SciPy's solver after each accepted step: its t_old, t, y and dense_output().
    """
    import scipy.integrate

    rhs = steps = 0

    def f(t: float, y: Array) -> Array:
        nonlocal rhs
        if rhs == max_rhs:
            raise NumericalError(f"the budget of max_rhs = {max_rhs} right-hand sides is used up")
        rhs += 1
        return ivp.f(t, y)

    stopped, newton, started = "", ivp.counts["newton"], process_time()
    with one_blas_thread(), np.errstate(all="ignore"):  # no right-hand side is NaN, and a shorter step
        solver: Any = getattr(scipy.integrate, method)(f, 0.0, ivp.y0, t_end, rtol=rtol, atol=rtol / 100)
        try:
            while solver.status == "running":
                stopped = solver.step() or ""
                if solver.status == "failed":
                    break
                steps += 1
                if on_step is not None:
                    on_step(solver)
        except (NumericalError, ValueError, np.linalg.LinAlgError) as error:  # or an implicit method's algebra with NaN
            stopped = str(error)
    seconds, t = process_time() - started, float(solver.t)
    stats = {
        "rhs": rhs, "steps": steps, "newton": ivp.counts["newton"] - newton,
        "jacobians": int(solver.njev), "factorizations": int(solver.nlu),
    }  # fmt: skip
    reason = f"stopped at t = {t:.4g} s: {stopped}" if stopped else ""
    return Outcome(t, ivp.terms(t, solver.y), stats, _iterations(method, solver.nfev, steps), seconds, reason)


def _iterations(method: str, nfev: int, steps: int) -> int | None:
    """Return the integrator's Newton iterations from SciPy's nfev, which excludes finite-difference Jacobians.

    Two evaluations choose the first step. An iteration of BDF takes one evaluation. One of Radau takes three, plus one
    at the end of each accepted step and one if the error of a rejected step is estimated again.
    """
    if method == "BDF":
        return nfev - 2
    if method == "Radau":
        return (nfev - 2 - steps) // 3
    return None if method == "LSODA" else 0


def end_of(ivp: Ivp, method: str, rtol: float, t_end: float) -> Terms:
    """Integrate a motion and return the terms at t_end.

    Raises
    ------
    NumericalError
        The motion stops before t_end.
    """
    outcome = march(ivp, method, rtol, t_end)
    if outcome.stopped:
        raise NumericalError(outcome.stopped)
    return outcome.terms


def sample(ivp: Ivp, method: str, rtol: float, times: Array) -> list[Terms]:
    """Integrate a motion and return the terms at increasing times, the first of which is 0.

    Raises
    ------
    NumericalError
        The motion stops before the last time.
    """
    states = [ivp.terms(0.0, ivp.y0)]

    def take(solver: Any) -> None:
        states.extend(ivp.terms(t, y) for t, y in between(solver, times))

    outcome = march(ivp, method, rtol, float(times[-1]), on_step=take)
    if outcome.stopped:
        raise NumericalError(outcome.stopped)
    return states


def between(solver: Any, times: Array) -> list[tuple[float, Array]]:
    """Return t and y at the times within a SciPy solver's last step, including its end."""
    inside = times[(times > solver.t_old) & (times <= solver.t)]
    if not len(inside):  # an interpolant of DOP853 takes three more right-hand sides
        return []
    at = solver.dense_output()
    return [(float(t), at(t)) for t in inside]


def difference(a: Terms, b: Terms) -> tuple[float, float]:
    """Return the largest differences of two states in x = (q, q_dot) and in z, rad or m and their rates."""
    step = a.mechanism.tree.difference(a.q_tree, b.q_tree)
    part = a.at.partition
    x = np.concatenate([step[part.q], b.q_dot - a.q_dot])
    return float(np.abs(x).max(initial=0.0)), float(np.abs(step[part.z]).max(initial=0.0))


def vector(x: Array) -> str:
    """Format a short vector: (0.01, -0.006)."""
    return f"({', '.join(f'{v:.6g}' for v in x)})"
