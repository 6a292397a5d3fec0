"""One motion in every formulation, marched to its end: what the studies of epsilon and of cost have in common.

Nothing is recorded on the way, so that a march's time and counts are those of the integration alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time

import numpy as np

from ckc_pin.control.actuation import Actuation
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.library import load
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.initial import find_start
from ckc_pin.simulation.integrate import ONE_STEP, BudgetError, Step, Stepper
from ckc_pin.simulation.prepare import scene_controller, scene_mechanism
from ckc_pin.simulation.scene import Scene, SolverSpec
from ckc_pin.simulation.systems import Dae, Force, LevelSet, PrintedSpf, System

__all__ = [
    "W0",
    "Outcome",
    "Problem",
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


@dataclass(frozen=True)
class Problem:
    """What to move, from where, under which force.

    Attributes
    ----------
    mechanism : Mechanism
    at : Kinematics
        The start, on phi = 0.
    q_dot : (d,) array
    force : callable
        (t, terms) to u' on the tree.
    """

    mechanism: Mechanism
    at: Kinematics
    q_dot: Array
    force: Force

    @classmethod
    def free(cls, mechanism: Mechanism, at: Kinematics, q_dot: Array) -> Problem:
        """No actuator does anything."""
        none = np.zeros(mechanism.n)
        return cls(mechanism, at, q_dot, lambda t, terms: none)

    @classmethod
    def of_scene(cls, scene: Scene) -> Problem:
        """Take a scene's start and controller; its formulation, solver and w are left aside."""
        mechanism = scene_mechanism(scene)
        start = find_start(mechanism, scene)
        controller = scene_controller(scene, mechanism)
        if controller is None:
            return cls.free(mechanism, start.at, start.q_dot)
        limit = scene.spec.controller.torque_limit if scene.spec.controller else None
        actuation = Actuation(mechanism, limit)
        return cls(
            mechanism,
            start.at,
            start.q_dot,
            lambda t, terms: actuation.apply(terms, controller.u(t, terms)).u_tree,
        )

    def dae(self, method: str = "DOP853") -> Dae:
        """Eq. 1, projected where the method allows it."""
        return Dae(self.mechanism, self.at, self.at.rho @ self.q_dot, self.force, method in ONE_STEP)

    def reduced(self) -> LevelSet:
        """Eq. 6."""
        return LevelSet(self.mechanism, self.at, self.q_dot, self.force)

    def spf(self, epsilon: float, w: Array, convention: CoriolisVelocity = "rho") -> LevelSet:
        """Eq. 17, from the same q and q_dot with z on phi = w."""
        start = on_level(self.mechanism, self.at, w)
        return LevelSet(self.mechanism, start, self.q_dot, self.force, epsilon, convention, w)

    def printed_spf(self, epsilon: float) -> PrintedSpf:
        """Eq. 8 as printed, from phi = 0."""
        w0 = np.zeros(self.mechanism.closure.rows)
        return PrintedSpf(self.mechanism, self.at, self.q_dot, self.force, epsilon, w0)


def five_bar_problem(moving: bool) -> Problem:
    """Free motion of the five-bar, theta_1 and theta_3 half a radian past the equilibrium, from rest or moving."""
    mechanism = load("five_bar")
    equilibrium = stable_equilibrium(mechanism)
    start = mechanism.sigma(mechanism.independent_part(equilibrium.q_tree) + OFFSET, equilibrium)
    return Problem.free(mechanism, start.at, MOVING if moving else np.zeros(mechanism.d))


@dataclass(frozen=True)
class Outcome:
    """How a march ended.

    Attributes
    ----------
    t : float
        Time reached, s.
    terms : Terms
        The state there.
    stats : dict of str to int
        rhs, steps, rejected, newton (corrections of sigma), factorizations, jacobians.
    iterations : int or None
        Newton iterations of an implicit integrator, 0 for an explicit one; None where the solver does not
        tell (LSODA). Radau's are right to a third of its rejected steps.
    seconds : float
        Processor time, s: on a busy machine it says more than the clock on the wall.
    stopped : str
        Why the march ended early; empty when it did not.
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
        There is none on this branch.
    """
    found = mechanism.sigma(mechanism.independent_part(at.q_tree), at, w)
    if found.verdict != "converged":
        raise NumericalError(f"no z with phi = {np.asarray(w).tolist()} at this q: {found.reason}")
    return found.at


def march(
    system: System,
    method: str,
    rtol: float,
    t_end: float,
    *,
    max_rhs: int | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> Outcome:
    """Integrate a system to t_end, or to where the budget of right-hand sides or the numerics end it.

    atol is rtol / 100.
    """
    started = process_time()
    stepper = Stepper(system, method, SolverSpec(method=method, rtol=rtol, max_rhs=max_rhs), t_end)  # type: ignore[arg-type]
    stopped = ""
    try:
        while stepper.solver.status == "running":
            step = stepper.step()
            if on_step is not None:
                on_step(step)
            stepper.settle()
    except (BudgetError, NumericalError) as error:
        stopped = f"stopped at t = {stepper.t:.4g} s: {error}"
    seconds = process_time() - started
    stats, iterations = stepper.stats(), _iterations(stepper)
    return Outcome(stepper.t, system.terms(stepper.t, stepper.solver.y), stats, iterations, seconds, stopped)


def _iterations(stepper: Stepper) -> int | None:
    """Newton iterations of the integrator, from SciPy's nfev, which leaves finite-difference Jacobians out.

    Two evaluations choose the first step. An iteration of BDF is one evaluation; one of Radau is three,
    with one more at the end of each accepted step and where a rejected step's error is looked at again.
    """
    nfev = int(stepper.solver.nfev)
    if stepper.method == "BDF":
        return nfev - 2
    if stepper.method == "Radau":
        return (nfev - 2 - stepper.steps) // 3
    return None if stepper.method == "LSODA" else 0


def end_of(system: System, method: str, rtol: float, t_end: float) -> Terms:
    """Return the state that a system reaches at t_end.

    Raises
    ------
    NumericalError
        It does not get there.
    """
    outcome = march(system, method, rtol, t_end)
    if outcome.stopped:
        raise NumericalError(outcome.stopped)
    return outcome.terms


def sample(system: System, method: str, rtol: float, times: Array) -> list[Terms]:
    """Return the states at increasing times, the first of them 0.

    Raises
    ------
    NumericalError
        The system does not get to the last one.
    """
    found = [system.terms(0.0, system.start())]

    def take(step: Step) -> None:
        while len(found) < len(times) and times[len(found)] <= step.t:
            t = float(times[len(found)])
            found.append(system.terms(t, step.interpolant(t)))

    outcome = march(system, method, rtol, float(times[-1]), on_step=take)
    if outcome.stopped:
        raise NumericalError(outcome.stopped)
    return found


def difference(a: Terms, b: Terms) -> tuple[float, float]:
    """Largest difference of two states in x = (q, q_dot) and in z, rad or m and their rates."""
    step = a.mechanism.tree.difference(a.q_tree, b.q_tree)
    part = a.at.partition
    x = np.concatenate([step[part.q], b.q_dot - a.q_dot])
    return float(np.abs(x).max(initial=0.0)), float(np.abs(step[part.z]).max(initial=0.0))


def vector(x: Array) -> str:
    """Write a short vector for people: (0.01, -0.006)."""
    return f"({', '.join(f'{v:.6g}' for v in x)})"
