"""Linear models: about an equilibrium, an operating point that motors hold, or an instant of a scene's run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.dynamics.formulations import tangent_basis
from ckc_pin.dynamics.terms import Terms, terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.generated.library import Library
from ckc_pin.kinematics.loading import load
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.kinds import require_kind, require_table
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.check import names_a_scene
from ckc_pin.simulation.closed_loop import ClosedLoop
from ckc_pin.simulation.libraries import library_of
from ckc_pin.simulation.linear_model import LinearModel, linear_model
from ckc_pin.simulation.prepare import scene_actuation, scene_controller, scene_mechanism
from ckc_pin.simulation.recorded_joints import RecordedJoints
from ckc_pin.simulation.run import Run
from ckc_pin.simulation.scene import CHANGES, Scene, load_scene, make_scene, with_changes
from ckc_pin.simulation.simulate import simulate

__all__ = ["At", "linearize"]

At = str | float | Mapping[str, float]

LEFT_OVER = 1e-9  # of the forces along a freedom: rounding, which no motor needs to hold
ROUNDING = 1e-4  # of that along the others
NO_CHART = 1e-6  # margin of phi_z below which q is none
OPEN = 1e-6  # of the mechanism's size: loops further open are not those of eq. 1
MOMENT = 1e-9  # s: a run to its very start


@dataclass(frozen=True)
class _Subject:
    mechanism: Mechanism
    scene: Scene | None

    @property
    def smoothing(self) -> float | None:
        return None if self.scene is None else self.scene.spec.friction_smoothing

    @property
    def library(self) -> Library | None:
        return library_of(self.mechanism, "auto" if self.scene is None else self.scene.spec.solver.terms)


def linearize(
    what: Mechanism | Scene | str | Path, at: At = "equilibrium", changes: Mapping[str, Any] | None = None
) -> LinearModel:
    """Linearize a mechanism, exactly, in minimal coordinates.

    Parameters
    ----------
    what : Mechanism, Scene, str or Path
        As `check` takes it. Of a mechanism's name with `changes` or an instant, its default scene.
    at : "equilibrium", "assembled", float or {coordinate: value}
        The stable equilibrium reached from q_guess, motors at rest; an instant of the scene's run, s; or at rest, held
        by the least torques of the motors, the configuration as assembled, or one as `terms` takes it.
    changes : mapping, optional
        Values of the scene by dotted key, e.g. ``{"friction_smoothing": 0.01}``.

    Returns
    -------
    LinearModel
        Of the plant, with the motors' torques as inputs; at an instant of a scene with a set point or tracking, the
        closed loop's A besides.

    Raises
    ------
    InputError
        An operating point that the motors cannot hold, an instant outside the run, no freedom left.
    NumericalError
        No equilibrium there, a singular configuration.

    Notes
    -----
    Dry friction is smoothed as the scene's friction_smoothing says; else joints with friction that are at rest are
    locked, and those that slide feel a constant force.

    >>> model = linearize("five_bar")
    >>> model.A.shape, model.inputs
    ((4, 4), ('theta_1', 'theta_3'))
    """
    takes = "a mechanism or a scene: itself, its name or path"
    require_kind(what, (Mechanism, Scene, str, Path), "linearize: what", takes)
    if changes is not None:
        require_table(changes, "linearize: changes", CHANGES)
    with one_blas_thread():
        subject = _subject(what, at, changes)
        if subject.mechanism.d == 0:
            raise InputError(f"{subject.mechanism.name}: d = 0, the loops leave no freedom: nothing can move")
        if isinstance(at, Mapping):
            return _at_point(subject, at)
        if at == "equilibrium":
            return _at_equilibrium(subject)
        if at == "assembled":
            mechanism = subject.mechanism
            return _operating(subject, Terms(mechanism, mechanism.assembled, np.zeros(mechanism.n)))
        return _at_instant(subject, _instant(at))


def _subject(what: Mechanism | Scene | str | Path, at: At, changes: Mapping[str, Any] | None) -> _Subject:
    if isinstance(what, str | Path):
        timed = not isinstance(at, Mapping | str)
        if not (names_a_scene(str(what)) or changes or timed):
            return _Subject(load(what), None)
        what = load_scene(what, changes)
    elif changes:
        raise InputError("linearize: changes go with a name; a Scene or a Mechanism is complete")
    return _Subject(scene_mechanism(what), what) if isinstance(what, Scene) else _Subject(what, None)


def _instant(at: At) -> float:
    if isinstance(at, int | float | np.integer | np.floating) and not isinstance(at, bool) and math.isfinite(at):
        return float(at)
    raise InputError(f'at = {at!r:.80}: give "equilibrium", "assembled", a time in seconds, or a table of coordinates')


# --- at rest -------------------------------------------------------------------------------------


def _at_equilibrium(subject: _Subject) -> LinearModel:
    mechanism = subject.mechanism
    try:
        at = stable_equilibrium(mechanism)
    except NumericalError as error:
        raise NumericalError(
            f"{error}; or linearize it as assembled, or at coordinates, where its motors hold it, or at an instant of "
            "a scene's run",
            q_tree=error.q_tree,
        ) from None
    return _at_rest(subject, at, np.zeros(len(mechanism.actuated)), "at its equilibrium")


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
    return _operating(subject, state)


def _operating(subject: _Subject, state: Terms) -> LinearModel:
    """Hold a configuration by the least torques; refuse what the motors do not reach."""
    mechanism, actuation = subject.mechanism, _actuation(subject)
    tangent, _ = tangent_basis(state, np.zeros(mechanism.closure.rows))
    needed = tangent.T @ state.h_tree
    tau = actuation.distribute(tangent, needed)
    u_tree = mechanism.motors.force(tau)
    enough = LEFT_OVER * (np.abs(tangent.T) @ (np.abs(state.h_tree) + np.abs(u_tree)))
    if np.any(np.abs(needed - tangent.T @ u_tree) > enough + ROUNDING * enough.max()):
        loose = _loose(state, tangent, actuation)
        names = ", ".join(mechanism.actuated) or "no motor"
        raise InputError(
            f"{mechanism.name}: the motors ({names}) cannot hold this configuration: nothing holds the motion along "
            f"{loose}, and gravity or springs act on it; take another one, the equilibrium, or more motors"
        )
    weak = np.flatnonzero(np.abs(tau) > actuation.limit * (1 + 1e-9))
    if len(weak):
        k = int(weak[0])
        raise InputError(
            f"{mechanism.name}: the motors cannot hold this configuration: {mechanism.actuated[k]} would need "
            f"{abs(tau[k]):.4g}, its limit is {actuation.limit[k]:.4g}"
        )
    return _at_rest(subject, state.at, tau, "held by its motors")


def _loose(state: Terms, tangent: Array, actuation: Actuation) -> str:
    """Name freedoms that no motor drives; where q is no chart, the coordinate that moves most in the loosest one."""
    if state.at.margin() > NO_CHART:
        return ", ".join(actuation.undriven(state.at))
    mechanism = state.mechanism
    motions, _ = np.linalg.qr(tangent / mechanism.tree.reach[:, None])
    grip = mechanism.motors.turns @ motions
    loosest = np.linalg.eigh(grip.T @ grip)[1][:, 0]
    return mechanism.coordinates[int(np.argmax(np.abs(motions @ loosest)))]


def _actuation(subject: _Subject) -> Actuation:
    return Actuation(subject.mechanism) if subject.scene is None else scene_actuation(subject.scene, subject.mechanism)


def _at_rest(subject: _Subject, at: Kinematics, tau: Array, says: str) -> LinearModel:
    mechanism, smoothing = subject.mechanism, subject.smoothing
    sticks = np.flatnonzero(mechanism.joints.friction) if smoothing is None else np.zeros(0, dtype=np.intp)
    state = Terms(mechanism, at, np.zeros(mechanism.n))
    return linear_model(state, tau, at=says, locked=sticks, smoothing=smoothing, library=subject.library)


# --- along a run ---------------------------------------------------------------------------------


def _at_instant(subject: _Subject, t: float) -> LinearModel:
    scene, mechanism = subject.scene, subject.mechanism
    if scene is None:
        raise InputError(f"at = {t:g}: a mechanism has no time; give one of its scenes")
    run = _run_to(scene, t)
    k = run.at(t)
    state = Terms(mechanism, mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[k])), run.v_tree[k])
    miss = float(np.abs(run.phi[k]).max(initial=0.0))
    if miss > max(OPEN * mechanism.size, 10 * mechanism.tolerance):
        raise InputError(
            f"at t = {t:g} s the loops of {scene.name} are open (|phi| = {miss:.3g}), as an SPF off its manifold is; "
            "give a later instant"
        )
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
    if law is None:
        return model
    if not isinstance(law, SetPoint | Tracking) or model.states[: mechanism.d] != mechanism.independent:
        return replace(model, notes=(*model.notes, "A and B are the plant's, without the scene's controller"))
    says = "A and B are the plant's; closed_loop is A with the scene's controller"
    spec = scene.spec.controller
    if isinstance(spec, FeedbackSpec) and spec.sample_time is not None:
        says += ", without its sampling and delay"
    closed = ClosedLoop(mechanism, law, smoothing, subject.library).at(t, state).closed
    return replace(model, closed_loop=closed, notes=(*model.notes, says))


def _run_to(scene: Scene, t: float) -> Run:
    """Run a scene up to an instant; its own output instants stay as they are."""
    t_end = scene.spec.t_end
    if not 0 <= t <= t_end:
        raise InputError(f"t = {t:g} s is outside the run of {scene.name}, which lasts from 0 to {t_end:g} s")
    changes = {"t_end": max(t, min(MOMENT, t_end))}
    run = simulate(make_scene(with_changes(scene.plain(), changes), scene.name, scene.sources))
    if run.status == "interrupted":
        raise KeyboardInterrupt(run.message)
    if run.status != "done" or run.t[-1] < t * (1 - 1e-12):
        raise InputError(
            f"t = {t:g} s is outside the run of {scene.name}, which ends at t = {run.t[-1]:.6g} s: {run.message}"
        )
    return run


def _notes(scene: Scene, run: Run, k: int) -> tuple[str, ...]:
    """Say what stands between this model and the run that goes on from there."""
    notes = []
    if np.any(np.abs(run.v_tree[k]) > 1e-6 * run.mechanism.tree.reach):
        notes.append("about a motion, not a state of rest: A and B are those of the instant")
    limits = scene_actuation(scene, run.mechanism).limit
    full = [name for name, x, most in zip(run.actuated, run.tau[k], limits, strict=True) if abs(x) >= most * (1 - 1e-9)]
    if full:
        notes.append(f"at their torque limit, so that the controller moves them no more there: {', '.join(full)}")
    return tuple(notes)
