"""Prepare a scene for a run: load the mechanism, build controller, events and start, and make the native loop."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.codegen.library import Library
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import (
    ControlLaw,
    Controller,
    RecordedTorques,
    SetPoint,
    TorqueController,
    Tracking,
    require_no_memory,
)
from ckc_pin.control.desired import Desired
from ckc_pin.control.forces import BodyForce
from ckc_pin.control.joint_servo import JointServo
from ckc_pin.control.sampled import Sampled, unwrap_sampled
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.native.control import breakpoints_table, control_table, force_tables, prescribed_tables
from ckc_pin.native.tables import core_table
from ckc_pin.run.checks import require_runnable, start_warnings
from ckc_pin.run.compiled_terms import NEVER, select_library
from ckc_pin.run.events import Event, EventFunction, build_event_functions, switch_tables
from ckc_pin.run.loop_terms import wrap_controller, wrap_force
from ckc_pin.scene.initial import Start, prescribed_velocity
from ckc_pin.scene.parts import (
    apply_sampling,
    build_scene_actuation,
    build_scene_controller,
    build_scene_forces,
    load_scene_mechanism,
    prescribed_motions,
)
from ckc_pin.scene.scene import Scene
from ckc_pin.scene.spec import SceneSpec

if TYPE_CHECKING:
    from ckc_pin.native.sensitivity_tables import SensitivityParameter

__all__ = ["Prepared", "SensitivitySetup", "SetUpSensitivities", "prepare"]

# A right-hand side is evaluated this close to the constraint manifold, relative to rtol and the mechanism's size.
CLOSURE_TOLERANCE = 3e-3
# From this ratio of inertias on, heavy links turn an open closure into accelerations of light links.
MAX_INERTIA_RATIO = 1e4
# A collocation step keeps the loops closed to this, relative to the mechanism's size. Otherwise its branches would not
# meet at a loss of rank.
COLLOCATION_TOLERANCE = 1e-9
# A controller is called at the start, later and at another state, and at the start again, to see whether it changes.
MEMORY_CHECK_TIME = 1e-3  # of t_end
MEMORY_CHECK_STEP = 1e-3  # of each independent coordinate: rad, or relative to the mechanism's size
# Controllers that are functions of (t, terms), or are evaluated once a sample.
NATIVE_CONTROLLERS = (SetPoint, Tracking, RecordedTorques, JointServo, Sampled)


class SensitivitySetup(Struct, frozen=True):
    """Tables with which the native loop integrates sensitivities of a motion.

    Attributes
    ----------
    sensitivity_parameters : tuple of SensitivityParameter
    table : dict
        The entry "sensitivities" of the formulation's table.
    parameter_library : Library or None
        Compiled terms with derivatives with respect to these parameters.
    missing_arguments : dict of str to bool arrays, or None
        Arguments that a library needs for these derivatives. None if there is such a library, or if there can be none.
    """

    sensitivity_parameters: tuple[SensitivityParameter, ...]
    table: dict[str, Any]
    parameter_library: Library | None
    missing_arguments: dict[str, BoolArray] | None


class SetUpSensitivities(Protocol):
    """Builds the tables of sensitivities of a scene that is being prepared."""

    def __call__(
        self,
        scene: Scene,
        mechanism: Mechanism,
        controller: Controller | TorqueController | Sampled | None,
        actuation: Actuation,
        start: Start,
    ) -> SensitivitySetup:
        """Return the tables (InputError: the motion has no known derivatives)."""
        ...


class Prepared(Struct, frozen=True, kw_only=True, dict=True):
    """A scene that is ready to run. It can be run several times.

    Attributes
    ----------
    scene : Scene
    mechanism : Mechanism
    controller : Controller, TorqueController, Sampled or None
        None if the caller gives u.
    actuation : Actuation
    forces : list of BodyForce
    events : list of EventFunction
    instants : (m,) array
        Output instants, s; empty if the caller steps.
    start : Start
    texts : dict of str to str
        Files of mechanism, scene and controller, by name.
    tables : tuple
        Arguments of the native loop: core, formulation, control, solver, events.
    loop : _core.Loop
    sensitivities : SensitivitySetup or None
        Set if sensitivities are integrated with the motion.
    """

    scene: Scene
    mechanism: Mechanism
    controller: Controller | TorqueController | Sampled | None
    actuation: Actuation
    forces: list[BodyForce]
    events: list[EventFunction]
    instants: Array
    start: Start
    texts: dict[str, str]
    tables: tuple[Any, ...]
    loop: _core.Loop
    sensitivities: SensitivitySetup | None = None

    @property
    def missing_arguments(self) -> dict[str, BoolArray] | None:
        """Arguments that a library of compiled terms needs for the parameter derivatives, if there is none yet."""
        return self.sensitivities.missing_arguments if self.sensitivities else None

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the mechanism and the start, which are known without following the desired motion."""
        return (*self.mechanism.warnings, *start_warnings(self.scene, self.mechanism, self.start))

    @cached_property
    def _prescribed_motions(self) -> list[Desired]:
        return prescribed_motions(self.scene.spec.prescribed)

    def _prescribed_rates(self, t: float) -> Array:
        """Return the rates of the prescribed joints at a start at t, (joints,)."""
        spec = self.scene.spec
        return np.array(
            [
                motion(t)[1][0] if one.begins is None else spec.initial.q_dot.get(one.joint, 0.0)
                for one, motion in zip(spec.prescribed, self._prescribed_motions, strict=True)
            ]
        )

    def begin(self, start: Start | None = None, t: float = 0.0) -> None:
        """Set the loop to a start at time t (s), by default the scene's, and discard its history.

        A controller with a method `reset` is reset, so that it carries nothing over from an earlier run.

        Raises
        ------
        InputError
            The velocity is not finite.
        """
        start = start or self.start
        with np.errstate(over="ignore"):
            v_tree = start.at.rho @ start.q_dot if start.v_tree is None else start.v_tree
        if self.mechanism.prescribed and start.v_tree is None:
            v_tree = v_tree + prescribed_velocity(self.mechanism, start.at, self._prescribed_rates(t))
        if not np.all(np.isfinite(v_tree)):
            raise InputError(
                f"initial.q_dot = {start.q_dot.tolist()}: the rates of the dependent coordinates are not finite"
            )
        law = unwrap_sampled(self.controller)
        reset = getattr(law, "reset", None)
        if callable(reset):
            reset()
        self.loop.start(t, start.at.q_tree, v_tree, start.w)


