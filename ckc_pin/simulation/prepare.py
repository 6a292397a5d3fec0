"""From a scene to a loop that can be started: mechanism, controller, start, formulation, solver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from os.path import exists
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.build import make_controller
from ckc_pin.control.controllers import (
    Controller,
    Law,
    SetPoint,
    TorqueController,
    Tracking,
    as_controller,
    gives_tau,
)
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.control.torques import Torques
from ckc_pin.dynamics.formulations import refuse_massless
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.generated.library import Library
from ckc_pin.kinematics.loading import load
from ckc_pin.mechanism.findings import beyond_stops
from ckc_pin.mechanism.library import mechanism_file
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism
from ckc_pin.mechanism.parameters import Changes
from ckc_pin.mechanism.tree import Array, BoolArray
from ckc_pin.native import _core
from ckc_pin.native.control import control_table
from ckc_pin.native.tables import core_table
from ckc_pin.native.variation import Varying, directions_of, variation_table
from ckc_pin.simulation.events import Event, EventFunction, event_functions
from ckc_pin.simulation.initial import Start, branch, find_start, is_chart, require_chart
from ckc_pin.simulation.libraries import changing_library, library_of
from ckc_pin.simulation.loop_terms import controller_call
from ckc_pin.simulation.scene import Scene
from ckc_pin.simulation.scene_spec import SceneSpec
from ckc_pin.simulation.varying import compensated_at, require_known_motion, require_movable, varying_of

__all__ = [
    "Prepared",
    "in_samples",
    "output_instants",
    "prepare",
    "require_runnable",
    "scene_actuation",
    "scene_controller",
    "scene_mechanism",
]

SLACK = 3e-3  # of rtol: how far a right-hand side may be off the closure, relative to the mechanism's size
UNEVEN = 1e4  # ratio of inertias from which heavy links turn what that is into accelerations of light ones
CLOSED = 1e-9  # of the mechanism's size: the loops stay closed along a collocation step, or the branches do not meet
UNLIMITED = 2**62
OUTPUTS = 500  # instants when a scene gives no output_dt
MAX_OUTPUTS = 1_000_000


def scene_mechanism(scene: Scene) -> Mechanism:
    """Load the mechanism that a scene names, relative to its own folder or by shipped name, or has made by rule."""
    return _built(scene, scene.spec.parameters)


def _built(scene: Scene, changes: Changes) -> Mechanism:
    mechanism = scene.spec.mechanism
    return load(_beside(scene, mechanism) if isinstance(mechanism, str) else mechanism, changes)


def _beside(scene: Scene, name: str) -> str | Path:
    folder = scene.sources.folder
    if folder is not None and (name.endswith(".toml") or exists(folder / name)):
        return mechanism_file(folder / name)
    return name


def scene_controller(
    scene: Scene, mechanism: Mechanism, texts: dict[str, str] | None = None
) -> SetPoint | Tracking | Torques | None:
    """Build a scene's controller; the texts of its own model are added to `texts`."""

    def load_model(name: str) -> Mechanism:
        model = load(_beside(scene, name))
        if texts is not None:
            texts.update({f"model/{file}": text for file, text in model.sources.texts.items()})
        return model

    spec = scene.spec
    if spec.controller is None:
        return None
    of = spec.controller, mechanism, spec.coriolis_velocity, spec.t_end, scene.sources
    with scene.sources.naming():
        start = {name: x for name, x in spec.initial.q.items() if name in mechanism.coordinates}
        near = branch(mechanism, start)
        if not is_chart(near):  # between branches; the start itself is refused
            near = mechanism.assembled
        return make_controller(*of, near, load_model)


def scene_actuation(scene: Scene, mechanism: Mechanism) -> Actuation:
    """Return how a scene's controller, or who stands in for it, moves the motors."""
    spec = scene.spec.controller
    allocation = spec.allocation if isinstance(spec, FeedbackSpec) else None
    with scene.sources.naming():
        return Actuation(mechanism, spec.torque_limit if spec else None, allocation)


def in_samples(
    scene: Scene, controller: SetPoint | Tracking | Torques | None
) -> SetPoint | Tracking | Torques | Sampled | None:
    """Return a scene's controller on the clock that the scene gives it, if it does."""
    spec = scene.spec.controller
    if controller is None or not isinstance(spec, FeedbackSpec) or spec.sample_time is None:
        return controller
    with scene.sources.naming():
        return Sampled(controller, spec.sample_time, spec.delay, spec.sensor, spec.drive)


