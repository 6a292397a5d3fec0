"""Linear models about an equilibrium, about an operating point held by motors, or at an instant of a scene's run."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.interrupt import interrupt_again
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.toml_writer import to_toml_value
from ckc_pin.base.validation import is_array, is_number, require_table, require_type
from ckc_pin.codegen.library import Library
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import Controller, SetPoint, TorqueController, Tracking
from ckc_pin.control.forces import BodyForce
from ckc_pin.control.sampled import Sampled
from ckc_pin.dynamics.equilibrium import equilibrium
from ckc_pin.dynamics.terms import Terms, terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import minimum_norm_step, project_onto_closure, sigma
from ckc_pin.linear.closed_loop import LAWS, ClosedLoop
from ckc_pin.linear.linear_model import LinearModel, linear_model
from ckc_pin.linear.statics import balance_at_rest
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import describe_stop_violation
from ckc_pin.native.control import apply_u
from ckc_pin.native.plant import NONE
from ckc_pin.run.compiled_terms import select_library
from ckc_pin.run.recorded import RecordedJoints
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.names import is_scene_name
from ckc_pin.scene.overrides import EXPECTED_OVERRIDES
from ckc_pin.scene.parts import (
    apply_sampling,
    build_scene_actuation,
    build_scene_controller,
    build_scene_forces,
    load_scene_mechanism,
)
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["At", "linearize"]

At = str | float | Mapping[str, float] | Sequence[float] | Array

MIN_CHART_MARGIN = 1e-6  # margin of phi_z, below which q does not determine z to all digits
CLOSURE_TOLERANCE = 1e-6  # |phi| relative to the mechanism's size
MIN_DURATION_S = 1e-9  # of a run to its start
SPEED_TOLERANCE = 1e-6  # rad/s or sizes/s; slower motions count as rest
LIMIT_TOLERANCE = 1e-9  # relative to a torque limit


@dataclass(frozen=True)
class _Subject:
    """What is linearized: a mechanism, and a scene if one is given."""

    mechanism: Mechanism
    scene: Scene | None

    @property
    def name(self) -> str:
        return self.mechanism.name if self.scene is None else self.scene.name

    @property
    def actuation(self) -> Actuation:
        return Actuation(self.mechanism) if self.scene is None else build_scene_actuation(self.scene, self.mechanism)

    @property
    def forces_at_rest(self) -> list[BodyForce]:
        """The scene's forces on links, with value zero."""
        forces = [] if self.scene is None else build_scene_forces(self.scene, self.mechanism)
        return [force.fixed(np.zeros(6)) for force in forces]

    @property
    def smoothing(self) -> float | None:
        return None if self.scene is None else self.scene.spec.friction_smoothing

    @property
    def library(self) -> Library | None:
        return select_library(self.mechanism, "auto" if self.scene is None else self.scene.spec.solver.terms)