def prepare(
    scene: Scene,
    controller: Controller | TorqueController | Sampled | ControlLaw | Mapping[str, Any] | None = None,
    events: Sequence[Event | Mapping[str, Any]] = (),
    *,
    free: bool = False,
    profile: bool = False,
    library: Library | None = None,
    set_up_sensitivities: SetUpSensitivities | None = None,
) -> Prepared:
    """Build everything that a scene needs before its first step.

    Parameters
    ----------
    scene : Scene
    controller : Controller, TorqueController, Sampled, function u(t, terms) or mapping, optional
        Replaces the scene's controller.
    events : sequence of Event or mapping
        Events in addition to the scene's.
    free : bool
        Use no controller; the caller gives u step by step.
    profile : bool
        Count the terms that are evaluated.
    library : Library, optional
        Compiled terms to use instead of those that solver.terms selects.
    set_up_sensitivities : SetUpSensitivities, optional
        Builds the tables of sensitivities that are integrated with the motion.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written.
    NumericalError
        Its start is singular.
    """
    # Too many output instants are refused before anything is loaded.
    instants = np.zeros(0) if free else scene.output_instants()
    scene = scene.with_control(controller, events)
    mechanism = load_scene_mechanism(scene)
    texts: dict[str, str] = {}
    law = None if free else apply_sampling(scene, build_scene_controller(scene, mechanism, texts))
    actuation = build_scene_actuation(scene, mechanism)
    body_forces = build_scene_forces(scene, mechanism)
    functions = build_event_functions(scene.spec.event, scene.events, mechanism)
    start = require_runnable(scene, mechanism, law, actuation, free=free)
    if law is not None and not isinstance(law, NATIVE_CONTROLLERS):
        v_tree, tree = start.at.rho @ start.q_dot, mechanism.tree
        step = MEMORY_CHECK_STEP * start.at.rho.sum(axis=1) * tree.step_scale
        other = mechanism.kinematics(tree.integrate(start.at.q_tree, step))
        later = MEMORY_CHECK_TIME * scene.spec.t_end
        require_no_memory(law, Terms(mechanism, start.at, v_tree), Terms(mechanism, other, v_tree, later))
    D_tree = mechanism.tree.mass_matrix(start.at.q_tree)
    formulation = _formulation_table(mechanism, scene.spec, np.diagonal(D_tree))
    switches: list[float] = []
    later_motions: list[Desired] = []
    functions_of_time: list[Any] = [force.over_time for force in body_forces]
    if not isinstance(law, Sampled):
        functions_of_time += [law, getattr(law, "desired", None)]
    if mechanism.prescribed:
        motions = prescribed_motions(scene.spec.prescribed)
        for one, motion in zip(scene.spec.prescribed, motions, strict=True):
            (functions_of_time if one.begins is None else later_motions).append(motion)
            switches += [x for x in (one.begins, one.ends) if isinstance(x, float)]
        formulation["prescribed"] = prescribed_tables(
            mechanism,
            motions,
            [switch_tables(one, functions) for one in scene.spec.prescribed],
            smooth_friction=scene.spec.friction_smoothing is not None,
        )
    if body_forces:
        formulation["forces"] = force_tables(body_forces, partial(wrap_force, mechanism=mechanism))
    if (breakpoints := breakpoints_table(functions_of_time, switches, later_motions)) is not None:
        formulation["breakpoints"] = breakpoints
    formulation["works"] = scene.spec.work
    if isinstance(servo := unwrap_sampled(law), JointServo):
        servo.limit_torques(actuation.limit)
    sensitivities = None
    if set_up_sensitivities is not None:
        sensitivities = set_up_sensitivities(scene, mechanism, law, actuation, start)
        library = sensitivities.parameter_library
        formulation["sensitivities"] = sensitivities.table
    with scene.sources.prefix_errors():
        control = control_table(
            law,
            actuation,
            partial(wrap_controller, mechanism=mechanism),
            differentiates=sensitivities is not None,
        )
    library = library or select_library(mechanism, scene.spec.solver.terms)
    tables = (
        core_table(mechanism, library, scene.spec.friction_smoothing or 0.0),
        formulation,
        control,
        _solver_table(mechanism, scene.spec, profile=profile),
        [function.event for function in functions],
    )
    return Prepared(
        scene=scene,
        mechanism=mechanism,
        controller=law,
        actuation=actuation,
        forces=body_forces,
        events=functions,
        instants=instants,
        start=start,
        texts={**mechanism.sources.texts, **scene.sources.texts, **texts},
        tables=tables,
        loop=_core.Loop(*tables),
        sensitivities=sensitivities,
    )


