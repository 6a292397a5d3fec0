"""Linear models: about an equilibrium, an operating point that motors hold, or an instant of a scene's run."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.interrupt import interrupt_again
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.validation import is_number, require_table, require_type
from ckc_pin.codegen.library import Library
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.control.torques import Torques
from ckc_pin.dynamics.equilibrium import equilibrium
from ckc_pin.dynamics.terms import Terms, terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import minimum_norm_step, project_onto_closure, sigma
from ckc_pin.linear.closed_loop import ClosedLoop
from ckc_pin.linear.linear_model import LinearModel, linear_model
from ckc_pin.linear.resting import hold
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import describe_stop_violation
from ckc_pin.native.plant import NONE
from ckc_pin.run.compiled_terms import library_of
from ckc_pin.run.recorded_joints import RecordedJoints
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.parts import scene_actuation, scene_controller, scene_mechanism
from ckc_pin.scene.scene import OVERRIDES, Scene, apply_overrides, load_scene, make_scene, names_a_scene

__all__ = ["At", "linearize"]

At = str | float | Mapping[str, float]

NO_CHART = 1e-6  # margin of phi_z below which q is none
OPEN = 1e-6  # of the mechanism's size: loops further open are not those of eq. 1
MOMENT = 1e-9  # s: a run to its very start


@dataclass(frozen=True)
class _Subject:
    mechanism: Mechanism
    scene: Scene | None

    @property
    def name(self) -> str:
        return self.mechanism.name if self.scene is None else self.scene.name

    @property
    def actuation(self) -> Actuation:
        return Actuation(self.mechanism) if self.scene is None else scene_actuation(self.scene, self.mechanism)

    @property
    def smoothing(self) -> float | None:
        return None if self.scene is None else self.scene.spec.friction_smoothing

    @property
    def library(self) -> Library | None:
        return library_of(self.mechanism, "auto" if self.scene is None else self.scene.spec.solver.terms)


def linearize(
    what: Mechanism | Scene | str | Path, at: At = "equilibrium", overrides: Mapping[str, Any] | None = None
) -> LinearModel:
    """Linearize a mechanism, exactly, in minimal coordinates.

    Parameters
    ----------
    what : Mechanism, Scene, str or Path
        As `check` takes it. Of a mechanism's name with `overrides` or an instant, its default scene.
    at : "equilibrium", "assembled", "target", float or {coordinate: value}
        The stable equilibrium reached from q_guess, motors at rest; an instant of the scene's run, s; or at rest the
        configuration as assembled, or one as `terms` takes it, held by stops that joints rest on, by the least torques
        of the motors, shared as in a run, and where these fail by friction; or the target of the scene's set point,
        with the torques of that.
    overrides : mapping, optional
        Values of the scene by dotted key, e.g. ``{"friction_smoothing": 0.01}``.

    Returns
    -------
    LinearModel
        Of the plant, with the motors' torques as inputs; at an instant of a scene with a set point or tracking, and at
        a set point's target, the closed loop's A besides.

    Raises
    ------
    InputError
        An operating point that nothing holds, a joint beyond its stops, an instant outside the run, no freedom left.
    NumericalError
        No equilibrium there, a singular configuration, a run that stopped before.

    Notes
    -----
    Dry friction is smoothed as the scene's friction_smoothing says; else joints with friction that are at rest are
    locked, and those that slide feel a constant force. Joints that rest on a stop are locked.

    >>> model = linearize("five_bar")
    >>> model.A.shape, model.inputs
    ((4, 4), ('theta_1', 'theta_3'))
    """
    takes = "a mechanism or a scene: itself, its name or path"
    require_type(what, (Mechanism, Scene, str, Path), "linearize: what", takes)
    if overrides is not None:
        require_table(overrides, "linearize: overrides", OVERRIDES)
    with one_blas_thread():
        subject = _subject(what, at, overrides)
        if subject.mechanism.d == 0:
            raise InputError(f"{subject.mechanism.name}: d = 0, the loops leave no freedom: nothing can move")
        if isinstance(at, Mapping):
            return _at_point(subject, at)
        if not isinstance(at, str):
            return _at_instant(subject, _instant(at))
        match at:
            case "equilibrium":
                return _at_equilibrium(subject)
            case "target":
                return _at_target(subject)
            case "assembled":
                mechanism = subject.mechanism
                return _operating(subject, Terms(mechanism, mechanism.assembled, np.zeros(mechanism.n)))
        raise _no_state(at)


def _subject(what: Mechanism | Scene | str | Path, at: At, overrides: Mapping[str, Any] | None) -> _Subject:
    if isinstance(what, str | Path):
        timed = not isinstance(at, Mapping | str)
        if not (names_a_scene(str(what)) or overrides or timed):
            return _Subject(load(what), None)
        what = load_scene(what, overrides)
    elif overrides:
        raise InputError("linearize: overrides go with a name; a Scene or a Mechanism is complete")
    return _Subject(scene_mechanism(what), what) if isinstance(what, Scene) else _Subject(what, None)


def _instant(at: Any) -> float:
    if is_number(at) and abs(at) <= sys.float_info.max:
        return float(at)
    raise _no_state(at)


def _no_state(at: Any) -> InputError:
    return InputError(
        f'at = {at!r:.80}: give "equilibrium", "assembled", "target", a time in seconds, or a table of coordinates'
    )


# --- at rest -------------------------------------------------------------------------------------


def _at_equilibrium(subject: _Subject) -> LinearModel:
    mechanism = subject.mechanism
    try:
        at = equilibrium(mechanism)
    except NumericalError as error:
        motors = "as assembled, or at coordinates, where its motors hold it, or " if mechanism.actuated else ""
        says = f"{error}; or linearize it {motors}at an instant of a scene's run"
        raise NumericalError(says, q_tree=error.q_tree) from None
    if says := describe_stop_violation(mechanism, at.q_tree):
        raise InputError(f"{mechanism.name}: at its equilibrium {says}; give coordinates within them")
    return _at_rest(
        subject,
        Terms(mechanism, at, np.zeros(mechanism.n)),
        np.zeros(len(mechanism.actuated)),
        NONE,
        "at its equilibrium",
    )


def _at_target(subject: _Subject) -> LinearModel:
    scene, mechanism = subject.scene, subject.mechanism
    law = None if scene is None else scene_controller(scene, mechanism)
    if scene is None or not isinstance(law, SetPoint):
        raise InputError(
            f'at = "target": {subject.name} has no set point; give a scene whose controller is of type "set_point"'
        )
    found = sigma(mechanism, law.q_d, find_start(mechanism, scene).at)  # on the branch that a run is on
    if found.verdict != "converged":
        raise InputError(f'at = "target": {mechanism.name} cannot be there: {found.reason}')
    if says := describe_stop_violation(mechanism, found.at.q_tree):
        raise InputError(f'{mechanism.name}: at = "target": {says}; give another controller.q_d')
    state, actuation = Terms(mechanism, found.at, np.zeros(mechanism.n)), subject.actuation
    actuation.require_transmission(state.at)
    tau = actuation.apply(state, law.u(0.0, state)).tau
    model = _at_rest(subject, state, tau, NONE, "at the target of its controller")
    return _with_controller(subject, model, law, 0.0, state, 0.0)


def _at_point(subject: _Subject, given: Mapping[str, float]) -> LinearModel:
    mechanism = subject.mechanism
    whole = set(given) >= set(mechanism.coordinates)  # taken as it is: q may be no chart there
    state = terms(mechanism, given, dict.fromkeys(mechanism.coordinates, 0.0) if whole else None)
    miss = float(np.abs(state.phi).max(initial=0.0))
    if miss > max(OPEN * mechanism.size, mechanism.tolerance):
        raise InputError(
            f"at: the loops do not close there (|phi| = {miss:.3g}); give {', '.join(mechanism.independent)} alone"
        )
    if not whole and state.at.margin() <= NO_CHART:  # a fold, where Newton's method finds half of the digits
        where = ", ".join(f"{name} = {x:.6g}" for name, x in given.items())
        raise NumericalError(
            f"at: {where} is singular: the other coordinates do not follow from that; take another configuration, or "
            f"give {', '.join(mechanism.coordinates)}",
            q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(state.q_tree)),
        )
    return _operating(subject, _closed(state))


def _operating(subject: _Subject, state: Terms) -> LinearModel:
    """Hold a configuration by stops, the least torques and, where these fail, friction; refuse what nothing holds."""
    mechanism = subject.mechanism
    if says := describe_stop_violation(mechanism, state.q_tree):
        raise InputError(f"{mechanism.name}: at: {says}; give coordinates within them")
    rest = hold(state, subject.actuation, rubs=subject.smoothing is None)
    notes = []
    if rest.rubs:
        notes.append("dry friction holds what the motors do not: other torques would do as well")
    if len(rest.idle):
        names = ", ".join(mechanism.coordinates[k] for k in rest.idle)
        notes.append(f"at a stop that nothing pushes it into, and that the model leaves out: {names}")
    says = "held by its motors" if mechanism.actuated else "at rest"
    return _at_rest(subject, state, rest.tau, rest.touching, says, tuple(notes))


def _at_rest(
    subject: _Subject, state: Terms, tau: Array, touching: IntArray, says: str, notes: tuple[str, ...] = ()
) -> LinearModel:
    sticks = np.flatnonzero(subject.mechanism.joints.friction) if subject.smoothing is None else NONE
    locked = np.union1d(sticks, touching)
    return linear_model(
        state, tau, at=says, locked=locked, smoothing=subject.smoothing, library=subject.library, notes=notes
    )


# --- along a run ---------------------------------------------------------------------------------


def _at_instant(subject: _Subject, t: float) -> LinearModel:
    scene, mechanism = subject.scene, subject.mechanism
    if scene is None:
        raise InputError(f"at = {t:g}: a mechanism has no time; give one of its scenes")
    run = _run_to(scene, t)
    k = run.at(t)
    miss = float(np.abs(run.phi[k]).max(initial=0.0))
    if miss > max(OPEN * mechanism.size, 10 * mechanism.tolerance):
        why = "as an SPF off its manifold has them; give a later instant"
        if scene.spec.formulation == "dae":
            why = "since nothing closes those of a DAE that drifts; set solver.projection = true"
        raise InputError(f"at t = {t:.15g} s the loops of {scene.name} are open (|phi| = {miss:.3g}), {why}")
    at = mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[k]))
    state = _closed(Terms(mechanism, at, run.v_tree[k]))
    of_joints = RecordedJoints(run)
    locked, smoothing = of_joints.locked[k], subject.smoothing
    sliding = np.zeros(mechanism.n) if smoothing is not None else -mechanism.joints.friction * of_joints.sign[k]
    model = linear_model(
        state,
        run.tau[k],
        at=f"at t = {t:g} s",
        t=t,
        u_tree=sliding,
        locked=locked,
        smoothing=smoothing,
        library=subject.library,
        notes=_notes(scene, run, k),
    )
    law = scene_controller(scene, mechanism)
    return model if law is None else _with_controller(subject, model, law, t, state, sliding)


def _with_controller(
    subject: _Subject,
    model: LinearModel,
    law: SetPoint | Tracking | Torques,
    t: float,
    state: Terms,
    sliding: Array | float,
) -> LinearModel:
    """Add the closed loop, or say why there is none."""
    if isinstance(law, Torques):
        return replace(model, notes=(*model.notes, "A and B are the plant's, without the scene's controller"))
    locked = np.array([model.coordinates.index(name) for name in model.locked], np.intp)
    try:
        loop = ClosedLoop(subject.mechanism, law, subject.smoothing, subject.library, subject.actuation)
        closed = loop.at(t, state, sliding, locked).closed
    except NumericalError as error:
        says = f"A and B are the plant's, without the scene's controller, since {error}"
        return replace(model, notes=(*model.notes, says))
    says = "A and B are the plant's; closed_loop is A with the scene's controller"
    spec = None if subject.scene is None else subject.scene.spec.controller
    if isinstance(spec, FeedbackSpec) and spec.sample_time is not None:
        more = {"delay": spec.delay > 0, "sensor": spec.sensor is not None, "drive": spec.drive is not None}
        says += f", without its {', '.join(['sampling', *(name for name, there in more.items() if there)])}"
    return replace(model, closed_loop=closed, notes=(*model.notes, says))


def _closed(state: Terms) -> Terms:
    """Close loops that are slightly open, and make J v' zero."""
    mechanism = state.mechanism
    at, v = project_onto_closure(state.at, mechanism.rank), state.v_tree
    if v.any():
        v = v + minimum_norm_step(at.J, mechanism.rank, at.J @ v, mechanism.tree.step_scale)
    return Terms(mechanism, at, v)