def linearize(
    what: Mechanism | Scene | str | Path, at: At = "equilibrium", overrides: Mapping[str, Any] | None = None
) -> LinearModel:
    """Linearize a mechanism in minimal coordinates, with exact derivatives.

    Parameters
    ----------
    what : Mechanism, Scene, str or Path
        As in `check`. A mechanism's name with `overrides` or with a time stands for its default scene.
    at : "equilibrium", "assembled", "target", float, {coordinate: value} or array
        The state:

        - "equilibrium": the stable equilibrium reached from q_guess, without motor torques.
        - "assembled" or coordinates: at rest there. Loaded stops and minimum-norm motor torques hold the mechanism, and
          dry friction if these are not sufficient. Motors share the torques as in a run. An array is in the order of
          `independent` or of `coordinates`.
        - "target": the target of the scene's set point, with the controller's torques.
        - a number: that time of the scene's run, s.
    overrides : mapping, optional
        Overrides of the scene's keys, such as ``{"friction_smoothing": 0.01}``.

    Returns
    -------
    LinearModel
        Of the plant, with motor torques as inputs. It includes the closed loop at a set point's target, and at a time
        of a scene with a set point or tracking.

    Raises
    ------
    InputError
        Nothing holds the operating point, a joint is beyond its stops, the time is outside the run, or no freedom
        remains.
    NumericalError
        There is no equilibrium, the configuration is singular, or the run stopped earlier.

    Notes
    -----
    Dry friction is smoothed if the scene has friction_smoothing. Otherwise joints with friction are locked at rest and
    feel a constant force while they slide. Joints that rest on a stop are locked.

    >>> model = linearize("five_bar")
    >>> model.A.shape, model.inputs
    ((4, 4), ('theta_1', 'theta_3'))
    """
    expected = "a mechanism or a scene: itself, its name or path"
    require_type(what, (Mechanism, Scene, str, Path), "linearize: what", expected)
    if overrides is not None:
        require_table(overrides, "linearize: overrides", EXPECTED_OVERRIDES)
    with one_blas_thread():
        subject = _find_subject(what, at, overrides)
        scene = subject.scene
        if scene is not None and (in_part := [one.joint for one in scene.spec.prescribed if one.can_be_free]):
            raise InputError(
                f"{scene.name}: the prescribed motion of {', '.join(in_part)} begins or ends in the run, which linear "
                "models do not support"
            )
        if subject.mechanism.d == 0:
            raise InputError(f"{subject.mechanism.name}: d = 0, the mechanism has no freedom to linearize")
        if is_array(at):
            mechanism = subject.mechanism
            at = mechanism.name_values(to_toml_value(at), "linearize: at", mechanism.independent, mechanism.coordinates)
        if isinstance(at, Mapping):
            return _linearize_at_coordinates(subject, at)
        if not isinstance(at, str):
            return _linearize_at_time(subject, _require_time(at))
        match at:
            case "equilibrium":
                return _linearize_at_equilibrium(subject)
            case "target":
                return _linearize_at_target(subject)
            case "assembled":
                mechanism = subject.mechanism
                return _linearize_balanced(subject, Terms(mechanism, mechanism.assembled, np.zeros(mechanism.n)))
        raise _unknown_state(at)


def _find_subject(what: Mechanism | Scene | str | Path, at: At, overrides: Mapping[str, Any] | None) -> _Subject:
    if isinstance(what, str | Path):
        needs_run = not (isinstance(at, Mapping | str) or is_array(at))
        if not (is_scene_name(str(what)) or overrides or needs_run):
            return _Subject(load(what), None)
        what = load_scene(what, overrides)
    elif isinstance(what, Scene):
        what = what.with_overrides(overrides)
    elif overrides:
        raise InputError("linearize: overrides are accepted with a scene, not with a Mechanism")
    if not isinstance(what, Scene):
        return _Subject(what, None)
    mechanism = load_scene_mechanism(what)
    return _Subject(mechanism, what)


def _require_time(at: Any) -> float:
    if is_number(at) and abs(at) <= sys.float_info.max:
        return float(at)
    raise _unknown_state(at)


def _unknown_state(at: Any) -> InputError:
    return InputError(
        f'at = {at!r:.80}: give "equilibrium", "assembled", "target", a time in seconds, or coordinates as a table or '
        "an array"
    )


# --- at rest -------------------------------------------------------------------------------------


def _linearize_at_equilibrium(subject: _Subject) -> LinearModel:
    mechanism = subject.mechanism
    try:
        at = equilibrium(mechanism)
    except NumericalError as error:
        alternatives = "as assembled or at coordinates, where its motors hold it, or " if mechanism.actuated else ""
        message = f"{error}; linearize it {alternatives}at a time of a scene's run instead"
        raise NumericalError(message, q_tree=error.q_tree) from None
    if violation := describe_stop_violation(mechanism, at.q_tree):
        raise InputError(f"{mechanism.name}: at its equilibrium {violation}; give coordinates within the stops")
    state = Terms(mechanism, at, np.zeros(mechanism.n))
    return _linearize_at_rest(subject, state, np.zeros(len(mechanism.actuated)), NONE, "at its equilibrium")


def _linearize_at_target(subject: _Subject) -> LinearModel:
    scene, mechanism = subject.scene, subject.mechanism
    law = None if scene is None else build_scene_controller(scene, mechanism)
    if scene is None or not isinstance(law, SetPoint):
        raise InputError(
            f'at = "target": {subject.name} has no set point; give a scene whose controller is of type "set_point"'
        )
    solution = sigma(mechanism, law.q_d, find_start(mechanism, scene).at)  # on the assembly branch of a run
    if solution.verdict != "converged":
        raise InputError(f'at = "target": {mechanism.name} cannot reach its target: {solution.reason}')
    if violation := describe_stop_violation(mechanism, solution.at.q_tree):
        raise InputError(f'{mechanism.name}: at = "target": {violation}; give another controller.q_d')
    state, actuation = Terms(mechanism, solution.at, np.zeros(mechanism.n)), subject.actuation
    actuation.require_driven_freedoms(state.at)
    tau = apply_u(actuation, state, law.u(0.0, state)).tau
    model = _linearize_at_rest(subject, state, tau, NONE, "at the target of its controller")
    return _add_closed_loop(subject, model, law, 0.0, state, 0.0)