def _formulation_table(mechanism: Mechanism, spec: SceneSpec, inertias: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return the native loop's table of a formulation and its tolerances.

    Parameters
    ----------
    inertias : (n,) array
        Diagonal of D' at the start.

    Raises
    ------
    InputError
        The mechanism cannot be integrated in the scene's spf_coordinates, or off phi = 0.
    """
    if spec.formulation == "dae":
        alpha, beta = spec.solver.baumgarte or (0.0, 0.0)
        return {"kind": "dae", "tolerance": mechanism.tolerance, "projects": spec.solver.projection,
                "alpha": alpha, "beta": beta}  # fmt: skip
    table = {
        "tolerance": mechanism.tolerance,
        "epsilon": spec.epsilon if spec.formulation == "spf" else 1.0,
        "actual": spec.formulation == "spf" and spec.coriolis_velocity == "actual",
    }
    has_joint_events = mechanism.joints.has_events(spec.friction_smoothing)
    if spec.formulation == "spf" and spec.spf_coordinates == "z":
        if mechanism.tree.free_roots:
            raise InputError(
                'spf_coordinates = "z": eq. 8 as printed integrates q and z as numbers, and the rotation of a free '
                'root has no such numbers; use "w"'
            )
        if has_joint_events:
            raise InputError(
                f'{mechanism.name}: spf_coordinates = "z" does not close the loops exactly, so joints cannot stick or '
                'rest at stops; use "w"'
            )
        return {"kind": "printed", **table}
    if has_joint_events and spec.initial.w is not None and any(spec.initial.w):
        raise InputError(
            f"initial.w: joints of {mechanism.name} that stick or rest at stops cannot be held off phi = 0; remove it"
        )
    evenness = min(1.0, MAX_INERTIA_RATIO * float(inertias.min()) / float(inertias.max()))
    return {
        "kind": "level_set",
        **table,
        "rhs_tolerance": CLOSURE_TOLERANCE * spec.solver.rtol * mechanism.size * evenness,
    }


def _solver_table(mechanism: Mechanism, spec: SceneSpec, *, profile: bool) -> dict[str, Any]:
    """Return the native loop's table of method, tolerances and budgets; `profile` counts the evaluated terms."""
    solver = spec.solver
    is_printed_spf = spec.formulation == "spf" and spec.spf_coordinates == "z"
    return {
        "method": "Radau" if solver.method == "auto" and is_printed_spf else solver.method,
        "rtol": solver.rtol,
        "atol": solver.rtol / 100 if solver.atol is None else solver.atol,
        "max_step": solver.max_step or math.inf,
        "min_step": solver.min_step,
        "max_rhs": solver.max_rhs or NEVER,
        "manifold_tolerance": max(COLLOCATION_TOLERANCE * mechanism.size, 10 * mechanism.tolerance),
        "profile": profile,
    }
