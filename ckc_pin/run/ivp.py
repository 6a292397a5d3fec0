"""The formulations as initial value problems y' = f(t, y) in NumPy, for SciPy's or other solvers.

============ ==================== =====================================================
class        y                    equations
============ ==================== =====================================================
`LevelSet`   q, q_dot             eq. 6 on the level set phi = w(0) exp(-t / epsilon). With
                                  w(0) = 0 it is the reduced model, otherwise the SPF in
                                  the coordinates of eq. 17, whose w is known exactly
`PrintedSpf` q, q_dot, z          eq. 8 as printed
`Dae`        q', v'               eq. 1 with the closure differentiated twice and without
                                  projection
============ ==================== =====================================================

This is the readable reference. Runs do not use it: the native loop has its own implementation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import describe_value, is_number
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import (
    Controller,
    TorqueController,
    initial_state,
    is_torque_controller,
)
from ckc_pin.control.forces import BodyForce, body_wrenches, generalized_force
from ckc_pin.control.sampled import Sampled
from ckc_pin.dynamics.formulations import (
    CoriolisVelocity,
    dae_acceleration,
    reduced_acceleration,
    spf_terms,
    spf_z_dot,
)
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.chart import Chart
from ckc_pin.kinematics.sigma import follow_sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native.control import apply_u
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.parts import (
    apply_sampling,
    build_scene_actuation,
    build_scene_controller,
    build_scene_forces,
    load_scene_mechanism,
)
from ckc_pin.scene.scene import Scene, as_scene

__all__ = ["Dae", "Force", "Ivp", "LevelSet", "PrintedSpf", "as_ivp", "make_force"]

Force = Callable[[float, Terms], Array]  # u' on the tree at (t, terms)


class Ivp(Protocol):
    """An initial value problem y' = f(t, y), and the terms and velocities of its states.

    Attributes
    ----------
    mechanism : Mechanism
    y0 : array
        State at t = 0.
    t_span : (0, t_end)
        Times, s.
    counts : dict of str to int
        "newton": number of Newton corrections of sigma.
    """

    mechanism: Mechanism
    y0: Array
    t_span: tuple[float, float]
    counts: dict[str, int]

    def f(self, t: float, y: Array) -> Array:
        """Return y' at (t, y), or NaN where it does not exist, so that solvers shorten their steps."""

    def terms(self, t: float, y: Array) -> Terms:
        """Return the terms at a state (NumericalError where they do not exist)."""

    def velocity(self, t: float, y: Array) -> Array:
        """Return the velocity of the tree, shape (n,). Off the manifold the SPF's z_dot differs from rho_z q_dot."""


def as_ivp(scene: Scene | str | Path, overrides: Mapping[str, Any] | None = None) -> Ivp:
    """Return a scene's motion as an initial value problem.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name or its path. Its solver and its events are not used.
    overrides : mapping, optional
        Values by dotted key.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written, its controller is sampled, or its joints stick or have stops.
    NumericalError
        The start is singular.

    Examples
    --------
    >>> from scipy.integrate import solve_ivp
    >>> problem = as_ivp("five_bar/swing", {"formulation": "reduced"})
    >>> solution = solve_ivp(problem.f, problem.t_span, problem.y0, "LSODA", rtol=1e-8, atol=1e-10)
    >>> problem.terms(2.0, solution.y[:, -1]).q_tree
    """
    scene = as_scene(scene, overrides, "as_ivp")
    spec, mechanism = scene.spec, load_scene_mechanism(scene)
    law = build_scene_controller(scene, mechanism)
    if isinstance(apply_sampling(scene, law), Sampled):
        raise InputError("as_ivp: controller.sample_time: a sampled u is not a function of t and y; remove sample_time")
    smoothing = spec.friction_smoothing
    if mechanism.joints.has_events(smoothing):
        raise InputError(
            f"as_ivp: joints of {mechanism.name} stick or have stops, whose forces are not a function of t and y; "
            "without stops set friction_smoothing"
        )
    start = find_start(mechanism, scene)
    if len(initial_state(law)):
        raise InputError(
            "as_ivp: a controller with a state of its own is no function of t and y; set K_I = 0 in a servo"
        )
    force = make_force(law, build_scene_actuation(scene, mechanism))
    if smoothing is not None:
        force = _with_friction(force, mechanism, smoothing)
    if body_forces := build_scene_forces(scene, mechanism):
        force = _with_body_forces(force, body_forces)
    span = (0.0, spec.t_end)
    if spec.formulation == "dae":
        return Dae(mechanism, start.at, start.at.rho @ start.q_dot, force, span)
    if spec.formulation == "reduced":
        return LevelSet(mechanism, start.at, start.q_dot, force, span)
    problem = PrintedSpf if spec.spf_coordinates == "z" else LevelSet
    return problem(
        mechanism, start.at, start.q_dot, force, span, spec.epsilon, start.w, convention=spec.coriolis_velocity
    )