def _linearize_at_coordinates(subject: _Subject, coordinates: Mapping[str, float]) -> LinearModel:
    mechanism = subject.mechanism
    # A complete configuration is used as it is, because the independent coordinates may not determine it.
    is_complete = set(coordinates) >= set(mechanism.coordinates)
    state = terms(mechanism, coordinates, dict.fromkeys(mechanism.coordinates, 0.0) if is_complete else None)
    max_phi = float(np.abs(state.phi).max(initial=0.0))
    if max_phi > max(CLOSURE_TOLERANCE * mechanism.size, mechanism.tolerance):
        raise InputError(
            f"at: the loops are open there (|phi| = {max_phi:.3g}); give {', '.join(mechanism.independent)} only"
        )
    # Near a fold Newton's method finds only half of the digits.
    if not is_complete and state.at.margin() <= MIN_CHART_MARGIN:
        where = ", ".join(f"{name} = {x:.6g}" for name, x in coordinates.items())
        raise NumericalError(
            f"at: {where} is singular: it does not determine the other coordinates; choose another configuration, or "
            f"give {', '.join(mechanism.coordinates)}",
            q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(state.q_tree)),
        )
    return _linearize_balanced(subject, _project_onto_manifold(state))


def _linearize_balanced(subject: _Subject, state: Terms) -> LinearModel:
    """Linearize about a configuration that stops, motors and dry friction hold at rest; InputError if they cannot."""
    mechanism = subject.mechanism
    if violation := describe_stop_violation(mechanism, state.q_tree):
        raise InputError(f"{mechanism.name}: at: {violation}; give coordinates within the stops")
    balance = balance_at_rest(state, subject.actuation, has_friction=subject.smoothing is None)
    notes = []
    if balance.uses_friction:
        notes.append("dry friction holds part of the load, so other motor torques are possible, too")
    if len(balance.unloaded_stops):
        names = ", ".join(mechanism.coordinates[k] for k in balance.unloaded_stops)
        notes.append(f"at a stop without a force on it, which the model ignores: {names}")
    at = "held by its motors" if mechanism.actuated else "at rest"
    return _linearize_at_rest(subject, state, balance.tau, balance.loaded_stops, at, tuple(notes))


def _linearize_at_rest(
    subject: _Subject, state: Terms, tau: Array, loaded_stops: IntArray, at: str, notes: tuple[str, ...] = ()
) -> LinearModel:
    sticking = np.flatnonzero(subject.mechanism.joints.friction) if subject.smoothing is None else NONE
    locked = np.union1d(sticking, loaded_stops)
    forces = subject.forces_at_rest
    if prescribed := subject.mechanism.prescribed:
        notes = (*notes, f"at rest at the position where the prescribed motion begins: {', '.join(prescribed)}")
    if forces:
        notes = (*notes, "forces on links are inputs, zero at the state")
    return linear_model(
        state, tau, at=at, locked=locked, smoothing=subject.smoothing, library=subject.library, forces=forces,
        notes=notes,
    )  # fmt: skip


# --- along a run ---------------------------------------------------------------------------------


def _linearize_at_time(subject: _Subject, t: float) -> LinearModel:
    scene, mechanism = subject.scene, subject.mechanism
    if scene is None:
        raise InputError(f"at = {t:g}: a mechanism has no time; give one of its scenes")
    run = _run_until(scene, t)
    k = run.at(t)
    max_phi = float(np.abs(run.phi[k]).max(initial=0.0))
    if max_phi > max(CLOSURE_TOLERANCE * mechanism.size, 10 * mechanism.tolerance):
        remedy = "because the SPF starts off its manifold; give a later time"
        if scene.spec.formulation == "dae":
            remedy = "because a DAE without projection drifts; set solver.projection = true"
        raise InputError(f"at t = {t:.15g} s the loops of {scene.name} are open (|phi| = {max_phi:.3g}), {remedy}")
    at = mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[k]))
    state, correction = Terms(mechanism, at, run.v_tree[k]), np.zeros(mechanism.closure.rows)
    if mechanism.prescribed:  # the rows of prescribed joints are neither zero nor constant
        correction[mechanism.prescribed_rows] = -run.prescribed_at(k)[0]
    else:
        state = _project_onto_manifold(state)
    joints = RecordedJoints(run)
    locked, smoothing = joints.locked[k], subject.smoothing
    friction = np.zeros(mechanism.n) if smoothing is not None else -mechanism.joints.friction * joints.sliding_signs[k]
    forces = run.forces_at(k)
    model = linear_model(
        state,
        run.tau[k],
        at=f"at t = {t:g} s",
        t=t,
        u_tree=friction,
        locked=locked,
        smoothing=smoothing,
        library=subject.library,
        forces=forces,
        correction=correction,
        notes=_describe_instant(scene, run, k),
    )
    law = build_scene_controller(scene, mechanism)
    return model if law is None else _add_closed_loop(subject, model, law, t, state, friction, forces)