def require_runnable(
    scene: Scene,
    mechanism: Mechanism,
    controller: Controller | TorqueController | Sampled | None,
    actuation: Actuation,
    *,
    free: bool = False,
) -> Start:
    """Return where a scene starts, where it can be run from there under a controller.

    Raises
    ------
    InputError, NumericalError
        It cannot: no freedoms, no or a singular start, motors that cannot do what the controller wants.
    """
    if isinstance(controller, Sampled):
        with scene.sources.naming():
            controller.require_countable(scene.spec.t_end)
            controller.require_sensible(mechanism)
    if mechanism.d == 0:
        raise InputError(f"{mechanism.name}: d = 0, the loops leave no freedom: nothing can move")
    if mechanism.splits_root and (controller is not None or free or scene.spec.formulation != "dae"):
        raise InputError(f"{mechanism.name}: {CONSTRAINED_IN_PART}")
    start = find_start(mechanism, scene)
    with scene.sources.naming():
        if beyond := beyond_stops(mechanism, start.at.q_tree):
            raise InputError(f"initial: {beyond}; give another initial.q, or a q_guess within them")
    refuse_massless(Terms(mechanism, start.at, np.zeros(mechanism.n)), start.at.rho, start.at.partition.q)
    law = controller.controller if isinstance(controller, Sampled) else controller
    if law is not None and not gives_tau(law):
        require_chart(mechanism, start)
        actuation.require_transmission(start.at)
    return start


@dataclass(frozen=True)
class Prepared:
    """A scene ready to be run, again and again.

    Attributes
    ----------
    scene : Scene
    mechanism : Mechanism
    controller : Controller, TorqueController, Sampled or None
        What acts, beside a u that is held.
    actuation : Actuation
    events : list of EventFunction
    instants : (m,) array
        Output instants, s; empty where the caller steps.
    start : Start
    texts : dict of str to str
        The files of mechanism, scene and controller.
    tables : tuple
        What the loop is made of: core, formulation, control, solver, events.
    loop : native Loop
    varying : tuple of Varying
        Numbers that the motion's changes with are integrated beside it.
    changing : dict of str to bool arrays, or None
        Numbers that compiled terms would have to take to say how the motion changes; None where they do or cannot.
    """

    scene: Scene
    mechanism: Mechanism
    controller: Controller | TorqueController | Sampled | None
    actuation: Actuation
    events: list[EventFunction]
    instants: Array
    start: Start
    texts: dict[str, str]
    tables: tuple[Any, ...]
    loop: Any
    varying: tuple[Varying, ...] = ()
    changing: dict[str, BoolArray] | None = None

    def begin(self, start: Start | None = None, t: float = 0.0) -> None:
        """Put the loop to a start, as if nothing had been before."""
        start = start or self.start
        with np.errstate(over="ignore"):
            v_tree = start.at.rho @ start.q_dot if start.v_tree is None else start.v_tree
        if not np.all(np.isfinite(v_tree)):
            raise InputError(
                f"initial.q_dot = {start.q_dot.tolist()}: the other coordinates' rates are not finite then"
            )
        self.loop.start(t, start.at.q_tree, v_tree, start.w)


def prepare(
    scene: Scene,
    controller: Controller | TorqueController | Sampled | Law | None = None,
    events: Sequence[Event] = (),
    *,
    free: bool = False,
    profile: bool = False,
    library: Library | None = None,
    parameters: Sequence[str] = (),
) -> Prepared:
    """Build everything that a scene needs before its first step.

    Parameters
    ----------
    controller : Controller, TorqueController, Sampled or function u(t, terms), optional
        Takes the place of the scene's.
    events : sequence of Event
        Beside those of the scene.
    free : bool
        No controller at all: the caller says what acts.
    profile : bool
        Count which terms are evaluated.
    library : Library, optional
        The mechanism's terms, compiled, in the place of those that the scene's solver.terms says.
    parameters : sequence of str
        What the motion's changes with are integrated beside it.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written.
    NumericalError
        Its start is singular.
    """
    instants = np.zeros(0) if free else output_instants(scene)  # refused before anything is loaded
    mechanism = scene_mechanism(scene)
    texts: dict[str, str] = {}
    if controller is None and not free:
        controller = in_samples(scene, scene_controller(scene, mechanism, texts))
    elif controller is not None and not isinstance(controller, Sampled):
        controller = as_controller(controller)
    actuation = scene_actuation(scene, mechanism)
    functions = event_functions(scene.spec.event, events, mechanism)
    start = require_runnable(scene, mechanism, controller, actuation, free=free)
    D_tree = mechanism.tree.evaluate(pin.crba, start.at.q_tree)
    formulation = _formulation(mechanism, scene.spec, np.diagonal(D_tree))
    varying: list[Varying] = []
    changing: dict[str, BoolArray] | None = None
    terms = scene.spec.solver.terms
    if parameters:
        changed = partial(_built, scene)
        law = controller.controller if isinstance(controller, Sampled) else controller
        varying = varying_of(mechanism, scene, law, actuation, parameters, changed, start.at.q_tree)
        require_known_motion(mechanism, scene, controller, varying)
        require_movable(mechanism, scene.spec.parameters, varying, changed)
        changing, directions = directions_of(mechanism, varying) or (None, None)
        library = changing_library(mechanism, terms, changing)
        changing = changing if library is None else None
        formulation["variation"] = variation_table(
            mechanism, varying, directions, at_equilibrium=scene.spec.initial.at == "equilibrium",
            target=compensated_at(mechanism, law),
        )  # fmt: skip
    with scene.sources.naming():
        control = control_table(
            controller, actuation, partial(controller_call, mechanism=mechanism), differs=bool(parameters)
        )
    tables = (
        core_table(mechanism, library or library_of(mechanism, terms), scene.spec.friction_smoothing or 0.0),
        formulation,
        control,
        _solver(mechanism, scene.spec, profile),
        [event.row for event in functions],
    )
    loop = _core.Loop(*tables)
    texts = {**mechanism.sources.texts, **scene.sources.texts, **texts}
    return Prepared(
        scene,
        mechanism,
        controller,
        actuation,
        functions,
        instants,
        start,
        texts,
        tables,
        loop,
        tuple(varying),
        changing,
    )