def make_force(controller: Controller | TorqueController | None, actuation: Actuation) -> Force:
    """Return the function (t, terms) of the force u' on the tree that a controller applies through the motors."""
    if controller is None:
        return lambda t, terms: actuation.zero.u_tree
    torques = is_torque_controller(controller)
    law: Callable[[float, Terms], Array] = getattr(controller, "tau" if torques else "u")
    if torques:
        return lambda t, terms: actuation.apply_tau(terms, law(t, terms)).u_tree
    return lambda t, terms: apply_u(actuation, terms, law(t, terms)).u_tree


def _with_body_forces(force: Force, forces: Sequence[BodyForce]) -> Force:
    return lambda t, terms: force(t, terms) + generalized_force(body_wrenches(forces, t, terms), terms)


def _with_friction(force: Force, mechanism: Mechanism, smoothing: float) -> Force:
    return lambda t, terms: force(t, terms) + mechanism.joints.smooth_friction(terms.v_tree, smoothing)


@dataclass
class LevelSet:
    """The reduced model (w0 = 0), or the SPF in the coordinates of eq. 17 (w0 = phi at the start).

    z is computed by following the level set from the state of the last evaluation, along a straight line in q.
    """

    mechanism: Mechanism
    initial: Kinematics
    q_dot: Array
    force: Force
    t_span: tuple[float, float]
    epsilon: float = 1.0
    w0: Array | None = None
    convention: CoriolisVelocity = "rho"
    counts: dict[str, int] = field(default_factory=lambda: {"newton": 0})

    def __post_init__(self) -> None:
        self._d, self._last = self.mechanism.d, self.initial
        self._off = self.w0 is not None and bool(np.any(self.w0))
        self._chart = Chart(self.mechanism.tree, self.initial.partition.q, self.initial.q_tree)
        self.y0 = np.concatenate([self._chart.numbers(self.initial.q_tree), self.q_dot])

    def w(self, t: float) -> Array:
        """Return the exact w(t) of eq. 17's second line, shape (rows,)."""
        w0 = np.zeros(self.mechanism.closure.rows) if self.w0 is None else self.w0
        return w0 * np.exp(-t / self.epsilon)

    def close(self, t: float, numbers: Array) -> Kinematics:
        """Return the configuration at q on the level set phi(q, z) = w(t)."""
        step = self._chart.step(self._last.q_tree, numbers)
        solution = follow_sigma(self._last, step, self.w(t), self.mechanism.tolerance, anywhere=False)
        self.counts["newton"] += solution.iterations
        if solution.verdict != "converged":
            tree = self.mechanism.tree
            where = tree.named(tree.to_coordinates(solution.at.q_tree))
            raise NumericalError(f"sigma(q) is {solution.verdict}: {solution.reason}", t=t, q_tree=where)
        self._last = solution.at
        return solution.at

    def terms(self, t: float, y: Array) -> Terms:
        y = _require_state(t, y, self.y0)
        at, q_dot = self.close(t, y[: self._d]), y[self._d :]
        if self._off:
            return spf_terms(self.mechanism, at, q_dot, self.epsilon, self.w(t), self.convention)
        return Terms(self.mechanism, at, at.rho @ q_dot)

    def velocity(self, t: float, y: Array) -> Array:
        y = _require_state(t, y, self.y0)
        terms = self.terms(t, y)
        return _spf_velocity(terms, y[self._d :], self.epsilon, self.w(t)) if self._off else terms.v_tree

    def f(self, t: float, y: Array) -> Array:
        y = _require_state(t, y, self.y0)
        try:
            terms, q_dot = self.terms(t, y), y[self._d :]
            actual = self._off and self.convention == "actual"
            q_ddot = reduced_acceleration(terms, self.force(t, terms), q_dot if actual else None)
        except NumericalError:
            return np.full_like(y, np.nan)
        return np.concatenate([self._chart.rate(terms.q_tree, q_dot), q_ddot])