def _run_to(scene: Scene, t: float) -> Run:
    """Run a scene up to an instant; its own output instants stay as they are."""
    t_end = scene.spec.t_end
    if not 0 <= t <= t_end:
        raise InputError(f"t = {t:.15g} s is outside the run of {scene.name}, which lasts from 0 to {t_end:.15g} s")
    overrides = {"t_end": max(t, min(MOMENT, t_end))}
    run = simulate(make_scene(apply_overrides(scene.to_dict(), overrides), scene.name, scene.sources))
    if run.status == "interrupted":
        raise interrupt_again(run.message)
    if run.status == "done" and run.t[-1] >= t * (1 - 1e-12):
        return run
    says = f"t = {t:.15g} s is outside the run of {scene.name}, which ends at t = {run.t[-1]:.9g} s: {run.message}"
    raise InputError(says) if run.status == "done" else NumericalError(says, t=float(run.t[-1]))


def _notes(scene: Scene, run: Run, k: int) -> tuple[str, ...]:
    """Say what stands between this model and the run that goes on from there."""
    notes = []
    if np.any(np.abs(run.v_tree[k]) > 1e-6 * run.mechanism.tree.step_scale):
        notes.append("about a motion, not a state of rest: A and B are those of the instant")
    limits = scene_actuation(scene, run.mechanism).limit
    full = [name for name, x, most in zip(run.actuated, run.tau[k], limits, strict=True) if abs(x) >= most * (1 - 1e-9)]
    if full:
        notes.append(f"at the torque limit, so that no controller moves it further: {', '.join(full)}")
    return tuple(notes)
