"""From a scene to a loop that can be started: mechanism, controller, start, formulation, solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.codegen.library import Library
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import ControlLaw, Controller, TorqueController, as_controller
from ckc_pin.control.sampled import Sampled
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.native.control import control_table
from ckc_pin.native.tables import core_table
from ckc_pin.native.variation import SensitivityParameter
from ckc_pin.run.compiled_terms import library_of
from ckc_pin.run.events import Event, EventFunction, event_functions
from ckc_pin.run.loop_tables import formulation_table, solver_table
from ckc_pin.run.loop_terms import controller_call
from ckc_pin.run.runnable import require_runnable
from ckc_pin.scene.initial import Start
from ckc_pin.scene.output_instants import output_instants
from ckc_pin.scene.parts import (
    in_samples,
    scene_actuation,
    scene_controller,
    scene_mechanism,
)
from ckc_pin.scene.scene import Scene

__all__ = ["DerivativeSetup", "ParameterDerivatives", "Prepared", "prepare"]


@dataclass(frozen=True)
class ParameterDerivatives:
    """What the native loop needs to integrate the derivatives of a motion with respect to parameters.

    Attributes
    ----------
    sensitivity_parameters : tuple of SensitivityParameter
        The parameters.
    table : dict
        The formulation's entry for them.
    library : Library or None
        Compiled terms that have these derivatives.
    missing_arguments : dict of str to bool arrays, or None
        Arguments that a library would need to have these derivatives; None where there is one, or none can.
    """

    sensitivity_parameters: tuple[SensitivityParameter, ...]
    table: dict[str, Any]
    library: Library | None
    missing_arguments: dict[str, BoolArray] | None


class DerivativeSetup(Protocol):
    """Build the parameter derivatives of a scene that is being prepared."""

    def __call__(
        self,
        scene: Scene,
        mechanism: Mechanism,
        controller: Controller | TorqueController | Sampled | None,
        actuation: Actuation,
        start: Start,
    ) -> ParameterDerivatives:
        """Return them (InputError: the motion has no known derivatives)."""
        ...


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
    derivatives : ParameterDerivatives or None
        Set where derivatives of the motion are integrated beside it.
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
    derivatives: ParameterDerivatives | None = None

    @property
    def missing_arguments(self) -> dict[str, BoolArray] | None:
        """Arguments that a library of compiled terms would need to have the parameter derivatives."""
        return self.derivatives.missing_arguments if self.derivatives else None

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
    controller: Controller | TorqueController | Sampled | ControlLaw | None = None,
    events: Sequence[Event] = (),
    *,
    free: bool = False,
    profile: bool = False,
    library: Library | None = None,
    derivatives: DerivativeSetup | None = None,
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
    derivatives : DerivativeSetup, optional
        Builds the parameter derivatives that are integrated beside the motion.

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
    terms = scene.spec.solver.terms
    setup = None if derivatives is None else derivatives(scene, mechanism, controller, actuation, start)
    if setup is not None:
        library = setup.library
        formulation["variation"] = setup.table
    with scene.sources.prefix_errors():
        control = control_table(
            controller, actuation, partial(controller_call, mechanism=mechanism), differs=setup is not None
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
        setup,
    )