@dataclass
class PrintedSpf:
    """Eq. 8 as printed: y = (q, q_dot, z), with phi = w0 at the start, for mechanisms without free roots."""

    mechanism: Mechanism
    initial: Kinematics
    q_dot: Array
    force: Force
    t_span: tuple[float, float]
    epsilon: float
    w0: Array
    convention: CoriolisVelocity = "rho"
    counts: dict[str, int] = field(default_factory=lambda: {"newton": 0})

    def __post_init__(self) -> None:
        self._d, partition, place = self.mechanism.d, self.mechanism.partition, self.mechanism.tree.q_index
        self._q, self._z = place[partition.q], place[partition.z]
        self.y0 = np.concatenate([self.initial.q_tree[self._q], self.q_dot, self.initial.q_tree[self._z]])

    def terms(self, t: float, y: Array) -> Terms:
        y, d, q_tree = _require_state(t, y, self.y0), self._d, np.empty(self.mechanism.tree.nq)
        q_tree[self._q], q_tree[self._z] = y[:d], y[2 * d :]
        at = self.mechanism.kinematics(q_tree)
        return spf_terms(self.mechanism, at, y[d : 2 * d], self.epsilon, at.phi, self.convention)

    def velocity(self, t: float, y: Array) -> Array:
        y = _require_state(t, y, self.y0)
        # The exact w is used because the rounding of phi would be divided by epsilon.
        w = self.w0 * np.exp(-t / self.epsilon)
        return _spf_velocity(self.terms(t, y), y[self._d : 2 * self._d], self.epsilon, w)

    def f(self, t: float, y: Array) -> Array:
        y = _require_state(t, y, self.y0)
        if not np.all(np.isfinite(y)):
            return np.full_like(y, np.nan)
        terms, q_dot = self.terms(t, y), y[self._d : 2 * self._d]
        try:
            u_tree = self.force(t, terms)
        except NumericalError:
            return np.full_like(y, np.nan)
        q_ddot = reduced_acceleration(terms, u_tree, q_dot if self.convention == "actual" else None)
        return np.concatenate([q_dot, q_ddot, spf_z_dot(terms.at, q_dot, self.epsilon, terms.phi)])


@dataclass
class Dae:
    """Eq. 1: y = (q', v'). An error of the constraints is not corrected and grows with the square of time."""

    mechanism: Mechanism
    initial: Kinematics
    v_tree: Array
    force: Force
    t_span: tuple[float, float]
    counts: dict[str, int] = field(default_factory=lambda: {"newton": 0})

    def __post_init__(self) -> None:
        self.y0 = np.concatenate([self.initial.q_tree, self.v_tree])

    def terms(self, t: float, y: Array) -> Terms:
        y, tree = _require_state(t, y, self.y0), self.mechanism.tree
        q_tree = y[: tree.nq] if tree.is_euclidean else pin.normalize(tree.model, y[: tree.nq])
        return Terms(self.mechanism, self.mechanism.kinematics(q_tree), y[tree.nq :])

    def velocity(self, t: float, y: Array) -> Array:
        return _require_state(t, y, self.y0)[self.mechanism.tree.nq :]

    def f(self, t: float, y: Array) -> Array:
        y = _require_state(t, y, self.y0)
        if not np.all(np.isfinite(y)):
            return np.full_like(y, np.nan)
        terms = self.terms(t, y)
        try:
            acceleration = dae_acceleration(terms, self.force(t, terms))
        except NumericalError:
            return np.full_like(y, np.nan)
        return np.concatenate([self.mechanism.tree.configuration_rate(terms.q_tree, terms.v_tree), acceleration])


def _require_state(t: Any, y: Any, y0: Array) -> Array:
    """Return a state as an array of floats (InputError if t or y has another type, or y another shape than y0)."""
    if not is_number(t):
        raise InputError(f"as_ivp: t: expected a number, s, got {describe_value(t)}")
    try:
        state = np.asarray(y, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"as_ivp: y: expected {len(y0)} numbers, as y0 has, got {describe_value(y)}") from None
    if state.shape != y0.shape:
        raise InputError(f"as_ivp: y: expected {len(y0)} numbers, as y0 has, got shape {state.shape}")
    return state


def _spf_velocity(terms: Terms, q_dot: Array, epsilon: float, w: Array) -> Array:
    velocity = terms.at.rho @ q_dot
    velocity[terms.at.partition.z] = spf_z_dot(terms.at, q_dot, epsilon, w)
    return velocity