def _add_closed_loop(
    subject: _Subject,
    model: LinearModel,
    law: Controller | TorqueController,
    t: float,
    state: Terms,
    friction: Array | float,
    forces: Sequence[BodyForce] = (),
) -> LinearModel:
    """Add the closed loop to a model, or a note why it has none."""
    if not isinstance(law, SetPoint | Tracking) or type(law) not in LAWS:
        return replace(model, notes=(*model.notes, "A and B are the plant's, without the scene's controller"))
    locked = np.array([model.coordinates.index(name) for name in model.locked], np.intp)
    try:
        loop = ClosedLoop(subject.mechanism, law, subject.smoothing, subject.library, subject.actuation)
        A_closed = loop.linearize(t, state, friction, locked, forces).A_closed
    except NumericalError as error:
        note = f"A and B are the plant's, without the scene's controller, because {error}"
        return replace(model, notes=(*model.notes, note))
    note = "A and B are the plant's; closed_loop is A with the scene's controller"
    sampled = None if subject.scene is None else apply_sampling(subject.scene, law)
    if isinstance(sampled, Sampled):
        parts = {"delay": sampled.delay > 0, "sensor": sampled.sensor is not None, "drive": sampled.drive is not None}
        ignored = ["sampling", *(name for name, is_present in parts.items() if is_present)]
        note += f", without its {', '.join(ignored)}"
    return replace(model, closed_loop=A_closed, notes=(*model.notes, note))


def _project_onto_manifold(state: Terms) -> Terms:
    """Close loops that are slightly open, and make J v' zero."""
    mechanism = state.mechanism
    at, v = project_onto_closure(state.at, mechanism.rank), state.v_tree
    if v.any():
        v = v + minimum_norm_step(at.J, mechanism.rank, at.J @ v, mechanism.tree.step_scale)
    return Terms(mechanism, at, v)


def _run_until(scene: Scene, t: float) -> Run:
    """Run a scene up to a time, with the scene's output instants."""
    t_end = scene.spec.t_end
    if not 0 <= t <= t_end:
        raise InputError(f"t = {t:.15g} s is outside the run of {scene.name}, which lasts from 0 to {t_end:.15g} s")
    overrides = {"t_end": max(t, min(MIN_DURATION_S, t_end))}
    run = simulate(scene, overrides)
    if run.status == "interrupted":
        raise interrupt_again(run.message)
    if run.status == "done" and run.t[-1] >= t * (1 - 1e-12):
        return run
    message = f"t = {t:.15g} s is outside the run of {scene.name}, which ends at t = {run.t[-1]:.9g} s: {run.message}"
    raise InputError(message) if run.status == "done" else NumericalError(message, t=float(run.t[-1]))


def _describe_instant(scene: Scene, run: Run, k: int) -> tuple[str, ...]:
    """Return notes on a motion and on motors at their limits, at the output instant k of a run."""
    notes = []
    if np.any(np.abs(run.v_tree[k]) > SPEED_TOLERANCE * run.mechanism.tree.step_scale):
        notes.append("about a motion, not a state of rest: A and B are those of the instant")
    limits = build_scene_actuation(scene, run.mechanism).limit
    saturated = [
        name
        for name, tau, (lower, upper) in zip(run.actuated, run.tau[k], limits.T, strict=True)
        if not lower * (1 - LIMIT_TOLERANCE) < tau < upper * (1 - LIMIT_TOLERANCE)
    ]
    if saturated:
        notes.append(f"at the torque limit, so the controller cannot increase the torque: {', '.join(saturated)}")
    return tuple(notes)