def output_instants(scene: Scene) -> Array:
    """Return when a run of a scene is recorded, s (InputError where that is too often)."""
    t_end, output_dt = scene.spec.t_end, scene.spec.solver.output_dt
    if output_dt is None:
        return np.unique(np.linspace(0.0, t_end, OUTPUTS + 1, dtype=float))  # fewer in a t_end of a few denormals
    if t_end / output_dt > MAX_OUTPUTS:
        says = f"solver.output_dt = {output_dt:g} gives more than {MAX_OUTPUTS} output instants in {t_end:g} s"
        raise InputError(f"{scene.sources.name}: {says}")
    times = np.arange(int(t_end / output_dt * (1 + 1e-12)) + 1, dtype=float) * output_dt
    if t_end - times[-1] > 1e-9 * min(output_dt, t_end):
        return np.append(times, t_end)
    times[-1] = t_end
    return times


def _formulation(mechanism: Mechanism, spec: SceneSpec, inertias: np.ndarray[Any, Any]) -> dict[str, Any]:
    if spec.formulation == "dae":
        alpha, beta = spec.solver.baumgarte or (0.0, 0.0)
        return {"kind": "dae", "tolerance": mechanism.tolerance, "projects": spec.solver.projection,
                "alpha": alpha, "beta": beta}  # fmt: skip
    table = {
        "tolerance": mechanism.tolerance,
        "epsilon": spec.epsilon if spec.formulation == "spf" else 1.0,
        "actual": spec.formulation == "spf" and spec.coriolis_velocity == "actual",
    }
    sticks = mechanism.joints.has_events(spec.friction_smoothing)
    if spec.formulation == "spf" and spec.spf_coordinates == "z":
        if mechanism.tree.free:
            raise InputError(
                'spf_coordinates = "z": eq. 8 as printed integrates q and z as numbers, and the rotation of a free '
                'root is none; take "w"'
            )
        if sticks:
            raise InputError(
                f'{mechanism.name}: spf_coordinates = "z" leaves the loops open by its tolerance, and joints that '
                'stick or touch are rows of their closure; take "w"'
            )
        return {"kind": "printed", **table}
    if sticks and spec.initial.w is not None and any(spec.initial.w):
        raise InputError(
            f"initial.w: off phi = 0 the joints of {mechanism.name} that stick or touch cannot be held; leave it out"
        )
    # heavy links turn what a light one's closure is off by into accelerations
    evenness = min(1.0, UNEVEN * float(inertias.min()) / float(inertias.max()))
    return {"kind": "level_set", **table, "slack": SLACK * spec.solver.rtol * mechanism.size * evenness}


def _solver(mechanism: Mechanism, spec: SceneSpec, profile: bool) -> dict[str, Any]:
    solver = spec.solver
    printed = spec.formulation == "spf" and spec.spf_coordinates == "z"
    return {
        "method": "Radau" if solver.method == "auto" and printed else solver.method,
        "rtol": solver.rtol,
        "atol": solver.rtol / 100 if solver.atol is None else solver.atol,
        "max_step": solver.max_step or math.inf,
        "min_step": solver.min_step,
        "max_rhs": solver.max_rhs or UNLIMITED,
        "closed": max(CLOSED * mechanism.size, 10 * mechanism.tolerance),
        "profile": profile,
    }
