"""From a scene to a loop that can be started: mechanism, controller, start, formulation, solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import Controller, Law, TorqueController, as_controller
from ckc_pin.control.sampled import Sampled
from ckc_pin.errors import InputError
from ckc_pin.generated.library import Library
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array, BoolArray
from ckc_pin.native import _core
from ckc_pin.native.control import control_table
from ckc_pin.native.tables import core_table
from ckc_pin.native.variation import Varying, directions_of, variation_table
from ckc_pin.simulation.events import Event, EventFunction, event_functions
from ckc_pin.simulation.initial import Start
from ckc_pin.simulation.libraries import changing_library, library_of
from ckc_pin.simulation.loop_tables import formulation_table, solver_table
from ckc_pin.simulation.loop_terms import controller_call
from ckc_pin.simulation.output_instants import output_instants
from ckc_pin.simulation.runnable import require_runnable
from ckc_pin.simulation.scene import Scene
from ckc_pin.simulation.scene_parts import (
    changed_mechanism,
    in_samples,
    scene_actuation,
    scene_controller,
    scene_mechanism,
)
from ckc_pin.simulation.varying import (
    at_assembled_stop,
    compensated_at,
    require_known_motion,
    require_movable,
    varying_of,
)

__all__ = ["Prepared", "prepare"]


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
    formulation = formulation_table(mechanism, scene.spec, np.diagonal(D_tree))
    varying: list[Varying] = []
    changing: dict[str, BoolArray] | None = None
    terms = scene.spec.solver.terms
    if parameters:
        changed = partial(changed_mechanism, scene)
        law = controller.controller if isinstance(controller, Sampled) else controller
        varying = varying_of(mechanism, scene, law, actuation, parameters, changed, start.at.q_tree)
        require_known_motion(mechanism, scene, controller, varying)
        require_movable(mechanism, scene.spec.parameters, varying, changed)
        if scene.spec.initial.at == "assembled":
            varying = [at_assembled_stop(mechanism, scene.spec.parameters, x, changed) for x in varying]
        changing, directions = directions_of(mechanism, varying) or (None, None)
        library = changing_library(mechanism, terms, changing)
        changing = changing if library is None else None
        formulation["variation"] = variation_table(
            mechanism, varying, directions, at_equilibrium=scene.spec.initial.at == "equilibrium",
            target=compensated_at(mechanism, law), controlled=controller is not None or free,
        )  # fmt: skip
    with scene.sources.naming():
        control = control_table(
            controller, actuation, partial(controller_call, mechanism=mechanism), differs=bool(parameters)
        )
    tables = (
        core_table(mechanism, library or library_of(mechanism, terms), scene.spec.friction_smoothing or 0.0),
        formulation,
        control,
        solver_table(mechanism, scene.spec, profile),
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
